"""Packets of three PID controllers with published plants, at the cost of today's loop plus five percent.

    python benchmarks/published_pids.py [--json docs/published_pids.json]

Every rule keeps the controller. Its parameter is tuned until the cost is at most 1.05 times that of sending every
sample; the periodic rows are exact. The script keeps the rows of an existing file, and computes the missing ones.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

import taciturn
from taciturn import PID, ContinuousPlant, Network, Problem, TaciturnError
from taciturn._files import write_whole
from taciturn.base.given_controller import cost_as_now, disturbed

MORE = 0.05
ACCURACY = 5e-4  # standard error relative to the cost
LONGEST = 400  # steps between packets that are tried
ULTIMATE_GAIN, ULTIMATE_PERIOD = 8.0, 2 * np.pi / np.sqrt(3)  # of 1/(s + 1)³


def three_lags() -> tuple[ContinuousPlant, PID, float]:
    """1/(s + 1)³ [astrom1995] with the rule of Ziegler and Nichols [ziegler1942], derivative filter Td/5."""
    kp, Ti, Td = 0.6 * ULTIMATE_GAIN, ULTIMATE_PERIOD / 2, ULTIMATE_PERIOD / 8
    plant = ([[-1, 1, 0], [0, -1, 1], [0, 0, -1]], [[0], [0], [1]], [[1, 0, 0]])
    return plant_with(plant, 0.3, 0.01), PID(kp, kp / Ti, kp * Td, Td / 5), 0.05


def motor_speed() -> tuple[ContinuousPlant, PID, float]:
    """The speed of a DC motor and its PID controller (100, 200, 10) [ctms]."""
    J, b, K, R, L = 0.01, 0.1, 0.01, 1.0, 0.5
    plant = ([[-b / J, K / J], [-K / L, -R / L]], [[0], [1 / L]], [[1, 0]])
    return plant_with(plant, 1.0, 0.005), PID(100, 200, 10, 0.1), 0.005


def cruise_control() -> tuple[ContinuousPlant, PID, float]:
    """The speed of a car of 1,000 kg with the friction 50 N s/m, and its PI controller (800, 40) [ctms]."""
    return plant_with(([[-50 / 1000]], [[1 / 1000]], [[1]]), 300.0, 0.05), PID(800, 40), 0.1


def plant_with(matrices: tuple[Any, Any, Any], at_input: float, at_output: float) -> ContinuousPlant:
    """Return the plant with white noise of an intensity at the input, and of a deviation at the output."""
    A, B, C = matrices
    B = np.array(B, dtype=float)
    return ContinuousPlant(A, B, B @ B.T * at_input**2, C=C, V=[[at_output**2]])


CASES = {"three lags": three_lags, "motor speed": motor_speed, "cruise control": cruise_control}
RULES: dict[str, dict[str, Any]] = {
    "excess, command, hold": {"theta": 0.5},
    "excess, command, model": {"theta": 0.5, "actuation": "model"},
    "excess, measurement, hold": {"theta": 0.5, "link": "sensor"},
    "excess, measurement, model": {"theta": 0.5, "link": "sensor", "actuation": "model"},
    "send-on-delta, measurement": {"kind": "send-on-delta", "delta": 1.0},
    "send-on-delta, command": {"kind": "send-on-delta", "delta": 1.0, "link": "actuator"},
    "symmetric-send-on-delta": {"kind": "symmetric-send-on-delta", "delta": 1.0},
    "event-pid": {"kind": "event-pid", "delta": 1.0},
    "event-pid-saturated": {"kind": "event-pid-saturated", "delta": 1.0},
}


def problem_of(case: str) -> Problem:
    """Return the problem of a case, with weights for which the loop's present variances count equally."""
    plant, pid, period = CASES[case]()
    cost = cost_as_now(plant, pid, period)
    return Problem(plant, cost, Network(), "excess", {"theta": 0.1, "period": period}, controller=pid)


def tuned(case: str, rule: str) -> dict[str, Any]:
    """Return the packets per second and the cost of a rule with the budget."""
    problem, changes = problem_of(case), dict(RULES[rule])
    if "delta" in changes:
        deviation = np.sqrt(1 / (problem.cost.R if changes.get("link") == "actuator" else _output_weight(problem)))
        changes["theta"], changes["delta"] = None, float(0.3 * np.asarray(deviation).item())
    changed = problem.changed(changes)
    always = problem.design().cost_all_time
    try:
        found = taciturn.tune(changed, cost=(1 + MORE) * always, standard_error=ACCURACY * always)
    except TaciturnError as error:
        return {"refused": str(error)}
    answer = found.evaluation
    (rate,) = answer.rates.values()
    return {
        "rate": rate.value,
        "rate_error": rate.standard_error,
        "cost": answer.cost.value / always,
        "cost_error": answer.cost.standard_error / always,
        "parameter": found.parameter.value,
    }


def _output_weight(problem: Problem) -> Any:
    C = np.asarray(problem.plant.C, dtype=float)
    return (C @ problem.cost.Q @ C.T) / (C @ C.T) ** 2


def periodic(case: str) -> dict[str, Any]:
    """Return the lowest rates of periodic packets with the budget: the controller as it is, and discretised anew."""
    problem = problem_of(case)
    policy = problem.design()
    same, period = policy.theory.periodic, policy.tick
    noise, budget = policy.theory.noise_cost, (1 + MORE) * policy.cost_all_time * period

    def slowest(cost_at: Any) -> dict[str, float]:
        costs = {q: cost for q in range(1, LONGEST) if (cost := cost_at(q)) is not None}
        within = [q for q, cost in costs.items() if cost + noise <= budget]
        q = max(within)
        beyond = costs.get(q + 1)
        rate = 1 / q
        if beyond is not None:  # long phases of q and of q + 1
            share = (budget - noise - costs[q]) / (beyond - costs[q])
            rate = share / (q + 1) + (1 - share) / q
        return {"rate": float(rate / period), "steps": q}

    return {
        "at its own step": slowest(same.at_its_step),
        "discretised anew": slowest(lambda q: same.at_its_step(1) if q == 1 else same.discretised(q)),
        "every sample": 1 / period,
        "LQG": taciturn.design.all_time(*_with_disturbance(problem), period=period).cost_all_time
        / policy.cost_all_time,
    }


def _with_disturbance(problem: Problem) -> tuple[Any, Any]:
    assert problem.controller is not None
    found, _, _ = disturbed(problem.plant, problem.cost, problem.parameters["period"], problem.controller)
    return found.source, found.cost


def main() -> None:
    """Compute what is missing in the file, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    path = parser.parse_args().json
    known: dict[str, Any] = json.loads(path.read_text()) if path and path.exists() else {}
    for case in CASES:
        rows: dict[str, Any] = known.setdefault(case, {})
        for rule in ("periodic", *RULES):
            if rule not in rows:
                rows[rule] = periodic(case) if rule == "periodic" else tuned(case, rule)
                print(case, rule, rows[rule], flush=True)
                if path:
                    write_whole(path, (json.dumps(known, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
