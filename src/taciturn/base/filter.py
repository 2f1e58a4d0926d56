"""Policy steps of the filter at the node that decides, and the step counter that selects time-varying gains.

The node estimates the state x̂_k = E[x_k | y_0, …, y_k] by a Kalman filter with the innovation ν and the gain g:

    ν = y − C x̂⁻,    x̂ = x̂⁻ + g ν,    x̂⁻⁺ = A x̂ + B û,

where û is the input that the actuator applies (``held``). If the whole state is measured, x̂ = y. For a total over a
horizon or with a discount, the filter starts with the run: its gains are a table that a step counter reads, until they
repeat. The counter also holds the phase of a base that attempts to send at every q-th step only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.kalman import Filter
from taciturn.lqg.queries import Predictor, follow_every_query
from taciturn.model.cost import Cost
from taciturn.model.network import REFERENCE
from taciturn.model.plant import Plant
from taciturn.model.policy import ESTIMATE as ESTIMATE
from taciturn.model.policy import HELD as HELD
from taciturn.model.steps import Assign, Location, Step
from taciturn.model.theory import INNOVATION, Innovations
from taciturn.model.trigger import Matrix, Scheduled

SEND, CLOCK, DEVIATION = "send", "clock", "deviation"
COLLOCATED: tuple[frozenset[str], ...] = (frozenset({"sensor", "controller"}),)


@dataclass(frozen=True, eq=False, repr=False)
class FilterSteps(Displayed):
    """The policy steps that compute the state estimate from the measurements."""

    correct: tuple[Step, ...]  # policy steps before the control is computed
    predict: tuple[Step, ...]  # policy steps after the control is computed
    initial: dict[str, Array]  # initial values of the memories
    innovations: Innovations | None  # white innovations of the filter, or None


def estimate_state(
    plant: Plant, steady: Filter | None, at: str = "controller", gain: Matrix | None = None
) -> FilterSteps:
    """Return the policy steps of the steady-state Kalman filter, or of a filter with other given gains."""
    if plant.full_state:
        measured = Assign(at, ESTIMATE, {"y": np.eye(plant.states)})
        return FilterSteps((measured,), (), {}, None)
    gain = steady.gain if gain is None and steady is not None else gain
    assert gain is not None
    correct = (
        Assign(at, INNOVATION, {**outputs_of(plant, at), "prior": -plant.C}),
        Assign(at, ESTIMATE, {"prior": np.eye(plant.states), INNOVATION: gain}),
    )
    predict = (Assign(at, "prior", {ESTIMATE: plant.A, HELD: plant.B}),)
    innovations = None
    if steady is not None and gain is steady.gain:
        innovations = Innovations(INNOVATION, steady.innovation, ESTIMATE, steady.posterior)
    return FilterSteps(correct, predict, {"prior": plant.mean}, innovations)


def outputs_of(plant: Plant, at: str = "controller") -> dict[str, Array]:
    """Return the plant's outputs as a sum of signals: the measurement, and the set-points that the controller reads."""
    unit, p = np.eye(plant.outputs), plant.sensed
    if p == plant.outputs:
        return {"y": unit}
    if at != "controller":
        raise ProblemError(
            f"the set-points change (reference.steps or reference.file), but the node {at} runs the filter, and only "
            "the controller receives the set-points; expected a policy whose filter is at the controller, or constant "
            "set-points"
        )
    return {"y": unit[:, :p], REFERENCE: unit[:, p:]}


@dataclass(frozen=True, eq=False, repr=False)
class Transient(Displayed):
    """The time-varying Kalman filter that starts with the mean and covariance of the initial state."""

    gains: Array  # gains of the innovations, (steps, n, p)
    innovation: Array  # covariances of the innovations, (steps, p, p)
    posterior: Array  # covariances of the estimation error, (steps, n, n)
    start: int | None  # step from which all repeat, or None with a horizon


def filter_from_the_start(plant: Plant, cost: Cost) -> Transient:
    """Compute the time-varying Kalman filter: over the horizon, or until its gains repeat or later weights are
    negligible.
    """
    prior, start = follow_every_query(plant, plant.covariance, cost.horizon, cost.discount)
    gains = Predictor(plant).correction(prior)
    left = np.eye(plant.states) - gains @ plant.C
    posterior = left @ prior @ left.swapaxes(1, 2) + gains @ plant.V @ gains.swapaxes(1, 2)
    return Transient(gains, plant.C @ prior @ plant.C.T + plant.V, posterior, start)


def count_ticks(ticks: int, start: int | None) -> Location:
    """Return a step counter 0, 1, …, ``ticks`` − 1. It then continues at ``start`` or, if that is None, stops."""
    table = np.arange(1, ticks + 1)
    table[-1] = ticks - 1 if start is None else start
    return Location(CLOCK, table)


def by_clock(values: Array) -> Matrix:
    """Return one matrix unchanged. Return several matrices as a table from which the step counter selects one."""
    return values if values.ndim == 2 else Scheduled(CLOCK, values)


@dataclass(frozen=True, eq=False, repr=False)
class StepCounter(Displayed):
    """Step counter of a policy. It selects the gains of a time-varying filter, and the steps at which the base loop
    sends.
    """

    pattern: tuple[bool, ...]  # whether the base attempts in each step of its cycle, or of the horizon
    phases: tuple[int, ...]  # step of the pattern in each state of the counter
    repeats: int | None = 0  # state with which the counter continues after its last state; None: it stops
    filter: Transient | None = None  # the filter from the start of the run, or None for the steady-state filter

    @staticmethod
    def of(problem: Discrete, every: int) -> StepCounter:
        """Return the step counter for a problem whose base loop sends at every ``every``-th step."""
        cost, plant = problem.cost, problem.plant
        pattern = tuple(k == 0 for k in range(every))
        if not cost.mission:
            return StepCounter(pattern, tuple(range(every)))
        found = None if plant.full_state else filter_from_the_start(plant, cost)
        if cost.horizon is not None:
            return StepCounter(
                tuple(k % every == 0 for k in range(cost.horizon)), tuple(range(cost.horizon)), None, found
            )
        length = 0 if found is None else len(found.gains)
        states = -(-length // every) * every + every
        return StepCounter(pattern, tuple(k % every for k in range(states)), states - every, found)

    @property
    def locations(self) -> tuple[Location, ...]:
        """The step counter as a discrete state of the policy; empty if nothing in the policy depends on the step."""
        return (count_ticks(len(self.phases), self.repeats),) if len(self.phases) > 1 or self.repeats is None else ()

    @property
    def gains(self) -> Matrix | None:
        """Gains of the time-varying filter; None if the policy uses the filter in steady state."""
        return None if self.filter is None else by_clock(self._table(self.filter.gains))

    def innovation(self, steady: Filter) -> Matrix:
        """Return the covariance of the innovations: of the time-varying filter or, without one, of the filter
        ``steady``.
        """
        return steady.innovation if self.filter is None else by_clock(self._table(self.filter.innovation))

    def _table(self, values: Array) -> Array:
        assert self.filter is not None
        last, first = len(values), self.filter.start
        index = np.arange(len(self.phases))
        if first is not None:
            index = np.where(index < last, index, first + (index - first) % (last - first))
        return values[index]
