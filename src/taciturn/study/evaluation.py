"""The result of an evaluation: cost, rates and bounds of a policy, their units, and values for comparison.

``Evaluation.FIELDS`` lists each number once, in the order of the JSON document. A first table has a row for the policy,
for fair periodic control at its rate, for sending every sample, and for each bound; a second one has a row for each of
several links. Costs are per step, per second, per second at the sampling instants (if the integral of the stage cost
has no average), or per finite-horizon run; rates are per step or per second. An excess is relative to the cost J_all of
sending every sample, 100 (J/J_all − 1) %. Where no theorem gives J_all, such as with limits or losses, it is measured
(``baseline``), and the excess has the error of a pair on the same random numbers. That of an upper bound is relative to
the upper end of J_all, and is rounded up; that of a lower bound is rounded down.

The verdict answers how many packets the policy sends, what this costs compared with sending every sample, and what is
proven about it. Its numbers have the digits of the table, in which their standard errors are. If they are not averages,
if no guarantee holds for this loop, or if they are those of another plant than the user has written, the verdict says
so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeAlias, TypeVar, cast

from taciturn._display import Displayed
from taciturn._figure import Size, draw
from taciturn._style import StyleName
from taciturn._text import Lines, magnitude, number_of, per_unit, percent
from taciturn.lqg.discrete import has_average
from taciturn.model.estimate import Estimate, bound_text, outward, proved, rounded
from taciturn.model.limits import Violations
from taciturn.model.plant import ContinuousPlant
from taciturn.model.result import SPLICED, VERDICT, Field, Tabular, plain_fields, rows_text, seconds, whole
from taciturn.model.schedule import Schedule
from taciturn.model.theory import Linearisation, LowerBound
from taciturn.problem import Problem
from taciturn.simulation.late_packets import LatePackets
from taciturn.study.baseline import excess_over
from taciturn.study.evaluation_figure import cost_panel, rate_panel
from taciturn.study.further_loops import AfterStep, AsWritten, WithoutLimits
from taciturn.study.measure import CONDITIONAL
from taciturn.study.periodic import SAME, ClockMix
from taciturn.study.sentences import (
    MOST_DECIMALS,
    THAN,
    WITHDRAWN,
    ZERO,
    clock_text,
    decimals_of,
    excess_text,
    percent_above,
    percent_text,
    proof_text,
    queries_text,
    sends_text,
    share_of,
    share_text,
    together,
)
from taciturn.study.set_point_steps import SetPointSteps

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TimeUnit: TypeAlias = Literal["step", "second"]
Unit: TypeAlias = Literal["step", "second", "second at the sampling instants", "mission"]


def time_unit(problem: Problem) -> TimeUnit:
    """Return the unit of time of a problem's cost: second for a continuous-time plant, and step for a discrete-time
    one.
    """
    return "second" if isinstance(problem.plant, ContinuousPlant) else "step"


def cost_unit(problem: Problem) -> Unit:
    """Return the unit of a problem's cost: per step, per second, or total for a run over a finite horizon.

    If the integral of the cost has no average, the cost is that of the deviations at the sampling instants.
    """
    if problem.cost.mission:
        return "mission"
    integrated = all(has_average(plant, problem.cost) for plant in (problem.plant, problem.actual) if plant is not None)
    return time_unit(problem) if integrated else "second at the sampling instants"


def rate_unit(unit: Unit) -> TimeUnit:
    """Return the unit of time of send rates for the unit of the cost. Over a finite horizon, it is the step."""
    return "second" if unit.startswith("second") else "step"


R = TypeVar("R")  # row of a table
Consistency = Literal["guaranteed", "verified", "not verified"]
BY_DEFAULT = "with a slow disturbance by default: "  # begins the verdict on a plant that the user has not written
THIS, EVERY_SAMPLE = "this policy", "every sample"  # rows of the table
TOGETHER = "all links"  # the row of all links together
DAY = 86400.0  # seconds


def _verdict(found: Evaluation) -> Iterator[str]:
    """Yield the sentences of the verdict."""
    if not found.settled:
        yield "no verdict: the loop has not settled, so the simulated cost is not an average"
    elif not found.trusted:
        yield f"{packets_text(found.rates, found)}; no verdict on the cost, whose standard error cannot be trusted"
    elif found.sends_every_sample:
        yield f"100 % of the packets: this policy sends every sample, at a cost of {found.cost} {found.per}"
    elif found.as_written is not None:
        yield f"plant as written: {_as_written(found, found.as_written)}"
        yield f"{BY_DEFAULT}{_numbers(found, '')}"
    elif found.by_default:
        yield f"{BY_DEFAULT}{_numbers(found)}"
    else:
        yield _numbers(found)
    yield from withdrawn_text([found])
    yield from found.doubts


def withdrawn_text(listed: Sequence[Evaluation]) -> Iterator[str]:
    """Yield a sentence that says why no guarantee holds, if the simulated loops differ from the design."""
    reasons = dict.fromkeys(reason for found in listed for reason in found.withdrawn)
    if reasons:
        unknown = any(found.cost_every_sample is None for found in listed)
        also = ", and the cost of every sample is unknown" if unknown else ""
        yield f"no guarantee holds{also}: {'; '.join(reasons)}"


def _numbers(found: Evaluation, than: str = THAN) -> str:
    """Return packets, cost and guarantee."""
    proven = () if found.withdrawn else (_proven(found),)
    return ", ".join([packets_text(found.rates, found), cost_text(found, than), *proven])


def cost_text(found: Evaluation, than: str = THAN) -> str:
    """Write the cost as text, compared with the cost of sending every sample if this is known."""
    base, cost = found.cost_every_sample, f"cost {found.cost} {found.per}"
    if base is None:
        return cost
    if found.excess is None:
        return f"{cost}, where every sample costs nothing"
    return excess_text(found.excess, " cost", than, spread=found.measured) + ", measured" * found.measured


def packets_text(rates: Mapping[str, Estimate], found: Evaluation) -> str:
    """Write which share of the packets is sent, or the send rate if packets may be sent at any time."""
    share = share_of(rates, found.base_rate)
    if share is None:
        return ", ".join(f"{number_of(f'{rate.value:.4g}', 'packet')} per {found.rate_unit}" for rate in rates.values())
    return f"{share_text(share)} of the packets"


def _proven(found: Evaluation) -> str:
    """Return the guarantee, that at the measured rate if there is one."""
    bound = found.guarantee_at_rate
    if bound is None and found.cost_bound is not None:
        bound = Estimate(found.cost_bound, 0.0, "exact")
    if bound is None:
        return "exact" if found.cost.method == "exact" else "no guarantee"
    if not found.cost_all_time or found.cost_all_time <= 0:
        return f"at most {bound_text(bound, 1)} proven"
    more = "" if found.cost.value / found.cost_all_time - 1 > ZERO else " more"
    return f"at most {percent_above(bound, found.highest_all_time, 1, signed=False)}{more} proven"


def _title(found: Evaluation) -> str:
    """Return the first sentence of the verdict for a figure, whose axis names the cost to which costs are compared."""
    first, proven = found.verdict[0], _proven(found)
    bound = proven.removesuffix(" proven")
    if bound == proven or not first.endswith(f", {proven}"):
        return first
    more = " more" if bound.endswith(" %") else ""
    return f"{first.removesuffix(f', {proven}').replace(THAN, '')}; proven: {bound}{more}"


def _as_written(found: Evaluation, written: AsWritten) -> str:
    """Return packets and cost on the plant as the user has written it."""
    if not written.settled:
        return "no verdict, since the loop has not settled"
    cost = f"cost {written.cost} {found.per}"
    if written.excess is not None:
        measured = written.cost_all_time is None
        cost = excess_text(written.excess, " cost", THAN, spread=measured) + ", measured" * measured
    return f"{packets_text(written.rates, found)}, {cost}"


def _written_line(found: Evaluation) -> str:
    """Return the default disturbance that was added to the plant, and the numbers without it."""
    written = found.as_written
    if written is None:
        return ""
    every, late = "", "" if written.settled else "; the loop has not settled: more steps are required"
    if written.cost_every_sample is not None:
        extra = "" if written.excess is None else f" ({percent_text(written.excess)})"
        every = f", every sample {written.cost_every_sample}{extra}"
    packets = sends_text(written.rates, f"per {found.rate_unit}")
    return (
        f"the table is for a slow disturbance at each input that the problem does not state ({written.added}); on the "
        f"plant as written, this policy costs {written.cost}{every}, {packets}{late}"
    )


def _percent_document(excess: Estimate) -> dict[str, Any]:
    """Return the JSON of an excess in percent."""
    return whole(excess.scaled(100.0))


def _each(estimates: Mapping[str, Estimate]) -> dict[str, Any]:
    """Return the JSON of estimates by name."""
    return {name: one.document() for name, one in estimates.items()}


def _better_line(found: Evaluation) -> str:
    """Return why other controllers that send every sample are in the table."""
    if not found.better:
        return ""
    costs = " and ".join(f"{name} costs {cost}" for name, cost in found.better.items())
    return (
        "sending less costs less here, because the controller amplifies noise, so that the saving says little about "
        f"the policy; with every sample, {costs}"
    )


def _proof_line(found: Evaluation) -> str:
    """Return which numbers are proved, if there is a guarantee."""
    return "" if found.cost_bound is None else proof_text(found.proved, found.cost_all_time_error is not None)


def _no_schedule_line(found: Evaluation) -> str:
    """Return the lower bound on the cost of all schedules of this controller, in words."""
    base, bound = found.cost_all_time, found.lower_bound
    if bound is None:
        return ""
    sure = f"({percent(bound.confidence)} sure)"
    if not base or base <= 0:
        return f"of this controller at this rate costs less than {rounded(bound.cost, 6, -1)} {sure}"
    least = bound.cost / base - 1
    if least <= ZERO:
        return "of this controller is proved to cost more than every sample at this rate"
    decimals = max(MOST_DECIMALS, -magnitude(100 * least), decimals_of(found.cost.value / base - 1 - least, 1))
    return f"of this controller at this rate costs less than {percent(least, decimals, up=-1)} more {sure}"


def _periodic_line(found: Evaluation) -> str:
    """Return how periodic control at the same rate sends, or why there is none."""
    if found.sends_every_sample:
        return "the same as this policy, which sends every sample"
    if found.clock is None:
        return f"none at this rate: {found.no_clock}" if found.no_clock else ""
    ((_, rate),) = _periodic_rates(found).items()
    return clock_text(found.clock) + ("" if rate in found.rates.values() else "; more packets do not lower its cost")


def _periodic_rates(found: Evaluation) -> Mapping[str, Estimate]:
    """Return the rates of periodic control: the measured ones, or a lower one at which it costs no more."""
    (rate, *others), clock = found.rates.values(), found.clock
    if clock is None or others or clock.rate >= rate.value * (1 - SAME):
        return found.rates
    return dict.fromkeys(found.rates, Estimate(clock.rate, 0.0, "exact"))


def _promised_line(found: Evaluation) -> str:
    """Return the cost that the linearisation predicts, compared with the plant's cost; it is not a guarantee."""
    promised, cost = found.linearisation, found.cost.value
    if promised is None:
        return ""
    text = f"every sample costs {promised.cost_all_time:.6g}"
    if promised.cost_all_time:
        text += f" (measured: {found.cost.scaled(1 / promised.cost_all_time)} times that)"
    if promised.cost_bound is not None:
        over, margin = cost - promised.cost_bound, 4 * found.cost.standard_error
        seen = "met here" if over + margin <= 0 else "exceeded here" if over > margin else "undecided within the errors"
        text += f", its bound {promised.cost_bound:.6g} ({seen})"
    return f"{text}; none of this is guaranteed for the nonlinear plant"


