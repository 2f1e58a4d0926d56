"""The result of an evaluation: cost, rates and bounds of a policy, with their units, and the numbers next to them.

``Evaluation.FIELDS`` lists each number once, in the order of the JSON document. Its table has a row for the policy, for
fair periodic control at its rate, for sending every sample, and for each bound; the lines below it end with a verdict
in one sentence. Costs are per step, per second, per second at the sampling instants (if the integral of the stage cost
has no average), or per finite-horizon run; rates are per step or per second. An excess is relative to the cost J_all of
sending every sample, 100 (J/J_all − 1) %. That of an upper bound is relative to the upper end of J_all, and is rounded
up; that of a lower bound is rounded down.

Three further loops are parts of an evaluation, where they apply:

* ``AfterStep``: cost and rate under a constant disturbance of one standard deviation, for a policy that assumes a slow
  disturbance, next to the same control that sends every sample.
* ``WithoutLimits``: the loop without the limits of its inputs, and the share of the steps in which a limit binds. This
  share is counted on paths that start after twelve time constants.
* ``AsWritten``: the loop on the plant as written, without a slow disturbance that a default has added.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, ClassVar, Literal, TypeAlias, TypeVar, cast

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn._progress import Progress, Stages
from taciturn._text import Lines, magnitude, negligible, per_unit, percent
from taciturn.base.filter import SEND
from taciturn.design.kind import usual_nodes
from taciturn.design.silence import send_every_sample
from taciturn.loop import Loop, close
from taciturn.lqg.discrete import has_average
from taciturn.model.diagram import pattern_text
from taciturn.model.estimate import Estimate, bound_text, outward, proved, rounded
from taciturn.model.limits import Violations
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.result import SPLICED, Field, Result, Tabular, plain_fields, seconds, whole
from taciturn.model.saturation import Saturation
from taciturn.model.schedule import Schedule
from taciturn.model.steps import Decide
from taciturn.model.theory import Linearisation, LowerBound
from taciturn.model.trigger import Form, Trigger
from taciturn.problem import Problem
from taciturn.problem.without_file import BareKind
from taciturn.program.engine import prepare
from taciturn.program.ops import Entry
from taciturn.program.translation import APPLIED, first_input
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


def proof_text(proved: bool, every_sample: bool) -> str:
    """Return in words which numbers of a guarantee are computed with proved errors."""
    if proved:
        return "J_all and guarantee are proved for the gains as stored"
    if every_sample:
        return "J_all is proved for the gains as stored; what silence adds is computed in doubles, for exact gains"
    return "of the theorem; its numbers are computed in doubles, with estimated rounding errors"


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


def _sends(rates: Mapping[str, Estimate], unit: str) -> str:
    return ", ".join(f"{rate} sends {unit}" for rate in rates.values())


@dataclass(frozen=True, repr=False)
class AsWritten(Result):
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

    def extra(self) -> str:
        """Return by how much the policy costs more than sending every sample on the plant as written, as text."""
        if not self.cost_all_time:
            return "without known cost of every sample"
        return percent_above(self.cost, self.cost_all_time)

    def text(self, unit: str) -> str:
        """Return what is added and the numbers without it as one sentence."""
        every = "" if self.cost_all_time is None else f", every sample {self.cost_all_time:.6g} ({self.extra()})"
        late = "" if self.settled else "; the loop has not settled: more steps are required"
        return (
            f"a slow disturbance at each input that the problem does not state ({self.added}); on the plant as "
            f"written, this policy costs {self.cost}{every}, {_sends(self.rates, unit)}{late}"
        )


ACCURACY = 1e-3  # standard error relative to the cost of sending every sample
NEVER = 1e150  # a cost of silence above that of any packet


@dataclass(frozen=True, repr=False)
class AfterStep(Result):
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

    def text(self, unit: str) -> str:
        """Return the averages as one sentence."""
        size = ", ".join(f"{value:.4g}" for value in self.size)
        sent = _sends(self.rates, unit)
        late = "" if self.settled else "; the transient has not decayed: more steps are required"
        return f"of {size} at the input: cost {self.cost}, with every sample {self.cost_all_time}; {sent}{late}"


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
    return replace(always, network=usual_nodes(network, policy.kind)) if len(links) == 1 else always


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
class WithoutLimits(Result):
    """The loop without limits of its inputs, compared with the loop that has them.

    Args:
        share: share of the steps in which a limit binds, in the loop with limits; None if it has no average.
        cost: cost of the loop without limits; None for a policy that is given without its problem.
        cost_bound: proven upper bound on this cost, or None.
        rates: sends per step or per second without limits, by scheduled link.
    """

    FIELDS: ClassVar[tuple[Field[WithoutLimits], ...]] = (
        Field("share", key="share_at_limit"),
        Field(
            "without_limits",
            lambda found: {"cost": found.cost, "cost_bound": found.cost_bound, "rates": found.rates},
        ),
    )

    share: Estimate | None
    cost: Estimate | None
    cost_bound: float | None
    rates: Mapping[str, Estimate] = field(hash=False)

    def text(self, unit: str) -> str:
        """Return the comparison as one sentence."""
        bind = "the share of the steps in which a limit binds has no average"
        if self.share is not None:
            bind = f"a limit binds in {self.share.scaled(100)} % of the steps"
        bound = "" if self.cost_bound is None else f", guarantee {self.cost_bound:.6g}"
        if self.cost is None:
            return bind + bound.replace(", ", "; without limits: ", 1)
        return f"{bind}; without limits: cost {self.cost}{bound}, {_sends(self.rates, unit)}"


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


R = TypeVar("R")  # row of a table
Consistency = Literal["guaranteed", "verified", "not verified"]
ZERO = 1e-11  # relative difference of two costs that is a rounding error
DAY = 86400.0  # seconds


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
    bound = found.guarantee_at_rate or _known(found.cost_bound)
    if bound is not None:
        by = "the guarantee" if found.cost_bound_at_rate is None else "the bound at this rate"
        text += f", at most {percent_above(bound, found.highest_all_time, 1, signed=False)} by {by}"
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


def _promised(found: Evaluation) -> str:
    """Return the cost that the linearisation predicts, compared with the plant's cost; it is not a guarantee."""
    promised, cost = found.linearisation, found.cost.value
    if promised is None:
        return ""
    text = f"sending every sample costs {promised.cost_all_time:.6g}"
    if promised.cost_all_time:
        text += f" (measured: {found.cost.scaled(1 / promised.cost_all_time)} times that)"
    if promised.cost_bound is not None:
        over, margin = cost - promised.cost_bound, 4 * found.cost.standard_error
        seen = "met here" if over + margin <= 0 else "exceeded here" if over > margin else "undecided within the errors"
        text += f", its bound {promised.cost_bound:.6g} ({seen})"
    return f"{text}; none of this is guaranteed for the nonlinear plant"


