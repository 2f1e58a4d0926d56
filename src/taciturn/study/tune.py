"""The parameter of a policy that meets a budget: a rate, or a cost."""

from __future__ import annotations

from dataclasses import replace

from taciturn._progress import Progress
from taciturn.design.catalogue import KNOBS, Knob
from taciturn.errors import ProblemError
from taciturn.model.plant import ContinuousPlant
from taciturn.model.policy import LinkName
from taciturn.problem import Problem, expect_problem
from taciturn.simulation.average import check_effort
from taciturn.study.budget import budget_of
from taciturn.study.clock import Cycle, Either, Ticked
from taciturn.study.evaluate import evaluate
from taciturn.study.fair import clock_of
from taciturn.study.search import EXACT, Goal, Look, Search
from taciturn.study.tuned import Parameter, Tuned


def tune(
    problem: Problem,
    *,
    rate: float | str | None = None,
    cost: float | str | None = None,
    link: LinkName | None = None,
    seed: int = 0,
    standard_error: float | None = None,
    progress: Progress | None = None,
) -> Tuned:
    """Return the parameter with which a problem's policy sends at a rate, or costs so much.

    The parameter is the knob of the policy kind; rate and cost are taken to be monotone in it. The search looks at the
    same draws again and again, and corrects its answer once it is measured more precisely, until it is at least two
    standard errors within the budget. Where the rate jumps, as with whole numbers, the answer is the policy next to the
    budget that keeps it.

    Args:
        problem: its policy; the value that its parameter has is where the search starts.
        rate: at most so many sends per step or per second, or ``"50%"`` of the rate of sending always; the answer
            sends as little less as it can.
        cost: at most so much per step, per second or per mission, or ``"+5%"`` above the cost of sending always; the
            answer costs as little less as it can.
        link: whose rate; omitted where the policy decides one only.
        seed: of the draws.
        standard_error: absolute, of the cost of the answer; omitted: 1e-4 of it.
        progress: called with the fraction done.

    Returns:
        The parameter with the standard error that it has as an answer to the budget, the evaluation at this parameter,
        whose standard errors are those of any evaluation, and the confidence with which the budget is kept.

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
    goal = Goal(name, budget_of(problem, knob, name, budget), link or knob.link)
    search = Search(problem, knob, goal, seed, progress)
    if knob.cycles and (cycles := _next_to(problem, knob, goal, search)) is not None:
        return cycles
    low, high = search.bracket()
    if not knob.whole:
        low, high = search.close_in(low, high)
        if low is high:
            return _tuned(search, *search.refine(low, standard_error))
    found = _tuned(search, search.measure_within(low, standard_error), 0.0, None)
    if search.meets_exactly(low):
        return found
    return replace(found, beyond=_tuned(search, search.measure(high, standard_error), 0.0, None))


def _next_to(problem: Problem, knob: Knob, goal: Goal, search: Search) -> Tuned | None:
    """Return the cycle next to the budget that keeps it, and the one beyond; None where no exact cost tells them."""
    always = problem.changed({knob.name: 1})
    policy = always.designed()
    clock = clock_of(always, policy)
    clock = clock.ticked if isinstance(clock, Either) else clock
    if not isinstance(clock, Ticked):
        return None
    search.expect_possible(evaluate(always))
    found = clock.around(goal.budget) if goal.name == "rate" else clock.around_cost(goal.budget)
    if found is None:
        return None
    below, above = (_at_cycle(search, point.cycle) for point in found)
    keeps, beyond = (below, above) if goal.name == "rate" else (above, below)
    if goal.of(beyond.evaluation).value <= goal.budget * (1 + EXACT):
        return beyond
    meets = goal.of(keeps.evaluation).value >= goal.budget * (1 - EXACT)
    return keeps if meets else replace(keeps, beyond=beyond)


def _at_cycle(search: Search, cycle: Cycle | None) -> Tuned:
    assert cycle is not None
    name, value = search.knob.name, cycle[0] if len(cycle) == 1 else cycle
    changed = search.problem.changed({name: value})
    return Tuned(search.goal, Parameter(name, value, 0.0), changed, evaluate(changed), None, None)


def _tuned(search: Search, look: Look, error: float | None, slope: float | None) -> Tuned:
    name = search.knob.name
    changed = search.problem.changed({name: look.value})
    return Tuned(search.goal, Parameter(name, look.value, error), changed, look.evaluation, None, slope)


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
    if len(knobs) > 1 and all(knob.link is None for knob in knobs):
        knobs = knobs[:1]
    if len(knobs) > 1:
        raise ProblemError(f"{problem.kind} decides on two links; expected link, one of {[k.link for k in knobs]}")
    if not knobs:
        raise ProblemError(f"{problem.kind} has no parameter for this rate; expected another kind, such as lqg")
    return knobs[0]
