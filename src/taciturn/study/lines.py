"""Parts of results as text: bounds that still hold after rounding, percentages, schedules."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from taciturn._display import Displayed
from taciturn._text import LARGE, magnitude, number_text, percent
from taciturn.model.diagram import pattern_text
from taciturn.model.estimate import Estimate
from taciturn.model.schedule import Schedule
from taciturn.study.clock import ClockMix

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
    """Return in words which numbers of a guarantee are computed with proved errors.

    Args:
        proved: whether the whole guarantee is.
        every_sample: whether the cost of sending every sample is.
    """
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
