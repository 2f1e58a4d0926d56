"""Logs of the nodes of a run, which are read and deleted in parts while the nodes run."""

from __future__ import annotations

import json
import threading
from array import array
from collections.abc import Generator, Iterable
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from taciturn._arrays import Array
from taciturn.runtime.processes import Processes
from taciturn.runtime.service import name_of_part

PART = 2**20  # bytes of a part of a log, of which a node has at most two
PAUSE = 0.2  # seconds between two searches for complete parts


def logged_lines(log: Path) -> list[dict[str, Any]]:
    """Return the entries of a node's log."""
    lines: list[dict[str, Any]] = []
    for text in log.read_text(encoding="utf-8").splitlines():
        with suppress(ValueError):  # the last line of a process that was killed
            lines.append(json.loads(text))
    return lines


class Logs:
    """The packets of a run: the steps in which they were sent, and the sequence numbers of those that arrived.

    Args:
        processes: the nodes, whose logs are ``ROLE.jsonl`` in their folder; a complete part is ``ROLE.jsonl.1``.
    """

    def __init__(self, processes: Processes) -> None:
        """Start before the first line."""
        self._logs = {role: processes.folder / f"{role}.jsonl" for role in processes.roles}
        self._ends = {link: (processes.sender(link), processes.receiver(link)) for link in processes.links}
        self._sent = {link: array("q") for link in processes.links}
        self._arrived = {link: array("q") for link in processes.links}

    @contextmanager
    def followed(self) -> Generator[None]:
        """Read and delete complete parts of the logs while the block runs, and the rest of the logs at its end."""
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
        """Return whether a packet was sent at each step, according to the log of the sender, (steps,)."""
        sent = np.zeros(ticks)
        steps = np.array(self._sent[link], dtype=np.int64)
        sent[steps[steps < ticks]] = 1.0
        return sent

    def arrived(self, link: str) -> tuple[int, ...]:
        """Return the sequence numbers of the packets that arrived, according to the log of the receiver."""
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