def _known(cost: float | None, error: float = 0.0) -> Estimate | None:
    return None if cost is None else Estimate(cost, error, "simulation" if error else "exact")


def _sends_every_sample(found: Evaluation) -> bool:
    """Return whether the policy is the one that sends every sample, by a closed form."""
    return found.cost.method == "exact" and all(rate.value == found.base_rate for rate in found.rates.values())


def _clock_rates(found: Evaluation) -> Mapping[str, Estimate]:
    """Return the rates of periodic control: the measured ones, or a lower one at which it costs no more."""
    (rate, *others), clock = found.rates.values(), found.clock
    if clock is None or others or clock.rate >= rate.value * (1 - SAME):
        return found.rates
    return dict.fromkeys(found.rates, Estimate(clock.rate, 0.0, "exact"))


def _method(found: Evaluation) -> str:
    how = found.method if found.cost.method == "simulation" else found.cost.method
    return f"{how if found.estimator in ('', how) else f'{how}, {found.estimator}'}: {found.reason}"


def _periodic(found: Evaluation) -> str:
    if _sends_every_sample(found):
        return "the same as this policy, which sends every sample"
    if found.clock is None:
        return f"none at this rate: {found.no_clock}" if found.no_clock else ""
    ((_, rate),) = _clock_rates(found).items()
    return clock_text(found.clock) + ("" if rate in found.rates.values() else "; more packets do not lower its cost")


def _proof(found: Evaluation) -> str:
    return "" if found.cost_bound is None else proof_text(found.proved, found.cost_all_time_error is not None)


def _sure(found: Evaluation) -> str:
    bound = found.lower_bound
    return "" if bound is None else f"of this controller at this rate, {percent(bound.confidence)} sure"


