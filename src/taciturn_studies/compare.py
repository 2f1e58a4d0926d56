"""Comparison of policies at the same rate or traffic: their ranking by cost, cost differences, and guarantees.

The problems have the same plant, cost, network and limits, and different policies. Each policy is tuned to the rate r
(``tune``), and its cost is corrected for the remaining error of its rate along the slope of cost against rate:

    J(r) = J − J'(r̂) (r̂ − r),  with the standard error √(σ_J² + (J' σ_r)²).

If the rate jumps across r, the time is shared between the policies on both sides, (1 − s) r₊ + s r₋ = r, and their
costs and bounds are averaged with the same shares. The difference of two policies that are simulated step by step is
simulated on common draws, where this has the smaller standard error; the ranking is repeated until no difference shows
that another policy is cheaper than the first.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np

from taciturn.errors import ProblemError, TaciturnError
from taciturn.extend import (
    ROW,
    Above,
    Panel,
    Progress,
    Series,
    Size,
    Stages,
    StyleName,
    Thing,
    answered_within,
    draw,
    in_notebook,
    instance,
    number,
    per_unit,
    percent,
)
from taciturn.loop import Loop
from taciturn.lqg.discrete import has_average
from taciturn.model.estimate import Estimate, bound_text
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.result import VERDICT, Field, Result, Tabular, plain_fields
from taciturn.model.steps import read
from taciturn.model.transport import with_transport
from taciturn.problem import Problem
from taciturn.problem.without_file import Studied, as_problem
from taciturn.simulation.average import check_effort, difference
from taciturn.study.baseline import common_base, excess_over
from taciturn.study.evaluate import evaluate
from taciturn.study.evaluation import Evaluation, TimeUnit, Unit, columns_of, cost_unit, rate_unit, withdrawn_text
from taciturn.study.sentences import THAN, excess_text, percent_above, percent_text, shares_text
from taciturn_studies.goal import RateGoal
from taciturn_studies.periodic_links import CLOCKS, LinkClocks, clocks_document, clocks_or_reason
from taciturn_studies.tune import Tuned, tune

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LARGE = 0.05  # largest correction for the rate, as a share of the cost
PERIODIC = "periodic control"
SPAN = 2.0  # standard errors of a bar
LEAST = 1.1  # smallest height of the rows of a figure, in inches
CORRECTED = "each cost is corrected for the difference of the measured rate"
ALIKE = 2.0  # standard errors within which two costs are not told apart
RELATIVE_ERROR = 3e-4  # default standard error, relative to the cost of sending every sample


def compare(
    problems: Mapping[str, Studied],
    rate: float | None = None,
    *,
    traffic: float | None = None,
    link: str | None = None,
    seed: int = 0,
    standard_error: float | None = None,
    time_limit: float | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Compare the policies of several problems at the same rate or, with several links, at the same total traffic.

    Each policy is tuned to the rate or the traffic, as by ``tune``. If periodic control is specified only by its
    period, a second variant is also tried: it measures as often as the other policies and sends in the best cycle of
    intervals. The cheaper variant counts. The remaining error of a policy's rate, about one standard error, is
    corrected along the slope of cost against rate, and is added to the standard error. If the rate of a policy jumps
    across the given rate, the time is shared between the policies on both sides of the jump. If two policies are both
    simulated step by step, their difference is simulated with the same random numbers.

    Args:
        problems: at least two problems by name, with the same plant, cost and network, and different policies or
            buffers of receivers.
        rate: sends per step, or per second for a continuous plant; for a finite-horizon run, the mean fraction of steps
            with a send. Default: the rate of the first policy, or its traffic if it decides on several links.
        traffic: instead, the sum of the rates of all links, each times the price of a packet.
        link: link whose rate is meant; may be omitted if each policy decides on a single link.
        seed: seed of the random draws.
        standard_error: absolute standard error of each cost; default: 3e-4 of the cost of sending every sample.
        time_limit: time limit in seconds; default: none. Without a result in time, an error is raised.
        progress: callback that receives the fraction done.

    Returns:
        The ranking.

    Raises:
        ProblemError: there are fewer than two policies, a policy occurs twice, the plants, costs or networks differ, a
            policy is incompatible with them, or a policy cannot reach the rate.
        UnstableError: a policy has no stable loop.

    Example:
        >>> from taciturn import load
        >>> mass = load("two-mass-lqg")
        >>> named = {"hold": mass, "model": mass.changed({"actuation": "model"})}
        >>> [one.name for one in compare(named, 0.3, standard_error=1e-3).ranking]
        ['model', 'hold']
    """
    with answered_within(time_limit):
        check_effort(seed, standard_error, None)
        if traffic is not None and (rate is not None or link is not None):
            named = {"rate": rate, "traffic": traffic, "link": link}
            got = " and ".join(name for name, value in named.items() if value is not None)
            raise ProblemError(
                f"the budgets {got} are given; expected either a rate, with or without a link, or a traffic"
            )
        given, bar = comparable(problems, link, "rate" if traffic is None else "traffic"), in_notebook(progress)
        if rate is None and traffic is None:
            rate, traffic = _present(next(iter(given.values())), link, seed)
        goal = "rate" if traffic is None else "traffic"
        level, problems = number(goal, rate if traffic is None else traffic, 0.0), given
        found: list[Contestant] = []
        for index, (name, choices) in enumerate(measuring_alike(problems).items()):
            part = Stages(bar, index / len(problems), (index + 0.8) / len(problems))
            try:
                alike: list[Contestant] = []
                for problem in choices:
                    wanted = _wanted(problem) if standard_error is None else standard_error
                    tuned = tune(
                        problem, rate=rate, traffic=traffic, link=link, seed=seed + index, standard_error=wanted,
                        progress=part,
                    )  # fmt: skip
                    only = link or next(iter(tuned.evaluation.rates))  # without a name, the only one
                    alike.append(_at_rate(name, tuned, level, only if traffic is None else None))
                found.append(min(alike, key=lambda one: one.cost.value))
            except TaciturnError as error:
                raise type(error)(f"{name}: {error}") from None
        found.sort(key=lambda one: one.cost.value)
        ranking, best = tuple(found), None
        while best is None or ranking[0].name != best.name:  # until no difference shows that another policy is cheaper
            best = ranking[0]
            beside = [replace(one, above=_above(one, best, level, seed + len(problems))) for one in found]
            ranking = tuple(sorted(beside, key=lambda one: one.above.value))
        clocks = None if traffic is None else clocks_or_reason([one.tuned.problem for one in ranking], level)
        return Comparison(level, cost_unit(found[0].tuned.problem), _every_sample(found), ranking, goal, clocks)


