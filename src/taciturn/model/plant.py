"""Linear and nonlinear plants with noise, in discrete or continuous time, whose data are checked.

    x⁺ = A x + B u + w,   or   dx = (A x + B u) dt + noise,   y = C x + v.

A plant that is not linear has a step function, which A and B linearise at the operating point; with a point, the
attributes of a plant are deviations from it, and ``about`` moves a plant to another point.

A descriptor plant E x⁺ = A x + B u + w, or E dx = (A x + B u) dt + noise, is the plant with E⁻¹A, E⁻¹B and E⁻¹w, with
the same state x. A double is a rational number, so whether E is regular is decided without a tolerance, and the
matrices are the doubles nearest to the exact ones, also if E is nearly singular. With a singular E, some of the
equations are algebraic, and the state may jump when an input does.

A plant of a design may contain states that were added to it: registers of inputs, disturbances and set-points
(``lqg.discrete``). ``summary`` and ``matrix_lines`` describe plants and matrices as text.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Literal, NamedTuple, Self, TypeVar, cast

import numpy as np
from flint import fmpq, fmpq_mat, fmpz_mat

from taciturn._arrays import (
    Array,
    ArrayLike,
    array,
    frozen,
    instance,
    is_definite,
    number,
    quoted,
    semidefinite,
    set_fields,
    square,
)
from taciturn._display import Displayed
from taciturn._modes import eigenvalues, factor, mode_text, root, symmetric_factor
from taciturn._rational import FEWEST, Limit, is_semidefinite, nearest, rational, unmoved
from taciturn._text import Lines, number_of
from taciturn.errors import ProblemError
from taciturn.model.delay import Transport
from taciturn.model.dynamics import Dynamics, Map
from taciturn.model.key import NO_KEY, Rows, stated_as, table_of
from taciturn.model.load import Load
from taciturn.model.names import Names, Role, unit_of
from taciturn.model.noise import Noise
from taciturn.model.operating_point import MovedDynamics, OperatingPoint
from taciturn.model.saturation import Saturation, limits_from, positive, saturation
from taciturn.model.signals import Exosystem, RandomSteps, SampledChanges
from taciturn.model.trigger import Matrix, Scheduled


class Inverse(NamedTuple):
    """The inverse E⁻¹ of a descriptor matrix. It is stored exactly, as an integer matrix times a rational number."""

    whole: fmpz_mat
    factor: fmpq

    @classmethod
    def of(cls, E: ArrayLike, n: int) -> Inverse:
        """Compute the inverse of a matrix E, (n, n), without rounding."""
        matrix, below = rational(array("E", E, (n, n), "(states, states)")).numer_denom()
        try:
            one = fmpz_mat(n, n, [int(i == j) for i in range(n) for j in range(n)])
            found = cast("fmpq_mat", cast("Any", matrix).solve(one))  # its stub leaves the type open
        except ZeroDivisionError:
            raise ProblemError(
                f"E is singular: its rank is {matrix.rank()} for {number_of(n, 'state')}, so some equations are "
                "algebraic, and the "
                "state could jump with an input; expected an invertible E: eliminate the states that the algebraic "
                "equations determine"
            ) from None
        whole, divisor = found.numer_denom()
        return cls(whole, fmpq(below, divisor))

    def times(self, name: str, effect: ArrayLike) -> Array:
        """Multiply a matrix of the descriptor equation from the left by E⁻¹, and round to the nearest doubles."""
        right = array(name, effect, (self.whole.nrows(), None), "(states, any)")
        whole, below = rational(right).numer_denom()
        return _within_range(f"E⁻¹{name}", self.whole * whole, self.factor / below)

    def covariance(self, name: str, W: ArrayLike) -> Array:
        """Convert the noise covariance W of the descriptor equation to that of the state, E⁻¹W(E⁻¹)'."""
        stated = semidefinite(name, W, self.whole.nrows(), "(states, states)")
        exact = rational(stated)
        if not (is_definite(stated) or is_semidefinite(stated)):  # but for the rounding of its entries
            part = rational(root(stated))
            exact = part * part.transpose()
        whole, below = exact.numer_denom()
        moved = self.whole * whole * self.whole.transpose()
        return _within_range(f"E⁻¹·{name}·E'⁻¹", moved, self.factor * self.factor / below)

    def acting(self, exosystem: Exosystem | None) -> Exosystem | None:
        """Convert disturbances of the descriptor equation to disturbances of the state."""
        if exosystem is None or not exosystem.E.shape[1]:
            return exosystem
        return replace(exosystem, E=self.times("exosystem.E", exosystem.E))

    def shaking(self, jumps: Jumps | None) -> Jumps | None:
        """Convert Poisson jumps of the descriptor equation to jumps of the state."""
        if jumps is None:
            return None
        instance("jumps", jumps, Jumps)
        if jumps.distribution != "normal":
            raise ProblemError(
                f"jumps.distribution is {jumps.distribution!r}, but E is given, which mixes the jumps of the "
                "equations; expected 'normal', or A, B and the jumps of a plant without E"
            )
        return replace(jumps, covariance=self.covariance("jumps.covariance", jumps.covariance))


