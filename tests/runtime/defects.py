"""Defects that are planted in the nodes, to show that worlds of faults find them."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple
from unittest.mock import patch

from taciturn.nodes import clock
from taciturn.nodes import packet as packets
from taciturn.nodes.clock import JUMPED, Phase
from taciturn.nodes.inbox import Inbox, Stream
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet, Wire
from taciturn_udp import nodes, plant
from taciturn_udp.nodes import NodeServer
from taciturn_udp.proofs import Reception, _Session


class Defect(NamedTuple):
    """A defect: what it replaces in Python, and in the source of the C core."""

    places: tuple[tuple[Any, str, Any], ...] = ()
    core: dict[str, str] | None = None

    @contextmanager
    def planted(self) -> Generator[None]:
        """Plant it in Python."""
        with ExitStack() as stack:
            for place, name, wrong in self.places:
                stack.enter_context(patch.object(place, name, wrong))
            yield


def around(place: type, name: str, wrong: Callable[..., Any]) -> Defect:
    """Return a defect that calls the true method, or not."""
    true = getattr(place, name)
    return Defect(((place, name, lambda *given, **named: wrong(true, *given, **named)),))


def _ahead_is_ignored(true: Callable[..., str], node: Node, packet: Packet) -> str:
    handling = true(node, packet)
    return "misdirected" if handling == "ahead" else handling


def _late_wins(inbox: Inbox, stream: Stream, packet: Packet) -> None:
    inbox.counters["late"] += 1
    if inbox._lossless:
        inbox._degrade("late")
        stream.behind = packet


def _late_input_wins(true: Callable[..., None], server: Any, packet: Packet) -> None:
    before = server.refused["late"]
    true(server, packet)
    if server.refused["late"] > before:
        server.refused["late"], server.taken = before, server.taken + 1
        server._inputs[packet.loop][packet.link].apply(packet)


def _numbers_start_again(true: Callable[..., None], node: Node, saved: Any) -> None:
    true(node, saved)
    if "sequences" in saved:
        node._sequences.clear()


def _any_sum(true: Callable[..., Any], wire: Wire, datagram: bytes) -> Any:
    if wire.keyed:  # the tag shows a change
        return true(wire, datagram)
    return true(wire, datagram[:-4] + zlib.crc32(datagram[:-4]).to_bytes(4, "big"))


def _never_earlier(true: Callable[..., bool], phase: Phase, tick: int, now: float) -> bool:
    off = now - tick * phase.tick - phase.zero
    return True if -JUMPED * phase.tick <= off < 0 else true(phase, tick, now)


def _silent_only_without_steps(node: Node) -> tuple[str, ...]:
    return tuple(node._heard_at) if node._unheard else ()


def _marks_are_not_heard(true: Callable[..., str], node: Node, packet: Packet) -> str:
    heard, unheard = dict(node._heard_at), node._unheard
    handling = true(node, packet)
    if packet.kind == "mark":
        node._heard_at, node._unheard = heard, unheard
    return handling


def _of_one_epoch(true: Callable[..., None], node: Node, *given: Any, **named: Any) -> None:
    true(node, *given, **named | {"epoch": 1000})


def _never_expires(server: NodeServer, now: float) -> None:
    if now >= server._expires:
        server._expires = now + 1.0


def _safe_of_the_future(true: Callable[..., None], server: NodeServer, now: float) -> None:
    epochs = [node.epoch for node in server.nodes]
    for node in server.nodes:
        node.epoch += 1 << 20
    true(server, now)
    for node, epoch in zip(server.nodes, epochs, strict=True):
        node.epoch = epoch


def _any_answer(true: Callable[..., bool], reception: Reception, answer: Packet) -> bool:
    session = reception._known.setdefault((answer.link, answer.loop), _Session())
    session.nonce = answer.nonce
    return true(reception, answer)


def _old_nonce(true: Callable[..., Packet], reception: Reception, challenge: Packet, *given: Any) -> Packet:
    old = OLD.setdefault((id(reception), challenge.link), challenge)
    return true(reception, challenge._replace(nonce=old.nonce), *given)


OLD: dict[tuple[int, str], Packet] = {}  # first challenge that each process has received on a link
LATE_IN_C = "channel->has_behind ? packet->tick > channel->behind.tick : packet->tick >= channel->newest"
DEFECTS: dict[str, Defect] = {
    "packets far ahead do not correct the clock": around(Node, "sort_in", _ahead_is_ignored),
    "the watchdog does not run before the first step": Defect(((NodeServer, "_expire", _never_expires),)),
    "a late packet replaces a newer command": Defect(((Inbox, "_miss", _late_wins),)),
    "a late packet replaces a newer command in C": Defect(core={LATE_IN_C: "true"}),
    "an old packet silences a fresh node": Defect(((clock, "AGREED", 1 << 30),)),
    "steps are caught up without a limit": Defect(((nodes, "LEFT_BEHIND", 1 << 30),)),
    "marks are never sent": Defect(((Node, "mark", lambda *_: ()),)),
    "marks are sent in every step": around(Node, "mark", lambda true, node, every: true(node, 0)),
    "the plant applies a late input": around(plant.PlantServer, "_sort", _late_input_wins),
    "a clock that is some steps fast is not corrected": Defect(((Phase, "_follow", lambda *_: None),)),
    "a node does not doubt its clock after a gap": Defect(((NodeServer, "_notice", lambda *_: None),)),
    "the watchdog never expires": Defect(((Node, "silent_links", property(_silent_only_without_steps)),)),
    "the watchdog never expires in C": Defect(core={"bool late = limit > 0U &&": "bool late = false && limit > 0U &&"}),
    "sequence numbers start again from a saved state": around(Node, "restore", _numbers_start_again),
    "all starts have one epoch": around(Node, "__init__", _of_one_epoch),
    "the checksum is not checked": around(Wire, "decode", _any_sum),
    "a clock that is some steps slow is not corrected": around(Phase, "hear", _never_earlier),
    "marks do not stop the watchdog": around(Node, "sort_in", _marks_are_not_heard),
    "the safe input is of a later epoch": around(NodeServer, "_expire", _safe_of_the_future),
    "late packets are not counted in C": Defect(core={"node->counters.late++;": ""}),
    "packets are used before the answer to a challenge": Defect(((Reception, "admits", lambda *_: True),)),
    "packets are used before the answer to a challenge in C": Defect(
        core={"(known && packet->tick >= channel->first)": "true"}
    ),
    "an old answer is a proof": around(Reception, "accepts", _any_answer),
    "an old answer is a proof in C": Defect(core={" || packet->nonce != nonce_of(node, i)": ""}),
    "a node answers with an old nonce": around(Reception, "answer", _old_nonce),
    "a forged packet is used": Defect(((packets, "_is_signed", lambda *_: True),)),
    "a forged packet is used in C": Defect(core={"return difference == 0U;": "return true;"}),
}
SHOWN = {  # a world that shows each defect
    "packets far ahead do not correct the clock": 72,
    "the watchdog does not run before the first step": 0,
    "a late packet replaces a newer command": 3,
    "a late packet replaces a newer command in C": 13,
    "an old packet silences a fresh node": 8,
    "steps are caught up without a limit": 5,
    "marks are never sent": 2,
    "marks are sent in every step": 0,
    "the plant applies a late input": 52,
    "a clock that is some steps fast is not corrected": 22,
    "a node does not doubt its clock after a gap": 36,
    "the watchdog never expires": 1,
    "the watchdog never expires in C": 52,
    "sequence numbers start again from a saved state": 29,
    "all starts have one epoch": 36,
    "the checksum is not checked": 22,
    "a clock that is some steps slow is not corrected": 5,
    "marks do not stop the watchdog": 2,
    "the safe input is of a later epoch": 93,
    "late packets are not counted in C": 4,
    "packets are used before the answer to a challenge": 2,
    "packets are used before the answer to a challenge in C": 9,
    "an old answer is a proof": 60,
    "an old answer is a proof in C": 86,
    "a node answers with an old nonce": 8,
    "a forged packet is used": 11,
    "a forged packet is used in C": 11,
}
