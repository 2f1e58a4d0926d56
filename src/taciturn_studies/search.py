"""Search for the parameter value at which a policy meets a budget.

The excess over the budget is a function of one parameter, such as a threshold, known with a statistical error. A trial
of a value is an evaluation by quadrature if one serves, else a simulation of a fixed number of steps; all trials use
the same draws, so the excess changes as smoothly as the policy does (``look_at``, ``settled``). The coordinate is
log(value), in which rates and costs of thresholds of any size change at a similar pace.

1. ``Search.bracket`` walks from the given value with growing steps until the excess changes its sign. Values that fail
   are passed over: some thresholds have no design, and some loops diverge.
2. ``Search.close_in`` finds the crossing, up to a jump: rates of integer parameters, and of thresholds that all errors
   exceed, change by jumps. Then the trials on both sides are the answer.
3. ``Search.refine`` repeats the answer at full precision, and corrects it along the slope of two trials next to it,
   until it is below the budget by more than its error, and not by much more.

If no value meets the budget, the error states the range that can be reached (``out_of_reach``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Never

import numpy as np

from taciturn.analyse.renewal import decides_alone, expect_affordable
from taciturn.design.kind import TradeoffParameter
from taciturn.errors import ProblemError, TaciturnError, UnstableError
from taciturn.extend import Displayed, Progress, Stages, crossing, per_unit
from taciturn.model.estimate import Estimate
from taciturn.model.policy import Policy
from taciturn.problem import Problem
from taciturn.renewal.chain import NoQuadratureError
from taciturn.study.evaluate import evaluate, with_violations
from taciturn.study.evaluation import Evaluation
from taciturn.study.measure import Request
from taciturn_studies.goal import EXACT, Goal, ViolationGoal

ROUGHLY = 1e-5  # relative accuracy of the cost in a trial by quadrature
AT_THE_END = 1e-3  # share of the range of all results, or of this end, within which a result counts as an end
TINY = 1e-300  # in place of a value of 0, which has no logarithm
LONGER = 8  # factor on the steps of a trial if the loop has not settled
LEFT = 0.93  # share of the remaining progress that a trial leaves; the number of trials is not known in advance
EFFORT = 2_000_000  # steps of a trial; all trials use the same draws
FIRST, GROWTH, FARTHEST = 1.4, 1.5, 45.0  # first step of the bracketing in log(value), its growth, and the farthest
HALVINGS = 12  # bisections towards the limit of values for which a policy can be designed
JUMP = 1e-11  # width in log(value) below which a change counts as a jump
KEPT = 2.0  # standard errors below the budget, at least
PASSED = 20  # integers on either side that are skipped if no policy can be designed for them
SURE = 3.0  # standard errors by which a trial at the limit of the range may miss the budget
FINEST, WIDEST = 0.2, 12.0  # smallest and largest distance in log(value) of trials between which a crossing is sought
ALIKE = 1e-3  # difference of two trials, relative to the budget, below which no crossing is sought between them
STRIDE = 0.1  # longest step of a correction in log(value)
NARROW = 1e-5  # width in log(value) below which a change at full precision counts as a jump
ROUNDS = 3  # corrections
AIMED, FAR = 3.0, 8.0  # standard errors below the budget: target of a correction, and most


@dataclass(frozen=True, eq=False, repr=False)
class Look(Displayed):
    """A trial of one parameter value: the evaluation, and by how much the limited quantity exceeds the budget."""

    value: float
    evaluation: Evaluation
    above: float
    error: float


@dataclass(frozen=True, repr=False)
class Attempt(Displayed):
    """One tested parameter value, with the limited quantity, the cost, and the rate or traffic."""

    value: float
    limited: Estimate
    cost: Estimate
    used: Estimate  # rate or traffic

    def document(self) -> dict[str, object]:
        """Return the attempt as JSON."""
        found = {"limited": self.limited.value, "cost": self.cost.value, "used": self.used.value}
        return {"value": self.value, **found}


class _FailedError(Exception):
    """A trial between two others failed."""

    def __init__(self, place: float) -> None:
        """Keep the place."""
        super().__init__()
        self.place = place


class Search:
    """A search for the parameter value at which a policy meets a budget."""

    def __init__(
        self,
        problem: Problem,
        tuning: TradeoffParameter,
        goal: Goal,
        seed: int,
        progress: Progress | None,
        standard_error: float | None = None,
    ) -> None:
        """Prepare the search; no value is tried yet."""
        self.tuning, self.goal, self.seed, self.progress = tuning, goal, seed, progress
        self.standard_error = standard_error  # of the cost, at full precision
        self.problem, self._limits = replace(problem, limits=None), problem.limits
        self.rising = tuning.falls == goal.limits_cost  # whether the rate or cost increases with the value
        self._seen: dict[float, Look | TaciturnError] = {}
        self._stage = Stages(progress, 0.0, 1 - LEFT)  # of the present trial

    def look(self, value: float) -> Look | None:
        """Evaluate one parameter value; return None if no policy can be designed or the loop is unstable."""
        if value not in self._seen:
            try:
                changed = self.problem.changed({self.tuning.name: value})
                found = settled(changed, self.tuning.name, self.seed, EFFORT, self._stage)
                self._seen[value] = self._seen_as(value, changed, found, EFFORT)
            except TaciturnError as error:
                self._seen[value] = error
            self._stage(1.0)
            self._stage = Stages(self.progress, *(1 - LEFT ** (len(self._seen) + k) for k in (0, 1)))
        look = self._seen[value]
        return look if isinstance(look, Look) else None

    def try_at(self, value: float, steps: int | None = None) -> Look:
        """Evaluate one parameter value with a given number of steps, or else with the requested standard error."""
        changed, error = self.problem.changed({self.tuning.name: value}), None if steps else self.standard_error
        return self._seen_as(value, changed, look_at(changed, self.seed, steps, error, self._stage), steps)

    def _seen_as(self, value: float, problem: Problem, evaluation: Evaluation, steps: int | None) -> Look:
        if self._limits is not None and isinstance(self.goal, ViolationGoal):
            request = Request(self.seed, None, steps, "auto")
            evaluation = with_violations(problem, self._limits, request, evaluation, self._stage)
        return Look(value, evaluation, *self.goal.above(evaluation))

    def meets_exactly(self, look: Look) -> bool:
        """Return whether the limited quantity of a trial equals the budget, apart from its error."""
        return abs(look.above) <= max(EXACT * self.goal.budget, self.goal.close * look.error)

    def keeps(self, look: Look) -> bool:
        """Return whether the limited quantity of a trial is below the budget by more than its error."""
        return look.above + KEPT * look.error <= EXACT * self.goal.budget

    def bracket(self) -> tuple[Look, Look]:
        """Find two trials on both sides of the budget: one at or below it, and one above it."""
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
        """Narrow the interval around a crossing or a jump of the limited quantity; return the trials at both ends.

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

        def apart(one: Look, other: Look) -> float:
            return abs(self.place(one.value) - self.place(other.value))

        def above(place: float) -> float:
            look = self.look(self.value(place))
            if look is None:
                raise _FailedError(place)
            if self.meets_exactly(look):
                ends[:] = [look, look]
                return 0.0
            side = int(look.above > 0)
            if apart(look, ends[1 - side]) < apart(*ends):
                ends[side] = look
            return look.above

        places = self.place(ends[0].value), self.place(ends[1].value)
        if above(places[0]) * above(places[1]) > 0:  # at the limit of the range, rounding decides the side
            nearest = min(ends, key=lambda look: abs(look.above))
            return nearest, nearest
        crossing(above, *places, JUMP)
        return ends[0], ends[1]

    def _start(self) -> Look:
        """Return the trial of the given value, or of the nearest value for which a policy can be designed."""
        start = self.tuning.value_in(self.problem.parameters)
        for k in range(9):
            for sign in (1.0, -1.0):
                found = self.look(self._moved(start, sign * k * FIRST))
                if found is not None:
                    return found
        why = self._seen[start]
        assert isinstance(why, TaciturnError)
        raise why

    def expect_start(self) -> None:
        """Raise an error if no parameter value can meet the budget, before a search over several parameters starts."""
        self.expect_possible(self._start().evaluation)

    def expect_possible(self, found: Evaluation) -> None:
        """Raise an error if no parameter value can meet the budget; sending every sample shows the possible range."""
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
                f"the {name} budget of {budget:g} per {found.rate_unit} is above the {name} of sending every sample; "
                f"expected at most {most:g}"
            )
        if least is not None and budget < least * (1 - EXACT):
            raise ProblemError(
                f"the cost budget of {budget:g} {per_unit(found.unit)} is below the cost of sending every sample; "
                f"expected at least {least:.6g}"
            )

    def _walk(self, here: Look, outwards: float) -> tuple[Look, Look] | None:
        """Return the last two trials of a walk that passes the budget, or None if the walk ends before.

        Values that fail are skipped; if all farther values fail, the walk ends at the farthest value that does not.
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
        """Return all successful trials."""
        return [look for look in self._seen.values() if isinstance(look, Look)]

    def tried(self) -> tuple[Attempt, ...]:
        """Return all successful trials, in ascending order of the parameter value."""
        found = sorted(self.looks(), key=lambda look: look.value)
        return tuple(
            Attempt(one.value, self.goal.of(one.evaluation), one.evaluation.cost, self.goal.use(one.evaluation))
            for one in found
        )

    def place(self, value: float) -> float:
        """Convert a parameter value to its coordinate on the search's logarithmic axis."""
        return float(np.log(value - self.tuning.least + self.tuning.whole))

    def value(self, place: float) -> float:
        """Convert a coordinate on the search's logarithmic axis to a parameter value."""
        return self.tuning.least + float(np.exp(place))

    def _moved(self, start: float, by: float) -> float:
        """Return the value at a distance from another value; for integers, at least the next one."""
        place = self.place(start) + by
        if not self.tuning.whole:
            return self.value(place) if by else start
        value = round(min(np.exp(place), 1e9)) - 1 + int(self.tuning.least)
        return int(max(self.tuning.least, value if value != start or by == 0 else start + np.sign(by)))

    def refine(self, low: Look, high: Look) -> tuple[Look, Look, float | None, float | None]:
        """Repeat the trials with the requested standard error, and correct the parameter for the remaining error."""
        tried = [] if low is high else [self.try_at(look.value) for look in (low, high)]
        place = self.place(low.value)
        span = self.goal.span
        around = [self.look(self.value(place + step)) for step in (-span, span)]
        near = [one for one in around if one is not None]
        slope = pace = blur = 0.0
        if len(near) == 2:
            slope = (near[1].above - near[0].above) / (2 * span)
            rates = [self.goal.use(one.evaluation).value for one in near]
            pace = (rates[1] - rates[0]) / (2 * span)
        measured = self.try_at(low.value, LONGER * EFFORT) if low.error and slope else low
        for _ in range(0 if tried else ROUNDS):
            blur = measured.error  # error of the trial that determines the next place
            missing = measured.above + AIMED * blur
            place -= float(np.clip(missing / slope, -STRIDE, STRIDE)) if slope else 0.0
            measured = self.try_at(self.value(place))
            tried.append(measured)
            if self._nearly(measured) or not slope:
                break
        else:
            measured, beyond = self._straddle(tried)
            if measured is not beyond:
                return measured, beyond, 0.0, None
            blur = measured.error
        changes = slope / (measured.value - self.tuning.least)
        error = blur / abs(changes) if changes else None
        costs = [one.evaluation.cost.value for one in near]
        along = (costs[1] - costs[0]) / (2 * span) / pace if pace else None
        return measured, measured, error, along

    def _nearly(self, look: Look) -> bool:
        """Return whether a trial is below the budget by more than its error, and not by much more."""
        return self.keeps(look) and look.above >= -max(FAR * look.error, EXACT * self.goal.budget)

    def _straddle(self, tried: list[Look]) -> tuple[Look, Look]:
        """Return a trial that nearly meets the budget twice, or else the trials on both sides of a jump."""
        closest: dict[bool, Look] = {}  # by whether the trial is below the budget

        def add(look: Look) -> None:
            side = self.keeps(look)
            if side not in closest or abs(look.above) < abs(closest[side].above):
                closest[side] = look

        for look in tried:
            add(look)
        here = next(iter(closest.values()))
        beyond = [look for look in self.looks() if self.keeps(look) != self.keeps(here)]
        for look in sorted(beyond, key=lambda look: abs(self.place(look.value) - self.place(here.value))):
            if len(closest) < 2:
                add(self.try_at(look.value))
        while len(closest) == 2 and not self._nearly(closest[True]):
            ends = [self.place(look.value) for look in closest.values()]
            if abs(ends[1] - ends[0]) < NARROW:
                break
            middle = self.try_at(self.value(sum(ends) / 2))
            closest[self.keeps(middle)] = middle
        low, high = closest.get(True), closest.get(False)
        if low is not None and (high is None or self._nearly(low)):
            return low, low  # also at the limit of the range
        assert high is not None
        if low is not None and high.above > 0:
            return low, high
        missed = replace(high, evaluation=replace(high.evaluation, reached=False))
        return missed, missed

    def measure_within(self, look: Look) -> Look:
        """Evaluate an integer parameter precisely and, if it exceeds the budget, the integers next to it in turn."""
        found, step = self.try_at(look.value), -1 if self.rising else 1
        for away in range(1, PASSED if self.tuning.whole else 1):
            value = int(look.value) + away * step
            if found.above <= EXACT * self.goal.budget or value < self.tuning.least:
                break
            if (other := self.look(value)) is not None:
                found = self.try_at(other.value)
        return found


