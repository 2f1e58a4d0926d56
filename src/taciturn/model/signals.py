"""External signals that act on a plant: disturbances and set-points, which together form an exosystem.

A signal has states d that no input moves, d⁺ = S d + w_d (or ḋ = S d + noise) from a known start. They act on the plant
and on the outputs z that are to be zero:

    x⁺ = A x + B u + E d + w,   y = C x + G d + v,   z = C_z x + D_z u + F d.

D_z is zero, except for measured outputs of a plant with a direct feedthrough. A disturbance has E or G, and nobody
knows it: the filter estimates it. A set-point r of the output z is a state with F = −1. It is known: a constant one has
S = 1 and no noise, so that the filter predicts it without an error; a form that moves by itself, such as a sinusoid,
has another S. Of others, the controller is given the changes at each step, as measured outputs without noise: steps at
random times, or those of a timetable that repeats.

A controller brings the set-points that it is given between limits, and moves them by at most a limited change per step
(``set_point_limits``). ``model.set_points`` adds this to a policy.

``ExternalDisturbance`` and ``SetPoint`` make signals; an ``Exosystem`` is all signals of a plant, one above the other.
For a new form of set-point, write a subclass of ``Changes``: with ``states`` if it moves by itself, or with ``sampled``
if it consists of random steps or of changes that repeat, which ``program.signals`` draws. Designs, simulations and
nodes see the matrices alone.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import cos, pi, sin
from typing import ClassVar, Literal, TypeAlias, get_args

import numpy as np

from taciturn._arrays import (
    Array,
    ArrayLike,
    array,
    block_diagonal,
    frozen,
    instance,
    number,
    quoted,
    semidefinite,
    set_fields,
    square,
)
from taciturn._display import Displayed
from taciturn._rational import Limit, free_modes
from taciturn._text import number_of
from taciturn.errors import ProblemError
from taciturn.model.key import NO_KEY, Rows, stated_as
from taciturn.model.load import Load, stairs
from taciturn.model.operating_point import OperatingPoint
from taciturn.model.saturation import Saturation

LONGEST = 100_000  # sampling steps of a timetable
_ROUNDING = 1e-9  # relative difference of a change from its limit


@dataclass(frozen=True, eq=False, repr=False)
class Signal(Displayed):
    """An external signal: states d⁺ = S d + w, which no input affects, and their effects on the plant."""

    S: Array  # dynamics of the states, (q, q)
    W: Array  # covariance per step, or intensity per second, of the noise that moves them, (q, q)
    start: Array  # first value, (q,)
    E: Array | None = None  # effect on the state of the plant, (n, q); None for no effect
    G: Array | None = None  # effect on the measured outputs, (p, q)
    F: Array | None = None  # effect on the outputs z that are to be zero, (z, q)

    def entering(self, name: str, rows: int) -> Array:
        """Return the effect matrix E, G or F of a signal, with the given number of rows; zeros if it has none."""
        found: Array | None = getattr(self, name)
        return np.zeros((rows, len(self.S))) if found is None else found


@dataclass(frozen=True, eq=False, repr=False)
class Changes(Displayed):
    """Base class of set-points that change while the loop runs."""

    key: ClassVar[str] = "changes"  # of the problem file, after "reference."
    # range of the set-points, and their largest change per second or step, which the controller enforces; or None
    limits: Saturation | None = field(default=None, kw_only=True, metadata=NO_KEY)

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of set-points."""

    @property
    def noise(self) -> Array | None:
        """Mean square, per second or step, of the changes that the controller reads; None if it reads none."""
        return None

    @property
    def known(self) -> Array | None:
        """The set-points in the units of the plant, if they are known in advance; otherwise None."""
        return None

    def states(self, continuous: bool) -> Signal | None:
        """Return the signal that is added to the constant set-points; None if there is none."""
        return None

    def relative_to(self, z: Array) -> Changes:
        """Express the set-points as deviations from the values z."""
        return self

    def limits_from(self, z: Array) -> Saturation | None:
        """Return the limits of the set-points as deviations from the values z."""
        one = self.limits
        return None if one is None else replace(one, low=one.low - z, high=one.high - z)

    def sampled(self, period: float) -> RandomSteps | SampledChanges:
        """Return the changes as the controller reads them at the sampling instants."""
        raise NotImplementedError  # a form whose states move by themselves is sampled with the plant

    def beside(self, count: int) -> Changes:
        """Add disturbances that the controller is given too, and that do not change by themselves."""
        raise NotImplementedError  # of a form that is never given