def _certified(found: Evaluation) -> str:
    if found.rate_bounds is None:
        return ""
    low, high = found.rate_bounds
    return f"{rounded(low, 4, -1)} to {rounded(high, 4, 1)} per {found.rate_unit}"


def _queries(found: Evaluation) -> Lines:
    if found.schedule is None:
        return []
    parts, several = found.schedule.by_link, len(found.schedule.links) > 1
    return [(f"queries, {link}" if several else "sensor queries", queries_text(one)) for link, one in parts.items()]


def _traffic(found: Evaluation) -> str:
    several = len(found.rates) > 1 and found.traffic is not None
    return f"{found.traffic} per {found.rate_unit}, the rates times the prices of a packet" if several else ""


def _days(found: Evaluation) -> dict[str, Estimate]:
    """Return the days until the batteries are empty."""
    return {link: life.scaled(1 / DAY) for link, life in found.life.items()}


def _powers(found: Evaluation) -> Lines:
    days = {link: f"; the battery lasts {life} days" for link, life in _days(found).items()}
    watts = {link: f"{power.scaled(1e3)} mW for packets" for link, power in found.power.items()}
    return [(f"power, {link}", text + days.get(link, "")) for link, text in watts.items()]


def _violated(found: Evaluation) -> Lines:
    return [] if found.violations is None else found.violations.lines()


def _sentence(name: str) -> Callable[[Evaluation], str]:
    """Return the function that gives the sentence of a part of an evaluation."""

    def text(found: Evaluation) -> str:
        part = getattr(found, name)
        return "" if part is None else part.text(f"per {found.rate_unit}")

    return text


