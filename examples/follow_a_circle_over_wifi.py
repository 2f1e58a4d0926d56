"""How well does a robot follow a circle over Wi-Fi that drops packets, with event-triggered corrections?"""

import numpy as np
from matplotlib import rcParams
from matplotlib.figure import Figure

import taciturn

steps, seconds = 200, 0.1
angle = np.linspace(0, 2 * np.pi, steps + 1)
circle = np.column_stack([np.cos(angle), np.sin(angle)])
reference = taciturn.Reference(states=circle, inputs=np.diff(circle, axis=0) / seconds)  # known at both ends

plane = np.eye(2)
robot = taciturn.Plant(A=plane, B=seconds * plane, W=1e-4 * plane, dt=seconds, mean=[1.0, 0.3])  # starts 0.3 m off
cost = taciturn.Cost(Q=plane, R=0.1 * plane, horizon=steps)
wifi = taciturn.Network("udp", actuator_loss=0.1, sensor_loss=0.25, delay=1)

paths, rates = {}, []
for price in (0.0, 0.0003, 0.001, 0.003):
    policy = taciturn.design.lossy_lqg(robot, cost, price=price, network=wifi, reference=reference)
    loop = taciturn.close(robot, policy)
    found = taciturn.average(loop, standard_error=5e-4)
    sends = found.rates["actuator"]
    bound = policy.guarantee.at_rate(sends.value)
    print(f"λ = {price:g}: corrections in {sends.value:.1%} of the steps; deviations cost {found.cost}, ", end="")
    print(f"at every sample {policy.cost_all_time:.4f}, at this rate at most {bound:.4f}")
    slack = 5 * (found.cost.standard_error + price * steps * sends.standard_error) + 1e-9
    assert policy.cost_all_time - slack <= found.cost.value <= bound + slack
    paths[price], rates = taciturn.simulate(loop, steps, seed=1), [*rates, sends.value]

rcParams.update(taciturn.style())
figure = Figure(figsize=(6, 6), layout="constrained")
axes = figure.subplots()
axes.plot(*circle.T, "--", color="C7", label="reference")
for index, price in enumerate((0.0, 0.003)):
    path = paths[price]
    sent = path.sends["actuator"]
    axes.plot(*path.state.T, color=f"C{index}", linewidth=1, label=f"λ = {price:g}: {sent.sum()} corrections")
    axes.plot(*path.state[sent].T, ".", color=f"C{index}", markersize=4)
axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
axes.legend()
figure.savefig("follow_a_circle_over_wifi.svg")

off = {price: np.linalg.norm(path.state - circle[:-1], axis=1)[20:] for price, path in paths.items()}
print("largest distance from the reference after 2 s:", {price: f"{100 * d.max():.0f} cm" for price, d in off.items()})
assert rates[-1] < 0.3 * rates[0]
assert off[0.003].max() < 0.5
