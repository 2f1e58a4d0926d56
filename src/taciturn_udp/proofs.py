"""Receive datagrams, and send packets again; with a key, senders must prove that they are running.

A tag shows that a packet was once sent by a holder of the key, but not when. Therefore a process accepts the packets of
an epoch only after their sender has answered a *challenge*:

1. A packet of an epoch without proof arrives. The receiver discards it, and sends a challenge with a random number
   (nonce) to the address from which the packet came.
2. The sender answers with the nonce, its epoch, and the first step whose packets are still valid: that before its
   last one. It then sends the packets of these steps again, so that a discarded packet is not lost.
3. The receiver accepts all packets of this epoch from this step on. An answer is valid once, as the next challenge has
   another nonce.

The epoch of an answer may also be smaller than the last one, so a device without a clock may draw it at random.
Without keys, anybody can send packets, and a larger epoch replaces a smaller one without a challenge.

Each link of a loop has one sender, except the link of set-points: an operator and a simulated plant prove for
themselves that they are running.
"""

from __future__ import annotations

import secrets
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from taciturn.model.wire import BACK, HEADER_SIZE, OFFSETS, PROOFS, SETPOINT, VERSION
from taciturn.nodes.inbox import packet_of
from taciturn.nodes.packet import Packet, Wire
from taciturn_udp.endpoint import Address
from taciturn_udp.late import unstamped
from taciturn_udp.service import QUIET, Port, Say

VALID = 2  # last steps of a sender whose packets are valid after its answer, and which it sends again
OPERATED = "setpoint by an operator"  # the link of set-points, as far as an operator sends on it
UNANSWERED = 64  # challenges without an answer after which a message says so


def disagreement(name: str, why: str, keyed: bool, sender: Address, datagram: bytes) -> str | None:
    """Return a message if the sender of a rejected datagram has another policy, key or release; otherwise None."""
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


@dataclass
class _Session:
    """The state of a sender: its proven epoch, its first valid step, and the nonce of an open challenge."""

    epoch: int | None = None
    first: int = 0
    nonce: int | None = None
    unanswered: int = 0


