"""Sending and receiving of UDP datagrams; only this module of the package uses sockets."""

from __future__ import annotations

import contextlib
import select
import socket
import struct
import sys
import time
from collections.abc import Mapping, Sequence
from typing import TypeAlias

from taciturn.errors import ProblemError
from taciturn.extend import number_of

Address: TypeAlias = tuple[str, int]
LARGEST, LARGEST_OF_ALL = 4096, 65535  # largest datagram in bytes: by default (packets are shorter), and possible
BUFFER = 4 << 20  # requested size of the receive buffer in the kernel, in bytes
MOST = 128  # largest number of datagrams received per call, so that a flood does not delay a step
_LINUX = sys.platform.startswith("linux")  # other systems define the next constants differently
_FORCED = 33  # SO_RCVBUFFORCE: a larger buffer than users other than root may request
_MEMORY, _DROPS = 55, 8  # SO_MEMINFO, and the index of the dropped datagrams in its table


def parse_address(name: str, text: str, *, own: bool = False) -> Address:
    """Split ``HOST:PORT`` into a host and a port; without a host, it is 127.0.0.1."""
    host, colon, port = text.rpartition(":")
    if ":" in host or "[" in text:
        raise ProblemError(
            f"{name} is {text!r}, an IPv6 address, and IPv6 is not supported; expected HOST:PORT with a name or an "
            "IPv4 address, e.g. 127.0.0.1:9001"
        )
    least = 0 if own else 1
    digits = port.isascii() and port.isdecimal() and len(port) <= 5
    if not colon or not digits or not least <= int(port) <= 65535:
        raise ProblemError(
            f"{name} is {text!r}; expected HOST:PORT with a port from {least} to 65535, e.g. 127.0.0.1:9001"
        )
    try:
        found = socket.getaddrinfo(host or "127.0.0.1", int(port), socket.AF_INET, socket.SOCK_DGRAM)
    except (OSError, ValueError) as error:  # a UnicodeError is a ValueError: a label of more than 63 letters
        raise ProblemError(
            f"{name}: the host {host!r} is unknown ({error}); expected a name or an IPv4 address"
        ) from None
    address = found[0][4]
    return str(address[0]), int(address[1])


def parse_peers(name: str, given: Sequence[str] | None) -> Address | dict[str, Address] | None:
    """Convert ``HOST:PORT`` to one address, or ``LINK=HOST:PORT`` texts to an address per link; None without text."""
    if not given:
        return None
    if len(given) == 1 and "=" not in given[0]:
        return parse_address(name, given[0])
    found: dict[str, Address] = {}
    for text in given:
        link, equals, address = text.partition("=")
        if not equals or link in found:
            raise ProblemError(
                f"{name} is {text!r}{' again' if equals else ''}; expected one LINK=HOST:PORT for each link"
            )
        found[link] = parse_address(f"{name} {link}", address)
    return found


def peers_by_link(name: str, given: Address | Mapping[str, Address] | None, links: Sequence[str]) -> dict[str, Address]:
    """Return the address of the receiver on each link on which a process sends, from one address or one per link."""
    if given is None and links:
        raise ProblemError(f"--peer is missing, but {name} sends packets; expected HOST:PORT of their receiver")
    if given and not links:
        raise ProblemError(f"--peer is given, but {name} sends packets on no link; expected no --peer: remove it")
    if not isinstance(given, Mapping):
        if len(links) > 1:
            raise ProblemError(
                f"--peer gives only one address, but {name} sends on {number_of(len(links), 'link')}; expected "
                f"{', '.join(f'{link}=HOST:PORT' for link in links)}"
            )
        return {} if given is None else dict.fromkeys(links, given)
    for link in [*given, *links]:
        if link not in given or link not in links:
            raise ProblemError(
                f"--peer {'names' if link in given else 'has no address for'} the link {link!r}; expected the links "
                f"on which {name} sends: {', '.join(links) or 'none'}"
            )
    return dict(given)


