"""Words for numbers of studies: shares, rates, schedules, and costs compared with the cost of every sample sent.

An excess is J/J_every − 1, with the cost J_every of the loop that sends every sample.

A percentage has three digits, at most two decimals, and no digits that its standard error does not support.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite

from taciturn._text import magnitude, negligible, number_of, percent
from taciturn.model.estimate import Estimate
from taciturn.model.rule import pattern_text
from taciturn.model.schedule import Schedule
from taciturn.study.periodic import ClockMix

DIGITS, MOST_DECIMALS = 3, 2  # of a percentage in a table: its digits, and the largest number of decimals
ZERO = 1e-11  # relative difference of two costs that is a rounding error
COARSE = 0.1  # relative standard error from which on a percentage shows it
THAN = " than every sample"
WITHDRAWN = ": no guarantee holds"  # what a note says about a difference between loop and design


def decimals_of(share: float, digits: int) -> int:
    """Return with how many decimals, at most four, a percentage has the given number of digits."""
    return min(max(digits - 1 - magnitude(float(f"{100 * share:.{digits}g}")), 0), 4)


def percent_above(cost: Estimate, base: float, up: int = 0, *, signed: bool = True) -> str:
    """Write by how many percent a cost exceeds the cost of sending every sample, with three digits.

    The percentage has at most two decimals, and fewer if its standard error is large.
    """
    return percent_text(cost.scaled(1 / base, -1.0), up, signed=signed)


def percent_text(excess: Estimate, up: int = 0, *, signed: bool = True) -> str:
    """Write an excess J/J_every − 1 in percent, with the digits of ``percent_above``."""
    return percent(excess.value, _decimals(excess.value, excess.standard_error), up=up, signed=signed)


def _decimals(above: float, error: float) -> int:
    """Return the decimals of an excess in percent: those of three digits, at most two, or those of its error."""
    if not isfinite(above):
        return 0
    most = min(MOST_DECIMALS, decimals_of(above, DIGITS))
    return min(most, max(0, -magnitude(100 * error))) if error > 0 else most


def share_text(share: Estimate) -> str:
    """Write a share in percent with three digits, or with fewer if its standard error is large."""
    error = share.standard_error
    if error > COARSE * abs(share.value):
        return percent(share.value, error=error)
    decimals = decimals_of(share.value, DIGITS)
    return percent(share.value, min(decimals, max(0, -magnitude(100 * error))) if error > 0 else decimals)


def more_text(cost: Estimate, base: float, noun: str = "", than: str = "") -> str:
    """Write how much more or less than sending every sample a policy costs, with as many digits as in the table."""
    return excess_text(cost.scaled(1 / base, -1.0), noun, than)


def excess_text(excess: Estimate, noun: str = "", than: str = "", *, spread: bool = False) -> str:
    """Write an excess J/J_every − 1 as more or less cost, with its standard error if it is large or ``spread``."""
    above = excess.value
    exact = negligible(excess.standard_error, 1 + above)
    error = 0.0 if exact else excess.standard_error
    if error > COARSE * abs(above) or (spread and error):
        text = percent(abs(above), error=error)
    elif exact and abs(above) <= ZERO:
        text = percent(0.0)
    else:
        text = percent(abs(above), max(-magnitude(100 * above), _decimals(above, error)))
    shown, _, rest = text.partition(" ± ")
    if not shown.strip("0. %"):
        return f"as much{noun}{than.replace(' than ', ' as ')}{f' (± {rest})' if rest else ''}"
    return f"{text} {'more' if above >= 0 else 'less'}{noun}{than}"


def compared_text(cost: Estimate, base: float, than: str = THAN) -> str:
    """Compare the cost of a policy with the cost of sending every sample, in words."""
    return more_text(cost, base, " cost", than)


def share_of(rates: Mapping[str, Estimate], base_rate: float | None) -> Estimate | None:
    """Compute the share of all links' packets that is sent, with an upper bound on its standard error."""
    if base_rate is None or not rates:
        return None
    return together(rates).scaled(1 / (len(rates) * base_rate))


def together(rates: Mapping[str, Estimate]) -> Estimate:
    """Add the send rates of all links. The standard error of the sum is an upper bound."""
    listed = [*rates.values()]
    errors = sum(one.standard_error for one in listed), sum(one.error for one in listed)
    return Estimate(sum(one.value for one in listed), errors[0], listed[0].method, errors[1])


def sends_text(rates: Mapping[str, Estimate], unit: str) -> str:
    """Write the send rates as text. ``unit`` is their unit, such as "per step"."""
    several = len(rates) > 1
    return ", ".join(
        f"{number_of(rate, 'send')} {unit}{f' ({link})' if several else ''}" for link, rate in rates.items()
    )


def proof_text(proved: bool, every_sample: bool) -> str:
    """Write which numbers of a guarantee have a proven bound on their computing error."""
    if proved:
        return "the cost of every sample and the guarantee are proved for the gains as stored"
    if every_sample:
        return (
            "the cost of every sample is proved for the gains as stored; what silence adds is computed in doubles, for "
            "exact gains"
        )
    return "of the theorem; its numbers are computed in doubles, with estimated rounding errors"


def clock_text(clock: ClockMix) -> str:
    """Write when periodic control sends, and whether it holds or predicts between packets."""
    named = [f"{list(point.cycle)} steps" if point.cycle else f"{1 / point.rate:.4g} s" for point in clock.points]
    found = ", the best found" if clock.words == "hold" else ""  # with a model, neighbouring intervals are optimal
    return f"{clock.words}, every {' or '.join(named)}{found}"


def queries_text(schedule: Schedule) -> str:
    """Write at which steps the sensor is queried."""
    ticks = schedule.ticks
    if schedule.start is not None and schedule.period == 1:
        found = pattern_text(schedule.queries.tolist(), schedule.start)
        return f"at {found}" if found == "every step" else found
    listed = ", ".join(map(str, ticks[:12])) + (", …" if len(ticks) > 12 else "")
    if schedule.start is None:
        return f"{len(ticks)} of {number_of(len(schedule.queries), 'step')}" + (f": {listed}" if ticks else "")
    once = f"{schedule.queries[schedule.start :].sum()} of {number_of(schedule.period, 'step')}, periodically"
    return once if schedule.start == 0 else f"{once} from step {schedule.start} on: {listed}"


def shares_text(shares: Mapping[str, float]) -> str:
    """Write the share of each link in the trigger threshold as text."""
    return ", ".join(f"{link} {share:g}" for link, share in shares.items())
