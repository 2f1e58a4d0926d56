"""What is said of an answer, line by line: the command line prints it, and so does Python."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from taciturn.model.schedule import Schedule
    from taciturn.study.clock import ClockMix
    from taciturn.study.evaluate import Evaluation
    from taciturn.study.tuned import Tuned

Lines = list[tuple[str, str]]


def text_of(lines: Lines) -> str:
    """Return names and what stands behind them, one under the other."""
    width = max(14, *(len(name) for name, _ in lines))
    return "\n".join(f"{name:{width}s} {text}" for name, text in lines)


def evaluation_lines(found: Evaluation) -> Lines:
    """Return what is said of one answer."""
    how = found.method if found.cost.method == "simulation" else found.cost.method
    method = how if found.estimator in ("", how) else f"{how}, {found.estimator}"
    lines: Lines = [("policy", found.policy), ("cost", f"{found.cost} per {found.unit}   ({method})")]
    lines.append(("method", f"{found.method}: {found.reason}"))
    lines += [(f"rate, {link}", f"{rate} per {found.rate_unit}") for link, rate in found.rates.items()]
    if found.cost_all_time is not None:
        always = found.cost.method == "exact" and math.isclose(found.cost.value, found.cost_all_time, rel_tol=1e-12)
        more = f"   (this policy: {above_all_time(found)} %)" if found.cost_all_time and not always else ""
        lines.append(("all-time cost", f"{found.cost_all_time:.6g}{more}"))
    if found.cost_bound is not None:
        lines.append(("guaranteed", f"at most {found.cost_bound:.6g}"))
    if found.cost_bound_at_rate is not None:
        lines.append(("at this rate", f"at most {found.cost_bound_at_rate:.6g}"))
    if found.linearisation is not None:
        lines.append(("linearisation", _promised(found)))
    if found.lower_bound is not None:
        text = f"{rounded(found.lower_bound.cost, 6, -1)} at this rate ({100 * found.lower_bound.confidence:g} %)"
        lines.append(("no less than", text))
    if found.rate_bounds is not None:
        low, high = found.rate_bounds
        text = f"{rounded(low, 4, -1)} to {rounded(high, 4, 1)} per {found.rate_unit}"
        lines.append(("certified rate", text))
    if found.mean_interval is not None:
        lines.append(("mean interval", f"{found.mean_interval} s"))
    if found.clock is not None:
        lines.append(("fair clock", _clock(found.clock, found)))
    if found.consistency is not None:
        lines.append(("consistent", found.consistency))
    if found.schedule is not None:
        lines.append(("sensor queries", _queries(found.schedule)))
    lines += [("verdict", text) for text in _verdict(found)]
    return [*lines, *(("note", note) for note in found.notes)]


def tuned_lines(found: Tuned) -> Lines:
    """Return what is said of the parameter that meets a budget, and of the answer at it."""
    parameter = found.parameter
    lines: Lines = [(parameter.name, str(parameter)), ("budget", _budget(found)), *evaluation_lines(found.evaluation)]
    if found.beyond is not None:
        other = found.beyond
        rates = ", ".join(f"rate, {link} {rate}" for link, rate in other.evaluation.rates.items())
        text = f"{other.parameter.beside(parameter)}: {rates}, cost {other.evaluation.cost}"
        lines.append(("beyond", f"the budget lies in a jump, on whose other side is {parameter.name} = {text}"))
    return lines


def _budget(found: Tuned) -> str:
    """Say whether the budget is kept, and how surely."""
    goal, sure = found.goal, math.floor(1000 * found.confidence) / 10
    per = found.evaluation.rate_unit if goal.name == "rate" else found.evaluation.unit
    kept = "exactly" if found.confidence == 1 else f"with {sure:g} % confidence"
    return f"{goal.name} at most {goal.budget:.6g} per {per}, kept {kept}"


def _verdict(found: Evaluation) -> list[str]:
    """Say how often a policy sends, what that costs, and how far it is from what is proved on both sides."""
    base, bound, lower = found.cost_all_time, found.cost_bound_at_rate, found.lower_bound
    if lower is None or not base or found.base_rate is None:
        return []
    shares = [f"{100 * rate.value / found.base_rate:.3g} %" for rate in found.rates.values()]
    above, least = 100 * (found.cost.value / base - 1), 100 * (lower.cost / base - 1)
    decimals = max(_decimals(above - least, 1), _decimals(above, 2))  # that tell them from each other
    text = f"sends {shares[0]} of the time, costs {above:.{decimals}f} % above all-time control"
    if bound is not None:
        text += f", at most {rounded(100 * (bound / base - 1), 2, 1)} % by the bound at this rate"
    least = math.floor(least * 10**decimals) / 10**decimals
    return [f"{text}; no scheduling of this controller at this rate can cost less than {least:.{decimals}f} % above"]


def _clock(clock: ClockMix, found: Evaluation) -> str:
    """Say what time-triggered control costs at this rate, whether it holds or predicts, and when it sends."""
    base = found.cost_all_time
    more = f" ({100 * (clock.cost / base - 1):+.2f} %)" if base else ""
    named = [f"{list(point.cycle)} ticks" if point.cycle else f"{1 / point.rate:.4g} s" for point in clock.points]
    sends = f", every {' or '.join(named)}"
    return f"{clock.cost:.6g} at this rate{more}: {clock.words}{sends}"


def _promised(found: Evaluation) -> str:
    """Say what the theory of the linearisation says, and how the plant's cost compares; nothing of it is claimed."""
    promised, cost = found.linearisation, found.cost.value
    assert promised is not None
    text = f"all-time cost {promised.cost_all_time:.6g}"
    if promised.cost_all_time:
        text += f" (measured: {cost / promised.cost_all_time:.4g} times that)"
    if promised.cost_bound is not None:
        over, margin = cost - promised.cost_bound, 4 * found.cost.standard_error
        seen = "kept here" if over + margin <= 0 else "broken here" if over > margin else "kept or broken, by chance"
        text += f", its bound {promised.cost_bound:.6g} ({seen})"
    return f"{text}; none of this is claimed of the plant"


