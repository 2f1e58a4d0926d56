"""Logs of nodes, with one JSON line per step, and the packets of a run as these logs show them.

A node of a run writes its log in parts (``logged``): a part that is large enough gets another name as soon as the part
before it is gone. Meanwhile the run reads complete parts and deletes them (``Logs.followed``), so that a node has at
most two parts on the disk, however long the run is.
"""

from __future__ import annotations

import json
import threading
from array import array
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from taciturn.extend import Array
from taciturn.nodes.node import Measurement, Node, Values
from taciturn.nodes.packet import Packet
from taciturn.program.ops import text_of
from taciturn_udp.endpoint import Endpoint, parse_address
from taciturn_udp.service import Told

if TYPE_CHECKING:
    from taciturn_udp.processes import Processes

PART = 2**20  # bytes of a part of a log, of which a node has at most two
PAUSE = 0.2  # seconds between two searches for complete parts


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
    arrived: Mapping[str, list[int]],
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
        line[f"arrived_{link}"] = arrived.get(link, [])
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


def name_of_part(log: Path) -> Path:
    """Return the file name under which a completed part of a log is stored."""
    return log.with_name(f"{log.name}.1")


class _Log:
    """A file of JSON lines, perhaps in parts; ``logged`` describes the arguments."""

    def __init__(self, path: Path, part: int | None) -> None:
        self._path, self._part = path, part
        self._file = path.open("a", encoding="utf-8")

    def write(self, line: Mapping[str, Any]) -> None:
        """Write one line to the log, and close the present part of the log if it is large enough."""
        print(json.dumps(line), file=self._file, flush=True)
        if self._part is not None and self._file.tell() >= self._part and not name_of_part(self._path).exists():
            self._file.close()
            self._path.replace(name_of_part(self._path))
            self._file = self._path.open("a", encoding="utf-8")

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def logged_lines(log: Path) -> list[dict[str, Any]]:
    """Yield the entries of a node's log."""
    lines: list[dict[str, Any]] = []
    for text in log.read_text(encoding="utf-8").splitlines():
        with suppress(ValueError):  # the last line of a process that was killed
            lines.append(json.loads(text))
    return lines


class Logs:
    """Packets of a run, read from logs: the steps at which they were sent, and the sequence numbers that arrived."""

    def __init__(self, processes: Processes) -> None:
        """Start before the first line."""
        self._logs = {role: processes.folder / f"{role}.jsonl" for role in processes.roles}
        self._ends = {link: (processes.sender(link), processes.receiver(link)) for link in processes.links}
        self._sent = {link: array("q") for link in processes.links}
        self._arrived = {link: array("q") for link in processes.links}

    @contextmanager
    def followed(self) -> Generator[None]:
        """While the block runs, read and delete each completed part of the logs; at its end, read the rest."""
        ended = threading.Event()

        def follow() -> None:
            while not ended.wait(PAUSE):
                self._take_parts()

        reader = threading.Thread(target=follow, name="logs", daemon=True)
        reader.start()
        try:
            yield
        finally:
            ended.set()
            reader.join()
        self._take_parts()
        for role, log in self._logs.items():
            self._take(role, logged_lines(log))

    def sends(self, link: str, ticks: int) -> Array:
        """Return, for each step, whether the sender's log contains a packet on the link, shape (steps,)."""
        sent = np.zeros(ticks)
        steps = np.array(self._sent[link], dtype=np.int64)
        sent[steps[steps < ticks]] = 1.0
        return sent

    def arrived(self, link: str) -> tuple[int, ...]:
        """Return the sequence numbers of the packets that arrived on a link, from the receiver's log."""
        return tuple(self._arrived[link])

    def _take_parts(self) -> None:
        for role, log in self._logs.items():
            part = name_of_part(log)
            if part.exists():
                self._take(role, logged_lines(part))
                part.unlink()

    def _take(self, role: str, lines: Iterable[dict[str, Any]]) -> None:
        sends = [link for link, (sender, _) in self._ends.items() if sender == role]
        hears = [link for link, (_, receiver) in self._ends.items() if receiver == role]
        for line in lines:
            for link in sends:
                if line[f"sent_{link}"]:
                    self._sent[link].append(line["tick"])
            for link in hears:
                # a node does not listen to a sensor that is never queried
                self._arrived[link].extend(line.get(f"arrived_{link}", ()))
