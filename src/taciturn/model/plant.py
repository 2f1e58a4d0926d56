"""Plants: discrete or continuous in time, driven by noise, and checked when they are made."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, Protocol, cast, runtime_checkable

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array, ArrayLike, array, frozen, instance, number, quoted, semidefinite
from taciturn._modes import SCATTER, Slow, lost_modes, mode_text, pace
from taciturn.errors import ProblemError
from taciturn.model.dynamics import Dynamics, Map

JumpDistribution = Literal["normal", "uniform", "two-point"]


@dataclass(frozen=True, eq=False)
class Plant:
    """A discrete-time plant x⁺ = A x + B u + w, y = C x + v, with white w ~ N(0, W) and v ~ N(0, V).

    Args:
        A: dynamics, (n, n).
        B: inputs, (n, m).
        W: process-noise covariance per step, (n, n), semidefinite; zero is legal.
        C: measurement, (p, n); omitted: the full state is measured.
        V: measurement-noise covariance, (p, p), semidefinite; omitted: exact measurement.
        dt: seconds per step; omitted: time is counted in steps.
        mean: initial mean, (n,); omitted: 0.
        covariance: initial covariance, (n, n); omitted: 0.
        input_limit: symmetric clip of each input at the plant, (m,), positive; omitted: none.
        function: x⁺ = f(x, u, w) of arrays (n,), (m,), (n,), w ~ N(0, W) drawn at every tick: a plant that is not
            linear. Policies are designed on A and B, which must be its derivatives by x and u at 0, an equilibrium;
            that by w is the identity wherever W is not 0. Omitted: A x + B u + w.

    Raises:
        ProblemError: wrong shape, not finite, indefinite; a growing mode that no input moves or no measurement shows;
            or a function that fails, does not rest at 0, or has another linearisation.

    Example:
        >>> Plant(A=[[2.0]], B=[[1.0]], W=[[0.01]]).inputs
        1
    """

    A: Array
    B: Array
    W: Array
    C: Array
    V: Array
    dt: float | None
    mean: Array
    covariance: Array
    input_limit: Array | None
    function: Dynamics | None
    full_state: bool = field(repr=False)

    def __init__(
        self,
        A: ArrayLike,
        B: ArrayLike,
        W: ArrayLike,
        C: ArrayLike | None = None,
        V: ArrayLike | None = None,
        dt: float | None = None,
        mean: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        input_limit: ArrayLike | None = None,
        function: Map | Dynamics | None = None,
    ) -> None:
        """Check and freeze."""
        _set_linear(self, A, B, C, V, mean, covariance, input_limit)
        object.__setattr__(self, "W", semidefinite("W", W, self.states, "(states, states)"))
        object.__setattr__(self, "dt", None if dt is None else number("dt", dt, 0.0))
        object.__setattr__(self, "function", None if function is None else _checked(function, self))
        _refuse_lost_modes(self, continuous=False)

    @property
    def states(self) -> int:
        """Number of states n."""
        return self.A.shape[0]

    @property
    def inputs(self) -> int:
        """Number of inputs m."""
        return self.B.shape[1]

    @property
    def outputs(self) -> int:
        """Number of measured outputs p."""
        return self.C.shape[0]

    def same_as(self, other: Plant) -> bool:
        """Tell whether the other plant has the same linear dynamics, noise and input limit."""
        keys = ("A", "B", "C", "W", "V", "input_limit")
        return all(self.agrees(key, other) for key in keys)

    def agrees(self, key: str, other: Plant) -> bool:
        """Tell whether the other plant has the same array of this name, or neither has one."""
        return np.array_equal(getattr(self, key), getattr(other, key))


@dataclass(frozen=True, eq=False)
class Jumps:
    """Poisson jumps of the state: at each event of rate λ the state moves by a zero-mean draw.

    Args:
        rate: events per second λ, positive.
        covariance: of one jump, (n, n), semidefinite.
        distribution: ``"normal"``, ``"uniform"`` or ``"two-point"``, each scaled to the covariance.

    Raises:
        ProblemError: rate not positive, or covariance not semidefinite.
    """

    rate: float
    covariance: Array
    distribution: JumpDistribution = "normal"

    def __post_init__(self) -> None:
        """Check and freeze."""
        number("jumps.rate", self.rate, 0.0)
        size = array("jumps.covariance", self.covariance, (None, None), "(states, states)").shape[0]
        object.__setattr__(self, "covariance", semidefinite("jumps.covariance", self.covariance, size))
        if self.distribution not in ("normal", "uniform", "two-point"):
            raise ProblemError(
                f"jumps.distribution is {self.distribution!r}; expected 'normal', 'uniform' or 'two-point'"
            )


@dataclass(frozen=True, eq=False)
class Prediction:
    """An actuator that runs a model between ticks: u = L x̂, dx̂/dt = (A + BL) x̂ of the plant it was designed for.

    Args:
        L: (inputs, states).
        dynamics: A + BL, (states, states).
    """

    L: Array
    dynamics: Array

    @classmethod
    def of(cls, plant: ContinuousPlant, L: Array) -> Prediction:
        """Return that of a plant's own model."""
        return cls(L, plant.A + plant.B @ L)


