"""The link of set-points in exported C is as every other link: key, proof, replay window and counters."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pytest
from counts import few
from export.devices import Device, Library, compile_checked, compile_node, feed
from runtime.test_packets import KEY

from taciturn.loop import Loop
from taciturn.model.packets import wire_links
from taciturn.model.wire import ANY_LINK, ANY_POLICY, SETPOINT
from taciturn.nodes.keys import Keys
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Frames, Packet, Wire
from taciturn.problem import parse
from taciturn_export.export import export_c
from taciturn_udp.proofs import answer_to

OTHER = bytes(range(40, 60))
SECRET = b"sixteen bytes..."  # of feed.c
TANK: dict[str, Any] = {
    "plant": {
        "A": [[1.0, 0.0], [0.1, 0.9]], "B": [[0.05], [0.0]], "C": [[0.0, 1.0]],
        "W": [[1e-4, 0.0], [0.0, 1e-4]], "V": [[1e-3]], "dt": 1.0,
    },
    "reference": {"value": [3.0], "steps": {"rate": 0.01, "covariance": [[4.0]]}},
    "cost": {"Q": [[0.0, 0.0], [0.0, 1.0]], "R": [[0.05]]},
    "nodes": {"probe": {"measures": True}, "box": {"controls": True}, "valve": {"applies": True}},
    "policy": {"kind": "distributed", "theta": 0.5},
}  # fmt: skip


@cache
def tank() -> Loop:
    """Return a tank whose level follows changing set-points, with a node for each task."""
    problem = parse(TANK, "tank")
    return problem.close(problem.design())


@cache
def library() -> Library:
    """Return its controller in C."""
    return compile_node(tank().policy, "box", tank().network, Path(mkdtemp()))


def wire(key: bytes | Keys | None = KEY) -> Wire:
    """Return the encoder of its packets."""
    return Wire(tank().policy, tank().network, key)


def point(tick: int, sequence: int, value: float = 1.0, epoch: int = 5) -> Packet:
    """Return a packet with a set-point."""
    return Packet("measurement", SETPOINT, tick, sequence, (value,), epoch)


def prove(device: Device, epoch: int, key: bytes = KEY) -> None:
    """Answer the challenge that a packet with a set-point causes."""
    assert not device.receive(wire(key).encode(point(0, 0, epoch=epoch)))
    (asked,) = map(wire(key).decode, device.send())
    assert isinstance(asked, Packet)
    assert (asked.kind, asked.link, asked.back) == ("challenge", SETPOINT, True)
    assert not device.receive(wire(key).encode(answer_to(asked, epoch, -1)))


@pytest.mark.parametrize("key", few([None, SECRET], 1))
def test_set_points_after_lost_packets_break_no_memory(tmp_path: Path, key: bytes | None) -> None:
    """Every access of the exported node is checked, with the sizes of the export; it counts as a node in Python."""
    program, rng = compile_checked(tank().policy, "box", tank().network, tmp_path), np.random.default_rng(1)
    host, given, coder = Node(tank().policy, "box", epoch=9), list[bytes](), wire(key)
    for tick in range(200):
        news = (
            [Packet("data", "probe", tick, tick, tuple(rng.normal(size=3).tolist()), 5)] if rng.random() < 0.6 else []
        )
        step, sequence = (max(0, tick - int(late)) for late in rng.integers(4, size=2))
        news += [point(step, sequence, float(rng.normal()))] if tick % 3 else []
        for packet in news:
            given.append(coder.encode(packet))
            host.sort_in(packet)
        host.step(tick)
        given.append(b"")
    counted = feed(program, given, *(["key"] if key else []))[-1].split()
    found = {name: int(number) for name, number in zip(counted[::2], counted[1::2], strict=True)}
    if key is None:
        assert {name: host.counters[name] for name in ("received", "used", "late", "replayed")}.items() <= found.items()
        assert found["received"] > 150
    else:  # nobody has answered a challenge
        assert found["received"] == 0
        assert found["unproven"] > 150


@pytest.mark.evidence
def test_set_points_of_a_running_sender_are_believed() -> None:
    """Also after a restart with a smaller epoch; the recording of the former epoch is then of no use."""
    device = Device(library(), KEY, 9)
    for epoch in (2**31, 3):
        prove(device, epoch)
        assert device.receive(wire().encode(point(1, 1, epoch=epoch)))
        assert not device.receive(wire().encode(point(1, 1, epoch=epoch)))  # a duplicate
    assert not device.receive(wire().encode(point(9, 9, epoch=2**31)))
    assert device.counters["duplicate"] == 2
    saved, again = device.save(), Device(library(), KEY, 10)
    assert again.restore(saved)
    assert again.receive(wire().encode(point(2, 2, epoch=3)))


@pytest.mark.evidence
def test_the_link_of_set_points_has_its_own_key() -> None:
    """A datagram with the key of another link is forged, as for a node in Python."""
    device, host = Device(library(), KEY, 9), wire(Keys({"probe": (KEY,), "valve": (KEY,), SETPOINT: (OTHER,)}))
    device.set_keys(SETPOINT, OTHER)
    datagram = wire(KEY).encode(point(1, 1))
    assert host.decode(datagram) == "forged"
    assert not device.receive(datagram)
    assert device.counters == {"forged": 1}
    prove(device, 5, OTHER)
    assert device.receive(host.encode(point(1, 1)))


def test_a_key_of_a_link_without_packets_is_refused() -> None:
    """The function says so, and changes nothing behind its tables."""
    code, none = library().code, Device(library()).key
    device = Device(library(), KEY, 9)
    for link in range(256):
        known = link < len(wire_links(tank().policy))
        assert bool(code.tac_set_keys(device.node, link, none, none) & 1) == known


def test_the_page_of_an_export_names_the_number_of_the_link(tmp_path: Path) -> None:
    """A program must know it to send set-points and to set the key."""
    problem = parse(TANK, "tank")
    export_c(problem, tmp_path)
    number = wire_links(tank().policy).index(SETPOINT)
    assert f"{number}: set-points to `box`" in (tmp_path / "README.md").read_text()


@pytest.mark.parametrize("key", [None, KEY], ids=["plain", "keyed"])
def test_an_operator_learns_the_policy_from_a_device(key: bytes | None) -> None:
    """The answer repeats the nonce, and the report contains what the operator and the device need of each other."""
    device, coder = Device(library(), key, 9), wire(key)
    asks = Frames(ANY_POLICY, {ANY_LINK: SETPOINT}, {}, coder.keys)
    for epoch, points in ((0, (3.0, 3.0)), (5, (1.5, 1.5))):
        assert not device.receive(asks.encode(Packet("challenge", SETPOINT, 0, 0, nonce=77)))
        answer, report = (coder.decode(one) for one in device.send() if coder.decode(one)[0] in ("answer", "report"))
        assert isinstance(answer, Packet)
        assert isinstance(report, Packet)
        assert (answer.nonce, answer.back, answer.epoch) == (77, True, epoch)
        assert report.values == points
        given = Packet("setpoint", SETPOINT, report.tick, 0, (1.5,), 5)
        if key is not None and not epoch:
            assert not device.receive(coder.encode(given))
            (asked,) = map(coder.decode, device.send())
            assert isinstance(asked, Packet)
            assert not device.receive(coder.encode(answer_to(asked, 5, report.tick)))
        assert device.receive(coder.encode(given)) == (not epoch)
        device.step(epoch + 1)
        found = [one for one in map(coder.decode, device.send()) if isinstance(one, Packet) and one.kind == "report"]
        assert [(one.tick, one.epoch, one.values) for one in found] == [(epoch + 2, 5, (1.5, 1.5))]