@dataclass(frozen=True, eq=False, repr=False)
class RandomSteps(Changes):
    """Set-points that change in steps at random times. Each change is a normal random vector with zero mean.

    With the rate 0, set-points change only when somebody changes them: the controller reads them in every step.

    Args:
        rate: mean number of steps per second, or per sampling step of a plant that is discrete in time.
        covariance: covariance of a step, (z, z), positive semidefinite, and not zero unless the rate is 0.
        limits: range of the set-points, only with the rate 0, and their largest change per second or step; or None.

    Raises:
        ProblemError: the rate is negative, a step changes nothing, or the steps leave the range.

    Example:
        >>> RandomSteps(0.01, [[4.0]]).noise
        array([[0.04]])
    """

    key = "steps.covariance"
    rate: float
    covariance: Array = field(metadata=stated_as(Rows))

    def __init__(self, rate: float, covariance: ArrayLike, limits: Saturation | None = None) -> None:
        """Validate and store the arguments."""
        rate = number("reference.steps.rate", rate, 0.0, closed=True)
        given = array("reference.steps.covariance", covariance, (None, None), "(set-points, set-points)")
        checked = semidefinite("reference.steps.covariance", given, len(given), "(set-points, set-points)")
        if rate and not checked.any():
            raise ProblemError("reference.steps.covariance is zero; expected the covariance of a step")
        if rate and limits is not None and np.isfinite([limits.low, limits.high]).any():
            raise ProblemError(
                "reference.range is given, but steps at random times (reference.steps) leave every range; expected the "
                "rate 0, so that only an operator changes the set-points, or a timetable (reference.file)"
            )
        set_fields(self, {"rate": rate, "covariance": checked, "limits": limits})

    @property
    def size(self) -> int:
        """Number of set-points."""
        return len(self.covariance)

    @property
    def noise(self) -> Array:
        """Covariance of the changes, per second or per sampling step."""
        return self.rate * self.covariance

    def beside(self, count: int) -> RandomSteps:
        """Add disturbances that the controller is given too, and that do not change by themselves."""
        limits = None if self.limits is None else self.limits.beside(count)
        return RandomSteps(self.rate, np.pad(self.covariance, (0, count)), limits)

    @property
    def exceed(self) -> bool:
        """True if the steps are larger than the limits allow."""
        return self.limits is not None and self.rate > 0

    def relative_to(self, z: Array) -> RandomSteps:
        """Express the limits as deviations from the values z."""
        return RandomSteps(self.rate, self.covariance, self.limits_from(z))

    def sampled(self, period: float) -> RandomSteps:
        """Convert the changes to discrete time: at most one change per period, with the same variance.

        Raises:
            ProblemError: there is more than one step per sampling period.
        """
        rate = self.rate * period
        if rate > 1:
            raise ProblemError(
                f"reference.steps.rate is {self.rate:g}, more than one step in each sampling period; expected at most "
                f"{1 / period:g}"
            )
        return RandomSteps(rate, self.covariance, per_step(self.limits, period))