def explicit(E: ArrayLike, A: ArrayLike, B: ArrayLike) -> tuple[Inverse, Array, Array]:
    """Convert a plant with a descriptor matrix E: return E⁻¹, and E⁻¹A and E⁻¹B of the equivalent plant without E."""
    A = square("A", A, "states × states")
    B = array("B", B, (len(A), None), "(states, inputs)")
    inverse = Inverse.of(E, len(A))
    return inverse, inverse.times("A", A), inverse.times("B", B)


def _within_range(name: str, whole: fmpz_mat, factor: fmpq) -> Array:
    return array(name, nearest(whole, factor), (None, None))


BLUR = 1e-6  # relative difference below which poles are considered equal
WIDEST = 12  # largest number of columns of a matrix that is printed in full
NARROW = 6  # most columns of four digits that fit a line
BEFORE = "direct feedthrough of the input of the step before, as each sample is taken before the input changes"
FED = "y = C x + D u + v, with the input u of the step before, as each sample is taken before the input changes"
NamedRows = dict[str, str | Array | None]


@dataclass(frozen=True, eq=False, repr=False)
class DisplayedPlant(Displayed):
    """Base class of discrete-time and continuous-time plants: the attributes, keys and summary that both have."""

    A: Array = field(metadata=stated_as(Rows, note="dynamics, {per}"))
    B: Array = field(metadata=stated_as(Rows, note="effect of the inputs, {per}"))
    C: Array = field(metadata=stated_as(Rows | None, note="output matrix"))
    D: Array | None = field(metadata=stated_as(Rows | None, note=BEFORE))
    W: Array = field(metadata=stated_as(Rows | None, note="noise w: {noise}, in the units of the states squared"))
    V: Array = field(
        metadata=stated_as(
            Rows | None, note="measurement noise v: covariance per sample, in the units of the outputs squared"
        )
    )
    mean: Array = field(metadata=NO_KEY)  # in [plant.initial]
    covariance: Array = field(metadata=NO_KEY)
    input_limit: Array | None = field(
        metadata=stated_as(
            list[float | list[float]] | None,
            note="largest size of each input, or [low, high]; with a limit, no guarantee is shown",
        )
    )
    # in the units of the plant, (m, 2); ``input_limit`` is computed from it for each operating point, so that it does
    # not depend on the points between
    stated_limit: Array | None = field(compare=False, metadata=NO_KEY)
    input_rate: Array | None = field(metadata=stated_as(list[float] | None))
    full_state: bool = field(metadata=NO_KEY)
    exosystem: Exosystem | None = field(metadata=NO_KEY)
    # of the simulated plant, which designs do not look at
    loads: tuple[Load, ...] = field(default=(), metadata=NO_KEY, kw_only=True)
    operating_point: OperatingPoint | None = field(metadata=stated_as(table_of(OperatingPoint) | None))
    # constant delays of its inputs and outputs over the links of a network
    transport: Transport | None = field(default=None, metadata=NO_KEY, kw_only=True)
    # for text and figures; a plant with further states and outputs keeps the names of the first ones
    names: Names | None = field(default=None, compare=False, kw_only=True, metadata=NO_KEY)
    continuous: ClassVar[bool] = True

    @property
    def states(self) -> int:
        """Number of states n."""
        return self.A.shape[0]

    @property
    def inputs(self) -> int:
        """Number of inputs m."""
        return self.B.shape[1]

    @property
    def saturation(self) -> Saturation | None:
        """Limits of the inputs, and of their change per step; None if no input has a limit."""
        return saturation(self.input_limit, self.input_rate)

    @property
    def unlimited(self) -> Self:
        """A copy of the plant without limits of its inputs."""
        return self._without("input_limit", "stated_limit", "input_rate")

    @property
    def linear(self) -> Self:
        """The linear plant without input limits and loads for which policies are designed."""
        found = self._without("input_limit", "stated_limit", "input_rate", "function")
        return altered(found, {"loads": ()}) if found.loads else found

    def _without(self, *names: str) -> Self:
        return altered(self, {name: None for name in names if getattr(self, name, None) is not None})

    @property
    def rest_outputs(self) -> Array:
        """The outputs at the operating point, (p,). They are zero for a plant without an operating point."""
        point = self.operating_point
        if point is None:
            return np.zeros(len(self.C))
        return self.C @ point.x if self.D is None else self.C @ point.x + self.D @ point.u

    @property
    def stated_mean(self) -> Array:
        """Mean of the initial state, (n,), in the units of the plant."""
        return self.mean if self.operating_point is None else self.mean + self.operating_point.x

    def told(self, role: Role, place: int) -> str:
        """Write the name of a signal after its number in a message; empty without names."""
        return "" if self.names is None else self.names.told(role, place)

    @property
    def time(self) -> str:
        """Whether time is continuous or discrete, as text."""
        return "continuous in time"

    @property
    def noise(self) -> str | None:
        """Description of noise that is not Gaussian; None for Gaussian noise."""
        return None

    def summary(self) -> NamedRows:
        """Return the values to display: size, time base, poles, measurement, noise and matrices."""
        return {
            "size": self.short(),
            "time": self.time,
            "poles": _poles(self.A, self.continuous),
            "measured": "the full state, exactly" if self.full_state else FED if self.D is not None else "y = C x + v",
            "noise": self.noise,
            "A": self.A,
            "B": self.B,
            "C": None if self.full_state else self.C,
            "D": self.D,
            "W": self.W,
            "V": None if self.full_state else self.V,
            "operating point": None if self.operating_point is None else self.operating_point.short(),
            "mean": self.stated_mean if self.mean.any() else None,
            "covariance": self.covariance if self.covariance.any() else None,
            "input limit": None if self.stated_limit is None else limits_text(self.stated_limit, self.names),
            "input rate": None if self.input_rate is None else rates_text(self.input_rate, self.continuous),
        }

    def short(self, inputs: int | None = None) -> str:
        """Describe how many states, inputs and outputs the plant has. ``inputs`` replaces the number of inputs."""
        counts = (self.states, self.inputs if inputs is None else inputs, self.C.shape[0])
        named = zip(counts, ("state", "input", "output"), strict=True)
        return ", ".join(number_of(count, name) for count, name in named)


