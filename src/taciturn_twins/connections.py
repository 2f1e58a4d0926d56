"""The open connections of a live page: strangers, which await access control, and admitted connections.

A connection is a stranger until its request passed the access control. A new stranger is always accepted: if there are
too many, the oldest of the address with the most strangers is closed. Therefore connections that wait, or that send
slowly, cannot keep out a user whose request contains the token, and they never take a seat of an admitted connection.
"""

from __future__ import annotations

import io
import socket
import threading
import time
from collections import Counter
from contextlib import suppress

SEATS = 128  # largest number of admitted connections
STRANGERS = 64  # largest number of connections that have not been admitted
PER_ADDRESS = 16  # largest number of them from one address
LARGEST = 1 << 17  # largest number of bytes of a request with its header


class Connections:
    """The connections of a server; every method may be called from any thread."""

    def __init__(self) -> None:
        """Start without connections."""
        self._lock = threading.Lock()
        self._strangers: dict[socket.socket, str] = {}  # with their addresses, the oldest first
        self._admitted: set[socket.socket] = set()

    def enter(self, connection: socket.socket, address: str) -> None:
        """Add a connection that awaits access control, and close the oldest one if there are too many."""
        with self._lock:
            self._strangers[connection] = address
            counts = Counter(self._strangers.values())
            heaviest = address if counts[address] > PER_ADDRESS else counts.most_common(1)[0][0]
            if counts[address] > PER_ADDRESS or len(self._strangers) > STRANGERS:
                self._dismiss(next(one for one, place in self._strangers.items() if place == heaviest))

    def admit(self, connection: socket.socket) -> bool:
        """Admit a connection after access control, and return whether fewer than ``SEATS`` were admitted."""
        with self._lock:
            if len(self._admitted) >= SEATS or self._strangers.pop(connection, None) is None:
                return False
            self._admitted.add(connection)
            return True

    def leave(self, connection: socket.socket) -> None:
        """Remove a connection, before its socket is closed."""
        with self._lock:
            self._strangers.pop(connection, None)
            self._admitted.discard(connection)

    def dismiss(self) -> None:
        """Close all connections that await access control."""
        with self._lock:
            for connection in list(self._strangers):
                self._dismiss(connection)

    def _dismiss(self, connection: socket.socket) -> None:
        """Close a stranger: its thread reads the end of the request, and closes the socket."""
        del self._strangers[connection]
        with suppress(OSError):  # it has ended by itself
            connection.shutdown(socket.SHUT_RDWR)


class Timed(io.RawIOBase):
    """The bytes of a request, which a socket must receive completely before a deadline.

    Args:
        connection: the socket.
        seconds: time from now to the deadline.
    """

    def __init__(self, connection: socket.socket, seconds: float) -> None:
        """Set the deadline."""
        self._connection, self._end, self._left = connection, time.monotonic() + seconds, LARGEST

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        """Receive bytes, and return their number.

        Raises:
            TimeoutError: the deadline is over.
            OSError: the request is too large, or the client is gone.
        """
        remaining = self._end - time.monotonic()
        if remaining <= 0.0:
            raise TimeoutError("the request took too long")
        self._connection.settimeout(remaining)
        size = self._connection.recv_into(buffer)
        self._left -= size
        if self._left < 0:
            raise OSError("the request is too large")
        return size
