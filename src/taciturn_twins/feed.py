"""The feed of a live page: a log of events for any number of readers, and a queue of user requests.

A writer never waits for a reader. Only the number of the next event is stored for each reader. Therefore a slow reader
delays no other reader and needs no memory, and a reader that joins late receives the round from its beginning.
"""

from __future__ import annotations

import json
import secrets
import threading
from typing import Any, NamedTuple

from taciturn.errors import ProblemError
from taciturn.extend import choice, number

HELD = 50_000  # number of latest events of a round that are stored for readers that join late
BATCH = 500  # largest number of events that a reader receives per call
WAITING = 64  # largest number of requests that wait for the run
ASKS = ("pause", "value", "push")


class News(NamedTuple):
    """The next part of the event log for one reader.

    Args:
        text: events in the format of server-sent events; may be empty.
        since: number of the next event.
        picture: number of the newest picture.
        ended: whether the log has ended.
    """

    text: bytes
    since: int
    picture: int
    ended: bool


class Feed:
    """A thread-safe store of the events of a round, the newest picture, and the requests that are waiting for the run.

    Example:
        >>> feed = Feed()
        >>> feed.begin({"round": 0}, ("price", 0.0, 1.0))
        >>> feed.ask("value", 0.5)
        >>> feed.asked()
        [('value', 0.5)]
    """

    def __init__(self) -> None:
        """Start with an empty log."""
        self._turn = threading.Condition()
        self._run = secrets.token_hex(4)  # distinguishes this server from an earlier one at the same address
        self._events: list[bytes] = []
        self._first = 1  # number of the first stored event after the event that begins the round
        self._beginning = self._event(0, "wait", None)
        self._picture, self._pictures = b"", 0
        self._parameter: tuple[str, float, float] | None = None
        self._asked: list[tuple[str, float]] = []
        self._paused = self._ended = False

    @property
    def picture(self) -> bytes:
        """The newest picture; empty before the first picture."""
        return self._picture

    def begin(self, about: dict[str, Any], parameter: tuple[str, float, float]) -> None:
        """Begin a round, and remove earlier events from the log."""
        text = encode("about", about)
        with self._turn:
            self._beginning = self._event(self._next, "begin", text)
            self._first, self._parameter = self._next + 1, parameter
            self._events.clear()
            if self._paused:
                self._append("asked", encode("pause", {"ask": "pause", "value": 1.0}))
            self._turn.notify_all()

    def tell(self, kind: str, text: str) -> None:
        """Append an event for all current and later readers."""
        with self._turn:
            self._append(kind, text)
            self._turn.notify_all()

    def show(self, picture: bytes) -> None:
        """Replace the newest picture, and notify all readers."""
        with self._turn:
            self._picture = picture
            self._pictures += 1
            self._turn.notify_all()

    def ask(self, ask: str, value: object) -> None:
        """Store a request for the run, and show it on all pages.

        Raises:
            ProblemError: the request is unknown, its value is out of range, no round has begun, or too many requests
                are waiting.
        """
        choice("ask", ask, ASKS)
        with self._turn:
            if self._parameter is None:
                raise ProblemError("no round has begun; expected a request during a round: try again later")
            name, least, largest = self._parameter
            known = number(name, value, least, largest, closed=True) if ask == "value" else number("value", value)
            if ask != "value" and known not in (0.0, 1.0):
                raise ProblemError(f"value of {ask!r} is {known:g}; expected 0 or 1")
            if len(self._asked) >= WAITING:
                raise ProblemError(
                    f"{WAITING} requests are waiting for the run; expected fewer: check whether the run has stopped"
                )
            self._asked.append((ask, known))
            self._paused = known == 1.0 if ask == "pause" else self._paused
            self._append("asked", encode(ask, {"ask": ask, "value": known}))
            self._turn.notify_all()

    def asked(self) -> list[tuple[str, float]]:
        """Return the requests since the last call, in order."""
        with self._turn:
            found, self._asked = self._asked, []
        return found

    def end(self) -> None:
        """Append the event that ends the log."""
        with self._turn:
            self._ended = True
            self._append("end", "null")
            self._turn.notify_all()

    def resume(self, last: str) -> int:
        """Return the number of the event after a reader's last event, or 0 if that event belongs to another run."""
        run, _, told = last.rpartition(".")
        known = run == self._run and len(told) < 20 and told.isdecimal()
        return int(told) + 1 if known and int(told) < self._next else 0

    def news(self, since: int, picture: int, patience: float) -> News:
        """Return the events after a reader's last event; wait for events for at most ``patience`` seconds.

        If the reader has not received the beginning of this round, or its next event is no longer stored, the result is
        the beginning of the round and all stored events.
        """
        with self._turn:
            self._turn.wait_for(lambda: since < self._next or picture < self._pictures or self._ended, patience)
            anew = since < self._first
            start = self._first if anew else since
            found = self._events[start - self._first : start - self._first + BATCH]
            beginning, pictures, ended = self._beginning, self._pictures, self._ended
            reached = start + len(found)
            done = ended and reached == self._next
        text = (beginning if anew else b"") + b"".join(found)
        if picture < pictures:
            text += f"event: picture\ndata: {pictures}\n\n".encode()
        return News(text, reached, pictures, done)

    @property
    def _next(self) -> int:
        return self._first + len(self._events)

    def _append(self, kind: str, text: str) -> None:
        self._events.append(self._event(self._next, kind, text))
        if len(self._events) >= 2 * HELD:
            del self._events[:HELD]
            self._first += HELD

    def _event(self, event: int, kind: str, text: str | None) -> bytes:
        return f"id: {self._run}.{event}\nevent: {kind}\ndata: {text or 'null'}\n\n".encode()


def encode(name: str, value: object) -> str:
    """Return a value as JSON on one line; arrays become lists.

    Raises:
        ProblemError: a number is not finite, or a value has no representation in JSON.
    """
    try:
        return json.dumps(value, allow_nan=False, default=_plain, separators=(",", ":"))
    except ValueError:
        raise ProblemError(f"{name} holds a number that is not finite; expected None for a missing number") from None
    except TypeError as error:
        raise ProblemError(f"{name} cannot be sent ({error}); expected numbers, texts, lists and mappings") from None


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):  # an array, or one of its numbers
        return value.tolist()
    raise TypeError(f"a value has the type {type(value).__name__}")
