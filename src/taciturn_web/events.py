"""Log of server-sent events; any number of browsers read it, each at its own speed.

A writer, in any thread, never waits for a reader. Only the number of the next event is stored for each reader.
Therefore a slow reader delays no other reader and needs no memory, and a reader that joins late receives everything
from the event that began the log anew. A browser that reconnects names its last event, and receives the later ones.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import threading
from collections.abc import AsyncIterator
from typing import Any

from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from taciturn.errors import ProblemError

PULSE = 2.0  # seconds between keep-alive events while there are no other events
LOOK = 0.03  # seconds between two checks for events; pages draw at most ten times per second
HELD = 50_000  # number of latest events that are stored for readers that join late
BATCH = 500  # largest number of events that a reader receives at once


class Log:
    """Log of server-sent events since it began; of events that replace each other, it keeps only the newest."""

    def __init__(self, kind: str) -> None:
        """Begin with an event of a kind, without data."""
        self._lock = threading.Lock()
        self._run = secrets.token_hex(4)  # distinguishes this log from an earlier one at the same address
        self._events: list[bytes] = []
        self._first = 1  # number of the first stored event after the event that begins the log
        self._beginning = self._event(0, kind, "null")
        self._newest, self._replaced = b"", 0
        self._ended = False

    def begin(self, kind: str, data: str) -> None:
        """Remove all events, and begin the log again with the given event."""
        with self._lock:
            self._beginning = self._event(self._next, kind, data)
            self._first = self._next + 1
            self._events.clear()

    def tell(self, kind: str, data: str) -> None:
        """Append an event, which all present and future readers receive."""
        with self._lock:
            self._append(kind, data)

    def replace(self, kind: str, data: str) -> None:
        """Set an event that replaces its earlier versions; a reader receives only the newest version."""
        with self._lock:
            self._newest, self._replaced = f"event: {kind}\ndata: {data}\n\n".encode(), self._replaced + 1

    def end(self) -> None:
        """Append the event that ends the log."""
        with self._lock:
            if not self._ended:
                self._ended = True
                self._append("end", "null")

    async def answer(self, request: Request) -> Response:
        """Return the HTTP response through which a browser reads the log."""
        events = self._follow(request.headers.get("Last-Event-ID", ""))
        return StreamingResponse(events, media_type="text/event-stream")

    async def _follow(self, last: str) -> AsyncIterator[bytes]:
        """Yield the events after a reader's last event until the end."""
        run, _, told = last.rpartition(".")
        known = run == self._run and len(told) < 20 and told.isdecimal() and int(told) < self._next
        since, replaced, ended, silent = int(told) + 1 if known else 0, 0, False, 0.0
        yield b"retry: 1000\n\n"
        while not ended:
            with self._lock:
                text, since, ended = self._take(since)
                if replaced < self._replaced:
                    text, replaced = text + self._newest, self._replaced
            if text or silent >= PULSE:
                yield text or b"event: alive\ndata: null\n\n"
                silent = 0.0
            else:
                await asyncio.sleep(LOOK)
                silent += LOOK

    def _take(self, since: int) -> tuple[bytes, int, bool]:
        """Return the next events of a reader, the number of the event after them, and whether the log has ended.

        A reader that lacks the beginning, or whose next event is no longer stored, receives the beginning and all
        stored events.
        """
        anew = since < self._first
        start = self._first if anew else since
        found = self._events[start - self._first : start - self._first + BATCH]
        reached = start + len(found)
        return (self._beginning if anew else b"") + b"".join(found), reached, self._ended and reached == self._next

    @property
    def _next(self) -> int:
        return self._first + len(self._events)

    def _append(self, kind: str, data: str) -> None:
        self._events.append(self._event(self._next, kind, data))
        if len(self._events) >= 2 * HELD:
            del self._events[:HELD]
            self._first += HELD

    def _event(self, event: int, kind: str, data: str) -> bytes:
        return f"id: {self._run}.{event}\nevent: {kind}\ndata: {data}\n\n".encode()


def encode(name: str, value: object) -> str:
    """Encode a value as JSON on one line, for the data of an event; arrays are encoded as lists."""
    try:
        return json.dumps(value, allow_nan=False, default=_plain, separators=(",", ":"))
    except ValueError:
        raise ProblemError(f"{name} contains a number that is not finite; expected None for a missing number") from None
    except TypeError as error:
        raise ProblemError(f"{name} cannot be sent ({error}); expected numbers, texts, lists and mappings") from None


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):  # an array, or one of its numbers
        return value.tolist()
    raise TypeError(f"a value has the type {type(value).__name__}")
