"""Datagrams over UDP: the only file that knows of sockets."""

from __future__ import annotations

import contextlib
import select
import socket
import struct
import sys
import time
from typing import TypeAlias

from taciturn.errors import ProblemError

Address: TypeAlias = tuple[str, int]
LARGEST, LARGEST_OF_ALL = 4096, 65535  # bytes of a datagram that are read: packets of numbers are shorter
BUFFER = 4 << 20  # bytes that wait in the kernel, if it lets us
MOST = 128  # datagrams that are taken at once, so that a flood does not keep a node from its tick
_LINUX = sys.platform.startswith("linux")  # elsewhere the next numbers mean something else
_FORCED = 33  # SO_RCVBUFFORCE: beyond what others may ask for
_MEMORY, _DROPS = 55, 8  # SO_MEMINFO, and where its table holds what was dropped


def parse_address(name: str, text: str) -> Address:
    """Return host and port of ``HOST:PORT``; the host may be left out: 127.0.0.1.

    Raises:
        ProblemError: no such form, no such port, or an unknown host.
    """
    host, colon, port = text.rpartition(":")
    if not colon or not port.isdecimal() or not 0 <= int(port) <= 65535:
        raise ProblemError(f"{name} is {text!r}; expected HOST:PORT with a port from 0 to 65535, as 127.0.0.1:9001")
    try:
        found = socket.getaddrinfo(host or "127.0.0.1", int(port), socket.AF_INET, socket.SOCK_DGRAM)
    except OSError as error:
        raise ProblemError(f"{name}: the host {host!r} is unknown ({error}); expected a name or an address") from None
    address = found[0][4]
    return str(address[0]), int(address[1])


class Endpoint:
    """A bound UDP socket.

    Args:
        bind: where to listen; port 0: any free one.
        largest: bytes of a datagram that are read; what is longer is cut, and then no packet.

    Raises:
        ProblemError: the address is in use, or not of this machine.
    """

    def __init__(self, bind: Address, largest: int = LARGEST) -> None:
        """Bind."""
        self._largest = largest
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        for option in (socket.SO_RCVBUF, *((_FORCED,) if _LINUX else ())):  # the second is root's
            with contextlib.suppress(OSError):
                self._socket.setsockopt(socket.SOL_SOCKET, option, BUFFER)
        try:
            self._socket.bind(bind)
        except OSError as error:
            self._socket.close()
            raise ProblemError(
                f"{bind[0]}:{bind[1]} cannot be bound ({error.strerror}); expected a free port of this machine: "
                "is another node running there?"
            ) from None
        self._socket.setblocking(False)
        self.sent, self.received, self.unsent = 0, 0, 0
        self.senders: list[Address] = []  # of the datagrams that were taken last, in their order

    @property
    def address(self) -> Address:
        """Where it listens."""
        host, port = self._socket.getsockname()
        return str(host), int(port)

    @property
    def dropped(self) -> int | None:
        """Datagrams that the kernel dropped as they came faster than they were taken; None where it does not say."""
        if not _LINUX:
            return None
        try:
            return struct.unpack_from("I", self._socket.getsockopt(socket.SOL_SOCKET, _MEMORY, 64), 4 * _DROPS)[0]
        except (OSError, struct.error):
            return None

    @property
    def counted(self) -> dict[str, int | None]:
        """What has gone out and come in."""
        return {
            "sent": self.sent,
            "unsent": self.unsent,
            "received": self.received,
            "dropped_by_kernel": self.dropped,
        }

    def send(self, datagram: bytes, to: Address) -> None:
        """Send a datagram; what the network refuses is counted in ``unsent``."""
        try:
            self._socket.sendto(datagram, to)
            self.sent += 1
        except OSError:
            self.unsent += 1

    def receive(self, until: float | None) -> list[bytes]:
        """Return what has come; wait for the first datagram until a time of ``time.monotonic`` (None: forever)."""
        found = self._take()
        if not found:
            left = None if until is None else until - time.monotonic()
            if left is None or left > 0:
                select.select([self._socket], [], [], left)
                found = self._take()
        return found

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def __enter__(self) -> Endpoint:
        """Be closed at the end of a block."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def _take(self) -> list[bytes]:
        found: list[bytes] = []
        self.senders = []
        with contextlib.suppress(BlockingIOError):
            for _ in range(MOST):
                try:
                    # Windows raises where a datagram is longer than what is asked for; others cut it, as this does
                    datagram, sender = self._socket.recvfrom(LARGEST_OF_ALL)
                except ConnectionError:  # a peer is not there yet: refused on POSIX, reset on Windows
                    continue
                found.append(datagram[: self._largest])
                self.senders.append(sender)
        self.received += len(found)
        return found


def free_addresses(count: int) -> list[Address]:
    """Return so many addresses of the loopback that are free now."""
    endpoints = [Endpoint(("127.0.0.1", 0)) for _ in range(count)]
    found = [endpoint.address for endpoint in endpoints]
    for endpoint in endpoints:
        endpoint.close()
    return found