@dataclass(frozen=True, eq=False, repr=False)
class Timetable(Changes):
    """Set-points that change at known times, and then repeat. The controller learns of a change when it happens.

    Args:
        times: times of the changes in seconds, or sampling steps of a plant that is discrete in time, (rows,); the
            first is 0, and at the last the timetable begins again.
        values: the set-points from each time on, (rows, z); the last row equals the first.
        limits: range of the set-points, and their largest change per second or step; or None.

    Raises:
        ProblemError: the times do not increase from 0, or the last row differs from the first.

    Example:
        >>> Timetable([0, 20, 50], [[1.0], [3.0], [1.0]]).sampled(1.0).table[19]
        array([2.])
    """

    key = "file"
    times: Array
    values: Array

    def __init__(self, times: ArrayLike, values: ArrayLike, limits: Saturation | None = None) -> None:
        """Validate and store the arguments."""
        set_fields(self, {"times": array("reference.file: the times", times, (None,), "(rows,)")})
        shape, meaning = (len(self.times), None), "(rows, set-points)"
        set_fields(self, {"values": array("reference.file: the set-points", values, shape, meaning), "limits": limits})
        if len(self.times) < 2 or self.times[0] != 0 or not (np.diff(self.times) > 0).all():
            raise ProblemError(
                f"reference.file has the times {self.times[:6].tolist()}; expected at least two times that increase "
                "from 0"
            )
        if not np.array_equal(self.values[0], self.values[-1]):
            raise ProblemError(
                f"reference.file ends with the set-points {self.values[-1].tolist()}; expected the set-points of its "
                f"first row, {self.values[0].tolist()}, with which the timetable begins again"
            )

    @property
    def size(self) -> int:
        """Number of set-points."""
        return self.values.shape[1]

    @property
    def noise(self) -> Array:
        """Mean square of the changes, per second or per sampling step."""
        moved = np.diff(self.values, axis=0)
        return np.asarray(moved.T @ moved / self.times[-1], dtype=np.float64)

    @property
    def known(self) -> Array:
        """The set-points in all rows of the timetable."""
        return self.values

    def relative_to(self, z: Array) -> Timetable:
        """Express the set-points of the timetable as deviations from the values z."""
        return Timetable(self.times, self.values - z, self.limits_from(z))

    def beside(self, count: int) -> Timetable:
        """Add disturbances that the controller is given too, and that do not change by themselves."""
        limits = None if self.limits is None else self.limits.beside(count)
        return Timetable(self.times, np.pad(self.values, ((0, 0), (0, count))), limits)

    def sampled(self, period: float) -> SampledChanges:
        """Convert the changes to discrete time: a change between two sampling instants takes effect at the later one.

        Raises:
            ProblemError: the timetable has too many sampling steps, or one that lasts less than a period.
        """
        steps = np.ceil(self.times / period * (1 - 1e-12)).astype(int)
        if abs(self.times[-1] / period - steps[-1]) > 1e-9 * steps[-1]:
            raise ProblemError(
                f"reference.file lasts {self.times[-1]:g}, which is not a multiple of the sampling step {period:g}, "
                f"so the timetable would shift with each repetition; expected, for example, {steps[-1] * period:g}"
            )
        if steps[-1] > LONGEST:
            raise ProblemError(
                f"reference.file lasts {steps[-1]} sampling steps; expected at most {LONGEST} steps: shorten the "
                "timetable"
            )
        if not (np.diff(steps) > 0).all():
            raise ProblemError(
                f"reference.file has several changes within one sampling period ({period:g}); expected at most one "
                "change in each period"
            )
        table = np.zeros((int(steps[-1]), self.size))
        table[steps[1:] - 1] = np.diff(self.values, axis=0)
        return SampledChanges(table, per_step(self.limits, period))


@dataclass(frozen=True, eq=False, repr=False)
class SampledChanges(Displayed):
    """Changes of a timetable's set-points from one step to the next. The timetable repeats.

    Args:
        table: the changes, (steps, z).
        limits: range of the set-points, and their largest change per step; or None.
    """

    table: Array
    limits: Saturation | None = None

    @property
    def size(self) -> int:
        """Number of set-points."""
        return self.table.shape[1]

    @property
    def noise(self) -> Array:
        """Mean square of the changes per step."""
        return np.asarray(self.table.T @ self.table / len(self.table), dtype=np.float64)

    @property
    def exceed(self) -> bool:
        """True if changes are larger than the limits allow; a timetable is within its range."""
        rate = None if self.limits is None else self.limits.rate
        return rate is not None and bool((np.abs(self.table) > rate * (1 + _ROUNDING)).any())