def _certified_line(found: Evaluation) -> str:
    """Return the certified bounds on the rate."""
    if found.rate_bounds is None:
        return ""
    low, high = found.rate_bounds
    return f"{rounded(low, 4, -1)} to {rounded(high, 4, 1)} per {found.rate_unit}"


def _query_lines(found: Evaluation) -> Lines:
    """Return when sensors are queried."""
    if found.schedule is None:
        return []
    parts, several = found.schedule.by_link, len(found.schedule.links) > 1
    return [(f"queries, {link}" if several else "sensor queries", queries_text(one)) for link, one in parts.items()]


def _traffic_line(found: Evaluation) -> str:
    """Return the traffic of several links whose packets have different prices."""
    if len(found.rates) < 2 or len({found.prices.get(link, 1.0) for link in found.rates}) < 2:
        return ""
    return f"{found.traffic} per {found.rate_unit}, the rates times the prices of a packet"


def _power_line(found: Evaluation) -> str:
    """Return the power of the packets of the only link, and the life of its battery."""
    if len(found.rates) > 1:
        return ""
    days = [f"; the battery lasts {life} days" for life in found.battery_days.values()]
    return "".join([*(f"{power.scaled(1e3)} mW for packets" for power in found.power.values()), *days])


def _silence_line(found: Evaluation) -> str:
    """Return the cost that the silence of each node adds to its own response."""
    added = ", ".join(f"{one.value:.4g} ({links})" for links, one in found.silence.items())
    return f"adds {added} to the cost of its own response" if added else ""