class Reception:
    """Reception of datagrams by a process."""

    def __init__(
        self,
        wire: Wire,
        port: Port,
        name: str,
        links: Iterable[str],
        say: Say | None = None,
        draw: Callable[[], int] | None = None,
        stamps: bool = False,
    ) -> None:
        """Start without proofs. With ``stamps``, links in virtual time state how late packets are (``late``)."""
        if wire.keys is not None:
            wire.keys.check(name, links)
        self._wire, self._port, self._name = wire, port, name
        self._stamps = stamps
        self._say, self._draw = say, draw or (lambda: secrets.randbits(64))
        self.refused: Counter[str] = Counter()  # datagrams that are not used, by reason
        self.counters: Counter[str] = Counter()  # challenges sent and answered, proofs received, answers not asked for
        self._known: dict[tuple[str, int], _Session] = {}  # by link, or ``OPERATED``, and loop

    def packets(self, received: Iterable[tuple[bytes, Address]]) -> Iterator[tuple[Packet, Address]]:
        """Decode datagrams, discard the invalid ones, and yield the packets, each with its sender."""
        changed = None if self._wire.keys is None else self._wire.keys.renew()
        if changed is not None:
            self._tell(changed)
        for datagram, sender in received:
            datagram, late = unstamped(datagram) if self._stamps else (datagram, 0)
            packet = self._wire.decode(datagram)
            if isinstance(packet, Packet):
                yield packet._replace(late=late) if late else packet, sender
                continue
            self.refused[packet] += 1
            sentence = disagreement(self._name, packet, self._wire.keyed, sender, datagram)
            if sentence is not None and self.refused[packet] == 1:
                self._tell(sentence)

    def admits(self, packet: Packet, sender: Address) -> bool:
        """Return whether the sender of a packet has proven that it is running; if it has not, send it a challenge."""
        if not self._wire.keyed:
            return True
        sender_of = OPERATED if packet.kind in ("setpoint", "manual") else packet.link
        session = self._known.setdefault((sender_of, packet.loop), _Session())
        if packet.epoch == session.epoch:
            if packet.tick < session.first:
                self.refused["replayed"] += 1
            return packet.tick >= session.first
        self.refused["unproven"] += 1
        if session.nonce is None:
            session.nonce = self._draw()
        back = packet.kind not in BACK and not packet.back
        asked = Packet("challenge", packet.link, 0, 0, loop=packet.loop, back=back, nonce=session.nonce)
        self._port.send(self._wire.encode(asked), sender)
        self.counters["challenges"] += 1
        session.unanswered += 1
        if session.unanswered == UNANSWERED:
            self._tell(
                f"the {self._name} has discarded {UNANSWERED} packets on the {packet.link} link, because "
                f"{sender[0]}:{sender[1]} does not answer its challenges; expected an answer from the running sender: "
                "are these recorded packets, or does a firewall stop datagrams to that address?"
            )
        return False

    def accepts(self, answer: Packet) -> str:
        """Accept an answer to a challenge. If its sender has restarted, return its link, or ``OPERATED``; otherwise an
        empty text. Discard an unexpected answer.
        """
        names = (answer.link, OPERATED) if answer.link == SETPOINT else (answer.link,)
        found = {name: self._known.get((name, answer.loop)) for name in names}
        for name, session in found.items():
            if session is not None and session.nonce is not None and session.nonce == answer.nonce:
                self.counters["proofs"] += 1
                other = session.epoch != answer.epoch
                session.epoch, session.first, session.nonce, session.unanswered = answer.epoch, answer.tick, None, 0
                return name if other else ""
        self.counters["unasked"] += 1
        return ""

    def answer(self, challenge: Packet, epoch: int, tick: int) -> Packet:
        """Return the answer to a challenge, and count it; ``tick`` is the step executed last (−1: none)."""
        self.counters["answered"] += 1
        return answer_to(challenge, epoch, tick)

    def save(self) -> list[list[Any]]:
        """Return all proofs as values that JSON can store."""
        return [[*name, session.epoch, session.first] for name, session in self._known.items()]

    def restore(self, saved: list[list[Any]]) -> None:
        """Continue from saved proofs."""
        for link, loop, epoch, first in saved:
            self._known[link, loop] = _Session(epoch, first)

    def _tell(self, sentence: str) -> None:
        if self._say is not None:
            self._say(sentence)


def answer_to(challenge: Packet, epoch: int, tick: int) -> Packet:
    """Return a sender's answer to a challenge; ``tick`` is the step that the sender executed last (−1: none)."""
    assert challenge.kind in PROOFS
    first = max(tick + 1 - VALID, 0)
    return Packet("answer", challenge.link, first, 0, (), epoch, challenge.loop, not challenge.back, challenge.nonce)


class Outbox:
    """The packets that a process sent in the last steps; the process runs one node for each loop."""

    def __init__(self, wire: Wire, port: Port, peers: Mapping[str, Address], loops: int) -> None:
        """Start without packets."""
        self._wire, self._port, self._peers = wire, port, peers
        # in lockstep a node may be one step ahead of its receiver, which then lacks the packets of two steps
        self._last = [deque[list[Packet]](maxlen=VALID) for _ in range(loops)]
        self.counters: Counter[str] = Counter()  # packets sent again, by kind and link
        self._repeated: dict[tuple[int, str | None], float] = {}  # time of the last repetition, by loop and link

    def keep(self, loop: int, packets: list[Packet]) -> None:
        """Store a step's packets, so that they can be sent again."""
        self._last[loop].append(packets)

    def keep_more(self, loop: int, packets: list[Packet]) -> None:
        """Store further packets of the last step."""
        if not self._last[loop]:
            self._last[loop].append([])
        self._last[loop][-1] += packets

    def send(self, packets: Sequence[Packet]) -> None:
        """Send packets to the receivers of their links."""
        for packet in packets:
            self._port.send(self._wire.encode(packet), self._peers[packet.link])

    def repeat(self, loop: int, now: float, link: str | None = None) -> None:
        """Send the packets of the last steps once more, in the same order, on one link or on all links.

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
        """Return the first node's stored packets as values that JSON can store."""
        return [[list(packet) for packet in sent] for sent in self._last[0]]

    def restore(self, saved: list[list[list[Any]]]) -> None:
        """Continue from saved packets."""
        self._last[0].extend([packet_of(entry) for entry in sent] for sent in saved)
