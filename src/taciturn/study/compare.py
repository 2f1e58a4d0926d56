"""Policies at the same rate: who costs less, by how much, and with what guarantee."""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from taciturn._arrays import instance, number
from taciturn._figure import Panel, Series, draw
from taciturn._progress import Progress
from taciturn.design.catalogue import CATALOGUE, KNOBS
from taciturn.errors import ProblemError, TaciturnError
from taciturn.loop import Loop
from taciturn.model.estimate import Estimate
from taciturn.model.plant import ContinuousPlant
from taciturn.model.policy import LinkName, Policy
from taciturn.problem import Problem, expect_problem
from taciturn.simulation.average import check_effort, difference
from taciturn.study.evaluate import Evaluation
from taciturn.study.tune import Tuned, tune
from taciturn.study.units import TimeUnit, Unit, cost_unit, rate_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LARGE = 0.05  # share of the cost that a correction for the rate may be
RELATIVE_ERROR = 3e-4  # of the all-time cost, where no standard error is asked


@dataclass(frozen=True, eq=False)
class Contestant:
    """A policy at the rate of the comparison.

    Args:
        name: given by the user.
        policy: its kind.
        link: whose rate it is.
        tuned: the policy; where its rate jumps across the one that is asked, the one below, with the one ``beyond``.
        share: of the time that is spent on ``tuned``, so that the rate is met; the rest on the one beyond.
        cost: at exactly the rate of the comparison.
        above: cost less that of the first of the ranking, its standard error that of the difference.
        cost_bound: proved of the cost at this rate, or None.
    """

    name: str
    policy: str
    link: LinkName
    tuned: Tuned
    share: float
    cost: Estimate
    above: Estimate
    cost_bound: float | None

    @property
    def parameter(self) -> str:
        """Name and value of the parameter that was tuned, or the two between which the time is shared."""
        one, two = self.tuned.parameter, None if self.tuned.beyond is None else self.tuned.beyond.parameter
        values = [one.beside(two), *(() if two is None else (two.beside(one),))]
        return f"{self.tuned.parameter.name} = {' and '.join(values)}"

    @property
    def reached(self) -> bool:
        """Whether rate and standard error were met."""
        return all(one.evaluation.reached for one in (self.tuned, self.tuned.beyond) if one is not None)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Policies at the same rate, the cheapest first.

    Args:
        rate: sends per step or per second; of a mission the mean fraction of its steps.
        unit: what the cost counts per: ``"step"``, ``"second"`` or ``"mission"``.
        cost_all_time: exact cost of sending at every tick, the least that a policy with the most ticks per second has;
            None where none is known.
        ranking: the contestants.
    """

    rate: float
    unit: Unit
    cost_all_time: float | None
    ranking: tuple[Contestant, ...]

    @property
    def rate_unit(self) -> TimeUnit:
        """What the rate counts per."""
        return rate_unit(self.unit)

    def document(self) -> dict[str, Any]:
        """Return the JSON document of ``taciturn compare --json``."""
        return {
            "rate": self.rate,
            "unit": self.unit,
            "cost_all_time": self.cost_all_time,
            "ranking": [
                {
                    "name": one.name,
                    "policy": one.policy,
                    "link": one.link,
                    "parameter": {
                        "name": one.tuned.parameter.name,
                        "value": one.tuned.parameter.value,
                        "standard_error": one.tuned.parameter.standard_error,
                        "beyond": None if one.tuned.beyond is None else one.tuned.beyond.parameter.value,
                        "share": one.share,
                    },
                    "cost": one.cost.document(),
                    "above_best": one.above.document("value", "standard_error"),
                    "cost_bound": one.cost_bound,
                    "statement": None if one.cost_bound is None else one.tuned.evaluation.statement,
                    "notes": list(one.tuned.evaluation.notes),
                }
                for one in self.ranking
            ],
        }

    def plot(self) -> Figure:
        """Return a figure: the cost of each policy with its standard error, and its guarantee where it is in sight."""
        names = [one.name for one in reversed(self.ranking)]
        places = [float(i) for i in range(len(names))]
        costs = [one.cost.value for one in reversed(self.ranking)]
        errors = [one.cost.standard_error for one in reversed(self.ranking)]
        series = [Series(costs, places, "cost", "bars", errors, 0)]
        bounds = [(one.cost_bound, place) for one, place in zip(reversed(self.ranking), places, strict=True)]
        shown = [(bound, place) for bound, place in bounds if bound is not None and bound <= 1.5 * max(costs)]
        if shown:
            series.append(Series([b for b, _ in shown], [p for _, p in shown], "guaranteed", "stars", color=3))
        if self.cost_all_time is not None:
            series.append(Series([self.cost_all_time] * 2, [-0.5, len(names) - 0.5], "all-time", "dashed", color=7))
        title = f"{self.rate:.4g} sends per {self.rate_unit}"
        return draw([Panel(series, f"cost per {self.unit}", "", title, names)], height=1.5 + 0.35 * len(names))


def compare(
    problems: Mapping[str, Problem],
    rate: float,
    *,
    link: LinkName | None = None,
    seed: int = 0,
    standard_error: float | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Compare the policies of several problems at the same rate.

    Each is tuned to the rate. Time-triggered control whose period is all that was given may also measure as often as
    the others, with the best cycle of intervals; the cheaper of both counts. What the rate of a policy misses, a
    standard error or so, is corrected along the slope of cost against rate, and adds to the standard error. A policy
    whose rate jumps shares its time between the two policies on either side. Differences are simulated on common draws
    where both policies are simulated tick by tick.

    Args:
        problems: at least two, by name: the same plant, cost and network, and different policies.
        rate: sends per step, or per second of a continuous plant; of a mission the mean fraction of its steps.
        link: whose rate; omitted where each policy decides one only.
        seed: of the draws.
        standard_error: absolute, of each cost; omitted: 3e-4 of that of sending at every tick.
        progress: called with the fraction done.

    Returns:
        The ranking.

    Raises:
        ProblemError: fewer than two policies, one of them twice, different plants, costs or networks, a policy that
            does not fit them, or a rate that one does not reach.
        UnstableError: a policy has no stable loop.

    Example:
        >>> from taciturn import load
        >>> mass = load("two-mass")
        >>> named = {"hold": mass, "model": mass.changed({"actuation": "model"})}
        >>> [one.name for one in compare(named, 0.3, standard_error=1e-3).ranking]
        ['model', 'hold']
    """
    check_effort(seed, standard_error, None)
    rate = number("rate", rate, 0.0)
    _check(problems, link)
    found: list[Contestant] = []
    for index, (name, choices) in enumerate(_measuring_alike(problems).items()):

        def report(fraction: float, index: int = index) -> None:
            if progress is not None:
                progress((index + 0.8 * fraction) / len(problems))

        try:
            alike: list[Contestant] = []
            for problem in choices:
                wanted = _wanted(problem) if standard_error is None else standard_error
                tuned = tune(problem, rate=rate, link=link, seed=seed + index, standard_error=wanted, progress=report)
                alike.append(_at_rate(name, tuned, rate, link or _only_link(tuned)))
            found.append(min(alike, key=lambda one: one.cost.value))
        except TaciturnError as error:
            raise type(error)(f"{name}: {error}") from None
    found.sort(key=lambda one: one.cost.value)
    ranking, best = tuple(found), None
    while best is None or ranking[0].name != best.name:  # until no difference says that another one is cheaper
        best = ranking[0]
        beside = [replace(one, above=_above(one, best, rate, seed + len(problems))) for one in found]
        ranking = tuple(sorted(beside, key=lambda one: one.above.value))
    return Comparison(rate, cost_unit(found[0].tuned.problem), _all_time(found), ranking)