def settled(
    problem: Problem, tuned: str, seed: int, steps: int, progress: Progress | None = None, longer: int = LONGER
) -> Evaluation:
    """Evaluate a problem, with a longer simulation if needed; raise an error if the mean cost does not converge."""
    found = look_at(problem, seed, steps, None, progress)
    if not found.reached and longer > 1:
        found = look_at(problem, seed, longer * steps, None, progress)
    if not found.reached:
        given = f"{problem.kind} with {tuned} = {problem.parameters[tuned]:g}"
        raise UnstableError(f"the mean cost of {given} does not settle within {longer * steps} steps")
    return found


def look_at(
    problem: Problem, seed: int, steps: int | None, standard_error: float | None, progress: Progress | None = None
) -> Evaluation:
    """Evaluate a problem by quadrature if possible, otherwise by simulating the given number of steps."""
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


def _serves(problem: Problem, policy: Policy) -> bool:
    """Return whether a quadrature may be quicker than a simulation."""
    if not decides_alone(policy):
        return False
    try:
        expect_affordable(problem.close(policy))
    except NoQuadratureError:
        return False
    return True


def out_of_reach(
    policy: str, tuned: str, name: str, budget: float, tried: Sequence[tuple[float, float]], failed: str = ""
) -> ProblemError:
    """Return an error for a budget that cannot be met; its message states which values can be reached."""
    found, first = sorted(value for _, value in tried), np.log(max(tried[0][0], TINY))

    def end(limit: float) -> str:
        same = AT_THE_END * min(found[-1] - found[0], max(abs(limit), abs(budget)))  # one end may be huge
        values = [value for value, given in tried if abs(given - limit) <= same]
        return f"{limit:.5g} ({tuned} = {min(values, key=lambda value: abs(np.log(max(value, TINY)) - first)):.4g})"

    near = [value for value in found if value < budget][-1:] + [value for value in found if value > budget][:1]
    expected = "within this range" if len(near) < 2 else f"such as {near[0]:.5g} or {near[1]:.5g}, the nearest found"
    return ProblemError(
        f"no {tuned} gives {policy} the {name} {budget:g}: the {name} ranges from {end(found[0])} to {end(found[-1])}"
        f"{f', and other values fail ({failed})' if failed else ''}; expected a {name} {expected}"
    )
