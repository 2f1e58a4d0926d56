"""Search for a parameter that meets a budget: bracketing, root finding, and a correction at full precision."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Never

import numpy as np

from taciturn import _scipy
from taciturn._display import Displayed
from taciturn._progress import Progress, Stages
from taciturn._text import per_unit
from taciturn.design.kind import TradeoffParameter
from taciturn.errors import ProblemError, TaciturnError, UnstableError
from taciturn.problem import Problem
from taciturn.study.evaluation import Evaluation
from taciturn.study.tuning.goal import EXACT, Goal
from taciturn.study.tuning.trials import look_at

LEFT = 0.93  # share of the remaining progress that a trial leaves; the number of trials is not known in advance
EFFORT = 2_000_000  # steps of a trial; all trials use the same draws
LONGER = 8  # factor on these steps if a loop has not settled, and for the last trial
FIRST, GROWTH, FARTHEST = (
    1.4,
    1.5,
    45.0,
)  # of the bracketing in log(value): first step, growth, farthest
HALVINGS = 12  # bisections towards the limit of values for which a policy can be designed
CLOSE = 0.25  # largest error of a root, in standard errors of a trial
JUMP = 1e-11  # width in log(value) below which a change counts as a jump
SPAN, STRIDE = 0.02, 0.1  # in log(value): half-width for slopes, and longest step of a correction
ROUNDS = 3  # corrections at full precision
KEPT, AIMED, FAR = 2.0, 3.0, 8.0  # standard errors below the budget: least, target of a correction, and most
PASSED = 20  # integers on either side that are skipped if no policy can be designed for them
ALIKE = 1e-3  # share of the range of all results within which a result counts as an end of this range
SURE = 3.0  # standard errors by which a trial at the limit of the range may miss the budget


@dataclass(frozen=True, eq=False, repr=False)
class Look(Displayed):
    """A trial of one value of the tuning parameter: its evaluation, and the excess over the budget."""

    value: float
    evaluation: Evaluation
    above: float
    error: float


class Search:
    """A search over values of the tuning parameter.

    Args:
        problem: the problem that is tuned.
        tuning: the tuning parameter.
        goal: the budget.
        seed: seed of the random draws.
        progress: callback that receives the fraction done.
    """

    def __init__(
        self, problem: Problem, tuning: TradeoffParameter, goal: Goal, seed: int, progress: Progress | None
    ) -> None:
        """Prepare the search; no value is tried yet."""
        self.problem, self.tuning, self.goal, self.seed, self.progress = problem, tuning, goal, seed, progress
        self.rising = tuning.falls == goal.limits_cost  # whether the rate or cost increases with the value
        self._seen: dict[float, Look | TaciturnError] = {}
        self._stage = Stages(progress, 0.0, 1 - LEFT)  # of the present trial

    def look(self, value: float) -> Look | None:
        """Return the trial of a value, or None if no policy can be designed or the loop diverges."""
        if value not in self._seen:
            try:
                self._seen[value] = self._settled(value)
            except TaciturnError as error:
                self._seen[value] = error
            self._stage(1.0)
            self._stage = Stages(self.progress, *(1 - LEFT ** (len(self._seen) + k) for k in (0, 1)))
        found = self._seen[value]
        return found if isinstance(found, Look) else None

    def _settled(self, value: float) -> Look:
        found = self._look(value, EFFORT)
        if not found.evaluation.reached:
            found = self._look(value, LONGER * EFFORT)
        if not found.evaluation.reached:
            given = f"{self.problem.kind} with {self.tuning.name} = {value:g}"
            raise UnstableError(f"the mean cost of {given} does not settle within {LONGER * EFFORT} steps")
        return found

    def _look(self, value: float, steps: int | None = None, standard_error: float | None = None) -> Look:
        changed = self.problem.changed({self.tuning.name: value})
        evaluation = look_at(changed, self.seed, steps, standard_error, self._stage)
        found = self.goal.of(evaluation)
        return Look(value, evaluation, found.value - self.goal.budget, found.standard_error + found.error)

    def meets_exactly(self, look: Look) -> bool:
        """Return whether a trial equals the budget within its error."""
        return abs(look.above) <= max(EXACT * self.goal.budget, CLOSE * look.error)

    def keeps(self, look: Look) -> bool:
        """Return whether a trial is below the budget by more than its error."""
        return look.above + KEPT * look.error <= EXACT * self.goal.budget

    def bracket(self) -> tuple[Look, Look]:
        """Return two trials that bracket the budget: one that is not above it, and one that is above it.

        Raises:
            ProblemError: no value reaches the budget.
        """
        here = self._start()
        self.expect_possible(here.evaluation)
        if self.meets_exactly(here):
            return here, here
        outwards = -1.0 if (here.above > 0) == self.rising else 1.0
        found = self._walk(here, outwards)
        if found is None:
            nearest = min(self._looks(), key=lambda look: abs(look.above))
            if abs(nearest.above) > SURE * nearest.error:
                self._refuse()
            return nearest, nearest  # such as a rate of 1, which is the limit of a vanishing threshold
        before, after = found
        if self.meets_exactly(after):
            return after, after
        low, high = (before, after) if before.above <= 0 else (after, before)
        while self.tuning.whole and (middle := self._between(low, high)) is not None:
            low, high = (middle, high) if middle.above <= EXACT * self.goal.budget else (low, middle)
        return low, high

    def _between(self, low: Look, high: Look) -> Look | None:
        """Return the trial at the integer nearest to the middle for which a policy can be designed, or None."""
        first, last = sorted((int(low.value), int(high.value)))
        for away in range(min(PASSED, (last - first) // 2)):
            for value in (middle := (first + last) // 2) - away, middle + away:
                look = self.look(value) if first < value < last else None
                if look is not None:
                    return look
        return None

    def close_in(self, low: Look, high: Look) -> tuple[Look, Look]:
        """Return the trials on both sides of a jump, or the same trial twice if it meets the budget exactly."""
        ends = [low, high]

        def above(place: float) -> float:
            look = self.look(self._value(place))
            if look is None:
                self._refuse()
            if self.meets_exactly(look):
                ends[:] = [look, look]
                return 0.0
            side = int(look.above > 0)
            if abs(self._place(look.value) - self._place(ends[1 - side].value)) < self._width(ends):
                ends[side] = look
            return look.above

        places = self._place(low.value), self._place(high.value)
        if above(places[0]) * above(places[1]) > 0:  # at the limit of the range, rounding decides the side
            nearest = min(ends, key=lambda look: abs(look.above))
            return nearest, nearest
        _scipy.crossing(above, *places, JUMP)
        return ends[0], ends[1]

    def _width(self, ends: list[Look]) -> float:
        return abs(self._place(ends[0].value) - self._place(ends[1].value))

    def refine(self, look: Look, standard_error: float | None) -> tuple[Look, float | None, float | None]:
        """Repeat a trial at full precision, and correct its values for the remaining distance from the budget.

        Also return the standard error of its value as a solution of the budget, or None if the budget does not depend
        on the value here, and the derivative of the cost with respect to the rate, or None if the rate does not change.
        """
        place = self._place(look.value)
        around = [self.look(self._value(place + step)) for step in (-SPAN, SPAN)]
        near = [one for one in around if one is not None]
        slope = pace = blur = 0.0
        if len(near) == 2:
            slope = (near[1].above - near[0].above) / (2 * SPAN)
            rates = [self.goal.use(one.evaluation).value for one in near]
            pace = (rates[1] - rates[0]) / (2 * SPAN)
        measured = self._look(look.value, LONGER * EFFORT) if look.error and slope else look
        for _ in range(ROUNDS):
            blur = measured.error  # error of the trial that determines the next place
            missing = measured.above + AIMED * blur
            place -= float(np.clip(missing / slope, -STRIDE, STRIDE)) if slope else 0.0
            measured = self._look(self._value(place), standard_error=standard_error)
            near_enough = measured.above >= -max(FAR * measured.error, EXACT * self.goal.budget)
            if (self.keeps(measured) and near_enough) or not slope:
                break
        else:
            if not self.keeps(measured):
                measured = replace(measured, evaluation=replace(measured.evaluation, reached=False))
        changes = slope / (measured.value - self.tuning.least)
        error = blur / abs(changes) if changes else None
        costs = [one.evaluation.cost.value for one in near]
        along = (costs[1] - costs[0]) / (2 * SPAN) / pace if pace else None
        return measured, error, along

    def measure(self, look: Look, standard_error: float | None) -> Look:
        """Return a trial of the same value of the tuning parameter at full precision."""
        return self._look(look.value, standard_error=standard_error)

    def measure_within(self, look: Look, standard_error: float | None) -> Look:
        """Return a trial at full precision within the budget, at this integer or at a neighbouring one."""
        found, step = self.measure(look, standard_error), -1 if self.rising else 1
        for away in range(1, PASSED if self.tuning.whole else 1):
            value = int(look.value) + away * step
            if found.above <= EXACT * self.goal.budget or value < self.tuning.least:
                break
            if (other := self.look(value)) is not None:
                found = self.measure(other, standard_error)
        return found

    def _start(self) -> Look:
        """Return the trial of the given value, or of the nearest value for which a policy can be designed."""
        given = self.problem.parameters.get(self.tuning.name)
        usual = max(self.tuning.least, 1) if self.tuning.whole else self.tuning.least + 1.0
        start = given if isinstance(given, int | float) and given > self.tuning.least else usual
        for k in range(9):
            for sign in (1.0, -1.0):
                found = self.look(self._moved(start, sign * k * FIRST))
                if found is not None:
                    return found
        why = self._seen[start]
        assert isinstance(why, TaciturnError)
        raise why

    def expect_start(self) -> None:
        """Reject a budget that no value can meet, before a search of more than this parameter.

        Raises:
            ProblemError: no policy can be designed, or the budget is beyond that of sending at every step.
        """
        self.expect_possible(self._start().evaluation)

    def expect_possible(self, found: Evaluation) -> None:
        """Reject a budget that no value can meet, by comparison with sending at every step.

        Raises:
            ProblemError: the rate is above, or the cost below, that of sending at every step.
        """
        budget, most, least = self.goal.budget, self.goal.most(found), found.cost_all_time
        # without acknowledgement, or with a controller that is not optimal, sending every sample may not cost least
        if (
            any(law.acknowledged is False for law in self.problem.network.links.values())
            or self.problem.controller is not None
        ):
            least = None
        if self.tuning.name == "period":  # both limits depend on the period
            return
        if most is not None and budget > most * (1 + EXACT):
            name = self.goal.name
            raise ProblemError(
                f"the {name} {budget:g} per {found.rate_unit} is above the {name} of sending at every step; "
                f"expected at most {most:g}"
            )
        if self.goal.limits_cost and least is not None and budget < least * (1 - EXACT):
            raise ProblemError(
                f"the cost {budget:g} {per_unit(found.unit)} is below the cost of sending at every step; "
                f"expected at least {least:.6g}"
            )

    def _walk(self, here: Look, outwards: float) -> tuple[Look, Look] | None:
        """Return the last two trials of a walk that passes the budget, or None if the walk ends before."""
        side, start, distance, step = here.above > 0, here.value, 0.0, FIRST
        while distance < FARTHEST:
            distance += step
            step *= GROWTH
            there = self.look(self._moved(start, outwards * distance)) or self._edge(here, outwards, start, distance)
            if there.value == here.value:
                return None
            if (there.above > 0) != side or self.meets_exactly(there):
                return here, there
            here = there
        return None

    def _edge(self, last: Look, outwards: float, start: float, beyond: float) -> Look:
        """Return the farthest trial for which a policy can still be designed."""
        inside = abs(self._place(last.value) - self._place(start))
        for _ in range(HALVINGS):
            middle = (inside + beyond) / 2
            found = self.look(self._moved(start, outwards * middle))
            if found is None:
                beyond = middle
            else:
                last, inside = found, middle
        return last

    def _refuse(self) -> Never:
        """Raise an error that states the range that can be reached.

        Raises:
            ProblemError: always.
        """
        start = self._looks()[0]
        for outwards in (-1.0, 1.0):
            self._walk(start, outwards)
        looks = sorted(self._looks(), key=lambda look: look.above)
        found = [look.above + self.goal.budget for look in looks]
        ends = [self._nearest(look, start, ALIKE * (found[-1] - found[0])).value for look in (looks[0], looks[-1])]
        failed = next((str(error) for error in self._seen.values() if isinstance(error, TaciturnError)), None)
        budget = self.goal.budget
        near = [value for value in found if value < budget][-1:] + [value for value in found if value > budget][:1]
        expected = (
            "within this range" if len(near) < 2 else f"such as {near[0]:.5g} or {near[1]:.5g}, the nearest found"
        )
        raise ProblemError(
            f"no {self.tuning.name} gives {self.problem.kind} the {self.goal.name} {budget:g}: the {self.goal.name} "
            f"ranges from {found[0]:.5g} ({self.tuning.name} = {ends[0]:.4g}) to {found[-1]:.5g} "
            f"({self.tuning.name} = {ends[1]:.4g})"
            + (f", and other values fail ({failed})" if failed else "")
            + f"; expected a {self.goal.name} {expected}"
        )

    def _nearest(self, end: Look, start: Look, most: float) -> Look:
        """Return the trial nearest to the first one whose result differs from that of ``end`` by its error at most."""
        alike = [look for look in self._looks() if abs(look.above - end.above) <= max(most, look.error + end.error)]
        return min(alike, key=lambda look: abs(self._place(look.value) - self._place(start.value)))

    def _looks(self) -> list[Look]:
        return [look for look in self._seen.values() if isinstance(look, Look)]

    def _place(self, value: float) -> float:
        """Return the coordinate of a value on the logarithmic axis of the search."""
        return float(np.log(value - self.tuning.least + self.tuning.whole))

    def _value(self, place: float) -> float:
        return self.tuning.least + float(np.exp(place))

    def _moved(self, start: float, by: float) -> float:
        """Return the value at a distance from another value; for integers, at least the next one."""
        place = self._place(start) + by
        if not self.tuning.whole:
            return self._value(place) if by else start
        value = round(min(np.exp(place), 1e9)) - 1 + int(self.tuning.least)
        return int(max(self.tuning.least, value if value != start or by == 0 else start + np.sign(by)))
