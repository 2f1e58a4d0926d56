"""The result of an evaluation, and its text: one table, then details and warnings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, ClassVar, Literal, cast

from taciturn._text import Lines, magnitude, negligible, pairs_text, per_unit, percent, table_text
from taciturn.analyse.limits import LowerBound
from taciturn.model.estimate import Estimate
from taciturn.model.limits import Violations
from taciturn.model.schedule import Schedule
from taciturn.model.table import Columns, Tabular, columns_of
from taciturn.model.theory import Linearisation
from taciturn.study.clock import SAME, ClockMix
from taciturn.study.disturbed import AfterStep
from taciturn.study.limited import WithoutLimits
from taciturn.study.lines import (
    MOST_DECIMALS,
    AsWritten,
    bound_text,
    clock_text,
    decimals_of,
    outward,
    percent_above,
    proof_text,
    proved,
    queries_text,
    rounded,
)
from taciturn.study.measure import CONDITIONAL
from taciturn.study.units import TimeUnit, Unit, rate_unit

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
