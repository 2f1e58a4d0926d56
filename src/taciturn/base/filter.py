"""The filter as policy steps, at the node that decides, and the step counter of what changes from step to step.

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
from taciturn.model.steps import Assign, Location, Step
from taciturn.model.theory import INNOVATION, Innovations
from taciturn.model.trigger import Matrix, Scheduled

ESTIMATE, HELD = "estimate", "held"
SEND, CLOCK, DEVIATION = "send", "clock", "deviation"
COLLOCATED: tuple[frozenset[str], ...] = (frozenset({"sensor", "controller"}),)


@dataclass(frozen=True, eq=False, repr=False)
class FilterSteps(Displayed):
    """Policy steps that compute the estimate of the state from the measurement."""

    correct: tuple[Step, ...]  # policy steps before the control is computed
    predict: tuple[Step, ...]  # policy steps after the control is computed
    initial: dict[str, Array]  # initial values of the memories
    innovations: Innovations | None  # white innovations of the filter, or None


def estimate_state(
    plant: Plant, steady: Filter | None, at: str = "controller", gain: Matrix | None = None
) -> FilterSteps:
    """Return the policy steps of a steady filter, or of one with the given gains."""
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
    """Return the outputs of a plant as a sum of the measurement and of the set-points that the controller is given."""
    unit, p = np.eye(plant.outputs), plant.sensed
    if p == plant.outputs:
        return {"y": unit}
    if at != "controller":
        raise ProblemError(
            f"the set-points change (reference.steps or file), but the {at} runs the filter, and only the controller "
            "is given the set-points; expected a policy whose filter is at the controller, or constant set-points"
        )
    return {"y": unit[:, :p], REFERENCE: unit[:, p:]}


@dataclass(frozen=True, eq=False, repr=False)
class Transient(Displayed):
    """The Kalman filter from the initial state on."""

    gains: Array  # gains of the innovations, (steps, n, p)
    innovation: Array  # covariances of the innovations, (steps, p, p)
    posterior: Array  # covariances of the estimation error, (steps, n, n)
    start: int | None  # step from which all repeat, or None with a horizon


def filter_from_the_start(plant: Plant, cost: Cost) -> Transient:
    """Return the Kalman filter over a horizon, or until its gains repeat or later steps do not count any more."""
    prior, start = follow_every_query(plant, plant.covariance, cost.horizon, cost.discount)
    gains = Predictor(plant).correction(prior)
    left = np.eye(plant.states) - gains @ plant.C
    posterior = left @ prior @ left.swapaxes(1, 2) + gains @ plant.V @ gains.swapaxes(1, 2)
    return Transient(gains, plant.C @ prior @ plant.C.T + plant.V, posterior, start)


def count_ticks(ticks: int, start: int | None) -> Location:
    """Return a step counter 0, 1, …, ``ticks`` − 1 that then continues at ``start``, or stops if ``start`` is None."""
    table = np.arange(1, ticks + 1)
    table[-1] = ticks - 1 if start is None else start
    return Location(CLOCK, table)


def by_clock(values: Array) -> Matrix:
    """Return a constant matrix unchanged, or a table with one matrix for each step of the step counter."""
    return values if values.ndim == 2 else Scheduled(CLOCK, values)


@dataclass(frozen=True, eq=False, repr=False)
class StepCounter(Displayed):
    """The step counter of a policy: the phase of its base, and the gains of a filter that starts with the run."""

    pattern: tuple[bool, ...]  # whether the base attempts in each step of its cycle, or of the horizon
    phases: tuple[int, ...]  # step of the pattern in each state of the counter
    repeats: int | None = 0  # state with which the counter continues after its last state; None: it stops
    filter: Transient | None = None  # the filter from the start of the run, or None for the steady-state filter

    @staticmethod
    def of(problem: Discrete, every: int) -> StepCounter:
        """Return the step counter for a cost, and a base that attempts at every q-th step."""
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
        """The step counter, if anything depends on it."""
        return (count_ticks(len(self.phases), self.repeats),) if len(self.phases) > 1 or self.repeats is None else ()

    @property
    def gains(self) -> Matrix | None:
        """Gains of the filter, or None for those of the steady-state filter."""
        return None if self.filter is None else by_clock(self._table(self.filter.gains))

    def innovation(self, steady: Filter) -> Matrix:
        """Return the covariance of the innovations."""
        return steady.innovation if self.filter is None else by_clock(self._table(self.filter.innovation))

    def _table(self, values: Array) -> Array:
        assert self.filter is not None
        last, first = len(values), self.filter.start
        index = np.arange(len(self.phases))
        if first is not None:
            index = np.where(index < last, index, first + (index - first) % (last - first))
        return values[index]