@dataclass(frozen=True, eq=False)
class JumpNoise:
    """What Poisson jumps add to a state within a tick: Σ_i e^{A(τ−t_i)} w_i over the jumps at times t_i.

    Args:
        A: dynamics between jumps, per second, (n, n).
        jumps: rate, covariance and law of a jump.
        period: τ, seconds per tick.
    """

    A: Array
    jumps: Jumps
    period: float


@dataclass(frozen=True, eq=False)
class ContinuousPlant:
    """A continuous-time plant dx = (A x + B u) dt + noise, sampled measurement y = C x + v.

    Args:
        A: dynamics, (n, n), per second.
        B: inputs, (n, m).
        W: intensity per second of the Wiener noise, (n, n), semidefinite; give W or jumps.
        jumps: Poisson jumps instead of Wiener noise.
        C: measurement, (p, n); omitted: the full state is measured.
        V: measurement-noise covariance of each sample, (p, p); omitted: exact measurement.
        mean: initial mean, (n,); omitted: 0.
        covariance: initial covariance, (n, n); omitted: 0.
        input_limit: symmetric clip of each input at the plant, (m,); omitted: none.

    Raises:
        ProblemError: wrong shape, not finite, indefinite; a growing mode that no input moves or no measurement shows; W
            and jumps both given.

    Example:
        >>> ContinuousPlant(A=[[0, 1], [0, 0]], B=[[0], [1]], W=[[0, 0], [0, 2.5]]).states
        2
    """

    A: Array
    B: Array
    W: Array
    jumps: Jumps | None
    C: Array
    V: Array
    mean: Array
    covariance: Array
    input_limit: Array | None
    full_state: bool = field(repr=False)

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
    ) -> None:
        """Check and freeze."""
        _set_linear(self, A, B, C, V, mean, covariance, input_limit)
        if W is None and jumps is None:
            raise ProblemError("W is missing; expected the noise intensity per second (zeros for none), or jumps")
        if jumps is not None:
            if W is not None:
                raise ProblemError("W and jumps are both given; expected one kind of noise: remove one")
            instance("jumps", jumps, Jumps)
            covariance = semidefinite("jumps.covariance", jumps.covariance, self.states, "(states, states)")
            W = jumps.rate * covariance
        object.__setattr__(self, "W", semidefinite("W", cast("ArrayLike", W), self.states, "(states, states)"))
        object.__setattr__(self, "jumps", jumps)
        _refuse_lost_modes(self, continuous=True)

    @property
    def states(self) -> int:
        """Number of states n."""
        return self.A.shape[0]

    @property
    def inputs(self) -> int:
        """Number of inputs m."""
        return self.B.shape[1]


@runtime_checkable
class StateSpaceLike(Protocol):
    """What `control.StateSpace` and `scipy.signal.StateSpace`/`dlti` have in common."""

    A: npt.NDArray[np.float64]
    B: npt.NDArray[np.float64]
    C: npt.NDArray[np.float64]
    D: npt.NDArray[np.float64]


