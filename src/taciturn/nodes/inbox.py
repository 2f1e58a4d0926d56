"""Handling of the packets that arrive at a node. Each case, such as a late or repeated packet, is counted.

| packet | counter and handling |
|---|---|
| belongs to the step that reads it | `used`: the case that the theory assumes |
| belongs to a later step | waits for its step; dropped as `ahead` if it is more than `AHEAD` steps early |
| belongs to an earlier step | `late`: with packet drops, it is treated as dropped; on an ideal network, the next step uses it if it is newer than every packet that a step has read |
| has arrived before | `duplicate`, dropped |
| belongs to an earlier epoch, or is far behind the newest packet | `replayed`, dropped |
| belongs to another loop or link | `misdirected`, dropped |
| is older than another packet of the same step, or waits while a later epoch begins | `superseded`, dropped |
| is a mark: its sender is running and has finished a step | `marks` |
| has set-points of a simulated plant, although an operator has given others | `overruled`, dropped |
| comes over a link with random delays | waits for the step in which it arrives; the newest one is `used`, an older one `superseded`, unless the node uses all packets |

An operator does not know the number of the step. So the set-points and manual inputs of an operator take effect in the
next step, and of two packets that arrive before it, the later one by its sequence number; an earlier one is
`superseded`.

The counter `received` is the sum of all other counters and the number of waiting packets. Whether a packet is new is
decided by a window over the sequence numbers of its sender, as in IPsec [rfc4303].

On a link with random delays, a packet has the number of pieces of a period after which it arrives (``Packet.late``), and
so has its acknowledgement. The step that hears it takes for each piece the newest packet that has arrived, with its
age, and acknowledges all packets that are newer than those of earlier steps. A node that uses all packets, such as a
filter that includes each measurement at its own step, takes one for each age; an older packet is `late`.
"""  # noqa: E501  # the rows of a ta"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

from taciturn._display import Displayed
from taciturn.errors import ProblemError
from taciturn.model.wire import BACK, LARGEST, SETPOINT, fits
from taciturn.nodes.packet import Packet
from taciturn.program.late import NEVER
from taciturn.program.node import Arrival

WIDTH = 1024  # width of the window in sequence numbers
News: TypeAlias = Literal["new", "duplicate", "replayed"]
AHEAD = 64  # largest number of steps by which a packet may be early
Handling: TypeAlias = Literal["misdirected", "duplicate", "replayed", "superseded", "ahead", "marks", "waiting", "late"]
LATE_ANSWER = "late acknowledgement"  # which degrades a node
OPERATOR = "setpoint", SETPOINT  # kind and link of an operator's packets with set-points
BY_HAND = "manual", SETPOINT  # and of those with manual inputs
USABLE: frozenset[Handling] = frozenset({"marks", "waiting", "late"})  # the packet shows that its sender is running


class Window:
    """Record of the sequence numbers received from one sender, to detect repeated and missing packets."""

    # The first packet of a later epoch clears the window. A packet is a replay if it belongs to an earlier epoch, or is
    # behind the newest packet by the width of the window or more.

    def __init__(self) -> None:
        """Start with an empty window."""
        self.epoch, self.newest, self.seen, self.distinct = -1, -1, 0, 0

    @property
    def missing(self) -> int:
        """Number of packets in this epoch, up to the newest one, that have not arrived, because they are late or
        dropped.
        """
        return self.newest + 1 - self.distinct

    def admit(self, epoch: int, sequence: int) -> News:
        """Record a packet, and return whether it is new, a repetition, or too old to tell."""
        if epoch < self.epoch:
            return "replayed"
        if epoch > self.epoch:
            self.epoch, self.newest, self.seen, self.distinct = epoch, -1, 0, 0
        behind = self.newest - sequence
        if behind < 0:
            self.seen = 1 if -behind >= WIDTH else (self.seen << -behind | 1) & ((1 << WIDTH) - 1)
            self.newest = sequence
        elif behind >= WIDTH:
            return "replayed"
        elif self.seen >> behind & 1:
            return "duplicate"
        else:
            self.seen |= 1 << behind
        self.distinct += 1
        return "new"

    def save(self) -> list[int]:
        """Return the record as a list of numbers, to save it."""
        return [self.epoch, self.newest, self.seen, self.distinct]

    def restore(self, saved: list[int]) -> None:
        """Continue from a saved record."""
        self.epoch, self.newest, self.seen, self.distinct = saved


