"""The result of an evaluation as text: one table, then details and warnings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, cast

from taciturn._text import LARGE, Lines, magnitude, negligible, number_text, pairs_text, per_unit, percent, table_text
from taciturn.model.estimate import Estimate

if TYPE_CHECKING:
    from taciturn.model.schedule import Schedule
    from taciturn.study.clock import ClockMix
    from taciturn.study.evaluate import Evaluation
    from taciturn.study.tuning.tuned import Tuned

MOST_DECIMALS = 2  # largest number of decimals of a percentage in a table
ZERO = 1e-11  # relative difference of two costs that is a rounding error
THERE = "the bound at this rate"
DIRECTION = {"guarantee": 1, "guarantee, this rate": 1, "no schedule below": -1}
"""Direction in which a bound is rounded, so that it still holds."""


def evaluation_text(found: Evaluation) -> str:
    """Return the text that ``taciturn evaluate`` prints."""
    how = found.method if found.cost.method == "simulation" else found.cost.method
    method = how if found.estimator in ("", how) else f"{how}, {found.estimator}"
    first: Lines = [("policy", found.policy), ("method", f"{method}: {found.reason}")]
    return "\n\n".join(filter(None, [pairs_text(first), _table(found), pairs_text(_details(found))]))


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
            rows.append({"name": name, "cost": known, **extra, **{f"rate_{link}": rates.get(link) for link in same}})

    add("this policy", found.cost, found.rates)
    add("periodic, same rate", None if always else periodic_cost(found), same)
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
        cells = [str(record["name"]), str(cost) if up is None else bound_text(cost, up)]
        if base:
            value = unrounded.get(str(record["name"]))
            above = percent_above(cost if value is None else replace(cost, value=value), base, up or 0)
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
        lines.append(("periodic", _clock(found.clock)))
    elif found.no_clock:
        lines.append(("periodic", f"none at this rate: {found.no_clock}"))
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
        lines.append(("sensor queries", _queries(found.schedule)))
    lines += [("verdict", text) for text in _verdict(found)]
    return [*lines, *(("note", note) for note in found.notes)]


def tuned_text(found: Tuned) -> str:
    """Return the text that ``taciturn tune`` prints: the parameter that meets the budget, and its evaluation."""
    parameter = found.parameter
    lines: Lines = [(parameter.name, str(parameter)), ("budget", budget_text(found))]
    if found.beyond is not None:
        other = found.beyond
        rates = ", ".join(f"rate, {link} {rate}" for link, rate in other.evaluation.rates.items())
        text = f"{other.parameter.beside(parameter)}: {rates}, cost {other.evaluation.cost}"
        jump = f"the {found.goal.name} jumps across the budget; on the other side:"
        lines.append(("beyond", f"{jump} {parameter.name} = {text}"))
    return f"{pairs_text(lines)}\n{evaluation_text(found.evaluation)}"


def budget_text(found: Tuned) -> str:
    """Return a text that states whether the budget is met, and with which confidence."""
    goal, sure = found.goal, found.confidence
    unit = found.evaluation.rate_unit if goal.name == "rate" else found.evaluation.unit
    if sure is None:
        kept = "met in this simulation, whose standard error cannot be trusted"
    else:
        kept = "met exactly" if sure == 1 else f"met with {percent(math.floor(1000 * sure) / 1000)} confidence"
    return f"{goal.name} at most {goal.budget:.6g} {per_unit(unit)}, {kept}"


def _verdict(found: Evaluation) -> list[str]:
    """Return a sentence with the rate and the cost of a policy and their distance from the bounds, or a reason."""
    base, lower = found.cost_all_time, found.lower_bound
    if _sends_every_sample(found):
        return []
    if base is None:
        return ["none: for this loop, the cost of sending every sample is not known"]
    if base <= 0:
        return ["none: sending every sample costs nothing, so no cost is a percentage of it"]
    if not found.settled:
        return ["none: the loop has not settled, so the simulated cost is not an average"]
    if not found.trusted:
        return ["none: the standard error of the cost cannot be trusted"]
    above, error = found.cost.value / base - 1, found.cost.standard_error / base
    error = 0.0 if negligible(found.cost.standard_error, found.cost.value) else error
    least = None if lower is None else lower.cost / base - 1
    decimals = max(MOST_DECIMALS, -magnitude(100 * above))
    if least is not None:
        decimals = max(decimals, _decimals(above - least, 1))  # enough to distinguish the two
    side = "above" if above >= 0 else "below"
    text = f"costs {percent(abs(above), decimals, error=error)} {side} sending every sample"
    if abs(above) <= ZERO and error == 0:
        text = "costs as much as sending every sample"
    if found.base_rate is not None:
        text = f"sends {_shares(found.rates, found.base_rate)}, {text}"
    bound = found.cost_bound if found.cost_bound_at_rate is None else found.cost_bound_at_rate
    if bound is not None:
        by, moved = ("the guarantee", 0.0) if found.cost_bound_at_rate is None else (THERE, found.bound_error)
        text += f", at most {percent_above(_moved(bound, moved), base, 1, signed=False)} by {by}"
    if least is None:
        return [text]
    if least <= ZERO:
        return [f"{text}; no bound above the cost of sending every sample is proved for this controller at this rate"]
    least_text = percent(least, max(decimals, -magnitude(100 * least)), up=-1)
    return [f"{text}; no schedule of this controller at this rate costs less than {least_text} above"]


def _shares(rates: Mapping[str, Estimate], base_rate: float) -> str:
    """Return the rates of all links as percentages of the rate of sending every sample."""
    found: list[str] = []
    for link, rate in rates.items():
        share = rate.value / base_rate
        text = f"{percent(share, _decimals(share, 3), error=rate.standard_error / base_rate)} of the time"
        found.append(f"{text} on the {link} link" if len(rates) > 1 else text)
    return " and ".join(found)


def _sends_every_sample(found: Evaluation) -> bool:
    """Return whether the policy is the one that sends every sample, by a closed form."""
    return found.cost.method == "exact" and all(rate.value == found.base_rate for rate in found.rates.values())


def _clock(clock: ClockMix) -> str:
    """Return how periodic control actuates (hold or prediction), and when it sends."""
    named = [f"{list(point.cycle)} steps" if point.cycle else f"{1 / point.rate:.4g} s" for point in clock.points]
    return f"{clock.words}, every {' or '.join(named)}"


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


def _decimals(share: float, digits: int) -> int:
    """Return the number of decimals with which a percentage shows the given number of digits, at most four."""
    return min(max(digits - 1 - magnitude(100 * share), 0), 4)


def outward(value: float, digits: int, up: int) -> float:
    """Return a bound rounded up (1) or down (−1) to the given number of digits, so that it still holds."""
    nearest = float(f"{value:.{digits}g}")
    if up * (nearest - value) < 0:
        nearest += up * 10.0 ** (math.floor(math.log10(abs(value))) + 1 - digits)
    return nearest


def least_cost(found: Evaluation) -> float | None:
    """Return the lower bound on the cost of any schedule, rounded down to six digits, or None without a bound."""
    return None if found.lower_bound is None else outward(found.lower_bound.cost, 6, -1)


def proved(bound: float | None) -> float | None:
    """Return an upper bound, rounded up to six digits, or None without a bound."""
    return None if bound is None else outward(bound, 6, 1)


def bound_at_rate(found: Evaluation) -> Estimate | None:
    """Return the upper bound at the measured rate, rounded up to six digits, with the error due to that of the rate."""
    bound = proved(found.cost_bound_at_rate)
    return None if bound is None else _moved(bound, found.bound_error)


def periodic_cost(found: Evaluation) -> Estimate | None:
    """Return the cost of periodic control at the measured rate, with the error due to that of the rate."""
    return None if found.clock is None else _moved(found.clock.cost, found.clock.standard_error)


def _moved(cost: float, error: float) -> Estimate:
    return Estimate(cost, error, "simulation" if error else "exact")


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


def _queries(schedule: Schedule) -> str:
    """Return a text that states when the sensor is queried."""
    ticks = schedule.ticks
    if schedule.period == 1:
        return "at every step" if ticks else "never"
    listed = ", ".join(map(str, ticks[:12])) + (", …" if len(ticks) > 12 else "")
    if schedule.start is None:
        return f"{len(ticks)} of {len(schedule.queries)} steps" + (f": {listed}" if ticks else "")
    once = f"{schedule.queries[schedule.start :].sum()} of {schedule.period} steps, periodically"
    return once if schedule.start == 0 else f"{once} from step {schedule.start} on: {listed}"


def percent_above(cost: Estimate, base: float, up: int = 0, *, signed: bool = True) -> str:
    """Return the excess of a cost over the cost of sending every sample, in percent, with at most two decimals.

    The last digit is that of the first digit of the standard error.

    Args:
        cost: the cost, or a bound on it.
        base: the cost of sending every sample.
        up: direction of rounding: 1 for an upper bound, -1 for a lower bound, and 0 for a cost.
        signed: whether a positive number has a sign.
    """
    error, decimals = 100 * cost.standard_error / base, MOST_DECIMALS
    if error > 0:
        decimals = min(decimals, max(0, -magnitude(error)))
    return percent(cost.value / base - 1, decimals, up=up, signed=signed)
