"""What becomes of packets that arrive at a node: every case is defined, and counted once.

| a packet | |
|---|---|
| of the tick that wants it | `used`: this is the theory |
| of a later tick | waits for it; more than `AHEAD` ticks early it is dropped: `ahead` |
| of an earlier tick | `late`: a network that loses packets has lost it, as the theory has it; on an ideal one the newest such packet is used in the next tick |
| that has come before | `duplicate`, dropped |
| of an earlier epoch, or far behind the newest | `replayed`, dropped |
| of another loop or link | `misdirected`, dropped |
| older than another of its tick | `superseded`, dropped |
| that is a mark: its sender lives, and has finished a tick | `marks` |

So `received` is the sum of all the others and of what waits.
"""  # noqa: E501

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from taciturn.runtime.packet import Packet
from taciturn.runtime.window import Window

AHEAD = 64  # ticks that a packet may be early


@dataclass
class Stream:
    """Packets of one kind on one link.

    Args:
        lag: how many ticks older than the tick that reads it its packet is.
        at: where its values stand among the inputs of a node: whether one arrived, and then the payload.
        size: of the payload.
        part: of the tick that reads it.
    """

    lag: int
    at: int
    size: int
    part: int
    window: Window = field(default_factory=Window)
    waiting: dict[int, Packet] = field(default_factory=dict[int, Packet])
    behind: Packet | None = None  # the newest that came too late
    missing: int = 0  # sequence numbers that were missing when it was read last


class Inbox:
    """The packets that have come to a node.

    Args:
        streams: by kind and link.
        loop: of the node.
        lossless: whether the policy's theory takes every packet to arrive.
        counters: where each packet is counted.
        degrade: called where something happens that the theory does not know.
    """

    def __init__(
        self,
        streams: Mapping[tuple[str, str], Stream],
        loop: int,
        lossless: bool,
        counters: Counter[str],
        degrade: Callable[[str], None],
    ) -> None:
        """Nothing has come."""
        self.streams, self.loop, self._lossless = streams, loop, lossless
        self.counters, self._degrade = counters, degrade
        self.marks = {link: Window() for _, link in streams}
        self.marked = {link: -1 for _, link in streams}  # the last tick that its sender has finished

    @property
    def waiting(self) -> int:
        """Packets that wait for their tick."""
        return sum(len(stream.waiting) for stream in self.streams.values())

    def take(self, packet: Packet, past: int) -> bool:
        """Take a packet in after the tick ``past``; return whether it is new, and not far too early."""
        self.counters["received"] += 1
        stream = self.streams.get((packet.kind, packet.link))
        mark = packet.kind == "mark" and packet.link in self.marks
        if packet.loop != self.loop or not (mark or stream):
            self.counters["misdirected"] += 1
            return False
        window = self.marks[packet.link] if stream is None else stream.window
        news = window.admit(packet.epoch, packet.sequence)
        if news != "new":
            self.counters[news] += 1
            return False
        if packet.tick > past + AHEAD and past >= 0:
            self.counters["ahead"] += 1
            return False
        if stream is None:
            self.counters["marks"] += 1
            self.marked[packet.link] = max(self.marked[packet.link], packet.tick)
        elif packet.tick > past - stream.lag:
            self._wait(stream, packet)
        else:
            self._miss(stream, packet)
        return True

    def settled(self, link: str, tick: int) -> bool:
        """Tell whether the packet of a tick has come, or will not."""
        return self.marked[link] >= tick or tick in self.streams["data", link].waiting

    def collect(self, part: int, tick: int, inputs: list[float]) -> list[Packet]:
        """Put the packets that a part of a tick wants among its inputs; return those that came in time."""
        found: list[Packet] = []
        for stream in self.streams.values():
            if stream.part != part:
                continue
            wanted = tick - stream.lag
            for old in [number for number in stream.waiting if number < wanted]:
                self._miss(stream, stream.waiting.pop(old))
            packet = stream.waiting.pop(wanted, None)
            if packet is not None:
                self.counters["used"] += 1
                found.append(packet)
            elif stream.behind is not None:
                packet = stream.behind
            stream.behind = None
            if self._lossless and stream.window.missing > stream.missing:
                self._degrade("lost")
            stream.missing = stream.window.missing
            arrived = (0.0,) * (1 + stream.size) if packet is None else (1.0, *packet.values)
            inputs[stream.at : stream.at + 1 + stream.size] = arrived
        return found

    def save(self) -> dict[str, Any]:
        """Return all that is remembered, as JSON holds it."""
        streams = {
            " ".join(name): {
                "window": stream.window.save(),
                "waiting": [list(packet) for packet in stream.waiting.values()],
                "behind": stream.behind and list(stream.behind),
                "missing": stream.missing,
            }
            for name, stream in self.streams.items()
        }
        marks = {link: window.save() for link, window in self.marks.items()}
        return {"channels": streams, "marks": marks, "marked": dict(self.marked)}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Go on from what was saved."""
        for name, stream in self.streams.items():
            kept = saved["channels"][" ".join(name)]
            stream.window.restore(kept["window"])
            stream.waiting = {packet.tick: packet for packet in map(packet_of, kept["waiting"])}
            stream.behind = None if kept["behind"] is None else packet_of(kept["behind"])
            stream.missing = kept["missing"]
        for link, window in self.marks.items():
            window.restore(saved["marks"][link])
            self.marked[link] = saved["marked"][link]

    def _wait(self, stream: Stream, packet: Packet) -> None:
        known = stream.waiting.get(packet.tick)
        self.counters["superseded"] += known is not None
        if known is None or (packet.epoch, packet.sequence) > (known.epoch, known.sequence):
            stream.waiting[packet.tick] = packet
        if len(stream.waiting) > 2 * AHEAD:  # of a node that has not begun
            self._miss(stream, stream.waiting.pop(min(stream.waiting)))

    def _miss(self, stream: Stream, packet: Packet) -> None:
        self.counters["late"] += 1
        if packet.kind == "acknowledgement":
            self._degrade("late acknowledgement")
        elif self._lossless:
            self._degrade("late")
            if stream.behind is None or packet.tick > stream.behind.tick:
                stream.behind = packet


def packet_of(saved: Sequence[Any]) -> Packet:
    """Return a packet of its saved fields."""
    kind, link, tick, sequence, values, epoch, loop = saved
    return Packet(kind, link, tick, sequence, tuple(values), epoch, loop)
