"""Sent and received packets as a reader finds them in a file, and the reading of the file itself.

A reading has one entry for each packet, in the order of sending: the time of sending s, and the time r − s from sending
to reception, in seconds, which is ∞ if the packet was lost. Its relation to the delay depends on the route:

* ``one way``: one computer, or computers with the same time, observed both: r − s is the delay.
* ``round trip``: one computer observed a request and its answer: r − s is the delay of both together.
* ``two computers``: the sender observed s and the receiver r: r − s is the delay plus a line in time, as ``envelope``
  explains.

A copy of a packet that arrives again counts as a duplicate, and its first arrival as the reception.

If packets have numbers, those that are missing belong to dropped packets. Their times of sending are interpolated
linearly between their neighbours.

A file is read whole, up to 32 MiB. UTF-8 and UTF-16, which PowerShell writes, are accepted. The output of ping in
another encoding, as that of a localised Windows, is read as Latin-1, since all that is read of it is ASCII.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from taciturn.errors import ProblemError
from taciturn.extend import Array, Displayed, frozen, number_of, read_bytes, why_unreadable

Route: TypeAlias = Literal["one way", "round trip", "two computers"]
Whole: TypeAlias = npt.NDArray[np.int64]

LARGEST = 2**25  # bytes of a file
MOST_MISSING = 10_000_000  # packets that are inserted since their numbers are missing
_CAPTURES = (b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\xc3\xd4", b"\x4d\x3c\xb2\xa1", b"\xa1\xb2\x3c\x4d", b"\x0a\x0d\x0d\x0a")
_PACKED = (b"\x1f\x8b", b"PK\x03\x04", b"\x28\xb5\x2f\xfd", b"BZh", b"\xfd7zXZ")


@dataclass(frozen=True, repr=False, eq=False)
class Reading(Displayed):
    """Sent and received packets, in the order of sending."""

    form: str  # of the file, in words
    sent: Array  # time of sending of each packet in seconds, shape (packets,)
    elapsed: Array  # time of reception minus time of sending; infinite if the packet was lost, shape (packets,)
    route: Route
    duplicates: int = 0  # further copies of received packets
    notes: tuple[str, ...] = ()  # sentences for the user, for example about times that the file does not contain


@dataclass(frozen=True, repr=False)
class Names(Displayed):
    """Names of the columns, keys or fields from which a reader takes times and numbers; None: it searches for them."""

    sent: str | None = None
    received: str | None = None
    number: str | None = None
    unit: str | None = None  # of the times of sending
    link: str | None = None


def read_file(path: Path) -> tuple[str, bool]:
    """Return the text of a file, and whether its encoding is a known one."""
    try:
        content = read_bytes(path, LARGEST)
    except OSError as error:
        raise ProblemError(
            f"the file {str(path)!r} cannot be read ({why_unreadable(error)}); expected a regular text file of at most "
            f"{LARGEST >> 20} MiB: check its name, or split a larger file"
        ) from None
    if content.startswith(_CAPTURES):
        raise ProblemError(
            f"the file {str(path)!r} has captured packets in binary form; expected their times as text: export them by "
            "tshark -r FILE -T fields -E header=y -E separator=, -e frame.time_epoch -e ip.id"
        )
    if content.startswith(_PACKED):
        raise ProblemError(f"the file {str(path)!r} is compressed; expected a text file: unpack it first")
    marks = {b"\xff\xfe": "utf-16-le", b"\xfe\xff": "utf-16-be"}
    encoding = marks.get(content[:2], "utf-8-sig")
    try:
        text, known = content.decode(encoding).lstrip("\ufeff"), True
    except UnicodeDecodeError:
        text, known = content.decode("latin-1"), False
    if not text.strip():
        raise ProblemError(f"the file {str(path)!r} is empty; expected a line for each packet: measure again")
    if "\0" in text:
        raise ProblemError(f"the file {str(path)!r} is binary; expected text, such as the output of ping")
    return text.replace("\r\n", "\n").replace("\r", "\n"), known


def ordered(
    form: str, sent: Array, elapsed: Array, route: Route, duplicates: int = 0, notes: tuple[str, ...] = ()
) -> Reading:
    """Return a reading whose packets are sorted by their times of sending; a note says how many were not."""
    order = np.argsort(sent, kind="stable")
    before = int((np.diff(sent) < 0).sum())
    if before:
        notes = (*notes, f"{before} times of sending are before that of the line above; packets are sorted by time")
    return Reading(form, frozen(sent[order]), frozen(elapsed[order]), route, duplicates, notes)


def with_missing(where: str, numbers: Whole, sent: Array, elapsed: Array) -> tuple[Array, Array]:
    """Insert a dropped packet for each missing number; numbers are increasing, and unknown times of sending are NaN."""
    span = int(numbers[-1] - numbers[0]) + 1
    if span - len(numbers) > MOST_MISSING:
        raise ProblemError(
            f"{where} has the numbers {numbers[0]} to {numbers[-1]} for {number_of(len(numbers), 'packet')}; expected "
            "consecutive numbers, of which some may be missing: name the key or column of the number"
        )
    at = numbers - numbers[0]
    times, found = np.full(span, np.nan), np.full(span, np.inf)
    times[at], found[at] = sent, elapsed
    known = np.flatnonzero(np.isfinite(times))
    if len(known) < span:
        steps = np.diff(times[known]) / np.diff(known)
        step = float(np.median(steps)) if len(steps) else 0.0
        filled = np.interp(np.arange(span), known, times[known])
        index = np.arange(span)
        filled = np.where(index < known[0], times[known[0]] + (index - known[0]) * step, filled)
        times = np.where(index > known[-1], times[known[-1]] + (index - known[-1]) * step, filled)
    return times, found