@dataclass(repr=False)
class Stream(Displayed):
    """All packets of one kind that a node receives on one link."""

    lag: int  # number of steps between the step of a packet and the step that reads it
    at: int  # index of the first of its inputs of the node: whether a packet arrived, followed by the payload
    size: int  # number of entries of the payload
    part: int  # part of the step that reads the packets
    pieces: int = 0  # if delays are random: the pieces of a step, in each of which a packet may arrive; otherwise 0
    ages: int = 0  # and of acknowledgements, the number of ages of packets whose arrival is told
    every: int = 0  # and if the node uses all packets, the number of ages, for each of which the inputs contain one
    kept: bool = False  # whether the last payload remains in effect until another packet arrives, as for set-points
    ordered: bool = False  # whether packets take effect at once, in the order of their sequence numbers
    window: Window = field(default_factory=Window)  # window over the sequence numbers received
    waiting: dict[int, Packet] = field(default_factory=dict[int, Packet])  # packets that wait for their step, by step
    behind: Packet | None = None  # newest late packet, or None
    missing: int = 0  # number of missing sequence numbers when the packets were last read
    newest: int = -1  # step of the newest packet that a step has read; older packets are never used

    def dated(self, packet: Packet, first: int) -> Packet:
        """Return a packet on a link with random delays, which arrives in a step from ``first`` on at the earliest.

        An acknowledgement states when its packet arrived, and may be too late.
        """
        if packet.kind == "acknowledgement":
            (told,) = packet.values
            return packet._replace(late=int(min(max(told, 0.0), NEVER)))
        return packet._replace(late=max(packet.late, (first - packet.tick) * self.pieces))


def streams_of(arrivals: Iterable[Arrival]) -> dict[tuple[str, str], Stream]:
    """Create the streams of packets that a node receives: one for each kind of packet and each link."""
    kept, operated = ("measurement", "setpoint", "manual"), ("setpoint", "manual")
    found = {
        (a.kind, a.link): Stream(
            a.lag, a.at, a.size, a.part, a.pieces, a.ages, a.every, kept=a.kind in kept, ordered=a.kind in operated
        )
        for a in arrivals
    }
    if BY_HAND in found:  # an operator numbers all packets together
        found[BY_HAND].window = found[OPERATOR].window
    return found


