"""Input limits: which input an actuator applies when it receives a command.

An input first moves towards the command, by at most its rate in a step, and is then brought between its limits, so that
it never leaves them. Limits are stated per input as a positive number, which is symmetric, or as a pair [low, high], in
which a side may be infinite; a plant stores them as (m, 2).

The operations are those that exported code carries out, on numbers or on arrays with one entry per path.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from taciturn._arrays import Array, ArrayLike, array, frozen, quoted
from taciturn._display import Displayed
from taciturn._text import number_of
from taciturn.errors import ProblemError


@dataclass(frozen=True, eq=False, repr=False)
class Saturation(Displayed):
    """Lower and upper limit of each input, and the limit of its change per step.

    An actuator moves its input towards the command, by at most ``rate``, and stays between ``low`` and ``high``.
    """

    low: Array  # lower limit of each input, (m,); −∞ for none
    high: Array  # upper limit of each input, (m,); ∞ for none
    rate: Array | None = None  # largest change of each input in a step, (m,), ∞ for none; or None

    def __call__(self, wanted: Any, before: Any = None) -> Any:
        """Return the input that is applied, given the command and the input of the step before."""
        return np.stack([self._one(i, wanted[i], before) for i in range(len(self.low))])

    def _one(self, i: int, value: Any, before: Any) -> Any:
        if self.rate is not None and np.isfinite(self.rate[i]):
            value = _within(value, before[i] - float(self.rate[i]), before[i] + float(self.rate[i]))
        low, high = (float(limit) if np.isfinite(limit) else None for limit in (self.low[i], self.high[i]))
        return _within(value, low, high)

    @property
    def moves(self) -> Saturation | None:
        """These limits if an input has a limit of its change per step; otherwise None."""
        return self if self.rate is not None and np.isfinite(self.rate).any() else None

    @property
    def bounded(self) -> bool:
        """True if every input has a lower and an upper limit."""
        return bool(np.isfinite(self.low).all() and np.isfinite(self.high).all())

    def of(self, inputs: Sequence[int]) -> Saturation:
        """Return the limits of some inputs, given by their indices."""
        rows = [*inputs]
        return replace(
            self, low=self.low[rows], high=self.high[rows], rate=None if self.rate is None else self.rate[rows]
        )

    def beside(self, count: int) -> Saturation:
        """Add entries without limits."""
        low = np.pad(self.low, (0, count), constant_values=-np.inf)
        high = np.pad(self.high, (0, count), constant_values=np.inf)
        rate = None if self.rate is None else np.pad(self.rate, (0, count), constant_values=np.inf)
        return replace(self, low=low, high=high, rate=rate)

    def begun(self, before: Array) -> Array:
        """Clip the input before the first step to the limits."""
        return np.minimum(np.maximum(before, self.low), self.high)


def saturation(limit: Array | None, rate: Array | None) -> Saturation | None:
    """Return the limits that a plant's ``input_limit`` and ``input_rate`` state; None if it has neither."""
    if limit is None and rate is None:
        return None
    sides = limit if limit is not None else np.full((len(cast("Array", rate)), 2), (-np.inf, np.inf))
    return Saturation(sides[:, 0], sides[:, 1], rate)


def limits_from(value: ArrayLike, inputs: int) -> Array:
    """Convert limits, as the user has stated them, to a lower and an upper limit of each input, (m, 2)."""
    entries = _entries(value)
    if not any(np.ndim(entry) for entry in entries):
        if len(entries) == 2 > inputs:
            raise ProblemError(
                "input_limit has shape (2,), but the plant has one input; expected the shape (1,), or a pair of "
                f"limits for this input: [{quoted(entries)}]"
            )
        high = positive("input_limit", value, inputs)
        return frozen(np.stack([-high, high], axis=1))
    if len(entries) != inputs:
        raise ProblemError(
            f"input_limit has {number_of(len(entries), 'entry')}; expected {number_of(inputs, 'entry')}, one for "
            "each input"
        )
    return frozen(np.array([_pair(f"input_limit[{i}]", entry) for i, entry in enumerate(entries)]))


def positive(name: str, value: ArrayLike, inputs: int) -> Array:
    """Check that each input has one positive number, and return them, (m,). ∞ means that there is no limit."""
    entries = _entries(value)
    limited = [not (isinstance(entry, float) and entry == np.inf) for entry in entries]
    finite = [entry if kept else 1.0 for entry, kept in zip(entries, limited, strict=True)]
    found = array(name, finite if np.ndim(cast("Any", value)) else value, (inputs,), "(inputs,)")
    if (found <= 0).any():
        raise ProblemError(f"{name} is {found.min():g}; expected positive numbers (omit this key if there is no limit)")
    return frozen(np.where(limited, found, np.inf))


def limit_entries(limit: Array) -> list[float | list[float]]:
    """Convert limits, (m, 2), to one entry per input: a number if they are symmetric, and otherwise a pair."""
    return [float(high) if low == -high else [float(low), float(high)] for low, high in limit]


def _entries(value: ArrayLike) -> list[Any]:
    try:
        return list(cast("Sequence[Any]", value))
    except TypeError:  # a number alone
        return [value]


def _pair(name: str, entry: Any) -> tuple[float, float]:
    """Return the limits of an input from a positive number, or from a pair."""
    try:
        low, high = (float(side) for side in (entry if np.ndim(entry) else (-entry, entry)))
    except (TypeError, ValueError):
        low, high = np.nan, np.nan
    if not (low < high and low < np.inf and high > -np.inf):
        raise ProblemError(f"{name} is {quoted(entry)}; expected a positive number, or [low, high] with low < high")
    return low, high


def _within(value: Any, low: Any, high: Any) -> Any:
    """Return a number brought between two limits, each of which may be None."""
    if high is not None:
        return _within(np.where(value > high, high, value), low, None)
    return value if low is None else cast("Any", np.where(low > value, low, value))
