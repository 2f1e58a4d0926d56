"""Tuning: the parameter with which a policy meets a budget: of rate, traffic, cost, or violation of limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import cast

from taciturn._arrays import number
from taciturn._progress import Progress, Stages, answered_within, in_notebook
from taciturn.design.kind import TradeoffParameter
from taciturn.errors import ProblemError
from taciturn.model.limits import Limits
from taciturn.model.plant import ContinuousPlant
from taciturn.problem import Problem
from taciturn.problem.bare import Studied, as_problem
from taciturn.simulation.average import check_effort
from taciturn.study.clock import Cycle, Either, Ticked
from taciturn.study.evaluate import evaluate, with_written
from taciturn.study.fair import clock_of
from taciturn.study.measure import Request
from taciturn.study.tuning.budget import budget_of
from taciturn.study.tuning.goal import EXACT, CostGoal, Goal, RateGoal, RatesGoal, TrafficGoal, ViolationGoal
from taciturn.study.tuning.refine import Refinement
from taciturn.study.tuning.search import Look, Search
from taciturn.study.tuning.shares import Division
from taciturn.study.tuning.tuned import Parameter, Tuned
from taciturn.study.violated import with_violations

DIVIDED = 0.7  # share of the progress in which the shares are tuned


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
    """Return the parameter with which a problem's policy meets a budget: its rate, traffic, cost or violation.

    The parameter is the tuning parameter of the policy kind. If rate or cost are not monotone in it, the answer is the
    largest value found at which they cross the budget in the usual direction. All trials of the search use the same
    draws. The answer is then measured more precisely and corrected, until it is at least two
    standard errors within the budget. If the rate jumps across the budget, as for integer parameters, the answer is the
    policy on the side of the jump that meets the budget. A budget that is exceeded by at most 1e-9 of it counts as met,
    since costs and rates have rounding errors of this size.

    If the policy divides a threshold among several links, the shares of the links are tuned too, unless the problem
    states them or a link is named: for the least traffic at a cost, or for the least cost at a traffic or at given
    rates. Links without a given rate then send every sample, as this costs least. For a cost or a traffic, shares with
    which the loop does not settle in a short trial are left out.

    Args:
        problem: the problem whose policy is tuned; the search starts at its value of the parameter.
        rate: largest rate, in sends per step or per second, or ``"50%"`` of the rate of sending every sample; the
            answer is as close to this limit as possible. Or largest rates of several links by name.
        cost: largest cost, per step, per second or per finite-horizon run, or ``"+5%"`` above the cost of sending every
            sample; the answer is as close to this limit as possible.
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
        bar, divided = Stages(in_notebook(progress)), _divides(problem, goal, link)
        if divided:
            Search(problem, tuning, goal, seed, None).expect_start()
            problem = problem.changed(Division(problem, tuning, goal, seed, bar.stage(0.0, DIVIDED)).best())
            bar = bar.stage(DIVIDED, 1.0)
        shares = cast("Mapping[str, float]", problem.parameters[str(problem.record.shares)]) if divided else None
        found = replace(_found(problem, tuning, goal, seed, standard_error, bar), shares=shares)
        evaluation = with_written(found.problem, Request(seed, None, None, "auto"), found.evaluation, Stages(None))
        found = replace(found, evaluation=evaluation)
        return found if problem.limits is None else _limited(found, problem.limits, seed)


def _limited(found: Tuned, limits: Limits, seed: int) -> Tuned:
    """Return an answer with the limits of the problem, and with the probabilities of their violation."""
    problem, evaluation = replace(found.problem, limits=limits), found.evaluation
    if evaluation.violations is None:
        evaluation = with_violations(problem, limits, Request(seed, None, None, "auto"), evaluation, Stages(None))
    beyond = None if found.beyond is None else _limited(found.beyond, limits, seed)
    return replace(found, problem=problem, evaluation=evaluation, beyond=beyond)


