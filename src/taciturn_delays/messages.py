"""Reader of logs of messages, such as those of MQTT: a time of publication and a time of reception for each message.

Two forms are read. A table has a heading and a row for each message; an empty time of reception means that the message
was lost. In lines of JSON, each line has one message, with the time of reception before it or in it:

    mosquitto_sub -t plant/y -F '%U %p'      1700000000.250000000 {"sent": 1700000000.2, "seq": 7}
    mosquitto_sub -t plant/y -F '%I %t %p'   the same with a date, which has whole seconds and is therefore refused
    mosquitto_sub -t plant/y -F '%J'         {"tst": "2026-03-02T12:00:00.250000+0000", "payload": {"sent": …}}

The payload contains the time of sending, as seconds or in a smaller unit since 1970, which the size tells, or since any
other time with a stated unit. A payload in quotes (%j) is JSON in JSON.

The times are those of a column or key with one of the usual names (``SENT``, ``RECEIVED``, ``NUMBER``), or with a
stated one, such as payload.t. With a number per message, missing numbers are lost messages, and repeated ones are
duplicates, as of a delivery at least once. Without it, losses are seen only as empty cells.

Publisher and subscriber may be two computers, so their times are compared as ``envelope`` explains.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn, cast

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Displayed, quoted
from taciturn_delays.instants import instant, seconds
from taciturn_delays.reading import Names, Reading, ordered, with_missing
from taciturn_delays.tables import expect_column, first_of, read_table

SENT = ("sent", "published", "publication", "sent_at", "send_time", "timestamp", "time", "ts")
RECEIVED = ("received", "reception", "received_at", "receive_time", "tst")
NUMBER = ("seq", "sequence", "number", "counter", "n")
_SECOND = 10**9  # nanoseconds
_FEW = 5  # messages whose times may all be whole seconds by chance


@dataclass(repr=False)
class _Messages(Displayed):
    """Times in nanoseconds of the messages; a time of reception is None if the message was lost."""

    sent: list[int] = field(default_factory=list[int])
    received: list[int | None] = field(default_factory=list["int | None"])
    numbers: list[int] = field(default_factory=list[int])


def is_table_of_messages(names: Iterable[str]) -> bool:
    """Check whether the names of the columns are those of a table of messages."""
    return first_of(names, SENT) is not None and first_of(names, RECEIVED) is not None


def read_message_table(path: Path, text: str, names: Names) -> Reading:
    """Read a table with a row for each message."""
    table, found = read_table(path, text), _Messages()
    sent, received = (
        expect_column(table, name, known, what)
        for name, known, what in (
            (names.sent, SENT, "times of sending"),
            (names.received, RECEIVED, "times of reception"),
        )
    )
    number = (
        first_of(table.names, NUMBER) if names.number is None else expect_column(table, names.number, (), "numbers")
    )
    for i, (begin, end) in enumerate(zip(table.column(sent), table.column(received), strict=True)):
        found.sent.append(instant(f"{sent} in {table.where(i)}", begin, names.unit))
        found.received.append(instant(f"{received} in {table.where(i)}", end) if end else None)
    if number is not None:
        found.numbers = [_whole(f"{number} in {table.where(i)}", one) for i, one in enumerate(table.column(number))]
    return _reading(path, found, "table of messages")


def read_message_lines(path: Path, text: str, names: Names) -> Reading:
    """Read lines with a message in JSON each."""
    found = _Messages()
    for i, line in enumerate(text.split("\n"), 1):
        if not line.strip():
            continue
        where = f"line {i} of {str(path)!r}"
        before, brace, rest = line.partition("{")
        values = dict(_flat(_parsed(where, brace + rest), ""))
        sent = _value(values, SENT if names.sent is None else (names.sent,), prefer="payload")
        if sent is None:
            told = f"the key {quoted(names.sent)}" if names.sent else f"the time of sending ({', '.join(SENT)})"
            raise ProblemError(
                f"{where} does not have {told}; expected it among its keys {', '.join(values)}: name the key, such as "
                f"--sent {next(iter(values), 'payload.t')}"
            )
        words = before.split()
        received = _value(values, RECEIVED) if names.received is None else _value(values, (names.received,))
        if names.received is None and words:
            received = words[0]
        if received is None:
            raise ProblemError(
                f"{where} does not have the time of reception; expected it before the message, as by mosquitto_sub -F "
                "'%U %p', or as tst in it, as by -F '%J'"
            )
        found.sent.append(instant(f"the time of sending in {where}", sent, names.unit))
        found.received.append(instant(f"the time of reception in {where}", received))
        number = _value(values, NUMBER if names.number is None else (names.number,), prefer="payload")
        if number is not None:
            found.numbers.append(_whole(f"the number in {where}", number))
    if names.number is not None and not found.numbers:
        raise ProblemError(
            f"the messages in {str(path)!r} do not have the key {quoted(names.number)}; expected the key of a number "
            "that counts messages: name another key, or none"
        )
    return _reading(path, found, "log of messages")


def _reading(path: Path, found: _Messages, form: str) -> Reading:
    """Return the messages as packets."""
    notes = list[str]()
    if _whole_seconds([one for one in found.received if one is not None]):
        raise ProblemError(
            f"all times of reception in {str(path)!r} are whole seconds; expected times with fractions of a second: "
            "record them by mosquitto_sub -F '%U %p'"
        )
    if _whole_seconds(found.sent):
        notes.append("all times of sending are whole seconds: if their fractions are cut off, delays are too large")
    start = min(found.sent)
    sent = seconds(found.sent, start)
    elapsed = np.array(
        [np.inf if end is None else (end - begin) / 1e9 for begin, end in zip(found.sent, found.received, strict=True)]
    )
    if len(found.numbers) != len(found.sent):
        notes.append("the messages have no number: only losses with a row of their own are seen")
        return ordered(form, sent, elapsed, "two computers", 0, tuple(notes))
    order = np.lexsort((elapsed, sent))
    numbers, sent, elapsed = np.array(found.numbers, dtype=np.int64)[order], sent[order], elapsed[order]
    again = np.concatenate([[False], (np.diff(numbers) == 0) & (np.diff(sent) == 0)])
    numbers, sent, elapsed = numbers[~again], sent[~again], elapsed[~again]
    falls = int((np.diff(numbers) <= 0).sum())
    if falls:
        notes.append(f"the numbers start again {falls} times; losses there are not seen")
    edges = [0, *(np.flatnonzero(np.diff(numbers) <= 0) + 1).tolist(), len(numbers)]
    parts = [with_missing(repr(str(path)), numbers[a:b], sent[a:b], elapsed[a:b]) for a, b in pairwise(edges)]
    sent, elapsed = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    return ordered(form, sent, elapsed, "two computers", int(again.sum()), tuple(notes))


def _whole_seconds(times: list[int]) -> bool:
    """Check whether times are whole seconds, and not by chance."""
    return len(times) >= _FEW and all(time % _SECOND == 0 for time in times)


def _parsed(where: str, text: str) -> Mapping[str, Any]:
    """Return the message in a line."""

    def refuse(word: str) -> NoReturn:
        raise ValueError(f"{word} is no number")

    try:
        value: Any = json.loads(text, parse_float=Decimal, parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise ProblemError(
            f"{where} is no message in JSON ({error}); expected a time and an object, such as 1700000000.25 "
            '{"sent": 1700000000.2, "seq": 7}: correct the line, or remove it'
        ) from None
    if not isinstance(value, dict):
        raise ProblemError(
            f"{where} is {quoted(value)}; expected an object in JSON, such as " + '{"sent": 1700000000.2}'
        )
    return cast("Mapping[str, Any]", value)


def _flat(value: Mapping[str, Any], prefix: str, depth: int = 0) -> Iterator[tuple[str, object]]:
    """Yield the values in an object, also within other objects, with dotted keys in lower case."""
    for key, one in value.items():
        name = f"{prefix}{key}".lower()
        inner: Any = one
        if isinstance(one, str) and one.lstrip().startswith("{"):
            try:
                inner = json.loads(one, parse_float=Decimal)
            except (ValueError, RecursionError):
                inner = one
        if isinstance(inner, dict) and depth < 8:
            yield from _flat(cast("Mapping[str, Any]", inner), f"{name}.", depth + 1)
        elif isinstance(inner, str | int | Decimal):
            yield name, inner


def _value(values: Mapping[str, object], wanted: Iterable[str], prefer: str = "") -> object | None:
    """Return the value of the first wanted key, whole or as the end of a dotted key."""
    for name in (one.lower() for one in wanted):
        ends = [key for key in values if key == name or key.endswith(f".{name}")]
        if ends:
            return values[min(ends, key=lambda key: (not key.startswith(prefer), len(key)))]
    return None


def _whole(where: str, value: object) -> int:
    """Return a number of a message."""
    text = str(value).strip()
    if not (text.isascii() and text.isdecimal() and len(text) < 19):
        raise ProblemError(
            f"{where} is {quoted(value)}; expected a whole number that counts messages: name another key or column"
        )
    return int(text)
