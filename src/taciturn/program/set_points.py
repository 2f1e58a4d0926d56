"""Process noise of a plant whose last states are set-points that change, as operations of a program."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array
from taciturn._modes import factor
from taciturn.model.location import Location
from taciturn.model.set_points import RandomSteps, SampledChanges
from taciturn.program.draws import NORMAL
from taciturn.program.lower import Operands, TimeStep

TIMETABLE = "timetable"  # step counter of set-points that change at known times


def draw_noise(tick: TimeStep, spread: Array) -> Operands:
    """Return the product of G and new normal draws."""
    drawn = tick.supplied(NORMAL, spread.shape[1], len(tick.builder.inputs))
    return [tick.value(value) for value in tick.builder.transform(spread.tolist(), drawn)]


def add_changes(tick: TimeStep, W: Array, changes: RandomSteps | SampledChanges) -> Operands:
    """Return the process noise: Gaussian noise of all other states, and the changes of the last states, the set-points.

    Args:
        tick: the time step under construction.
        W: covariance of the noise, (n, n).
        changes: how the set-points change.
    """
    b, others = tick.builder, W[: -changes.size, : -changes.size]
    noise = draw_noise(tick, factor(others)) if others.any() else [b.constant(0.0)] * len(others)
    if isinstance(changes, SampledChanges):
        rows = len(changes.table)
        tick.locations[TIMETABLE] = Location(TIMETABLE, (np.arange(rows) + 1) % rows)
        here = tick.place(TIMETABLE)
        return [*noise, *(b.value(b.lookup(column, here)) for column in changes.table.T.tolist())]
    steps, none = draw_noise(tick, factor(changes.covariance)), b.constant(0.0)
    happens = b.emit("greater", b.constant(changes.rate), tick.uniform())
    return [*noise, *(b.choose(happens, step, none) for step in steps)]
