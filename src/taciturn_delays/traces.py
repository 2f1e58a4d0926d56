"""Readers of files of this library: packets of a recorded run, traces of delays, and histograms.

``packets.csv`` has the columns time, step, link, event, delay and bytes. The event is sent, delivered, lost or late.
A packet has a row ``sent`` with the time of sending, and a row with its outcome for the same step and link, or the
latter alone; the time of sending is then the time of a dropped packet, and the time minus the delay of another. A late
packet was delivered after its step, so its delay counts. If a link sent several packets in a step, as to several
receivers, the outcomes belong to them in the order of the file.

A trace has the columns ``sent`` and ``delay`` in seconds; an empty delay means that the packet was lost.

A histogram has the columns ``milliseconds`` and ``probability``. The difference between 1 and their sum is
the probability of a loss. It has no order of packets, so nothing is known about the dependence between them.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Array, frozen, number_of, quoted
from taciturn_delays.reading import Reading, ordered
from taciturn_delays.tables import Table, read_table

PACKETS = ("time", "step", "link", "event", "delay")
TRACE = ("sent", "delay")
HISTOGRAM = ("milliseconds", "probability")
_EVENTS = ("sent", "delivered", "lost", "late")
_TOO_MUCH = 1e-6  # by which probabilities may exceed 1, after rounding


def read_trace(path: Path, text: str) -> Reading:
    """Read a trace."""
    table = _with_columns(path, text, TRACE, "trace")
    sent, delay = np.array(table.numbers("sent", -math.inf)), np.array(table.numbers("delay", lost=True))
    return ordered("trace", sent, delay, "one way")


def read_histogram(path: Path, text: str) -> tuple[Array, Array]:
    """Return delays in seconds and their probabilities."""
    table = _with_columns(path, text, HISTOGRAM, "histogram")
    values, chances = np.array(table.numbers("milliseconds")), np.array(table.numbers("probability"))
    total = float(chances.sum())
    if not 0 < total <= 1 + _TOO_MUCH:
        raise ProblemError(
            f"the probabilities in {str(path)!r} have the sum {total:g}; expected a sum above 0 and at most 1, where "
            "the rest is the probability of a loss: divide counts by the number of packets"
        )
    return frozen(values / 1000), frozen(chances / max(total, 1.0))


def read_packets(path: Path, text: str, link: str | None) -> Reading:
    """Read the packets of one link in ``packets.csv``."""
    table = _with_columns(path, text, PACKETS, "packets")
    links = table.column("link")
    names = list(dict.fromkeys(links))
    if link is None and len(names) > 1:
        raise ProblemError(
            f"the file {str(path)!r} has packets of the links {', '.join(names)}; expected one of them: add --link "
            f"{names[0]}"
        )
    chosen = names[0] if link is None else link
    if chosen not in names:
        raise ProblemError(
            f"the link {quoted(chosen)} has no packets in {str(path)!r}; expected one of the links {', '.join(names)}"
        )
    return _of_link(table, [i for i, name in enumerate(links) if name == chosen], chosen)


def _of_link(table: Table, rows: list[int], link: str) -> Reading:
    """Return the packets in the chosen rows."""
    times, steps, events, delays = (table.column(name) for name in ("time", "step", "event", "delay"))
    open_sent: dict[str, list[float]] = {}
    ended: dict[str, list[tuple[float, float]]] = {}  # time of sending without a row sent, and delay
    for i in rows:
        if events[i] not in _EVENTS:
            raise ProblemError(
                f"event in {table.where(i)} is {quoted(events[i])}; expected one of the words {', '.join(_EVENTS)}"
            )
        time = table.number(i, "time", times[i], -math.inf)
        if events[i] == "sent":
            open_sent.setdefault(steps[i], []).append(time)
            continue
        delay = math.inf if events[i] == "lost" else table.number(i, "delay", delays[i], 0.0)
        ended.setdefault(steps[i], []).append((time if math.isinf(delay) else time - delay, delay))
    sent, elapsed, unknown = list[float](), list[float](), 0
    for step in dict.fromkeys([*open_sent, *ended]):
        starts, outcomes = open_sent.get(step, []), ended.get(step, [])
        for k in range(max(len(starts), len(outcomes))):
            alone, delay = outcomes[k] if k < len(outcomes) else (math.nan, math.inf)
            unknown += k >= len(outcomes)
            sent.append(starts[k] if k < len(starts) else alone)
            elapsed.append(delay)
    if unknown and not ended:
        raise ProblemError(
            f"the file {str(table.path)!r} has only rows sent of the link {quoted(link)}; expected rows delivered, "
            "late or lost as well: add the log of the receiver to the record"
        )
    notes = (f"counted as lost: {number_of(unknown, 'packet')} without an outcome",) if unknown else ()
    return ordered(f"packets of the link {link}", np.array(sent), np.array(elapsed), "one way", 0, notes)


def _with_columns(path: Path, text: str, names: tuple[str, ...], form: str) -> Table:
    """Read a table that must have some columns."""
    table = read_table(path, text)
    missing = [name for name in names if name not in table.names]
    if missing:
        raise ProblemError(
            f"the {form} {str(path)!r} does not have the column {missing[0]!r}; expected the columns "
            f"{', '.join(names)}, but the heading is {quoted(', '.join(table.names))}"
        )
    return table
