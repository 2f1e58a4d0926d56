"""How often must a camera measure an inverted pendulum? Motor and controller are at the pivot, the camera is remote."""

import numpy as np
from matplotlib import rcParams
from matplotlib.figure import Figure

import taciturn
from taciturn.simulation.average import plain_average

# upright pendulum of 0.5 m, unstable pole at 4.4 rad/s; at most 50 pictures per second, each accurate to 3 mrad
pendulum = taciturn.ContinuousPlant(
    A=[[0, 1], [9.81 / 0.5, -0.1]], B=[[0], [4]], W=np.diag([0, 0.05]), C=[[1, 0]], V=[[1e-5]]
)
cost = taciturn.Cost(Q=np.diag([10, 1]), R=[[0.1]])

policies, queries = [], []
for zeta in (0.0, 5e-5, 1e-4, 2e-4, 5e-4, 8e-4, 1.5e-3):  # price of a query, that is, of a picture
    policy = taciturn.design.remote_lqg(pendulum, cost, zeta=zeta, controller="actuator", period=0.02)
    policies.append(policy)
    queries.append(policy.schedule.rate / policy.tick)
    # the schedule depends on covariances only: its cost is exact without simulation
    above = policy.theory.closed_form.cost / policy.cost_all_time - 1
    bound = policy.guarantee.cost / policy.cost_all_time - 1
    print(f"ζ = {zeta:g}: {queries[-1]:.1f} queries per second cost {above:.1%} more than 50, guarantee {bound:.1%}")

costs = [p.theory.closed_form.cost for p in policies]
rcParams.update(taciturn.style())
figure = Figure(figsize=(7, 6), layout="constrained")
trade, course = figure.subplots(2, 1)
trade.plot(queries, costs, "o-")
trade.set(xlabel="queries per second", ylabel="cost per second")
schedule = policies[2].schedule
course.plot(4 * schedule.value.tolist(), "o-", label="value of a query")
course.axhline(schedule.price, color="C3", linestyle="--", label="price of a query, ζ")
course.set(xlabel=f"step (the schedule repeats every {schedule.period} steps)", ylabel="cost")
course.legend()
figure.savefig("how_often_must_a_camera_look.svg")

# compare the exact cost at the lowest rate with a simulation
loop = taciturn.close(pendulum, policies[-1])
found = taciturn.average(loop, plain_average(loop), steps=20_000_000)
print(f"{queries[-1]:.1f} queries per second: exact {costs[-1]:.6f}, simulated {found.cost}")
assert abs(found.cost.value - costs[-1]) < 6 * found.cost.standard_error
assert queries == sorted(queries, reverse=True)
assert all((1 - 1e-9) * p.cost_all_time <= p.theory.closed_form.cost <= (1 + 1e-9) * p.guarantee.cost for p in policies)
