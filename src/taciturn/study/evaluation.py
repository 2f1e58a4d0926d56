"""The result of an evaluation, and its text: one table, then details and warnings.

Units of costs and rates: per step, per second, per second at the sampling instants, or per finite-horizon run.

Parts of results as text: bounds that still hold after rounding, percentages, schedules.

Cost and rate of a policy under a constant disturbance, after a step from zero to one deviation.

A loop whose inputs have limits and the loop without limits: how often a limit binds, and cost and bound.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, ClassVar, Literal, TypeAlias, cast

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn._progress import Progress, Stages
from taciturn._text import LARGE, Lines, magnitude, negligible, number_text, pairs_text, per_unit, percent, table_text
from taciturn.base.filter import SEND
from taciturn.design.kind import placed
from taciturn.design.silence import send_every_sample
from taciturn.loop import Loop, close
from taciturn.lqg.discrete import has_average
from taciturn.model.diagram import pattern_text
from taciturn.model.estimate import Estimate
from taciturn.model.limits import Violations
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.result import Columns, Tabular, columns_of
from taciturn.model.saturation import Saturation
from taciturn.model.schedule import Schedule
from taciturn.model.steps import Decide
from taciturn.model.theory import Linearisation, LowerBound
from taciturn.model.trigger import Form, Trigger
from taciturn.problem import Problem
from taciturn.problem.bare import BareKind
from taciturn.program.engine import prepare
from taciturn.program.lower import APPLIED, first_input
from taciturn.program.ops import Entry
from taciturn.simulation.average import average
from taciturn.simulation.reliability import escapes, wanders
from taciturn.simulation.sampling import Averages
from taciturn.study.measure import CONDITIONAL, Request, measure
from taciturn.study.periodic import SAME, ClockMix

TimeUnit: TypeAlias = Literal["step", "second"]
Unit: TypeAlias = Literal["step", "second", "second at the sampling instants", "mission"]


def time_unit(problem: Problem) -> TimeUnit:
    """Return the unit of time of a problem's cost weights and average cost."""
    return "second" if isinstance(problem.plant, ContinuousPlant) else "step"


def cost_unit(problem: Problem) -> Unit:
    """Return the unit that a problem's cost refers to; the cost of a finite-horizon run is a total.

    If the integral of the cost has no average, the cost is that of the deviations at the sampling instants.
    """
    if problem.cost.mission:
        return "mission"
    integrated = all(has_average(plant, problem.cost) for plant in (problem.plant, problem.actual) if plant is not None)
    return time_unit(problem) if integrated else "second at the sampling instants"


def rate_unit(unit: Unit) -> TimeUnit:
    """Return the unit of time of a rate for a given unit of the cost; rates of a finite-horizon run are per step."""
    return "second" if unit.startswith("second") else "step"


MOST_DECIMALS = 2  # largest number of decimals of a percentage in a table


def decimals_of(share: float, digits: int) -> int:
    """Return the number of decimals with which a percentage shows the given number of digits, at most four."""
    return min(max(digits - 1 - magnitude(100 * share), 0), 4)


def outward(value: float, digits: int, up: int) -> float:
    """Return a bound rounded up (1) or down (−1) to the given number of digits, so that it still holds."""
    nearest = float(f"{value:.{digits}g}")
    if up * (nearest - value) < 0:
        nearest += up * 10.0 ** (math.floor(math.log10(abs(value))) + 1 - digits)
    return nearest


def proved(bound: float | None) -> float | None:
    """Return an upper bound, rounded up to six digits, or None without a bound."""
    return None if bound is None else outward(bound, 6, 1)


def proof_text(proved: bool, every_sample: bool) -> str:
    """Return in words which numbers of a guarantee are computed with proved errors."""
    if proved:
        return "J_all and guarantee are proved for the gains as stored"
    if every_sample:
        return "J_all is proved for the gains as stored; what silence adds is computed in doubles, for exact gains"
    return "of the theorem; its numbers are computed in doubles, with estimated rounding errors"


def rounded(value: float, digits: int, up: int) -> str:
    """Return a bound as text, rounded up (1) or down (−1), so that it still holds."""
    nearest = outward(value, digits, up)
    return f"{nearest:.0f}" if 1e4 <= abs(nearest) < LARGE else number_text(nearest, digits)


def bound_text(bound: Estimate, up: int) -> str:
    """Return a bound as text, rounded up (1) or down (−1) to six digits, or to those that its standard error allows."""
    if bound.standard_error == 0:
        return rounded(bound.value, 6, up)
    digits = 2 + magnitude(bound.value) - magnitude(bound.standard_error)
    return str(replace(bound, value=outward(bound.value, digits, up) if digits > 0 else bound.value))


