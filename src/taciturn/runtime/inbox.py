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
class Channel:
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
        channels: by kind and link.
        loop: of the node.
        lossless: whether the policy's theory takes every packet to arrive.
        counters: where each packet is counted.
        degrade: called where something happens that the theory does not know.
    """

    def __init__(
        self,
        channels: Mapping[tuple[str, str], Channel],
        loop: int,
        lossless: bool,
        counters: Counter[str],
        degrade: Callable[[str], None],
    ) -> None:
        """Nothing has come."""
        self.channels, self.loop, self._lossless = channels, loop, lossless
        self.counters, self._degrade = counters, degrade
        self.marks = {link: Window() for _, link in channels}
        self.marked = {link: -1 for _, link in channels}  # the last tick that its sender has finished

    @property
    def waiting(self) -> int:
        """Packets that wait for their tick."""
        return sum(len(channel.waiting) for channel in self.channels.values())

    def take(self, packet: Packet, past: int) -> bool:
        """Take a packet in after the tick ``past``; return whether it is new, and not far too early."""
        self.counters["received"] += 1
        channel = self.channels.get((packet.kind, packet.link))
        mark = packet.kind == "mark" and packet.link in self.marks
        if packet.loop != self.loop or not (mark or channel):
            self.counters["misdirected"] += 1
            return False
        window = self.marks[packet.link] if channel is None else channel.window
        news = window.admit(packet.epoch, packet.sequence)
        if news != "new":
            self.counters[news] += 1
            return False
        if packet.tick > past + AHEAD and past >= 0:
            self.counters["ahead"] += 1
            return False
        if channel is None:
            self.counters["marks"] += 1
            self.marked[packet.link] = max(self.marked[packet.link], packet.tick)
        elif packet.tick > past - channel.lag:
            self._wait(channel, packet)
        else:
            self._miss(channel, packet)
        return True

    def settled(self, link: str, tick: int) -> bool:
        """Tell whether the packet of a tick has come, or will not."""
        return self.marked[link] >= tick or tick in self.channels["data", link].waiting

    def collect(self, part: int, tick: int, inputs: list[float]) -> list[Packet]:
        """Put the packets that a part of a tick wants among its inputs; return those that came in time."""
        found: list[Packet] = []
        for channel in self.channels.values():
            if channel.part != part:
                continue
            wanted = tick - channel.lag
            for old in [number for number in channel.waiting if number < wanted]:
                self._miss(channel, channel.waiting.pop(old))
            packet = channel.waiting.pop(wanted, None)
            if packet is not None:
                self.counters["used"] += 1
                found.append(packet)
            elif channel.behind is not None:
                packet = channel.behind
            channel.behind = None
            if self._lossless and channel.window.missing > channel.missing:
                self._degrade("lost")
            channel.missing = channel.window.missing
            arrived = (0.0,) * (1 + channel.size) if packet is None else (1.0, *packet.values)
            inputs[channel.at : channel.at + 1 + channel.size] = arrived
        return found

    def save(self) -> dict[str, Any]:
        """Return all that is remembered, as JSON holds it."""
        channels = {
            " ".join(name): {
                "window": channel.window.save(),
                "waiting": [list(packet) for packet in channel.waiting.values()],
                "behind": channel.behind and list(channel.behind),
                "missing": channel.missing,
            }
            for name, channel in self.channels.items()
        }
        marks = {link: window.save() for link, window in self.marks.items()}
        return {"channels": channels, "marks": marks, "marked": dict(self.marked)}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Go on from what was saved."""
        for name, channel in self.channels.items():
            kept = saved["channels"][" ".join(name)]
            channel.window.restore(kept["window"])
            channel.waiting = {packet.tick: packet for packet in map(packet_of, kept["waiting"])}
            channel.behind = None if kept["behind"] is None else packet_of(kept["behind"])
            channel.missing = kept["missing"]
        for link, window in self.marks.items():
            window.restore(saved["marks"][link])
            self.marked[link] = saved["marked"][link]

    def _wait(self, channel: Channel, packet: Packet) -> None:
        known = channel.waiting.get(packet.tick)
        self.counters["superseded"] += known is not None
        if known is None or (packet.epoch, packet.sequence) > (known.epoch, known.sequence):
            channel.waiting[packet.tick] = packet
        if len(channel.waiting) > 2 * AHEAD:  # of a node that has not begun
            self._miss(channel, channel.waiting.pop(min(channel.waiting)))

    def _miss(self, channel: Channel, packet: Packet) -> None:
        self.counters["late"] += 1
        if packet.kind == "acknowledgement":
            self._degrade("late acknowledgement")
        elif self._lossless:
            self._degrade("late")
            if channel.behind is None or packet.tick > channel.behind.tick:
                channel.behind = packet


def packet_of(saved: Sequence[Any]) -> Packet:
    """Return a packet of its saved fields."""
    kind, link, tick, sequence, values, epoch, loop = saved
    return Packet(kind, link, tick, sequence, tuple(values), epoch, loop)