def set_point_limits(size: int, within: ArrayLike | None = None, ramp: ArrayLike | None = None) -> Saturation | None:
    """Return the limits of set-points, in the units of the plant: the range of each, (z, 2), and its largest change,
    (z,), per second, or per step of a plant that is discrete in time; None without limits.
    """
    if within is None and ramp is None:
        return None
    sides = np.tile([-np.inf, np.inf], (size, 1))
    if within is not None:
        try:
            sides = np.array(within, dtype=np.float64)
        except (TypeError, ValueError):
            sides = np.zeros(0)
        if sides.shape != (size, 2) or not (sides[:, 0] < sides[:, 1]).all():
            raise ProblemError(
                f"reference.range is {quoted(within)}; expected {number_of(size, 'pair')} [low, high] with low < high, "
                "one for each set-point"
            )
    rate = None if ramp is None else array("reference.ramp", ramp, (size,), "(set-points,)")
    if rate is not None and not (rate > 0).all():
        raise ProblemError(
            f"reference.ramp is {rate.min():g}; expected positive numbers (omit this key if there is no limit)"
        )
    return Saturation(frozen(sides[:, 0]), frozen(sides[:, 1]), rate)


def per_step(limits: Saturation | None, period: float) -> Saturation | None:
    """Return limits whose largest change is per sampling step instead of per second."""
    return limits if limits is None or limits.rate is None else replace(limits, rate=limits.rate * period)


def expect_within(limits: Saturation | None, points: Array, z: Array | float = 0.0) -> None:
    """Raise an error if set-points that are known in advance, (rows, z) relative to z, are beyond their range."""
    if limits is None:
        return
    outside = (points < limits.low) | (points > limits.high)
    if outside.any():
        row, place = (int(i) for i in np.argwhere(outside)[0])
        moved = np.broadcast_to(z, limits.low.shape)[place]
        raise ProblemError(
            f"set-point {place + 1} is {points[row, place] + moved:g}, beyond reference.range "
            f"[{limits.low[place] + moved:g}, {limits.high[place] + moved:g}]; expected set-points in this range, or "
            "another range"
        )


@dataclass(frozen=True, eq=False, repr=False)
class SetPoint(Displayed):
    """Set-points of some linear combinations of the states."""

    # C_z of the combinations z = C_z x, (z, n)
    outputs: Array = field(metadata=stated_as(Rows | None))
    # their set-points at the start, (z,), in the units of the plant; None: those at its point, or 0
    value: Array | None = field(metadata=stated_as(list[float] | None))
    # how they change while the loop runs; None for constant set-points
    changes: Changes | None = field(metadata=NO_KEY)
    # D_z of the combinations z = C_z x + D_z u
    D: Array | None = field(metadata=NO_KEY)

    def __init__(
        self,
        outputs: ArrayLike,
        value: ArrayLike | None = None,
        changes: Changes | None = None,
        D: Array | None = None,
    ) -> None:
        """Validate and store the arguments."""
        followed = array("reference.outputs", outputs, (None, None), "(set-points, states)")
        size = len(followed)
        if changes is not None:
            instance("changes", changes, *Changes.__subclasses__())
            if changes.size != size:
                raise ProblemError(
                    f"reference.{changes.key} states changes of {number_of(changes.size, 'set-point')}; "
                    f"expected {number_of(size, 'set-point')}, one for each row of reference.outputs"
                )
        if changes is not None and changes.known is not None:
            if value is not None:
                raise ProblemError(
                    f"reference.value and reference.{changes.key} are both given; expected only one of them"
                )
            value = changes.known[0]
        value = None if value is None else array("reference.value", value, (size,), "(set-points,)")
        D = D if D is not None and D.any() else None
        set_fields(self, {"outputs": followed, "value": value, "changes": changes, "D": D})

    def signals(self, continuous: bool, changes: Changes | None, at: Array | None) -> list[Signal]:
        """Return the set-points as external signals, those that change last. With ``at``, they are deviations
        from it.
        """
        z = len(self.outputs)
        value = np.zeros(z) if self.value is None else self.value if at is None else self.value - at
        own, noise = (None, None) if changes is None else (changes.states(continuous), changes.noise)
        r = 0 if at is None and noise is None and not value.any() else z  # no states if they are zero for ever
        S = np.zeros((r, r)) if continuous else np.eye(r)
        W = np.zeros((r, r)) if noise is None else noise
        return [*([] if own is None else [own]), Signal(S, W, value[:r], F=-np.eye(z)[:, :r])]