def _method_line(found: Evaluation) -> str:
    """Return the method, and why it was chosen."""
    how = found.method if found.cost.method == "simulation" else found.cost.method
    return f"{how if found.estimator in ('', how) else f'{how}, {found.estimator}'}: {found.reason}"


def _time_line(found: Evaluation) -> str:
    """Return the wall time and the number of simulated steps."""
    return f"{found.seconds:.3g} s" + (f", {number_of(found.steps, 'simulated step')}" if found.steps else "")


def _sentence(name: str) -> Callable[[Evaluation], str]:
    """Return the function that gives the sentence of a part of an evaluation."""

    def text(found: Evaluation) -> str:
        part = getattr(found, name)
        return "" if part is None else part.sentence(f"per {found.rate_unit}")

    return text


def _violated(found: Evaluation) -> Lines:
    return [] if found.violations is None else found.violations.lines()


@dataclass(frozen=True, repr=False)
class _Row(Displayed):
    """A row of the table of an evaluation: a cost or, in a direction in which it holds, a bound, and rates."""

    name: str
    cost: Estimate | None  # a proved bound is rounded
    rates: Mapping[str, Estimate | None] = field(hash=False)
    up: int = 0
    exact: Estimate | None = None  # the bound, which the text rounds to the digits of its standard error

    def rate(self, link: str) -> str:
        """Write the send rate of this table row as text. Only the policy's own rate is a measured one."""
        rate = self.rates.get(link)
        return "" if rate is None else str(rate) if self.name == THIS else f"{rate.value:.4g}"


