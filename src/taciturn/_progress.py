"""Progress of a computation, and its time limit."""

from __future__ import annotations

import importlib
import os
import sys
import time
from collections.abc import Callable
from typing import Any

from taciturn._arrays import number
from taciturn._text import percent

Progress = Callable[[float], None]
clock = time.monotonic
PATIENCE = 1.0  # seconds before a bar appears in a notebook


class OutOfTime(Exception):  # noqa: N818
    """Signal that the time limit has passed; it is raised from a progress callback."""


def limited(progress: Progress | None, seconds: float | None) -> Progress | None:
    """Return a progress callback that raises ``OutOfTime`` when it is called after a time limit.

    A computation that calls it often enough ends in time, and can return its best answer so far.

    Args:
        progress: callback that receives the fraction done, or None.
        seconds: time limit in seconds from now; None for no limit.

    Raises:
        ProblemError: ``seconds`` is not positive.
    """
    if seconds is None:
        return progress
    end = clock() + number("time_limit", seconds, 0.0)

    def tell(fraction: float) -> None:
        if clock() > end:
            raise OutOfTime
        if progress is not None:
            progress(fraction)

    return tell


class Stages:
    """The progress of a stage of a computation, mapped to an interval of the overall progress.

    Args:
        progress: callback that receives the fraction done of the whole computation, or None.
        low: overall progress at the start of the stage.
        high: overall progress at the end of the stage.
    """

    def __init__(self, progress: Progress | None, low: float = 0.0, high: float = 1.0) -> None:
        """Start with a progress of 0."""
        self.progress, self.low, self.high, self.at = progress, low, high, 0.0

    def __call__(self, fraction: float) -> None:
        """Report the fraction done of this stage; it never decreases."""
        self.at = max(self.at, min(fraction, 1.0))
        self.tick()

    def tick(self) -> None:
        """Report the same progress again, so that the time limit is checked."""
        if self.progress is not None:
            self.progress(self.low + (self.high - self.low) * self.at)

    def stage(self, low: float, high: float) -> Stages:
        """Return the progress of a part of this stage."""
        return Stages(self, low, high)


def in_notebook(progress: Progress | None) -> Progress | None:
    """Return a progress bar if no callback is given and the code runs in a notebook; else return the given callback.

    The bar appears below the cell after one second. It disappears when everything is done, and at the latest at the end
    of the cell: a search may end early, and an error ends every computation. ``TACITURN_PROGRESS=0`` disables it.
    """
    shell = sys.modules.get("IPython")
    if progress is not None or shell is None or os.environ.get("TACITURN_PROGRESS") == "0":
        return progress
    running = shell.get_ipython()
    if running is None or not hasattr(running, "kernel"):
        return None
    began, shown = clock(), list[Any]()
    display = importlib.import_module("IPython.display")

    def move(fraction: float) -> None:
        if not shown and (fraction >= 1 or clock() - began < PATIENCE):
            return
        text = "" if fraction >= 1 else f'<progress max="1" value="{fraction:.3f}"></progress> {percent(fraction, 0)}'
        if shown:
            shown[0].update(display.HTML(text))
        else:
            shown.append(display.display(display.HTML(text), display_id=True))
            running.events.register("post_run_cell", leave)

    def leave(*_: object) -> None:
        running.events.unregister("post_run_cell", leave)
        shown[0].update(display.HTML(""))

    return move
