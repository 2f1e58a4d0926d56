"""How far a computation is, and the end of the time that it has."""

from __future__ import annotations

import time
from collections.abc import Callable

from taciturn._arrays import number

Progress = Callable[[float], None]
clock = time.monotonic


class OutOfTime(Exception):  # noqa: N818
    """The time limit has passed: raised from within a call of progress."""


def limited(progress: Progress | None, seconds: float | None) -> Progress | None:
    """Return a progress that raises ``OutOfTime`` when it is called after so many seconds.

    So a computation that calls its progress often enough ends in time, and may answer with what it has.

    Args:
        progress: called with the fraction done, or None.
        seconds: from now on; None for no limit.

    Raises:
        ProblemError: seconds that are not positive.
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
    """The progress of a computation in stages: each goes from one fraction of the whole to another.

    Args:
        progress: called with the fraction done of the whole, or None.
    """

    def __init__(self, progress: Progress | None, low: float = 0.0, high: float = 1.0) -> None:
        """Start at the low end."""
        self.progress, self.low, self.high, self.at = progress, low, high, 0.0

    def __call__(self, fraction: float) -> None:
        """Tell the fraction of this stage; what has been told stays."""
        self.at = max(self.at, min(fraction, 1.0))
        self.tick()

    def tick(self) -> None:
        """Tell the same fraction again: a sign of life, that ends what is out of time."""
        if self.progress is not None:
            self.progress(self.low + (self.high - self.low) * self.at)

    def stage(self, low: float, high: float) -> Stages:
        """Return the progress of a part of this computation."""
        return Stages(self, low, high)