def comparable(given: Mapping[str, Studied], link: str | None, budget: str = "rate") -> dict[str, Problem]:
    """Return the problems to compare, by name; raise an error if they differ in more than their policies."""
    instance("problems", given, Mapping)
    problems = {name: as_problem(f"problems[{name!r}]", problem) for name, problem in given.items()}
    if len(problems) < 2:
        raise ProblemError(
            f"the number of policies is {len(problems)}; expected at least two policies to compare, in problems that "
            "differ in their policies, such as two-mass and two-mass-lqg"
        )
    for (one, first), (other, second) in itertools.combinations(problems.items(), 2):
        for what in ("plant", "actual", "cost", "network", "reference", "limits"):
            if not _same(*(_stated(problem, what) for problem in (first, second))):
                tables = {"actual": "[plant.actual]", "network": "[network], [nodes] or [links]"}
                where = tables.get(what, f"[{what}]")
                raise ProblemError(
                    f"the problems {one} and {other} differ in {where}; expected equal tables in all problems"
                )
        periods = [each.parameters.get("period") for each in (first, second)]
        if periods[0] != periods[1] and not has_average(first.plant, first.cost):
            raise ProblemError(
                f"the problem {one} has the period {periods[0]} and the problem {other} the period {periods[1]}, but "
                "their costs count only the sampling instants, because the disturbances grow without limit and "
                "require an input that changes between samples; expected equal periods, or disturbances that are "
                "constant or decay"
            )
        alike = first.record is second.record and _same(_fixed(first, link), _fixed(second, link))
        if alike and _signals(first) == _signals(second) and _same(first.network, second.network):
            raise ProblemError(
                f"the problems {one} and {other} have the same policy, {first.kind}, at the same {budget}; expected "
                "policies that differ in a parameter other than the tuned one"
            )
    return problems