def _all_time(found: Sequence[Contestant]) -> float | None:
    """Return the least cost of sending at every tick, of the policies with the most ticks per second."""
    answers = [one.tuned.evaluation for one in found]
    fastest = max(one.base_rate or 0.0 for one in answers)
    costs = [one.cost_all_time for one in answers if one.base_rate == fastest]
    return min((cost for cost in costs if cost is not None), default=None)


def _check(problems: Mapping[str, Problem], link: LinkName | None) -> None:
    """Refuse what cannot be compared."""
    instance("problems", problems, Mapping)
    for name, problem in problems.items():
        expect_problem(f"problems[{name!r}]", problem)
    if len(problems) < 2:
        raise ProblemError(f"the number of policies is {len(problems)}; expected at least two, to compare them")
    for (one, first), (other, second) in itertools.combinations(problems.items(), 2):
        for what in ("plant", "actual", "cost", "network", "reference"):
            if not _same(getattr(first, what), getattr(second, what)):
                where = "[plant.actual]" if what == "actual" else f"[{what}]"
                raise ProblemError(f"{one} and {other} differ in {where}; expected the same in all problems")
        if first.kind == second.kind and _same(_fixed(first, link), _fixed(second, link)):
            raise ProblemError(
                f"{one} and {other} are one policy, {first.kind}, at the same rate; expected policies that differ in "
                "more than the parameter that is tuned"
            )


def _measuring_alike(problems: Mapping[str, Problem]) -> dict[str, list[Problem]]:
    """Return the problems; a clock that would measure less often than the others, with one that measures as often."""
    given = [problem.parameters.get("period") for problem in problems.values()]
    periods = [period for period in given if isinstance(period, int | float)]
    found = {name: [problem] for name, problem in problems.items()}
    for name, problem in problems.items():
        plant, knobs = problem.plant, [knob for knob in KNOBS[problem.kind] if knob.cycles]
        seen_in_part = isinstance(plant, ContinuousPlant) and not plant.full_state
        if knobs and seen_in_part and periods and knobs[0].name not in problem.parameters:
            found[name].append(problem.changed({"period": min(periods), knobs[0].name: 1}))
    return found


