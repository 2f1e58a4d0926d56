"""A watchdog for each link: the node names the link on which nothing arrives, within the interval of that link."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import pytest
from export.devices import Device, compile_node

from taciturn.loop import Loop
from taciturn.model.policy import longest_silence
from taciturn.model.wire import SETPOINT
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet, Wire
from taciturn.problem import parse
from taciturn_udp.endpoint import Endpoint
from taciturn_udp.nodes import NodeServer

INTERVAL, WATCHDOG = 20, 30
TANKS: dict[str, Any] = {
    "plant": {
        "A": [[0.97, 0.0], [0.0, 0.98]], "B": [[0.1, 0.0], [0.0, 0.1]], "C": [[1.0, 0.0], [0.0, 1.0]],
        "W": [[0.01, 0.0], [0.0, 0.01]], "V": [[0.04, 0.0], [0.0, 0.04]], "dt": 2.0,
    },
    "reference": {"value": [1.0, 0.0], "steps": {"rate": 0.01, "covariance": [[1.0, 0.0], [0.0, 1.0]]}},
    "cost": {"Q": [[1.0, 0.0], [0.0, 1.0]], "R": [[0.1, 0.0], [0.0, 0.1]]},
    "nodes": {
        "level-1": {"measures": [0]}, "level-2": {"measures": [1]}, "plc": {"controls": True},
        "pump-1": {"applies": [0]}, "pump-2": {"applies": [1]},
    },
    "links": {"level-1": {"max_interval": INTERVAL}},
    "policy": {"kind": "distributed", "theta": 1.0, "prediction": "model", "actuation": "model"},
}  # fmt: skip


@cache
def tanks() -> Loop:
    """Return two tanks with a sensor and a pump each, and one controller."""
    problem = parse(TANKS, "tanks")
    return problem.close(problem.design())


def plc(**given: Any) -> Node:
    """Return the controller."""
    return Node(tanks().policy, "plc", watchdog=WATCHDOG, epoch=1, **given)


def mark(link: str, tick: int) -> Packet:
    """Return a mark, which a sensor sends while its policy is silent."""
    return Packet("mark", link, tick, tick, (), 1)


@pytest.mark.evidence
def test_a_mark_of_its_own_that_is_sent_back_to_a_node_is_no_sign_of_life() -> None:
    """Neither in Python nor in C: the tag of such a mark is right, so its direction must tell."""
    loop = tanks()
    valve = Node(loop.policy, "pump-1", epoch=1, watchdog=5)
    device = Device(compile_node(loop.policy, "pump-1", loop.network, Path(mkdtemp())), epoch=1)
    device.watch(5)
    wire = Wire(loop.policy, loop.network)
    for tick in range(12):
        own = Packet("mark", "pump-1", tick, tick, (), 1, back=True)
        assert valve.sort_in(own) == "misdirected"
        assert not device.receive(wire.encode(own))
        valve.step(tick)
        device.step(tick)
    assert valve.silent
    assert device.silent
    assert valve.counters["misdirected"] == device.counters["misdirected"] == 12
    controllers = mark("pump-1", 11)
    assert valve.sort_in(controllers) == "marks"
    assert device.receive(wire.encode(controllers))


@pytest.mark.parametrize(("dead", "limit"), [("level-1", INTERVAL), ("level-2", WATCHDOG)])
def test_one_of_two_sensors_dies_and_the_controller_names_its_link(dead: str, limit: int) -> None:
    """Within ``max_interval`` of its link, else within the watchdog; set-points and the other sensor do not hide it.

    The node in C finds the same.
    """
    device = Device(compile_node(tanks().policy, "plc", tanks().network, Path(mkdtemp())), None, 1)
    device.watch(WATCHDOG)
    host, wire = plc(), Wire(tanks().policy)
    code = wire.links.index(dead)
    for tick in range(200):
        alive = [link for link in ("level-1", "level-2") if link != dead or tick <= 73 or tick >= 150]
        points = Packet("measurement", SETPOINT, tick, tick, (1.0, 0.0), 1)
        for packet in (points, *(mark(link, tick) for link in alive)):
            host.sort_in(packet)
            device.receive(wire.encode(packet))
        host.step(tick)
        assert device.step(tick)
        silent = 73 + limit <= tick < 150
        assert host.silent_links == ((dead,) if silent else ())
        assert bool(device.code.tac_silent_on(device.node, code) & 1) == silent
        assert host.degraded == device.degraded
        assert host.degraded >= silent
        assert not host.silent
        assert not device.silent
    assert dict(host.reasons) == {f"silent {dead}": 1}


def test_a_sensor_that_never_starts_is_named() -> None:
    """The controller joins a running loop, and counts from its first step."""
    node = plc()
    for tick in range(100, 100 + INTERVAL):
        node.step(tick, packets=[mark("level-2", tick)])
        assert node.silent_links == (("level-1",) if tick == 100 + INTERVAL - 1 else ())


def test_all_links_silent_make_the_node_silent_and_its_input_safe() -> None:
    """A single dead sensor does not: the node goes on with what arrives."""
    tables = {**TANKS, "nodes": {**TANKS["nodes"], "pump-1": {"applies": [0], "site": "plc"}}}
    problem = parse(tables, "tanks")
    node = Node(problem.design(), "plc", watchdog=WATCHDOG, safe=(0.5,))
    for tick in range(100):
        alive = [link for link in ("level-1", "level-2") if tick < (20 if link == "level-1" else 40)]
        given = node.step(tick, packets=[mark(link, tick) for link in alive]).input
        assert node.silent == (tick >= 39 + WATCHDOG)
        assert (given == (0.5,)) == node.silent
    assert dict(node.reasons) == {"silent level-1": 1, "silent level-2": 1}


def test_a_saved_node_remembers_when_it_heard_each_link() -> None:
    """A restart does not restart the watchdogs."""
    node, again = plc(), plc()
    for tick in range(INTERVAL - 2):
        node.step(tick, packets=[mark("level-2", tick)])
    again.restore(node.save())
    for tick in range(INTERVAL - 2, INTERVAL + 2):
        again.step(tick, packets=[mark("level-2", tick)])
    assert again.silent_links == ("level-1",)


def test_the_limit_is_the_interval_only_where_no_packet_is_lost() -> None:
    """Where packets are lost, a missing one is no sign of a dead sender; nor is a limit beyond the watchdog of use."""
    network = tanks().network
    assert longest_silence(network, "level-1") == INTERVAL
    assert longest_silence(network, "level-2") is None
    lossy = parse({**TANKS, "reference": {}, "links": {"level-1": {"max_interval": INTERVAL, "loss": 0.1}}}, "lossy")
    assert longest_silence(lossy.network, "level-1") is None
    assert Node(tanks().policy, "plc", watchdog=5).limits == {"level-1": 5, "level-2": 5}
    assert Node(tanks().policy, "plc").limits == {}


def test_a_process_prints_which_link_is_silent_and_logs_it() -> None:
    """With the number of steps of this link."""
    said, told, here, now = list[str](), list[Any](), Endpoint(("127.0.0.1", 0)), 0.0
    wire, there = Wire(tanks().policy), Endpoint(("127.0.0.1", 0))
    peers = {"pump-1": here.address, "pump-2": here.address}
    node = Node(tanks().policy, "plc", watchdog=10)
    with here, there:
        server = NodeServer(
            [node], wire, there, peer=peers, tick=0.005, say=said.append, told=told.append, clock=lambda: now
        )
        turns = server.turns(lambda: False)
        next(turns)
        for tick in range(60):  # in virtual time, so that no other process of this machine delays the packets
            now, there.senders = 0.005 * tick, [here.address]
            turns.send([wire.encode(mark("level-2", tick))])
            now, there.senders = 0.005 * tick + 0.003, []
            turns.send([])
        report = server.report()
    assert report["degraded"].get("silent level-1") == 1
    assert any("no usable packet on the link level-1 for 10 steps" in one for one in said)
    assert told[-1]["silent_links"] == ["level-1"]
    assert told[-1]["degraded"] == 1
