"""Search for a parameter that meets a budget: bracketing and root finding.

A quick evaluation within a search, as precise as the search needs.

A correction at full precision of the parameter that a search has found, or both sides of a jump.

The shares of several links in one threshold: those that meet a budget with the least traffic or the least cost.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Never

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn._progress import Progress, Stages
from taciturn._text import per_unit
from taciturn.analyse.renewal import decides_alone, expect_affordable
from taciturn.design.kind import TradeoffParameter
from taciturn.errors import ProblemError, TaciturnError, UnstableError
from taciturn.model.policy import Policy
from taciturn.problem import Problem
from taciturn.renewal.chain import NoQuadratureError
from taciturn.study.evaluate import evaluate, with_violations
from taciturn.study.evaluation import Evaluation
from taciturn.study.goal import EXACT, Goal, RatesGoal, ViolationGoal
from taciturn.study.measure import Request

ROUGHLY = 1e-5  # relative accuracy of the cost in a trial by quadrature
ALIKE_OF_RANGE = 1e-3  # share of the range of all results within which a result counts as an end of this range
TINY = 1e-300  # in place of a value of 0, which has no logarithm
LONGER = 8  # factor on the steps of a trial if the loop has not settled


def look_at(
    problem: Problem, seed: int, steps: int | None, standard_error: float | None, progress: Progress | None = None
) -> Evaluation:
    """Return an evaluation by quadrature if one applies, else by a simulation of the given number of steps."""
    policy = problem.designed()
    if isinstance(policy, Policy) and policy.theory.cost_all_time == 0:
        raise ProblemError(
            "sending every sample costs nothing, so that no budget determines a parameter; expected noise W or V that "
            "the cost depends on"
        )
    solved = not isinstance(policy, Policy) and policy.looked_at is not None
    if solved or (isinstance(policy, Policy) and _serves(problem, policy)):
        wanted = standard_error if steps is None else ROUGHLY * abs(policy.cost_all_time) or None
        try:
            found = evaluate(
                problem, seed=seed, method="exact", standard_error=wanted, after_step=False, progress=progress
            )
        except ProblemError:
            if solved:
                raise
        else:
            if found.reached or solved:
                return found
    return evaluate(problem, seed=seed, steps=steps, standard_error=standard_error, after_step=False, progress=progress)


def settled(
    problem: Problem, tuned: str, seed: int, steps: int, progress: Progress | None = None, longer: int = LONGER
) -> Evaluation:
    """Return the evaluation of a loop that settles."""
    found = look_at(problem, seed, steps, None, progress)
    if not found.reached and longer > 1:
        found = look_at(problem, seed, longer * steps, None, progress)
    if not found.reached:
        given = f"{problem.kind} with {tuned} = {problem.parameters[tuned]:g}"
        raise UnstableError(f"the mean cost of {given} does not settle within {longer * steps} steps")
    return found


def out_of_reach(
    policy: str, tuned: str, name: str, budget: float, tried: Sequence[tuple[float, float]], failed: str = ""
) -> ProblemError:
    """Return an error that states the range that can be reached."""
    found, first = sorted(value for _, value in tried), np.log(max(tried[0][0], TINY))
    same = ALIKE_OF_RANGE * (found[-1] - found[0])

    def end(limit: float) -> str:
        values = [value for value, given in tried if abs(given - limit) <= same]
        return f"{limit:.5g} ({tuned} = {min(values, key=lambda value: abs(np.log(max(value, TINY)) - first)):.4g})"

    near = [value for value in found if value < budget][-1:] + [value for value in found if value > budget][:1]
    expected = "within this range" if len(near) < 2 else f"such as {near[0]:.5g} or {near[1]:.5g}, the nearest found"
    return ProblemError(
        f"no {tuned} gives {policy} the {name} {budget:g}: the {name} ranges from {end(found[0])} to {end(found[-1])}"
        f"{f', and other values fail ({failed})' if failed else ''}; expected a {name} {expected}"
    )


def _serves(problem: Problem, policy: Policy) -> bool:
    """Return whether a quadrature may be quicker than a simulation."""
    if not decides_alone(policy):
        return False
    try:
        expect_affordable(problem.close(policy))
    except NoQuadratureError:
        return False
    return True


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
    """A trial between two others failed."""

    def __init__(self, place: float) -> None:
        """Keep the place."""
        super().__init__()
        self.place = place


class Search:
    """A search over values of the tuning parameter."""

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
        """Return two trials that bracket the budget: one that is not above it, and one that is above it."""
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
        """Return the same as ``close_in``, and keep the last trials on both sides in ``ends``."""

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
        """Reject a budget that no value can meet, before a search of more than this parameter."""
        self.expect_possible(self._start().evaluation)

    def expect_possible(self, found: Evaluation) -> None:
        """Reject a budget that no value can meet, by comparison with sending at every step."""
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
        """Raise an error that states the range that can be reached."""
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


STRIDE = 0.1  # longest step of a correction in log(value)
NARROW = 1e-5  # width in log(value) below which a change at full precision counts as a jump
ROUNDS = 3  # corrections
AIMED, FAR = 3.0, 8.0  # standard errors below the budget: target of a correction, and most


class Refinement:
    """Trials of a search at full precision."""

    def __init__(self, search: Search, standard_error: float | None) -> None:
        """Try nothing yet."""
        self._search, self._standard_error = search, standard_error

    def _at(self, place: float) -> Look:
        """Return the trial at a place."""
        return self._search.try_at(self._search.value(place), standard_error=self._standard_error)

    def refine(self, low: Look, high: Look) -> tuple[Look, Look, float | None, float | None]:
        """Repeat trials at full precision, and correct their values for the remaining distance from the budget."""
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
        """Return a trial that nearly meets the budget twice, or else the trials on both sides of a jump."""
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


EFFORT_OF_SHARES = 400_000  # steps of a trial; all trials use the same draws
FIRST_SHARE, LAST_SHARE = 1.6, 0.2  # first and last step of the search, in the logarithm of a share
WORTH = 3e-4  # least relative improvement for which the search continues
CLOSE = 3e-3  # relative distance from the budget at which a scale is accepted, and the rest corrected
TRIES, ROUNDS_OF_SHARES = 12, 8  # trials for one scale, and rounds over all links for given rates
SLOPE = 0.5  # first guess of the change of the logarithm of a rate or cost, per unit of the scale
STRIDE_OF_SHARES, FARTHEST_SHARE = (
    1.5,
    12.0,
)  # longest step of a scale, and longest way from the start, in the logarithm
LEAST = 1e-6  # least ratio to the budget, for rates of 0
LEFT_OF_SHARES = 0.97  # share of the remaining progress that a trial leaves


@dataclass(frozen=True, eq=False, repr=False)
class Trial(Displayed):
    """A trial of the thresholds of all links."""

    # logarithm of the share of each link, plus that of a common scale, whose square is the tuning parameter
    logs: Array
    evaluation: Evaluation  # cost and rates


class Division:
    """The division of a threshold among the links on which a policy decides."""

    def __init__(
        self, problem: Problem, tuning: TradeoffParameter, goal: Goal, seed: int, progress: Progress | None
    ) -> None:
        """Prepare the search; nothing is tried yet."""
        assert problem.record.shares is not None
        self._problem, self._tuning, self._goal, self._seed = problem, tuning, goal, seed
        self._name, self._links = problem.record.shares, list(problem.network.links)
        self._progress, self._done = progress, 0
        self._longer = LONGER if isinstance(goal, RatesGoal) else 1  # other shares that do not settle are left out
        # slopes of the limited and of the minimised quantity, at the last scale
        self._slopes: tuple[float, float] | None = None

    def best(self) -> dict[str, object]:
        """Return the best shares, with three digits and the mean 1, and the threshold at which the search found
        them.
        """
        logs = self._given_rates(self._goal) if isinstance(self._goal, RatesGoal) else self._cheapest()
        return {self._tuning.name: self._whole(logs), self._name: self._shares(logs)}

    def _cheapest(self) -> Array:
        """Return the shares of the least traffic at the budgeted cost, or of the least cost at the budgeted traffic.

        The search changes one share at a time, and adapts the threshold of all links so that the budget is met. Equal
        shares are first, for which the threshold is sought as for given shares.
        """
        equal = self._problem.changed({self._name: dict.fromkeys(self._links, 1.0)})
        search = Search(equal, self._tuning, self._goal, self._seed, self._stage())
        found, _ = search.close_in(*search.bracket())
        logs = np.full(len(self._links), 0.5 * np.log(found.value) - np.log(len(self._links)))
        best, worth = Trial(logs, found.evaluation), self._other(found.evaluation)
        step = FIRST_SHARE
        while step >= LAST_SHARE:
            before = worth
            for place in range(len(self._links)):
                for by in (step, -step):
                    logs = best.logs.copy()
                    logs[place] += by
                    try:
                        tried, value = self._scaled(logs)
                    except TaciturnError:
                        continue  # this budget cannot be met with these shares
                    if value < worth - WORTH * abs(worth):
                        best, worth = tried, value
                        break
            if worth >= before - WORTH * abs(before):
                step /= 2
        return best.logs

    def _other(self, found: Evaluation) -> float:
        """Return the quantity to be minimised."""
        return self._goal.use(found).value if self._goal.limits_cost else found.cost.value

    def _start(self) -> float:
        """Return the scale of the given threshold, or of one of usual size."""
        given = self._problem.parameters.get(self._tuning.name)
        return 0.5 * float(np.log(given)) if isinstance(given, int | float) and given > 0 else 0.0

    def _scaled(self, logs: Array) -> tuple[Trial, float]:
        """Return a trial whose common scale meets the budget, and the quantity to be minimised there."""
        goal = self._goal
        sign = 1.0 if goal.limits_cost else -1.0  # of the change of the limited quantity with the scale

        def above(trial: Trial) -> float:
            return float(np.log(max(goal.of(trial.evaluation).value / goal.budget, LEAST)))

        def other(trial: Trial) -> float:
            return self._other(trial.evaluation)

        return self._root(logs, np.ones(len(logs)), above, other, sign, (goal.name, goal.budget))

    def _root(
        self,
        logs: Array,
        direction: Array,
        above: Callable[[Trial], float],
        other: Callable[[Trial], float],
        sign: float,
        budget: tuple[str, float],
    ) -> tuple[Trial, float]:
        """Return a trial along a direction at which ``above`` is 0, and the value of ``other`` at exactly this
        place.
        """
        place, last = 0.0, None
        slope, along = self._slopes or (SLOPE * sign, None)
        low, high = -FARTHEST_SHARE, FARTHEST_SHARE
        tried: list[tuple[float, float]] = []
        for _ in range(TRIES):
            trial = self._try(logs + place * direction)
            missing = above(trial)
            tried.append((self._whole(trial.logs), budget[1] * float(np.exp(missing))))
            if last is not None and place != last[0]:
                along = (other(trial) - last[2]) / (place - last[0])
                if (missing - last[1]) * (place - last[0]) * sign > 0:
                    slope = (missing - last[1]) / (place - last[0])
            if abs(missing) <= CLOSE and along is not None:
                self._slopes = slope, along
                return trial, other(trial) - along * missing / slope
            if missing * sign > 0:
                high = min(high, place)
            else:
                low = max(low, place)
            last = place, missing, other(trial)
            moved = place - float(np.clip(missing / slope, -STRIDE_OF_SHARES, STRIDE_OF_SHARES))
            place = moved if low < moved < high else (low + high) / 2
        raise out_of_reach(self._problem.kind, self._tuning.name, *budget, tried)

    def _given_rates(self, goal: RatesGoal) -> Array:
        """Return the shares at which the links with a limit reach it; the others send every sample."""
        named = [self._links.index(link) for link in goal.limits]
        logs = np.full(len(self._links), -np.inf)
        logs[named] = self._start() - np.log(len(named))
        axes = np.eye(len(self._links))
        for _ in range(ROUNDS_OF_SHARES):
            before = logs.copy()
            for place in named:
                self._slopes = None
                link = self._links[place]
                above, limit = self._above_limit(goal, link), (f"rate of {link}", goal.limits[link])
                logs = self._root(logs, axes[place], above, lambda _: 0.0, -1.0, limit)[0].logs
            if np.abs(logs[named] - before[named]).max() < CLOSE or len(named) == 1:
                break
        return logs

    def _above_limit(self, goal: RatesGoal, link: str) -> Callable[[Trial], float]:
        def above(trial: Trial) -> float:
            least = 0.5 * (trial.evaluation.base_rate or 1.0) / EFFORT_OF_SHARES
            return float(np.log(max(trial.evaluation.rates[link].value, least) / goal.limits[link]))

        return above

    def _try(self, logs: Array) -> Trial:
        changed = self._problem.changed(
            {self._tuning.name: self._whole(logs), self._name: self._shares(logs, digits=17)}
        )
        stage = self._stage()
        found = settled(changed, self._tuning.name, self._seed, EFFORT_OF_SHARES, stage, self._longer)
        stage(1.0)
        return Trial(logs, found)

    def _stage(self) -> Stages:
        """Return the progress of the next trial."""
        self._done += 1
        return Stages(self._progress, *(1 - LEFT_OF_SHARES ** (self._done - k) for k in (1, 0)))

    def _whole(self, logs: Array) -> float:
        """Return the tuning parameter."""
        return float(np.exp(2 * np.logaddexp.reduce(logs[np.isfinite(logs)])))

    def _shares(self, logs: Array, digits: int = 3) -> dict[str, float]:
        """Return the shares with the mean 1 of the links that do not send every sample."""
        finite = np.isfinite(logs)
        share = np.exp(logs - np.logaddexp.reduce(logs[finite])) * finite.sum()
        return {link: float(f"{one:.{digits}g}") for link, one in zip(self._links, share, strict=True)}
