"""Reader of the output of ping on Linux, macOS and Windows, and of that of BusyBox.

Every reply has a round-trip time, "time=12.3 ms" or "time<1ms". On Linux and macOS it also has a sequence number, such
as icmp_seq=7, which counts modulo 65,536. A packet is lost if no reply has its number, whatever else a line says about
it ("Request timeout", "no answer yet", "Destination Host Unreachable"): a late reply may follow such a line. Dropped
packets at the end are those that the last lines count as transmitted.

The time of sending is that of the reply, with ``ping -D`` or ``--apple-time``, minus the round-trip time. Without it,
the packets were sent at equal intervals: those of ``--interval``, or the mean interval that Linux states on its last
lines, or 1 s.

Windows numbers no packets. There, each line between the heading and an empty line is a packet, and a line without a
time is a lost one, in any language. "time<1ms" counts as 1 ms.

All that is read is ASCII, so the language of the system does not matter.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Displayed, number_of, quoted
from taciturn_delays.instants import instant
from taciturn_delays.reading import Reading, ordered, with_missing

_SEQUENCE = re.compile(r"\b(?:icmp_|icmp6_)?(?:seq|req)[= ](\d{1,9})\b")
_TIME = re.compile(r"[=<]\s?(-?\d{1,12}(?:[.,]\d+)?)\s?ms\b")
_STAMP = re.compile(r"^\[?(\d{9,10}\.\d+)\]? |^(\d\d):(\d\d):(\d\d\.\d+) ")
_HEAD = re.compile(r"^PING6?[ (]")
_FROM_ZERO = re.compile(r"^PING6|: \d+ data bytes")  # macOS and BusyBox
_OF_WINDOWS = re.compile(r"^(?=\S).*\bping(?:ing)?\b.*:\s*$", re.IGNORECASE)  # in several languages
_TRANSMITTED = re.compile(r"^(\d{1,9}) \D+?, (\d+) .*%")
_TOTAL = re.compile(r", \w+ (\d{1,15})\s?ms\s*$")
_LOST = re.compile(r"^(?:Request timed out|.*unreachable|.*failed|.*failure|.*expired in transit)", re.IGNORECASE)
_CYCLE = 1 << 16  # sequence numbers
_SECOND = 10**9  # nanoseconds
_DAY = 86400 * _SECOND
_USUAL = 1.0  # seconds between packets


@dataclass(repr=False)
class _Lines(Displayed):
    """Replies and totals on the lines of an output with sequence numbers."""

    first: int | None = None  # number of the first packet, if the heading is there
    stamps: dict[int, int] = field(default_factory=dict[int, int])  # time of sending in nanoseconds, by number
    trips: dict[int, float] = field(default_factory=dict[int, float])  # round-trip time, by number
    last: int = -1  # largest number on any line
    duplicates: int = 0
    transmitted: int | None = None
    total: float | None = None  # seconds from the first to the last packet


def is_ping(text: str) -> bool:
    """Check whether a text is the output of ping."""
    replies = re.search(r"(?m)^.*\b(?:icmp_|icmp6_)?(?:seq|req)[= ]\d+.*$|^\S.*[=<]\d+\s?ms.*TTL=\d+\s*$", text)
    return replies is not None or any(
        _HEAD.match(line) or _OF_WINDOWS.match(line) for line in text.split("\n", 50)[:50]
    )


def read_ping(path: Path, text: str, interval: float | None) -> Reading:
    """Read the output of ping."""
    lines = [line.rstrip() for line in text.split("\n")]
    runs = sum(1 for line in lines if _HEAD.match(line))
    if runs > 1:
        raise ProblemError(
            f"the file {str(path)!r} contains the output of {runs} runs of ping; expected one run: split the file"
        )
    if any(_SEQUENCE.search(line) for line in lines):
        return _numbered(path, lines, interval)
    return _of_windows(path, lines, interval)


def _milliseconds(path: Path, number: int, text: str) -> float:
    """Return a round-trip time in seconds."""
    value = float(text.replace(",", ".") + "e-3")
    if value < 0:
        raise ProblemError(
            f"line {number} of {str(path)!r} has a round trip of {quoted(text)} ms; expected at least 0: the time of "
            "the computer was set back, so measure again"
        )
    return value


def _numbered(path: Path, lines: list[str], interval: float | None) -> Reading:
    """Read an output with sequence numbers."""
    found = _gather(path, lines)
    if not found.trips:
        raise ProblemError(
            f"the output of ping in {str(path)!r} has no reply; expected at least one delivered packet: check that the "
            "host answers"
        )
    start = min([*found.trips] if found.first is None else [*found.trips, found.first])
    end, notes = found.last, list[str]()
    if found.transmitted is None:
        notes.append("the last lines with the number of transmitted packets are missing: losses at the end are unknown")
    elif found.first is not None:
        end = max(end, start + found.transmitted - 1)
        if end > max(found.trips):
            count = number_of(end - max(found.trips), "packet")
            notes.append(f"{count} at the end without a reply, which may have been on the way, counted as lost")
    numbers = np.array(sorted({*found.trips, start, end}), dtype=np.int64)
    if found.stamps:
        base = min(found.stamps.values())
        known = [found.stamps.get(number) for number in numbers.tolist()]
        sent = np.array([np.nan if one is None else (one - base) / _SECOND for one in known])
        notes += ["the interval is not used: the file has times"] if interval is not None else []
    else:
        sent = numbers.astype(np.float64) * _interval(found, interval, notes)
    trips = np.array([found.trips.get(number, np.inf) for number in numbers.tolist()])
    times, elapsed = with_missing(repr(str(path)), numbers, sent, trips)
    return ordered("output of ping", times, elapsed, "round trip", found.duplicates, tuple(notes))


def _interval(found: _Lines, interval: float | None, notes: list[str]) -> float:
    """Return the interval between packets if the output has no times, and add a note that says where it is from."""
    if interval is not None:
        notes.append(f"the file has no times of sending: one packet every {interval:g} s, as stated")
        return interval
    if found.total and found.transmitted and found.transmitted > 1:
        step = found.total / (found.transmitted - 1)
        notes.append(f"the file has no times of sending: equal intervals of {step:.6g} s, from the total time of ping")
        return step
    notes.append(
        f"the file has no times of sending: one packet every {_USUAL:g} s is assumed; use --interval or ping -D"
    )
    return _USUAL


def _gather(path: Path, lines: list[str]) -> _Lines:
    """Return what the lines of an output with sequence numbers contain."""
    found, before = _Lines(), -_DAY
    for i, line in enumerate(lines, 1):
        if _HEAD.match(line):
            found.first = 0 if _FROM_ZERO.search(line) else 1
        elif sequence := _SEQUENCE.search(line):
            number = int(sequence[1])
            number += _CYCLE * round((max(found.last, 0) - number) / _CYCLE) if found.last >= 0 else 0
            found.last = max(found.last, number)
            trip = _TIME.search(line, sequence.end())
            if trip is None:
                continue
            if number in found.trips:
                found.duplicates += 1
                continue
            found.trips[number] = _milliseconds(path, i, trip[1])
            if stamp := _STAMP.match(line):
                hours = 0 if stamp[1] else 3600 * int(stamp[2]) + 60 * int(stamp[3])
                at = hours * _SECOND + instant("time", stamp[1] or stamp[4], "s")
                while not stamp[1] and at < before - _DAY // 2:
                    at += _DAY
                before = at
                found.stamps[number] = at - round(found.trips[number] * _SECOND)
        elif total := _TRANSMITTED.match(line):
            found.transmitted = int(total[1])
            whole = _TOTAL.search(line)
            found.total = None if whole is None else int(whole[1]) / 1000
    return found


def _of_windows(path: Path, lines: list[str], interval: float | None) -> Reading:
    """Read an output of Windows, which has a line for each packet and no numbers."""
    trips, inside, shortest = list[float](), False, False
    for i, line in enumerate(lines, 1):
        time = None if line[:1].isspace() else _TIME.search(line)
        if not trips and not inside and _OF_WINDOWS.match(line) and time is None:
            inside = True
        elif time is not None:
            inside = True
            shortest = shortest or "<" in time[0]
            trips.append(_milliseconds(path, i, time[1]))
        elif not line:
            inside = inside and not trips
        elif inside or _LOST.match(line):
            trips.append(np.inf)
    if not np.isfinite(trips).any():
        raise ProblemError(
            f"the output of ping in {str(path)!r} has no reply; expected at least one delivered packet, as a line with "
            "time=12ms: check that the host answers"
        )
    step = _USUAL if interval is None else interval
    notes = [
        f"the file has no times of sending: one packet every {step:g} s, as "
        + ("Windows sends them while replies arrive" if interval is None else "stated"),
        "ping of Windows prints whole milliseconds" + (", where time<1ms counts as 1 ms" if shortest else ""),
    ]
    sent = np.arange(float(len(trips))) * step
    return ordered("output of ping (Windows)", sent, np.array(trips), "round trip", 0, tuple(notes))
