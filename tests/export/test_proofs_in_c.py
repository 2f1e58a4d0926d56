"""Nodes in C with a key: they challenge a sender that has not proven that it is running, and answer challenges."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import pytest
from export.devices import Device, Library, compile_node
from export.test_nodes_in_c import LOOP, LOOPS
from runtime.test_packets import KEY

from taciturn.model.packets import wire_links
from taciturn.nodes.keys import Keys
from taciturn.nodes.packet import Packet, Wire
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn_udp.proofs import answer_to

OTHER = bytes(range(40, 60))


@cache
def library(name: str, role: str) -> Library:
    """Return a node in C, compiled once."""
    loop = LOOPS[name]()
    return compile_node(loop.policy, role, loop.network, Path(mkdtemp()), seed=1)


def node(role: str, name: str = "ideal", epoch: int = 9) -> Device:
    """Return a fresh node with a key."""
    return Device(library(name, role), KEY, epoch, LOOP)


def wire(name: str = "ideal", key: bytes = KEY) -> Wire:
    """Return the encoder of its packets."""
    loop = LOOPS[name]()
    return Wire(loop.policy, loop.network, key)


def command(tick: int, sequence: int, epoch: int, value: float = 0.25) -> Packet:
    """Return a packet of the controller."""
    return Packet("data", "actuator", tick, sequence, (value,), epoch, LOOP)


def sent(device: Device, name: str = "ideal") -> list[Packet]:
    """Return the packets that a node sends."""
    found = [wire(name).decode(datagram) for datagram in device.send()]
    assert all(isinstance(packet, Packet) for packet in found)
    return found  # type: ignore[return-value]


def test_a_recorded_packet_is_of_no_use_and_a_running_sender_is_believed() -> None:
    """Whatever its epoch; the sender may also have a smaller epoch than before, when it has started again."""
    device, nonces = node("actuator"), list[int]()
    for epoch in (2**31, 3, 2):
        for tick in (1_000_000, 40):
            assert not device.receive(wire().encode(command(tick, 0, epoch, 9.0)))
            (asked,) = sent(device)
            assert (asked.kind, asked.link, asked.back) == ("challenge", "actuator", True)
            nonces.append(asked.nonce)
        assert not device.receive(wire().encode(answer_to(asked._replace(nonce=asked.nonce ^ 1), epoch, 40)))
        assert not device.receive(wire().encode(command(40, 0, epoch)))
        assert len(sent(device)) == 1
        assert not device.receive(wire().encode(answer_to(asked, epoch, 40)))
        assert device.receive(wire().encode(command(40, 0, epoch)))
        assert not device.receive(wire().encode(command(38, 9, epoch, 9.0)))  # before the proof
        assert not sent(device)
    assert [nonces.count(nonce) for nonce in nonces] == [2] * 6
    assert device.counters == {"received": 3, "unproven": 12, "proofs": 6, "superseded": 2}
    assert device.step(40)
    assert device.input == (0.25,)


def test_nonces_differ_between_starts_loops_and_challenges() -> None:
    """And nobody without the key can compute them."""
    found = set[int]()
    for epoch in range(3):
        for loop in range(3):
            device = Device(library("ideal", "actuator"), KEY, epoch, loop)
            device.receive(wire().encode(command(1, 0, 5)._replace(loop=loop)))
            found |= {packet.nonce for packet in sent(device)}
    other = Device(library("ideal", "actuator"), OTHER, 0, 0)
    other.receive(wire(key=OTHER).encode(command(1, 0, 5)._replace(loop=0)))
    (asked,) = (wire(key=OTHER).decode(datagram) for datagram in other.send())
    assert isinstance(asked, Packet)
    assert len(found | {asked.nonce}) == 10


@pytest.mark.parametrize("every", [None, 0])
def test_a_node_answers_and_repeats_its_last_packets(every: int | None) -> None:
    """The answer names the step before the last one; then come its last packets, once in a step."""
    device = node("controller")
    if every is not None:
        device.mark_after(every)
    asked = Packet("challenge", "actuator", 0, 0, (), 0, LOOP, True, 77)
    assert not device.receive(wire().encode(asked))
    assert sent(device) == [answer_to(asked, 9, -1)]
    for tick in range(3):
        assert device.step(tick, [5.0, -5.0])
        last = sent(device)
    assert len(last) == (1 if every is None else 2)
    for again in (last, []):
        assert not device.receive(wire().encode(asked))
        assert sent(device) == [answer_to(asked, 9, 2), *again]
    assert not device.receive(wire().encode(asked._replace(back=False)))  # of what it does not send
    assert not device.receive(wire().encode(asked._replace(loop=LOOP + 1)))
    assert not sent(device)


def test_a_node_is_not_taken_in_by_its_own_packets() -> None:
    """Its challenge and its marks come back: they travel in the wrong direction."""
    device, told = node("controller", "untold"), wire("untold")
    ack = Packet("acknowledgement", "actuator", 0, 0, (), 3, LOOP)
    assert not device.receive(told.encode(ack))
    (asked,) = sent(device, "untold")
    assert (asked.kind, asked.link, asked.back) == ("challenge", "actuator", False)
    for packet in (asked, asked._replace(kind="answer", epoch=9), Packet("mark", "actuator", 0, 0, (), 9, LOOP)):
        assert not device.receive(told.encode(packet))
    assert device.counters == {"received": 1, "misdirected": 1, "unproven": 1, "proofs": 2}
    assert not device.receive(told.encode(answer_to(asked, 3, -1)))
    assert device.receive(told.encode(ack))


def test_a_saved_node_keeps_its_proofs() -> None:
    """Also an open challenge: a restored node accepts the answer to it."""
    device = node("actuator")
    assert not device.receive(wire().encode(command(1, 0, 3)))
    saved = device.save()
    (asked,) = sent(device)
    restored = node("actuator")
    assert restored.restore(saved)
    assert not restored.receive(wire().encode(answer_to(asked, 3, 1)))
    assert restored.receive(wire().encode(command(1, 0, 3)))
    again = node("actuator")
    assert again.restore(restored.save())
    assert again.receive(wire().encode(command(2, 1, 3)))


def test_keys_change_without_a_stop() -> None:
    """Accept the new key, use it, accept it alone; a key of another link is of no use on this one."""
    device, old, new = node("actuator"), wire(), wire(key=OTHER)
    assert not device.receive(old.encode(command(1, 0, 3)))
    (asked,) = sent(device)
    assert not device.receive(old.encode(answer_to(asked, 3, 1)))
    found = []
    for i, keys in enumerate([(KEY,), (KEY, OTHER), (OTHER, KEY), (OTHER,)]):
        device.set_keys("actuator", *keys)
        datagrams = (one.encode(command(2, 2 * i + k, 3)) for k, one in enumerate((old, new)))
        found.append([device.receive(datagram) for datagram in datagrams])
    assert found == [[True, False], [True, True], [True, True], [False, True]]
    device.set_keys("sensor", KEY)
    assert not device.receive(old.encode(command(2, 9, 3)))
    assert device.counters["forged"] == 3


def test_a_link_without_a_key_accepts_nothing_if_another_link_has_one() -> None:
    """A datagram on it is refused for the reason that a host gives, whether it has a tag or not."""
    device, loop = node("actuator", "delayed"), LOOPS["delayed"]()
    device.set_keys("sensor", None)
    host = Wire(loop.policy, loop.network, Keys({"actuator": (KEY,)}))
    mark, told = Packet("mark", "sensor", 3, 0, (), 3, LOOP), wire("delayed")
    changed = bytearray(told.encode(mark._replace(link="actuator")))
    changed[6] = wire_links(loop.policy).index("sensor")
    untagged = Wire(loop.policy, loop.network).encode(mark)
    wrong = [told.encode(mark), wire("delayed", OTHER).encode(mark), bytes(changed), untagged, untagged + bytes(16)]
    assert not any(device.receive(datagram) for datagram in wrong)
    reasons = [str(host.decode(datagram)) for datagram in wrong]
    assert reasons == ["forged", "forged", "corrupted", "malformed", "foreign"]
    assert device.counters == {reason: reasons.count(reason) for reason in reasons}


FORWARD = {"sensor": "controller", "actuator": "actuator"}  # receivers of packets that travel along a link
BACKWARD = {"sensor": "sensor", "actuator": "controller"}


def deliver(nodes: dict[str, Device], told: Wire) -> None:
    """Give every node what the others send, until none sends any more."""
    moved = True
    while moved:
        moved = False
        for one in nodes.values():
            for datagram in one.send():
                packet, moved = told.decode(datagram), True
                assert isinstance(packet, Packet)
                back = packet.back or packet.kind == "acknowledgement"
                nodes[(BACKWARD if back else FORWARD)[packet.link]].receive(datagram)


def test_nodes_with_keys_decide_as_nodes_without() -> None:
    """Three nodes in C on links with acknowledgements, which exchange what each of them sends: the same inputs."""
    loop = LOOPS["delayed"]()
    places: tuple[str, ...] = ("sensor", "controller", "actuator")
    found = []
    for key in (None, KEY):
        nodes: dict[str, Device] = {
            role: Device(library("delayed", role), key, 20 + i, LOOP) for i, role in enumerate(places)
        }
        for one in nodes.values():
            one.mark_after(0)
        plant, inputs = SimulatedPlant(loop, seed=3), list[tuple[float, ...] | None]()
        for tick in range(40):
            for role, one in nodes.items():
                assert one.step(tick, plant.measurement if role == "sensor" else None)
                deliver(nodes, Wire(loop.policy, loop.network, key))
            inputs.append(nodes["actuator"].input)
            plant.move(inputs[-1] or ())
        found.append(inputs)
    assert found[0] == found[1]
    assert len(set(found[0])) > 8
