"""The step counter of policies whose base or filter changes from step to step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn.design.estimation import Transient, by_clock, count_ticks, filter_from_the_start
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.kalman import Filter
from taciturn.model.policy import Location
from taciturn.model.trigger import Matrix


@dataclass(frozen=True, eq=False, repr=False)
class StepCounter(Displayed):
    """The step counter of a policy: the phase of its base, and the gains of a filter that starts with the run.

    Args:
        pattern: whether the base attempts in each step of its cycle, or of the horizon.
        phases: step of the pattern in each state of the counter.
        repeats: state with which the counter continues after its last state; None: it stops.
        filter: the filter from the start of the run, or None for the steady-state filter.
    """

    pattern: tuple[bool, ...]
    phases: tuple[int, ...]
    repeats: int | None = 0
    filter: Transient | None = None

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
