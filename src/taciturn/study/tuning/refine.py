"""A correction at full precision of the parameter that a search has found, or both sides of a jump."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from taciturn.study.tuning.goal import EXACT
from taciturn.study.tuning.search import EFFORT, PASSED, Look, Search
from taciturn.study.tuning.trials import LONGER

STRIDE = 0.1  # longest step of a correction in log(value)
NARROW = 1e-5  # width in log(value) below which a change at full precision counts as a jump
ROUNDS = 3  # corrections
AIMED, FAR = 3.0, 8.0  # standard errors below the budget: target of a correction, and most


class Refinement:
    """Trials of a search at full precision.

    Args:
        search: the search.
        standard_error: absolute standard error of the cost.
    """

    def __init__(self, search: Search, standard_error: float | None) -> None:
        """Try nothing yet."""
        self._search, self._standard_error = search, standard_error

    def _at(self, place: float) -> Look:
        """Return the trial at a place."""
        return self._search.try_at(self._search.value(place), standard_error=self._standard_error)

    def refine(self, low: Look, high: Look) -> tuple[Look, Look, float | None, float | None]:
        """Repeat trials at full precision, and correct their values for the remaining distance from the budget.

        Args:
            low: trial that is not above the budget.
            high: trial on the other side of a jump, or the same trial.

        Returns:
            The trial that meets the budget twice, or those on both sides of a jump; the standard error of the value
            as a solution of the budget, or None if the budget does not depend on the value here; and the derivative of
            the cost with respect to the rate, or None if the rate does not change or jumps.
        """
        tried = [] if low is high else [self.measure(look) for look in (low, high)]
        place = self._search.place(low.value)
        span = self._search.goal.span
        around = [self._search.look(self._search.value(place + step)) for step in (-span, span)]
        near = [one for one in around if one is not None]
        slope = pace = blur = 0.0
        if len(near) == 2:
            slope = (near[1].above - near[0].above) / (2 * span)
            rates = [self._search.goal.use(one.evaluation).value for one in near]
            pace = (rates[1] - rates[0]) / (2 * span)
        measured = self._search.try_at(low.value, LONGER * EFFORT) if low.error and slope else low
        for _ in range(0 if tried else ROUNDS):
            blur = measured.error  # error of the trial that determines the next place
            missing = measured.above + AIMED * blur
            place -= float(np.clip(missing / slope, -STRIDE, STRIDE)) if slope else 0.0
            measured = self._at(place)
            tried.append(measured)
            if self._nearly(measured) or not slope:
                break
        else:
            measured, beyond = self._straddle(tried)
            if measured is not beyond:
                return measured, beyond, 0.0, None
            blur = measured.error
        changes = slope / (measured.value - self._search.tuning.least)
        error = blur / abs(changes) if changes else None
        costs = [one.evaluation.cost.value for one in near]
        along = (costs[1] - costs[0]) / (2 * span) / pace if pace else None
        return measured, measured, error, along

    def _nearly(self, look: Look) -> bool:
        """Return whether a trial is below the budget by more than its error, and not by much more."""
        return self._search.keeps(look) and look.above >= -max(FAR * look.error, EXACT * self._search.goal.budget)

    def _straddle(self, tried: list[Look]) -> tuple[Look, Look]:
        """Return a trial that nearly meets the budget twice, or else the trials on both sides of a jump.

        Args:
            tried: trials at full precision.
        """
        closest: dict[bool, Look] = {}  # by whether the trial is below the budget

        def add(look: Look) -> None:
            side = self._search.keeps(look)
            if side not in closest or abs(look.above) < abs(closest[side].above):
                closest[side] = look

        for look in tried:
            add(look)
        for look in self._beyond(next(iter(closest.values()))):
            if len(closest) < 2:
                add(self.measure(look))
        while len(closest) == 2 and not self._nearly(closest[True]):
            ends = [self._search.place(look.value) for look in closest.values()]
            if abs(ends[1] - ends[0]) < NARROW:
                break
            middle = self._at(sum(ends) / 2)
            closest[self._search.keeps(middle)] = middle
        low, high = closest.get(True), closest.get(False)
        if low is not None and (high is None or self._nearly(low)):
            return low, low  # also at the limit of the range
        assert high is not None
        if low is not None and high.above > 0:
            return low, high
        missed = replace(high, evaluation=replace(high.evaluation, reached=False))
        return missed, missed

    def _beyond(self, here: Look) -> list[Look]:
        """Return the trials on the other side of the budget, those of the nearest values first."""
        below = self._search.keeps(here)
        found = [look for look in self._search.looks() if self._search.keeps(look) != below]
        return sorted(found, key=lambda look: abs(self._search.place(look.value) - self._search.place(here.value)))

    def measure(self, look: Look) -> Look:
        """Return a trial of the same value of the tuning parameter at full precision."""
        return self._search.try_at(look.value, standard_error=self._standard_error)

    def measure_within(self, look: Look) -> Look:
        """Return a trial at full precision within the budget, at this integer or at a neighbouring one."""
        found, step = self.measure(look), -1 if self._search.rising else 1
        for away in range(1, PASSED if self._search.tuning.whole else 1):
            value = int(look.value) + away * step
            if found.above <= EXACT * self._search.goal.budget or value < self._search.tuning.least:
                break
            if (other := self._search.look(value)) is not None:
                found = self.measure(other)
        return found