def limits_text(limit: Array, names: Names | None = None) -> str:
    """Write the limits of the inputs, (m, 2), as text, after the names of the inputs if they have some."""
    sides = [f"±{high:.6g}" if low == -high else f"{low:.6g} to {high:.6g}" for low, high in limit]
    sides = [side.replace("inf", "∞") for side in sides]
    if names is None or not names.inputs:
        return ", ".join(sides)
    shown = [unit_of(label) for label in names.numbered("inputs", len(sides))]
    return ", ".join(f"{name} {side} {unit}".strip() for (name, unit), side in zip(shown, sides, strict=True))


def rates_text(rate: Array, continuous: bool) -> str:
    """Write the limits of the change of each input per step or second, (m,), as text."""
    listed = ", ".join(f"{value:.6g}" for value in rate).replace("inf", "∞")
    return f"at most {listed} per {'second' if continuous else 'step'}"


def _poles(A: Array, continuous: bool) -> str:
    """Return the stability of a plant without control, and its poles, as text."""
    poles = eigenvalues(A)
    size = max(float(np.abs(poles).max()), 1e-300) if continuous else 1.0
    margin = float(poles.real.max() if continuous else np.abs(poles).max() - 1) / size
    stable = "marginally stable" if abs(margin) < BLUR else "stable" if margin < 0 else "unstable"
    shown = [complex(p.real) if abs(p.imag) < BLUR * abs(p) else complex(p) for p in poles]
    shown.sort(key=lambda p: (-float(f"{abs(p):.6g}"), p.real, -p.imag))  # rounding does not decide their order
    limit = Limit(continuous)
    digits = [limit.digits(p) if stable == "unstable" else FEWEST for p in shown]
    return f"{stable}: {', '.join(map(mode_text, shown, digits))}"


def matrix_lines(name: str, value: Matrix) -> Lines:
    """Write a matrix as lines of text. Special matrices are abbreviated, and of a table, the first matrix is shown."""
    if isinstance(value, Scheduled):
        first = value.values[0]
        if len(value.values) == 1:
            return matrix_lines(name, first)
        note = (name, f"the first of {len(value.values)}, selected by {value.by}:")
        return [note, *(("", text) for _, text in matrix_lines("", first))]
    rows, columns = value.shape
    if not value.any():
        return [(name, f"0 ({rows}×{columns})")]
    diagonal = np.diag(value) if rows == columns else value[:0, 0]
    if rows == columns > 1 and np.array_equal(value, np.diag(diagonal)):
        same = (diagonal == diagonal[0]).all()
        factor = "" if diagonal[0] == 1 else f"{diagonal[0]:.6g} "
        return [(name, f"{factor}I ({rows}×{rows})" if same else f"diag({', '.join(f'{d:.4g}' for d in diagonal)})")]
    if columns > WIDEST:
        return [(name, f"{rows}×{columns}, entries from {value.min():.4g} to {value.max():.4g}")]
    digits = 4 if columns <= NARROW else 2
    return [(name if i == 0 else "", vector_text(row, digits)) for i, row in enumerate(value)]


