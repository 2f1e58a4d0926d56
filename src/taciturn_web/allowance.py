"""Limits on the computing time of a page's clients, so that no client delays the others for long."""

from __future__ import annotations

import time

from starlette.exceptions import HTTPException

MOST = 1024  # largest number of clients that are remembered


class Allowance:
    """Computing time that each client may still use, in seconds; it grows again by ``share`` seconds per second."""

    def __init__(self, seconds: float, share: float) -> None:
        """Give each client so many seconds."""
        self._seconds, self._share = seconds, share
        self._used: dict[str, tuple[float, float]] = {}  # seconds of each client, and when; the oldest first

    def use(self, client: str, seconds: float) -> None:
        """Subtract the computing time that a client has used."""
        owed = self._owed(client) + seconds
        self._used.pop(client, None)
        self._used[client] = owed, time.monotonic()
        while len(self._used) > MOST:
            del self._used[next(iter(self._used))]

    def check(self, client: str) -> None:
        """Reject the request of a client that has no computing time left, with status 429."""
        excess = self._owed(client) - self._seconds
        if excess >= 0.0:
            again = {"Retry-After": f"{1 + excess / self._share:.0f}"}
            raise HTTPException(429, "this page has used its computing time", again)

    def _owed(self, client: str) -> float:
        """Return the seconds that a client has used and that have not returned yet."""
        used, when = self._used.get(client, (0.0, 0.0))
        return max(0.0, used - self._share * (time.monotonic() - when))
