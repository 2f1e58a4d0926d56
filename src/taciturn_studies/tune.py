"""Tuning: find the parameter at which a policy meets a budget for rate, traffic, cost, or violation of limits.

``tune`` brackets the budget along the tuning parameter of the policy kind, closes in on it with common random draws
(``search``), and then measures the answer more precisely and corrects it, until it is at least two standard errors
within the budget. If the rate jumps across the budget, as for integer parameters, the answer is the policy on the side
that meets the budget, and ``beyond`` is the one on the other side. For time-triggered control with an exact cost, both
are neighbouring cycles of send intervals. If a policy divides its threshold among links, the shares are tuned first.

``tune_period`` also tunes the period τ of the checks, at a given rate: τ is halved, and the threshold is tuned again,
until a halving gains less than a hundredth of the excess over the cost of sending every sample.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, cast

from taciturn.design.kind import TradeoffParameter
from taciturn.errors import ProblemError
from taciturn.extend import (
    HEIGHT,
    Level,
    Panel,
    Progress,
    Series,
    Size,
    Stages,
    StyleName,
    answered_within,
    draw,
    in_notebook,
    number,
    number_of,
    per_unit,
    percent,
    symbol,
)
from taciturn.lqg.discrete import has_average
from taciturn.model.estimate import Estimate
from taciturn.model.limits import Limits
from taciturn.model.plant import ContinuousPlant
from taciturn.model.policy import Policy
from taciturn.model.result import SPLICED, VERDICT, Field, Part, Result, Tabular
from taciturn.problem import Problem
from taciturn.problem.without_file import Studied, as_problem
from taciturn.simulation.average import check_effort
from taciturn.study.evaluate import evaluate, with_violations, with_written
from taciturn.study.evaluation import Evaluation, cost_text, packets_text
from taciturn.study.measure import Request
from taciturn.study.periodic import Cycle, Either, Ticked, clock_of
from taciturn.study.sentences import THAN, percent_text, shares_text
from taciturn_studies.goal import (
    EXACT,
    Goal,
    RateGoal,
    RatesGoal,
    RelativeCostGoal,
    TrafficGoal,
    ViolationGoal,
    budget_of,
    cost_goal,
)
from taciturn_studies.search import Attempt, Search
from taciturn_studies.shares import Division

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HALF = 0.55 * HEIGHT  # of one of two panels
WIDE = 10.0  # ratio of the largest and the smallest value above which the axis of the values is logarithmic
DIVIDED = 0.7  # share of the progress in which the shares are tuned
FASTER = 2.0  # from one period to the next
ENOUGH = 0.01  # share of the excess over the cost of sending every sample: a smaller gain ends the search
MOST = 20  # periods
SUREST = 0.999  # confidence beyond which errors are hardly normal, and of which no more is told
LEFT = 0.7  # share of the remaining progress that a period leaves; their number is not known in advance


def tune(
    problem: Studied,
    *,
    rate: float | str | Mapping[str, float | str] | None = None,
    cost: float | str | None = None,
    traffic: float | str | None = None,
    violation: float | None = None,
    link: str | None = None,
    seed: int = 0,
    standard_error: float | None = None,
    time_limit: float | None = None,
    progress: Progress | None = None,
) -> Tuned:
    """Find the parameter value at which a policy meets a budget for its rate, traffic, cost or violation.

    The parameter is the tuning parameter of the policy kind. If rate or cost is not monotone in the parameter, the
    answer is the largest value found at which it crosses the budget in the usual direction. All trials of the search
    use the same random numbers. The answer is then measured more precisely and corrected, until it is at least two
    standard errors within the budget. If the rate jumps across the budget, as for integer parameters, the answer is the
    policy on the side of the jump that meets the budget. A budget that is exceeded by at most 1e-9 of it counts as met,
    since costs and rates have rounding errors of this size.

    If the policy divides a threshold among several links, the shares of the links are tuned too, unless the problem
    states them or a link is named: for the least traffic at a cost, or for the least cost at a traffic or at given
    rates. Links without a given rate then send every sample, because this costs least. For a cost or a traffic, the
    search skips shares for which the loop does not settle in a short trial.

    Args:
        problem: the problem whose policy is tuned; the search starts at its value of the parameter.
        rate: largest rate, in sends per step or per second, or ``"50%"`` of the rate of sending every sample; the
            answer is as close to this limit as possible. Or largest rates of several links by name.
        cost: largest cost, per step, per second or per finite-horizon run, or ``"+5%"`` above the cost of sending every
            sample (with limits, losses or another plant: as simulated on the same random numbers); the answer is as
            close to this limit as possible.
        traffic: largest sum of the rates of all links, each times the price of a packet (``price`` of the link), or
            ``"50%"`` of that of sending every sample.
        violation: largest share of the steps in which limits of the states are violated, for a problem with limits; the
            answer is as close to this limit as its standard error allows, and has the fewest packets. Shares of several
            links are not tuned.
        link: link whose rate is meant; may be omitted if the policy decides on a single link.
        seed: seed of the random draws.
        standard_error: absolute standard error of the cost of the answer; default: 1e-4 of the cost.
        time_limit: time limit in seconds; default: none. Without a result in time, an error is raised.
        progress: callback that receives the fraction done.

    Returns:
        The parameter with its standard error as a solution of the budget, the shares if they were tuned, the evaluation
        at this parameter with its own standard errors, and the confidence with which the budget is met.

    Raises:
        ProblemError: no value reaches the budget, no budget or several budgets are given, or the policy has no such
            parameter.
        UnstableError: no value gives a stable loop.

    Example:
        >>> from taciturn import load
        >>> found = tune(load("two-mass-lqg"), rate=0.3, standard_error=1e-3)
        >>> round(found.parameter.value, 1), round(found.evaluation.rates["actuator"].value, 2)
        (1.1, 0.3)
    """
    with answered_within(time_limit):
        problem = as_problem("problem", problem)
        check_effort(seed, standard_error, None)
        if isinstance(rate, Mapping) and len(rate) == 1 and link is None and problem.record.shares is None:
            ((link, rate),) = rate.items()
        tuning = _tuning(problem, link)
        goal = _goal(problem, tuning, {"rate": rate, "cost": cost, "traffic": traffic, "violation": violation}, link)
        bar, divided = Stages(in_notebook(progress)), _divides(problem, tuning, goal, link)
        if divided:
            Search(problem, tuning, goal, seed, None).expect_start()
            problem = problem.changed(Division(problem, tuning, goal, seed, bar.stage(0.0, DIVIDED)).best())
            bar = bar.stage(DIVIDED, 1.0)
        shares = cast("Mapping[str, float]", problem.parameters[str(problem.record.shares)]) if divided else None
        found = replace(_found(problem, tuning, goal, seed, standard_error, bar), shares=shares)
        evaluation = with_written(found.problem, Request(seed, None, None, "auto"), found.evaluation, Stages(None))
        found = replace(found, evaluation=evaluation)
        return found if problem.limits is None else _limited(found, problem.limits, seed)


def tunings_of(problem: Problem, link: str | None) -> list[TradeoffParameter]:
    """Return the tuning parameters for one link's rate, or every link's; parameters set in the problem come first."""
    continuous, given = isinstance(problem.plant, ContinuousPlant), problem.parameters
    tunings = [
        tuning
        for tuning in problem.record.tuning
        if tuning.continuous in (None, continuous)
        and (tuning.link is None or (tuning.name in given and link in (None, tuning.link)))
    ]
    tunings = [tuning for tuning in tunings if tuning.name in given] or tunings[:1]
    return tunings[:1] if all(tuning.link is None for tuning in tunings) else tunings


def _tuning(problem: Problem, link: str | None) -> TradeoffParameter:
    """Return the tuning parameter for the rate of a link."""
    tunings = tunings_of(problem, link)
    if not tunings and (links := sorted({one.link for one in problem.record.tuning if one.link is not None})):
        raise ProblemError(
            f"link is {link!r}, but the policy kind {problem.kind} has no parameter for this link; expected the link "
            f"{' or '.join(links)}"
        )
    if len(tunings) > 1:
        raise ProblemError(
            f"the policy kind {problem.kind} has tuning parameters for two links; expected the option 'link' with one "
            f"of {[k.link for k in tunings]}"
        )
    if not tunings:
        raise ProblemError(
            f"the policy kind {problem.kind} has no parameter that changes this rate; expected {problem.record.remedy}"
        )
    return tunings[0]


def _goal(problem: Problem, tuning: TradeoffParameter, budgets: Mapping[str, object], link: str | None) -> Goal:
    """Return the one budget that is given."""
    given = {name: budget for name, budget in budgets.items() if budget is not None}
    if len(given) != 1:
        got = " and ".join(given) + " are given" if given else "none of rate, cost, traffic and violation is given"
        raise ProblemError(
            f"tuning needs one budget, but {got}; expected exactly one budget: rate, cost, traffic or violation, for "
            "example a rate of 50%, or a cost of +5% compared with sending every sample"
        )
    ((name, budget),) = given.items()
    if name == "violation":
        if problem.limits is None:
            raise ProblemError(
                "violation is given for a problem without state limits; expected state limits, as [limits] in a file"
            )
        return ViolationGoal(number("violation", budget, 0.0, 1.0), link or tuning.link)
    if isinstance(budget, Mapping):
        if link is not None or not budget:
            raise ProblemError(
                f"rate is {budget!r} and link is {link!r}; expected a rate for each link, without the option 'link'"
            )
        limits = cast("Mapping[str, object]", budget)
        return RatesGoal(limits={one: budget_of(problem, tuning, "rate", limit) for one, limit in limits.items()})
    if name == "cost":
        return cost_goal(problem, tuning, budget, link or tuning.link)
    limit = budget_of(problem, tuning, name, budget)
    return TrafficGoal(limit) if name == "traffic" else RateGoal(limit, link or tuning.link)


def _divides(problem: Problem, tuning: TradeoffParameter, goal: Goal, link: str | None) -> bool:
    """Return whether the shares of several links are to be tuned."""
    name = problem.record.shares
    stated = name is None or name in problem.parameters
    if isinstance(goal, RatesGoal):
        if stated:
            why = f"{problem.kind} has one parameter for all links" if name is None else f"{name} is given too"
            raise ProblemError(
                f"the rates of links ({', '.join(goal.limits)}) are given, but {why}; expected the rate of one link, "
                "with link (--rate X --link NAME)"
            )
        return True
    return (
        not stated
        and link is None
        and not isinstance(goal, RateGoal | ViolationGoal)
        and len(problem.network.links) > 1
        and _decides_on_several(problem.changed({tuning.name: tuning.value_in(problem.parameters)}))
    )


def _decides_on_several(problem: Problem) -> bool:
    """Return whether a policy decides on several links: with a given controller, a kind may decide on one only."""
    policy = problem.designed()
    return isinstance(policy, Policy) and len(policy.scheduled) > 1


def _found(
    problem: Problem, tuning: TradeoffParameter, goal: Goal, seed: int, standard_error: float | None, bar: Progress
) -> Tuned:
    """Return the value of a parameter that meets a budget."""
    search = Search(problem, tuning, goal, seed, bar, standard_error)
    if (
        tuning.cycles
        and not isinstance(goal, ViolationGoal | RelativeCostGoal)
        and (cycles := _next_to(problem, tuning, goal, search)) is not None
    ):
        return cycles
    found = _closed_in(search, tuning)
    return replace(found, tried=search.tried())


def _closed_in(search: Search, tuning: TradeoffParameter) -> Tuned:
    """Return the value of a parameter that a search finds."""
    low, high = search.bracket()
    if not tuning.whole:
        low, high, error, slope = search.refine(*search.close_in(low, high))
        found = _tuned(search, low.value, low.evaluation, error, slope)
        beyond = None if low is high else _tuned(search, high.value, high.evaluation, error, slope)
        return replace(found, beyond=beyond)
    within = search.measure_within(low)
    found = _tuned(search, within.value, within.evaluation)
    if search.meets_exactly(low):
        return found
    return replace(found, beyond=_tuned(search, high.value, search.try_at(high.value).evaluation))


def _next_to(problem: Problem, tuning: TradeoffParameter, goal: Goal, search: Search) -> Tuned | None:
    """Return the periodic cycle that meets the budget, with the one beyond it, or None if no exact cost is known."""
    always = problem.changed({tuning.name: 1})
    policy = always.designed()
    clock = clock_of(always, policy)
    clock = clock.ticked if isinstance(clock, Either) else clock
    if not isinstance(clock, Ticked):
        return None
    search.expect_possible(evaluate(always))
    found = clock.around(goal.budget) if isinstance(goal, RateGoal) else clock.around_cost(goal.budget)
    if found is None:
        return None
    cycles = [point.cycle or () for point in found]  # at sampling instants, so there is one
    below, above = (_tuned(search, cycle[0] if len(cycle) == 1 else cycle) for cycle in cycles)
    keeps, beyond = (below, above) if isinstance(goal, RateGoal) else (above, below)
    if goal.of(beyond.evaluation).value <= goal.budget * (1 + EXACT):
        return beyond
    meets = goal.of(keeps.evaluation).value >= goal.budget * (1 - EXACT)
    return keeps if meets else replace(keeps, beyond=beyond)


def _tuned(
    search: Search,
    value: float | Cycle,
    evaluation: Evaluation | None = None,
    error: float | None = 0.0,
    slope: float | None = None,
) -> Tuned:
    """Return the answer for a value, which is evaluated if the search has not done so."""
    name = search.tuning.name
    changed = search.problem.changed({name: value})
    return Tuned(search.goal, Parameter(name, value, error), changed, evaluation or evaluate(changed), None, slope)


def _limited(found: Tuned, limits: Limits, seed: int) -> Tuned:
    """Return an answer with the limits of the problem, and with the probabilities of their violation."""
    problem, evaluation = replace(found.problem, limits=limits), found.evaluation
    if evaluation.violations is None:
        evaluation = with_violations(problem, limits, Request(seed, None, None, "auto"), evaluation, Stages(None))
    beyond = None if found.beyond is None else _limited(found.beyond, limits, seed)
    return replace(found, problem=problem, evaluation=evaluation, beyond=beyond)


def tune_period(
    problem: Studied,
    *,
    rate: float,
    least: float,
    link: str | None = None,
    seed: int = 0,
    standard_error: float | None = None,
    time_limit: float | None = None,
    progress: Progress | None = None,
) -> TunedPeriod:
    """Find the sampling period and the policy parameter that give the least cost at a given send rate.

    The theorem of ``consistent`` relates δ to the period τ. At an equal rate, more frequent checks with a larger
    threshold cost less. So τ is halved, and δ is determined again from the exact rate, until a halving reduces the
    excess over the cost of sending every sample by less than a hundredth, or until τ would be below ``least``. The
    consistency of the result is then verified numerically (``Evaluation.consistency``) and no longer guaranteed.

    Args:
        problem: a problem with a continuous plant and a policy that checks every ``period``, the start of the search.
        rate: sends per second.
        least: the shortest period of the sensor, in seconds.
        link: link whose rate is meant; may be omitted if the policy decides on a single link.
        seed: seed of the random draws, if anything is simulated.
        standard_error: absolute standard error of the cost; default: 1e-4 of the cost.
        time_limit: time limit in seconds; default: none. Without a result in time, an error is raised.
        progress: callback that receives the fraction done.

    Raises:
        ProblemError: the policy has no period, the rate cannot be met, or ``least`` is above the period at the start.

    Source: khashooei2017

    Example:
        >>> from taciturn import ContinuousPlant, Cost, Network, Problem
        >>> walk, cost = ContinuousPlant([[0.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
        >>> problem = Problem(walk, cost, Network(), "consistent", {"period": 0.5})
        >>> found = tune_period(problem, rate=1.0, least=0.1)
        >>> found.best.problem.parameters["period"], found.best.evaluation.consistency
        (0.125, 'verified')
    """
    with answered_within(time_limit):
        problem = as_problem("problem", problem)
        period = problem.parameters.get("period")
        if not isinstance(problem.plant, ContinuousPlant) or not isinstance(period, int | float):
            raise ProblemError(
                f"the policy kind {problem.kind} has no period to tune here; expected a continuous plant and "
                "policy.period"
            )
        if not has_average(problem.plant, problem.cost):
            raise ProblemError(
                "the cost counts only the sampling instants, because the disturbances grow without limit and require "
                "an input that changes between samples, so the costs of several periods cannot be compared; expected "
                "disturbances that are constant or decay, or a given period"
            )
        rate, least = number("rate", rate, 0.0), number("least", least, 0.0)
        period = min(float(period), 1 / (FASTER * rate))
        if period < least:
            raise ProblemError(
                f"the least period is {least:g} s, but at {number_of(f'{rate:g}', 'send')} per second the search "
                f"starts from at most {period:g} s; expected a shorter least period, or a lower rate"
            )
        tried: list[Tuned] = []
        parameters = dict(problem.parameters)
        while period >= least and len(tried) < MOST:
            here = problem.changed({**parameters, "period": period})
            part = Stages(progress, *(1 - LEFT ** (len(tried) + k) for k in (0, 1)))
            found = tune(here, rate=rate, link=link, seed=seed, standard_error=standard_error, progress=part)
            tried.append(found)
            if len(tried) > 1 and not _gains(tried[-2], found):
                break
            name, value = found.parameter.name, found.parameter.value
            if isinstance(value, float) and name == "delta":
                value /= FASTER  # δ is a cost per check, so this threshold sends the same error
            parameters[name] = value
            period /= FASTER
        best = min(tried, key=lambda one: one.evaluation.cost.value)
        return TunedPeriod(best, tuple(tried))


def _gains(before: Tuned, after: Tuned) -> bool:
    """Return whether the last halving of the period lowered the cost enough to halve it again."""
    cost, base = after.evaluation.cost, after.evaluation.base
    above = cost.value - (0.0 if base is None else base)
    return before.evaluation.cost.value - cost.value > max(ENOUGH * above, cost.standard_error)


@dataclass(frozen=True, repr=False)
class Parameter(Result):
    """A tuned parameter of a policy, with its standard error.

    Args:
        name: key of ``[policy]``.
        value: a number, or for time-triggered control possibly a cycle of intervals.
        standard_error: standard error of the value, or None if the budget does not depend on the value here.
    """

    name: str
    value: float | Cycle
    standard_error: float | None

    def short(self) -> str:
        """Return a text with the parameter's name and value."""
        return f"{self.name} = {self}"

    def __str__(self) -> str:
        """Return the value, with its standard error if there is one."""
        if isinstance(self.value, tuple):
            return "[" + ", ".join(map(str, self.value)) + "]"
        return str(Estimate(self.value, self.standard_error or 0.0, "simulation"))

    def beside(self, other: Parameter | None) -> str:
        """Format the value with enough digits to tell it from another value, if one is given."""
        if isinstance(self.value, tuple):
            return str(self)
        alike = other is not None and not isinstance(other.value, tuple) and f"{other.value:.6g}" == f"{self.value:.6g}"
        return f"{self.value:.{17 if alike else 6}g}"


def _shares(found: Tuned) -> str:
    return "" if found.shares is None else shares_text(found.shares)


def _beyond(found: Tuned) -> dict[str, Any]:
    """Return the document of the policy on the other side of a jump."""
    rates = {link: rate.value for link, rate in found.evaluation.rates.items()}
    traffic = found.evaluation.traffic
    jump = {"value": found.parameter.value, "cost": found.evaluation.cost.value, "rates": rates}
    return jump | ({} if traffic is None else {"traffic": traffic.value})


def _beyond_text(found: Tuned) -> str:
    other, parameter = found.beyond, found.parameter
    if other is None:
        return ""
    rates = ", ".join(f"rate, {link} {rate}" for link, rate in other.evaluation.rates.items())
    traffic = f", traffic {other.evaluation.traffic}" if found.goal.name == "traffic" else ""
    text = f"{other.parameter.beside(parameter)}: {rates}{traffic}, cost {other.evaluation.cost}"
    jump = f"the {found.goal.name} jumps across the budget; on the other side:"
    return f"{jump} {parameter.name} = {text}"


@dataclass(frozen=True, eq=False, repr=False)
class Tuned(Tabular):
    """A policy whose parameter is tuned to meet a budget.

    Args:
        goal: the budget.
        parameter: the tuned parameter.
        problem: the problem with this parameter.
        evaluation: the evaluation of this problem.
        beyond: the policy on the other side of the jump, if rate and cost jump across the budget.
        slope: derivative of the cost with respect to the rate (or the traffic) at the budget, along the parameter; None
            at a jump.
        shares: tuned shares of the links, by name of the parameter that contains them; None if they were not tuned.
        tried: what the search has tried, by value; empty if the answer needs no search.
    """

    FIELDS: ClassVar[tuple[Field[Tuned], ...]] = (
        Field("parameter", say="", text=lambda found: [(found.parameter.name, str(found.parameter))]),
        Field("budget", "budget", say="budget", text=lambda found: _budget_text(found)),
        Field("evaluation", key=SPLICED),
        VERDICT,
        Field("shares", optional=True, say="shares", text=_shares, after="parameter"),
        Field("tried", optional=True),
        Field("beyond", optional=True, json=_beyond, say="beyond", text=lambda found: _beyond_text(found)),
    )

    goal: Goal
    parameter: Parameter
    problem: Problem
    evaluation: Evaluation
    beyond: Tuned | None
    slope: float | None
    shares: Mapping[str, float] | None = None
    tried: tuple[Attempt, ...] = ()

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentence that states the tuned parameter and the budget, followed by the verdict of the evaluation."""
        return (f"{self.parameter.name} = {self.parameter.beside(None)}: {_kept(self)}", *self.evaluation.verdict)

    @property
    def confidence(self) -> float | None:
        """Confidence that the budget is met, in view of the evaluation's errors; 1 if the evaluation is exact.

        The confidence is None if the standard error cannot be trusted; the notes of the evaluation then say so.
        """
        return self.goal.confidence(self.evaluation)

    @property
    def aim(self) -> str:
        """The budget in words."""
        return self.goal.text(self.evaluation)

    @property
    def drawn(self) -> bool:
        """Whether a number depends on the seed."""
        return self.evaluation.drawn

    @property
    def method(self) -> str:
        """The method that gave cost and rates."""
        return self.evaluation.method

    @property
    def reached(self) -> bool:
        """Whether the requested standard error was reached."""
        return self.evaluation.reached

    @property
    def budget(self) -> dict[str, object]:
        """The limited quantity, its limit, and the confidence that the policy meets the limit."""
        return {"of": self.goal.name, "at_most": self.goal.document, "confidence": self.confidence}

    def summary(self) -> Mapping[str, object]:
        """Return the parameter, the budget, and the resulting cost and rates, by name."""
        found = self.evaluation
        values = {"policy": found.policy, "parameter": self.parameter, "shares": self.shares, "goal": self.goal}
        return {**values, "cost": found.cost, "rates": found.rates, "beyond": self.beyond, "slope": self.slope}

    def about(self) -> dict[str, object]:
        """Return the parameter, the budget, and data about the evaluation, by name."""
        shares = {} if self.shares is None else {"shares": shares_text(self.shares)}
        return {"parameter": self.parameter.short(), **shares, "budget": _budget_text(self), **self.evaluation.about()}

    def table_rows(self) -> Sequence[Any]:
        """Return the rows of the evaluation's table, at the tuned parameter."""
        return self.evaluation.table_rows()

    def row_fields(self) -> tuple[Field[Any], ...]:
        """Return the columns of the table, which are the columns of the evaluation."""
        return self.evaluation.row_fields()

    def plot(self, ax: Any = None, figsize: Size | None = None, style: StyleName = "light") -> Figure:
        """Plot the limited quantity and the cost for each value that the search tried, with the budget and the result.

        If no search was needed, the figure is that of the evaluation.

        Args:
            ax: existing axes to draw in instead of a new figure: two, one above the other.
            figsize: width and height of a new figure, in inches.
            style: ``"light"``, ``"dark"``, ``"paper"`` or ``"paper-wide"``.
        """
        value, found = self.parameter.value, self.evaluation
        if isinstance(value, tuple) or not self.tried:
            return found.plot(ax, figsize, style)
        values = [one.value for one in self.tried]
        wide = min(*values, value) > 0 and max(values) > WIDE * min(values)
        if self.goal.limits_cost:
            other, there = [one.used for one in self.tried], self.goal.use(found)
            label = f"{'sends' if len(found.rates) == 1 else 'traffic'} per {found.rate_unit}"
        else:
            other, there, label = [one.cost for one in self.tried], found.cost, f"cost {per_unit(found.unit)}"
        limited = [
            _searched(values, [one.limited for one in self.tried], "tried"),
            _answer(value, self.goal.of(found), "answer"),
        ]
        cost = cost_text(found, THAN)
        title = f"{symbol(self.parameter.name)} = {value:.4g}: {packets_text(found.rates, found)}, {cost}"
        first = self.goal.limits_cost  # the panel that has the costs
        base = self.goal.base(found) if first else found.base
        every = [] if base is None else [Level(base, "every sample")]
        budget = Level(self.goal.budget, f"budget {self.goal.budget:.4g}", "threshold")
        panels = (
            Panel(limited, "", self.goal.axis(found), title, levels=[*(every if first else ()), budget]),
            Panel(
                [_searched(values, other), _answer(value, there)],
                symbol(self.parameter.name),
                label,
                levels=() if first else every,
            ),
        )
        return draw([replace(one, xlog=wide, height=HALF) for one in panels], ax, figsize, style)

    def table_texts(self) -> Sequence[str]:
        """Return the tables of the evaluation at the tuned parameter."""
        return self.evaluation.table_texts()

    def lines(self, part: Part = "details") -> list[tuple[str, str]]:
        """Return the lines of one part of the text: parameter and budget, then the lines of the evaluation."""
        return super().lines(part) + ([] if part == "verdict" else self.evaluation.lines(part))


def _searched(values: Sequence[float], found: Sequence[Estimate], label: str = "") -> Series:
    """Return the curve of the values that a search has tried."""
    errors = [one.standard_error for one in found]
    return Series(values, [one.value for one in found], label, error=errors, thing="trigger", faint=True)


def _answer(value: float, found: Estimate, label: str = "") -> Series:
    """Return the point of the answer."""
    return Series([value], [found.value], label, "points", [found.standard_error], "policy")


def _budget_text(found: Tuned) -> str:
    """Return a text that states whether the budget is met, with which confidence, and for which plant."""
    written = found.evaluation.as_written
    where = "" if written is None else ", for the plant with the disturbance that is added by default"
    if written is not None and found.goal.limits_cost:
        where += f"; on the plant as written, the cost is {written.cost}"
        where += "" if written.excess is None else f", {percent_text(written.excess)} relative to every sample"
    return f"{_kept(found)}{where}"


def _kept(found: Tuned) -> str:
    """Return the budget, and with which confidence it is met."""
    sure = found.confidence
    if sure is None:
        kept = "met in this simulation, whose standard error cannot be trusted"
    else:
        limited, most = found.goal.of(found.evaluation), found.goal.most(found.evaluation)
        over = limited.value > found.goal.budget
        exactly = f"met up to a rounding error of {EXACT:g} of it" if over else "met exactly"
        exact = limited.standard_error <= EXACT * found.goal.budget
        known = exact or (most is not None and found.goal.budget >= most)
        share = min(math.floor(1000 * sure) / 1000, SUREST)
        kept = exactly if sure == 1 and known else f"met with {percent(share)} confidence"
    return f"{found.goal.text(found.evaluation)}, {kept}"


@dataclass(frozen=True, eq=False, repr=False)
class TunedPeriod(Tabular):
    """The sampling period and the policy parameter that give the least cost at a given rate.

    Args:
        best: the result with the least cost.
        tried: all results, from the longest period to the shortest, all at the requested rate.
    """

    FIELDS: ClassVar[tuple[Field[TunedPeriod], ...]] = (
        Field("period", lambda found: _period(found.best), say="period", text="{:g}"),
        Field("best", key=SPLICED),
        VERDICT,
        Field("periods", lambda found: found.row_documents()),
    )

    best: Tuned
    tried: tuple[Tuned, ...]

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentence that states the best period, followed by the verdict for this period."""
        first, *others = self.best.verdict
        return (f"period = {_period(self.best):g} s, {first}", *others)

    def table_rows(self) -> Sequence[Tuned]:
        """Return the rows of the table, one for each period."""
        return self.tried

    def row_fields(self) -> tuple[Field[Tuned], ...]:
        """Return the columns of the table: period, parameter, cost, and consistency (at most periodic cost)."""
        name = self.best.parameter.name
        return (
            Field("period", _period, column="period", say="period", text="{:g}"),
            Field(name, lambda one: one.parameter.beside(None), key="", column=name, say=name),
            Field(name, "parameter.value"),
            Field("cost", "evaluation.cost", json=lambda cost: cost.value, column="cost", say="cost"),
            Field("consistency", "evaluation.consistency", column="consistency", say="consistent"),
        )

    def plot(self, ax: Any = None, figsize: Size | None = None, style: StyleName = "light") -> Figure:
        """Plot the cost for each sampling period, at the same send rate."""
        periods = [_period(one) for one in self.tried]
        found = [one.evaluation for one in self.tried]
        costs, base = [one.cost.value for one in found], [one.base for one in found]
        errors, name = [one.cost.standard_error for one in found], self.best.parameter.name
        notes = [f"{symbol(name)} = {one.parameter.beside(None)}" for one in self.tried]
        series = [Series(periods, costs, self.best.evaluation.policy, error=errors, thing="policy", notes=notes)]
        every = [(x, y) for x, y in zip(periods, base, strict=True) if y is not None]
        if every:
            series.append(Series([x for x, _ in every], [y for _, y in every], "every sample", thing="every sample"))
        per = per_unit(self.best.evaluation.unit)
        title = f"least cost at a period of {_period(self.best):g} s"
        return draw([Panel(series, "period (s)", f"cost {per}", title, xlog=len(periods) > 1)], ax, figsize, style)

    def table_texts(self) -> Sequence[str]:
        """Return the table of all periods, and the tables of the evaluation at the best period."""
        return (self.table(), *self.best.table_texts())

    def lines(self, part: Part = "details") -> list[tuple[str, str]]:
        """Return the lines of one part of the text: the best period, then the lines of its result."""
        return super().lines(part) + ([] if part == "verdict" else self.best.lines(part))


def _period(found: Tuned) -> float:
    return float(cast("float", found.problem.parameters["period"]))
