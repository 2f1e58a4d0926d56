"""Reception of datagrams: decoding, and with a key the proof that their sender is running.

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
"""

from __future__ import annotations

import secrets
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from taciturn.model.wire import BACK, PROOFS
from taciturn.runtime.packet import Packet, Wire
from taciturn.runtime.service import Port, Say, disagreement
from taciturn.runtime.udp import Address

VALID = 2  # last steps of a sender whose packets are valid after its answer, and which it sends again
UNANSWERED = 64  # challenges without an answer after which a message says so


@dataclass
class _Session:
    """The state of a sender: its proven epoch, its first valid step, and the nonce of an open challenge."""

    epoch: int | None = None
    first: int = 0
    nonce: int | None = None
    unanswered: int = 0


class Reception:
    """The received datagrams of a process, which receives from one sender on each link of a loop.

    Args:
        wire: encoder and decoder of the packets.
        port: socket of the process.
        name: name of the process in messages.
        links: links on which the process sends or receives.
        say: function called with messages: about packets of another policy or key, about a sender that does not
            answer, and about changed keys.
        draw: function that returns a new nonce of 64 bits; default: the random numbers of the operating system.

    Raises:
        ProblemError: the keys contain none for one of the links.
    """

    def __init__(
        self,
        wire: Wire,
        port: Port,
        name: str,
        links: Iterable[str],
        say: Say | None = None,
        draw: Callable[[], int] | None = None,
    ) -> None:
        """Start without proofs."""
        if wire.keys is not None:
            wire.keys.check(name, links)
        self._wire, self._port, self._name = wire, port, name
        self._say, self._draw = say, draw or (lambda: secrets.randbits(64))
        self.refused: Counter[str] = Counter()  # datagrams that are not used, by reason
        self.counters: Counter[str] = Counter()  # challenges sent and answered, proofs received, answers not asked for
        self._known: dict[tuple[str, int], _Session] = {}

    def packets(self, received: Iterable[tuple[bytes, Address]]) -> Iterator[tuple[Packet, Address]]:
        """Yield the packets of received datagrams, and their senders; refuse invalid datagrams."""
        changed = None if self._wire.keys is None else self._wire.keys.renew()
        if changed is not None:
            self._tell(changed)
        for datagram, sender in received:
            packet = self._wire.decode(datagram)
            if isinstance(packet, Packet):
                yield packet, sender
                continue
            self.refused[packet] += 1
            sentence = disagreement(self._name, packet, self._wire.keyed, sender, datagram)
            if sentence is not None and self.refused[packet] == 1:
                self._tell(sentence)

    def admits(self, packet: Packet, sender: Address) -> bool:
        """Return whether the sender of a packet has proven that it is running; if not, challenge it."""
        if not self._wire.keyed:
            return True
        session = self._known.setdefault((packet.link, packet.loop), _Session())
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

    def accepts(self, answer: Packet) -> bool:
        """Store the proof in an answer, and return whether it begins another epoch; discard any other answer."""
        session = self._known.get((answer.link, answer.loop))
        if session is None or session.nonce is None or session.nonce != answer.nonce:
            self.counters["unasked"] += 1
            return False
        self.counters["proofs"] += 1
        other = session.epoch != answer.epoch
        session.epoch, session.first, session.nonce, session.unanswered = answer.epoch, answer.tick, None, 0
        return other

    def answer(self, challenge: Packet, epoch: int, tick: int) -> Packet:
        """Return the answer of a process that has executed step ``tick`` last (-1: none), and count it."""
        self.counters["answered"] += 1
        return answer_to(challenge, epoch, tick)

    def save(self) -> list[list[Any]]:
        """Return the proofs as values that JSON can represent."""
        return [[*name, session.epoch, session.first] for name, session in self._known.items()]

    def restore(self, saved: list[list[Any]]) -> None:
        """Continue from saved proofs."""
        for link, loop, epoch, first in saved:
            self._known[link, loop] = _Session(epoch, first)

    def _tell(self, sentence: str) -> None:
        if self._say is not None:
            self._say(sentence)


def answer_to(challenge: Packet, epoch: int, tick: int) -> Packet:
    """Return the answer of a sender that has executed step ``tick`` last (-1: none)."""
    assert challenge.kind in PROOFS
    first = max(tick + 1 - VALID, 0)
    return Packet("answer", challenge.link, first, 0, (), epoch, challenge.loop, not challenge.back, challenge.nonce)