def percent_above(cost: Estimate, base: float, up: int = 0, *, signed: bool = True) -> str:
    """Return the excess of a cost over the cost of sending every sample, in percent, with at most two decimals.

    The last digit is that of the first digit of the standard error.
    """
    error, decimals = 100 * cost.standard_error / base, MOST_DECIMALS
    if error > 0:
        decimals = min(decimals, max(0, -magnitude(error)))
    return percent(cost.value / base - 1, decimals, up=up, signed=signed)


def shares_text(shares: Mapping[str, float]) -> str:
    """Return the shares of the links as text."""
    return ", ".join(f"{link} {share:g}" for link, share in shares.items())


def clock_text(clock: ClockMix) -> str:
    """Return how periodic control actuates (hold or prediction), and when it sends."""
    named = [f"{list(point.cycle)} steps" if point.cycle else f"{1 / point.rate:.4g} s" for point in clock.points]
    found = ", the best found" if clock.words == "hold" else ""  # with a model, neighbouring intervals are optimal
    return f"{clock.words}, every {' or '.join(named)}{found}"


def queries_text(schedule: Schedule) -> str:
    """Return a text that states when the sensor is queried."""
    ticks = schedule.ticks
    if schedule.start is not None and schedule.period == 1:
        found = pattern_text(schedule.queries.tolist(), schedule.start)
        return f"at {found}" if found == "every step" else found
    listed = ", ".join(map(str, ticks[:12])) + (", …" if len(ticks) > 12 else "")
    if schedule.start is None:
        return f"{len(ticks)} of {len(schedule.queries)} steps" + (f": {listed}" if ticks else "")
    once = f"{schedule.queries[schedule.start :].sum()} of {schedule.period} steps, periodically"
    return once if schedule.start == 0 else f"{once} from step {schedule.start} on: {listed}"


def proved_text(bound: float | None) -> str:
    """Return a proved bound rounded up, empty if there is none."""
    return "" if bound is None else rounded(bound, 6, 1)


@dataclass(frozen=True, repr=False)
class AsWritten(Displayed):
    """The policy on the plant as written, without a slow disturbance that a default has added.

    Args:
        added: time constant and deviation of this disturbance, as text.
        cost: cost of the policy on the plant as written.
        cost_all_time: cost of sending every sample there; None if it is not known.
        rates: sends per step or per second there, by scheduled link.
        settled: whether the initial transient has decayed.
    """

    added: str
    cost: Estimate
    cost_all_time: float | None
    rates: Mapping[str, Estimate] = field(hash=False)
    settled: bool = True

    def document(self) -> dict[str, Any]:
        """Return the part of the JSON document of ``taciturn evaluate --json``."""
        return {
            "added": self.added,
            "cost": self.cost.document("value", "standard_error"),
            "cost_all_time": self.cost_all_time,
            "rates": {link: rate.document("value", "standard_error") for link, rate in self.rates.items()},
            "settled": self.settled,
        }

    def extra(self) -> str:
        """Return by how much the policy costs more than sending every sample on the plant as written, as text."""
        if not self.cost_all_time:
            return "without known cost of every sample"
        return percent_above(self.cost, self.cost_all_time)

    def text(self, unit: str) -> str:
        """Return what is added and the numbers without it as one sentence."""
        every = "" if self.cost_all_time is None else f", every sample {self.cost_all_time:.6g} ({self.extra()})"
        rates = ", ".join(f"{rate} sends {unit}" for rate in self.rates.values())
        late = "" if self.settled else "; the loop has not settled: more steps are required"
        return (
            f"a slow disturbance at each input that the problem does not state ({self.added}); on the plant as "
            f"written, this policy costs {self.cost}{every}, {rates}{late}"
        )


ACCURACY = 1e-3  # standard error relative to the cost of sending every sample
NEVER = 1e150  # a cost of silence above that of any packet


@dataclass(frozen=True, repr=False)
class AfterStep(Displayed):
    """Averages of a loop with a constant disturbance, when the transient after the step has decayed.

    Args:
        size: the disturbance at each input.
        cost: cost of the policy.
        cost_all_time: cost of the same control if it sends every sample, under the same disturbance.
        rates: sends per step or per second, by scheduled link.
        settled: whether the transient has decayed within the steps.
    """

    size: tuple[float, ...]
    cost: Estimate
    cost_all_time: Estimate
    rates: Mapping[str, Estimate] = field(hash=False)
    settled: bool = True

    def document(self) -> dict[str, Any]:
        """Return the part of the JSON document of ``taciturn evaluate --json``."""
        costs = {"cost": self.cost, "cost_all_time": self.cost_all_time}
        found: dict[str, Any] = {name: cost.document("value", "standard_error") for name, cost in costs.items()}
        rates = {link: rate.document("value", "standard_error") for link, rate in self.rates.items()}
        return {"size": list(self.size), **found, "rates": rates, "settled": self.settled}

    def text(self, unit: str) -> str:
        """Return the averages as one sentence."""
        size = ", ".join(f"{value:.4g}" for value in self.size)
        rates = ", ".join(f"{rate} sends {unit}" for rate in self.rates.values())
        late = "" if self.settled else "; the transient has not decayed: more steps are required"
        return f"of {size} at the input: cost {self.cost}, with every sample {self.cost_all_time}; {rates}{late}"