def _stated(problem: Problem, what: str) -> object:
    """Return a part of a problem, without the buffers of receivers: they are chosen, as policies are."""
    given: object = getattr(problem, what)
    if isinstance(given, Network):
        return given.with_laws({"buffer": None})
    return with_transport(given, None) if isinstance(given, Plant | ContinuousPlant) else given


def _present(problem: Problem, link: str | None, seed: int) -> tuple[float | None, float | None]:
    """Return the rate of a policy with its present parameters, or its traffic if it decides on several links."""
    found = evaluate(replace(problem, limits=None), seed=seed)
    if link is None and len(found.rates) > 1 and found.traffic is not None:
        return None, float(f"{found.traffic.value:.3g}")
    rate = RateGoal(0.0, link).of(found)
    return float(f"{rate.value:.3g}"), None


def measuring_alike(problems: Mapping[str, Problem]) -> dict[str, list[Problem]]:
    """Return each problem, with a second variant where periodic control can also use the other policies' period."""
    given = [problem.parameters.get("period") for problem in problems.values()]
    periods = [period for period in given if isinstance(period, int | float)]
    found = {name: [problem] for name, problem in problems.items()}
    for name, problem in problems.items():
        plant, tunings = problem.plant, [tuning for tuning in problem.record.tuning if tuning.cycles]
        seen_in_part = isinstance(plant, ContinuousPlant) and not plant.full_state
        if tunings and seen_in_part and periods and tunings[0].name not in problem.parameters:
            found[name].append(problem.changed({"period": min(periods), tunings[0].name: 1}))
    return found


def _fixed(problem: Problem, link: str | None) -> dict[str, object]:
    """Return the parameters that are not tuned, with their defaults if they are not given."""
    defaults = {
        key: parameter.default
        for key, parameter in problem.record.arguments.items()
        if parameter.default is not parameter.empty
    }
    tuned = {tuning.name for tuning in problem.record.tuning if link is None or tuning.link in (None, link)}
    return {key: value for key, value in (defaults | dict(problem.parameters)).items() if key not in tuned}


def _signals(problem: Problem) -> list[list[str]]:
    """Return the signals that each policy step reads; another rule of this kind reads other signals."""
    try:
        policy = problem.designed()
    except TaciturnError:  # the design fails for the present parameter value, but may succeed for others
        return []
    return [sorted(read(step)) for step in policy.steps] if isinstance(policy, Policy) else []


def _same(one: object, other: object) -> bool:
    """Return whether two values are equal; they may be data classes with arrays."""
    if is_dataclass(one) and type(one) is type(other):
        return all(_same(getattr(one, part.name), getattr(other, part.name)) for part in fields(one))
    if isinstance(one, dict) and isinstance(other, dict):
        known, found = cast("dict[str, object]", one), cast("dict[str, object]", other)
        return known.keys() == found.keys() and all(_same(value, found[key]) for key, value in known.items())
    return bool(np.array_equal(cast("Any", one), cast("Any", other)))


def _wanted(problem: Problem) -> float | None:
    """Return the default standard error for a policy, relative to its cost of sending every sample, if it is known."""
    try:
        return RELATIVE_ERROR * problem.designed().cost_all_time or None
    except TaciturnError:  # the design fails for the present parameter value, but may succeed for others
        return None


def _at_rate(name: str, tuned: Tuned, rate: float, link: str | None) -> Contestant:
    """Return the cost of a policy at exactly this rate or traffic."""
    here = tuned.evaluation
    bound = _bound(here)
    share, share_error, cost = 1.0, 0.0, here.cost
    if tuned.beyond is not None:
        there = tuned.beyond.evaluation
        low, high = (tuned.goal.use(one) for one in (here, there))
        apart = high.value - low.value
        share = (high.value - rate) / apart
        share_error = float(np.hypot(share * low.standard_error, (1 - share) * high.standard_error)) / apart
        errors = share * cost.standard_error, (1 - share) * there.cost.standard_error
        moved = (cost.value - there.cost.value) * share_error
        value = share * cost.value + (1 - share) * there.cost.value
        cost = Estimate(value, float(np.linalg.norm([*errors, moved])), cost.method)
        other = _bound(there)
        bound = None if bound is None or other is None else share * bound + (1 - share) * other
    elif tuned.slope is not None:
        shift, error = _shift(tuned, rate)
        if abs(shift) + error > LARGE * abs(cost.value):
            raise ProblemError(
                f"the cost of {here.policy} cannot be estimated at the {tuned.goal.name} {rate:g}, where its slope is "
                f"{abs(tuned.slope):.2g} per send per {here.rate_unit}: the loop is nearly unstable there; expected "
                "another rate, or another policy"
            )
        cost = Estimate(cost.value - shift, float(np.hypot(cost.standard_error, error)), cost.method, cost.error)
    return Contestant(name, here.policy, link, tuned, share, cost, Estimate(0.0, 0.0, cost.method), bound, share_error)


