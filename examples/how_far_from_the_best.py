"""How far from the best schedule is a threshold? A drone holds its position in gusts and uses its radio rarely.

The position is measured, the velocity is not, and the thrust lags behind the command. The drone predicts the commands
of the ground station with a model. A lower bound for every schedule shows how far the threshold can be from the best.
"""

from dataclasses import replace

import taciturn

plant = taciturn.ContinuousPlant(
    A=[[0.0, 1.0, 0.0], [0.0, -0.3, 1.0], [0.0, 0.0, -4.0]],  # position, velocity, thrust
    B=[[0.0], [0.0], [4.0]],
    W=[[0.0, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.01]],
    C=[[1.0, 0.0, 0.0]],
    V=[[1e-4]],
)
cost = taciturn.Cost(Q=[[4.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]], R=[[0.1]])
rule = {"delta": 0.01, "period": 0.05, "actuation": "model"}
drone = taciturn.Problem(plant, cost, taciturn.Network(), "excess", rule)

grid = taciturn.tradeoff(drone, {"delta": [0.003, 0.01, 0.03]}, standard_error=1e-3, confidence=0.999)
for point in grid.points:
    found, rate = point.evaluation, point.evaluation.rates["actuator"]
    lower = found.lower_bound
    assert lower is not None
    assert found.cost_all_time is not None
    assert found.cost_bound_at_rate is not None
    costs = found.cost.value, lower.cost, found.cost_bound_at_rate
    shares = [100 * (each / found.cost_all_time - 1) for each in costs]
    print(f"{rate} sends per second instead of {found.base_rate:.0f} cost {shares[0]:.2f} % more than every sample;")
    print(f"  lower bound for every schedule: {shares[1]:.2f} % more, upper bound for this one: {shares[2]:.1f} %")
    assert lower.cost < found.cost.value + 4 * found.cost.standard_error < found.cost_bound_at_rate

last = grid.points[-1].evaluation
assert last.lower_bound is not None
price = last.lower_bound.price * 0.05  # per send: price of the bound times seconds per step
best = replace(drone, kind="near-optimal", parameters={"price": price, "period": 0.05})
near = taciturn.evaluate(best, standard_error=1e-3)
limit = last.lower_bound.at_rate(near.rates["actuator"].value * 0.05)
print(f"near-optimal: {near.rates['actuator']} sends per second cost {near.cost}, lower bound at this rate {limit:.4f}")
grid.plot().savefig("how_far_from_the_best.svg")
assert limit < near.cost.value + 4 * near.cost.standard_error