def _fixed(problem: Problem, link: LinkName | None) -> dict[str, object]:
    """Return the parameters that are not tuned, with those that are not given."""
    defaults = {
        key: parameter.default
        for key, parameter in inspect.signature(CATALOGUE[problem.kind]).parameters.items()
        if parameter.default is not parameter.empty
    }
    tuned = {knob.name for knob in KNOBS[problem.kind] if link is None or knob.link in (None, link)}
    return {key: value for key, value in (defaults | dict(problem.parameters)).items() if key not in tuned}


def _same(one: object, other: object) -> bool:
    """Tell whether two values, data classes of arrays perhaps, are the same."""
    if is_dataclass(one) and type(one) is type(other):
        return all(_same(getattr(one, part.name), getattr(other, part.name)) for part in fields(one))
    if isinstance(one, dict) and isinstance(other, dict):
        known, found = cast("dict[str, object]", one), cast("dict[str, object]", other)
        return known.keys() == found.keys() and all(_same(value, found[key]) for key, value in known.items())
    return bool(np.array_equal(cast("Any", one), cast("Any", other)))


def _wanted(problem: Problem) -> float | None:
    """Return the standard error that is asked of a policy: a share of the all-time cost, where that is known."""
    try:
        return RELATIVE_ERROR * problem.designed().cost_all_time or None
    except TaciturnError:  # at the value that the parameter has now; another may do
        return None


def _at_rate(name: str, tuned: Tuned, rate: float, link: LinkName) -> Contestant:
    """Return the cost of a policy at exactly this rate."""
    here = tuned.evaluation
    bound = _bound(here)
    share, cost = 1.0, here.cost
    if tuned.beyond is not None:
        there = tuned.beyond.evaluation
        low, high = (one.rates[link].value for one in (here, there))
        share = (high - rate) / (high - low)
        cost = Estimate(
            share * cost.value + (1 - share) * there.cost.value,
            float(np.hypot(share * cost.standard_error, (1 - share) * there.cost.standard_error)),
            cost.method,
        )
        other = _bound(there)
        bound = None if bound is None or other is None else share * bound + (1 - share) * other
    elif tuned.slope is not None:
        shift, error = _shift(tuned, rate, link)
        if abs(shift) + error > LARGE * abs(cost.value):
            raise ProblemError(
                f"the cost of {here.policy} cannot be told at the rate {rate:g}, near which it changes by "
                f"{abs(tuned.slope):.2g} per {here.rate_unit}: it is at the edge of what it keeps stable; "
                "expected another rate, or another policy"
            )
        cost = Estimate(cost.value - shift, float(np.hypot(cost.standard_error, error)), cost.method, cost.error)
    return Contestant(name, here.policy, link, tuned, share, cost, Estimate(0.0, 0.0, cost.method), bound)


def _shift(tuned: Tuned, rate: float, link: LinkName) -> tuple[float, float]:
    """Return what the cost is off because the rate is, and its standard error."""
    if tuned.slope is None:
        return 0.0, 0.0
    found = tuned.evaluation.rates[link]
    return tuned.slope * (found.value - rate), abs(tuned.slope) * found.standard_error


def _above(one: Contestant, best: Contestant, rate: float, seed: int) -> Estimate:
    """Return how much more a policy costs than the best."""
    if one.name == best.name:
        return Estimate(0.0, 0.0, one.cost.method)
    pair = (one, best)
    apart = float(np.hypot(one.cost.standard_error, best.cost.standard_error))
    above = Estimate(one.cost.value - best.cost.value, apart, one.cost.method if apart else best.cost.method)
    loop, other = (_loop(contestant) for contestant in pair)
    if loop is None or other is None or loop.problem.tick != other.problem.tick:
        return above
    steps = max(contestant.tuned.evaluation.steps for contestant in pair)
    found = difference(loop, other, seed=seed, steps=steps).cost
    shifts, errors = zip(*(_shift(contestant.tuned, rate, contestant.link) for contestant in pair), strict=True)
    error = float(np.sqrt(found.standard_error**2 + sum(error**2 for error in errors)))
    common = Estimate(found.value - shifts[0] + shifts[1], error, "simulation")
    return common if error < apart else above


def _loop(one: Contestant) -> Loop | None:
    """Return the loop of a policy that is simulated by completion of squares, which differences want."""
    tuned = one.tuned
    policy = tuned.problem.designed()
    if tuned.beyond is not None or tuned.evaluation.steps == 0 or not isinstance(policy, Policy):
        return None
    loop = tuned.problem.close(policy)
    return None if loop.identity is None else loop


def _only_link(tuned: Tuned) -> LinkName:
    """Return the link whose rate was tuned where none was named: the policy decides on one."""
    return cast("LinkName", next(iter(tuned.evaluation.rates)))


def _bound(evaluation: Evaluation) -> float | None:
    """Return the sharpest bound that is proved."""
    return evaluation.cost_bound if evaluation.cost_bound_at_rate is None else evaluation.cost_bound_at_rate