def _found(
    problem: Problem, tuning: TradeoffParameter, goal: Goal, seed: int, standard_error: float | None, bar: Progress
) -> Tuned:
    """Return the value of a parameter that meets a budget."""
    search = Search(problem, tuning, goal, seed, bar)
    if (
        tuning.cycles
        and not isinstance(goal, ViolationGoal)
        and (cycles := _next_to(problem, tuning, goal, search)) is not None
    ):
        return cycles
    refinement, (low, high) = Refinement(search, standard_error), search.bracket()
    if not tuning.whole:
        low, high, error, slope = refinement.refine(*search.close_in(low, high))
        found = _tuned(search, low, error, slope)
        return found if low is high else replace(found, beyond=_tuned(search, high, error, slope))
    found = _tuned(search, refinement.measure_within(low), 0.0, None)
    if search.meets_exactly(low):
        return found
    return replace(found, beyond=_tuned(search, refinement.measure(high), 0.0, None))


def _goal(problem: Problem, tuning: TradeoffParameter, budgets: Mapping[str, object], link: str | None) -> Goal:
    """Return the one budget that is given.

    Raises:
        ProblemError: no budget or several budgets are given, or the budget is not valid.
    """
    given = {name: budget for name, budget in budgets.items() if budget is not None}
    if len(given) != 1:
        got = " and ".join(given) + " are given" if given else "none of rate, cost, traffic and violation is given"
        raise ProblemError(f"{got}; expected one of them as the budget: rate, cost, traffic or violation")
    ((name, budget),) = given.items()
    if name == "violation":
        if problem.limits is None:
            raise ProblemError(
                "violation is given for a problem without limits of its states; expected limits, as [limits] in a file"
            )
        return ViolationGoal(number("violation", budget, 0.0, 1.0), link or tuning.link)
    if isinstance(budget, Mapping):
        if link is not None or not budget:
            raise ProblemError(f"rate is {budget!r} and link is {link!r}; expected rates by link, and no link")
        limits = cast("Mapping[str, object]", budget)
        return RatesGoal(limits={one: budget_of(problem, tuning, "rate", limit) for one, limit in limits.items()})
    limit = budget_of(problem, tuning, name, budget)
    if name == "traffic":
        return TrafficGoal(limit)
    return (RateGoal if name == "rate" else CostGoal)(limit, link or tuning.link)


def _divides(problem: Problem, goal: Goal, link: str | None) -> bool:
    """Return whether the shares of several links are to be tuned.

    Raises:
        ProblemError: several rates are given, but the policy kind has one parameter for all links.
    """
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
    )


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
    below, above = (_at_cycle(search, point.cycle) for point in found)
    keeps, beyond = (below, above) if isinstance(goal, RateGoal) else (above, below)
    if goal.of(beyond.evaluation).value <= goal.budget * (1 + EXACT):
        return beyond
    meets = goal.of(keeps.evaluation).value >= goal.budget * (1 - EXACT)
    return keeps if meets else replace(keeps, beyond=beyond)


def _at_cycle(search: Search, cycle: Cycle | None) -> Tuned:
    assert cycle is not None
    name, value = search.tuning.name, cycle[0] if len(cycle) == 1 else cycle
    changed = search.problem.changed({name: value})
    return Tuned(search.goal, Parameter(name, value, 0.0), changed, evaluate(changed), None, None)


def _tuned(search: Search, look: Look, error: float | None, slope: float | None) -> Tuned:
    name = search.tuning.name
    changed = search.problem.changed({name: look.value})
    return Tuned(search.goal, Parameter(name, look.value, error), changed, look.evaluation, None, slope)


def _tuning(problem: Problem, link: str | None) -> TradeoffParameter:
    """Return the tuning parameter for the rate of a link."""
    continuous, given = isinstance(problem.plant, ContinuousPlant), problem.parameters
    tunings = [
        tuning
        for tuning in problem.record.tuning
        if tuning.continuous in (None, continuous)
        and (tuning.link is None or (tuning.name in given and link in (None, tuning.link)))
    ]
    if not tunings and (links := sorted({one.link for one in problem.record.tuning if one.link is not None})):
        raise ProblemError(
            f"link is {link!r}, for which {problem.kind} has no parameter; expected {' or '.join(links)}"
        )
    tunings = [tuning for tuning in tunings if tuning.name in given] or tunings[:1]
    if len(tunings) > 1 and all(tuning.link is None for tuning in tunings):
        tunings = tunings[:1]
    if len(tunings) > 1:
        raise ProblemError(
            f"{problem.kind} decides on two links; expected link to be one of {[k.link for k in tunings]}"
        )
    if not tunings:
        raise ProblemError(f"{problem.kind} has no parameter that changes this rate; expected {problem.record.remedy}")
    return tunings[0]
