"""The parameter of a policy that meets a budget: a rate, or a cost."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Never

import numpy as np

from taciturn import _scipy
from taciturn._arrays import number
from taciturn.design.catalogue import KNOBS, Knob
from taciturn.errors import ProblemError, TaciturnError, UnstableError
from taciturn.model.estimate import Estimate
from taciturn.model.plant import ContinuousPlant
from taciturn.model.policy import LinkName
from taciturn.problem import Problem, expect_problem
from taciturn.simulation.average import check_effort
from taciturn.simulation.sampling import Progress
from taciturn.study.evaluate import Evaluation
from taciturn.study.looks import look_at

EFFORT = 2_000_000  # steps of a look; all looks see the same draws
LONGER = 8  # times as many where a loop has not settled, and for the last look
FIRST, GROWTH, FARTHEST = 1.4, 1.5, 45.0  # of the walk in log(value), from where it starts
HALVINGS = 12  # towards the end of what can be designed
CLOSE = 0.25  # standard errors of a look that a root may be off
JUMP = 1e-11  # width in log(value) over which what is sought jumps
SPAN, STRIDE = 0.02, 0.1  # of log(value): for slopes, and that a correction goes at most
ROUNDS = 3  # of corrections at full precision
PASSED = 20  # whole numbers on either side that are passed over where nothing can be designed
SURE = 3.0  # standard errors by which the answer may miss the budget
EXACT = 1e-9  # relative


@dataclass(frozen=True)
class Parameter:
    """A parameter and how well it is known; ``standard_error`` is None where the budget does not depend on it here."""

    name: str
    value: float
    standard_error: float | None


@dataclass(frozen=True, eq=False)
class Tuned:
    """The policy that meets a budget.

    Args:
        parameter: that was sought.
        problem: with this parameter.
        evaluation: of it.
        beyond: where rate and cost jump across the budget, the policy on the other side of the jump.
        slope: change of the cost with the rate at the budget, along the parameter; None at a jump.
    """

    parameter: Parameter
    problem: Problem
    evaluation: Evaluation
    beyond: Tuned | None
    slope: float | None

    def document(self) -> dict[str, Any]:
        """Return the JSON document of ``taciturn tune --json``."""
        parameter = {
            "name": self.parameter.name,
            "value": self.parameter.value,
            "standard_error": self.parameter.standard_error,
        }
        found = {"parameter": parameter} | self.evaluation.document()
        if self.beyond is not None:
            rates = {link: rate.value for link, rate in self.beyond.evaluation.rates.items()}
            jump = {"value": self.beyond.parameter.value, "cost": self.beyond.evaluation.cost.value, "rates": rates}
            found["beyond"] = jump
        return found


def tune(
    problem: Problem,
    *,
    rate: float | None = None,
    cost: float | None = None,
    link: LinkName | None = None,
    seed: int = 0,
    standard_error: float | None = None,
    progress: Progress | None = None,
) -> Tuned:
    """Return the parameter with which a problem's policy sends at a rate, or costs so much.

    The parameter is the knob of the policy kind; rate and cost are taken to be monotone in it. The search looks at the
    same draws again and again, and corrects its answer once it is measured more precisely. Where the rate jumps, as
    with whole numbers, the answer is the policy next to the budget that keeps it.

    Args:
        problem: its policy; the value that its parameter has is where the search starts.
        rate: sends per step or per second; the answer sends that often, or as little less as it can.
        cost: per step, per second or per mission; the answer costs so much, or as little less as it can.
        link: whose rate; omitted where the policy decides one only.
        seed: of the draws.
        standard_error: absolute, of the cost of the answer; omitted: 1e-4 of it.
        progress: called with the fraction done.

    Returns:
        The parameter with the standard error that it has as an answer to the budget, and the evaluation at this
        parameter, whose standard errors are those of any evaluation.

    Raises:
        ProblemError: a budget that no value reaches, none or two budgets, a policy without such a parameter.
        UnstableError: no value has a stable loop.

    Example:
        >>> from taciturn import load
        >>> found = tune(load("two-mass"), rate=0.3, standard_error=1e-3)
        >>> round(found.parameter.value, 1), round(found.evaluation.rates["actuator"].value, 2)
        (1.1, 0.3)
    """
    expect_problem("problem", problem)
    check_effort(seed, standard_error, None)
    if (rate is None) == (cost is None):
        got = "both" if rate is not None else "neither"
        raise ProblemError(f"of rate and cost {got} is given; expected one of them, the budget: --rate or --cost")
    name, budget = ("rate", rate) if rate is not None else ("cost", cost)
    knob = _knob(problem, link)
    goal = _Goal(name, number(name, budget, 0.0), link or knob.link)
    search = _Search(problem, knob, goal, seed, progress)
    low, high = search.bracket()
    if not knob.whole:
        low, high = search.close_in(low, high)
        if low is high:
            return search.refine(low, standard_error)
    found = search.measure(low, standard_error)
    return found if search.meets_exactly(low) else replace(found, beyond=search.measure(high, standard_error))


def _knob(problem: Problem, link: LinkName | None) -> Knob:
    """Return the parameter that is turned, for the rate of a link."""
    continuous, given = isinstance(problem.plant, ContinuousPlant), problem.parameters
    knobs = [
        knob
        for knob in KNOBS[problem.kind]
        if knob.continuous in (None, continuous)
        and (knob.link is None or (knob.name in given and link in (None, knob.link)))
    ]
    knobs = [knob for knob in knobs if knob.name in given] or knobs[:1]
    if len(knobs) > 1:
        raise ProblemError(f"{problem.kind} decides on two links; expected link, one of {[k.link for k in knobs]}")
    if not knobs:
        raise ProblemError(f"{problem.kind} has no parameter for this rate; expected another kind, such as lqg")
    return knobs[0]


@dataclass(frozen=True)
class _Goal:
    """What is to be met: ``rate`` or ``cost``, and how large it may be."""

    name: str
    budget: float
    link: LinkName | None

    def rate(self, evaluation: Evaluation) -> Estimate:
        link = next(iter(evaluation.rates)) if self.link is None else self.link
        if link not in evaluation.rates:
            raise ProblemError(
                f"link is {link!r}, on which {evaluation.policy} does not decide; "
                f"expected {' or '.join(evaluation.rates)}"
            )
        return evaluation.rates[link]

    def of(self, evaluation: Evaluation) -> Estimate:
        return evaluation.cost if self.name == "cost" else self.rate(evaluation)


@dataclass(frozen=True, eq=False)
class _Look:
    """One value of the knob: what was found, and by how much it is above the budget."""

    value: float
    evaluation: Evaluation
    above: float
    error: float


class _Search:
    """Looks at values of the knob.

    Args:
        problem: what is tuned.
        knob: what is turned.
        goal: what is sought.
        seed: of the draws.
        progress: called with the fraction done.
    """

    def __init__(self, problem: Problem, knob: Knob, goal: _Goal, seed: int, progress: Progress | None) -> None:
        """Look at nothing yet."""
        self.problem, self.knob, self.goal, self.seed, self.progress = problem, knob, goal, seed, progress
        self.rising = knob.falls == (goal.name == "cost")  # whether what is sought rises with the value
        self._seen: dict[float, _Look | TaciturnError] = {}

    def look(self, value: float) -> _Look | None:
        """Return what a value leads to; None where nothing can be designed or the loop diverges."""
        if value not in self._seen:
            try:
                self._seen[value] = self._settled(value)
            except TaciturnError as error:
                self._seen[value] = error
            if self.progress is not None:
                self.progress(1 - 0.93 ** len(self._seen))  # how many there will be is not known
        found = self._seen[value]
        return found if isinstance(found, _Look) else None

    def _settled(self, value: float) -> _Look:
        found = self._look(value, EFFORT)
        if not found.evaluation.reached:
            found = self._look(value, LONGER * EFFORT)
        if not found.evaluation.reached:
            given = f"{self.problem.kind} with {self.knob.name} = {value:g}"
            raise UnstableError(f"{given} does not settle within {LONGER * EFFORT} steps")
        return found

    def _look(self, value: float, steps: int | None = None, standard_error: float | None = None) -> _Look:
        changed = self.problem.changed({self.knob.name: value})
        evaluation = look_at(changed, self.seed, steps, standard_error)
        found = self.goal.of(evaluation)
        return _Look(value, evaluation, found.value - self.goal.budget, found.standard_error + found.error)

    def meets_exactly(self, look: _Look) -> bool:
        """Tell whether a look is on the budget."""
        return abs(look.above) <= max(EXACT * self.goal.budget, CLOSE * look.error)

    def bracket(self) -> tuple[_Look, _Look]:
        """Return the looks next to the budget, not above it and above it, as far as a walk finds them.

        Raises:
            ProblemError: no value reaches the budget.
        """
        here = self._start()
        if self.meets_exactly(here):
            return here, here
        outwards = -1.0 if (here.above > 0) == self.rising else 1.0
        found = self._walk(here, outwards)
        if found is None:
            nearest = min(self._looks(), key=lambda look: abs(look.above))
            if abs(nearest.above) > SURE * nearest.error:
                self._refuse()
            return nearest, nearest  # a rate of 1, which a vanishing threshold approaches
        before, after = found
        if self.meets_exactly(after):
            return after, after
        low, high = (before, after) if before.above <= 0 else (after, before)
        while self.knob.whole and (middle := self._between(low, high)) is not None:
            low, high = (middle, high) if middle.above <= EXACT * self.goal.budget else (low, middle)
        return low, high

    def _between(self, low: _Look, high: _Look) -> _Look | None:
        """Return the look at the whole number nearest to the middle that can be designed, or None."""
        first, last = sorted((int(low.value), int(high.value)))
        for away in range(min(PASSED, (last - first) // 2)):
            for value in (middle := (first + last) // 2) - away, middle + away:
                look = self.look(value) if first < value < last else None
                if look is not None:
                    return look
        return None

    def close_in(self, low: _Look, high: _Look) -> tuple[_Look, _Look]:
        """Return a look on the budget, twice; or those on both sides of a jump."""
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
        if above(places[0]) * above(places[1]) > 0:  # at the end of what can be reached a digit decides the side
            nearest = min(ends, key=lambda look: abs(look.above))
            return nearest, nearest
        _scipy.crossing(above, *places, JUMP)
        return ends[0], ends[1]

    def _width(self, ends: list[_Look]) -> float:
        return abs(self._place(ends[0].value) - self._place(ends[1].value))

    def refine(self, look: _Look, standard_error: float | None) -> Tuned:
        """Return the answer at full precision, corrected along the slope of the looks around it."""
        place = self._place(look.value)
        around = [self.look(self._value(place + step)) for step in (-SPAN, SPAN)]
        near = [one for one in around if one is not None]
        slope = pace = blur = 0.0
        if len(near) == 2:
            slope = (near[1].above - near[0].above) / (2 * SPAN)
            rates = [self.goal.rate(one.evaluation).value for one in near]
            pace = (rates[1] - rates[0]) / (2 * SPAN)
        measured = self._look(look.value, LONGER * EFFORT) if look.error and slope else look
        for _ in range(ROUNDS):
            blur = measured.error  # of what decides the place
            place -= float(np.clip(measured.above / slope, -STRIDE, STRIDE)) if slope else 0.0
            measured = self._look(self._value(place), standard_error=standard_error)
            if abs(measured.above) <= max(SURE * measured.error, EXACT * self.goal.budget) or not slope:
                break
        else:
            measured = replace(measured, evaluation=replace(measured.evaluation, reached=False))
        changes = slope / (measured.value - self.knob.least)
        error = blur / abs(changes) if changes else None
        costs = [one.evaluation.cost.value for one in near]
        along = (costs[1] - costs[0]) / (2 * SPAN) / pace if pace else None
        return self._tuned(measured, error, along)

    def measure(self, look: _Look, standard_error: float | None) -> Tuned:
        """Return a look at full precision, as it is."""
        return self._tuned(self._look(look.value, standard_error=standard_error), 0.0, None)

    def _tuned(self, look: _Look, error: float | None, slope: float | None) -> Tuned:
        parameter = Parameter(self.knob.name, look.value, error)
        return Tuned(parameter, self.problem.changed({self.knob.name: look.value}), look.evaluation, None, slope)

    def _start(self) -> _Look:
        """Return the look at the value that is given, or at the nearest that can be designed."""
        given = self.problem.parameters.get(self.knob.name)
        usual = max(self.knob.least, 1) if self.knob.whole else self.knob.least + 1.0
        start = given if isinstance(given, int | float) and given > self.knob.least else usual
        for k in range(9):
            for sign in (1.0, -1.0):
                found = self.look(self._moved(start, sign * k * FIRST))
                if found is not None:
                    return found
        why = self._seen[start]
        assert isinstance(why, TaciturnError)
        raise why

    def _walk(self, here: _Look, outwards: float) -> tuple[_Look, _Look] | None:
        """Return the last two looks of a walk that passes the budget, or None where it ends before."""
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

    def _edge(self, last: _Look, outwards: float, start: float, beyond: float) -> _Look:
        """Return the farthest look short of where nothing can be designed any more."""
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
        """Say what can be reached.

        Raises:
            ProblemError: always.
        """
        start = self._looks()[0]
        for outwards in (-1.0, 1.0):
            self._walk(start, outwards)
        looks = self._looks()
        found = sorted(self.goal.of(look.evaluation).value for look in looks)
        values = sorted(look.value for look in looks)
        failed = next((str(error) for error in self._seen.values() if isinstance(error, TaciturnError)), None)
        raise ProblemError(
            f"no {self.knob.name} gives {self.problem.kind} the {self.goal.name} {self.goal.budget:g}: from "
            f"{values[0]:.4g} to {values[-1]:.4g} it reaches {self.goal.name}s from {found[0]:.5g} to {found[-1]:.5g}"
            + (f" (beyond: {failed})" if failed else "")
            + f"; expected a {self.goal.name} in between"
        )

    def _looks(self) -> list[_Look]:
        return [look for look in self._seen.values() if isinstance(look, _Look)]

    def _place(self, value: float) -> float:
        """Return where a value is on the axis that is searched."""
        return float(np.log(value - self.knob.least + self.knob.whole))

    def _value(self, place: float) -> float:
        return self.knob.least + float(np.exp(place))

    def _moved(self, start: float, by: float) -> float:
        """Return the value that is so far from another; of whole numbers at least the next."""
        place = self._place(start) + by
        if not self.knob.whole:
            return self._value(place) if by else start
        value = round(min(np.exp(place), 1e9)) - 1 + int(self.knob.least)
        return int(max(self.knob.least, value if value != start or by == 0 else start + np.sign(by)))
