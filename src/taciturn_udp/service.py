"""Parts that all servers share: messages, sockets, stored states, and waiting for datagrams."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeAlias

from taciturn.errors import ProblemError
from taciturn.extend import delete_parts, read_bytes, why_unreadable, write_whole
from taciturn.model.policy import Policy
from taciturn_udp.endpoint import Address

Turns: TypeAlias = Generator[float, Sequence[bytes], None]
Told: TypeAlias = Callable[[Mapping[str, Any]], None]
Say: TypeAlias = Callable[[str], None]
LISTENS = "listens on"  # text of the first message of a process, for which its parent process waits
IDLE = 0.25  # seconds between checks for a stop request
WAIT = 0.3, 0.55  # default fractions of a step for which controller and actuators wait
LARGEST = 2**26  # bytes of a saved state
QUIET = 0.05  # seconds without datagrams after which no more are expected


def say_where(name: str, address: Address) -> None:
    """Print, to standard error, the address at which a process receives."""
    say(f"the {name} {LISTENS} {address[0]}:{address[1]}")


def say(sentence: str) -> None:
    """Print a message to standard error."""
    print(f"taciturn: {sentence}", file=sys.stderr, flush=True)


class Port(Protocol):
    """Interface of a server's socket: a UDP socket (``taciturn_udp.endpoint.Endpoint``) or one in virtual time."""

    received: int
    senders: list[Address]

    @property
    def address(self) -> Address:
        """The address at which the socket receives."""
        ...

    @property
    def counted(self) -> dict[str, int | None]:
        """Numbers of datagrams that the socket has sent and received."""
        ...

    def send(self, datagram: bytes, to: Address) -> None:
        """Send a datagram."""
        ...

    def receive(self, until: float | None) -> list[bytes]:
        """Return received datagrams; wait for the first one until the server's clock shows ``until``."""
        ...


class Storage(Protocol):
    """Interface of a storage for a node's state, from which the node continues after a restart."""

    def read(self) -> bytes | None:
        """Return the stored state; None if no state is stored."""
        ...

    def write(self, state: bytes) -> None:
        """Replace the stored state at once, so that an interruption leaves either the old or the new state."""
        ...


class FileStorage:
    """Storage of a node's state in a file."""

    def __init__(self, path: Path) -> None:
        """Check that the folder exists, and delete incomplete files, which a killed process has left."""
        if not path.parent.is_dir():
            raise ProblemError(
                f"the state cannot be saved in {path.parent}, which is not a folder; expected an existing folder"
            )
        self._path = path
        delete_parts(path)

    def __str__(self) -> str:
        """Return the name of the file."""
        return str(self._path)

    def read(self) -> bytes | None:
        """Return the contents of the file; None if the file does not exist."""
        try:
            return read_bytes(self._path, LARGEST)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise ProblemError(
                f"the saved state {self._path} cannot be read ({why_unreadable(error)}); expected a saved state of "
                "this node"
            ) from None

    def write(self, state: bytes) -> None:
        """Write the file atomically."""
        write_whole(self._path, state)


def usual_wait(policy: Policy, role: str) -> float:
    """Return how long a node waits for packets, as a fraction of a step; the controller waits less than the others."""
    return WAIT[role != policy.network.controller]


def drive(port: Port, turns: Turns) -> None:
    """Run a server: receive datagrams until the time that the generator ``turns`` yields, and send them to it."""
    found: Sequence[bytes] | None = None
    try:
        while True:
            found = port.receive(next(turns) if found is None else turns.send(found))
    except StopIteration:
        return


def take_until(endpoint: Port, take: Callable[[Sequence[bytes]], object], stopped: Callable[[], bool]) -> None:
    """Receive datagrams until the server is stopped, and then those that were sent before the stop."""
    while not stopped():
        take(endpoint.receive(time.monotonic() + IDLE))
    while found := endpoint.receive(time.monotonic() + QUIET):
        take(found)