def vector_text(values: Array, digits: int = 4) -> str:
    """Write the entries of a vector in columns of equal width."""
    if len(values) == 1:
        return f"[{values[0]:.6g}]"
    return f"[{' '.join(f'{value:{digits + 6}.{digits}g}' for value in values)}]"


AnyPlant = TypeVar("AnyPlant", bound=DisplayedPlant)


def altered(plant: AnyPlant, attributes: Mapping[str, object]) -> AnyPlant:
    """Return a copy of a plant with changed attributes, which are not checked."""
    found = copy(plant)
    set_fields(found, attributes)
    return found


def counted_from(
    plant: AnyPlant, origin: Plant | ContinuousPlant, moved: Callable[[OperatingPoint], OperatingPoint] | None = None
) -> AnyPlant:
    """Express a converted plant as deviations from the operating point of the plant that was converted."""
    point = origin.operating_point
    if point is None:
        return plant
    point = point if moved is None else moved(point)
    return altered(plant, {"operating_point": point, "stated_limit": origin.stated_limit})


def about(plant: Plant, point: OperatingPoint | None) -> Plant:
    """Express a plant as deviations from another operating point. For None, use the plant's own units.

    If the plant does not rest at this point, its ``drift`` is what its state moves by there.
    """
    here = plant.operating_point
    if here is point or (here is not None and point is not None and here.same_as(point)):
        return plant
    zero = OperatingPoint(np.zeros(plant.states), np.zeros(plant.inputs))
    start, end = here or zero, point or zero
    x, u = end.x - start.x, end.u - start.u
    terms = [plant.A @ x, plant.B @ u, -x]
    drift = np.sum([*terms, *([] if plant.drift is None else [plant.drift])], axis=0)
    still = np.abs(drift).max() <= STILL * max(float(np.abs(term).max()) for term in terms)
    function = plant.function
    moved: dict[str, object] = {
        "mean": frozen(plant.mean - x),
        "input_limit": limits_at(plant, point),
        "drift": None if still or function is not None else frozen(drift),
        "function": None if function is None else MovedDynamics.of(function, x, u, x),
        "operating_point": point,
    }
    return altered(plant, moved)


STILL = 1e-10  # drift that is a rounding error, relative to its terms


JumpDistribution = Literal["normal", "uniform", "two-point"]