def _shift(tuned: Tuned, rate: float) -> tuple[float, float]:
    """Return the error of the cost that is due to the error of the rate, and its standard error."""
    if tuned.slope is None:
        return 0.0, 0.0
    found = tuned.goal.use(tuned.evaluation)
    return tuned.slope * (found.value - rate), abs(tuned.slope) * found.standard_error


def _bound(evaluation: Evaluation) -> float | None:
    """Return the sharpest proven bound."""
    return evaluation.cost_bound if evaluation.cost_bound_at_rate is None else evaluation.cost_bound_at_rate


def _above(one: Contestant, best: Contestant, rate: float, seed: int) -> Estimate:
    """Return the cost of a policy minus the cost of the best policy."""
    if one.name == best.name:
        return Estimate(0.0, 0.0, one.cost.method)
    apart = float(np.hypot(one.cost.standard_error, best.cost.standard_error))
    above = Estimate(one.cost.value - best.cost.value, apart, one.cost.method if apart else best.cost.method)
    loop, other = _loop(one), _loop(best)
    if loop is None or other is None or loop.problem.tick != other.problem.tick:
        return above
    steps = max(one.tuned.evaluation.steps, best.tuned.evaluation.steps)
    found = difference(loop, other, seed=seed, steps=steps).cost
    (shift, error), (shift_of_best, error_of_best) = _shift(one.tuned, rate), _shift(best.tuned, rate)
    both = float(np.sqrt(found.standard_error**2 + (error**2 + error_of_best**2)))
    common = Estimate(found.value - shift + shift_of_best, both, "simulation")
    return common if both < apart else above


def _loop(one: Contestant) -> Loop | None:
    """Return the loop of a policy if its cost is simulated by completion of squares, else None."""
    tuned = one.tuned
    policy = tuned.problem.designed()
    if tuned.beyond is not None or tuned.evaluation.steps == 0 or not isinstance(policy, Policy):
        return None
    loop = tuned.problem.close(policy)
    return None if loop.identity is None else loop


def _every_sample(found: Sequence[Contestant]) -> Estimate | None:
    """Return the least cost of sending every sample among the policies with the most steps per second."""
    answers = [one.tuned.evaluation for one in found]
    fastest = max(one.base_rate or 0.0 for one in answers)
    costs = [one.cost_every_sample for one in answers if one.base_rate == fastest]
    return min((cost for cost in costs if cost is not None), key=lambda cost: cost.value, default=None)


def _excess(one: Contestant, base: Estimate | None) -> Estimate | None:
    """Return the excess of a cost over that of every sample, with the error of a pair if the policy has this base."""
    if base is None or base.value <= 0:
        return None
    here, own = one.tuned.evaluation, one.tuned.evaluation.excess
    if base.standard_error == 0 or own is None or common_base([here.cost_every_sample, base]) is None:
        return excess_over(one.cost, base)
    corrected = max(one.cost.standard_error**2 - here.cost.standard_error**2, 0.0) / base.value**2
    moved = (one.cost.value - here.cost.value) / base.value
    return Estimate(own.value + moved, float(np.sqrt(own.standard_error**2 + corrected)), one.cost.method)