def check_plant(name: str, given: Address | None, needed: bool) -> None:
    """Raise an error if the plant's address is missing where it is needed, or is given where it is not."""
    if needed and given is None:
        raise ProblemError(
            f"--plant is missing, but {name} exchanges packets with the plant; expected HOST:PORT of the plant"
        )
    if given is not None and not needed:
        raise ProblemError(
            f"--plant is given, but {name} neither measures nor applies inputs; expected no --plant: remove it"
        )


def hosts_of(*places: Address | Mapping[str, Address] | None) -> list[str]:
    """Return the hosts of addresses."""
    found = [place.values() if isinstance(place, Mapping) else [place] for place in places if place is not None]
    return [host for addresses in found for host, _ in addresses]


class Endpoint:
    """A bound UDP socket.

    Args:
        bind: address to listen on; with port 0, the system chooses a free port.
        largest: largest number of bytes read of a datagram; a longer one is truncated, and so rejected as a packet.

    Raises:
        ProblemError: the address is in use, or does not belong to this machine.
    """

    def __init__(self, bind: Address, largest: int = LARGEST) -> None:
        """Open and bind the socket."""
        self._largest = largest
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        for option in (socket.SO_RCVBUF, *((_FORCED,) if _LINUX else ())):  # only root may set the second
            with contextlib.suppress(OSError):
                self._socket.setsockopt(socket.SOL_SOCKET, option, BUFFER)
        try:
            self._socket.bind(bind)
        except OSError as error:
            self._socket.close()
            raise ProblemError(
                f"the address {bind[0]}:{bind[1]} cannot be bound ({error.strerror}); expected a free port of this "
                "machine: is another node running there?"
            ) from None
        self._socket.setblocking(False)
        self.sent, self.received, self.unsent = 0, 0, 0
        self.senders: list[Address] = []  # senders of the last received datagrams, in the same order

    @property
    def address(self) -> Address:
        """The address at which the socket receives."""
        host, port = self._socket.getsockname()
        return str(host), int(port)

    @property
    def dropped(self) -> int | None:
        """Number of datagrams that the kernel dropped because its buffer was full; None if unknown."""
        if not _LINUX:
            return None
        try:
            return struct.unpack_from("I", self._socket.getsockopt(socket.SOL_SOCKET, _MEMORY, 64), 4 * _DROPS)[0]
        except (OSError, struct.error):
            return None

    @property
    def counted(self) -> dict[str, int | None]:
        """Numbers of datagrams that were sent, not sent, received, and dropped by the kernel."""
        return {
            "sent": self.sent,
            "unsent": self.unsent,
            "received": self.received,
            "dropped_by_kernel": self.dropped,
        }

    def send(self, datagram: bytes, to: Address) -> None:
        """Send a datagram; if the network rejects it, count it in ``unsent``."""
        try:
            self._socket.sendto(datagram, to)
            self.sent += 1
        except OSError:
            self.unsent += 1

    def receive(self, until: float | None) -> list[bytes]:
        """Return received datagrams; wait for the first one until the monotonic time ``until``, if it is given."""
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
        """Return the endpoint, which is closed at the end of the ``with`` block."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the socket."""
        self.close()

    def _take(self) -> list[bytes]:
        found: list[bytes] = []
        self.senders = []
        with contextlib.suppress(BlockingIOError):
            for _ in range(MOST):
                try:
                    # read the largest size, as Windows raises an error for a longer datagram instead of truncating it
                    datagram, sender = self._socket.recvfrom(LARGEST_OF_ALL)
                except ConnectionError:  # no process listens at a peer: refused on POSIX, reset on Windows
                    continue
                found.append(datagram[: self._largest])
                self.senders.append(sender)
        self.received += len(found)
        return found


def free_addresses(count: int) -> list[Address]:
    """Return ``count`` addresses of this machine (127.0.0.1) whose ports are free at present."""
    endpoints = [Endpoint(("127.0.0.1", 0)) for _ in range(count)]
    found = [endpoint.address for endpoint in endpoints]
    for endpoint in endpoints:
        endpoint.close()
    return found
