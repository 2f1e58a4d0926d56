"""The steps of a running trial, each put together from the logs of all processes.

The world reports each step to a callback, and every process appends its log lines to a file. The lines of a step are
complete ``BEHIND`` steps later, and are then combined into one row.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from taciturn.model.network import Network
from taciturn_twins.outcome import ESTIMATE, trigger_values
from taciturn_twins.trial import Setup
from taciturn_udp.namespaces import kernel_losses, predict_drops
from taciturn_udp.relay import losses

LOGS = ("sensor", "controller", "actuator", "seen")
BEHIND = 2  # number of steps after which all processes have logged a step
Row = dict[str, Any]
LINKS: tuple[str, ...] = ("sensor", "actuator")
_SENDER = {"sensor": "sensor", "actuator": "controller"}


class Steps:
    """A reader of the logs of a trial with one robot, which yields one row per step.

    Args:
        network: network of the design, which distinguishes packet losses by design from unusual ones.
        setup: configuration of the run: the seed, and whether relays or the kernel drop packets.
        length: seconds per step.
        show: function called with each row (keys of ``taciturn_twins.page.KEYS``) and a message per unusual event.
    """

    def __init__(self, network: Network, setup: Setup, length: float, show: Callable[[Row, list[str]], None]) -> None:
        """Set the state before the first step."""
        self._length, self._show = length, show
        self._designed = designed_drops(network, setup)
        self._worlds: deque[Mapping[str, Any]] = deque()
        self._lines: dict[str, dict[int, Mapping[str, Any]]] = {name: {} for name in LOGS}
        self._tails: dict[str, _Tail] = {}
        self._came: dict[str, set[int]] = {link: set() for link in LINKS}
        self._packets: dict[str, int] = dict.fromkeys(LINKS, 0)
        self._drops: dict[str, int] = dict.fromkeys(LINKS, 0)
        self._cost, self._degraded = 0.0, 0

    def start(self, folder: Path) -> None:
        """Begin to read the logs in the given folder."""
        self._tails = {name: _Tail(folder / f"{name}.jsonl") for name in LOGS}

    def add(self, line: Mapping[str, Any]) -> None:
        """Store the log line of a step of the robot, and pass on the steps for which all log lines have arrived."""
        self._worlds.append(dict(line))
        if len(self._worlds) > BEHIND:
            self._join()

    def finish(self) -> None:
        """Show the remaining steps."""
        while self._worlds:
            self._join()

    def _read(self) -> None:
        for name, tail in self._tails.items():
            for line in tail.read():
                self._lines[name][line["tick"]] = line
                if name == "actuator":
                    self._came["actuator"].update(line["arrived_actuator"])
                elif name == "seen":
                    self._came["sensor"].add(line["sequence"])

    def _join(self) -> None:
        self._read()
        world = self._worlds.popleft()
        step = world["tick"]
        lines = {name: self._lines[name].pop(step, {}) for name in LOGS}
        controller, events = lines["controller"], list[str]()
        sent: dict[str, int] = {link: lines[_SENDER[link]].get(f"sent_{link}", 0) for link in LINKS}
        arrived: dict[str, int] = dict.fromkeys(LINKS, 0)
        for link in LINKS:
            if not sent[link]:
                continue
            sequence = self._packets[link]  # packets have consecutive sequence numbers
            self._packets[link] += 1
            if sequence in self._came[link]:
                arrived[link] = 1
            elif self._designed(link, sequence, step):
                self._drops[link] += 1
            else:
                events.append(f"a packet on the {link} link did not arrive in time, which is not a loss by design")
        if lines["seen"] and lines["seen"]["seen"] is None:
            events.append("the picture shows no marker, so the estimator has no measurement")
        degraded = controller.get("degraded", 0)
        if degraded > self._degraded:
            events.append("the controller is degraded by an event that the theory excludes")
        self._degraded = degraded
        self._cost += world["cost"]
        values = trigger_values(controller)
        row = {
            "tick": step,
            "time": step * self._length,
            "state": world["from"],
            "estimate": controller.get("memory", {}).get(ESTIMATE),
            "input": world["u"],
            "trigger": values[0] if values else None,
            "threshold": values[1] if values else None,
            "sent": sent,
            "arrived": arrived,
            "packets": dict(self._packets),
            "drops": dict(self._drops),
            "cost": self._cost,
            "degraded": degraded,
        }
        self._show(row, events)


def designed_drops(network: Network, setup: Setup) -> Callable[[str, int, int], bool]:
    """Return a function that says, for a link, sequence number and step, whether the network model drops that packet.

    The function excludes faults: if an outage of a link or of the camera drops a packet, this is a drop by design only
    if the network model drops the packet too.
    """
    if setup.namespaces:
        drops = kernel_losses(network, setup.seed)
        return lambda link, sequence, step: (
            link in drops and bool(predict_drops(drops[link].seed, drops[link].permille, [sequence])[0])
        )
    fates = losses(network, setup.seed)
    return lambda link, sequence, step: fates[link].lost(sequence, step)


class _Tail:
    """A reader of the new lines of a log file."""

    def __init__(self, path: Path) -> None:
        self._path, self._at = path, 0

    def read(self) -> Iterator[Mapping[str, Any]]:
        """Yield the complete lines that were written to the file since the last call."""
        if not self._path.exists():
            return
        with self._path.open("rb") as file:
            file.seek(self._at)
            for line in file:
                if not line.endswith(b"\n"):
                    break
                self._at += len(line)
                yield json.loads(line)