def _decimals(value: float, digits: int) -> int:
    """Return the decimals that show so many digits of a positive number, at most four."""
    return min(max(digits - 1 - math.floor(math.log10(value)), 0), 4) if value > 0 else 0


def rounded(value: float, digits: int, up: int) -> str:
    """Return a bound with so many digits, rounded so that it still holds: up (1) or down (−1)."""
    nearest = float(f"{value:.{digits}g}")
    if up * (nearest - value) < 0:
        nearest += up * 10.0 ** (math.floor(math.log10(abs(value))) + 1 - digits)
    return f"{nearest:.{digits}g}" if abs(nearest) < 1e4 else f"{nearest:,.0f}"


def _queries(schedule: Schedule) -> str:
    """Say when the sensor is queried."""
    ticks = schedule.ticks
    if schedule.period == 1:
        return "at every tick" if ticks else "never"
    listed = ", ".join(map(str, ticks[:12])) + (", …" if len(ticks) > 12 else "")
    if schedule.start is None:
        return f"{len(ticks)} of {len(schedule.queries)} ticks" + (f": {listed}" if ticks else "")
    once = f"{schedule.queries[schedule.start :].sum()} of {schedule.period} ticks, again and again"
    return once if schedule.start == 0 else f"{once} from tick {schedule.start} on: {listed}"


def above_all_time(found: Evaluation) -> str:
    """By how many percent the cost exceeds that of sending at every tick."""
    assert found.cost_all_time
    percent = 100 * (found.cost.value / found.cost_all_time - 1)
    return f"{percent:+.2f}" if abs(percent) < 1e6 else f"{percent:+.3g}"
