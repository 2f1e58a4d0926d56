"""Search for a parameter that meets a budget: bracketing and root finding."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Never

import numpy as np

from taciturn import _scipy
from taciturn._display import Displayed
from taciturn._progress import Progress, Stages
from taciturn._text import per_unit
from taciturn.design.kind import TradeoffParameter
from taciturn.errors import ProblemError, TaciturnError
from taciturn.problem import Problem
from taciturn.study.evaluation import Evaluation
from taciturn.study.measure import Request
from taciturn.study.tuning.goal import EXACT, Goal, ViolationGoal
from taciturn.study.tuning.trials import look_at, out_of_reach, settled
from taciturn.study.violated import with_violations

LEFT = 0.93  # share of the remaining progress that a trial leaves; the number of trials is not known in advance
EFFORT = 2_000_000  # steps of a trial; all trials use the same draws
FIRST, GROWTH, FARTHEST = (
    1.4,
    1.5,
    45.0,
)  # of the bracketing in log(value): first step, growth, farthest
HALVINGS = 12  # bisections towards the limit of values for which a policy can be designed
JUMP = 1e-11  # width in log(value) below which a change counts as a jump
KEPT = 2.0  # standard errors below the budget, at least
PASSED = 20  # integers on either side that are skipped if no policy can be designed for them
SURE = 3.0  # standard errors by which a trial at the limit of the range may miss the budget
FINEST, WIDEST = 0.2, 12.0  # smallest and largest distance in log(value) of trials between which a crossing is sought
ALIKE = 1e-3  # difference of two trials, relative to the budget, below which no crossing is sought between them


@dataclass(frozen=True, eq=False, repr=False)
class Look(Displayed):
    """A trial of one value of the tuning parameter: its evaluation, and the excess over the budget."""

    value: float
    evaluation: Evaluation
    above: float
    error: float


class _FailedError(Exception):
    """A trial between two others failed.

    Args:
        place: its place on the axis of the search.
    """

    def __init__(self, place: float) -> None:
        """Keep the place."""
        super().__init__()
        self.place = place


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
        self,
        problem: Problem,
        tuning: TradeoffParameter,
        goal: Goal,
        seed: int,
        progress: Progress | None,
    ) -> None:
        """Prepare the search; no value is tried yet."""
        self.tuning, self.goal, self.seed, self.progress = tuning, goal, seed, progress
        self.problem, self._limits = replace(problem, limits=None), problem.limits
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
        changed = self.problem.changed({self.tuning.name: value})
        return self._seen_as(value, changed, settled(changed, self.tuning.name, self.seed, EFFORT, self._stage), EFFORT)

    def try_at(self, value: float, steps: int | None = None, standard_error: float | None = None) -> Look:
        """Return a trial of a number of steps, or at full precision."""
        changed = self.problem.changed({self.tuning.name: value})
        return self._seen_as(value, changed, look_at(changed, self.seed, steps, standard_error, self._stage), steps)

    def _seen_as(self, value: float, problem: Problem, evaluation: Evaluation, steps: int | None) -> Look:
        if self._limits is not None and isinstance(self.goal, ViolationGoal):
            request = Request(self.seed, None, steps, "auto")
            evaluation = with_violations(problem, self._limits, request, evaluation, self._stage)
        return Look(value, evaluation, *self.goal.above(evaluation))

    def meets_exactly(self, look: Look) -> bool:
        """Return whether a trial equals the budget within its error."""
        return abs(look.above) <= max(EXACT * self.goal.budget, self.goal.close * look.error)

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
        found = self._walk(here, outwards) or self._crossing(here)
        if found is None:
            nearest = min(self.looks(), key=lambda look: abs(look.above))
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
        """Return the trials on both sides of a jump, or the same trial twice if it meets the budget exactly.

        If a trial between them fails, the search continues between one of them and the last trial before the failure.

        Raises:
            ProblemError: no value reaches the budget.
        """
        ends = [low, high]
        try:
            return self._close_in(ends)
        except _FailedError as failed:
            for end in ends:
                way = failed.place - self.place(end.value)
                edge = self._edge(end, float(np.sign(way)), end.value, abs(way))
                if (edge.above > 0) != (end.above > 0):
                    return self.close_in(*sorted((end, edge), key=lambda look: look.above))
            self._refuse()

    def _close_in(self, ends: list[Look]) -> tuple[Look, Look]:
        """Return the same as ``close_in``, and keep the last trials on both sides in ``ends``.

        Raises:
            _FailedError: a trial fails.
        """

        def above(place: float) -> float:
            look = self.look(self.value(place))
            if look is None:
                raise _FailedError(place)
            if self.meets_exactly(look):
                ends[:] = [look, look]
                return 0.0
            side = int(look.above > 0)
            if abs(self.place(look.value) - self.place(ends[1 - side].value)) < self._width(ends):
                ends[side] = look
            return look.above

        places = self.place(ends[0].value), self.place(ends[1].value)
        if above(places[0]) * above(places[1]) > 0:  # at the limit of the range, rounding decides the side
            nearest = min(ends, key=lambda look: abs(look.above))
            return nearest, nearest
        _scipy.crossing(above, *places, JUMP)
        return ends[0], ends[1]

    def _width(self, ends: list[Look]) -> float:
        return abs(self.place(ends[0].value) - self.place(ends[1].value))

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
        budget, most, least = self.goal.budget, self.goal.most(found), self.goal.least(found)
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
        if least is not None and budget < least * (1 - EXACT):
            raise ProblemError(
                f"the cost {budget:g} {per_unit(found.unit)} is below the cost of sending at every step; "
                f"expected at least {least:.6g}"
            )

    def _walk(self, here: Look, outwards: float) -> tuple[Look, Look] | None:
        """Return the last two trials of a walk that passes the budget, or None if the walk ends before.

        Values that fail are passed over; if all farther ones fail, the walk ends at the farthest that does not.
        """
        side, start, distance, step, failed = here.above > 0, here.value, 0.0, FIRST, 0.0
        while distance < FARTHEST:
            distance += step
            step *= GROWTH
            there = self.look(self._moved(start, outwards * distance))
            if there is None:
                failed = failed or distance
                continue
            if there.value == here.value:
                return None
            if (there.above > 0) != side or self.meets_exactly(there):
                return here, there
            here, failed = there, 0.0
        there = self._edge(here, outwards, start, failed) if failed else here
        return (here, there) if (there.above > 0) != side or self.meets_exactly(there) else None

    def _crossing(self, start: Look) -> tuple[Look, Look] | None:
        """Return two neighbouring trials that bracket the budget, of a quantity that is not monotone in the parameter.

        For example, the cost of silence may be less than that of few sends with an unsuitable controller. After walks
        in both directions, intervals between neighbouring trials are halved if the quantity differs between their ends,
        or if values between them fail. If there are several brackets, the result is the farthest one in which
        the quantity crosses the budget in the usual direction, which has the fewest packets.
        """
        for outwards in (-1.0, 1.0):
            here = start
            while (found := self._walk(here, outwards)) is not None and found[1].value != here.value:
                if self.meets_exactly(found[1]) or (found[1].above > 0) == (self.rising == (outwards > 0)):
                    break
                here = found[1]  # the walk has crossed the budget in the unusual direction, and goes on
        width = FIRST
        while not self.tuning.whole:
            looks = sorted(self.looks(), key=lambda look: look.value)
            pairs = [(a, b) for a, b in pairwise(looks) if (a.above > 0) != (b.above > 0)]
            usual = [(a, b) for a, b in pairs if (b.above > 0) == self.rising]
            if usual or (pairs and width <= FINEST):
                return (usual or pairs)[-1]
            width /= 2
            if width < FINEST:
                return None
            for a, b in pairwise(looks):
                place, gap = self.place(a.value), self.place(b.value) - self.place(a.value)
                if abs(a.above - b.above) > ALIKE * self.goal.budget and gap < WIDEST:
                    for part in range(1, int(np.ceil(gap / width))):
                        self.look(self.value(place + part * width))
        return None

    def _edge(self, last: Look, outwards: float, start: float, beyond: float) -> Look:
        """Return the farthest trial for which a policy can be designed, or the first one that passes the budget."""
        inside = abs(self.place(last.value) - self.place(start))
        for _ in range(HALVINGS):
            middle = (inside + beyond) / 2
            found = self.look(self._moved(start, outwards * middle))
            if found is None:
                beyond = middle
            elif (found.above > 0) != (last.above > 0):
                return found
            else:
                last, inside = found, middle
        return last

    def _refuse(self) -> Never:
        """Raise an error that states the range that can be reached.

        Raises:
            ProblemError: always.
        """
        start = self.looks()[0]
        for outwards in (-1.0, 1.0):
            self._walk(start, outwards)
        tried = [(look.value, self.goal.of(look.evaluation).value) for look in self.looks()]
        failed = next((str(error) for error in self._seen.values() if isinstance(error, TaciturnError)), "")
        raise out_of_reach(self.problem.kind, self.tuning.name, self.goal.name, self.goal.budget, tried, failed)

    def looks(self) -> list[Look]:
        """Return all trials that did not fail."""
        return [look for look in self._seen.values() if isinstance(look, Look)]

    def place(self, value: float) -> float:
        """Return the coordinate of a value on the logarithmic axis of the search."""
        return float(np.log(value - self.tuning.least + self.tuning.whole))

    def value(self, place: float) -> float:
        """Return the value at a coordinate."""
        return self.tuning.least + float(np.exp(place))

    def _moved(self, start: float, by: float) -> float:
        """Return the value at a distance from another value; for integers, at least the next one."""
        place = self.place(start) + by
        if not self.tuning.whole:
            return self.value(place) if by else start
        value = round(min(np.exp(place), 1e9)) - 1 + int(self.tuning.least)
        return int(max(self.tuning.least, value if value != start or by == 0 else start + np.sign(by)))