Shape: TypeAlias = Literal["constant", "ramp", "sinusoid", "matrix"]


@dataclass(frozen=True, eq=False, repr=False)
class ExternalDisturbance(Displayed):
    """A disturbance of known shape and unknown size. The filter estimates it, and the input compensates it.

    The value of a constant disturbance may also have a first value and changes at stated times: a load, which the
    simulated plant has: a loop that ``close`` makes with this plant, not a policy alone. If the wander is zero, the
    design knows nothing of a load, unless it is ``known``.

    Args:
        enters: how the disturbance moves the state: entries added to x per step, or per second, (n,).
        wander: variance per step, or intensity per second, of the noise that moves the disturbance, positive: of its
            value, for a ramp of its slope, for a sinusoid of both of its components, for a matrix of all of its states.
            It may be zero for a load, and is zero for one that is known.
        shape: ``"constant"``, ``"ramp"``, ``"sinusoid"``, or ``"matrix"`` for dynamics of one's own.
        frequency: radians per step of a sinusoid, or radians per second for a continuous plant.
        measured: how the disturbance adds to the measured outputs, (p,); default 0.
        matrix: S of the shape ``"matrix"``: d⁺ = S d per step, or ḋ = S d for a continuous plant, (q, q). The first
            state is the value of the disturbance. No mode may grow.
        initial: value of a load at the start; default 0, at which the filter starts in any case.
        steps: changes of a load: rows [time, value] with increasing times in seconds, or in steps of a plant that is
            discrete in time. From each time on the load has the value, and the last one remains.
        known: whether the controller reads the load in each step without an error, as it reads set-points.

    Raises:
        ProblemError: the wander is not positive without a load, a frequency or a matrix is missing or not used, or the
            changes of a load have no increasing times or another shape than a constant.

    Example:
        >>> ExternalDisturbance([0.0, 0.3], wander=1e-3).dynamics(continuous=False)
        array([[1.]])
    """

    enters: Array = field(metadata=stated_as(list[float]))
    wander: float
    shape: Shape = field(default="constant", metadata=stated_as(str, "kind"))
    frequency: float | None = None
    measured: Array | None = field(default=None, metadata=stated_as(list[float] | None))
    matrix: Array | None = field(default=None, metadata=stated_as(Rows | None))
    initial: float | None = None
    steps: Array | None = field(default=None, metadata=stated_as(Rows | None))
    known: bool = False

    def __init__(
        self,
        enters: ArrayLike,
        wander: float | None = None,
        shape: Shape = "constant",
        frequency: float | None = None,
        measured: ArrayLike | None = None,
        matrix: ArrayLike | None = None,
        initial: float | None = None,
        steps: ArrayLike | None = None,
        known: bool = False,
    ) -> None:
        """Validate and store the arguments."""
        enters = array("disturbance.enters", enters, (None,), "(states,)")
        loaded = initial is not None or steps is not None or known
        if wander is None and not loaded:
            raise ProblemError(
                "disturbance.wander is missing; expected the variance of what moves the disturbance, or the initial "
                "value or the steps of a load"
            )
        wander = number("disturbance.wander", wander or 0.0, 0.0, closed=loaded)
        if shape not in get_args(Shape):
            raise ProblemError(
                f"disturbance.kind is {quoted(shape)}; expected one of the kinds {', '.join(get_args(Shape))}"
            )
        if (frequency is None) == (shape == "sinusoid"):
            got = "missing" if frequency is None else f"{frequency:g}"
            expected = "the radians per step or second of a sinusoid" if frequency is None else f"none for a {shape}"
            raise ProblemError(f"disturbance.frequency is {got}; expected {expected}")
        if (matrix is None) == (shape == "matrix"):
            got = "missing" if matrix is None else "given"
            expected = "S of d⁺ = S d, or of ḋ = S d" if matrix is None else f"none for a {shape}"
            raise ProblemError(f"disturbance.matrix is {got}; expected {expected}")
        matrix = None if matrix is None else square("disturbance.matrix", matrix)
        frequency = None if frequency is None else number("disturbance.frequency", frequency, 0.0)
        seen = None if measured is None else array("disturbance.measured", measured, (None,), "(outputs,)")
        if not enters.any() and (seen is None or not seen.any()):
            raise ProblemError(
                "disturbance.enters and disturbance.measured are zero; expected an effect on a state or an output"
            )
        if loaded and shape != "constant":
            key = "initial" if initial is not None else "steps" if steps is not None else "known"
            raise ProblemError(f"disturbance.{key} is given for a {shape}; expected it for a constant disturbance only")
        if known and wander:
            raise ProblemError(
                f"disturbance.known is true, but disturbance.wander is {wander:g}; expected the wander 0: a known load "
                "only has the changes that are stated"
            )
        initial = None if initial is None else number("disturbance.initial", initial)
        changes = None if steps is None else array("disturbance.steps", steps, (None, 2), "(changes, 2)")
        set_fields(self, {"enters": enters, "wander": wander, "shape": shape})
        set_fields(self, {"initial": initial, "steps": changes, "known": bool(known)})
        _ = self.stairs
        set_fields(self, {"frequency": frequency, "measured": seen, "matrix": matrix})

    @property
    def stairs(self) -> tuple[Array, Array] | None:
        """Times of the changes of a load, from 0 on, and the values from then on; None for no load."""
        return None if self.initial is None and self.steps is None else stairs(self.initial, self.steps)

    @property
    def hidden(self) -> bool:
        """True for a load of which the design knows nothing."""
        return self.wander == 0.0 and not self.known

    def dynamics(self, continuous: bool) -> Array:
        """Return the matrix S of the disturbance's dynamics. The first state is the value of the disturbance.

        Raises:
            ProblemError: a mode of the matrix grows.
        """
        if self.matrix is not None:
            limit = Limit(continuous)
            growing = free_modes(self.matrix, limit).growing
            if growing.size:
                raise ProblemError(
                    f"disturbance.matrix has the mode {limit.named(complex(growing[0]))}, which grows; expected modes "
                    "that decay or persist"
                )
            return self.matrix
        if self.shape == "constant":
            return np.array([[0.0 if continuous else 1.0]])
        if self.shape == "ramp":
            return np.array([[0.0, 1.0], [0.0, 0.0]]) + (0.0 if continuous else np.eye(2))
        w = self.frequency or 0.0
        if not continuous and w >= pi:
            raise ProblemError(f"disturbance.frequency is {w:g}; expected a frequency below π radians per step")
        return np.array([[0.0, w], [-w, 0.0]]) if continuous else np.array([[cos(w), sin(w)], [-sin(w), cos(w)]])

    @property
    def noise(self) -> Array:
        """Covariance of the noise that drives the disturbance's states; in continuous time, its intensity."""
        moved = {"constant": [1.0], "ramp": [0.0, 1.0], "sinusoid": [1.0, 1.0]}
        own = [] if self.matrix is None else [1.0] * len(self.matrix)
        return self.wander * np.diag(moved.get(self.shape, own))

    def signal(self, continuous: bool, outputs: int) -> Signal:
        """Return the disturbance as an external signal. Only its first state acts on the plant."""
        S, seen = self.dynamics(continuous), np.zeros(outputs) if self.measured is None else self.measured
        E, G = (np.pad(effect[:, None], ((0, 0), (0, len(S) - 1))) for effect in (self.enters, seen))
        start = np.zeros(len(S))
        if self.known and self.stairs is not None:
            start[:] = self.stairs[1][0]
        return Signal(S, self.noise, start, E, G)


