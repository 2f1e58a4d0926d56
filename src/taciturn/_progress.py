"""Progress and time limit of a computation. A callback for the progress may also stop the computation."""

from __future__ import annotations

import importlib
import math
import os
import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import Any

from taciturn._arrays import number
from taciturn._text import percent
from taciturn.errors import ProblemError

Progress = Callable[[float], None]
clock = time.monotonic
PATIENCE = 1.0  # seconds before a bar appears in a notebook
_limit: ContextVar[_Limit | None] = ContextVar("time limit", default=None)
_watch: ContextVar[Callable[[], None] | None] = ContextVar("watch", default=None)


class OutOfTime(Exception):  # noqa: N818
    """Raised when the time limit has passed, so that the caller returns the best answer found so far."""


class NoTimeLeft(Exception):  # noqa: N818
    """Raised when the time limit has passed before the first answer, because an unfinished search has no answer."""


@dataclass(frozen=True)
class _Limit:
    """A time limit."""

    end: float  # time at which it passes
    seconds: float  # the limit that a user has stated
    early: bool  # whether the best answer so far is to be returned when it passes


def check_time() -> None:
    """Raise ``OutOfTime`` or ``NoTimeLeft`` if the time limit of the current computation has passed.

    Designs, searches and simulations call this function often, so that they stop in time and return the answer that
    they have. A watch (``watched``) may raise another exception.
    """
    watch, limit = _watch.get(), _limit.get()
    if watch is not None:
        watch()
    if limit is not None and clock() > limit.end:
        raise OutOfTime if limit.early else NoTimeLeft


def seconds_left() -> float:
    """Return the seconds that remain until the time limit of the current computation: at least 0, or infinity."""
    limit = _limit.get()
    return math.inf if limit is None else max(0.0, limit.end - clock())


def late_text() -> str:
    """Write a note that a part of an answer is missing because the time limit has passed."""
    limit = _limit.get()
    return "the time limit passed" if limit is None else f"the time limit of {limit.seconds:g} s passed"


@contextmanager
def watched(watch: Callable[[], None]) -> Generator[None]:
    """While the block runs, call ``watch`` at each check of the time. It may raise an exception to stop the block."""
    token = _watch.set(watch)
    try:
        yield
    finally:
        _watch.reset(token)


@contextmanager
def part_of_time(share: float) -> Generator[None]:
    """Limit the block to a share of the remaining time, if the caller accepts the best answer found so far."""
    limit, left = _limit.get(), seconds_left()
    token = _limit.set(replace(limit, end=clock() + share * left) if limit is not None and limit.early else limit)
    try:
        yield
    finally:
        _limit.reset(token)


@contextmanager
def answered_within(seconds: float | None, early: bool = False) -> Generator[None]:
    """Limit the time of the computations in the block. An earlier limit of an outer block still applies.

    Args:
        seconds: time limit in seconds from now; None for no further limit.
        early: whether the computations in the block return their best answer so far.

    Raises:
        ProblemError: ``seconds`` is not positive, or no answer was found in time.
        OutOfTime, NoTimeLeft: no answer was found within an outer limit.
    """
    if seconds is None:
        yield
        return
    limit, outer = _Limit(clock() + number("time_limit", seconds, 0.0), seconds, early), _limit.get()
    token = _limit.set(limit if outer is None or limit.end < outer.end else outer)
    try:
        yield
    except (OutOfTime, NoTimeLeft):
        if outer is not None and clock() > outer.end:
            raise
        raise ProblemError(
            f"time_limit is {seconds:g}, but no result was available within {seconds:g} s; expected a longer time limit"
        ) from None
    finally:
        _limit.reset(token)


class Stages:
    """Progress of one stage of a computation, which covers an interval of the progress of the whole computation."""

    def __init__(self, progress: Progress | None, low: float = 0.0, high: float = 1.0) -> None:
        """Start with a progress of 0."""
        self.progress, self.low, self.high, self.at = progress, low, high, 0.0

    def __call__(self, fraction: float) -> None:
        """Report the fraction done of this stage; it never decreases."""
        self.at = max(self.at, min(fraction, 1.0))
        self.tick()

    def tick(self) -> None:
        """Report the present progress once more, and check the time limit."""
        check_time()
        if self.progress is not None:
            self.progress(self.low + (self.high - self.low) * self.at)

    def stage(self, low: float, high: float) -> Stages:
        """Create a sub-stage, whose progress from 0 to 1 covers the interval from ``low`` to ``high`` of this stage."""
        return Stages(self, low, high)


def in_notebook(progress: Progress | None) -> Progress | None:
    """Return ``progress`` if it is given. If it is not, create a progress bar in a notebook, and return its callback.

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