def plant_from(
    system: object,
    W: ArrayLike,
    V: ArrayLike | None = None,
    mean: ArrayLike | None = None,
    covariance: ArrayLike | None = None,
    input_limit: ArrayLike | None = None,
) -> Plant | ContinuousPlant:
    """Make a plant of a `control.StateSpace` or a `scipy.signal.StateSpace`/`dlti`.

    A continuous system gives a ContinuousPlant (W is then an intensity), a discrete one a Plant.
    scipy's ``dt=None`` means continuous; python-control's ``dt=None`` (unspecified) is refused.

    Args:
        system: an object with A, B, C, D and dt, or one that ``to_ss`` converts.
        W: process noise, (n, n).
        V: measurement-noise covariance, (p, p); omitted: exact measurement.
        mean: initial mean, (n,).
        covariance: initial covariance, (n, n).
        input_limit: clip of each input, (m,).

    Returns:
        The plant.

    Raises:
        ProblemError: no such attributes, D ≠ 0, or an unspecified time base.

    Example:
        >>> import scipy.signal
        >>> plant_from(scipy.signal.dlti([[2.0]], [[1.0]], [[1.0]], [[0.0]], dt=0.1), W=[[1.0]]).dt
        0.1
    """
    if not isinstance(system, StateSpaceLike):
        to_state_space = getattr(system, "to_ss", None)  # transfer functions and zero-pole-gain systems
        if to_state_space is None:
            raise ProblemError(
                f"system is a {type(system).__name__}; expected a state-space object with A, B, C, D: "
                "convert it first, as with control.ss"
            )
        try:
            system = cast("StateSpaceLike", to_state_space())
        except (TypeError, ValueError) as error:  # improper, or a table of frequencies
            raise ProblemError(
                f"system is a {type(system).__name__} without a state space ({error}); "
                "expected an object with A, B, C, D, or a proper transfer function"
            ) from None
    if np.any(np.asarray(system.D) != 0):
        raise ProblemError("D is not zero; expected no direct feedthrough from input to measurement")
    dt: float | bool | None = getattr(system, "dt", None)
    if dt is None and not any(kind.__module__.startswith("scipy.") for kind in type(system).__mro__):
        raise ProblemError(
            "dt of the system is None, which is unspecified; expected 0 (continuous) or the seconds per step: "
            "make it anew with dt=0 or dt=…"
        )
    C = np.asarray(system.C, dtype=np.float64)
    if dt is None or (dt is not True and dt == 0):
        return ContinuousPlant(
            system.A, system.B, W, C=C, V=V, mean=mean, covariance=covariance, input_limit=input_limit
        )
    step = None if dt is True else float(dt)
    return Plant(system.A, system.B, W, C, V, step, mean, covariance, input_limit)


def _set_linear(
    plant: Plant | ContinuousPlant,
    A: ArrayLike,
    B: ArrayLike,
    C: ArrayLike | None,
    V: ArrayLike | None,
    mean: ArrayLike | None,
    covariance: ArrayLike | None,
    input_limit: ArrayLike | None,
) -> None:
    """Check and set what both kinds of plant share."""
    A = array("A", A, (None, None), "(states, states)")
    n = A.shape[0]
    if n == 0 or A.shape[1] != n:
        raise ProblemError(f"A has shape {A.shape}; expected a square matrix with at least one state")
    B = array("B", B, (n, None), "(states, inputs)")
    if B.shape[1] == 0:
        raise ProblemError("B has no columns; expected at least one input")
    C = frozen(np.eye(n)) if C is None else array("C", C, (None, n), "(outputs, states)")
    p = C.shape[0]
    if p == 0:
        raise ProblemError("C has no rows; expected at least one measured output (omit C to measure the full state)")
    limit = None if input_limit is None else array("input_limit", input_limit, (B.shape[1],), "(inputs,)")
    if limit is not None and (limit <= 0).any():
        raise ProblemError(f"input_limit is {limit.min():g}; expected positive limits (omit it for no limit)")
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
    }
    for key, value in values.items():
        object.__setattr__(plant, key, value)
    object.__setattr__(plant, "full_state", np.array_equal(C, np.eye(n)) and not plant.V.any())


def _checked(function: Map | Dynamics, plant: Plant) -> Dynamics:
    """Return a function whose linearisation is the plant's."""
    if not callable(function):
        raise ProblemError(f"function is {quoted(function)}; expected a function x, u, w → x⁺")
    found = function if isinstance(function, Dynamics) else Dynamics(function)
    found.check(plant.A, plant.B, plant.W)
    return found


def _refuse_lost_modes(plant: Plant | ContinuousPlant, continuous: bool) -> None:
    """Refuse a plant with a growing mode that no input moves or no measurement shows.

    Those on the edge of stability are for cost and noise to decide: they may leave one alone.
    """
    slow = Slow(plant.A, continuous)
    for A, B, verb, what, remedy in (
        (plant.A, plant.B, "stabilisable", "no input can move", "add an actuator, or remove the mode"),
        (plant.A.T, plant.C.T, "detectable", "no measurement shows", "add a sensor, or remove the mode"),
    ):
        lost = lost_modes(A, B, continuous, slow)
        lost = lost[lost.real > SCATTER * pace(A)] if continuous else lost[np.abs(lost) > 1 + SCATTER]
        if lost.size:
            matrices = "(A, B)" if verb == "stabilisable" else "(A, C)"
            raise ProblemError(
                f"{matrices} is not {verb}: {what} the mode at {mode_text(complex(lost[0]))}, which grows; "
                f"expected a {verb} plant; {remedy}"
            )
