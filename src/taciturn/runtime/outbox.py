"""Sending of the packets of nodes, and their repetition if they may have been dropped or discarded."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from typing import Any

from taciturn.runtime.inbox import packet_of
from taciturn.runtime.packet import Packet, Wire
from taciturn.runtime.reception import VALID
from taciturn.runtime.service import QUIET, Port
from taciturn.runtime.udp import Address


class Outbox:
    """The packets of the last steps of the nodes of a process, one node for each loop.

    Args:
        wire: encoder of the packets.
        port: socket of the process.
        peers: address that receives the packets of each link.
        loops: number of nodes.
    """

    def __init__(self, wire: Wire, port: Port, peers: Mapping[str, Address], loops: int) -> None:
        """Start without packets."""
        self._wire, self._port, self._peers = wire, port, peers
        # in lockstep a node may be one step ahead of its receiver, which then lacks the packets of two steps
        self._last = [deque[list[Packet]](maxlen=VALID) for _ in range(loops)]
        self.counters: Counter[str] = Counter()  # packets sent again, by kind and link
        self._repeated: dict[tuple[int, str | None], float] = {}  # time of the last repetition, by loop and link

    def keep(self, loop: int, packets: list[Packet]) -> None:
        """Remember the packets of a step."""
        self._last[loop].append(packets)

    def send(self, packets: Sequence[Packet]) -> None:
        """Send packets to the other ends of their links."""
        for packet in packets:
            self._port.send(self._wire.encode(packet), self._peers[packet.link])

    def repeat(self, loop: int, now: float, link: str | None = None) -> None:
        """Send the packets of the last steps again, in their order: of one link, or of all links.

        The rate is limited, so that an attacker who repeats a datagram does not cause many others.
        """
        if now - self._repeated.get((loop, link), -QUIET) < QUIET:
            return
        self._repeated[loop, link] = now
        for sent in self._last[loop]:
            again = [packet for packet in sent if link in (None, packet.link)]
            self.counters.update(f"sent again {packet.kind} {packet.link}" for packet in again)
            self.send(again)

    def save(self) -> list[list[list[Any]]]:
        """Return the packets of the first node as values that JSON can represent."""
        return [[list(packet) for packet in sent] for sent in self._last[0]]

    def restore(self, saved: list[list[list[Any]]]) -> None:
        """Continue from saved packets."""
        self._last[0].extend([packet_of(entry) for entry in sent] for sent in saved)
