"""Loads that the option ``--load VALUE@SECONDS`` adds to the simulated plant of a problem.

From this time on, VALUE is added to the first ``[[disturbance]]`` of the file. Without one, it is a new disturbance
that enters as the inputs do, with a value for each input. The design does not learn of it, unless the file says that
the disturbance is known. So nodes that read the same file without the option run the same policy.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from taciturn._arrays import quoted
from taciturn._text import number_of
from taciturn.errors import ProblemError
from taciturn.model.load import stairs
from taciturn.model.plant import Plant
from taciturn.problem import Problem
from taciturn.problem.read import timed_rows

SOON = 1e-9  # seconds or steps after the start, where the controller knows the value


def with_added_loads(problem: Problem, texts: Sequence[str]) -> Problem:
    """Add loads to the simulated plant of a problem, each of the form VALUE@SECONDS.

    Raises:
        ProblemError: a text has another form, or another number of values than the disturbance or the plant.
    """
    if not texts:
        return problem
    if problem.source is None:
        raise ProblemError("--load is given for a problem that was not read from a file; expected a problem file")
    plant = problem.actual or problem.plant
    stated = cast("dict[str, Any]", problem.source["plant"])
    entries = [dict(one) for one in cast("list[dict[str, Any]]", problem.source.get("disturbance") or ())]
    first = entries[0] if entries else None
    if first is None:
        B = np.asarray(cast("dict[str, Any]", stated.get("actual") or stated)["B"]).reshape(plant.states, -1)
        added = [{"enters": column.tolist(), "wander": 0.0} for column in B.T]
        entries += added
    elif first.get("kind", "constant") != "constant":
        added = [{key: first[key] for key in ("enters", "measured") if key in first} | {"wander": 0.0}]
        entries += added
    else:
        added = [first]
    step = plant.dt or 1.0 if isinstance(plant, Plant) else 1.0  # times of a discrete plant are in steps
    for text in texts:
        values, time = _read(text)
        if len(values) != len(added):
            of = "the first [[disturbance]]" if first is not None else "the plant without a [[disturbance]]"
            raise ProblemError(
                f"--load is {text!r}, with {number_of(len(values), 'value')}; expected {number_of(len(added), 'value')}"
                f" for {of}{', one for each input' * (first is None)}"
            )
        for one, value in zip(added, values, strict=True):
            _add(one, value, time / step)
    return problem.changed({"disturbance": entries})


def _read(text: str) -> tuple[list[float], float]:
    """Return the values and the time of a text such as ``0.3@20`` or ``0.3,0@20``."""
    before, _, after = text.partition("@")
    try:
        values, time = [float(part) for part in before.split(",")], float(after)
    except ValueError:
        values, time = [], np.nan
    if not (np.isfinite([*values, time]).all() and time >= 0):
        raise ProblemError(
            f"--load is {quoted(text)}; expected VALUE@SECONDS, such as 0.3@20, with a value for each input, such as "
            "0.3,0@20, and a time of at least 0"
        )
    return values, time


def _add(entry: dict[str, Any], value: float, time: float) -> None:
    """Add a value from a time on to the table of a disturbance."""
    path = entry.pop("file", None)
    rows = entry.pop("steps", None) if path is None else timed_rows("disturbance.file", path, "value")
    times, values = stairs(entry.pop("initial", None), rows)
    time = max(time, SOON) if entry.get("known") else time
    all_times = np.union1d(times, time)
    before = values[np.searchsorted(times, all_times, side="right") - 1]
    entry["steps"] = np.column_stack([all_times, before + value * (all_times >= time)]).tolist()
