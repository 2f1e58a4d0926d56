"""Do four water tanks reach their levels although a valve leaks and the pumps are limited?

The quadruple tank near its minimum-phase operating point, in cm and V: levels follow Torricelli's law, an outlet is
15 % larger than in the model, and the pumps apply 0 to 6 V. Each sensor and each pump has a link of its own.
"""

import numpy as np
from matplotlib import rcParams
from matplotlib.figure import Figure

import taciturn
from taciturn.model.disturbance import follow
from taciturn.model.dynamics import equilibrium
from taciturn.model.operating_point import OperatingPoint
from taciturn.model.signals import ExternalDisturbance, Timetable

AREA, OUTLET = np.array([28.0, 32.0, 28.0, 32.0]), np.array([0.071, 0.057, 0.071, 0.057])  # cm²: johansson2000
FLOWS = np.array([[0.7 * 3.33, 0], [0, 0.6 * 3.35], [0, 0.4 * 3.35], [0.3 * 3.33, 0]])  # cm³/(V s): johansson2000
LEAK, DT, VOLTS, LIMITS = 0.15, 2.0, [3.0, 3.0], [[0.0, 6.0]] * 2  # leak, step, limits and timetable: assumed
TABLE = Timetable([0, 100, 200, 300, 400], [[12, 13], [17, 13], [17, 17], [9, 13], [12, 13]])  # steps, cm
built = taciturn.load("quadruple-tank")


def tanks(limits: list[list[float]] | None, wander: float, leak: float | None = None) -> taciturn.Plant:
    """Return the tanks, linear without a leak, with unknown flows into the lower tanks if wander is not 0."""

    def slopes(h: np.ndarray, v: np.ndarray) -> np.ndarray:
        out = OUTLET * np.array([1 + (leak or 0.0), 1, 1, 1]) * np.sqrt(2 * 981.0 * np.maximum(h, 0.0))
        return (FLOWS @ v + np.array([out[2], out[3], 0, 0]) - out) / AREA

    step = taciturn.integrate(slopes, dt=DT, steps=2)
    point = OperatingPoint(equilibrium(step, [12.4, 12.7, 1.8, 1.4], VOLTS), VOLTS)  # where these tanks rest
    A, B = taciturn.linearise(step, states=4, inputs=2, at=(point.x, point.u))
    given = {"function": None if leak is None else step, "operating_point": point, "input_limit": limits}
    plant = taciturn.Plant(A, B, DT * built.plant.W, built.plant.C, built.plant.V, DT, **given)
    flows = [ExternalDisturbance(DT / AREA * np.eye(4)[i], wander) for i in (0, 1)] if wander else []  # cm³/s
    return follow(plant, plant.C, None, flows, TABLE)


cases = {"leak estimated, anti-windup": (LIMITS, 0.01), "leak estimated": (None, 0.01), "anti-windup": (LIMITS, 0.0)}
rule = {"theta": 1.0, "prediction": "model", "actuation": "model"}
rcParams.update(taciturn.style())
upper, lower = (figure := Figure(figsize=(7, 5.5), layout="constrained")).subplots(2, 1, sharex=True)
high, off, minutes = {}, {}, DT / 60 * np.arange(400)
for name, (limits, wander) in cases.items():
    design, actual = tanks(limits, wander), tanks(LIMITS, 1e-12 if wander else 0.0, LEAK)  # no flow but the leak
    problem = taciturn.Problem(design, built.cost, built.network, "distributed", rule, actual)
    path = taciturn.simulate(problem.close(problem.design()), 31 * 400, seed=1)
    level, voltage = (x[400:, 0].reshape(30, 400).mean(axis=0) for x in (path.state, path.input))  # 30 periods
    high[name], off[name] = level[100:200].max() - 17, np.abs(level[170:200].mean() - 17)
    sends = sum(sent[400:].mean() for sent in path.sends.values())
    print(f"{name}: overshoot {high[name]:.2f} cm, offset {off[name]:.2f} cm, {sends:.2f} packets per step")
    _, _ = upper.plot(minutes, level, label=name), lower.step(minutes, voltage)
upper.step(minutes, TABLE.sampled(1.0).table.cumsum(axis=0)[np.arange(-1, 399), 0] + 12, "k--", label="set-point")
upper.set(title="Mean of 30 periods", ylabel="level of tank 1 (cm)")
lower.set(ylabel="voltage of pump 1 (V)", xlabel="time (min)")
upper.legend(fontsize="small")
figure.savefig("four_tanks_with_a_leak.svg")
assert high["leak estimated, anti-windup"] < 0.4 * high["leak estimated"]
assert off["leak estimated, anti-windup"] < 0.3 * off["anti-windup"]