class Inbox:
    """Stores the packets that a node has received, until the step that reads them."""

    def __init__(
        self,
        streams: Mapping[tuple[str, str], Stream],
        loop: int,
        lossless: bool,
        counters: Counter[str],
        degrade: Callable[[str], None],
    ) -> None:
        """Start with an empty inbox."""
        self.streams, self.loop, self._lossless = streams, loop, lossless
        self.counters, self._degrade = counters, degrade
        self.marks = {link: Window() for _, link in streams}
        self.marked = {link: -1 for _, link in streams}  # last step that the sender has finished
        # a mark that comes in the direction of the node's own is one of its own, which somebody has sent back
        self._back = {link: kind in BACK for kind, link in streams}

    @property
    def links(self) -> list[str]:
        """Links on which the node receives packets."""
        return [link for _, link in self.streams]

    @property
    def waiting(self) -> int:
        """Number of packets that have arrived early and wait for their step."""
        return sum(len(stream.waiting) for stream in self.streams.values())

    def take(self, packet: Packet, past: int) -> Handling:
        """Store a packet that arrives after step ``past``, and return how it was handled, such as "misdirected"."""
        self.counters["received"] += 1
        stream = self.streams.get((packet.kind, packet.link))
        mark = packet.kind == "mark" and packet.back == self._back.get(packet.link)
        if packet.loop != self.loop or not (mark or stream):
            self.counters["misdirected"] += 1
            return "misdirected"
        if stream is not None and (len(packet.values) != stream.size or not fits(packet.values)):
            raise ProblemError(
                f"a packet of kind {packet.kind} on the {packet.link} link contains the numbers {packet.values}; "
                f"expected {stream.size} finite numbers of at most {LARGEST:.2g} in magnitude"
            )
        window = self.marks[packet.link] if stream is None else stream.window
        begun, newest = window.epoch, window.newest
        news = window.admit(packet.epoch, packet.sequence)
        for one in self.streams.values():
            if stream is not None and window.epoch > begun and one.window is window:
                self._forget(one)
        if news != "new":
            self.counters[news] += 1
            return news
        if stream is not None and stream.ordered:
            if packet.epoch == begun and packet.sequence < newest:
                self.counters["superseded"] += 1
                return "superseded"
            packet = packet._replace(tick=past + 1)
        if packet.tick > past + AHEAD and past >= 0:
            self.counters["ahead"] += 1
            return "ahead"
        if stream is None:
            self.counters["marks"] += 1
            self.marked[packet.link] = max(self.marked[packet.link], packet.tick)
            return "marks"
        if stream.pieces:
            packet = stream.dated(packet, past + 1 - stream.lag)
        if due_step(packet, stream) > past - stream.lag:
            self._wait(stream, packet)
            return "waiting"
        self._miss(stream, packet)
        return "late"

    def late_by(self, packet: Packet, present: int) -> int:
        """Return how many whole steps after the step that reads it a packet arrives, if step ``present`` runs then."""
        stream = self.streams.get((packet.kind, packet.link))
        return 0 if stream is None else max(0, present - packet.tick - stream.lag)

    def settled(self, link: str, tick: int) -> bool:
        """Check whether a step's packet has arrived, or the sender has reported that it sends no packet in this
        step.
        """
        return self.marked[link] >= tick or tick in self.streams["data", link].waiting

    def finished(self, link: str, tick: int) -> bool:
        """Check whether a sender has finished a step, and all its marks (end-of-step messages) have arrived."""
        # In lockstep, a missing mark shows that datagrams of its step were dropped; their sender repeats them.
        return tick < 0 or (self.marked[link] >= tick and not self.marks[link].missing)

    def given(self, tick: int) -> bool:
        """Check whether the set-points of a step have arrived. True also for a node that does not receive
        set-points.
        """
        stream = self.streams.get(("measurement", SETPOINT))
        return stream is None or tick in stream.waiting

    def collect(self, part: int, tick: int, inputs: list[float]) -> list[Packet]:
        """Copy packets for this part of the step to the inputs of the program. Return those that arrived in time."""
        found: list[Packet] = []
        for stream in self.streams.values():
            if stream.part != part:
                continue
            if stream.kept:
                self._collect_kept(stream, tick, inputs)
                continue
            wanted = tick - stream.lag
            if stream.pieces:
                found += self._collect_late(stream, wanted, inputs)
                continue
            for old in [number for number in stream.waiting if number < wanted]:
                self._miss(stream, stream.waiting.pop(old))
            packet = stream.waiting.pop(wanted, None)
            if packet is not None:
                self.counters["used"] += 1
                found.append(packet)
            elif stream.behind is not None:
                packet = stream.behind
            stream.behind = None
            if packet is not None:
                stream.newest = max(stream.newest, packet.tick)
            if self._lossless and stream.window.missing > stream.missing:
                self._degrade("lost")
            stream.missing = stream.window.missing
            arrived = (0.0,) * (1 + stream.size) if packet is None else (1.0, *packet.values)
            inputs[stream.at : stream.at + 1 + stream.size] = arrived
        return found

    def _collect_late(self, stream: Stream, wanted: int, inputs: list[float]) -> list[Packet]:
        """Copy the packets that arrive in a step to the inputs, for each piece the newest one; return those in time.

        Of acknowledgements, copy for each age the piece in which the packet of this age has arrived.
        """
        come = [packet for packet in stream.waiting.values() if due_step(packet, stream) <= wanted]
        for packet in come:
            del stream.waiting[packet.tick]
        stream.missing = stream.window.missing
        if stream.ages:
            inputs[stream.at : stream.at + stream.ages] = [NEVER] * stream.ages
            for packet in come:
                if due_step(packet, stream) < wanted or wanted - packet.tick >= stream.ages:
                    self._miss(stream, packet)
                    continue
                self.counters["used"] += 1
                inputs[stream.at + wanted - packet.tick] = float(packet.late % stream.pieces)
            return come
        if stream.every:
            return self._put_each(stream, come, wanted, inputs)
        newer, used = _put_newest(stream, come, wanted, inputs)
        self.counters["used"] += len(used)
        self.counters["superseded"] += len(come) - len(used)
        stream.newest = max([stream.newest, *used])
        return newer

    def _put_each(self, stream: Stream, come: Sequence[Packet], wanted: int, inputs: list[float]) -> list[Packet]:
        """Copy the packets that arrive in a step to the inputs of their ages; return those that are not too old."""
        size, found = 1 + stream.size, list[Packet]()
        inputs[stream.at : stream.at + stream.every * size] = [0.0] * stream.every * size
        for packet in come:
            age = wanted - packet.tick
            if age >= stream.every:
                self._miss(stream, packet)
                continue
            self.counters["used"] += 1
            inputs[stream.at + age * size : stream.at + (age + 1) * size] = (1.0, *packet.values)
            # a packet of a step that this node has missed is heard now
            found.append(stream.dated(packet, wanted))
        stream.newest = max([stream.newest, *(one.tick for one in found)])
        return found

    def so_far(self, part: int, tick: int, inputs: list[float]) -> list[Packet]:
        """Copy packets as ``collect`` does, but leave them in the inbox, as further ones may arrive in the step."""
        found = list[Packet]()
        for stream in self.streams.values():
            if stream.part != part or stream.kept:
                continue
            wanted = tick - stream.lag
            if stream.pieces:
                come = [packet for packet in stream.waiting.values() if due_step(packet, stream) <= wanted]
                found += _put_newest(stream, come, wanted, inputs)[0]
                continue
            packet = stream.waiting.get(wanted)
            found += [] if packet is None else [packet]
            packet = stream.behind if packet is None else packet
            arrived = (0.0,) * (1 + stream.size) if packet is None else (1.0, *packet.values)
            inputs[stream.at : stream.at + 1 + stream.size] = arrived
        return found

    def _collect_kept(self, stream: Stream, tick: int, inputs: list[float]) -> None:
        """Copy the newest set-points of this step or of an earlier one to the inputs; without any, the last remain."""
        come = [stream.waiting.pop(number) for number in sorted(stream.waiting) if number <= tick]
        if not stream.ordered and self.operated:
            self.counters["overruled"] += len(come)
            stream.behind = None
            return
        self.counters["used"] += len(come)
        come += [] if stream.behind is None else [stream.behind]
        stream.behind = None
        for packet in come:
            if packet.tick >= stream.newest:
                stream.newest = packet.tick
                inputs[stream.at : stream.at + 1 + stream.size] = (1.0, *packet.values)

    @property
    def operated(self) -> bool:
        """True if an operator has given set-points; those of a simulated plant then have no effect."""
        stream = self.streams.get(OPERATOR)
        return stream is not None and stream.newest >= 0

    def forget(self, link: str, by_operator: bool = False) -> None:
        """Forget the sequence numbers received on a link, from an operator or the other sender, which starts a new
        epoch.
        """
        window = Window()
        for (kind, of), stream in self.streams.items():
            if of == link and ((kind, of) in (OPERATOR, BY_HAND)) == by_operator:
                self._forget(stream)
                stream.window, stream.missing = window if by_operator else Window(), 0
        if link in self.marks and not by_operator:
            self.marks[link], self.marked[link] = Window(), -1

    def save(self) -> dict[str, Any]:
        """Return the state of the inbox, as values that JSON can represent, to save it."""
        streams = {
            " ".join(name): {
                "window": stream.window.save(),
                "waiting": [list(packet) for packet in stream.waiting.values()],
                "behind": stream.behind and list(stream.behind),
                "missing": stream.missing,
                "newest": stream.newest,
            }
            for name, stream in self.streams.items()
        }
        marks = {link: window.save() for link, window in self.marks.items()}
        return {"channels": streams, "marks": marks, "marked": dict(self.marked)}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Restore a saved state of the inbox."""
        for name, stream in self.streams.items():
            kept = saved["channels"][" ".join(name)]
            stream.window.restore(kept["window"])
            stream.waiting = {packet.tick: packet for packet in map(packet_of, kept["waiting"])}
            stream.behind = None if kept["behind"] is None else packet_of(kept["behind"])
            stream.missing, stream.newest = kept["missing"], kept["newest"]
        for link, window in self.marks.items():
            window.restore(saved["marks"][link])
            self.marked[link] = saved["marked"][link]

    def _wait(self, stream: Stream, packet: Packet) -> None:
        known = stream.waiting.get(packet.tick)
        self.counters["superseded"] += known is not None
        if known is None or (packet.epoch, packet.sequence) > (known.epoch, known.sequence):
            stream.waiting[packet.tick] = packet
        if len(stream.waiting) > 2 * AHEAD:  # only before the first step of the node
            self._miss(stream, stream.waiting.pop(min(stream.waiting)))

    def _forget(self, stream: Stream) -> None:
        """Drop the early packets of a sender that has started again: they are older than all that it sends now."""
        self.counters["superseded"] += len(stream.waiting)
        stream.waiting.clear()
        stream.behind = None

    def _miss(self, stream: Stream, packet: Packet) -> None:
        self.counters["late"] += 1
        if stream.kept:  # they take effect in the next step
            if stream.behind is None or packet.tick >= stream.behind.tick:
                stream.behind = packet
            return
        if packet.kind == "acknowledgement":
            self._degrade(LATE_ANSWER)
        elif self._lossless:
            self._degrade("late")
            if packet.tick > (stream.newest if stream.behind is None else stream.behind.tick):
                stream.behind = packet


def _put_newest(
    stream: Stream, come: Sequence[Packet], wanted: int, inputs: list[float]
) -> tuple[list[Packet], set[int]]:
    """Copy the newest packet of each piece to the inputs; return the packets that count, and the steps of used ones."""
    # a packet of a step that this node has missed is heard now
    newer = [stream.dated(one, wanted) for one in come if one.tick > stream.newest]
    used, size = set[int](), 1 + stream.size
    for piece in range(stream.pieces):
        here = [one for one in newer if one.late % stream.pieces <= piece]
        best = max(here, key=lambda one: one.tick, default=None)
        used |= set[int]() if best is None else {best.tick}
        arrived = (0.0,) * size if best is None else (1.0 + wanted - best.tick, *best.values)
        inputs[stream.at + piece * size : stream.at + (piece + 1) * size] = arrived
    return newer, used


def due_step(packet: Packet, stream: Stream) -> int:
    """Return the step that reads a packet: its own, or on a link with random delays that of its arrival."""
    return packet.tick + packet.late // stream.pieces if stream.pieces else packet.tick


def packet_of(saved: Sequence[Any]) -> Packet:
    """Restore a packet from the values with which it was saved."""
    kind, link, tick, sequence, values, *rest = saved
    return Packet(kind, link, tick, sequence, tuple(values), *rest)