@dataclass(frozen=True, eq=False, repr=False)
class Plant(DisplayedPlant):
    """A discrete-time plant x⁺ = A x + B u + w, y = C x + v, with white noise w ~ N(0, W) and v ~ N(0, V).

    With E it is the descriptor plant E x⁺ = A x + B u + w with the same state x, and its attributes A, B and W are
    those without E: E⁻¹A, E⁻¹B and E⁻¹W(E⁻¹)', each the double nearest to the exact value.

    Args:
        A: state matrix, (n, n).
        B: input matrix, (n, m).
        W: process-noise covariance per step, (n, n), positive semidefinite; may be zero. Required unless ``noise``
            states that of the inputs.
        C: output matrix, (p, n); if omitted, the full state is measured.
        V: measurement-noise covariance, (p, p), positive semidefinite; if omitted, the measurement is exact.
        dt: seconds per step; if omitted, time is counted in steps.
        mean: mean of the initial state, (n,); default 0.
        covariance: covariance of the initial state, (n, n); default 0.
        input_limit: limits of each input at the plant: a positive number for symmetric limits, or a pair [low, high],
            with ∞ for an open side; stored as (m, 2); default no limit.
        exosystem: disturbances and set-points, or None.
        function: step x⁺ = f(x, u, w) of a nonlinear plant, with arrays (n,), (m,), (n,) and w ~ N(0, W) drawn at
            every step. Policies are designed for A and B, which must be the derivatives of f with respect to x and u
            at the operating point. The derivative with respect to w must be the identity wherever W is not 0. If
            ``function`` is omitted, the step is A x + B u + w.
        input_rate: largest change of each input per step, (m,), ∞ for no limit; default no limit. The input before the
            start is 0.
        operating_point: state and input around which A and B are given; default 0. Then the arguments mean, input_limit
            and function, the measurements and the inputs are in the units of the plant; the attributes of the plant and
            the cost count deviations from the point.
        D: direct feedthrough, (p, m), of the input that the plant applied in the step before: y_k = C x_k + D û_{k−1}
            + v_k; default 0. Only with C.
        E: matrix of the next state, (n, n), regular; default the identity. The effect of the exosystem on the state is
            then that on the equation of E. Not with ``function``.
        noise: amplitudes of noise at the inputs in place of W, and at the outputs in place of V.
        names: names of the states, inputs and outputs, or None.

    Raises:
        ProblemError: if a matrix has the wrong shape, is not finite or is indefinite; if E is singular; if a growing
            mode is not controllable or not observable; or if ``function`` fails, does not rest at the operating point,
            or is not linearised by A, B.

    Example:
        >>> Plant(A=[[2.0]], B=[[1.0]], W=[[0.01]]).inputs
        1
        >>> Plant(E=[[4.0]], A=[[2.0]], B=[[1.0]], W=[[0.16]]).W
        array([[0.01]])
    """

    dt: float | None = field(
        metadata=stated_as(float | None, note="seconds per step; without this key the plant is continuous in time")
    )
    function: Dynamics | None = field(metadata=stated_as(str | None))
    # the plant without its disturbances, set-points and registers, if these are states here
    alone: Plant | None = field(default=None, metadata=NO_KEY)
    # inputs whose values in earlier steps are states, after those of the plant, and after them outputs of earlier steps
    registers: tuple[int, ...] = field(default=(), metadata=NO_KEY)
    stored: tuple[int, ...] = field(default=(), metadata=NO_KEY)
    # of set-points, the last states, which are also outputs
    changes: RandomSteps | SampledChanges | None = field(default=None, metadata=NO_KEY)
    # what the state moves by at the point that states and inputs are relative to
    drift: Array | None = field(default=None, metadata=NO_KEY)
    continuous: ClassVar[bool] = False

    def __init__(
        self,
        A: ArrayLike,
        B: ArrayLike,
        W: ArrayLike | None = None,
        C: ArrayLike | None = None,
        V: ArrayLike | None = None,
        dt: float | None = None,
        mean: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        input_limit: ArrayLike | None = None,
        function: Map | Dynamics | None = None,
        exosystem: Exosystem | None = None,
        input_rate: ArrayLike | None = None,
        operating_point: OperatingPoint | None = None,
        D: ArrayLike | None = None,
        E: ArrayLike | None = None,
        noise: Noise | None = None,
        names: Names | None = None,
    ) -> None:
        """Validate and store the arguments."""
        W, V = _covariances(noise, W, V, A, B, C)
        if W is None:
            raise ProblemError(
                "W is missing; expected the process-noise covariance per step (zeros for none), or noise.input"
            )
        if E is not None:
            if function is not None:
                raise ProblemError(
                    "E is given together with a function, which returns the next state; expected no E: remove it"
                )
            inverse, A, B = explicit(E, A, B)
            W, exosystem = inverse.covariance("W", W), inverse.acting(exosystem)
        _set_linear(self, A, B, C, V, mean, covariance, input_limit, input_rate, exosystem, D)
        set_names(self, names)
        _set_step(self, W, dt, function, operating_point, mean is not None)
        _refuse_lost_modes(self, continuous=False)

    @property
    def time(self) -> str:
        """Discrete time with the seconds per step, as text."""
        per = "" if self.dt is None else f", {self.dt:g} s per step"
        return f"discrete in time{per}{'' if self.function is None else ', not linear'}"

    @property
    def outputs(self) -> int:
        """Number of measured outputs p."""
        return self.C.shape[0]

    @property
    def stated(self) -> int:
        """Number of states, without the registers that delays or a direct feedthrough add for earlier inputs."""
        return self.states - len(self.registers) - len(self.stored)

    @property
    def sensed(self) -> int:
        """Number of outputs that sensors measure, without set-points that are outputs too."""
        return self.outputs - self.set_points

    @property
    def set_points(self) -> int:
        """Number of set-points that change while the loop runs. The controller reads them as the last outputs."""
        return 0 if self.changes is None else self.changes.size

    @property
    def given(self) -> Array:
        """Initial values, (z,), of the set-points that the controller reads."""
        return self.mean[self.states - self.set_points :]

    def same_as(self, other: Plant) -> bool:
        """Return whether the other plant has the same linear dynamics, noise and input limits."""
        apart = {"mean", "covariance", "dt", "function", "full_state", "operating_point", "stated_limit", "names"}
        apart |= {"exosystem", "alone", "changes", "registers", "stored", "loads", "transport"}
        return all(self.agrees(key, other) for key in {one.name for one in (*fields(self), *fields(other))} - apart)

    def agrees(self, key: str, other: Plant) -> bool:
        """Return whether two plants have the same value of an attribute, or both have none."""
        return np.array_equal(*(cast("Any", getattr(one, key, None)) for one in (self, other)))


