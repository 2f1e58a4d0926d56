"""Every policy that fits, on three plants, at three rates: the tables of docs/comparison.md.

    python benchmarks/comparison.py [--json docs/comparison.json]

A policy that does not reach a rate is left out of that ranking, with the sentence that says why. Tables that are in the
file already are kept: it can be interrupted, and continues where it was.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import taciturn
from taciturn import ContinuousPlant, Plant, Problem, TaciturnError

SHARES = (0.1, 0.3, 0.5)  # of the base rate
PRECISION = 1e-3  # standard error of a cost, in all-time costs
PLANTS = {
    "two-mass": "two masses and a spring",
    "inverted-pendulum": "inverted pendulum on a cart",
    "wiener-double-integrator": "double integrator",
}
POLICIES: dict[str, dict[str, object]] = {
    "periodic": {"kind": "periodic"},
    "periodic, model": {"kind": "periodic", "actuation": "model"},
    "pattern of 12": {"kind": "periodic-schedule", "length": 12, "sends": 4},
    "rollout": {"kind": "rollout", "horizon": 1, "every": 3},
    "lqg": {"kind": "lqg", "theta": 0.1},
    "lqg, model": {"kind": "lqg", "theta": 0.1, "actuation": "model"},
    "absolute": {"kind": "absolute", "threshold": 1.0},
    "absolute, model": {"kind": "absolute", "threshold": 1.0, "actuation": "model"},
    "absolute, state": {"kind": "absolute", "threshold": 1.0, "error": "state"},
    "relative": {"kind": "relative", "sigma": 0.5},
    "mixed": {"kind": "mixed", "sigma": 0.3, "threshold": 0.1},
    "dynamic": {"kind": "dynamic", "sigma": 0.3, "rho": 0.8, "gain": 2.0},
    "stochastic": {"kind": "stochastic"},
    "stochastic, model": {"kind": "stochastic", "actuation": "model"},
    "downsampled": {"kind": "downsampled", "fast": 1, "slow": 2, "threshold": 0.1},
    "self-triggered": {"kind": "self-triggered", "beta": 1.2, "max_interval": 20},
    "variance": {"kind": "variance", "threshold": 0.1},
    "send-on-delta": {"kind": "send-on-delta", "delta": 0.1},
    "consistent": {"kind": "consistent"},
}


def problem_with(base: Problem, policy: dict[str, object]) -> Problem:
    """Return the problem with another policy."""
    old = {name: None for name in base.parameters if name != "period" and name not in policy}
    if policy["kind"] == "periodic" and not (isinstance(base.plant, ContinuousPlant) and base.plant.full_state):
        old["every"] = 3
    return base.changed({**old, **policy})


def fitting(base: Problem, rate: float) -> tuple[dict[str, Problem], dict[str, str]]:
    """Return the problems whose policies reach a rate, and why the others do not."""
    fit: dict[str, Problem] = {}
    why: dict[str, str] = {}
    for name, policy in POLICIES.items():
        if policy["kind"] == "consistent" and (isinstance(base.plant, Plant) or not base.plant.full_state):
            continue  # it predicts a measured state in continuous time
        try:
            problem = problem_with(base, policy)
            fit[name] = taciturn.tune(problem, rate=rate, standard_error=1e300).problem
        except TaciturnError as error:
            why[name] = str(error)
    return fit, why


def table(plant: str, share: float) -> dict[str, Any]:
    """Return the ranking on a plant at a share of its base rate."""
    base = taciturn.load(plant)
    rate = share / base.design().tick
    fit, why = fitting(base, rate)
    wanted = PRECISION * base.design().cost_all_time
    found = None
    while found is None:
        try:
            found = taciturn.compare(fit, rate, standard_error=wanted)
        except TaciturnError as error:  # of one policy, whose name comes first
            name, _, why[name] = str(error).partition(": ")
            del fit[name]
    return {"plant": plant, "title": PLANTS[plant], "share": share, **found.document(), "left_out": why}


def main() -> None:
    """Compute all rankings and write them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="where to write the tables")
    arguments = parser.parse_args()
    tables: list[dict[str, Any]] = []
    if arguments.json and arguments.json.is_file():
        tables = json.loads(arguments.json.read_text(encoding="utf-8"))
    for plant in PLANTS:
        for share in SHARES:
            if any(one["plant"] == plant and one["share"] == share for one in tables):
                continue
            found = table(plant, share)
            tables.append(found)
            for place in found["ranking"]:
                above = place["above_best"]
                apart = f"{above['value']:.3g} ± {above['standard_error']:.1g}"
                print(
                    f"{plant:26s}{share:5.0%}  {place['name']:20s}{place['cost']['value']:12.5g}  +{apart}", flush=True
                )
            for name, text in found["left_out"].items():
                print(f"{plant:26s}{share:5.0%}  {name:20s}{text}")
            order = [(plant, share) for plant in PLANTS for share in SHARES]
            tables.sort(key=lambda one: order.index((one["plant"], one["share"])))
            if arguments.json:
                arguments.json.write_text(json.dumps(tables, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
