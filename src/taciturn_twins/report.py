"""The report of a twin's run as a JSON document and as lines of text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np

from taciturn.extend import Array, percent
from taciturn.model.estimate import Estimate
from taciturn.study.testbed.ticks import measured
from taciturn_twins.identification import Identification
from taciturn_twins.mission import THESIS
from taciturn_twins.outcome import Trial
from taciturn_twins.robot import Robot
from taciturn_twins.run import TwinRun, mean


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
        **run.origin(),
    }


def lines_of(found: TwinRun) -> list[tuple[str, str]]:
    """Return the printed lines of a run as pairs of name and value."""
    robot, trial, model = found.prepared.robot, found.trial, found.prepared.model
    runs, ticks = trial.costs.shape
    lines = [
        ("robot", f"{robot.name}, {runs} x {ticks} steps of {robot.tick:g} s in {found.seconds:.1f} s"),
        ("camera", f"{found.prepared.calibration.error:.2f} pixels reprojection error of the landmarks"),
    ]
    lines += [*model_lines(model, robot), ("policy", found.policy.kind), ("cost", f"{found.cost} per mission")]
    if found.always is not None:
        always = float(found.always.totals.mean())
        above = percent(found.cost.value / always - 1, 1, signed=True)
        lines.append(("every-sample cost", f"{always:.6g}   (this policy: {above})"))
    if found.cost_bound is not None:
        lines.append(("guaranteed", f"at most {found.cost_bound:.6g}, for the identified model"))
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


def model_lines(model: Identification, robot: Robot) -> list[tuple[str, str]]:
    """Return the identified rates of change per second and per unit of each input, next to those of the data sheet."""
    lines: list[tuple[str, str]] = []
    for state, values, errors, nominal in zip(
        robot.states, model.B / robot.tick, model.B_standard_error / robot.tick, robot.rate, strict=True
    ):
        rates = ", ".join(str(Estimate(*pair, "simulation")) for pair in zip(values, errors, strict=True))
        listed = ", ".join(f"{rate:g}" for rate in nominal)
        lines.append((f"d{state.split(' ')[0]}/dt per input", f"{rates}   (data sheet: {listed})"))
    return lines


def _listed(counted: Mapping[str, Any]) -> str:
    shown = (f"{value:.2f}" if isinstance(value, float) else str(value) for value in counted.values())
    return ", ".join(f"{text} {name.replace('_', ' ')}" for text, name in zip(shown, counted, strict=True))


def vision(off: Array, robot: Robot) -> dict[str, Any]:
    """Return the bias and standard deviation of the camera measurements, in millimetres and degrees."""
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
