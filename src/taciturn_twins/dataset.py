"""Conversion of the results of trials to a labelled data set."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from taciturn_twins.outcome import Trial
from taciturn_twins.robot import Robot

if TYPE_CHECKING:
    import xarray


def to_dataset(robot: Robot, trials: Mapping[str, Trial], attributes: Mapping[str, Any]) -> xarray.Dataset:
    """Convert the results of trials under several policies to a labelled data set.

    The dimensions are ``policy`` (``event-triggered``, ``all-time``), ``run``, ``tick`` (steps), ``instant`` (one more
    than ``tick``), ``state``, ``input``, ``link``, ``form`` (trigger values of not sending and of sending), and
    ``coordinate`` (of the bodies).
    """
    import xarray

    first = next(iter(trials.values()))
    links = list(first.sent)
    variables: dict[str, tuple[tuple[str, ...], Callable[[Trial], object]]] = {
        "pose": (("run", "instant", "state"), lambda trial: trial.poses),
        "estimate": (("run", "tick", "state"), lambda trial: trial.estimates),
        "seen": (("run", "tick", "state"), lambda trial: trial.seen),
        "given": (("run", "tick", "input"), lambda trial: trial.inputs),
        "trigger": (("run", "tick", "form"), lambda trial: trial.values),
        "cost": (("run", "tick"), lambda trial: trial.costs),
        "total": (("run",), lambda trial: trial.totals),
        "sent": (("link", "run", "tick"), lambda trial: np.array([trial.sent[link] for link in links])),
        "arrived": (("link", "run", "tick"), lambda trial: np.array([trial.arrived[link] for link in links])),
        "light": (("run", "instant", "coordinate"), lambda trial: trial.lights),
    }
    return xarray.Dataset(
        {
            name: (("policy", *dims), np.array([read(trial) for trial in trials.values()]))
            for name, (dims, read) in variables.items()
        },
        coords={
            "policy": list(trials),
            "link": links,
            "state": list(robot.states),
            "input": list(robot.inputs),
            "form": ["silent", "send"],
            "time": ("instant", robot.tick * np.arange(first.poses.shape[1])),
        },
        attrs=attributes,
    )
