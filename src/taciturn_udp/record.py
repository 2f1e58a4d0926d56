"""Record of a run in a folder: all packets in ``packets.csv``, and the signals of all steps in ``signals.csv``.

| column of ``packets.csv`` | meaning |
|---|---|
| `time` | seconds from the beginning of step 0 to the event; of a dropped packet, until it was sent |
| `step`, `link` | step and link of the packet |
| `event` | `sent`, `delivered`, `late` (delivered after the step that reads the packet, `lateness`) or `lost` |
| `delay` | seconds from sending to arrival |
| `bytes` | bytes of the datagram |
| `trigger` | value of silence in the decision to send, as in ``simulate``; empty if no signal decides |

A row of ``signals.csv`` has the measurement and the input of a step, and the set-points of the simulated plant, with
the names of ``taciturn simulate --table``. In virtual time, times are those of the steps, and delays those that the
links draw. If a node has sent a packet again, its first sending and its first arrival count.

The rows come from the logs of the nodes, which the run reads meanwhile (``logs``), so a node does no further
work. A packet without an arrival waits in a table of at most ``WIDTH`` packets for each link, as its receiver refuses
older ones. Rows are held back until the logs of all nodes have reached their time, then sorted, and written as whole
lines in one call.
"""

from __future__ import annotations

import csv
import errno
import io
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias, cast

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Array, quoted, why_unreadable
from taciturn.loop import Loop
from taciturn.model.packets import packet_shapes
from taciturn.model.steps import Send
from taciturn.nodes.inbox import WIDTH
from taciturn.nodes.node import Measurement
from taciturn.nodes.packet import Packet, Wire
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn.program.ops import Option, text_of
from taciturn_udp.logs import Arrival

PACKETS, SIGNALS = "packets.csv", "signals.csv"
HEAD = ("time", "step", "link", "event", "delay", "bytes", "trigger")
HELD = 4096  # largest number of rows that wait for the log of a node
SOME = 64  # rows that are written at once; between them, the thread of the plant may run
EVENTS = ("sent", "delivered", "late", "lost")
Cell: TypeAlias = float | int | str | None
Lost: TypeAlias = Callable[[int, int], bool]  # whether a link drops the packet of a sequence number and a step
Drawn: TypeAlias = Callable[[int, int], float | None]  # its random delay in seconds; None if it never arrives


@dataclass(frozen=True)
class _Sent:
    """A packet that was sent."""

    time: float
    step: int


