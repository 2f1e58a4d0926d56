"""Which threshold costs less than periodic control? Three triggers for an unstable platform pushed by gusts."""

import numpy as np
from matplotlib import rcParams
from matplotlib.figure import Figure

import taciturn
from taciturn.lqg.prediction import prediction_cost
from taciturn_events.losing_thresholds import find_losses
from taciturn_events.policy import average_events

# position and velocity; two gusts per second on average push the velocity, and the position a little
gusts = taciturn.Jumps(rate=2.0, covariance=[[0.02, 0.0], [0.0, 1.0]])
plant = taciturn.ContinuousPlant(A=[[0.0, 1.0], [1.0, -0.2]], B=[[0.0], [1.0]], jumps=gusts)
cost = taciturn.Cost(Q=[[4.0, 0.0], [0.0, 0.1]], R=[[0.5]])
price = prediction_cost(plant.A, plant.B, cost.Q, cost.R, cost.N, plant.W)

rcParams.update(taciturn.style())
figure = Figure(figsize=(7, 4.5), layout="constrained")
axes = figure.subplots()
rates = np.geomspace(0.4, 6, 60)
axes.plot(rates, [price.periodic(1 / r) for r in rates], "--", color="0.5", label="periodic control")

found: dict[str, list[tuple[float, float]]] = {"consistent": [], "integral": [], "Euclidean": []}
for period in (0.6, 0.3, 0.15):
    policy = taciturn.design.consistent(plant, cost, period=period)
    result = taciturn.average(taciturn.close(plant, policy), steps=400_000)
    rate = result.rates["sensor"]
    found["consistent"].append((rate.value, result.cost.value))
    print(f"consistent, a check every {period} s: {rate} sends per second, cost {result.cost}")
    assert result.cost.value - 4 * result.cost.standard_error < price.periodic(1 / rate.value)

for share in (0.2, 0.5, 0.95):
    policy = taciturn.design.integral(plant, cost, slope=share * price.initial_slope, h_max=3.0)
    result = average_events(policy)
    found["integral"].append((result.rates["sensor"].value, result.cost.value))
    print(f"integral, slope {share:.0%} of its limit: α* = {policy.alpha} s, cost {result.cost}")
    assert result.cost.value < price.periodic(1 / result.rates["sensor"].value)

losses = find_losses(plant, cost, levels=[0.1, 0.3, 1.0, 2.0, 4.0], cycles=100_000)
found["Euclidean"] = [(point.rate.value, point.cost.value) for point in losses.points]
print("rates at which the Euclidean threshold costs more than periodic control:", losses.rates or "none")

for name, points in found.items():
    axes.plot(*zip(*points, strict=True), "o-", markersize=4, label=name)
axes.set(xlabel="sends per second", ylabel="cost per second", xscale="log")
axes.legend()
figure.savefig("which_threshold_beats_periodic_control.svg")
assert all(spent < price.periodic(1 / rate) for name in ("consistent", "integral") for rate, spent in found[name])
