"""Functions that all network processes share: printing of the address, the log of steps, and the end on request."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Protocol, TypeAlias

from taciturn._files import delete_parts, read_bytes, why_unreadable, write_whole
from taciturn.errors import ProblemError
from taciturn.model.policy import Policy
from taciturn.model.wire import HEADER_SIZE, OFFSETS, VERSION
from taciturn.program.names import text_of
from taciturn.runtime.node import Node, Values
from taciturn.runtime.packet import Packet
from taciturn.runtime.udp import Address, Endpoint, parse_address

Turns: TypeAlias = Generator[float, Sequence[bytes], None]
Told: TypeAlias = Callable[[Mapping[str, Any]], None]
Say: TypeAlias = Callable[[str], None]
LISTENS = "listens on"  # text of the first message of a process, for which its parent process waits
IDLE = 0.25  # seconds between checks for a stop request
WAIT = 0.3, 0.55  # default fractions of a step for which controller and actuators wait
LARGEST = 2**26  # bytes of a saved state
QUIET = 0.05  # seconds without datagrams after which no more are expected


def say_where(name: str, address: Address) -> None:
    """Print to standard error the address that a process listens on."""
    say(f"the {name} {LISTENS} {address[0]}:{address[1]}")


def say(sentence: str) -> None:
    """Print a message to standard error."""
    print(f"taciturn: {sentence}", file=sys.stderr, flush=True)


def disagreement(name: str, why: str, keyed: bool, sender: Address, datagram: bytes) -> str | None:
    """Return a message if a datagram is rejected because the sender has another policy, key or release, else None."""
    version = datagram[OFFSETS["version"]] if len(datagram) > HEADER_SIZE else VERSION
    if why == "foreign" and version != VERSION:
        return (
            f"the {name} refuses packets of version {version} of the wire format from {sender[0]}:{sender[1]}; "
            f"expected version {VERSION}: run the same release of taciturn on both sides, and export firmware again"
        )
    others = {"foreign": "of another policy, or with a key on one side only,", "forged": "of another key"}
    others |= {"malformed": "too short for the tag of a key"} if keyed else {}
    if why not in others:
        return None
    return f"the {name} refuses packets {others[why]} from {sender[0]}:{sender[1]}: same problem file and --key?"


class Port(Protocol):
    """Interface of the socket of a server: ``taciturn.runtime.udp.Endpoint``, or one in virtual time."""

    received: int
    senders: list[Address]

    @property
    def address(self) -> Address:
        """The address that the socket listens on."""
        ...

    @property
    def counted(self) -> dict[str, int | None]:
        """The counters of datagrams sent and received."""
        ...

    def send(self, datagram: bytes, to: Address) -> None:
        """Send a datagram."""
        ...

    def receive(self, until: float | None) -> list[bytes]:
        """Return the received datagrams; wait for the first one until a time of the server's clock."""
        ...


class Storage(Protocol):
    """A place that keeps the state of a node while its process does not run."""

    def read(self) -> bytes | None:
        """Return the saved state, or None if there is none."""
        ...

    def write(self, state: bytes) -> None:
        """Replace the saved state, completely or not at all."""
        ...


class FileStorage:
    """A saved state in a file.

    Args:
        path: the file.

    Raises:
        ProblemError: the folder of the file does not exist.
    """

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
        """Return the content of the file, or None if it does not exist."""
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
    """Return the fraction of a step for which a node waits; the controller sends before its receivers act."""
    return WAIT[role != policy.network.controller]


def drive(port: Port, turns: Turns) -> None:
    """Run a server, which yields the time until which it waits for datagrams, and is sent those that arrive."""
    found: Sequence[bytes] | None = None
    try:
        while True:
            found = port.receive(next(turns) if found is None else turns.send(found))
    except StopIteration:
        return


def take_until(endpoint: Port, take: Callable[[Sequence[bytes]], object], stopped: Callable[[], bool]) -> None:
    """Receive datagrams until stopped, and then those that were sent before the stop."""
    while not stopped():
        take(endpoint.receive(time.monotonic() + IDLE))
    while found := endpoint.receive(time.monotonic() + QUIET):
        take(found)


@contextmanager
def logged(target: str | None, part: int | None = None) -> Generator[Told | None]:
    """Yield a function that writes JSON lines to a file, to standard output (``-``), or to ``udp://HOST:PORT``.

    Args:
        target: the file, ``-``, or ``udp://HOST:PORT``; None for no log.
        part: size in bytes at which a file is renamed to ``name_of_part`` and a new file begins, so that another
            process can read and delete it; the file grows further while the previous part still exists.
    """
    if target is None:
        yield None
    elif target.startswith("udp://"):
        to = parse_address("--log", target.removeprefix("udp://"))
        with Endpoint(("0.0.0.0", 0)) as endpoint:
            yield lambda line: endpoint.send(json.dumps(line).encode(), to)
    elif target == "-":
        yield lambda line: print(json.dumps(line), flush=True)
    else:
        with closing(_Log(Path(target), part)) as log:
            yield log.write


def log_line(
    node: Node,
    measurement: Values | None,
    packets: Sequence[Packet],
    given: Values | None,
    arrived: Mapping[str, list[int]],
    loop: int | None,
) -> dict[str, Any]:
    """Return the log line of a step: its inputs and outputs, and the sequence numbers that have arrived by link."""
    line: dict[str, Any] = {
        "timestamp": node.tick * (node.policy.model.dt or 1.0),
        "tick": node.tick,
        "role": node.role,
    }
    if loop is not None:
        line["loop"] = loop
    if measurement is not None:
        line["y"] = list(measurement)
    for link in node.program.sends:
        line[f"sent_{link}"] = int(any(packet.kind == "data" and packet.link == link for packet in packets))
    for link in node.program.hears:
        line[f"arrived_{link}"] = arrived.get(link, [])
    line |= {text_of(option).replace(" ", "_"): value for option, value in node.options.items()}
    line["memory"] = node.memory
    if given is not None:
        line["u"] = list(given)
    line |= {"degraded": int(node.degraded), "reasons": dict(node.reasons)}
    line |= {"silent": int(node.silent), "silent_links": list(node.silent_links)}
    return line | {"waiting": node.waiting}


def name_of_part(log: Path) -> Path:
    """Return the name of the complete part of a log."""
    return log.with_name(f"{log.name}.1")


class _Log:
    """A file of JSON lines, perhaps in parts; ``logged`` describes the arguments."""

    def __init__(self, path: Path, part: int | None) -> None:
        self._path, self._part = path, part
        self._file = path.open("a", encoding="utf-8")

    def write(self, line: Mapping[str, Any]) -> None:
        """Write one line to the log, and complete the current part of the log if it is large enough."""
        print(json.dumps(line), file=self._file, flush=True)
        if self._part is not None and self._file.tell() >= self._part and not name_of_part(self._path).exists():
            self._file.close()
            self._path.replace(name_of_part(self._path))
            self._file = self._path.open("a", encoding="utf-8")

    def close(self) -> None:
        """Close the file."""
        self._file.close()