class Record:
    """Files of a record, which a run fills."""

    # ``tick`` is the duration of a step in real time, None in virtual time. ``lost`` has functions that tell whether a
    # link drops a packet; a packet of another link is lost if it does not arrive. ``drawn`` has functions that tell the
    # delays that links draw in virtual time, in which packets arrive with the steps.

    def __init__(
        self,
        folder: Path,
        loop: Loop,
        wire: Wire,
        tick: float | None,
        lost: Mapping[str, Lost],
        drawn: Mapping[str, Drawn] | None = None,
    ) -> None:
        """Create the files, with their headers."""
        self.folder, self._real, self._lost, self._drawn = folder, tick is not None, lost, drawn or {}
        policy = loop.policy
        self._period, self._loop = policy.model.dt or 1.0, loop
        laws, period = policy.network.links, self._period
        self._waits = {link: law.wait.periods(period) * period for link, law in laws.items()}
        self._begins: Callable[[int], float | None] = lambda step: None
        shapes = packet_shapes(policy, loop.network)
        self._bytes, self._triggers = dict[str, int](), dict[str, tuple[str, ...]]()
        for step in policy.steps:
            if isinstance(step, Send):
                self._triggers[step.link] = _silent_options(loop, step)
                numbers = (0.0,) * shapes["data", step.link][1]
                self._bytes[step.link] = len(wire.encode(Packet("data", step.link, 0, 0, numbers)))
        links = self._bytes
        self._roads = {link: dict[tuple[int, int], _Sent]() for link in links}  # packets without an arrival, by number
        self._early = {link: list[Arrival]() for link in links}  # arrivals before the log of the sender was read
        self._rows, self._signals = list[tuple[Cell, ...]](), list[tuple[Cell, ...]]()
        self._reached = dict[str, float]()
        self._trouble: OSError | None = None
        self._empty = True
        self._files = _create(folder, {PACKETS: HEAD, SIGNALS: signal_names(loop)})

    def begin(self, begins: Callable[[int], float | None], roles: Sequence[str]) -> None:
        """Take the beginning of each step, and the nodes whose logs follow."""
        self._begins = begins
        self._reached = dict.fromkeys(roles, -np.inf)

    def watch(self, plant: SimulatedPlant, clock: Callable[[], float] = time.monotonic) -> RecordedPlant:
        """Return the plant with a record of its signals, at the times that a clock shows."""
        return RecordedPlant(plant, self, clock)

    def take_signals(self, at: float, step: int, measurement: Measurement, inputs: Sequence[float]) -> None:
        """Record the signals of a step that began at a time of the system."""
        time_of = self._time(at, step)
        p = self._loop.policy.model.sensed
        u = _applied(self._loop, np.array(inputs, dtype=np.float64))
        self._signals.append((time_of, step, *measurement[:p], *u.tolist(), *measurement[p:]))

    def take_sends(self, link: str, line: Mapping[str, Any]) -> None:
        """Record the packets on a link that a line of the sender's log names."""
        for epoch, sequence, step in line.get(f"departures_{link}", ()):
            sent = _Sent(self._time(line["monotonic"], step), step)
            values = [line[name] for name in self._triggers[link] if name in line]
            trigger = min(values) if values and step == line["tick"] else None
            self._add(sent, link, "sent", trigger=trigger)
            foreseen = self._lost.get(link)
            if foreseen is not None and foreseen(sequence, step):
                self._add(sent, link, "lost")
                continue
            road = self._roads[link]
            road[epoch, sequence] = sent
            while len(road) > WIDTH:
                self._add(road.pop(next(iter(road))), link, "lost")

    def take_arrival(self, link: str, came: Arrival) -> None:
        """Record a packet that has arrived, as the log of the receiver and the beginning of the steps show it."""
        if (came.epoch, came.sequence) in self._roads[link]:
            self._arrive(link, came)
        else:  # the log of the sender is read next, unless its process was killed before it wrote the line
            self._early[link].append(came)

    def reach(self, role: str, line: Mapping[str, Any]) -> None:
        """Take up that the log of a node was read up to a line."""
        self._reached[role] = self._time(line["monotonic"], line["tick"])

    def write(self, whole: bool = False) -> None:
        """Write all rows before the time that all logs have reached; ``whole``: all rows."""
        self._match(whole)
        rows = sorted(self._rows, key=_order)
        until = np.inf if whole else min(self._reached.values(), default=np.inf)
        free = sum(_order(row)[0] < until for row in rows)
        free = max(free, len(rows) - HELD)
        self._rows = rows[free:]
        signals = self._signals[:]  # the plant may append further ones meanwhile
        del self._signals[: len(signals)]
        self._put(PACKETS, rows[:free])
        self._put(SIGNALS, signals)

    def finish(self, pending: Mapping[str, int]) -> tuple[str, ...]:
        """Record as lost what has not arrived, except packets on the way; return notes on what is not recorded."""
        self._match()
        for link, road in self._roads.items():
            left = list(road.values())
            for sent in left[: len(left) - pending.get(link, 0)]:
                self._add(sent, link, "lost")
            road.clear()
        self.write(whole=True)
        if self._trouble is None:
            return ()
        return (f"the record {quoted(str(self.folder))} is not complete: {why_unreadable(self._trouble)}",)

    def close(self) -> None:
        """Write all rows, and close the files; delete them if the run has not begun."""
        self.write(whole=True)
        for name, file in self._files.items():
            file.close()
            if self._empty:
                (self.folder / name).unlink(missing_ok=True)

    def _match(self, whole: bool = False) -> None:
        """Record the arrivals whose packets the log of the sender now has; ``whole``: also the others."""
        for link, arrivals in self._early.items():
            known = [came for came in arrivals if (came.epoch, came.sequence) in self._roads[link]]
            for came in known:
                arrivals.remove(came)
                self._arrive(link, came)
            while arrivals and (whole or len(arrivals) > WIDTH):
                self._arrive(link, arrivals.pop(0))

    def _time(self, at: float, step: int) -> float:
        begun = self._begins(0) if self._real else None
        return step * self._period if begun is None else at - begun

    def _arrive(self, link: str, came: Arrival) -> None:
        sent = self._roads[link].pop((came.epoch, came.sequence), None)
        event = "late" if came.late > 0 or came.missed else "delivered"
        at = self._time(came.time, came.step)
        delay = None if sent is None else at - sent.time
        if not self._real:
            drawn = self._drawn.get(link)
            after = None if drawn is None else drawn(came.sequence, came.step)
            # the simulated plant shows the constant delay of a link; another packet takes whole steps
            waited = self._waits.get(link, 0.0) + came.late * self._period if after is None else after
            at, delay = at + waited, None if sent is None else waited
        self._add(_Sent(at, came.step), link, event, delay)

    def _add(self, at: _Sent, link: str, event: str, delay: Cell = None, trigger: Cell = None) -> None:
        self._rows.append((at.time, at.step, link, event, delay, self._bytes[link], trigger))

    def _put(self, name: str, rows: Sequence[Sequence[Cell]]) -> None:
        file = self._files[name]
        if not rows or file.closed or self._trouble is not None:
            return
        self._empty = False
        try:
            for first in range(0, len(rows), SOME):
                content, place = _text(rows[first : first + SOME]), file.tell()
                if file.write(content) < len(content):
                    file.truncate(place)
                    raise OSError(errno.ENOSPC, "the disk is full")
        except OSError as error:  # must not end the run
            self._trouble = error


