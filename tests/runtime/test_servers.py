"""What servers of nodes and plants do with packets that are old, far too early, or come again."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from counts import few

import taciturn
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet, Wire
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn_udp.endpoint import Endpoint
from taciturn_udp.nodes import BLIND, NodeServer
from taciturn_udp.plant import PlantServer

PROBLEM = taciturn.load("two-mass-lqg")
POLICY = PROBLEM.design()
WIRE = Wire(POLICY)
TICK = 0.02


@pytest.fixture
def here() -> Iterator[Endpoint]:
    """Give an endpoint that plays everybody else."""
    with Endpoint(("127.0.0.1", 0)) as endpoint:
        yield endpoint


def serving(role: str, here: Endpoint, tick: float | None) -> NodeServer:
    """Return the server of one node, whose peer, if it needs one, and plant are here."""
    node = Node(POLICY, role)  # type: ignore[arg-type]
    there = Endpoint(("127.0.0.1", 0))
    peer = here.address if role == "controller" else None
    return NodeServer([node], WIRE, there, peer=peer, plant=here.address, tick=tick)


def soon(seconds: float) -> Callable[[], bool]:
    """Return what tells whether so much time has gone by."""
    end = time.monotonic() + seconds
    return lambda: time.monotonic() > end


def measured(tick: int, epoch: int = 100, sequence: int | None = None) -> bytes:
    """Return the measurement of a step."""
    number = tick if sequence is None else sequence
    return WIRE.encode(Packet("measurement", "plant", tick, number, (0.5, -0.5), epoch))


def given(tick: int, value: float, epoch: int = 100, sequence: int | None = None) -> bytes:
    """Return the input of a step."""
    return WIRE.encode(Packet("input", "plant", tick, tick if sequence is None else sequence, (value,), epoch))


@pytest.mark.parametrize("tick", few([None, TICK], 1))
def test_measurements_of_far_ticks_and_of_old_epochs_are_dropped(here: Endpoint, tick: float | None) -> None:
    """A node continues with the present: what cannot have begun, and what is old, changes nothing and is counted."""
    server = serving("controller", here, tick)
    with server.endpoint:
        to = server.endpoint.address
        for k in range(3):
            here.send(measured(k), to)
        server.run(3, soon(2.0))
        strange = [
            measured(2**62, sequence=50),
            measured(470, sequence=51),
            measured(1, epoch=7),
            measured(400, epoch=7),
        ]
        for datagram in strange:
            here.send(datagram, to)
        number = 1 + server.run(None, soon(0.3))["tick"]  # in real time, the node goes on for a while
        assert number == 3 if tick is None else 3 <= number <= 3 + BLIND
        here.send(measured(number, sequence=60), to)
        report = server.run(number + 1, soon(2.0))
    assert report["tick"] == number
    assert report["refused"] == {"ahead": 2, "replayed": 2}
    assert report["counters"].get("missed", 0) == 0
    assert report["counters"].get("missing", 0) == number - 3


@pytest.mark.evidence
def test_an_answer_is_given_again_but_not_often(here: Endpoint) -> None:
    """In virtual time a measurement that comes again is answered again, once in a while; in real time never."""
    for tick in (None, TICK):
        server = serving("controller", here, tick)
        with server.endpoint:
            here.send(measured(0), server.endpoint.address)
            server.run(1, soon(2.0))
            first = here.receive(time.monotonic() + 0.2)
            for _ in range(20):
                here.send(measured(0), server.endpoint.address)
            server.run(None, soon(0.3))
            again = [datagram for datagram in here.receive(time.monotonic() + 0.2) if datagram in first]
        assert first
        assert len(again) == (len(first) if tick is None else 0)


def test_in_virtual_time_the_packets_of_the_last_two_steps_are_repeated(here: Endpoint) -> None:
    """A node with a lag of one step may have executed two steps before the port of its receiver was open."""
    server = serving("controller", here, None)
    with server.endpoint:
        for tick in range(3):
            here.send(measured(tick), server.endpoint.address)
        server.run(3, soon(5.0))
        first = [WIRE.decode(datagram) for datagram in here.receive(time.monotonic() + 0.2)]
        here.send(measured(2), server.endpoint.address)
        server.run(None, soon(0.3))
        again = [WIRE.decode(datagram) for datagram in here.receive(time.monotonic() + 0.2)]
    assert again == [packet for packet in first if isinstance(packet, Packet) and packet.tick > 0]


def test_in_virtual_time_no_step_begins_before_every_mark_has_arrived(here: Endpoint) -> None:
    """The mark of step 1 does not show that the packet of step 0 has arrived, as both may have been dropped."""
    server = serving("actuator", here, None)
    marks = [WIRE.encode(Packet("mark", "actuator", tick, tick, (), 100)) for tick in range(2)]
    with server.endpoint:
        here.send(marks[1], server.endpoint.address)
        server.run(2, soon(0.3))
        assert server.nodes[0].tick == -1
        here.send(WIRE.encode(Packet("data", "actuator", 0, 0, (0.25,), 100)), server.endpoint.address)
        here.send(marks[0], server.endpoint.address)
        server.run(2, soon(5.0))
        assert server.nodes[0].tick == 1
        assert server.nodes[0].counters["used"] == 1


def test_refused_packets_do_not_move_the_clock(here: Endpoint) -> None:
    """Copies of one old packet are counted, and the actuator keeps its steps."""
    server = serving("actuator", here, TICK)
    with server.endpoint:
        to, began = server.endpoint.address, time.monotonic()
        for k in range(10):
            while time.monotonic() < began + k * TICK:
                server.run(None, soon(0.002))
            here.send(WIRE.encode(Packet("data", "actuator", k, k, (0.1,), 100)), to)
            for _ in range(4):
                here.send(WIRE.encode(Packet("data", "actuator", 470, 3, (9.0,), 5)), to)
        report = server.run(None, soon(0.2))
    assert report["counters"]["replayed"] == 40
    assert 9 <= report["tick"] < 40
    assert report["clock_jumps"] == 0


def test_a_node_that_was_away_for_long_takes_the_clock_from_packets_far_ahead(here: Endpoint) -> None:
    """After 190 steps it drops what comes until eight packets in a row agree on the time, and uses the next."""
    server = serving("actuator", here, TICK)
    with server.endpoint, ThreadPoolExecutor() as thread:
        running, began = thread.submit(server.run, 213, soon(5.0)), time.monotonic()
        for i, tick in enumerate([0, 1, 2, *range(193, 213)]):
            time.sleep(max(0.0, began + i * TICK - time.monotonic()))
            here.send(WIRE.encode(Packet("data", "actuator", tick, i, (0.1,), 100)), server.endpoint.address)
        report = running.result()
    assert report["tick"] == 212
    assert report["clock_jumps"] == 1
    assert 8 <= report["counters"]["ahead"] <= 16  # eight in a row, where nothing else delays the packets
    assert report["counters"]["used"] >= 4


def test_the_watchdog_runs_before_the_first_step(here: Endpoint) -> None:
    """An actuator that receives only packets of another policy applies its safe input, is degraded, and says why."""
    said: list[str] = []
    node = Node(POLICY, "actuator", watchdog=5, safe=(-1.5,), epoch=100)
    there = Endpoint(("127.0.0.1", 0))
    server = NodeServer([node], WIRE, there, plant=here.address, tick=TICK, say=said.append)
    with server.endpoint:
        here.send(b"noise", there.address)
        report = server.run(None, soon(12 * TICK))
        packets = [WIRE.decode(datagram) for datagram in here.receive(time.monotonic() + 0.2)]
        assert len(packets) >= 2
        assert {(packet.values, packet.epoch, packet.tick) for packet in packets} == {((-1.5,), 100, 0)}
        assert report["degraded"] == {"silent actuator": 1}
        assert len(said) == 1
        assert "no usable packet on the link actuator for 5 steps" in said[0]
        assert "1 malformed" in said[0]
        here.send(WIRE.encode(Packet("data", "actuator", 7, 0, (0.1,), 100)), there.address)
        server.run(8, soon(2.0))
    assert not node.silent
    assert node.step(9).input == (0.1,)


def test_inputs_wait_for_their_tick_and_far_ones_are_dropped(here: Endpoint) -> None:
    """A plant applies at step k what was computed for step k, also where the next one has come already."""
    loop = PROBLEM.close(POLICY)
    with Endpoint(("127.0.0.1", 0)) as endpoint:
        plant = SimulatedPlant(loop, 1)
        server = PlantServer([plant], WIRE, endpoint, here.address)
        datagrams = [given(1, 0.75), given(470, 9.0, sequence=470), given(2**60, 9.0, sequence=500), given(0, 0.25)]
        for datagram in [*datagrams, given(2, 0.5, epoch=3)]:
            here.send(datagram, endpoint.address)
        report = server.run(2, soon(2.0))
        seen = [server.given(0)]
    other = SimulatedPlant(loop, 1)
    costs = [other.move([0.25]), other.move([0.75])]
    assert server.costs[0] == costs
    assert seen == [(0.75,)]
    assert report["refused"] == {"ahead": 2, "replayed": 1}


def test_an_input_of_an_earlier_start_is_not_applied_after_one_of_a_later_start(here: Endpoint) -> None:
    """An actuator that was ahead of time has sent an input of step 2, and has started again since."""
    with Endpoint(("127.0.0.1", 0)) as endpoint:
        server = PlantServer([SimulatedPlant(PROBLEM.close(POLICY), 1)], WIRE, endpoint, here.address)
        for datagram in [given(2, 9.0, sequence=2), given(0, 0.25, epoch=200), given(1, 0.75, sequence=1, epoch=200)]:
            here.send(datagram, endpoint.address)
        server.run(3, soon(2.0))
    assert server.given(0) == (0.75,)
    assert server.held == 1


@pytest.mark.parametrize(
    ("own", "other", "why", "told"),
    [
        (WIRE, Wire(PROBLEM.changed({"theta": 0.7}).design()), "foreign", "of another policy"),
        pytest.param(
            WIRE, Wire(POLICY, key=b"k" * 32), "foreign", "with a key on one side only", marks=pytest.mark.evidence
        ),
        pytest.param(
            Wire(POLICY, key=b"k" * 32), WIRE, "malformed", "too short for the tag of a key", marks=pytest.mark.evidence
        ),
        (Wire(POLICY, key=b"k" * 32), Wire(POLICY, key=b"l" * 32), "forged", "of another key"),
    ],
    ids=["policy", "no key", "key", "other key"],
)
def test_who_refuses_packets_of_another_policy_says_so_once(
    here: Endpoint, own: Wire, other: Wire, why: str, told: str
) -> None:
    """Node and plant name the sender; what comes later is only counted."""
    said: list[str] = []
    with Endpoint(("127.0.0.1", 0)) as endpoint:
        nodes = NodeServer([Node(POLICY, "actuator")], own, endpoint, plant=here.address, say=said.append)
        plants = PlantServer([SimulatedPlant(PROBLEM.close(POLICY))], own, endpoint, here.address, say=said.append)
        for server, name in ((nodes, "actuator"), (plants, "plant")):
            for k in range(5):
                here.send(other.encode(Packet("data", "actuator", k, k, (0.5,))), endpoint.address)
            server.run(1, soon(0.3))
            assert server.refused == {why: 5}
            sentence = said.pop()
            assert sentence.startswith(f"the {name} refuses packets")
            assert told in sentence
            assert f" from {here.address[0]}:{here.address[1]}: same problem file" in sentence
            assert not said


@pytest.mark.evidence
def test_a_plant_without_inputs_says_whom_it_waits_for(here: Endpoint, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a while and again after a longer one; not where the input comes."""
    monkeypatch.setattr("taciturn_udp.plant.WAITED", 0.6)
    monkeypatch.setattr("taciturn_udp.plant.WAITED_AGAIN", 0.4)
    said: list[str] = []
    with Endpoint(("127.0.0.1", 0)) as endpoint:
        plants = [SimulatedPlant(PROBLEM.close(POLICY))]
        server = PlantServer(plants, WIRE, endpoint, here.address, say=said.append)
        here.send(given(0, 0.5), endpoint.address)
        server.run(1, soon(10.0))
        assert said == []
        server.run(1, soon(1.5))
    assert 2 <= len(said) <= 3
    assert f"step 0 from the nodes behind {here.address[0]}:{here.address[1]}: are all nodes running" in said[0]