@dataclass(frozen=True, eq=False, repr=False)
class Contestant(Result):
    """One of the compared policies, with its parameter tuned to the common rate or traffic.

    Args:
        name: name given by the user.
        policy: kind of the policy.
        link: link whose rate is compared; None if the traffic on all links is compared.
        tuned: the tuned policy; if its rate jumps across the requested rate, the policy below the jump, with the policy
            above the jump in ``beyond``.
        share: share of the time that ``tuned`` is used, so that the rate is met; ``beyond`` is used in the rest.
        cost: cost at exactly the rate of the comparison.
        above: cost minus the cost of the first in the ranking, with the standard error of the difference.
        cost_bound: proven upper bound on the cost at this rate, or None.
        share_error: standard error of ``share``, due to the standard errors of both rates.
    """

    shown: ClassVar[tuple[str, ...]] = (
        "name", "policy", "parameter", "cost", "above", "cost_bound", "link", "share",
    )  # fmt: skip

    name: str
    policy: str
    link: str | None
    tuned: Tuned
    share: float
    cost: Estimate
    above: Estimate
    cost_bound: float | None
    share_error: float = 0.0

    def short(self) -> str:
        """Return a text with the name of the policy and its cost."""
        return f"{self.name}: {self.cost}"

    @property
    def parameter(self) -> str:
        """Name and value of the tuned parameter; two values if the policy alternates between them."""
        one, two = self.tuned.parameter, None if self.tuned.beyond is None else self.tuned.beyond.parameter
        values = [one.beside(two), *(() if two is None else (two.beside(one),))]
        return f"{self.tuned.parameter.name} = {' and '.join(values)}"

    @property
    def rates(self) -> tuple[Estimate, ...]:
        """Rate or traffic at which the cost was computed; two values if the policy alternates between two settings."""
        both = (self.tuned, self.tuned.beyond)
        return tuple(one.goal.use(one.evaluation) for one in both if one is not None)

    @property
    def violation(self) -> Estimate | None:
        """Fraction of the steps in which the states violate their limits, at this rate; None if unknown."""
        both = (self.tuned, self.tuned.beyond)
        found = [one.evaluation.violations for one in both if one is not None]
        steps = [one.total.per_step for one in found if one is not None]
        if len(steps) < len(found):
            return None
        weights = (self.share, 1 - self.share)
        parts = [one.scaled(weight) for one, weight in zip(steps, weights, strict=False)]
        error = float(np.linalg.norm([one.standard_error for one in parts]))
        return Estimate(sum(one.value for one in parts), error, "simulation")

    @property
    def reached(self) -> bool:
        """Whether the policy has the common rate, and its evaluation the requested standard error."""
        return all(one.evaluation.reached for one in (self.tuned, self.tuned.beyond) if one is not None)


def _parameter(one: Contestant) -> dict[str, Any]:
    """Return the document of the tuned parameter, and of the share of the time of two values that alternate."""
    beyond = None if one.tuned.beyond is None else one.tuned.beyond.parameter.value
    shared = {"share": one.share, "share_standard_error": one.share_error, "shares": one.tuned.shares}
    return {**one.tuned.parameter.document(), "beyond": beyond, **shared}


def _notes(found: Comparison) -> Iterator[str]:
    """Yield the shares and the notes of each policy."""
    for one in found.ranking:
        share = percent(one.share, 1, error=one.share_error)
        shared = "" if one.share == 1 else f"the first value in {share} of the time, else the second; "
        shared += "" if one.tuned.shares is None else f"shares {shares_text(one.tuned.shares)}; "
        notes = "; ".join(note for note in one.tuned.evaluation.notes if note not in one.tuned.evaluation.doubts)
        if shared or notes:
            yield f"{one.name}: {(shared + notes).removesuffix('; ')}"


def _verdict(found: Comparison, mark: str = "{}") -> Iterator[str]:
    """Yield the policy with the least cost, and the costs of the next and the last policy. ``mark`` formats names."""
    first, *others = found.ranking
    at = f"at {'the traffic ' if found.of == 'traffic' else ''}{found.level}"

    def costs(one: Contestant) -> str:
        excess = _excess(one, found.cost_every_sample)
        if excess is None:
            return f"cost {one.cost} {per_unit(found.unit)}"
        return excess_text(excess, than=THAN)

    alike = [one for one in others if one.above.value <= ALIKE * one.above.standard_error]
    if alike:
        names = " and ".join(mark.format(one.name) for one in (first, *alike))
        yield f"{names} cost the same {at}, within the standard errors: {costs(first)}"
    else:
        yield f"{mark.format(first.name)} costs least {at}: {costs(first)}"
    left = [one for one in others if one not in alike]
    if left:
        yield "; ".join(f"{one.name}: {costs(one)}" for one in (left[:1] + left[1:][-1:]))
    yield from withdrawn_text([one.tuned.evaluation for one in found.ranking])
    for one in found.ranking:
        yield from (f"{one.name}: {doubt}" for doubt in one.tuned.evaluation.doubts)


