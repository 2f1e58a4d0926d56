"""Figures of runs of twins."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from taciturn.extend import Array, Lane, Panel, Series, Size, StyleName, Thing, draw
from taciturn_twins.outcome import Trial
from taciturn_twins.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

THINGS: tuple[Thing, ...] = ("policy", "every sample")


def figure_of(
    robot: Robot,
    trials: Mapping[str, Trial],
    run: int = 0,
    ax: Any = None,
    figsize: Size | None = None,
    style: StyleName = "light",
) -> Figure:
    """Plot the path, the inputs and the packets of one run under each policy.

    Args:
        robot: the robot.
        trials: trials by name; the first trial has the event-triggered policy.
        run: index of the run.
        ax: axes to draw in, one for each panel; default: a new figure.
        figsize: width and height of a new figure, in inches.
        style: name of the style.
    """
    first = next(iter(trials.values()))
    panels = [Panel(path(trials, run), "x (m)", "y (m)", "path")] if robot.turns else []
    panels += [Panel(positions(trials, run), "step", robot.states[0])]
    panels += [Panel(inputs(trials, run), "step", robot.inputs[0]), Panel(lanes=sends(first, run), xlabel="step")]
    figure = draw(panels, ax, figsize, style)
    if robot.turns:
        (figure.axes[0] if ax is None else ax[0]).set_aspect("equal")
    return figure


def positions(trials: Mapping[str, Trial], run: int = 0) -> list[Series]:
    """Return curves of the first state and its estimate against time, for each policy."""
    found: list[Series] = []
    for thing, (name, trial) in zip(THINGS, trials.items(), strict=False):
        found.append(_over_ticks(trial.poses[run, :, 0], name, thing))
        found.append(Series(*_points(trial.estimates[run, :, 0]), f"{name}, estimated", "dotted", thing=thing))
    return found


def inputs(trials: Mapping[str, Trial], run: int = 0) -> list[Series]:
    """Return curves of the first input against time, for each policy."""
    return [
        Series(*_points(trial.inputs[run, :, 0]), name, "steps", thing=thing)
        for thing, (name, trial) in zip(THINGS, trials.items(), strict=False)
    ]


def sends(trial: Trial, run: int = 0) -> list[Lane]:
    """Return, for each link, the steps at which packets were sent."""
    found: list[Lane] = []
    for link, sent in trial.sent.items():
        ticks = np.flatnonzero(sent[run]).astype(float).tolist()
        found.append(Lane(link, ticks, note=f"{len(ticks)} of {sent.shape[1]}"))
    return found


def path(trials: Mapping[str, Trial], run: int = 0) -> list[Series]:
    """Return curves of the path and of the reference in the plane, and the positions at which packets were sent."""
    first = next(iter(trials.values()))
    found: list[Series] = []
    reference = first.problem.reference
    if reference is not None:
        x, y = reference.states.T[:2].tolist()
        found.append(Series(x, y, "reference", thing="set-point"))
    for thing, (name, trial) in zip(THINGS, trials.items(), strict=False):
        x, y = trial.poses[run].T[:2].tolist()
        found.append(Series(x, y, name, thing=thing))
    sent = first.sent["actuator"][run] > 0
    x, y = first.poses[run, :-1][sent].T[:2].tolist()
    label = f"sends: {int(sent.sum())} of {len(sent)}"
    return [*found, Series(x, y, label, "points", thing="delivered")]


def running_costs(trials: Mapping[str, Trial]) -> list[Series]:
    """Return curves of the cost of each step, averaged over the runs, with standard errors."""
    found: list[Series] = []
    for thing, (name, trial) in zip(THINGS, trials.items(), strict=False):
        runs, ticks = trial.costs.shape
        error = (trial.costs.std(axis=0, ddof=1) / np.sqrt(runs)).tolist() if runs > 1 else None
        mean = trial.costs.mean(axis=0).tolist()
        found.append(Series([float(k) for k in range(ticks)], mean, name, error=error, thing=thing))
    return found


def _over_ticks(values: Array, label: str, thing: Thing) -> Series:
    return Series(*_points(values), label, thing=thing)


def _points(values: Array) -> tuple[list[float], list[float]]:
    return [float(k) for k in range(len(values))], values.tolist()