def averages_after_step(
    problem: Problem, policy: Policy, request: Request, progress: Progress | None = None
) -> AfterStep | None:
    """Return the averages after a step of the disturbance that the policy assumes, or None if it assumes none."""
    assumed = policy.disturbance
    if assumed is None or assumed.deviation is None:
        return None
    plant, told = problem.actual or problem.plant, Stages(progress)
    if isinstance(plant, Plant) and plant.stated == policy.model.stated:  # a policy without a problem: its own model
        plant = assumed.removed_from(plant)
    plant = assumed.stepped(plant)
    precise = precisely(request, policy)
    found = averages_on(plant, problem, policy, precise, told.stage(0.0, 0.5))
    always = averages_on(plant, problem, _with_every_sample(problem, policy), precise, told.stage(0.5, 1.0))
    size = tuple(float(value) for value in np.atleast_1d(assumed.deviation))
    return AfterStep(size, found.cost, always.cost, found.rates, found.settled and always.settled)


def precisely(request: Request, policy: Policy) -> Request:
    """Return the request with a standard error of 0.1 % of the cost of every sample, unless it wants a larger one."""
    return replace(request, standard_error=max(ACCURACY * policy.cost_all_time, request.standard_error or 0.0))


def averages_on(
    plant: Plant | ContinuousPlant, problem: Problem, policy: Policy, request: Request, progress: Progress | None
) -> Averages:
    """Return the averages of a policy on a plant with another disturbance than that of its design.

    The loop recovers from such a disturbance as slowly as from a fault, so this time constant decides how many steps
    are dropped.
    """
    policy = replace(policy, theory=replace(policy.theory, settling=policy.theory.recovers))
    network = problem.network if policy.network.nodes == problem.network.nodes else policy.network
    loop = close(plant, policy, network.with_intervals(policy.network), problem.cost)
    error = None if request.steps else request.standard_error
    return average(loop, seed=request.seed, standard_error=error, steps=request.steps, progress=progress)


def _with_every_sample(problem: Problem, policy: Policy) -> Policy:
    """Return the same control with a packet at every sample; some rules, such as levels of the output, have none."""
    if problem.controller is None:
        return sends_every_sample(policy)
    period = policy.tick if isinstance(problem.plant, ContinuousPlant) else None
    network, links = problem.network, policy.scheduled
    # over several links, which are ideal, the loop with every sample is that of one link
    sensed = len(links) == 1 and bool(network.nodes[links[0]].measures)
    link = "sensor" if sensed else "actuator"
    always = send_every_sample(policy.kind, problem.plant, problem.cost, period, problem.controller, link)
    return placed(always, network.unlimited) if len(links) == 1 else always


def sends_every_sample(policy: Policy) -> Policy:
    """Return the policy with triggers that always send, whatever the limits of the intervals between sends."""

    def always(trigger: Trigger) -> Trigger:
        return Trigger({**trigger.options, "silent": Form(constant=NEVER)})

    steps = tuple(
        replace(step, trigger=always(step.trigger)) if isinstance(step, Decide) and step.decision == SEND else step
        for step in policy.steps
    )
    return replace(policy, steps=steps, network=policy.network.unlimited)


PATHS, TICKS = 512, 512  # over which the share of steps at a limit is counted, after the transient
FEWEST, NUMBERS = 64, 20_000_000  # paths at least, and most inputs that are recorded with more
CONSTANTS, LONGEST = 12, 4096  # length of the transient in time constants, and its most steps
NEAR = 1e-9  # relative distance at which an input is at its limit: the rounding of set-points


@dataclass(frozen=True, repr=False)
class WithoutLimits(Displayed):
    """The loop without limits of its inputs, compared with the loop that has them.

    Args:
        share: share of the steps in which a limit binds, in the loop with limits; None if it has no average.
        cost: cost of the loop without limits; None for a policy that is given without its problem.
        cost_bound: proven upper bound on this cost, or None.
        rates: sends per step or per second without limits, by scheduled link.
    """

    share: Estimate | None
    cost: Estimate | None
    cost_bound: float | None
    rates: Mapping[str, Estimate] = field(hash=False)

    def document(self) -> dict[str, Any]:
        """Return the parts of the JSON document of ``taciturn evaluate --json``."""
        rates = {link: rate.document("value", "standard_error") for link, rate in self.rates.items()}
        cost = None if self.cost is None else self.cost.document("value", "standard_error")
        free = {"cost": cost, "cost_bound": self.cost_bound, "rates": rates}
        share = None if self.share is None else self.share.document("value", "standard_error")
        return {"share_at_limit": share, "without_limits": free}

    def text(self, unit: str) -> str:
        """Return the comparison as one sentence."""
        bind = "the share of the steps in which a limit binds has no average"
        if self.share is not None:
            bind = f"a limit binds in {self.share.scaled(100)} % of the steps"
        bound = "" if self.cost_bound is None else f", guarantee {self.cost_bound:.6g}"
        if self.cost is None:
            return bind + bound.replace(", ", "; without limits: ", 1)
        rates = ", ".join(f"{rate} sends {unit}" for rate in self.rates.values())
        return f"{bind}; without limits: cost {self.cost}{bound}, {rates}"


