"""What estimates of the cost of silence are worth if inputs have limits: the table of docs/constraints.md.

    python benchmarks/limited.py [--json docs/limited.json]

Each loop runs ``excess`` with two estimates of the cost of silence: that of the loop without limits, whose error is 0
for an input that a packet does not change, and a forecast with the limits over some steps. Thresholds vary the rate;
costs at equal rates are interpolated, logarithm over logarithm, between the two nearest. Loops that are in the file
already are kept.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg

import taciturn
from taciturn import PID, Cost, Plant, Policy
from taciturn.base import limited_value
from taciturn.base.limited_value import COST, LimitedSilence
from taciturn.design.silence import BEYOND, LIMIT, WOULD, Beyond
from taciturn.model.steps import Apply, Assign, Decide, Evaluate, Step
from taciturn.model.trigger import Form, Trigger

SEED, STEPS = 1, 1_000_000
AHEAD = (1, 3, 10, 30)  # steps of the forecast
RATES = (0.75, 0.5, 0.25)  # of the rate without a threshold, at which costs are compared
THRESHOLDS = np.geomspace(3e-3, 30, 13)  # in the cost of sending every sample without limits
FORBIDDEN = 1e30


def sampled(A: list[list[float]], B: list[list[float]], h: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a continuous plant with inputs that are held."""
    n, m = np.shape(B)
    whole = scipy.linalg.expm(h * np.block([[np.array(A), np.array(B)], [np.zeros((m, n + m))]]))
    return whole[:n, :n], whole[:n, n:]


