"""Logs of nodes, with one JSON line per step, and the packets of a run as these logs show them.

A node of a run writes its log in parts (``logged``): a part that is large enough gets another name as soon as the part
before it is gone. Meanwhile the run reads the lines that are complete, and deletes complete parts (``Logs.followed``),
so that a node has at most two parts on the disk, however long the run is. The lines have the times at which packets
were sent and arrived, by a clock that all processes of a machine share. So the run counts how many steps after its own
step each packet has arrived, and can record all packets (``record``).
"""

from __future__ import annotations

import json
import math
import threading
import time
from array import array
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np

from taciturn.extend import Array
from taciturn.nodes.lateness import Lateness
from taciturn.nodes.node import Measurement, Node, Values
from taciturn.nodes.packet import Packet
from taciturn.program.ops import text_of
from taciturn_udp.endpoint import Endpoint, parse_address
from taciturn_udp.service import Told

if TYPE_CHECKING:
    from taciturn_udp.processes import Processes
    from taciturn_udp.record import Record

PART = 2**20  # bytes of a part of a log, of which a node has at most two
PAUSE = 0.2  # seconds between two searches for complete lines
SOME = 8  # lines that are read at once


class Arrival(NamedTuple):
    """A data packet that has arrived at a node, as the log of the node shows it."""

    epoch: int
    sequence: int
    step: int  # of the packet
    read: int  # step that reads it
    time: float  # in seconds, of the receiver's clock
    late: int  # whole steps after the step that reads it, as far as the receiver can tell
    missed: bool  # whether the receiver had executed this step


@contextmanager
def logged(target: str | None, part: int | None = None) -> Generator[Told | None]:
    """Provide a function that writes values as JSON lines to a file, to standard output (``-``), or by UDP."""
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
    measurement: Measurement | None,
    packets: Sequence[Packet],
    given: Values | None,
    arrived: Mapping[str, Sequence[int]],
    loop: int | None,
) -> dict[str, Any]:
    """Return the log line of a step: inputs, outputs, and the sequence numbers of packets that arrived on each link."""
    line: dict[str, Any] = {
        "timestamp": node.tick * (node.policy.model.dt or 1.0),
        "tick": node.tick,
        "role": node.role,
        "epoch": node.epoch,
        "fingerprint": f"{node.fingerprint:016x}",
    }
    if loop is not None:
        line["loop"] = loop
    if measurement is not None:
        line["y"] = list(measurement)
    for link in node.program.sends:
        line[f"sent_{link}"] = int(any(packet.kind == "data" and packet.link == link for packet in packets))
    for link in node.program.hears:
        line[f"arrived_{link}"] = list(arrived.get(link, ()))
    line |= {text_of(option).replace(" ", "_"): value for option, value in node.options.items()}
    line["memory"] = node.memory
    if given is not None:
        line["u"] = list(given)
    if node.set_points is not None:
        line |= {"set_points": list(node.set_points.given), "set_points_in_effect": list(node.set_points.in_effect)}
    if node.operable:
        line["manual"] = None if node.manual is None else list(node.manual)
    line |= {"degraded": int(node.degraded), "reasons": dict(node.reasons)}
    line |= {"silent": int(node.silent), "silent_links": list(node.silent_links)}
    return line | {"waiting": node.waiting}


def packet_times(packets: Sequence[Packet], sent: float, arrivals: Mapping[str, Sequence[Arrival]]) -> dict[str, Any]:
    """Return the part of a log line about times: when packets were sent, with their numbers, and the arrivals."""
    line: dict[str, Any] = {"monotonic": sent}
    for packet in packets:
        if packet.kind == "data":
            line.setdefault(f"departures_{packet.link}", []).append([packet.epoch, packet.sequence, packet.tick])
    return line | {
        f"arrivals_{link}": [[*one[:-1], int(one.missed)] for one in came] for link, came in arrivals.items()
    }


def name_of_part(log: Path) -> Path:
    """Return the file name under which a completed part of a log is stored."""
    return log.with_name(f"{log.name}.1")


class _Log:
    """A file of JSON lines, perhaps in parts; ``logged`` describes the arguments."""

    def __init__(self, path: Path, part: int | None) -> None:
        self._path, self._part = path, part
        self._file = path.open("a", encoding="utf-8")
        if self._file.tell() and not _is_whole(path):
            print(file=self._file, flush=True)  # after the line that a killed process has left

    def write(self, line: Mapping[str, Any]) -> None:
        """Write one line to the log, and close the present part of the log if it is large enough."""
        print(json.dumps(line), file=self._file, flush=True)
        if self._part is not None and self._file.tell() >= self._part and not name_of_part(self._path).exists():
            self._file.close()
            with suppress(PermissionError):  # on Windows while the run reads this part: try again after the next line
                self._path.replace(name_of_part(self._path))
            self._file = self._path.open("a", encoding="utf-8")

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _is_whole(path: Path) -> bool:
    """Return whether a file ends with a whole line."""
    with path.open("rb") as file:
        file.seek(-1, 2)
        return file.read(1) == b"\n"