@dataclass(frozen=True, eq=False, repr=False)
class Jumps(Displayed):
    """Poisson jumps: at the events of a Poisson process with rate λ, a zero-mean random vector is added to the state.

    Args:
        rate: mean number of jumps per second λ, positive.
        covariance: covariance of a single jump, (n, n), positive semidefinite.
        distribution: ``"normal"``, ``"uniform"`` or ``"two-point"``; each is scaled to the covariance: a jump is G ξ
            with independent ξ_i of variance 1 and this distribution. If it is not normal, the distribution of a jump
            depends on G and not only on its covariance G G'. So G, ``spread``, is D S with the deviations D of the
            entries and the symmetric root S of their correlation matrix, which depends neither on the order of the
            states nor on their units. G itself is not symmetric, unless all deviations are equal.

    Raises:
        ProblemError: if the rate is not positive, or the covariance is not positive semidefinite.

    Example:
        >>> Jumps(1.0, [[100.0, 6.0], [6.0, 1.0]], "uniform").spread.round(3)
        array([[9.487, 3.162],
               [0.316, 0.949]])
    """

    rate: float
    covariance: Array = field(metadata=stated_as(Rows))
    distribution: JumpDistribution = field(default="normal", metadata=stated_as(str))

    def __post_init__(self) -> None:
        """Validate and store the arguments."""
        number("jumps.rate", self.rate, 0.0)
        size = array("jumps.covariance", self.covariance, (None, None), "(states, states)").shape[0]
        set_fields(self, {"covariance": semidefinite("jumps.covariance", self.covariance, size)})
        if self.distribution not in ("normal", "uniform", "two-point"):
            raise ProblemError(
                f"jumps.distribution is {self.distribution!r}; expected 'normal', 'uniform' or 'two-point'"
            )

    @property
    def spread(self) -> Array:
        """Matrix G, (n, ξ), of the jumps Gξ. The entries of ξ are independent, with variance 1."""
        return factor(self.covariance) if self.distribution == "normal" else symmetric_factor(self.covariance)


@dataclass(frozen=True, eq=False, repr=False)
class Prediction(Displayed):
    """The model that an actuator integrates between steps to predict the state: u = L x̂ and dx̂/dt = (A + BL) x̂."""

    L: Array  # feedback gain, (inputs, states)
    dynamics: Array  # closed-loop state matrix A + BL, (states, states)

    @classmethod
    def of(cls, plant: ContinuousPlant, L: Array) -> Prediction:
        """Return the model with which an actuator with the feedback gain L predicts the state of a plant."""
        return cls(L, plant.A + plant.B @ L)


@dataclass(frozen=True, eq=False, repr=False)
class JumpNoise(Displayed):
    """The noise due to Poisson jumps w_i at times t_i in a step of τ seconds: Σ_i e^{A(τ−t_i)} w_i."""

    A: Array  # state matrix between jumps, per second, (n, n)
    jumps: Jumps  # rate, covariance and distribution of the jumps
    period: float  # τ, seconds per step


@dataclass(frozen=True, eq=False, repr=False)
class ContinuousPlant(DisplayedPlant):
    """A continuous-time plant dx = (A x + B u) dt + noise with the sampled measurement y = C x + v.

    With E it is the descriptor plant E dx = (A x + B u) dt + noise, with attributes A, B and W as for ``Plant``.

    Args:
        A: state matrix, (n, n), per second.
        B: input matrix, (n, m).
        W: intensity per second of the Wiener noise, (n, n), positive semidefinite; give either W or jumps.
        jumps: Poisson jumps instead of Wiener noise.
        C: output matrix, (p, n); if omitted, the full state is measured.
        V: measurement-noise covariance of each sample, (p, p); if omitted, the measurement is exact.
        mean: mean of the initial state, (n,); default 0.
        covariance: covariance of the initial state, (n, n); default 0.
        input_limit: limits of each input at the plant: a positive number for symmetric limits, or a pair [low, high],
            with ∞ for an open side; stored as (m, 2); default no limit.
        exosystem: disturbances and set-points, or None.
        input_rate: largest change of each input per second, (m,), ∞ for no limit; default no limit. The input before
            the start is 0. Between the samples the input is held, and changes only at them.
        operating_point: as for ``Plant``.
        D: direct feedthrough, (p, m), as for ``Plant``: each sample is taken before the input changes.
        E: matrix of the derivative, (n, n), regular; default the identity. Jumps, which must then be normal, and the
            exosystem act on the equation of E.
        noise: amplitudes of noise at the inputs in place of W, and at the outputs in place of V.
        names: names of the states, inputs and outputs, or None.

    Raises:
        ProblemError: if a matrix has the wrong shape, is not finite or is indefinite; if E is singular; if a growing
            mode is not controllable or not observable; or unless exactly one of W and jumps is given.

    Example:
        >>> ContinuousPlant(A=[[0, 1], [0, 0]], B=[[0], [1]], W=[[0, 0], [0, 2.5]]).states
        2
    """

    jumps: Jumps | None = field(metadata=stated_as(table_of(Jumps) | None))

    def __init__(
        self,
        A: ArrayLike,
        B: ArrayLike,
        W: ArrayLike | None = None,
        jumps: Jumps | None = None,
        C: ArrayLike | None = None,
        V: ArrayLike | None = None,
        mean: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        input_limit: ArrayLike | None = None,
        exosystem: Exosystem | None = None,
        input_rate: ArrayLike | None = None,
        operating_point: OperatingPoint | None = None,
        D: ArrayLike | None = None,
        E: ArrayLike | None = None,
        noise: Noise | None = None,
        names: Names | None = None,
    ) -> None:
        """Validate and store the arguments."""
        W, V = _covariances(noise, W, V, A, B, C)
        if E is not None:
            inverse, A, B = explicit(E, A, B)
            W = None if W is None else inverse.covariance("W", W)
            jumps, exosystem = inverse.shaking(jumps), inverse.acting(exosystem)
        _set_linear(self, A, B, C, V, mean, covariance, input_limit, input_rate, exosystem, D)
        set_names(self, names)
        locate(self, operating_point, mean is not None)
        if W is None and jumps is None:
            raise ProblemError(
                "W is missing; expected the noise intensity per second (zeros for none), or jumps, or noise.input"
            )
        if jumps is not None:
            if W is not None:
                what = "W" if noise is None or noise.input is None else "noise.input"
                raise ProblemError(f"{what} and jumps are both given; expected one kind of noise: remove one")
            instance("jumps", jumps, Jumps)
            covariance = semidefinite("jumps.covariance", jumps.covariance, self.states, "(states, states)")
            W = jumps.rate * covariance
        intensity = semidefinite("W", cast("ArrayLike", W), self.states, "(states, states)")
        set_fields(self, {"W": intensity, "jumps": jumps})
        _refuse_lost_modes(self, continuous=True)

    @property
    def noise(self) -> str | None:
        """Description of the plant's Poisson jumps; None for a plant without jumps."""
        if self.jumps is None:
            return None
        return f"{self.jumps.rate:g} jumps per second, {self.jumps.distribution}, W is rate times covariance"


