"""Recognition of the form of a file, from its first lines, and the call of its reader.

A table is recognised by the names of its columns, the output of ping by its heading or by a reply, and a log of
messages by an object in JSON on its first line. A file that is none of these is refused with its first line. A stated
form is used as it is, and its reader then says what it misses.

An option that the form does not use is refused, since its user expects an effect.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

from taciturn.errors import ProblemError
from taciturn.extend import Array, Displayed, quoted
from taciturn_delays.captures import TIME, read_one_capture, read_two_captures
from taciturn_delays.messages import is_table_of_messages, read_message_lines, read_message_table
from taciturn_delays.ping import is_ping, read_ping
from taciturn_delays.reading import Names, Reading, read_file
from taciturn_delays.tables import heading
from taciturn_delays.traces import HISTOGRAM, PACKETS, TRACE, read_histogram, read_packets, read_trace

Form: TypeAlias = Literal["ping", "messages", "captures", "packets", "trace", "histogram"]
FORMS: tuple[Form, ...] = ("captures", "packets", "trace", "histogram", "ping", "messages")
_USES: Mapping[str, tuple[Form, ...]] = {
    "receiver": ("captures",),
    "interval": ("ping",),
    "link": ("packets",),
    "sent": ("messages",),
    "received": ("messages",),
    "unit": ("messages",),
    "identity": ("messages", "captures"),
}
_READABLE = (
    "the output of ping, a log of messages, an export of tshark, packets.csv, or a table with the columns sent and "
    "delay, or milliseconds and probability"
)


@dataclass(frozen=True, repr=False, eq=False)
class Histogram(Displayed):
    """Delays in seconds and their probabilities; the rest of the probability is that of a loss."""

    delays: Array
    probabilities: Array


def read(
    path: Path, receiver: Path | None, form: Form | None, interval: float | None, names: Names
) -> Reading | Histogram:
    """Read one file, or captures of the sender and of the receiver."""
    text, known = read_file(path)
    chosen = _recognised(path, text) if form is None else form
    if not known and chosen != "ping":
        raise ProblemError(f"the file {str(path)!r} is not UTF-8 text; expected text in UTF-8: save it as UTF-8")
    given = {"receiver": receiver, "interval": interval, "link": names.link, "sent": names.sent}
    given |= {"received": names.received, "unit": names.unit, "identity": names.number}
    for name, value in given.items():
        if value is not None and chosen not in _USES[name]:
            raise ProblemError(
                f"{name} is {quoted(str(value))}, but {str(path)!r} has the form {chosen}; expected it only for the "
                f"form {' or '.join(_USES[name])}: leave it out"
            )
    if chosen == "histogram":
        return Histogram(*read_histogram(path, text))
    return _reading(path, text, receiver, chosen, interval, names)


def _reading(path: Path, text: str, receiver: Path | None, form: Form, interval: float | None, names: Names) -> Reading:
    """Read the packets in a file of a known form."""
    if form == "ping":
        return read_ping(path, text, interval)
    if form == "captures":
        if receiver is None:
            return read_one_capture(path, text, names)
        return read_two_captures((path, text), (receiver, read_file(receiver)[0]), names)
    if form == "messages":
        return (read_message_lines if _has_object(text) else read_message_table)(path, text, names)
    return read_trace(path, text) if form == "trace" else read_packets(path, text, names.link)


def _recognised(path: Path, text: str) -> Form:
    """Return the form of a file."""
    columns = set(heading(text)[1])
    fits: dict[Form, bool] = {
        "captures": TIME in columns,
        "packets": columns >= set(PACKETS),
        "trace": columns >= set(TRACE),
        "histogram": columns >= set(HISTOGRAM),
        "ping": is_ping(text),
        "messages": _has_object(text) or is_table_of_messages(columns),
    }
    found: Form | None = next((form for form in FORMS if fits[form]), None)
    if found is None:
        first = next(line for line in text.split("\n") if line.strip())
        raise ProblemError(
            f"the file {str(path)!r} begins with {quoted(first)}, and its form is not recognised; expected "
            f"{_READABLE}: state it, as by --kind messages"
        )
    return found


def _has_object(text: str) -> bool:
    """Check whether the first line contains an object in JSON."""
    first = next((line for line in text.split("\n") if line.strip()), "")
    return "{" in first and "}" in first
