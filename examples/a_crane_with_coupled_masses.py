"""How many packets does a crane need whose equations of motion have a mass matrix, if its force costs nothing?"""

import numpy as np

import taciturn

# trolley of 1 kg, load of 0.2 kg on a rope of 0.5 m; states: position, angle, and their rates
m, load, rope, gravity, friction = 1.0, 0.2, 0.5, 9.81, 0.5
masses = np.array([[m + load, load * rope], [load * rope, load * rope**2]])
unit, none = np.eye(2), np.zeros((2, 2))
E = np.block([[unit, none], [none, masses]])
A = np.block([[none, unit], [np.diag([0, -load * gravity * rope]), np.diag([-friction, -0.002])]])
B, W = [[0], [0], [1], [0]], np.diag([0, 0, 0.05, 1e-4])  # force on the trolley; gusts on trolley and load
crane = taciturn.ContinuousPlant(E=E, A=A, B=B, W=W, C=[[1, 0, 0, 0], [0, 1, 0, 0]], V=np.diag([1e-6, 1e-5]))

hook = np.array([[1.0, rope, 0.0, 0.0]])  # only the position of the load has a cost: R = 0
cost = taciturn.Cost(Q=hook.T @ hook, R=[[0.0]])
problem = taciturn.Problem(
    crane, cost, taciturn.Network(), "excess", {"theta": 0.5, "actuation": "model", "period": 0.05}
)
found = taciturn.evaluate(problem, seed=1)
rate = found.rates["actuator"].value
print(f"{rate:.1f} packets per second instead of {found.base_rate:g}")
reached, all_packets = (1000 * value**0.5 for value in (found.cost.value, found.cost_all_time))
print(f"deviation of the load {reached:.2f} mm, {all_packets:.2f} with all packets")
assert rate < 0.8 * found.base_rate
assert found.cost.value < found.cost_bound