def _policies(found: Comparison) -> list[tuple[str, str]]:
    """Return a description of each policy, and the rate at which it was measured."""
    return [
        (one.name, f"{one.policy}, {one.parameter}, measured at {' and '.join(map(str, one.rates))}")
        for one in found.ranking
    ]


def _periodic(found: Comparison) -> str:
    if isinstance(found.clocks, str):
        return f"none at this traffic: {found.clocks}"
    if found.clocks is None:
        return ""
    return f"{found.clocks.cost:.6g}, the least found with {found.clocks.whose}, in steps: {found.clocks.short()}"


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Tabular):
    """Policies at the same rate or traffic, in ascending order of their costs.

    Args:
        rate: sends per step or per second; for a finite-horizon run, the mean fraction of steps with a send. For
            policies at the same traffic, the sum of the rates of all links, each times the price of a packet.
        unit: unit of time or run that the cost refers to: ``"step"``, ``"second"``, ``"second at the sampling
            instants"`` or ``"mission"``.
        cost_all_time: ``cost_every_sample`` if it is exact, else None.
        cost_every_sample: least cost of sending every sample among the policies with the most steps per second, exact
            or measured; None if it is unknown.
        ranking: the policies in the order of their costs.
        of: what is equal for all policies: the ``"rate"`` of a link, or the ``"traffic"``.
        clocks: for policies at the same traffic, fair periodic control with the best timing of each link that was found
            at this traffic, or the reason why there is none; else None.
    """

    FIELDS: ClassVar[tuple[Field[Comparison], ...]] = (
        VERDICT,
        Field("rate", say="", text=lambda found: [(found.of, f"{found.level}; {CORRECTED}")]),
        *plain_fields("of", "unit", "rate_unit"),
        Field("method", say="method", part="method"),
        Field("seconds", key="", say="time", text="{:.3g} s", part="method"),
        Field("cost_all_time"),
        Field("cost_every_sample", json=Estimate.document, say="every sample"),
        Field("clocks", json=clocks_document, optional=True, say="periodic", text=_periodic),
        Field("ranking", lambda found: found.row_documents(), say="", text=_policies),
        Field("notes", lambda found: tuple(_notes(found)), key="", say="note"),
    )
    heading: ClassVar[tuple[str, ...]] = ("rate", "rate_unit", "unit", "cost_every_sample", "method")

    rate: float
    unit: Unit
    cost_every_sample: Estimate | None
    ranking: tuple[Contestant, ...]
    of: str = "rate"
    clocks: LinkClocks | str | None = None

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentence that names the policy with the least cost, and says how much more the other policies cost."""
        return tuple(_verdict(self))

    @property
    def seconds(self) -> float:
        """Wall time of evaluating the tuned policies, in seconds."""
        return sum(one.tuned.evaluation.seconds for one in self.ranking)

    @property
    def method(self) -> str:
        """Methods that gave the costs."""
        return ", ".join(dict.fromkeys(one.tuned.evaluation.method for one in self.ranking))

    @property
    def rate_unit(self) -> TimeUnit:
        """Unit of time to which the rate refers."""
        return rate_unit(self.unit)

    @property
    def level(self) -> str:
        """Text that states the common rate or traffic."""
        return f"{self.rate:.6g}{' sends' * (self.of == 'rate')} per {self.rate_unit}"

    @property
    def cost_all_time(self) -> float | None:
        """Cost of sending every sample, if it is exact."""
        every = self.cost_every_sample
        return None if every is None or every.method != "exact" else every.value

    @property
    def _base(self) -> float | None:
        """Cost of sending every sample, to which percentages refer."""
        return None if self.cost_every_sample is None else self.cost_every_sample.value

    def table_rows(self) -> Sequence[Contestant]:
        """Return the rows of the table, one for each compared policy, in ascending order of the cost."""
        return self.ranking

    def row_fields(self) -> tuple[Field[Contestant], ...]:
        """Return the columns of the table: policy, parameter, cost and guarantee."""
        base, limited = self._base, any(one.violation is not None for one in self.ranking)

        def extra(one: Contestant) -> str:
            excess = _excess(one, self.cost_every_sample)
            return "" if excess is None else percent_text(excess)

        def bound(one: Contestant) -> str:
            if one.cost_bound is None:
                return "none"
            proved = Estimate(one.cost_bound, 0.0, "bound")
            return percent_above(proved, base, 1) if base else bound_text(proved, 1)

        return (
            Field("name", column="name", say=""),
            Field("policy", column="policy"),
            Field("link"),
            Field("method", "tuned.evaluation.method"),
            Field("parameter", key="", column="parameter"),
            Field("parameter", _parameter),
            Field("rates"),
            Field("cost", json=Estimate.document, column="cost", say=f"cost {per_unit(self.unit)}"),
            Field("extra", key="", say="extra cost", text=extra),
            Field("above", key="above_best", column="above_the_first", say="above the first", text=_difference),
            Field("cost_bound", column="guarantee", say="guarantee", text=bound, up=1),
            Field(
                "violation",
                json=Estimate.document,
                optional=True,
                column="violation",
                say="violation per step" if limited else None,
                none="none",
            ),
            Field("statement", lambda one: None if one.cost_bound is None else one.tuned.evaluation.statement),
            Field("notes", "tuned.evaluation.notes"),
            *columns_of(lambda one: one.tuned.evaluation),
        )

    def plot(self, ax: Any = None, figsize: Size | None = None, style: StyleName = "light") -> Figure:
        """Plot the costs in ascending order, and write how far each exceeds the lowest.

        The error bars are two standard errors. The differences have smaller errors, because all policies are simulated
        with the same random numbers.

        Args:
            ax: existing axes to draw in instead of a new figure.
            figsize: width and height of a new figure, in inches.
            style: ``"light"``, ``"dark"``, ``"paper"`` or ``"paper-wide"``.
        """
        return draw([self._panel()], ax, figsize, style)

    def _panel(self) -> Panel:
        """Return the panel of the costs, with their differences from the first as notes."""
        listed, per = self.ranking[::-1], per_unit(self.unit)  # the first is the uppermost
        rows = [float(row) for row in range(len(listed))]
        costs, errors = [one.cost.value for one in listed], [SPAN * one.cost.standard_error for one in listed]
        things: list[Thing] = ["periodic control" if one.policy in CLOCKS else "policy" for one in listed]
        marks: dict[Thing, str] = {"policy": "cost ± 2 standard errors", "periodic control": PERIODIC}
        series = list[Series]()
        for thing, label in marks.items():
            own = [row for row, other in enumerate(things) if other == thing]
            if own:
                y, spread = [rows[row] for row in own], [errors[row] for row in own]
                series.append(Series([costs[row] for row in own], y, label, "bars", spread, thing))
        bounds = [(row, one.cost_bound) for row, one in zip(rows, listed, strict=True) if one.cost_bound is not None]
        every = [] if self._base is None else [self._base]
        timed = [self.clocks.cost] if isinstance(self.clocks, LinkClocks) else []
        x, y = [bound for _, bound in bounds], [row for row, _ in bounds]
        series += [Series(x, y, "guarantee", "points", thing="guarantee")] if bounds else []
        ends = [-0.5, len(rows) - 0.5]
        series += [Series([cost] * 2, ends, "every sample", thing="every sample") for cost in every]
        series += [Series([cost] * 2, ends, PERIODIC, thing="periodic control") for cost in timed]
        base = every[0] if every and every[0] > 0 else None
        axis = None if base is None else Above.of(base, costs, [*x, *timed])
        return Panel(
            series,
            f"cost {per}" if axis is None else axis.label("cost", per),
            title=next(_verdict(self, "“{}”")),
            names=[one.name for one in listed],
            notes=[_above_least(one, base) for one in listed],
            xabove=axis,
            row=max(ROW, LEAST / len(listed)),
        )


def _above_least(one: Contestant, base: float | None) -> str:
    """Write for a figure by how much a cost exceeds the least one, in percent of the cost of every sample if known."""
    if not _difference(one):
        return "least"
    share = None if base is None else one.above.scaled(1 / base)
    return f"least + {one.above if share is None else percent(share.value, error=share.standard_error)}"


def _difference(one: Contestant) -> str:
    """Return a cost minus that of the first as text."""
    return str(one.above) if one.above.value or one.above.standard_error else ""
