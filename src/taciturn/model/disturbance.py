"""Plants extended by disturbances and set-points, and reference trajectories known at both ends of the network.

``follow`` gives a plant the exosystem of its disturbances and set-points. A policy estimates these disturbances, and
its cost counts the deviations from the states and inputs at which the outputs are at their set-points
(``lqg.followed``).

A slow ``Disturbance`` is what a controller with an integrator compensates by itself. The plant applies u + d instead of
u. Each entry of d is a Markov process with mean zero, d⁺ = e^{−h/T} d + noise, with the time constant T and a constant
standard deviation, also at the start of a run over a horizon or with a discount. The state of the plant becomes (x, d),
and the cost does not weight d.

A ``Reference`` r_k, f_k with r⁺ = A r + B f is stored at both ends of the network. The deviations x − r and u − f,
which the cost counts, have the dynamics of the plant. ``Tracking`` names the signals of a policy that contain r and f.

The step function of a nonlinear plant gets the same states (``DisturbedDynamics``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar, cast

import numpy as np

from taciturn._arrays import Array, ArrayLike, array, block_diagonal, instance, number, set_fields
from taciturn._display import Displayed
from taciturn._text import number_of
from taciturn.errors import ProblemError
from taciturn.model.cost import Cost
from taciturn.model.coverage import SIMULATED
from taciturn.model.dynamics import Dynamics
from taciturn.model.key import Rows, stated_as
from taciturn.model.operating_point import MovedDynamics, OperatingPoint
from taciturn.model.plant import ContinuousPlant, Plant, altered, counted_from
from taciturn.model.signals import Changes, Exosystem, ExternalDisturbance, SetPoint, Signal, loads_of

USUAL_STEPS = 1000.0  # default time constant in steps
MOST_STEPS = 1e6  # longest time constant in steps
USUAL_SHARE = 0.5  # default deviation, relative to the noise of a step as seen at the input


AnyPlant = TypeVar("AnyPlant", bound=Plant | ContinuousPlant)


@dataclass(frozen=True, eq=False, repr=False)
class Disturbance(Displayed):
    """A slowly varying disturbance that is added to each input of a plant.

    Args:
        time_constant: time constant T in seconds; default 1,000 steps.
        deviation: standard deviation in units of the input, (m,), or one number for all inputs; 0 for no disturbance.
            Default: half the deviation per step of the input noise that fits W best, the diagonal of B⁺W(B⁺)'.

    Raises:
        ProblemError: the time constant is not positive, or a deviation is negative.

    Example:
        >>> Disturbance(time_constant=100.0, deviation=0.1).deviation
        array(0.1)
    """

    time_constant: float | None = None
    deviation: Array | None = field(default=None, metadata=stated_as(float | list[float] | None))

    def __init__(self, time_constant: float | None = None, deviation: ArrayLike | None = None) -> None:
        """Validate and store the arguments."""
        if time_constant is not None:
            time_constant = number("disturbance.time_constant", time_constant, 0.0)
        if deviation is not None:
            deviation = array("disturbance.deviation", deviation, (None,) * np.ndim(deviation))
            if deviation.ndim > 1 or (deviation < 0).any():
                raise ProblemError(
                    f"disturbance.deviation is {deviation.tolist()}; expected a standard deviation of at least 0, or "
                    "one such number for each input"
                )
        set_fields(self, {"time_constant": time_constant, "deviation": deviation})

    @property
    def absent(self) -> bool:
        """True if the standard deviation is zero, so that there is no disturbance."""
        return self.deviation is not None and not self.deviation.any()

    def completed(self, plant: Plant | ContinuousPlant, period: float | None) -> Disturbance:
        """Fill in the default values for a plant. A continuous plant is sampled with the given period.

        Raises:
            ProblemError: the number of deviations is not that of the inputs, or the noise gives no default.
        """
        step = _seconds(plant, period)
        deviation = self.deviation
        if deviation is None:
            inverse = np.linalg.pinv(plant.B)
            seen = np.sqrt(np.maximum(np.diag(inverse @ plant.W @ inverse.T), 0.0))
            deviation = USUAL_SHARE * (seen / np.sqrt(step) if isinstance(plant, ContinuousPlant) else seen)
            if not deviation.all():
                raise ProblemError(
                    "disturbance.deviation is missing, and it cannot be derived from W, because some input has no "
                    "process noise; expected the standard deviation of the slow disturbance in the unit of the input, "
                    "or no disturbance"
                )
        elif deviation.ndim == 1 and len(deviation) != plant.inputs:
            raise ProblemError(
                f"disturbance.deviation has {number_of(len(deviation), 'entry')}; expected "
                f"{number_of(plant.inputs, 'entry')}, one for each input"
            )
        T = USUAL_STEPS * step if self.time_constant is None else self.time_constant
        if MOST_STEPS * step < T:
            raise ProblemError(
                f"disturbance.time_constant is {T:g} s, which is {T / step:.4g} steps; expected at most "
                f"{MOST_STEPS:g} steps, because averages extend over several time constants"
            )
        return Disturbance(T, np.broadcast_to(deviation, (plant.inputs,)))

    def text(self) -> str:
        """Write the time constant and the standard deviation as text."""
        sizes = [] if self.deviation is None else [f"{value:.4g}" for value in np.atleast_1d(self.deviation)]
        return f"time constant {self.time_constant:.4g} s, deviation {', '.join(sizes)}"

    def added_to(self, plant: Plant | ContinuousPlant, mission: bool = False) -> Plant | ContinuousPlant:
        """Extend the state x of a plant by the disturbance d, whose time constant and deviation must be given.

        Args:
            plant: the plant.
            mission: whether the cost depends on the start, where d has its stationary deviation. An average does not
                depend on it, and there d starts at zero.
        """
        assert self.time_constant is not None
        assert self.deviation is not None
        slow, spread = -1.0 / self.time_constant, self.deviation**2 if mission else 0.0
        if isinstance(plant, ContinuousPlant):
            return _with(plant, _at_inputs(plant, slow, -2.0 * slow * self.deviation**2), spread)
        kept = float(np.exp(slow * (plant.dt or 1.0)))
        return _with(plant, _at_inputs(plant, kept, (1.0 - kept**2) * self.deviation**2), spread)

    def stepped(self, plant: Plant | ContinuousPlant) -> Plant | ContinuousPlant:
        """Extend the state x of a plant by a constant disturbance d of the size of one standard deviation."""
        assert self.deviation is not None
        return _with(plant, _at_inputs(plant, float(isinstance(plant, Plant)), 0.0, self.deviation))

    def removed_from(self, plant: Plant) -> Plant:
        """Remove the disturbance d that ``added_to`` has added to the state of a plant."""
        n = plant.stated - plant.inputs
        function = None if plant.function is None else cast("DisturbedDynamics", plant.function.function).dynamics
        alone = Plant(
            plant.A[:n, :n], plant.B[:n], plant.W[:n, :n], plant.C[:, :n], plant.V, plant.dt, plant.mean[:n],
            plant.covariance[:n, :n], plant.input_limit, function, input_rate=plant.input_rate, D=plant.D,
        )  # fmt: skip
        return counted_from(alone, plant, lambda point: OperatingPoint(point.x[:n], point.u))


def padded(cost: Cost, inputs: int) -> Cost:
    """Extend a cost to the state (x, d) of a plant with disturbances d. The disturbances have weight zero."""
    rest = np.zeros((inputs, inputs))
    terminal = None if cost.terminal is None else block_diagonal(cost.terminal, rest)
    N = np.vstack([cost.N, rest])
    return Cost(block_diagonal(cost.Q, rest), cost.R, N, cost.horizon, terminal, cost.discount)


def _seconds(plant: Plant | ContinuousPlant, period: float | None) -> float:
    step = plant.dt if isinstance(plant, Plant) else period
    return 1.0 if step is None else step


def _at_inputs(plant: Plant | ContinuousPlant, kept: float, noise: Array | float, start: Array | float = 0.0) -> Signal:
    """Return signals that add to the inputs of a plant, each with dynamics, noise and start of its own."""
    m = plant.inputs
    return Signal(kept * np.eye(m), noise * np.eye(m), np.broadcast_to(start, (m,)), plant.B)


def _with(plant: Plant | ContinuousPlant, added: Signal, spread: Array | float = 0.0) -> Plant | ContinuousPlant:
    """Return the plant with the state (x, d) of signals at its inputs, whose start has the variance ``spread``."""
    (n, m), p = plant.B.shape, len(plant.C)
    A = np.block([[plant.A, added.entering("E", n)], [np.zeros((m, n)), added.S]])
    B, C = np.vstack([plant.B, np.zeros((m, m))]), np.hstack([plant.C, added.entering("G", p)])
    noise, rate = block_diagonal(plant.W, added.W), plant.input_rate
    mean = np.concatenate([plant.mean, added.start])
    covariance = block_diagonal(plant.covariance, spread * np.eye(m))

    def also(point: OperatingPoint) -> OperatingPoint:
        return OperatingPoint(np.concatenate([point.x, np.zeros(m)]), point.u)

    if isinstance(plant, ContinuousPlant):
        if plant.jumps is not None:
            raise ProblemError(
                "the plant has jumps, but a slow disturbance needs Gaussian noise; expected W instead of jumps, or "
                "no disturbance"
            )
        found = ContinuousPlant(
            A, B, noise, None, C, plant.V, mean, covariance, plant.input_limit, input_rate=rate, D=plant.D
        )
        return counted_from(_following(found, plant, m), plant, also)
    function = None if plant.function is None else DisturbedDynamics(plant.function, None, added.S)
    found = Plant(
        A, B, noise, C, plant.V, plant.dt, mean, covariance, plant.input_limit, function, input_rate=rate, D=plant.D
    )
    return counted_from(_following(found, plant, m), plant, also)


def _following(found: AnyPlant, plant: Plant | ContinuousPlant, more: int) -> AnyPlant:
    """Return a plant with more states that has the delays, the loads and the set-points of the plant it was made of."""
    loads = tuple(replace(one, E=np.pad(one.E, (0, more))) for one in plant.loads)
    found = altered(found, {"loads": loads, "transport": plant.transport})
    own = plant.exosystem
    if own is None:
        return found
    E, outputs = np.pad(own.E, ((0, more), (0, 0))), np.pad(own.outputs, ((0, 0), (0, more)))
    return altered(found, {"exosystem": replace(own, E=E, outputs=outputs)})


FOLLOWS = 1e-9  # tolerance of r⁺ = A r + B f, relative to the largest state


@dataclass(frozen=True, eq=False, repr=False)
class Reference(Displayed):
    """A reference trajectory: states r_0 … r_N and inputs f_0 … f_{N−1}, stored at both ends of the network.

    Args:
        states: reference states r_k, (steps + 1, n), in the units of the plant.
        inputs: feedforward inputs f_k, (steps, m), with r_{k+1} = A r_k + B f_k in deviations from the operating point.

    Raises:
        ProblemError: if the lengths of states and inputs do not match.
    """

    states: Array = field(metadata=stated_as(Rows | None))
    inputs: Array = field(metadata=stated_as(Rows | None))

    def __init__(self, states: ArrayLike, inputs: ArrayLike) -> None:
        """Validate and store the arguments."""
        fed = array("reference.inputs", inputs, (None, None), "(steps, inputs)")
        found = array("reference.states", states, (len(fed) + 1, None), "(steps + 1, states)")
        set_fields(self, {"states": found, "inputs": fed})

    def relative_to(self, plant: Plant) -> Reference:
        """Express the trajectory as deviations from the operating point of a plant."""
        point = plant.operating_point
        fits = (self.states.shape[1], self.inputs.shape[1]) == (plant.states, plant.inputs)  # otherwise check raises
        return self if point is None or not fits else Reference(self.states - point.x, self.inputs - point.u)

    def check(self, plant: Plant, horizon: int) -> None:
        """Check that the trajectory satisfies the plant's equation r_{k+1} = A r_k + B f_k in ``horizon`` steps.

        Raises:
            ProblemError: if a size or the length differs, or a state does not follow from the step before.
        """
        SIMULATED.check(self)
        for name, found, wanted in (
            ("inputs", self.inputs.shape, (horizon, plant.inputs)),
            ("states", self.states.shape, (horizon + 1, plant.states)),
        ):
            if found != wanted:
                raise ProblemError(
                    f"reference.{name} has shape {found}; expected the shape {wanted}, from the horizon and the "
                    "dimensions of the plant"
                )
        caused, pushes = self.states[:-1] @ plant.A.T, self.inputs @ plant.B.T
        miss = np.abs(caused + pushes - self.states[1:]).max(axis=1)
        allowed = FOLLOWS * max(float(np.abs(part).max()) for part in (self.states, caused, pushes))
        if (miss > allowed).any():
            step = int(np.argmax(miss > allowed))
            raise ProblemError(
                f"reference.states differs by {miss[step]:.3g} at step {step + 1} from A r + B f of step {step}; "
                f"expected states r and inputs f with r⁺ = A r + B f within {allowed:.3g}: compute the states from the "
                "inputs with all digits"
            )


@dataclass(frozen=True, eq=False, repr=False)
class Tracking(Displayed):
    """Names of the signals with the reference state and input of a policy, from which deviations of x and u cost.

    Args:
        state: name of the signal with the reference state r_k.
        input: name of the signal with the feedforward input f_k.
        final: final reference state r_N, (n,).
    """

    state: str
    input: str
    final: Array


def follow(
    plant: AnyPlant,
    outputs: ArrayLike | None = None,
    value: ArrayLike | None = None,
    disturbances: Sequence[ExternalDisturbance] | ExternalDisturbance = (),
    changes: Changes | None = None,
) -> AnyPlant:
    """Extend a plant by external disturbances that the input shall compensate, and by set-points of some outputs.

    Args:
        plant: the plant.
        outputs: C_z of the outputs z = C_z x that are to be at their set-points in spite of the disturbances, (z, n);
            default: the measured outputs, C x + D u for a plant with a direct feedthrough.
        value: the set-points, (z,), in the units of the plant; default: z at its operating point. With steps at random
            times, those at the start.
        disturbances: the disturbances, or the only one.
        changes: how the set-points change while the loop runs; None for constant set-points.

    Returns:
        The plant. A policy for it estimates the disturbances, and its cost weights the deviations from the states and
        inputs at which z is at the set-points.

    Raises:
        ProblemError: a size does not fit the plant.

    Source: francis1977

    Example:
        >>> plant = Plant([[0.9]], [[1.0]], [[0.1]], C=[[1.0]], V=[[0.1]])
        >>> follow(plant, value=[2.0], disturbances=[ExternalDisturbance([1.0], wander=1e-3)]).exosystem.start
        array([0., 2.])
    """
    instance("plant", plant, Plant, ContinuousPlant)
    listed = (disturbances,) if isinstance(disturbances, ExternalDisturbance) else disturbances
    for one in listed:
        instance("disturbances", one, ExternalDisturbance)
    if plant.exosystem is not None:
        raise ProblemError(
            "the plant already has disturbances or set-points; expected a plant without them: give all disturbances "
            "and set-points in one call"
        )
    fed = plant.D if outputs is None else None
    target = SetPoint(plant.C if outputs is None else outputs, value, changes, D=fed)
    return with_target(plant, target, listed)


def with_target(plant: AnyPlant, target: SetPoint, disturbances: Sequence[ExternalDisturbance]) -> AnyPlant:
    """Extend a plant by the states of external disturbances and set-points."""
    if target.outputs.shape[1] != len(plant.A):
        raise ProblemError(
            f"reference.outputs has {number_of(target.outputs.shape[1], 'column')}; expected "
            f"{number_of(len(plant.A), 'column')}, one for each "
            "state"
        )
    found = Exosystem.of(disturbances, target, len(plant.C), plant.continuous, plant.operating_point)
    loads = loads_of(disturbances, len(found.S), len(plant.C))
    alone = not len(found.S) and any(one.hidden for one in disturbances)  # nothing that a design would know
    return altered(plant, {"exosystem": None if alone else found, "loads": loads})


@dataclass(frozen=True, eq=False, repr=False)
class DisturbedDynamics(Displayed):
    """A nonlinear step function with disturbances d: (x, d), u, (w, w_d) → (f(x, u, w) + E d, S d + w_d)."""

    dynamics: Dynamics  # f
    E: Array | None  # effect of the signals on the next state, (n, q); None if they add to the inputs: f(x, u + d, w)
    S: Array  # dynamics of the signals, (q, q)

    def __call__(self, x: Any, u: Any, w: Any) -> Any:
        """Return the next states of the plant and of the signals."""
        n = len(x) - len(self.S)
        d: Any = x[n:]
        moved: Any = self.dynamics.function(x[:n], u if self.E is not None else u + d, w[:n])
        found = np.array(list(moved))
        return np.array([*(found if self.E is None else found + self.E @ d), *(self.S @ d + w[n:])])

    @staticmethod
    def of(function: Dynamics, E: Array, S: Array, rest: Array) -> Dynamics:
        """Extend a plant's step function by disturbances, and shift it to the same operating point as before."""
        moved = function.function
        if not isinstance(moved, MovedDynamics):
            return Dynamics(DisturbedDynamics(function, E, S))
        x, to = (np.concatenate([one, rest]) for one in (moved.x, moved.rest))
        return Dynamics(MovedDynamics(Dynamics(DisturbedDynamics(moved.dynamics, E, S)), x, moved.u, to))