def loaded(A: np.ndarray, B: np.ndarray, steps: float, deviation: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return a plant with a slow load at each input: its time constant, deviation, and the variance that moves it."""
    m, pole = B.shape[1], float(np.exp(-1 / steps))
    whole = np.block([[A, B], [np.zeros((m, len(A))), pole * np.eye(m)]])
    return whole, np.vstack([B, np.zeros((m, m))]), (1 - pole**2) * deviation**2


def design(plant: Plant, cost: Cost, **named: Any) -> Callable[[float], Policy]:
    """Return the policy of a threshold, which counts in the cost of every sample."""
    whole = taciturn.design.excess(plant, cost, delta=0.0, **named).cost_all_time
    return lambda share: taciturn.design.excess(plant, cost, delta=share * whole, **named)


def double_integrator() -> Callable[[float], Policy]:
    """Return a position that a limited force holds."""
    A, B = sampled([[0, 1], [0, 0]], [[0], [1]], 0.1)
    return design(Plant(A, B, np.diag([1e-6, 1e-2]), input_limit=[1.0]), Cost(np.diag([1.0, 0.1]), [[0.01]]))


def two_masses() -> Callable[[float], Policy]:
    """Return two masses and a spring, of which a weak force moves one."""
    spring = [[0, 0, 1, 0], [0, 0, 0, 1], [-1, 1, -0.05, 0.05], [1, -1, 0.05, -0.05]]
    A, B = sampled(spring, [[0], [0], [1], [0]], 0.2)
    plant = Plant(A, B, 0.01 * np.diag([0, 0, 1, 1]), input_limit=[0.4])
    return design(plant, Cost(np.diag([0.1, 1, 0, 0]), [[0.05]]))


def oscillator() -> Callable[[float], Policy]:
    """Return a lightly damped mode, and an input that is almost always at a limit."""
    A, B = sampled([[0, 1], [-1, -0.02]], [[0], [1]], 0.3)
    return design(Plant(A, B, 0.01 * np.eye(2), input_limit=[0.1]), Cost(np.eye(2), [[0.05]]))


def unstable() -> Callable[[float], Policy]:
    """Return an unstable state that the limits seldom let escape within a simulation."""
    return design(Plant([[1.05]], [[1.0]], [[0.01]], input_limit=[0.25]), Cost([[1.0]], [[0.1]]))


def valve() -> Callable[[float], Policy]:
    """Return two lags with a slow load, and a valve that cannot remove heat."""
    A, B, moved = loaded(*sampled([[-0.5, 0], [0.5, -0.25]], [[0.5], [0]], 0.5), 40.0, 0.5)
    plant = Plant(A, B, np.diag([1e-3, 1e-3, moved]), input_limit=[[-0.5, np.inf]])
    return design(plant, Cost(np.diag([0, 1.0, 0]), [[0.05]]))


def four_tanks() -> Callable[[float], Policy]:
    """Return two pumps of four tanks, whose leaks can exceed them."""
    A, B = sampled(
        [[-0.016, 0, 0.042, 0], [0, -0.011, 0, 0.033], [0, 0, -0.042, 0], [0, 0, 0, -0.033]],
        [[0.083, 0], [0, 0.063], [0, 0.048], [0.031, 0]],
        4.0,
    )
    A, B, moved = loaded(A, B, 30.0, 0.5)
    plant = Plant(A, B, np.diag([1e-4] * 4 + [moved] * 2), input_limit=[[-0.5, 0.7]] * 2)
    return design(plant, Cost(np.diag([1, 1, 0, 0, 0, 0.0]), 0.02 * np.eye(2)))


def pid_tank(tracking: float | None) -> Callable[[float], Policy]:
    """Return the built-in tank with a valve that its demand sometimes exceeds."""
    problem = taciturn.load("pid-tank")
    plant, pid = problem.plant, PID(1.2, 0.15, 1.0, 0.5, tracking_time=tracking)
    limited = Plant(plant.A, plant.B, plant.W, plant.C, plant.V, plant.dt, input_limit=[0.3])
    return design(limited, problem.cost, controller=pid)


LOOPS: Mapping[str, Callable[[], Callable[[float], Policy]]] = {
    "double integrator": double_integrator,
    "two masses": two_masses,
    "oscillator": oscillator,
    "unstable state": unstable,
    "one-sided valve": valve,
    "four tanks, two pumps": four_tanks,
    "PID tank": lambda: pid_tank(None),
    "PID tank, tracking": lambda: pid_tank(5.0),
}


def without_forecast(policy: Policy) -> Policy:
    """Return the policy whose cost of silence is that of the loop without limits.

    A given controller then sends whatever changes an input while a limit cuts its command.
    """
    steps = tuple(found for step in policy.steps for found in _without(step))
    functions = policy.theory.functions | {BEYOND}
    return replace(policy, steps=steps, theory=replace(policy.theory, functions=functions))


def _without(step: Step) -> tuple[Step, ...]:
    if not isinstance(step, Apply) or not isinstance(step.function, LimitedSilence):
        return (step,)
    rule, m, state = step.function, len(step.function.H), step.reads[:-2]
    if len(rule.free[0]) == m:
        return (Evaluate(step.at, COST, (Form(("error",), rule.H),)),)
    K, slope, n = rule.free[0][:m], rule.free[0][m:] / 2, rule.free[0].shape[1]
    form = Form(("error", *state), np.block([[rule.H, slope], [slope.T, np.zeros((n, n))]]))
    sizes = {"measured": 1, "register": n - 4, "estimate": 3}  # of the tank, its load and its outputs
    places = np.cumsum([0, *(sizes[name] for name in state)])
    would = {name: K[:, a:b] for name, a, b in zip(state, places[:-1], places[1:], strict=True)}
    beyond = {f"input {i + 1} limited": Form((BEYOND,), -np.diag(row)) for i, row in enumerate(np.eye(m))}
    return (
        Assign(step.at, WOULD, would),
        Apply(step.at, {BEYOND: m}, Beyond(rule.limits), (WOULD,)),
        Decide(step.at, LIMIT, Trigger({"within": Form(), **beyond})),
        Evaluate(step.at, COST, (form, *[Form(constant=FORBIDDEN)] * m), LIMIT),
    )


def points(made: Callable[[float], Policy], ahead: int | None) -> np.ndarray:
    """Return rate, cost and its standard error for each threshold, (thresholds, 3), by rising rates."""
    found = list[tuple[float, float, float]]()
    with_ahead, limited_value.AHEAD = limited_value.AHEAD, ahead or 1
    try:
        for share in (0.0, *THRESHOLDS):
            policy = made(share) if ahead else without_forecast(made(share))
            one = taciturn.average(taciturn.close(policy.model, policy), seed=SEED, steps=STEPS)
            found.append((one.rates["actuator"].value, one.cost.value, one.cost.standard_error))
    finally:
        limited_value.AHEAD = with_ahead
    return np.array(sorted(found))


def at_rates(curve: np.ndarray, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the interpolated costs at these rates, and the relative standard errors of the nearest points."""
    known = np.log(np.maximum(curve[:, 0], 1e-9))
    assert rates.min() >= curve[0, 0], f"expected rates of at least {curve[0, 0]:g}"
    costs = np.exp(np.interp(np.log(rates), known, np.log(curve[:, 1])))
    return costs, np.interp(np.log(rates), known, curve[:, 2] / curve[:, 1])


def measure(name: str) -> dict[str, Any]:
    """Return the costs of a loop at equal rates, by estimate."""
    made = LOOPS[name]()
    before = points(made, None)
    rates = before[-1, 0] * np.array(RATES)
    costs, errors = at_rates(before, rates)
    path = taciturn.simulate(taciturn.close(made(0.0).model, made(0.0)), 20_000, seed=SEED)
    limits = made(0.0).model.saturation
    assert limits is not None
    share = ((path.input <= limits.low) | (path.input >= limits.high)).any(axis=1).mean()
    cell: dict[str, Any] = {"loop": name, "at a limit": float(share), "rates": rates.tolist(), "steps": STEPS}
    cell |= {"without": costs.tolist(), "errors": errors.tolist()}
    for ahead in AHEAD:
        costs, errors = at_rates(points(made, ahead), rates)
        cell[f"forecast of {ahead}"] = costs.tolist()
        cell[f"errors of {ahead}"] = errors.tolist()
    return cell


def main() -> None:
    """Compute all loops and write them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="where to write the costs")
    arguments = parser.parse_args()
    cells: list[dict[str, Any]] = []
    if arguments.json and arguments.json.is_file():
        cells = json.loads(arguments.json.read_text(encoding="utf-8"))
    for name in LOOPS:
        if any(cell["loop"] == name for cell in cells):
            continue
        cell = measure(name)
        cells.append(cell)
        cells.sort(key=lambda one: [*LOOPS].index(one["loop"]))
        print(f"{name}: a limit binds in {cell['at a limit']:.0%} of the steps")
        for i, rate in enumerate(cell["rates"]):
            shown = ", ".join(
                f"{ahead}: {cell[f'forecast of {ahead}'][i] / cell['without'][i] - 1:+.1%}" for ahead in AHEAD
            )
            print(
                f"  {rate:.3f} per step: cost {cell['without'][i]:.4g} ± {cell['errors'][i]:.1%}; {shown}", flush=True
            )
        if arguments.json:
            arguments.json.write_text(json.dumps(cells, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
