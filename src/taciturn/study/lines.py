"""The result of an evaluation as text: one table, then details and warnings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, cast

from taciturn._text import Lines, pairs_text, per_unit, table_text
from taciturn.model.estimate import Estimate

if TYPE_CHECKING:
    from taciturn.model.schedule import Schedule
    from taciturn.study.clock import ClockMix
    from taciturn.study.evaluate import Evaluation
    from taciturn.study.tuned import Tuned

MOST_DECIMALS = 2  # largest number of decimals of a percentage
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
            cost = outward(cost, 6, DIRECTION[name]) if name in DIRECTION and isinstance(cost, float) else cost
            known = cost if isinstance(cost, Estimate) else Estimate(cost, 0.0, "exact")
            extra = {"extra_percent": known.scaled(100 / base, -100)} if base else {}
            rows.append({"name": name, "cost": known, **extra, **{f"rate_{link}": rates.get(link) for link in same}})

    add("this policy", found.cost, found.rates)
    add("periodic, same rate", None if found.clock is None or always else found.clock.cost, same)
    add("every sample", base, pace)
    add("guarantee", found.cost_bound, {})
    add("guarantee, this rate", found.cost_bound_at_rate, same)
    add("no schedule below", None if found.lower_bound is None else found.lower_bound.cost, same)
    return rows


def _table(found: Evaluation) -> str:
    """Return the records as a text table; bounds are rounded so that they still hold."""
    total, many = found.unit == "mission", len(found.rates) > 1
    base = None if _sends_every_sample(found) else found.cost_all_time
    per = "sends per step" if total else f"sends per {found.rate_unit}"
    header = ["", f"cost {per_unit(found.unit)}"]
    header += (["extra cost"] if base else []) + [f"{link} {per}" if many else per for link in found.rates]
    rows: list[list[str]] = []
    for record in evaluation_records(found):
        cost, up = cast("Estimate", record["cost"]), DIRECTION.get(str(record["name"]))
        cells = [str(record["name"]), str(cost) if up is None else rounded(cost.value, 6, up)]
        if base:
            cells.append("" if record["name"] == "every sample" else percent_above(cost, base))
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
        lines.append(("no schedule", f"of this controller at this rate, {100 * found.lower_bound.confidence:g} % sure"))
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
        kept = "met exactly" if sure == 1 else f"met with {math.floor(1000 * sure) / 10:g} % confidence"
    return f"{goal.name} at most {goal.budget:.6g} {per_unit(unit)}, {kept}"


def _verdict(found: Evaluation) -> list[str]:
    """Return a sentence with the rate and the cost of a policy, and their distance from the proven bounds."""
    base, bound, lower = found.cost_all_time, found.cost_bound_at_rate, found.lower_bound
    if lower is None or not base or found.base_rate is None:
        return []
    shares = [f"{100 * rate.value / found.base_rate:.3g} %" for rate in found.rates.values()]
    above, least = 100 * (found.cost.value / base - 1), 100 * (lower.cost / base - 1)
    decimals = max(_decimals(above - least, 1), _decimals(above, 2))  # enough to distinguish the two
    text = f"sends {shares[0]} of the time, costs {above:.{decimals}f} % above sending every sample"
    if bound is not None:
        text += f", at most {rounded(100 * (bound / base - 1), 2, 1)} % by the bound at this rate"
    least = math.floor(least * 10**decimals) / 10**decimals
    return [f"{text}; no schedule of this controller at this rate costs less than {least:.{decimals}f} % above"]


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
        text += f" (measured: {cost / promised.cost_all_time:.4g} times that)"
    if promised.cost_bound is not None:
        over, margin = cost - promised.cost_bound, 4 * found.cost.standard_error
        seen = "met here" if over + margin <= 0 else "exceeded here" if over > margin else "undecided within the errors"
        text += f", its bound {promised.cost_bound:.6g} ({seen})"
    return f"{text}; none of this is guaranteed for the nonlinear plant"


def _decimals(value: float, digits: int) -> int:
    """Return the number of decimals that show the given number of digits of a positive number, at most four."""
    return min(max(digits - 1 - math.floor(math.log10(value)), 0), 4) if value > 0 else 0


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


def rounded(value: float, digits: int, up: int) -> str:
    """Return a bound as text, rounded up (1) or down (−1), so that it still holds."""
    nearest = outward(value, digits, up)
    return f"{nearest:,.0f}" if 1e4 <= abs(nearest) < 1e12 else f"{nearest:.{digits}g}"


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


def percent_above(cost: Estimate, base: float | None) -> str:
    """Return the excess of a cost over the cost of sending every sample, in percent, with its significant digits."""
    assert base
    above = cost.scaled(100 / base, -100)
    if abs(above.value) >= 1e6:
        return f"{above.value:+.3g} %"
    decimals = MOST_DECIMALS
    if above.standard_error > 0:
        decimals = min(decimals, max(0, 1 - math.floor(math.log10(above.standard_error))))
    return f"{above.value:+.{decimals}f} %"