def derived_plant(
    A: Array,
    B: Array,
    W: Array,
    C: Array | None,
    V: Array | None,
    dt: float | None,
    mean: Array,
    covariance: Array,
    input_limit: Array | None,
    function: Dynamics | None = None,
    input_rate: Array | None = None,
) -> Plant:
    """Construct a discrete-time plant from matrices that were computed from a checked plant.

    The checked plant decides which modes are controllable and observable: rounding, as in sampling, may let a mode
    that no input moves grow a little.
    """
    found = object.__new__(Plant)
    _set_linear(found, A, B, C, V, mean, covariance, input_limit, input_rate, None, None)
    _set_step(found, W, dt, function, None, True)
    return found


def _set_step(
    plant: Plant,
    W: ArrayLike,
    dt: float | None,
    function: Map | Dynamics | None,
    point: OperatingPoint | None,
    starts: bool,
) -> None:
    """Check and set the attributes of a discrete plant alone; ``starts``: whether the initial mean is given."""
    locate(plant, point, starts)
    noise, step = semidefinite("W", W, plant.states, "(states, states)"), None if dt is None else number("dt", dt, 0.0)
    set_fields(plant, {"W": noise, "dt": step})
    if function is not None:
        if not callable(function):
            raise ProblemError(f"function is {quoted(function)}; expected a function x, u, w → x⁺")
        found = function if isinstance(function, Dynamics) else Dynamics(function)
        found.check(plant.A, plant.B, plant.W, None if point is None else (point.x, point.u), plant.names)
        if point is not None:
            rest = found(point.x, point.u, np.zeros(len(point.x)))
            found = MovedDynamics.of(found, point.x, point.u, rest)
        function = found
    set_fields(plant, {"function": function})


