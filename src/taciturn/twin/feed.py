"""What the pages of a run are told, and what people ask of it: one log that any number of readers follow.

Whoever writes never waits for a reader. A reader remembers no more than the number of the event that it wants next:
a slow one holds nothing up and costs no memory, and one that joins late is told the round from its beginning.
"""

from __future__ import annotations

import json
import secrets
import threading
from typing import Any, NamedTuple

from taciturn._arrays import choice, number
from taciturn.errors import ProblemError

HELD = 50_000  # latest events of a round that are kept for those who join late
BATCH = 500  # events that a reader is given at once
WAITING = 64  # requests that may wait for the run
ASKS = ("pause", "value", "push")


class News(NamedTuple):
    """What a reader is told next.

    Args:
        text: events, ready to be sent; may be empty.
        since: the number of the event to ask for next.
        picture: how many pictures there have been.
        ended: whether nothing more will come.
    """

    text: bytes
    since: int
    picture: int
    ended: bool


class Feed:
    """The events of a round, the newest picture, and the requests that wait for the run; for any threads.

    Example:
        >>> feed = Feed()
        >>> feed.begin({"round": 0}, ("price", 0.0, 1.0))
        >>> feed.ask("value", 0.5)
        >>> feed.asked()
        [('value', 0.5)]
    """

    def __init__(self) -> None:
        """Nothing has begun."""
        self._turn = threading.Condition()
        self._run = secrets.token_hex(4)  # tells a server from the one that was here before it
        self._events: list[bytes] = []
        self._first = 1  # the number of the first event that is kept, after the one that begins the round
        self._beginning = self._event(0, "wait", None)
        self._picture, self._pictures = b"", 0
        self._knob: tuple[str, float, float] | None = None
        self._asked: list[tuple[str, float]] = []
        self._paused = self._ended = False

    @property
    def picture(self) -> bytes:
        """The newest picture; empty: there has been none."""
        return self._picture

    def begin(self, about: dict[str, Any], knob: tuple[str, float, float]) -> None:
        """Begin a round: what was told before is forgotten."""
        text = encode("about", about)
        with self._turn:
            self._beginning = self._event(self._next, "begin", text)
            self._first, self._knob = self._next + 1, knob
            self._events.clear()
            if self._paused:
                self._append("asked", encode("pause", {"ask": "pause", "value": 1.0}))
            self._turn.notify_all()

    def tell(self, kind: str, text: str) -> None:
        """Tell all readers, those who come later included."""
        with self._turn:
            self._append(kind, text)
            self._turn.notify_all()

    def show(self, picture: bytes) -> None:
        """Let the readers know of a newer picture."""
        with self._turn:
            self._picture = picture
            self._pictures += 1
            self._turn.notify_all()

    def ask(self, ask: str, value: object) -> None:
        """Leave a request for the run, and tell all pages.

        Raises:
            ProblemError: no such request, a value out of range, no round yet, or a run that takes no requests.
        """
        choice("ask", ask, ASKS)
        with self._turn:
            if self._knob is None:
                raise ProblemError("no round has begun; expected one before anything is asked of it; try again")
            name, least, largest = self._knob
            known = number(name, value, least, largest, closed=True) if ask == "value" else number("value", value)
            if ask != "value" and known not in (0.0, 1.0):
                raise ProblemError(f"value of {ask!r} is {known:g}; expected 0 or 1")
            if len(self._asked) >= WAITING:
                raise ProblemError(f"{WAITING} requests wait for the run; expected it to take them: is it stuck?")
            self._asked.append((ask, known))
            self._paused = known == 1.0 if ask == "pause" else self._paused
            self._append("asked", encode(ask, {"ask": ask, "value": known}))
            self._turn.notify_all()

    def asked(self) -> list[tuple[str, float]]:
        """Return the requests since the last call, in their order."""
        with self._turn:
            found, self._asked = self._asked, []
        return found

    def end(self) -> None:
        """Tell all readers that nothing more will come."""
        with self._turn:
            self._ended = True
            self._append("end", "null")
            self._turn.notify_all()

    def resume(self, last: str) -> int:
        """Return the number of the event that follows the last one of a reader, 0 where it was of another run."""
        run, _, told = last.rpartition(".")
        known = run == self._run and len(told) < 20 and told.isdecimal()
        return int(told) + 1 if known and int(told) < self._next else 0

    def news(self, since: int, picture: int, patience: float) -> News:
        """Return what comes after what a reader has; wait so many seconds for it.

        Whoever has not heard the beginning of this round, or asks for what is no longer kept, gets the beginning and
        all that is kept.
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
    """Return a value as JSON on one line; arrays are lists.

    Raises:
        ProblemError: a number that is not finite, or what JSON does not know.
    """
    try:
        return json.dumps(value, allow_nan=False, default=_plain, separators=(",", ":"))
    except ValueError:
        raise ProblemError(f"{name} holds a number that is not finite; expected None where there is none") from None
    except TypeError as error:
        raise ProblemError(f"{name} cannot be sent ({error}); expected numbers, texts, lists and mappings") from None


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):  # an array, or one of its numbers
        return value.tolist()
    raise TypeError(f"it holds a {type(value).__name__}")
