"""What is said of a twin's run, as a JSON document and as lines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np

from taciturn._arrays import Array
from taciturn.study.ticks import measured
from taciturn.twin.mission import THESIS
from taciturn.twin.outcome import Trial
from taciturn.twin.robot import Robot
from taciturn.twin.run import TwinRun, mean


def document_of(run: TwinRun) -> dict[str, Any]:
    """Return the JSON document of ``taciturn twin --json``."""
    trial, robot = run.trial, run.prepared.robot
    return {
        "robot": robot.name,
        "policy": run.policy.kind,
        "runs": len(trial.totals),
        "rates": {link: measured(rate) for link, rate in run.rates.items()},
        "cost": measured(run.cost),
        "cost_all_time": None if run.always is None else float(run.always.totals.mean()),
        "cost_all_time_model": run.policy.cost_all_time,
        "cost_bound": run.cost_bound,
        "all_time": None if run.always is None else _summary(run.always),
        "vision": vision(trial.vision, robot),
        "datagrams": dict(trial.datagrams),
        "seed": run.setup.seed,
        "seed_of_preparation": run.prepared.seed,
        "seconds": round(run.seconds, 3),
        "ticks": trial.costs.shape[1],
        "calibration": run.prepared.calibration.document(),
        "model": run.prepared.model.document(),
        "faults": [str(fault) for fault in run.setup.faults],
        "processes": {name: dict(report) for name, report in trial.reports.items()},
        "notes": list(trial.notes),
    }


def lines_of(found: TwinRun) -> list[tuple[str, str]]:
    """Return what is printed of a run: names, and what stands behind them."""
    robot, trial, model = found.prepared.robot, found.trial, found.prepared.model
    runs, ticks = trial.costs.shape
    lines = [
        ("robot", f"{robot.name}, {runs} x {ticks} steps of {robot.tick:g} s in {found.seconds:.1f} s"),
        ("camera", f"{found.prepared.calibration.error:.2f} pixels from where its landmarks should be"),
    ]
    for i, state in enumerate(robot.states):
        rates = ", ".join(
            f"{model.B[i, j] / robot.tick:.5g} ± {model.B_standard_error[i, j] / robot.tick:.1g}"
            for j in range(len(robot.inputs))
        )
        lines.append((f"d{state.split(' ')[0]}/dt per input", f"{rates}   (data sheet: {robot.rate[i]})"))
    lines += [("policy", found.policy.kind), ("cost", f"{found.cost} per mission")]
    if found.always is not None:
        always = float(found.always.totals.mean())
        lines.append(("all-time cost", f"{always:.6g}   (this policy: {100 * (found.cost.value / always - 1):+.1f} %)"))
    if found.cost_bound is not None:
        lines.append(("guaranteed", f"at most {found.cost_bound:.6g}, in the identified model"))
    lines += [(f"rate, {link}", f"{rate} per step") for link, rate in found.rates.items()]
    for link, counted in trial.datagrams.items():
        if isinstance(counted, Mapping):
            lines.append((f"link, {link}", _listed(cast("Mapping[str, Any]", counted))))
        else:
            lines.append((link.replace("_", " "), str(counted)))
    for state, off in vision(trial.vision, robot).items():
        text = _listed(cast("Mapping[str, Any]", off)) if isinstance(off, Mapping) else str(off)
        lines.append((f"camera, {state}", text))
    lines += [("thesis", text) for text in THESIS[robot.name]]
    return [*lines, *(("note", note) for note in trial.notes)]


def _listed(counted: Mapping[str, Any]) -> str:
    shown = (f"{value:.2f}" if isinstance(value, float) else str(value) for value in counted.values())
    return ", ".join(f"{text} {name.replace('_', ' ')}" for text, name in zip(shown, counted, strict=True))


def vision(off: Array, robot: Robot) -> dict[str, Any]:
    """Return bias and standard deviation of what the camera says, in millimetres and degrees."""
    scale = np.array([1e3, 1e3, np.degrees(1.0)])[: off.shape[1]]
    units = ("mm", "mm", "deg")
    if not len(off):
        return {"pictures": 0}
    return {
        "pictures": len(off),
        **{
            state.split(" ")[0]: {f"bias_{unit}": float(bias), f"standard_deviation_{unit}": float(spread)}
            for state, unit, bias, spread in zip(
                robot.states, units, off.mean(axis=0) * scale, off.std(axis=0) * scale, strict=False
            )
        },
    }


def _summary(trial: Trial) -> dict[str, Any]:
    return {
        "cost": measured(mean(trial.totals)),
        "rates": {link: measured(mean(sent.mean(axis=1))) for link, sent in trial.sent.items()},
        "datagrams": dict(trial.datagrams),
    }