def _known(cost: float | None, error: float = 0.0) -> Estimate | None:
    return None if cost is None else Estimate(cost, error, "simulation" if error else "exact")


def _brief(found: Estimate | None, factor: float = 1.0) -> str:
    return "" if found is None else found.scaled(factor).rounded()


@dataclass(frozen=True, repr=False)
class _Link(Displayed):
    """A row of the table of links; numbers that are not known, or that need no column, are None."""

    name: str
    rate: Estimate
    share: Estimate | None  # of the packets of sending every sample
    price: float | None = None
    power: Estimate | None = None  # in watts
    days: Estimate | None = None
    guaranteed: str = ""  # share of the guarantee


@dataclass(frozen=True, repr=False)
class Evaluation(Tabular):
    """Cost, send rates and cost bounds of a policy, as the function :func:`evaluate` computes them.

    Args:
        policy: kind of the policy.
        unit: unit that the cost refers to: ``"step"``, ``"second"``, or ``"second at the sampling instants"`` if the
            integral has no average, or ``"mission"`` for a finite horizon or a discount.
        base_rate: rate of sending every sample, or None if sends may occur at any time.
        cost: cost per step or per second, or the total of a finite-horizon run.
        cost_all_time: exact cost of sending every sample, or None if the simulated plant is not the one of the design.
        baseline: cost of sending every sample in a loop that is not the one of the design, exact or simulated on the
            same random numbers; None if ``cost_all_time`` states it, or if there is no such average.
        paired: cost/baseline − 1, simulated on the same random numbers, or None.
        better: costs of other controllers that send every sample, by name, if the policy costs less than its baseline.
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
        lower_bound: lower bound on the cost of all schedules of this controller at the measured rate, if requested.
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
        set_point_steps: send rates with constant set-points and after a change; None if no changes are stated.
        without_limits: how often an input is at its limit, and the loop without limits; None if no input has a limit.
        as_written: the loop without a slow disturbance that a default has added to the plant; None if none was added.
        violations: probabilities that the limits of the problem are violated, or None.
        proved: whether the bounds are proved for the gains as they are stored, and rounded upwards; otherwise they are
            those of the theorem for exact gains, computed in doubles.
        cost_all_time_error: proved bound on the error of ``cost_all_time``; None if its error is only estimated.
        certificate: upper bound on the cost that follows from what the nodes measure themselves, for any noise; None if
            they do not measure it, or if the loop is not that of the design.
        silence: what the silence of each node adds to the cost of its own response, by the links that it decides.
        guarantee_shares: share of each node in the guarantee, by the links that the node decides: the square root of
            the cost that its silence may add, or has added if the guarantee is relative, divided by the sum of these
            roots; empty for a single decision.
        withdrawn: differences between the loop and its design, because of which no guarantee holds.
        late: how late packets are, how many are overtaken or lost, and how old the data are that receivers use, by link
            with random delays; averages over simulated paths.
        by_default: whether the model contains a slow disturbance that Taciturn adds by default.
        doubts: reasons why simulated numbers may not be averages, which are also among the notes.
    """

    FIELDS: ClassVar[tuple[Field[Evaluation], ...]] = (
        VERDICT,
        Field("policy", say="policy"),
        *plain_fields("unit", "rate_unit", "base_rate"),
        Field("cost", json=whole),
        *plain_fields("cost_all_time", "cost_all_time_error"),
        Field("cost_every_sample", json=whole),
        Field("excess", key="excess_percent", json=_percent_document),
        Field("better", key="better_every_sample", json=_each, optional=True, say="better baseline", text=_better_line),
        *plain_fields("cost_bound"),
        Field("proved", say="proof", text=_proof_line),
        Field("cost_bound_at_rate"),
        Field("bound_error", key="cost_bound_at_rate_standard_error"),
        Field("guarantee_shares", optional=True),
        Field("certificate", json=whole, optional=True, column="certificate", say=None),
        Field("silence", optional=True, say="silence", text=_silence_line),
        Field("rates"),
        Field("share", key="share_of_packets"),
        Field("traffic", say="traffic", text=_traffic_line, after="schedule"),
        Field("seed", say="seed", text=lambda found: str(found.seed) if found.drawn else "", part="method"),
        Field("seconds", json=seconds, say="time", text=_time_line, part="method"),
        *plain_fields("steps", "reached"),
        Field("method", say="method", text=_method_line, part="method", after=""),
        Field("reason", key="method_reason"),
        Field("cost_lower_bound", "lower_bound.cost", optional=True),
        Field(
            "cost_lower_bound_confidence",
            "lower_bound.confidence",
            optional=True,
            say="no schedule",
            text=_no_schedule_line,
        ),
        Field("rate_bounds", optional=True, say="certified rate", text=_certified_line),
        Field("consistency", optional=True, say="consistent"),
        Field("cost_periodic_same_rate"),
        Field("clock", say="periodic", text=_periodic_line, after="policy"),
        Field("no_clock", key="clock_reason", optional=True),
        Field("mean_interval", json=whole, optional=True, say="mean interval", text="{} s", after="rate_bounds"),
        Field("linearisation", json=asdict, optional=True, say="linearisation", text=_promised_line, after="proved"),
        Field("schedule", optional=True, say="queries", text=_query_lines),
        Field("cost_lqg", optional=True),
        Field("power", optional=True, say="power", text=_power_line),
        Field("battery_days", optional=True),
        Field("violations", key="violation", optional=True, say="violation", text=_violated),
        Field("after_step", optional=True, say="after a step", text=_sentence("after_step")),
        Field("set_point_steps", key=SPLICED, optional=True, say="set-points", text=_sentence("set_point_steps")),
        Field("late", key="late_packets", optional=True, say="late packets, {}", part="method"),
        Field("without_limits", key=SPLICED, optional=True, say="limits", text=_sentence("without_limits")),
        Field("as_written", optional=True, say="as written", text=_written_line, after="policy"),
        Field("notes", optional=True, say="note", text=lambda found: list(found.remarks)),
    )
    heading: ClassVar[tuple[str, ...]] = ("policy", "unit", "rate_unit", "method", "seed", "notes")
    shown: ClassVar[tuple[str, ...]] = (
        "policy", "cost", "rates", "unit", "cost_all_time", "cost_periodic_same_rate", "cost_bound", "method",
    )  # fmt: skip

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
    set_point_steps: SetPointSteps | None = None
    power: Mapping[str, Estimate] = field(hash=False, default_factory=lambda: {})
    life: Mapping[str, Estimate] = field(hash=False, default_factory=lambda: {})
    prices: Mapping[str, float] = field(hash=False, default_factory=lambda: {})
    cost_lqg: float | None = None
    without_limits: WithoutLimits | None = None
    violations: Violations | None = None
    as_written: AsWritten | None = None
    proved: bool = False
    cost_all_time_error: float | None = None
    certificate: Estimate | None = None
    silence: Mapping[str, Estimate] = field(hash=False, default_factory=lambda: {})
    guarantee_shares: Mapping[str, float] = field(hash=False, default_factory=lambda: {})
    withdrawn: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    by_default: bool = False
    baseline: Estimate | None = None
    paired: Estimate | None = None
    late: Mapping[str, LatePackets] = field(hash=False, default_factory=lambda: {})
    better: Mapping[str, Estimate] = field(hash=False, default_factory=lambda: {})

    @property
    def verdict(self) -> tuple[str, ...]:
        """The share of packets that is sent, the cost and its proven bound, in one or a few sentences."""
        return tuple(_verdict(self))

    @property
    def remarks(self) -> tuple[str, ...]:
        """The notes that the verdict does not contain."""
        told = {*self.doubts, *(f"{reason}{WITHDRAWN}" for reason in self.withdrawn)}
        return tuple(note for note in self.notes if note not in told)

    @property
    def rate_unit(self) -> TimeUnit:
        """Unit of time of the send rates: second or step."""
        return rate_unit(self.unit)

    @property
    def per(self) -> str:
        """Unit of the cost as text, such as "per second"."""
        return per_unit(self.unit)

    @property
    def sends(self) -> str:
        """Heading of a table column that contains send rates."""
        return f"sends per {self.rate_unit}"

    @property
    def cost_every_sample(self) -> Estimate | None:
        """Cost of the same loop that sends every sample, with its limits, losses and rounding: exact where a theorem
        gives it, else simulated on the same random numbers; None if there is no such average.
        """
        return self.baseline if self.baseline or self.cost_all_time is None else _known(self.cost_all_time)

    @property
    def excess(self) -> Estimate | None:
        """cost/cost_every_sample − 1, with the standard error of a pair if both are simulated; None if every sample
        costs nothing, or an unknown amount.
        """
        every = self.cost_every_sample
        if self.baseline is not None or every is None:
            return self.paired
        return excess_over(self.cost, every)

    @property
    def base(self) -> float | None:
        """Cost of sending every sample, to which all percentages refer: exact or measured; None if it is unknown."""
        return None if self.cost_every_sample is None else self.cost_every_sample.value

    @property
    def measured(self) -> bool:
        """True if the cost of sending every sample is simulated, because no theorem gives it."""
        return self.cost_every_sample is not None and self.cost_every_sample.method == "simulation"

    @property
    def highest_all_time(self) -> float:
        """Upper bound on the cost of sending every sample, including its error. Other bounds are relative to this
        number.
        """
        assert self.cost_all_time is not None, "a bound is that of a base"
        return self.cost_all_time + (self.cost_all_time_error or 0.0)

    @property
    def traffic(self) -> Estimate | None:
        """Sum of the send rates, each times the price of its packets, with an upper bound on the standard error."""
        paid = {link: rate.scaled(self.prices.get(link, 1.0)) for link, rate in self.rates.items()}
        return together(paid) if paid else None

    @property
    def share(self) -> Estimate | None:
        """Share of all links' packets that is sent; None if packets may be sent at any time."""
        return share_of(self.rates, self.base_rate)

    @property
    def sends_every_sample(self) -> bool:
        """True if the policy sends every sample, and its cost is known in closed form or is that of its baseline."""
        same = self.measured and self.paired is not None and self.paired.value == self.paired.standard_error == 0
        known = self.cost.method == "exact" or same
        return known and all(rate.value == self.base_rate for rate in self.rates.values())

    @property
    def battery_days(self) -> dict[str, Estimate]:
        """Days until the battery of the sender is empty, for each link with a battery."""
        return {link: life.scaled(1 / DAY) for link, life in self.life.items()}

    @property
    def drawn(self) -> bool:
        """True if a number in the result depends on random numbers, and so on the seed."""
        return self.method in ("simulation", CONDITIONAL) or (self.lower_bound or self.violations) is not None

    @property
    def cost_periodic_same_rate(self) -> float | None:
        """Exact cost of fair periodic control with the policy's measured send rate; None if none was found."""
        return None if self.clock is None else self.clock.cost

    @property
    def periodic(self) -> Estimate | None:
        """Cost of fair periodic control with the policy's measured send rate. Its error follows from that of
        the rate.
        """
        return None if self.clock is None else _known(self.clock.cost, self.clock.standard_error)

    @property
    def guarantee_at_rate(self) -> Estimate | None:
        """Upper bound on the cost for the measured send rate. Its error follows from that of the rate."""
        return _known(self.cost_bound_at_rate, self.bound_error)

    def short(self) -> str:
        """Write the cost in a few characters."""
        return f"cost {self.cost}"

    def plot(self, ax: Any = None, figsize: Size | None = None, style: StyleName = "light") -> Figure:
        """Draw a figure of costs and bounds with their errors, send rates, and probabilities that limits are violated.

        Args:
            ax: existing axes to draw in instead of a new figure, one for each panel.
            figsize: width and height of a new figure, in inches.
            style: ``"light"``, ``"dark"``, ``"paper"`` or ``"paper-wide"``.
        """
        rows = [(row.name, row.cost, row.up) for row in self.table_rows() if row.cost is not None]
        panels = [cost_panel(rows, [self.cost.value], self.base, self.per, _title(self))]
        panels += [rate_panel(self.rates, self.base_rate, self.rate_unit)] if self.rates else []
        panels += [] if self.violations is None else self.violations.panels()
        return draw(panels, ax, figsize, style)

    def table_rows(self) -> Sequence[_Row]:
        """Return the rows of the table: the policy, periodic control at its rate, sending every sample, and the bounds.

        A policy that sends every sample is not compared with itself.
        """
        always, same = self.sends_every_sample, self.rates
        pace = dict.fromkeys(same, _known(self.base_rate))
        lower = None if self.lower_bound is None else self.lower_bound.cost
        least = None if lower is None else outward(lower, 6, -1)
        found = (
            _Row(THIS, self.cost, same),
            _Row("periodic, same rate", None if always else self.periodic, _periodic_rates(self)),
            _Row(EVERY_SAMPLE, None if always else self.cost_every_sample, pace),
            *(_Row(f"{EVERY_SAMPLE}, {name}", cost, pace) for name, cost in self.better.items()),
            _Row("guarantee", _known(proved(self.cost_bound)), {}, 1, _known(self.cost_bound)),
            _Row("guarantee, this rate", self.guarantee_at_rate, same, 1),
            _Row("certificate of the nodes", self.certificate, same, 1),
            _Row("lower bound, any schedule", _known(least), same, -1, _known(lower)),
        )
        return [row for row in found if row.cost is not None]

    def table_texts(self) -> Sequence[str]:
        """Return the table of costs. If the policy decides on several links, a table of their rates follows."""
        return (self.table(), rows_text(self._link_fields(), self._links()) if len(self.rates) > 1 else "")

    def _links(self) -> list[_Link]:
        several = len(set(self.prices.values())) > 1
        parts = {link: name.split(" and ") for name in self.guarantee_shares for link in name.split(" and ")}

        def row(link: str, rate: Estimate) -> _Link:
            share, group = share_of({link: rate}, self.base_rate), parts.get(link, [])
            price = self.prices.get(link, 1.0) if several else None
            part = percent(self.guarantee_shares[" and ".join(group)], 1) if group[:1] == [link] else ""
            guaranteed = f"with {group[0]}" if group and not part else part
            return _Link(link, rate, share, price, self.power.get(link), self.battery_days.get(link), guaranteed)

        rows = [row(link, rate) for link, rate in self.rates.items()]
        return [*rows, _Link(TOGETHER, together(self.rates), self.share)]

    def _link_fields(self) -> tuple[Field[_Link], ...]:
        return (
            Field("name", say=""),
            Field("rate", say=self.sends),
            Field("share", say="of the packets", text=lambda row: "" if row.share is None else share_text(row.share)),
            Field("price", say="price", text="{:g}"),
            Field("power", say="power, mW", text=lambda row: _brief(row.power, 1e3)),
            Field("days", say="battery, days", text=lambda row: _brief(row.days)),
            Field("guaranteed", say="of the guarantee"),
        )

    def row_fields(self) -> tuple[Field[_Row], ...]:
        """Return the columns of the table: cost, excess over the cost of sending every sample, and send rates."""
        base = None if self.sends_every_sample else self.base
        seen = () if self.violations is None else self.violations.records().items()

        def extra(row: _Row) -> Estimate | None:
            if self.excess is not None and row.name == THIS:
                return self.excess.scaled(100.0)
            return row.cost.scaled(100 / base, -100) if base and row.cost is not None else None

        def exact(row: _Row) -> Estimate:
            found = row.exact or row.cost
            assert found is not None, "a row without a cost is left out"
            return found

        def above(row: _Row) -> str:
            if self.excess is not None and row.name == THIS:
                return percent_text(self.excess)
            of = self.highest_all_time if row.up == 1 else base or 0.0
            return "" if row.name == EVERY_SAMPLE else percent_above(exact(row), of, row.up)

        def cost(row: _Row) -> str:
            return bound_text(exact(row), row.up) if row.up else str(row.cost)

        def rate(link: str) -> Field[_Row]:
            heading, column = None if len(self.rates) > 1 else self.sends, f"rate_{link}"
            return Field(
                link, lambda row: row.rates.get(link), column=column, say=heading, text=lambda row: row.rate(link)
            )

        def violation(name: str, share: Estimate) -> Field[_Row]:
            return Field(name, lambda row: share if row.name == THIS else None, column=name)

        return (
            Field("name", column="name", say=""),
            Field("cost", column="cost", say=f"cost {self.per}", text=cost),
            *([Field("extra", extra, column="extra_percent", say="extra cost", text=above)] if base else []),
            *map(rate, self.rates),
            *(violation(name, share) for name, share in seen),
            *columns_of(lambda row: self if row.name == THIS else None, said=False),
        )


def columns_of(evaluation: Callable[[R], Evaluation | None], said: bool = True) -> list[Field[R]]:
    """Return the columns of a table in which each row is an evaluation."""

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