def _set_linear(
    plant: Plant | ContinuousPlant,
    A: ArrayLike,
    B: ArrayLike,
    C: ArrayLike | None,
    V: ArrayLike | None,
    mean: ArrayLike | None,
    covariance: ArrayLike | None,
    input_limit: ArrayLike | None,
    input_rate: ArrayLike | None,
    exosystem: Exosystem | None,
    D: ArrayLike | None,
) -> None:
    """Check and set the attributes that both plant classes share."""
    A = array("A", A, (None, None), "(states, states)")
    n = A.shape[0]
    if n == 0 or A.shape[1] != n:
        raise ProblemError(f"A has shape {A.shape}; expected a square matrix with at least one state")
    B = array("B", B, (n, None), "(states, inputs)")
    if B.shape[1] == 0:
        raise ProblemError("B has no columns; expected at least one input")
    given = C is not None
    C = array("C", C, (None, n), "(outputs, states)") if given else frozen(np.eye(n))
    p = C.shape[0]
    if p == 0:
        raise ProblemError("C has no rows; expected at least one measured output (omit C to measure the full state)")
    if D is not None and not given and array("D", D, (None, None), "(outputs, inputs)").any():
        raise ProblemError("D is given without C; expected C (and V), as a direct feedthrough adds to measured outputs")
    D = None if D is None else array("D", D, (p, B.shape[1]), "(outputs, inputs)")
    limit = None if input_limit is None else limits_from(input_limit, B.shape[1])
    values: dict[str, object] = {
        "A": A,
        "B": B,
        "C": C,
        "V": frozen(np.zeros((p, p))) if V is None else semidefinite("V", V, p, "(outputs, outputs)"),
        "mean": array("initial.mean", np.zeros(n) if mean is None else mean, (n,), "(states,)"),
        "covariance": frozen(np.zeros((n, n)))
        if covariance is None
        else semidefinite("initial.covariance", covariance, n, "(states, states)"),
        "input_limit": limit,
        "stated_limit": limit,
        "input_rate": None if input_rate is None else positive("input_rate", input_rate, B.shape[1]),
        "exosystem": exosystem,
        "D": D if D is not None and D.any() else None,
    }
    if exosystem is not None and (exosystem.E.shape[0], exosystem.G.shape[0]) != (n, p):
        got = f"{number_of(exosystem.E.shape[0], 'state')} and {number_of(exosystem.G.shape[0], 'output')}"
        raise ProblemError(
            f"the model of disturbances and set-points has {got}; expected {number_of(n, 'state')} and "
            f"{number_of(p, 'output')}, as in the plant"
        )
    set_fields(plant, values)
    set_fields(plant, {"full_state": np.array_equal(C, np.eye(n)) and not plant.V.any() and plant.D is None})


def _covariances(
    noise: Noise | None, W: ArrayLike | None, V: ArrayLike | None, A: ArrayLike, B: ArrayLike, C: ArrayLike | None
) -> tuple[ArrayLike | None, ArrayLike | None]:
    """Return the covariances W and V that are given, or that the amplitudes of the noise determine."""
    if noise is None:
        return W, V
    instance("noise", noise, Noise)
    outputs = array("A", A, (None, None)) if C is None else array("C", C, (None, None), "(outputs, states)")
    return noise.covariances(W, V, B, len(outputs))


def set_names(plant: Plant | ContinuousPlant, names: Names | None) -> None:
    """Set the names of a new plant, after a check of their numbers. Outputs that are the states have their names."""
    if names is None:
        return
    instance("names", names, Names)
    names.expect(len(plant.C), plant.inputs, plant.states)
    shown = replace(names, outputs=names.states) if plant.full_state and not names.outputs else names
    set_fields(plant, {"names": shown})


def _refuse_lost_modes(plant: Plant | ContinuousPlant, continuous: bool) -> None:
    """Reject a plant with a growing mode that is not controllable or not observable.

    Marginally stable modes are accepted here; whether they must be controlled depends on cost and noise.
    """
    for A, B, verb, what, remedy in (
        (plant.A, plant.B, "stabilisable", "no input affects", "add an actuator, or remove the mode"),
        (plant.A.T, plant.C.T, "detectable", "no measurement shows", "add a sensor, or remove the mode"),
    ):
        lost = unmoved(A, B, Limit(continuous), rounded=True).growing
        if lost.size:
            mode = Limit(continuous).named(complex(lost[0]))
            matrices = "(A, B)" if verb == "stabilisable" else "(A, C)"
            raise ProblemError(
                f"{matrices} is not {verb}: {what} the growing mode with the eigenvalue {mode}; expected a {verb} "
                f"plant: {remedy}"
            )


def locate(plant: Plant | ContinuousPlant, point: OperatingPoint | None, mean: bool) -> None:
    """Set the operating point of a new plant, and express its initial mean and its limits as deviations."""
    set_fields(plant, {"operating_point": point})
    if point is None:
        return
    instance("operating_point", point, OperatingPoint)
    n, m = plant.B.shape
    array("operating_point.x", point.x, (n,), "(states,)")
    array("operating_point.u", point.u, (m,), "(inputs,)")
    if mean:
        set_fields(plant, {"mean": frozen(plant.mean - point.x)})
    limit = plant.input_limit
    if limit is not None:
        for i in np.flatnonzero((point.u < limit[:, 0]) | (point.u > limit[:, 1])):
            raise ProblemError(
                f"operating_point.u is {point.u[i]:g} for input {i + 1}{plant.told('inputs', int(i))}, beyond its "
                "input_limit "
                f"[{limit[i, 0]:g}, {limit[i, 1]:g}]; expected an input within the limits"
            )
        set_fields(plant, {"input_limit": limits_at(plant, point)})


def limits_at(plant: Plant | ContinuousPlant, point: OperatingPoint | None) -> Array | None:
    """Return the limits of a plant's inputs as deviations from an operating point, (m, 2); None without limits.

    They are computed from the limits in the units of the plant: (limit − u) + u differs from the limit by rounding.
    """
    limit = plant.stated_limit
    return limit if limit is None or point is None else frozen(limit - point.u[:, None])