class RecordedPlant:
    """A simulated plant that records its signals."""

    def __init__(self, plant: SimulatedPlant, record: Record, clock: Callable[[], float]) -> None:
        """Start before the first step."""
        self._plant, self._record, self._clock = plant, record, clock
        self._began: float | None = None  # when the present step was measured first

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return self._plant.inputs

    @property
    def tick_length(self) -> float:
        """Sampling period in seconds; 1 if the problem does not give one."""
        return self._plant.tick_length

    @property
    def measurement(self) -> Measurement:
        """Measurement y at the present step, shape (p,)."""
        if self._began is None:
            self._began = self._clock()
        return self._plant.measurement

    @property
    def state(self) -> Array:
        """State x, (n,)."""
        return self._plant.state

    def move(self, inputs: Sequence[float]) -> float:
        """Apply these inputs to the plant for one step, record it, and return the cost of the step."""
        step, measured, began = self._plant.tick, self._plant.measurement, self._began
        cost = self._plant.move(inputs)
        self._record.take_signals(self._clock() if began is None else began, step, measured, inputs)
        self._began = None
        return cost


def signal_names(loop: Loop) -> tuple[str, ...]:
    """Return the columns of ``signals.csv``."""
    model = loop.policy.model
    return (
        "time",
        "step",
        *(f"y{i + 1}" for i in range(model.sensed)),
        *(f"u{i + 1}" for i in range(len(_applied(loop, np.zeros(loop.in_units.problem.plant.inputs))))),
        *(f"set_point{i + 1}" for i in range(model.outputs - model.sensed)),
    )


def _applied(loop: Loop, inputs: Array) -> Array:
    """Return the input u: if the actuator integrates a model, of whose state it is a multiple, as ``simulate`` does."""
    model, point = loop.policy.prediction, loop.problem.plant.operating_point
    if model is None:
        return inputs
    u = (inputs if point is None else inputs - point.x) @ model.L.T
    own = None if loop.problem.source is None else loop.problem.source.operating_point
    return u if own is None else u + own.u


def _silent_options(loop: Loop, step: Send) -> tuple[str, ...]:
    """Return the names in a log of the options without a packet; none if no signal decides about the packet."""
    policy = loop.policy
    if step.on is None or not policy.decisions[step.on].reads:
        return ()
    labels = policy.decisions[step.on].labels
    sending = step.sending(labels)
    return tuple(text_of(Option(step.on, label)).replace(" ", "_") for label in labels if label not in sending)


def _order(row: Sequence[Cell]) -> tuple[float, int, str, int]:
    """Return the place of an event in the record, which in virtual time does not depend on when logs were read."""
    at, step, link, event = cast("tuple[float, int, str, str]", tuple(row[:4]))
    return at, step, link, EVENTS.index(event)


def _text(rows: Sequence[Sequence[Cell]]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)  # numbers with all digits
    return text.getvalue().encode()


def _create(folder: Path, heads: Mapping[str, Sequence[str]]) -> dict[str, BinaryIO]:
    """Create the files of a record, each with its first line; they are not buffered."""
    shown = quoted(str(folder))
    if folder.exists() and not folder.is_dir():
        raise ProblemError(f"the record {shown} is a file; expected a folder, or the name of a new one")
    for name in heads:
        path = folder / name
        if path.exists() and (not path.is_file() or path.stat().st_size):
            raise ProblemError(
                f"the folder {shown} already contains {name}; expected a folder without a record: name another one, "
                "or delete the record"
            )
    files = dict[str, BinaryIO]()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, head in heads.items():
            files[name] = (folder / name).open("wb", buffering=0)
            files[name].write(_text([head]))
    except OSError as error:
        for file in files.values():
            file.close()
        raise ProblemError(
            f"the record {shown} cannot be written ({why_unreadable(error)}); expected a writable folder"
        ) from None
    return files