def compare_without_limits(
    problem: Problem, loop: Loop, request: Request, pace: float, progress: Progress | None
) -> WithoutLimits | None:
    """Return the comparison of a loop with the same loop without limits, or None if no input has a limit."""
    limits = loop.problem.plant.saturation
    if limits is None:
        return None
    # it would be that of the first steps, before the noise or the disturbances have come near the limits
    share = None if escapes(loop) or wanders(loop) else share_at_limits(loop, limits, request.seed)
    if isinstance(problem.own, BareKind):
        bound = loop.policy.guarantee
        return WithoutLimits(share, None, None if bound is None else bound.cost, {})
    actual = None if problem.actual is None else problem.actual.unlimited
    free = replace(problem, plant=problem.plant.unlimited, actual=actual)
    policy = free.designed()
    assert isinstance(policy, Policy)  # the others refuse limits
    other = replace(free.close(policy), precision=loop.precision)
    found, proved = measure(other, request, progress).averages, policy.guarantee if other.nominal else None
    rates = {link: rate.scaled(pace) for link, rate in found.rates.items()}
    return WithoutLimits(share, found.cost, None if proved is None else proved.cost, rates)


def share_at_limits(loop: Loop, limits: Saturation, seed: int) -> Estimate:
    """Return the share of the steps of a loop in which an input, or its change, is at a limit.

    The paths begin at random steps of a timetable, which may last longer than they do, and end with a cycle of the
    policy.
    """
    inputs, horizon, cycle = loop.problem.plant.inputs, loop.horizon, loop.policy.cycle
    burn = 0 if horizon is not None else min(int(CONSTANTS * loop.policy.theory.settling) + 1, LONGEST)
    program = loop.program().keep(outputs={Entry(APPLIED, i) for i in range(inputs)})
    ticks = burn + -(-TICKS // cycle) * cycle if horizon is None else horizon
    paths = max(FEWEST, min(PATHS, NUMBERS // (ticks * inputs)))
    start = loop.start(program, paths, seed, stationary=horizon is None)
    outputs = prepare(program)(start, ticks, None).outputs
    applied = np.stack([outputs[Entry(APPLIED, i)] for i in range(inputs)], axis=-1)
    first = np.broadcast_to(first_input(loop.policy, loop.problem.plant), (1, *applied.shape[1:]))
    at = _at_limits(limits, applied, np.concatenate([first, applied[:-1]]))[burn:].mean(axis=0)
    return Estimate(float(at.mean()), float(at.std(ddof=1) / np.sqrt(paths)), "simulation")


def _at_limits(limits: Saturation, applied: Array, before: Array) -> Array:
    """Return whether an input is at a limit, by step and path, given inputs (steps, paths, inputs)."""
    with np.errstate(invalid="ignore"):
        found = (applied <= limits.low + NEAR * np.abs(limits.low)) | (
            applied >= limits.high - NEAR * np.abs(limits.high)
        )
    if limits.rate is not None:
        found |= np.abs(applied - before) >= limits.rate * (1 - NEAR)
    return np.asarray(found.any(axis=-1), dtype=np.float64)


Consistency = Literal["guaranteed", "verified", "not verified"]
ZERO = 1e-11  # relative difference of two costs that is a rounding error
THERE = "the bound at this rate"
DAY = 86400.0  # seconds
DIRECTION = {"guarantee": 1, "guarantee, this rate": 1, "no schedule below": -1}
"""Direction in which a bound is rounded, so that it still holds."""


@dataclass(frozen=True, repr=False)
class Evaluation(Tabular):
    """Cost, rates and bounds of a policy.

    Args:
        policy: kind of the policy.
        unit: unit that the cost refers to: ``"step"``, ``"second"``, or ``"second at the sampling instants"`` if the
            integral has no average, or ``"mission"`` for a finite horizon or a discount.
        base_rate: rate of sending at every step, or None if sends may occur at any time.
        cost: cost per step or per second, or the total of a finite-horizon run.
        cost_all_time: exact cost of sending at every step, or None if the simulated plant is not the one of the design.
        cost_lqg: cost of LQG with the same weights and every sample, for a policy that keeps a given controller.
        statement: the theorem that proves the bounds, or None.
        cost_bound: proven upper bound on the cost, or None.
        cost_bound_at_rate: the sharper upper bound at the measured rate, or None.
        rates: sends per step or per second, by scheduled link; in a finite-horizon run, the mean fraction of the steps
            with a send (with a discount, sends are weighted like the costs).
        seed: seed of the random draws.
        seconds: wall time.
        steps: number of simulated steps; 0 if nothing was simulated.
        reached: whether the requested standard error was reached.
        schedule: schedule of the sensor queries, computed offline, or None.
        clock: fair periodic control at the measured rate, that is, time-triggered control with the measurements and the
            actuation of the policy; None if there is no such control or if it is unstable.
        mean_interval: mean seconds between sends, for policies that send on the error of a prediction.
        lower_bound: lower bound on the cost of any scheduling of this controller at the measured rate, if requested.
        rate_bounds: certified bounds on the rate, if a lower bound was requested and the send decision depends only on
            the error that a send resets; else None.
        consistency: whether the policy costs no more than fair periodic control: ``"guaranteed"`` by its theorem,
            ``"verified"`` by these numbers and their errors (4 standard errors), or ``"not verified"``; None if the
            question does not apply.
        notes: warnings and remarks for the reader.
        linearisation: cost of the linearised plant if the plant of the design is nonlinear, else None.
        estimator: quantity that a simulation averaged (see ``Averages``).
        settled: whether the initial transient of a simulated loop has decayed.
        method: method that gave cost and rates: ``"exact"``, ``"quadrature"``, ``"conditional sampling"`` or
            ``"simulation"``.
        reason: why this method was chosen.
        no_clock: reason why ``clock`` is None.
        trusted: whether the variance of a simulated cost is finite, as far as is known; if not, a note gives the
            reason.
        bound_error: standard error of ``cost_bound_at_rate`` that is due to the standard error of the measured rate.
        power: mean power in watts of the packets of each link whose energy is given.
        life: seconds until the battery of each link's sender is empty, where it is given.
        prices: prices of a packet on the links with a rate.
        after_step: averages after a step of the slow disturbance that the policy assumes, or None.
        without_limits: how often a limit of the inputs binds, and the loop without limits; None if no input has one.
        as_written: the loop without a slow disturbance that a default has added to the plant; None if none was added.
        violations: probabilities that the limits of the problem are violated, or None.
        proved: whether the bounds are proved for the gains as they are stored, and rounded upwards; otherwise they are
            those of the theorem for exact gains, computed in doubles.
        cost_all_time_error: proved bound on the error of ``cost_all_time``; None if its error is only estimated.
    """

    heading: ClassVar[tuple[str, ...]] = ("policy", "unit", "rate_unit", "method", "seed", "notes")

    policy: str
    unit: Unit
    base_rate: float | None
    cost: Estimate
    cost_all_time: float | None
    statement: str | None
    cost_bound: float | None
    cost_bound_at_rate: float | None
    rates: Mapping[str, Estimate] = field(hash=False)
    seed: int
    seconds: float
    steps: int
    reached: bool
    schedule: Schedule | None
    clock: ClockMix | None
    mean_interval: Estimate | None
    lower_bound: LowerBound | None
    rate_bounds: tuple[float, float] | None
    consistency: Consistency | None
    notes: tuple[str, ...]
    linearisation: Linearisation | None = None
    estimator: str = ""
    settled: bool = True
    method: str = "simulation"
    reason: str = "no other method applies"
    no_clock: str = ""
    trusted: bool = True
    bound_error: float = 0.0
    after_step: AfterStep | None = None
    power: Mapping[str, Estimate] = field(hash=False, default_factory=lambda: {})
    life: Mapping[str, Estimate] = field(hash=False, default_factory=lambda: {})
    prices: Mapping[str, float] = field(hash=False, default_factory=lambda: {})
    cost_lqg: float | None = None
    without_limits: WithoutLimits | None = None
    violations: Violations | None = None
    as_written: AsWritten | None = None
    proved: bool = False
    cost_all_time_error: float | None = None

    @property
    def rate_unit(self) -> TimeUnit:
        """Unit of time of the rates."""
        return rate_unit(self.unit)

    @property
    def highest_all_time(self) -> float:
        """The upper end of the cost of sending every sample, of which a bound is a multiple."""
        assert self.cost_all_time is not None, "a bound is that of a base"
        return self.cost_all_time + (self.cost_all_time_error or 0.0)

    @property
    def traffic(self) -> Estimate | None:
        """The rates of all links, each times the price of a packet, with an upper bound on the standard error."""
        paid = [rate.scaled(self.prices.get(link, 1.0)) for link, rate in self.rates.items()]
        value, error = sum(one.value for one in paid), sum(one.standard_error for one in paid)
        return Estimate(value, error, paid[0].method) if paid else None

    @property
    def drawn(self) -> bool:
        """True if any number in the result depends on the seed."""
        return self.method in ("simulation", CONDITIONAL) or (self.lower_bound or self.violations) is not None

    @property
    def cost_periodic_same_rate(self) -> float | None:
        """Exact cost of fair periodic control at the measured rate, or None if there is none."""
        return None if self.clock is None else self.clock.cost

    def summary(self) -> Mapping[str, object]:
        """Return policy, cost, rates and bounds by name."""
        names = ("policy", "cost", "rates", "unit", "cost_all_time", "cost_periodic_same_rate", "cost_bound", "method")
        return {name: getattr(self, name) for name in names}

    def short(self) -> str:
        """Return the cost as short text."""
        return f"cost {self.cost}"

    def columns(self) -> Columns:
        """Return one row each for this policy, periodic control at its rate, sending every sample, and the bounds."""
        return columns_of([*evaluation_records(self)])

    def __str__(self) -> str:
        """Return the text that ``taciturn evaluate`` prints."""
        how = self.method if self.cost.method == "simulation" else self.cost.method
        method = how if self.estimator in ("", how) else f"{how}, {self.estimator}"
        first: Lines = [("policy", self.policy), ("method", f"{method}: {self.reason}")]
        if self.as_written is not None:
            first.append(("by default", self.as_written.text(f"per {self.rate_unit}")))
        return "\n\n".join(filter(None, [pairs_text(first), _table(self), pairs_text(_details(self))]))

    def document(self) -> dict[str, Any]:
        """Return the JSON document of ``taciturn evaluate --json``."""
        result: dict[str, Any] = {
            "policy": self.policy,
            "unit": self.unit,
            "rate_unit": self.rate_unit,
            "base_rate": self.base_rate,
            "cost": _estimate(self.cost),
            "cost_all_time": self.cost_all_time,
            "cost_all_time_error": self.cost_all_time_error,
            "cost_bound": self.cost_bound,
            "proved": self.proved,
            "cost_bound_at_rate": self.cost_bound_at_rate,
            "cost_bound_at_rate_standard_error": self.bound_error,
            "rates": {link: rate.document("value", "standard_error") for link, rate in self.rates.items()},
            "traffic": None if self.traffic is None else self.traffic.document("value", "standard_error"),
            "seed": self.seed,
            "seconds": round(self.seconds, 4),
            "steps": self.steps,
            "reached": self.reached,
            "method": self.method,
            "method_reason": self.reason,
        }
        if self.lower_bound is not None:
            result["cost_lower_bound"] = self.lower_bound.cost
            result["cost_lower_bound_confidence"] = self.lower_bound.confidence
        if self.rate_bounds is not None:
            result["rate_bounds"] = list(self.rate_bounds)
        if self.consistency is not None:
            result["consistency"] = self.consistency
        result["cost_periodic_same_rate"] = self.cost_periodic_same_rate
        result["clock"] = None if self.clock is None else self.clock.document()
        result |= {"clock_reason": self.no_clock} if self.no_clock else {}
        if self.mean_interval is not None:
            result["mean_interval"] = _estimate(self.mean_interval)
        if self.linearisation is not None:
            result["linearisation"] = asdict(self.linearisation)
        if self.schedule is not None:
            result["schedule"] = self.schedule.document()
        result |= {} if self.cost_lqg is None else {"cost_lqg": self.cost_lqg}
        for name, found, unit in (("power", self.power, 1.0), ("battery_days", self.life, DAY)):
            if found:
                scaled = {link: one.scaled(1 / unit) for link, one in found.items()}
                result[name] = {link: one.document("value", "standard_error") for link, one in scaled.items()}
        if self.violations is not None:
            result["violation"] = self.violations.document()
        if self.after_step is not None:
            result["after_step"] = self.after_step.document()
        result |= {} if self.without_limits is None else self.without_limits.document()
        result |= {} if self.as_written is None else {"as_written": self.as_written.document()}
        return result | ({"notes": list(self.notes)} if self.notes else {})


def evaluation_records(found: Evaluation) -> list[dict[str, object]]:
    """Return rows of costs and rates: the policy, periodic control at its rate, sending every sample, and the bounds.

    A policy that sends every sample is not compared with itself.
    """
    always = _sends_every_sample(found)
    base = None if always else found.cost_all_time
    same = found.rates
    pace = dict.fromkeys(same, None if found.base_rate is None else Estimate(found.base_rate, 0.0, "exact"))
    rows: list[dict[str, object]] = []

    def add(name: str, cost: Estimate | float | None, rates: Mapping[str, Estimate | None]) -> None:
        if cost is not None:
            known = cost if isinstance(cost, Estimate) else Estimate(cost, 0.0, "exact")
            extra = {"extra_percent": known.scaled(100 / base, -100)} if base else {}
            seen: Mapping[str, object] = {} if rows or found.violations is None else found.violations.records()
            rows.append(
                {"name": name, "cost": known, **extra, **{f"rate_{link}": rates.get(link) for link in same}, **seen}
            )

    add("this policy", found.cost, found.rates)
    add("periodic, same rate", None if always else periodic_cost(found), _clock_rates(found))
    add("every sample", base, pace)
    add("guarantee", proved(found.cost_bound), {})
    add("guarantee, this rate", bound_at_rate(found), same)
    add("no schedule below", least_cost(found), same)
    return rows


def _table(found: Evaluation) -> str:
    """Return the records as a text table; bounds are rounded so that they still hold."""
    total, many = found.unit == "mission", len(found.rates) > 1
    base = None if _sends_every_sample(found) else found.cost_all_time
    per = "sends per step" if total else f"sends per {found.rate_unit}"
    header = ["", f"cost {per_unit(found.unit)}"]
    header += (["extra cost"] if base else []) + [f"{link} {per}" if many else per for link in found.rates]
    lower = None if found.lower_bound is None else found.lower_bound.cost
    unrounded = dict(zip(DIRECTION, (found.cost_bound, found.cost_bound_at_rate, lower), strict=True))
    rows: list[list[str]] = []
    for record in evaluation_records(found):
        cost, up = cast("Estimate", record["cost"]), DIRECTION.get(str(record["name"]))
        value = unrounded.get(str(record["name"]))
        exact = cost if value is None else replace(cost, value=value)  # it is rounded once
        cells = [str(record["name"]), str(cost) if up is None else bound_text(exact, up)]
        if base:
            of = base if up != 1 else found.highest_all_time
            above = percent_above(exact, of, up or 0)
            cells.append("" if record["name"] == "every sample" else above)
        for link, rate in found.rates.items():
            shown = cast("Estimate | None", record[f"rate_{link}"])
            measured = record["name"] == "this policy"
            cells.append("" if shown is None else str(rate) if measured else f"{shown.value:.4g}")
        rows.append(cells)
    return table_text(header, rows, 1)


def _details(found: Evaluation) -> Lines:
    """Return the details that the table does not contain, one line each."""
    lines: Lines = []
    if _sends_every_sample(found):
        lines.append(("periodic", "the same as this policy, which sends every sample"))
    elif found.clock is not None:
        ((_, rate),) = _clock_rates(found).items()
        fewer = "" if rate in found.rates.values() else "; more packets do not lower its cost"
        lines.append(("periodic", clock_text(found.clock) + fewer))
    elif found.no_clock:
        lines.append(("periodic", f"none at this rate: {found.no_clock}"))
    if found.cost_bound is not None:
        lines.append(("proof", proof_text(found.proved, found.cost_all_time_error is not None)))
    if found.linearisation is not None:
        lines.append(("linearisation", _promised(found)))
    if found.lower_bound is not None:
        lines.append(("no schedule", f"of this controller at this rate, {percent(found.lower_bound.confidence)} sure"))
    if found.rate_bounds is not None:
        low, high = found.rate_bounds
        text = f"{rounded(low, 4, -1)} to {rounded(high, 4, 1)} per {found.rate_unit}"
        lines.append(("certified rate", text))
    if found.mean_interval is not None:
        lines.append(("mean interval", f"{found.mean_interval} s"))
    if found.consistency is not None:
        lines.append(("consistent", found.consistency))
    if found.schedule is not None:
        several = len(found.schedule.links) > 1
        for link, one in found.schedule.by_link.items():
            lines.append((f"queries, {link}" if several else "sensor queries", queries_text(one)))
    if len(found.rates) > 1 and found.traffic is not None:
        lines.append(("traffic", f"{found.traffic} per {found.rate_unit}, the rates times the prices of a packet"))
    for link, power in found.power.items():
        life = found.life.get(link)
        lasting = "" if life is None else f"; the battery lasts {life.scaled(1 / DAY)} days"
        lines.append((f"power, {link}", f"{power.scaled(1e3)} mW for packets{lasting}"))
    lines += [] if found.violations is None else found.violations.lines()
    for name, part in (("after a step", found.after_step), ("limits", found.without_limits)):
        lines += [] if part is None else [(name, part.text(f"per {found.rate_unit}"))]
    lines += [("verdict", text) for text in _verdict(found)]
    return [*lines, *(("note", note) for note in found.notes)]


def _verdict(found: Evaluation) -> list[str]:
    """Return a sentence with the rate and the cost of a policy and their distance from the bounds, or a reason."""
    base, lower = found.cost_all_time, found.lower_bound
    if _sends_every_sample(found):
        return []
    if base is None:
        return ["none: the cost of sending every sample is known for the loop of the design, and not for this loop"]
    if base <= 0:
        return ["none: sending every sample costs nothing, so no cost is a percentage of it"]
    if not found.settled:
        return ["none: the loop has not settled, so the simulated cost is not an average"]
    if not found.trusted:
        return ["none: the standard error of the cost cannot be trusted"]
    if found.as_written is not None:
        return [_verdict_as_written(found, found.as_written)]
    above, error = found.cost.value / base - 1, found.cost.standard_error / base
    error = 0.0 if negligible(found.cost.standard_error, found.cost.value) else error
    least = None if lower is None else lower.cost / base - 1
    decimals = max(MOST_DECIMALS, -magnitude(100 * above))
    if least is not None:
        decimals = max(decimals, decimals_of(above - least, 1))  # enough to distinguish the two
    side = "above" if above >= 0 else "below"
    text = f"costs {percent(abs(above), decimals, error=error)} {side} sending every sample"
    if abs(above) <= ZERO and error == 0:
        text = "costs as much as sending every sample"
    if found.base_rate is not None:
        text = f"sends {_shares(found.rates, found.base_rate)}, {text}"
    bound = found.cost_bound if found.cost_bound_at_rate is None else found.cost_bound_at_rate
    if bound is not None:
        by, moved = ("the guarantee", 0.0) if found.cost_bound_at_rate is None else (THERE, found.bound_error)
        text += f", at most {percent_above(_moved(bound, moved), found.highest_all_time, 1, signed=False)} by {by}"
    if least is None:
        return [text]
    if least <= ZERO:
        return [f"{text}; no bound above the cost of sending every sample is proved for this controller at this rate"]
    least_text = percent(least, max(decimals, -magnitude(100 * least)), up=-1)
    return [f"{text}; no schedule of this controller at this rate costs less than {least_text} above"]


def _verdict_as_written(found: Evaluation, written: AsWritten) -> str:
    """Return the verdict for the plant as written, next to that for the plant with what a default has added."""
    assert found.cost_all_time is not None
    rates = "" if found.base_rate is None else f"sends {_shares(written.rates, found.base_rate)}, "
    with_it = percent_above(found.cost, found.cost_all_time)
    if not written.settled:
        return f"none: on the plant as written, the loop has not settled; {with_it} with the disturbance by default"
    if not written.cost_all_time:
        extra = f"costs {written.cost}; the cost of every sample there is not known"
    else:
        extra = f"costs {written.extra()} relative to sending every sample"
    return (
        f"on the plant as written, without the disturbance that is added by default: {rates}{extra}. With the "
        f"disturbance {with_it}, to which the guarantee refers"
    )


def _shares(rates: Mapping[str, Estimate], base_rate: float) -> str:
    """Return the rates of all links as percentages of the rate of sending every sample."""
    found: list[str] = []
    for link, rate in rates.items():
        share = rate.value / base_rate
        text = f"{percent(share, decimals_of(share, 3), error=rate.standard_error / base_rate)} of the time"
        found.append(f"{text} on the {link} link" if len(rates) > 1 else text)
    return " and ".join(found)


def _sends_every_sample(found: Evaluation) -> bool:
    """Return whether the policy is the one that sends every sample, by a closed form."""
    return found.cost.method == "exact" and all(rate.value == found.base_rate for rate in found.rates.values())


def _promised(found: Evaluation) -> str:
    """Return the cost that the linearisation predicts, compared with the plant's cost; it is not a guarantee."""
    promised, cost = found.linearisation, found.cost.value
    assert promised is not None
    text = f"sending every sample costs {promised.cost_all_time:.6g}"
    if promised.cost_all_time:
        text += f" (measured: {found.cost.scaled(1 / promised.cost_all_time)} times that)"
    if promised.cost_bound is not None:
        over, margin = cost - promised.cost_bound, 4 * found.cost.standard_error
        seen = "met here" if over + margin <= 0 else "exceeded here" if over > margin else "undecided within the errors"
        text += f", its bound {promised.cost_bound:.6g} ({seen})"
    return f"{text}; none of this is guaranteed for the nonlinear plant"


def least_cost(found: Evaluation) -> float | None:
    """Return the lower bound on the cost of any schedule, rounded down to six digits, or None without a bound."""
    return None if found.lower_bound is None else outward(found.lower_bound.cost, 6, -1)


def bound_at_rate(found: Evaluation) -> Estimate | None:
    """Return the upper bound at the measured rate, with the error due to that of the rate."""
    bound = found.cost_bound_at_rate
    return None if bound is None else _moved(bound, found.bound_error)


def periodic_cost(found: Evaluation) -> Estimate | None:
    """Return the cost of periodic control at the measured rate, with the error due to that of the rate."""
    return None if found.clock is None else _moved(found.clock.cost, found.clock.standard_error)


def _clock_rates(found: Evaluation) -> Mapping[str, Estimate]:
    """Return the rates of periodic control: the measured ones, or a lower one at which it costs no more."""
    (rate, *others), clock = found.rates.values(), found.clock
    if clock is None or others or clock.rate >= rate.value * (1 - SAME):
        return found.rates
    return dict.fromkeys(found.rates, Estimate(clock.rate, 0.0, "exact"))


def _moved(cost: float, error: float) -> Estimate:
    return Estimate(cost, error, "simulation" if error else "exact")


def _estimate(estimate: Estimate) -> dict[str, Any]:
    return estimate.document() | (estimate.document("error") if estimate.method == "quadrature" else {})