@dataclass(frozen=True, repr=False)
class _Row(Displayed):
    """A row of the table of an evaluation: a cost or, in a direction in which it holds, a bound, and rates."""

    name: str
    cost: Estimate | None  # a proved bound is rounded
    rates: Mapping[str, Estimate | None] = field(hash=False)
    up: int = 0
    exact: Estimate | None = None  # the bound, which the text rounds to the digits of its standard error

    def rate(self, link: str) -> str:
        """Return the cell of a rate; only that of the policy is measured."""
        rate = self.rates.get(link)
        return "" if rate is None else str(rate) if self.name == "this policy" else f"{rate.value:.4g}"


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

    FIELDS: ClassVar[tuple[Field[Evaluation], ...]] = (
        Field("policy", say="policy", above=True),
        *plain_fields("unit", "rate_unit", "base_rate"),
        Field("cost", json=whole),
        *plain_fields("cost_all_time", "cost_all_time_error", "cost_bound"),
        Field("proved", say="proof", text=_proof),
        Field("cost_bound_at_rate"),
        Field("bound_error", key="cost_bound_at_rate_standard_error"),
        Field("rates"),
        Field("traffic", say="traffic", text=_traffic, after="schedule"),
        Field("seed"),
        Field("seconds", json=seconds),
        *plain_fields("steps", "reached"),
        Field("method", say="method", text=_method, above=True),
        Field("reason", key="method_reason"),
        Field("cost_lower_bound", "lower_bound.cost", optional=True),
        Field(
            "cost_lower_bound_confidence",
            "lower_bound.confidence",
            optional=True,
            say="no schedule",
            text=_sure,
        ),
        Field("rate_bounds", optional=True, say="certified rate", text=_certified),
        Field("consistency", optional=True, say="consistent"),
        Field("cost_periodic_same_rate"),
        Field("clock", say="periodic", text=_periodic, after=""),
        Field("no_clock", key="clock_reason", optional=True),
        Field("mean_interval", json=whole, optional=True, say="mean interval", text="{} s", after="rate_bounds"),
        Field("linearisation", json=asdict, optional=True, say="linearisation", text=_promised, after="proved"),
        Field("schedule", optional=True, say="queries", text=_queries),
        Field("cost_lqg", optional=True),
        Field("power", optional=True, say="power", text=_powers),
        Field("battery_days", _days, optional=True),
        Field("violations", key="violation", optional=True, say="violation", text=_violated),
        Field("after_step", optional=True, say="after a step", text=_sentence("after_step")),
        Field("without_limits", key=SPLICED, optional=True, say="limits", text=_sentence("without_limits")),
        Field("as_written", optional=True, say="by default", text=_sentence("as_written"), above=True),
        Field("verdict", key="", say="verdict", text=_verdict),
        Field("notes", optional=True, say="note"),
    )
    heading: ClassVar[tuple[str, ...]] = ("policy", "unit", "rate_unit", "method", "seed", "notes")
    shown: ClassVar[tuple[str, ...]] = (
        "policy", "cost", "rates", "unit", "cost_all_time", "cost_periodic_same_rate", "cost_bound", "method",
    )  # fmt: skip
    gap: ClassVar[str] = "\n\n"

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
    def per(self) -> str:
        """Unit of the costs as text."""
        return per_unit(self.unit)

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

    @property
    def periodic(self) -> Estimate | None:
        """Cost of fair periodic control at the measured rate, with the error due to that of the rate."""
        return None if self.clock is None else _known(self.clock.cost, self.clock.standard_error)

    @property
    def guarantee_at_rate(self) -> Estimate | None:
        """Upper bound on the cost at the measured rate, with the error due to that of the rate."""
        return _known(self.cost_bound_at_rate, self.bound_error)

    def short(self) -> str:
        """Return the cost as short text."""
        return f"cost {self.cost}"

    def table_rows(self) -> Sequence[_Row]:
        """Return the policy, periodic control at its rate, sending every sample, and the bounds.

        A policy that sends every sample is not compared with itself.
        """
        always, same = _sends_every_sample(self), self.rates
        pace = dict.fromkeys(same, _known(self.base_rate))
        lower = None if self.lower_bound is None else self.lower_bound.cost
        least = None if lower is None else outward(lower, 6, -1)
        found = (
            _Row("this policy", self.cost, same),
            _Row("periodic, same rate", None if always else self.periodic, _clock_rates(self)),
            _Row("every sample", None if always else _known(self.cost_all_time), pace),
            _Row("guarantee", _known(proved(self.cost_bound)), {}, 1, _known(self.cost_bound)),
            _Row("guarantee, this rate", self.guarantee_at_rate, same, 1),
            _Row("no schedule below", _known(least), same, -1, _known(lower)),
        )
        return [row for row in found if row.cost is not None]

    def row_fields(self) -> tuple[Field[_Row], ...]:
        """Return the cost of a row, its excess over the cost of sending every sample, and its rates."""
        base = None if _sends_every_sample(self) else self.cost_all_time
        per = "sends per step" if self.unit == "mission" else f"sends per {self.rate_unit}"
        seen = () if self.violations is None else self.violations.records().items()

        def extra(row: _Row) -> Estimate | None:
            return row.cost.scaled(100 / base, -100) if base and row.cost is not None else None

        def exact(row: _Row) -> Estimate:
            found = row.exact or row.cost
            assert found is not None, "a row without a cost is left out"
            return found

        def above(row: _Row) -> str:
            of = self.highest_all_time if row.up == 1 else self.cost_all_time or 0.0
            return "" if row.name == "every sample" else percent_above(exact(row), of, row.up)

        def cost(row: _Row) -> str:
            return bound_text(exact(row), row.up) if row.up else str(row.cost)

        def rate(link: str) -> Field[_Row]:
            heading, column = f"{link} {per}" if len(self.rates) > 1 else per, f"rate_{link}"
            return Field(
                link, lambda row: row.rates.get(link), column=column, say=heading, text=lambda row: row.rate(link)
            )

        def violation(name: str, share: Estimate) -> Field[_Row]:
            return Field(name, lambda row: share if row.name == "this policy" else None, column=name)

        return (
            Field("name", column="name", say=""),
            Field("cost", column="cost", say=f"cost {self.per}", text=cost),
            *([Field("extra", extra, column="extra_percent", say="extra cost", text=above)] if base else []),
            *map(rate, self.rates),
            *(violation(name, share) for name, share in seen),
            *columns_of(lambda row: self if row.name == "this policy" else None, said=False),
        )


def columns_of(evaluation: Callable[[R], Evaluation | None], said: bool = True) -> list[Field[R]]:
    """Return the fields of evaluations that have a column, for a table that has an evaluation in its rows."""

    def column(one: Field[Evaluation]) -> Field[R]:
        def value(row: R) -> Any:
            found = evaluation(row)
            return None if found is None else one.of(found)

        def cell(row: R) -> str:
            found = evaluation(row)
            return "" if found is None else one.cell(found)

        heading = one.say if said else None
        return replace(cast("Field[Any]", one), value=value, say=heading, text=cell)

    return [column(one) for one in Evaluation.FIELDS if one.column]
