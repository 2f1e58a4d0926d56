"""Times of day, as whole nanoseconds since 1970, from text in common notations.

A double has 53 bits, which at 1.7e9 s since 1970 resolve 0.24 μs. Times are therefore whole nanoseconds, and become
seconds in floating point after the first time has been subtracted.

A number without a stated unit is in seconds, milliseconds, microseconds or nanoseconds since 1970, which its size
tells: 1e11 s is the year 5138, and 1e11 ms the year 1973. Smaller numbers, such as the milliseconds that have passed
since a device started, need a stated unit, or are seconds.

A date follows ISO 8601, such as 2026-03-02T12:00:00.25+0100. Without an offset it counts as UTC, which changes all
times by the same amount. mosquitto writes Z+0100 in some versions, where Z has no meaning.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from decimal import Decimal, InvalidOperation

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Array, quoted
from taciturn_delays.reading import Whole
from taciturn_delays.tables import NUMBER

UNITS = {"s": 9, "ms": 6, "us": 3, "ns": 0}  # powers of ten of nanoseconds
_SIZES = ((1e11, "s"), (1e14, "ms"), (1e17, "us"), (1e19, "ns"))
_LONGEST = 9.2e18  # nanoseconds in 64 bits
_START = datetime(1970, 1, 1, tzinfo=UTC)


def instant(where: str, value: object, unit: str | None = None) -> int:
    """Return a time in nanoseconds."""
    text = str(value).strip().replace(",", ".") if not isinstance(value, bool) else "a truth value"
    found = _number(text, unit) if NUMBER.fullmatch(text) else _date(text)
    if found is None or abs(found) > _LONGEST:
        raise ProblemError(
            f"{where} is {quoted(value)}; expected a time, as seconds since 1970 such as 1700000000.25, or as a date "
            "such as 2026-03-02T12:00:00.25Z: correct the line, or remove it"
        )
    return found


def _number(text: str, unit: str | None) -> int | None:
    try:
        value = Decimal(text)
        size = abs(float(text))
        chosen = unit or next((name for most, name in _SIZES if size < most), None)
        return None if chosen is None or size > _LONGEST else round(value.scaleb(UNITS[chosen]))
    except (InvalidOperation, OverflowError, ValueError):
        return None


def _date(text: str) -> int | None:
    try:
        found = datetime.fromisoformat(re.sub(r"Z(?=[+-]\d)", "", text))
    except ValueError:
        return None
    aware = found if found.tzinfo is not None else found.replace(tzinfo=UTC)
    return (aware - _START) // timedelta(microseconds=1) * 1000


def seconds(times: Sequence[int] | Whole, start: int) -> Array:
    """Return times in seconds after ``start``."""
    return (np.asarray(times, dtype=np.int64) - start).astype(np.float64) / 1e9
