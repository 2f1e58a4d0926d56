"""Figures of runs of twins."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from taciturn.extend import Array, Panel, Series, Size, draw
from taciturn_twins.outcome import Trial
from taciturn_twins.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RED, BLACK = 3, 7


def figure_of(
    robot: Robot, trials: Mapping[str, Trial], run: int = 0, ax: Any = None, figsize: Size | None = None
) -> Figure:
    """Return a figure of one run under each policy, with the path, the inputs and the packets.

    Args:
        robot: the robot.
        trials: trials by name; the first trial has the event-triggered policy.
        run: index of the run.
        ax: axes to draw in, one for each panel; default: a new figure.
        figsize: width and height of a new figure, in inches.
    """
    first = next(iter(trials.values()))
    panels = [Panel(path(trials, run), "x (m)", "y (m)", "path")] if robot.turns else []
    panels += [Panel(positions(trials, run), "step", robot.states[0])]
    panels += [Panel(inputs(trials, run), "step", robot.inputs[0]), Panel(sends(first, run), "step", "sent")]
    figure = draw(panels, ax, figsize, height=3.0 * len(panels))
    if robot.turns:
        (figure.axes[0] if ax is None else ax[0]).set_aspect("equal")
    return figure


def positions(trials: Mapping[str, Trial], run: int = 0) -> list[Series]:
    """Return curves of the first state and its estimate over time."""
    found: list[Series] = []
    for color, (name, trial) in enumerate(trials.items()):
        found.append(_over_ticks(trial.poses[run, :, 0], name, color))
        found.append(Series(*_points(trial.estimates[run, :, 0]), f"{name}, estimated", "dotted", color=color))
    return found


def inputs(trials: Mapping[str, Trial], run: int = 0) -> list[Series]:
    """Return curves of the first input over time."""
    return [
        Series(*_points(trial.inputs[run, :, 0]), name, "steps", color=color)
        for color, (name, trial) in enumerate(trials.items())
    ]


def sends(trial: Trial, run: int = 0) -> list[Series]:
    """Return the steps with a packet, for each link."""
    found: list[Series] = []
    for color, (link, sent) in enumerate(trial.sent.items()):
        ticks = np.flatnonzero(sent[run]).astype(float).tolist()
        label = f"{link}: {len(ticks)} of {sent.shape[1]}"
        found.append(Series(ticks, [1.0 - 0.25 * color] * len(ticks), label, "stems", color=color))
    return found


def path(trials: Mapping[str, Trial], run: int = 0) -> list[Series]:
    """Return the path in the plane, the reference, and the positions at which the controller sent a packet."""
    first = next(iter(trials.values()))
    found: list[Series] = []
    reference = first.problem.reference
    if reference is not None:
        x, y = reference.states.T[:2].tolist()
        found.append(Series(x, y, "reference", "dashed", color=BLACK))
    for color, (name, trial) in enumerate(trials.items()):
        x, y = trial.poses[run].T[:2].tolist()
        found.append(Series(x, y, name, color=color))
    sent = first.sent["actuator"][run] > 0
    x, y = (np.where(sent, axis, np.nan).tolist() for axis in first.poses[run, :-1].T[:2])
    label = f"sends: {int(sent.sum())} of {len(sent)}"
    return [*found, Series(x, y, label, error=[0.0] * len(sent), color=RED)]  # NaN separates the dots


def running_costs(trials: Mapping[str, Trial]) -> list[Series]:
    """Return curves of the mean cost of each step, with standard errors."""
    found: list[Series] = []
    for color, (name, trial) in enumerate(trials.items()):
        runs, ticks = trial.costs.shape
        error = (trial.costs.std(axis=0, ddof=1) / np.sqrt(runs)).tolist() if runs > 1 else None
        mean = trial.costs.mean(axis=0).tolist()
        found.append(Series([float(k) for k in range(ticks)], mean, name, error=error, color=color))
    return found


def _over_ticks(values: Array, label: str, color: int) -> Series:
    return Series(*_points(values), label, color=color)


def _points(values: Array) -> tuple[list[float], list[float]]:
    return [float(k) for k in range(len(values))], values.tolist()
