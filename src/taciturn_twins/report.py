"""Report on a twin's run, as a JSON document and as lines of text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from taciturn.extend import Array
from taciturn.model.estimate import Estimate
from taciturn_twins.identification import Identification
from taciturn_twins.outcome import Trial, mean
from taciturn_twins.robot import Robot
from taciturn_udp.averages import measured


def model_lines(model: Identification, robot: Robot) -> list[tuple[str, str]]:
    """Return lines that compare the identified rate of change per second for each input with the data sheet."""
    lines: list[tuple[str, str]] = []
    for state, values, errors, nominal in zip(
        robot.states, model.B / robot.tick, model.B_standard_error / robot.tick, robot.rate, strict=True
    ):
        rates = ", ".join(str(Estimate(*pair, "simulation")) for pair in zip(values, errors, strict=True))
        listed = ", ".join(f"{rate:g}" for rate in nominal)
        lines.append((f"d{state.split(' ')[0]}/dt per input", f"{rates}   (data sheet: {listed})"))
    return lines


def listed(counted: Mapping[str, Any]) -> str:
    """Return a text that lists numbers with their names."""
    shown = (f"{value:.2f}" if isinstance(value, float) else str(value) for value in counted.values())
    return ", ".join(f"{text} {name.replace('_', ' ')}" for text, name in zip(shown, counted, strict=True))


def vision(off: Array, robot: Robot) -> dict[str, Any]:
    """Return bias and standard deviation of the measurements by camera, in millimetres and degrees."""
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


def summary_of(trial: Trial) -> dict[str, Any]:
    """Return a trial's cost, rates and packet counts."""
    return {
        "cost": measured(mean(trial.totals)),
        "rates": {link: measured(mean(sent.mean(axis=1))) for link, sent in trial.sent.items()},
        "datagrams": dict(trial.datagrams),
    }
