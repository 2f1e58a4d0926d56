"""The experiments with the twins of both robots, in full: finite-horizon runs, prices, faults, real time, wheels.

    python benchmarks/twins.py [--runs 20] [--rounds 5] [--json docs/twins.json]

What has been done is kept in the file, experiment by experiment: started again, it continues with the rest.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from taciturn._files import write_whole
from taciturn_twins.faults import parse_fault
from taciturn_twins.prepared import Prepared, prepare
from taciturn_twins.run import TwinRun, mean, run_twin
from taciturn_twins.trial import Setup

PRICES = (0.0, 0.001, 0.002, 0.01)
FAULTS = {
    "rover": ("", "camera@1.2+2", "actuator@3+2", "actuator@0+2", "kidnap@6=0.2", "cover@1.2+2", "light@0+18=0.4",
              "controller@3", "push@3+0.3=20", "gain=0.1"),
    "omni": ("", "camera@6+2", "actuator@6+2", "kidnap@6=0.2", "cover@6+2", "light@0+25=0.4", "controller@6",
             "push@6+0.3=20", "gain=0.1"),
}  # fmt: skip


def summary(run: TwinRun) -> dict[str, Any]:
    """Return what is kept of a run."""
    kept = run.document()
    for name in ("processes", "calibration", "model"):
        del kept[name]
    totals = run.trial.totals
    kept["costs"] = totals.tolist()
    if run.always is not None:
        kept["costs_all_time"] = run.always.totals.tolist()
        ratio = mean(totals / run.always.totals)
        kept["cost_over_all_time"] = {"value": ratio.value, "standard_error": ratio.standard_error}
    guarantee = run.policy.guarantee
    assert guarantee is not None
    kept["cost_bound_at_rate"] = guarantee.at_rate(run.rates["actuator"].value)
    kept["lateness_ms"] = run.trial.reports["sensor"].get("lateness_ms")
    return kept


def path(run: TwinRun) -> dict[str, Any]:
    """Return the first run step by step, for pictures."""
    trial = run.trial
    return {
        "poses": np.round(trial.poses[0], 4).tolist(),
        "estimates": np.round(trial.estimates[0], 4).tolist(),
        "inputs": np.round(trial.inputs[0], 4).tolist(),
        "running_cost": np.round(trial.costs.mean(axis=0), 6).tolist(),
        "sent": {link: np.flatnonzero(sent[0]).tolist() for link, sent in trial.sent.items()},
    }


def rover(prepared: Prepared, runs: int) -> dict[str, Any]:
    """Return the rover's finite-horizon runs, event-triggered and all-time."""
    run = run_twin(prepared, Setup(runs))
    always = run.always
    assert always is not None
    other = TwinRun(run.prepared, run.policy, always, None, run.setup, 0.0)
    return {"summary": summary(run), "path": path(run), "path_all_time": path(other)}


def prices(prepared: Prepared, rounds: int) -> dict[str, Any]:
    """Return the omni's rounds at each price."""
    found: dict[str, Any] = {}
    for price in PRICES:
        run = run_twin(prepared, Setup(rounds), parameters={"price": price}, compare=False)
        distance = mean(1e3 * np.sqrt((run.trial.off**2).mean(axis=1)))
        found[str(price)] = {
            "summary": summary(run),
            "off_mm": {"value": distance.value, "standard_error": distance.standard_error},
            "path": path(run) if price in (0.0, 0.01) else None,
        }
    return found


def robustness(prepared: Prepared) -> dict[str, Any]:
    """Return what becomes of one run under each fault."""
    found: dict[str, Any] = {}
    for text in FAULTS[prepared.robot.name]:
        faults = (parse_fault(text),) if text else ()
        run = run_twin(prepared, Setup(seed=1, faults=faults), compare=False)
        distance = run.trial.off[0]
        found[text or "none"] = {
            "cost": float(run.trial.totals[0]),
            "sends": int(run.trial.sent["actuator"].sum()),
            "largest_off_m": float(distance[distance.size // 3 :].max()),
            "last_off_m": float(distance[-20:].mean()),
            "unseen": run.trial.datagrams["sensor"]["unseen"],
            "unanswered": run.trial.datagrams["questions"]["unanswered"],
            "notes": list(run.trial.notes),
        }
    return found


def main() -> None:
    """Do what has not been done, and keep it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", type=Path, default=Path("docs/twins.json"))
    given = parser.parse_args()
    kept: dict[str, Any] = json.loads(given.json.read_text()) if given.json.exists() else {}
    robots = {name: prepare(name) for name in ("rover", "omni")}
    steps: dict[str, Callable[[], dict[str, Any]]] = {
        "models": lambda: {
            name: {"model": one.model.document(), "calibration": one.calibration.document()}
            for name, one in robots.items()
        },
        "rover": lambda: rover(robots["rover"], given.runs),
        "prices": lambda: prices(robots["omni"], given.rounds),
        "faults of the rover": lambda: robustness(robots["rover"]),
        "faults of the omni": lambda: robustness(robots["omni"]),
        "real time, rover": lambda: summary(run_twin(robots["rover"], Setup(tick=0.3), compare=False)),
        "real time, omni": lambda: summary(run_twin(robots["omni"], Setup(tick=0.1), compare=False)),
        "rollers": lambda: summary(run_twin(robots["omni"], Setup(variant="rollers"), compare=False)),
    }
    for name, step in steps.items():
        if name not in kept:
            print(name, flush=True)
            kept[name] = step()
            write_whole(given.json, (json.dumps(kept) + "\n").encode())


if __name__ == "__main__":
    main()
