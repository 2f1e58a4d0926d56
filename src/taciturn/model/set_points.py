"""Set-points of a plant: constant, with steps at random times, or with the changes of a timetable that repeats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from taciturn._arrays import Array, ArrayLike, array, instance, number, semidefinite
from taciturn._display import Displayed
from taciturn.errors import ProblemError

LONGEST = 100_000  # sampling steps of a timetable


@dataclass(frozen=True, eq=False, repr=False)
class RandomSteps(Displayed):
    """Steps of set-points at random times: each adds a normal random vector with mean zero to the set-points.

    Args:
        rate: mean number of steps per second, or per sampling step of a plant that is discrete in time, positive.
        covariance: covariance of a step, (z, z), positive semidefinite and not zero.

    Raises:
        ProblemError: the rate or the covariance is not positive.

    Example:
        >>> RandomSteps(0.01, [[4.0]]).noise
        array([[0.04]])
    """

    rate: float
    covariance: Array

    def __init__(self, rate: float, covariance: ArrayLike) -> None:
        """Validate and store the arguments."""
        object.__setattr__(self, "rate", number("reference.steps.rate", rate, 0.0))
        given = array("reference.steps.covariance", covariance, (None, None), "(set-points, set-points)")
        checked = semidefinite("reference.steps.covariance", given, len(given), "(set-points, set-points)")
        if not checked.any():
            raise ProblemError("reference.steps.covariance is zero; expected the covariance of a step")
        object.__setattr__(self, "covariance", checked)

    @property
    def size(self) -> int:
        """Number of set-points."""
        return len(self.covariance)

    @property
    def noise(self) -> Array:
        """The covariance of the changes, per second or sampling step."""
        return self.rate * self.covariance

    def sampled(self, period: float) -> RandomSteps:
        """Return the changes at the sampling instants: at most one per period, with the same variance.

        Raises:
            ProblemError: there is more than one step per sampling period.
        """
        rate = self.rate * period
        if rate > 1:
            raise ProblemError(
                f"reference.steps.rate is {self.rate:g}, more than one step in each sampling period; expected at most "
                f"{1 / period:g}"
            )
        return RandomSteps(rate, self.covariance)


@dataclass(frozen=True, eq=False, repr=False)
class Timetable(Displayed):
    """Set-points that change at known times, and then repeat. The controller learns of a change when it takes effect.

    Args:
        times: times of the changes in seconds, or sampling steps of a plant that is discrete in time, (rows,); the
            first is 0, and at the last the timetable begins again.
        values: the set-points from each time on, (rows, z); the last row equals the first.

    Raises:
        ProblemError: the times do not increase from 0, or the last row differs from the first.

    Example:
        >>> Timetable([0, 20, 50], [[1.0], [3.0], [1.0]]).sampled(1.0).table[19]
        array([2.])
    """

    times: Array
    values: Array

    def __init__(self, times: ArrayLike, values: ArrayLike) -> None:
        """Validate and store the arguments."""
        object.__setattr__(self, "times", array("reference.file: the times", times, (None,), "(rows,)"))
        shape = (len(self.times), None)
        object.__setattr__(self, "values", array("reference.file: the set-points", values, shape, "(rows, set-points)"))
        if len(self.times) < 2 or self.times[0] != 0 or not (np.diff(self.times) > 0).all():
            raise ProblemError(
                f"reference.file has the times {self.times[:6].tolist()}; expected at least two times that increase "
                "from 0"
            )
        if not np.array_equal(self.values[0], self.values[-1]):
            raise ProblemError(
                f"reference.file ends with the set-points {self.values[-1].tolist()}; expected those of its first row, "
                f"{self.values[0].tolist()}, with which the timetable begins again"
            )

    @property
    def size(self) -> int:
        """Number of set-points."""
        return self.values.shape[1]

    @property
    def noise(self) -> Array:
        """The mean square of the changes, per second or sampling step."""
        moved = np.diff(self.values, axis=0)
        return np.asarray(moved.T @ moved / self.times[-1], dtype=np.float64)

    def sampled(self, period: float) -> SampledChanges:
        """Return the changes at the sampling instants; a change between them takes effect at the next one.

        Raises:
            ProblemError: the timetable has too many sampling steps, or one that lasts less than a period.
        """
        steps = np.ceil(self.times / period * (1 - 1e-12)).astype(int)
        if abs(self.times[-1] / period - steps[-1]) > 1e-9 * steps[-1]:
            raise ProblemError(
                f"reference.file lasts {self.times[-1]:g}, which is no multiple of the sampling step {period:g}, so "
                f"that it would shift with each repetition; expected for example {steps[-1] * period:g}"
            )
        if steps[-1] > LONGEST:
            raise ProblemError(
                f"reference.file lasts {steps[-1]} sampling steps; expected at most {LONGEST}: shorten the timetable"
            )
        if not (np.diff(steps) > 0).all():
            raise ProblemError(
                f"reference.file has changes within one sampling period ({period:g}); expected at most one in each"
            )
        table = np.zeros((int(steps[-1]), self.size))
        table[steps[1:] - 1] = np.diff(self.values, axis=0)
        return SampledChanges(table)


@dataclass(frozen=True, eq=False, repr=False)
class SampledChanges(Displayed):
    """The change of the set-points from each step of a timetable to the next; the timetable repeats.

    Args:
        table: the changes, (steps, z).
    """

    table: Array

    @property
    def size(self) -> int:
        """Number of set-points."""
        return self.table.shape[1]

    @property
    def noise(self) -> Array:
        """The mean square of the changes per step."""
        return np.asarray(self.table.T @ self.table / len(self.table), dtype=np.float64)


Changes: TypeAlias = RandomSteps | Timetable


@dataclass(frozen=True, eq=False, repr=False)
class SetPoint(Displayed):
    """The values that some combinations of the states are to have.

    Args:
        outputs: C_z of the combinations z = C_z x, (z, n).
        value: their set-points, (z,); default 0. With steps at random times, those at the start.
        changes: how they change while the loop runs; None for constant set-points.
        counted: whether they count from an operating point; then they are states of the exosystem also if all
            are zero, as they are not at another operating point.
        D: D_z of the combinations z = C_z x + D_z u, (z, m), or None for zero: that of measured outputs of a plant with
            a direct feedthrough.

    Raises:
        ProblemError: the number of set-points is not that of the combinations, or a timetable and a value are given.

    Example:
        >>> SetPoint([[1.0, 0.0]], [2.5]).value
        array([2.5])
    """

    outputs: Array
    value: Array
    changes: Changes | None
    counted: bool
    D: Array | None

    def __init__(
        self,
        outputs: ArrayLike,
        value: ArrayLike | None = None,
        changes: Changes | None = None,
        counted: bool = False,
        D: Array | None = None,
    ) -> None:
        """Validate and store the arguments."""
        object.__setattr__(self, "outputs", array("reference.outputs", outputs, (None, None), "(set-points, states)"))
        size = len(self.outputs)
        if changes is not None:
            instance("changes", changes, RandomSteps, Timetable)
            if changes.size != size:
                key = "file" if isinstance(changes, Timetable) else "steps.covariance"
                raise ProblemError(
                    f"reference.{key} states changes of {changes.size} set-points; expected {size}, one for each of "
                    "reference.outputs"
                )
        if isinstance(changes, Timetable):
            if value is not None:
                raise ProblemError("reference.value and reference.file are given; expected one of them")
            value = changes.values[0]
        given = np.zeros(size) if value is None else value
        object.__setattr__(self, "value", array("reference.value", given, (size,), "(set-points,)"))
        object.__setattr__(self, "changes", changes)
        object.__setattr__(self, "counted", counted)
        object.__setattr__(self, "D", D if D is not None and D.any() else None)

    @property
    def moved(self) -> bool:
        """Whether the set-points are states of the exosystem: they are not zero, or they change."""
        return self.counted or bool(self.value.any()) or self.changes is not None

    def relative_to(self, state: Array, given: Array) -> SetPoint:
        """Return the set-points relative to the combinations of a state, (n,), and an input, (m,)."""
        z = self.outputs @ state + (0.0 if self.D is None else self.D @ given)
        if isinstance(self.changes, Timetable):
            moved = Timetable(self.changes.times, self.changes.values - z)
            return SetPoint(self.outputs, None, moved, True, self.D)
        return SetPoint(self.outputs, self.value - z, self.changes, True, self.D)
