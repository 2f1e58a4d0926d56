"""Limits of states, or of combinations z = C_z x of states, and the probability that they are violated.

Limits concern neither the design nor the loop. A study computes for each of them how often a step violates it, and how
likely one violation is within a window: an hour, some steps, or a run. ``Violations`` holds the results: by limit, and
for all limits together. They are simulated, or computed by importance splitting if violations are rare.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from taciturn._arrays import Array, ArrayLike, array, expect_unmasked, frozen, set_fields
from taciturn._display import Displayed
from taciturn._figure import Panel, Series, Size, draw
from taciturn._style import StyleName
from taciturn._text import number_of, power_text
from taciturn.errors import ProblemError
from taciturn.model.estimate import Estimate
from taciturn.model.key import NO_KEY, Rows, stated_as
from taciturn.model.names import combined, unit_of
from taciturn.model.result import SPLICED, Field, Result, plain_fields

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MINUS = re.compile(r"(?<!\w)-(?=[\d.])")  # a hyphen that is the sign of a number


@dataclass(frozen=True, eq=False, repr=False)
class Limits(Displayed):
    """Limits low ≤ z ≤ high of the combinations z = C_z x of the states. Each combination is one row of C_z.

    Limits change neither the policy nor the loop: studies compute how often the loop violates them.

    Args:
        outputs: C_z, (z, n).
        low: lower bounds, (z,); −∞ for none; default: none.
        high: upper bounds, (z,); ∞ for none; default: none.
        quantities: names of the combinations, with their units in parentheses; default: those of a problem's plant, or
            x1, x2, …

    Raises:
        ProblemError: a row is 0, a combination has no bound, or a lower bound is not below its upper bound.

    Example:
        >>> Limits([[1.0, 0.0]], high=[2.0]).names
        ('x1 ≤ 2',)
    """

    outputs: Array = field(metadata=stated_as(Rows | None))  # omitted in a file: the measured outputs
    low: Array = field(metadata=stated_as(list[float] | None))
    high: Array = field(metadata=stated_as(list[float] | None))
    quantities: tuple[str, ...] = field(default=(), metadata=NO_KEY)

    def __init__(
        self,
        outputs: ArrayLike,
        low: ArrayLike | None = None,
        high: ArrayLike | None = None,
        quantities: Sequence[str] = (),
    ) -> None:
        """Validate and store the arguments."""
        rows = array("limits.outputs", outputs, (None, None), "(combinations, states)")
        for i in np.flatnonzero(~rows.any(axis=1)):
            raise ProblemError(
                f"limits.outputs[{i}] contains only zeros; expected a row with at least one nonzero weight of a state"
            )
        size = len(rows)
        found = {name: _bounds(name, value, size, side) for name, value, side in (("low", low, -1), ("high", high, 1))}
        for i in range(size):
            below, above = float(found["low"][i]), float(found["high"][i])
            if not np.isfinite([below, above]).any():
                raise ProblemError(
                    f"limits.outputs[{i}] has neither a lower nor an upper limit; expected limits.low, limits.high or "
                    "both"
                )
            if below >= above:
                raise ProblemError(
                    f"limits.low[{i}] is {below:g} and limits.high[{i}] is {above:g}; expected low < high"
                )
        if quantities and len(quantities) != size:
            raise ProblemError(
                f"limits.quantities has {number_of(len(quantities), 'name')}; expected {number_of(size, 'name')}, one "
                "for each combination"
            )
        set_fields(self, {"outputs": rows, **found, "quantities": tuple(quantities)})

    @property
    def names(self) -> tuple[str, ...]:
        """Each limit as text, such as ``-1 ≤ x1 ≤ 1``."""
        plain = [f"x{i + 1}" for i in range(self.outputs.shape[1])]
        named = self.quantities or [combined(row, plain) for row in self.outputs]
        return tuple(map(_named, named, self.low.tolist(), self.high.tolist()))

    def summary(self) -> Mapping[str, object]:
        """Return the values to display: all limits as one text."""
        return {"limits": self.short()}

    def short(self) -> str:
        """Write all limits as one text, separated by commas."""
        return ", ".join(self.names)

    def expect_states(self, states: int) -> None:
        """Check that the matrix C_z has one column for each state of the plant.

        Raises:
            ProblemError: there are more or fewer columns.
        """
        if self.outputs.shape[1] != states:
            raise ProblemError(
                f"limits.outputs has {number_of(self.outputs.shape[1], 'column')}; expected "
                f"{number_of(states, 'column')}, one for each state of the plant"
            )


@dataclass(frozen=True, repr=False)
class Violation(Result):
    """Probability that a limit of the states is violated, per step and within a window of time.

    Args:
        per_step: share of the steps with a violation.
        within: probability of at least one violation within the window.
        levels: number of levels of importance splitting; 0 for plain simulation.
    """

    FIELDS: ClassVar[tuple[Field[Violation], ...]] = (*plain_fields("per_step", "within", "method"),)

    per_step: Estimate
    within: Estimate
    levels: int

    @property
    def method(self) -> str:
        """The method of computation as text: simulation, or importance splitting with its number of levels."""
        return f"importance splitting, {number_of(self.levels, 'level')}" if self.levels else "simulation"


@dataclass(frozen=True, repr=False)
class Violations(Result):
    """Probabilities that limits of the states are violated: each limit, and at least one of them.

    Args:
        names: the limits as text.
        each: the probability of each limit.
        total: the probability that any limit is violated.
        window: the window of ``Violation.within``: ``"hour"``, ``"1000 steps"`` or ``"run"``.
    """

    FIELDS: ClassVar[tuple[Field[Violations], ...]] = (
        Field("total", key=SPLICED),
        Field("window"),
        Field("limits", lambda found: [{"limit": name, **one.document()} for name, one in found.limits]),
        Field("by_limit", key="", say="violation", text=lambda found: found.sentences()),
    )

    names: tuple[str, ...]
    each: tuple[Violation, ...]
    total: Violation
    window: str

    def by_limit(self) -> dict[str, Violation]:
        """Return the probability of a violation by limit. If there are several limits, ``any limit`` is added."""
        found = dict(self.limits)
        return found if len(found) == 1 else {**found, "any limit": self.total}

    @property
    def limits(self) -> list[tuple[str, Violation]]:
        """Each limit, as text, with the probability that it is violated."""
        return list(zip(self.names, self.each, strict=True))

    def sentences(self) -> list[str]:
        """Write a sentence on each limit and, if there are several, a sentence on the violation of any limit."""
        return [
            f"{name}: {one.per_step} of the steps, {one.within} within {self._one} ({one.method})"
            for name, one in self.by_limit().items()
        ]

    def panels(self) -> list[Panel]:
        """Return a panel of a figure with the probabilities on a logarithmic axis, which has a 0 at its left end."""
        found = [*self.by_limit().items()][::-1]  # the first is the uppermost
        shares: dict[str, list[Estimate]] = {
            "share of the steps": [one.per_step for _, one in found],
            f"probability within {self._one}": [one.within for _, one in found],
        }
        series = list[Series]()
        for index, (label, estimates) in enumerate(shares.items()):
            seen = [(row, one) for row, one in enumerate(estimates) if one.value > 0]
            errors = [min(one.standard_error, 0.9 * one.value) for _, one in seen]  # an end of a bar has a logarithm
            if seen:
                values, rows = [one.value for _, one in seen], [row for row, _ in seen]
                series.append(Series(values, rows, label, "bars", errors, index))
        notes = [f"{power_text(one.per_step.value)} of the steps" for _, one in found]
        names = [_MINUS.sub("−", name) for name, _ in found]
        title = f"limits violated in {power_text(self.total.per_step.value)} of the steps"
        zeros = [row for row, (_, one) in enumerate(found) if max(one.per_step.value, one.within.value) == 0]
        return [Panel(series, "probability of a violation", "", title, names, notes, xlog=bool(series), zeros=zeros)]

    def plot(self, ax: Any = None, figsize: Size | None = None, style: StyleName = "light") -> Figure:
        """Draw the probability that each limit is violated, with its standard error."""
        return draw(self.panels(), ax, figsize, style)

    @property
    def _one(self) -> str:
        return {"hour": "an hour", "run": "a run"}.get(self.window, self.window)

    def records(self) -> Mapping[str, Estimate]:
        """Return the probabilities of a violation, per step and within the window, as columns of a table."""
        many = len(self.each) > 1
        each = {f"violation_{i + 1}": one.per_step for i, one in enumerate(self.each) if many}
        return {"violation": self.total.per_step, "violation_within": self.total.within, **each}


def _bounds(name: str, value: ArrayLike | None, size: int, side: int) -> Array:
    """Return bounds as an array; only the infinity on their own side is allowed."""
    if value is None:
        return frozen(np.full(size, side * np.inf))
    expect_unmasked(f"limits.{name}", value)
    try:
        given = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        given = np.full(0, np.nan)
    none = given == side * np.inf
    if (given == -side * np.inf).any():
        raise ProblemError(
            f"limits.{name} contains {-side * np.inf:g}; expected numbers, or {side * np.inf:g} for no limit"
        )
    array(f"limits.{name}", np.where(none, 0.0, given) if given.size else value, (size,), "(combinations,)")
    return frozen(given)


def _named(quantity: str, low: float, high: float) -> str:
    name, unit = unit_of(quantity)
    unit = f" {unit}" if unit else ""
    left, right = (
        (f"{low:g}{unit} ≤ " if np.isfinite(low) else ""),
        (f" ≤ {high:g}{unit}" if np.isfinite(high) else ""),
    )
    return f"{left}{name}{right}"