@dataclass(frozen=True, eq=False, repr=False)
class Exosystem(Displayed):
    """The joint dynamics of all disturbances and set-points of a plant.

    Args:
        S: dynamics of the states d, (q, q).
        E: effect on the state of the plant, (n, q).
        G: effect on the measured outputs, (p, q).
        W: covariance per step, or intensity per second, of the noise that moves d, (q, q).
        start: initial value of d, (q,).
        outputs: C_z, (z, n).
        F: effect on z = C_z x + D_z u + F d, (z, q).
        changes: how the last states of d change, the set-points that the controller is given; None for constant ones.
        D: D_z, (z, m), or None for zero.
    """

    S: Array
    E: Array
    G: Array
    W: Array
    start: Array
    outputs: Array
    F: Array
    changes: Changes | None = None
    D: Array | None = None

    def __post_init__(self) -> None:
        """Check the sizes and the covariance."""
        q, (z, n) = len(self.S), self.outputs.shape
        shapes: Mapping[str, tuple[int | None, ...]] = {
            "S": (q, q), "E": (n, q), "G": (None, q), "start": (q,), "outputs": (z, n), "F": (z, q)
        }  # fmt: skip
        found = {name: array(f"exosystem.{name}", getattr(self, name), shape) for name, shape in shapes.items()}
        set_fields(self, {**found, "W": semidefinite("exosystem.W", self.W, q, "(q, q)")})

    @staticmethod
    def of(
        disturbances: Sequence[ExternalDisturbance],
        target: SetPoint,
        outputs: int,
        continuous: bool,
        point: OperatingPoint | None = None,
    ) -> Exosystem:
        """Combine disturbances and set-points into one exosystem.

        Args:
            disturbances: the disturbances.
            target: the combinations of the states that are to be at their set-points.
            outputs: number of measured outputs p.
            continuous: whether the plant is continuous in time.
            point: the operating point of the plant, or None.

        Raises:
            ProblemError: a disturbance has another number of states or outputs than the plant.
        """
        (z, n), signals, known = target.outputs.shape, list[Signal](), list[Signal]()
        for place, one in enumerate(disturbances):
            try:
                made = one.signal(continuous, outputs)
                _ = None if one.hidden else (known if one.known else signals).append(made)
            except ProblemError as error:
                raise ProblemError(str(error).replace("disturbance.", f"disturbance[{place}].")) from None
            measured = np.zeros(outputs) if one.measured is None else one.measured
            for name, got, expected in (("enters", one.enters, n), ("measured", measured, outputs)):
                if len(got) != expected:
                    raise ProblemError(
                        f"disturbance[{place}].{name} has {number_of(len(got), 'entry')}; expected "
                        f"{number_of(expected, 'entry')}"
                    )
        changes, z0 = target.changes, np.zeros(z)
        if point is not None:
            z0 = target.outputs @ point.x + (0.0 if target.D is None else target.D @ point.u)
            changes = None if changes is None else changes.relative_to(z0)
        own = target.signals(continuous, changes, None if point is None or target.value is None else z0)
        if changes is not None:
            started = own[-1].start[None] if changes.known is None else changes.known
            expect_within(changes.limits, started, z0)
        signals += [*own, *known]
        changes = None if changes is None or changes.noise is None else changes
        if known:  # they are given as set-points are, and come last
            k = len(known)
            changes = RandomSteps(0.0, np.zeros((k, k))) if changes is None else changes.beside(k)
        E, G, F = (
            np.hstack([one.entering(name, rows) for one in signals])
            for name, rows in (("E", n), ("G", outputs), ("F", z))
        )
        return Exosystem(
            S=block_diagonal(*(one.S for one in signals)),
            E=E,
            G=G,
            W=block_diagonal(*(one.W for one in signals)),
            start=np.concatenate([one.start for one in signals]),
            outputs=target.outputs,
            F=F,
            changes=changes,
            D=target.D,
        )


def loads_of(disturbances: Sequence[ExternalDisturbance], states: int, outputs: int) -> tuple[Load, ...]:
    """Return the loads among the disturbances of a plant, whose exosystem ``Exosystem.of`` has ``states`` states."""
    sizes = [0 if one.hidden or one.known else len(one.noise) for one in disturbances]
    known = [one for one in disturbances if one.known]
    found = list[Load]()
    for place, one in enumerate(disturbances):
        made = one.stairs
        if made is None:
            continue
        signal = states - len(known) + known.index(one) if one.known else sum(sizes[:place])
        measured = np.zeros(outputs) if one.measured is None else one.measured
        found.append(Load(*made, one.enters, measured, None if one.hidden else signal, one.known))
    return tuple(found)