def logged_lines(log: Path) -> list[dict[str, Any]]:
    """Yield the entries of a node's log."""
    return list(_entries(log.read_text(encoding="utf-8")))


def _entries(text: str) -> Iterator[dict[str, Any]]:
    for row in text.splitlines():
        with suppress(ValueError):  # the last line of a process that was killed
            yield json.loads(row)


class _Tail:
    """The lines of a node's log, each read once, while the node writes it in parts."""

    def __init__(self, log: Path) -> None:
        self._log, self._part = log, name_of_part(log)
        self._read = 0  # bytes of the oldest part that were read

    def lines(self, ended: bool = False) -> Iterator[dict[str, Any]]:
        """Return the lines that were completed since the last call; delete the part that the node has completed.

        If the node has ended, a last line without its end is read, too.
        """
        found = ""
        if self._part.exists():
            with self._part.open("rb") as file:
                found += self._rest(file, True) + "\n"
            self._part.unlink()
            self._read = 0
        # the file does not exist between the end of a part and the beginning of the next one
        with suppress(FileNotFoundError), self._log.open("rb") as file:
            if not self._part.exists():  # else this may already be the next part
                found += self._rest(file, ended)
        return _entries(found)

    def _rest(self, file: BinaryIO, ended: bool) -> str:
        file.seek(self._read)
        content = file.read()
        whole = content if ended else content[: content.rfind(b"\n") + 1]
        self._read += len(whole)
        return whole.decode("utf-8", errors="replace")


class Logs:
    """Packets of a run, read from logs: the steps at which they were sent, and those that arrived, with their lateness.

    ``begins`` returns the time at which a step begins, by the clock that all processes share, and None before the first
    step, and in virtual time, in which the logs state how late a packet is.
    """

    def __init__(
        self,
        processes: Processes,
        begins: Callable[[int], float | None],
        tick: float | None = None,
        record: Record | None = None,
    ) -> None:
        """Start before the first line."""
        self._tails = {role: _Tail(processes.folder / f"{role}.jsonl") for role in processes.roles}
        self._ends = {link: (processes.sender(link), processes.receiver(link)) for link in processes.links}
        self._sent = {link: array("q") for link in processes.links}
        self._arrived = {link: array("q") for link in processes.links}
        self.lateness = {link: Lateness() for link in processes.links}
        self._begins, self._tick, self._record = begins, tick, record
        if record is not None:
            record.begin(begins, processes.roles)

    @contextmanager
    def followed(self) -> Generator[None]:
        """While the block runs, read the lines of the logs as they come; at its end, read the rest."""
        ended = threading.Event()

        def follow() -> None:
            while not ended.wait(PAUSE):
                self._go_on()

        reader = threading.Thread(target=follow, name="logs", daemon=True)
        reader.start()
        try:
            yield
        finally:
            ended.set()
            reader.join()
            self._go_on(ended=True)

    def sends(self, link: str, ticks: int) -> Array:
        """Return, for each step, whether the sender's log contains a packet on the link, shape (steps,)."""
        sent = np.zeros(ticks)
        steps = np.array(self._sent[link], dtype=np.int64)
        sent[steps[steps < ticks]] = 1.0
        return sent

    def arrived(self, link: str) -> tuple[int, ...]:
        """Return the sequence numbers of the packets that arrived on a link, from the receiver's log."""
        return tuple(self._arrived[link])

    def _go_on(self, ended: bool = False) -> None:
        for role, tail in self._tails.items():
            self._take(role, tail.lines(ended))
        if self._record is not None:
            self._record.write(whole=ended)

    def _take(self, role: str, lines: Iterable[dict[str, Any]]) -> None:
        sends = [link for link, (sender, _) in self._ends.items() if sender == role]
        hears = [link for link, (_, receiver) in self._ends.items() if receiver == role]
        record = self._record
        for number, line in enumerate(lines):
            if number % SOME == 0:
                time.sleep(0)  # the thread of the plant may run
            for link in sends:
                if line[f"sent_{link}"]:
                    self._sent[link].append(line["tick"])
                if record is not None:
                    record.take_sends(link, line)
            for link in hears:
                # a node does not listen to a sensor that is never queried
                self._arrived[link].extend(line.get(f"arrived_{link}", ()))
                for entry in line.get(f"arrivals_{link}", ()):
                    came = self._timed(Arrival(*entry))
                    self.lateness[link].add(came.late, bool(came.missed))
                    if record is not None:
                        record.take_arrival(link, came)
            if record is not None:
                record.reach(role, line)

    def _timed(self, came: Arrival) -> Arrival:
        """Return an arrival with its lateness by the time at which the steps begin, which its receiver estimates."""
        begun = self._begins(came.read)
        if begun is None or self._tick is None:
            return came
        return came._replace(late=max(0, math.floor((came.time - begun) / self._tick)))
