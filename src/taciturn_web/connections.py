"""Open connections of a page: those that have passed access control, and all others (strangers).

A connection is a stranger until its request has passed the access control. A new stranger is always accepted: if there
are too many, the oldest of the address with the most strangers is closed. Therefore connections that wait, or that send
slowly, cannot keep out a user whose request contains the token, and they never take a seat of an admitted connection.

A connection carries one request. Its client has ``PATIENCE`` seconds to send the request as a whole, to read what fills
the buffer, and to read the end of the answer; otherwise the connection is closed.
"""

from __future__ import annotations

import asyncio
from collections import Counter

from uvicorn.protocols.http.h11_impl import H11Protocol

PATIENCE = 10.0  # seconds in which a client must act
SEATS = 128  # largest number of admitted connections
STRANGERS = 64  # largest number of connections that have not been admitted
PER_ADDRESS = 16  # largest number of them from one address


class Connection(H11Protocol):
    """A connection of the web server uvicorn; its request can access it as ``state.connection``."""

    _admitted, _waits, _since, _address = False, True, 0.0, ""
    _timer: asyncio.TimerHandle | None = None

    def admit(self) -> bool:
        """Admit this connection after access control; return false if ``SEATS`` connections are admitted already."""
        others = [one for one in self._all() if one._admitted]
        self._admitted = len(others) < SEATS and self in self.connections
        return self._admitted

    def wait(self, waits: bool) -> None:
        """Start the client's time limit if the server waits for the client, otherwise stop it."""
        self._waits = waits
        self._limit(waits)

    def dismiss(self) -> None:
        """Close this connection at once."""
        self.connections.discard(self)
        self.transport.abort()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the time limit for a request, and close the oldest stranger's connection if there are too many."""
        super().connection_made(transport)
        self.app_state = {**self.app_state, "connection": self}
        self._since, self._address = self.loop.time(), self.client[0] if self.client else ""
        self.wait(True)
        strangers = sorted((one for one in self._all() if not one._admitted), key=lambda one: one._since)
        counts = Counter(one._address for one in strangers)
        crowded = counts[self._address] > PER_ADDRESS
        if crowded or len(strangers) > STRANGERS:
            heaviest = self._address if crowded else counts.most_common(1)[0][0]
            next(one for one in strangers if one._address == heaviest).dismiss()

    def connection_lost(self, exc: Exception | None) -> None:
        """End the time limit."""
        super().connection_lost(exc)
        self.wait(False)

    def send_400_response(self, msg: str) -> None:
        """Answer a request that violates HTTP with an error, unless an answer may have begun."""
        if self.cycle:
            self.dismiss()
        else:
            super().send_400_response(msg)

    def pause_writing(self) -> None:
        """Start the time limit within which the client must read data, because the send buffer is full."""
        super().pause_writing()
        self._limit(True)

    def resume_writing(self) -> None:
        """End the time limit."""
        super().resume_writing()
        self._limit(self._waits)

    def _limit(self, waits: bool) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self.loop.call_later(PATIENCE, self.dismiss) if waits and self in self.connections else None

    def _all(self) -> list[Connection]:
        return [one for one in self.connections if isinstance(one, Connection)]
