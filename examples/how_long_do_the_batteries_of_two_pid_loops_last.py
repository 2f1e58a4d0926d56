"""How long do the batteries of two PI controllers' sensors and valves last, and does the promise hold under a load?

Two tanks are joined by a pipe, and a PLC keeps both levels with two PI controllers that stay as they are. Two level
sensors and two valves have a battery and a link each. The rule needs no model of noise or load: with κ = 0.3, the cost
on every path is at most 1/0.7² times that of sending every sample on this path.
"""

import numpy as np
from matplotlib import rcParams
from matplotlib.figure import Figure

import taciturn
from taciturn import PID, Cost, Disturbance, Network, Plant, Problem
from taciturn.model.controller import PIDLoops
from taciturn.model.link import LinkLaw
from taciturn.model.network import NodeRole

DAY, KAPPA, NOISE = 86_400, 0.3, 0.01  # seconds, κ of all nodes together, and noise of levels and sensors in dm
plant = Plant(
    [[0.97, 0.02], [0.02, 0.96]], [[0.05, 0], [0, 0.04]], NOISE**2 * np.eye(2), np.eye(2), NOISE**2 * np.eye(2), dt=1.0
)
cost = Cost.of_variances(plant.C, [0.05**2] * 2, [0.5**2] * 2)  # 5 mm of a level count as much as 0.5 V of a valve
loops = PIDLoops((PID(4, 0.2, disturbance=Disturbance(deviation=0)), PID(4, 0.2, input=2, output=2)))
sensors = {"level-1": NodeRole(measures=(0,)), "level-2": NodeRole(measures=(1,))}
valves = {"valve-1": NodeRole(applies=(0,)), "valve-2": NodeRole(applies=(1,))}
links = dict.fromkeys((*sensors, *valves), LinkLaw(energy=1e-3, battery=9000.0))  # joules of a packet and a battery
network = Network(nodes={**sensors, "plc": NodeRole(controls=True), **valves}, links=links)
problem = Problem(plant, cost, network, "distributed", {"kappa": KAPPA}, controller=loops)

found = taciturn.evaluate(problem, steps=400_000)
days = {link: life.value / DAY for link, life in found.life.items()}
extra = 100 * (found.cost.value / found.cost_all_time - 1)
always = 9000.0 / 1e-3 / DAY
print(f"Days of batteries, not {always:.0f}:", {link: round(day) for link, day in days.items()}, f"cost +{extra:.1f} %")

ticks, rng = 3000, np.random.default_rng(1)
w, v = NOISE * rng.standard_normal((2, ticks, 2))
load = np.outer(0.5 * np.sin(np.arange(ticks) / 100) + (np.arange(ticks) // 500 == 3), [1.0, 0.0])  # V at valve 1
costs = {"every sample": np.empty(ticks), "bank": np.empty(ticks)}
for name, kappa in (("every sample", 0.0), ("bank", KAPPA)):
    nodes, x = taciturn.Nodes(problem.changed({"kappa": kappa})), np.zeros(2)
    for tick in range(ticks):
        y = x + v[tick]
        u = nodes.step(y)
        costs[name][tick] = y @ cost.Q @ y + u @ cost.R @ u
        x = plant.A @ x + plant.B @ (u + load[tick]) + w[tick]
means = {name: np.cumsum(one) / np.arange(1, ticks + 1) for name, one in costs.items()}
means["promise"] = means["every sample"] / (1 - KAPPA) ** 2
ratio = means["bank"][-1] / means["every sample"][-1]
print(f"Under a load that no model contains, the cost is {ratio:.3f} times that of every sample, promised: 2.04")

rcParams.update(taciturn.style())
figure = Figure(figsize=(7, 3.8), layout="constrained")
axes = figure.subplots()
for (name, rows), style in zip(means.items(), ("-", "-", "k:"), strict=True):
    axes.plot(np.arange(ticks) / 60, rows, style, label=name)
axes.set(xlabel="time (min)", ylabel="mean cost up to this time", title="A step of the load after 25 minutes")
axes.legend()
figure.savefig("how_long_do_the_batteries_of_two_pid_loops_last.svg")
assert min(days.values()) > 1.5 * always
assert (means["bank"] <= means["promise"] * (1 + 1e-9)).all()
