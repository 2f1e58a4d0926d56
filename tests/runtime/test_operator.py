"""An operator gives a running controller set-points, which the controller keeps within their range and ramp."""

from __future__ import annotations

import ctypes
import json
import threading
import time
from collections.abc import Generator, Sequence
from contextlib import closing, contextmanager
from typing import Any

import numpy as np
import pytest
from counts import few
from typer.testing import CliRunner

import taciturn
from taciturn import Loop, Nodes, Problem, ProblemError
from taciturn.cli import app
from taciturn.model.set_points import IN_EFFECT
from taciturn.model.signals import Timetable, set_point_limits
from taciturn.model.wire import SETPOINT
from taciturn.nodes.inbox import OPERATOR, Handling
from taciturn.nodes.keys import Keys
from taciturn.nodes.node import Measurement, Node, Stepped
from taciturn.nodes.packet import Packet, Wire
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn_udp.endpoint import Address, Endpoint
from taciturn_udp.nodes import NodeServer
from taciturn_udp.operator import Operator
from taciturn_udp.plant import PlantServer
from taciturn_worlds.devices import DeviceCode, DeviceNode

RANGE, RAMP = (-5.0, 5.0), 0.25
SECRET = Keys({"plant": (bytes(16),), "actuator": (bytes(range(16)),), SETPOINT: (bytes(range(16, 32)),)})


def tank(**changes: object) -> Problem:
    """Return the tank of a PID controller, whose set-point only an operator changes, within limits."""
    return taciturn.load("pid-tank").changed({"reference.range": [[*RANGE]], "reference.ramp": [RAMP], **changes})


def operated(number: int, value: float, epoch: int = 7, tick: int = 0) -> Packet:
    """Return a packet of an operator."""
    return Packet("setpoint", SETPOINT, tick, number, (value,), epoch)


def limited(points: Sequence[float], start: float = 0.0) -> list[float]:
    """Return the set-points in effect, by the definition of a range and a ramp."""
    found = list[float]()
    for point in points:
        start = min(max(point, start - RAMP), start + RAMP)
        found.append(start := min(max(start, RANGE[0]), RANGE[1]))
    return found


@pytest.mark.parametrize("seed", few(range(2), 1))
def test_nodes_in_python_and_in_c_keep_range_and_ramp_alike(seed: int) -> None:
    """Every packet, counter and set-point in effect, also of packets that are repeated, late or overtaken."""
    policy, rng = tank().design(), np.random.default_rng(seed)
    wire, node, nodes = Wire(policy), Node(policy, "controller", epoch=1), Nodes(policy)
    device = DeviceNode(
        DeviceCode(policy, "controller", policy.network), policy, "controller",
        network=policy.network, epoch=1, seed=0, watchdog=None, safe="hold",
    )  # fmt: skip
    asked, effect, reports = list[float](), list[float](), 0
    for tick in range(200):
        news = [operated(int(rng.integers(max(0, tick - 9), tick + 1)), 4 * float(rng.normal())) for _ in range(2)]
        plants = Packet("measurement", SETPOINT, max(0, tick - int(rng.integers(3))), tick, (9.0,), 3)
        for packet in (plants, *(news if rng.random() < 0.3 else [])):
            node.sort_in(packet)
            device.receive(wire.encode(packet))
        y = rng.normal(size=1).tolist()
        sent = node.step(tick, y).packets
        assert node.set_points is not None
        told = device.step(tick, y).packets
        assert sent == tuple(packet for packet in told if packet.kind not in ("report", "mode"))
        for packet in (packet for packet in told if packet.kind == "report"):
            window = node.inbox.streams[OPERATOR].window
            assert packet.values == (*node.set_points.given, *node.set_points.in_effect)
            assert (packet.tick, packet.epoch, packet.sequence) == (tick + 1, 7, window.newest)
            reports += 1
        nodes.step(y, reference=node.set_points.given)
        asked += node.set_points.given
        effect += node.set_points.in_effect
        assert nodes.set_points == [*node.set_points.in_effect] == device.memory[IN_EFFECT] == node.memory[IN_EFFECT]
    assert effect == limited(asked)
    assert reports > 40
    for name in ("received", "used", "late", "superseded", "duplicate", "overruled"):
        assert node.counters[name] == device.counters[name], name
    assert min(node.counters["overruled"], node.counters["superseded"], node.counters["duplicate"]) > 0
    known = sum(node.counters[name] for name in ("used", "late", "superseded", "duplicate", "overruled"))
    assert node.counters["received"] == known + node.waiting


def test_an_operator_remains_after_a_restart() -> None:
    """The saved state of the controller includes the set-points of the operator, so the plant's stay overruled."""
    policy = tank().design()
    node, again = Node(policy, "controller"), Node(policy, "controller")
    node.step(0, [0.0], [operated(0, 1.0)])
    again.restore(json.loads(json.dumps(node.save())))
    again.step(1, [0.0], [Packet("measurement", SETPOINT, 1, 1, (3.0,), 9)])
    assert again.set_points is not None
    assert again.set_points.given == (1.0,)
    assert again.counters["overruled"] == 1


def test_limits_that_are_not_reached_change_neither_costs_nor_bound() -> None:
    """A ramp that is too slow for the stated changes withdraws the bound by name, and a wide one does not."""
    usual, wide = taciturn.load("pid-tank").design(), tank().design()
    assert wide.guarantee is not None
    assert wide.guarantee.cost == pytest.approx(usual.guarantee and usual.guarantee.cost)
    table = Timetable([0.0, 20.0, 40.0], [[0.0], [1.0], [0.0]], set_point_limits(1, [RANGE], [2.0]))
    steep = Timetable([0.0, 20.0, 40.0], [[0.0], [1.0], [0.0]], set_point_limits(1, None, [0.5]))
    assert (table.sampled(0.1).exceed, steep.sampled(1.0).exceed, table.sampled(1.0).exceed) == (True, True, False)
    slow = tank(**{"reference.range": None, "reference.steps": {"rate": 0.01, "covariance": [[1.0]]}})
    assert slow.close(slow.design()).violated_assumptions == (
        "the set-points change faster than their limit (reference.ramp)",
    )


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"reference.range": [[1.0, 5.0]]}, "set-point 1 is 0, beyond reference.range"),
        ({"reference.range": [[5.0, 1.0]]}, "reference.range is .*; expected 1 pair"),
        ({"reference.ramp": [0.0]}, "reference.ramp is 0; expected positive numbers"),
        ({"reference.steps": {"rate": 0.1, "covariance": [[1.0]]}}, "steps at random times .* leave every range"),
    ],
)
def test_limits_that_cannot_be_are_refused(changes: dict[str, object], sentence: str) -> None:
    """With the key, what is wrong with it, and a remedy."""
    with pytest.raises(ProblemError, match=sentence):
        tank(**changes)


def test_limits_are_in_the_units_of_the_plant() -> None:
    """At an operating point, set-points count from there inside the policy, but not for its user."""
    point = {"plant.operating_point.x": [12.0, 0.0], "plant.operating_point.u": [0.0]}
    nodes = Nodes(tank(**point, **{"reference.range": [[11.5, 13.0]]}))
    found = list[float]()
    for _ in range(5):
        nodes.step([12.0], reference=[14.0])
        found += nodes.set_points
    assert found == pytest.approx([12.25, 12.5, 12.75, 13.0, 13.0])


class Recorded(Node):
    """A node that records the packets that it sorts in, and its steps."""

    def __init__(self, *args: Any, **given: Any) -> None:
        """Start with an empty record."""
        super().__init__(*args, **given)
        self.record: list[Packet | tuple[int, Measurement | None, tuple[Packet, ...]]] = []

    def sort_in(self, packet: Packet) -> Handling:
        """Record a packet, and sort it in."""
        self.record.append(packet)
        return super().sort_in(packet)

    def step(self, tick: int, measurement: Any = None, *more: Any) -> Stepped:
        """Execute and record a step."""
        found = super().step(tick, measurement, *more)
        self.record.append((tick, measurement, found.packets))
        return found


@contextmanager
def running(loop: Loop, keys: Keys | None, kind: type[Node] = Node) -> Generator[tuple[NodeServer, Address]]:
    """Run plant, controller and actuator of a tank in lockstep, each in a thread."""
    policy, ended = loop.policy, threading.Event()
    ports = [Endpoint(("127.0.0.1", 0)) for _ in range(3)]
    plant, controller, actuator = (port.address for port in ports)
    wires = [Wire(policy, loop.network, keys) for _ in ports]
    first = kind(policy, "controller", network=loop.network, epoch=int(time.time()))
    servers = [
        NodeServer([first], wires[0], ports[1], peer=actuator, plant=plant),
        NodeServer([Node(policy, "actuator", epoch=5)], wires[1], ports[2], peer=None, plant=plant),
    ]
    world = PlantServer([SimulatedPlant(loop, 1)], wires[2], ports[0], {"plant": controller, SETPOINT: controller})
    runs = [threading.Thread(target=one.run, args=(None, ended.is_set)) for one in servers]
    runs.append(threading.Thread(target=world.run, args=(10**6, ended.is_set)))
    for run in runs:
        run.start()
    try:
        yield servers[0], controller
    finally:
        ended.set()
        for run in runs:
            run.join()
        for port in ports:
            port.close()


@pytest.mark.evidence
def test_a_tank_with_an_operator_a_load_and_missing_samples_is_the_same_in_c() -> None:
    """The controller of a run over UDP, and the exported one with the same packets: every bit of packets and memory."""
    problem = tank(disturbance=[{"enters": [0.0, -0.1], "steps": [[30, 0.3]]}], **{"links.sensor.missing": 0.2})
    loop = problem.close(problem.design())
    with running(loop, None, Recorded) as (server, address), closing(Tapped()) as tap:
        node, operator = server.nodes[0], Operator(tap, address)
        for value in (3.0, -9.0, 1.0):
            begun = node.tick
            operator.give([value])
            while node.tick < begun + 40:
                time.sleep(0.001)
    assert isinstance(node, Recorded)
    code = DeviceCode(loop.policy, "controller", loop.network)
    device = DeviceNode(
        code, loop.policy, "controller", network=loop.network, epoch=node.epoch, seed=0, watchdog=None, safe="hold"
    )
    wire, effects = Wire(loop.policy, loop.network), set[float]()
    for one in node.record:
        if isinstance(one, Packet):
            device.receive(wire.encode(one))
            continue
        tick, y, sent = one
        told = device.step(tick, None if y is None else list(y))
        assert tuple(packet for packet in told.packets if packet.kind not in ("report", "mode")) == sent, tick
        effects.update(device.memory[IN_EFFECT])
    assert device.memory == node.memory
    assert node.counters["missing"] == device.counters["missing"] > 10
    assert {3.0, -5.0, 1.0} <= effects


class Tapped(Endpoint):
    """A socket of an operator whose datagrams are recorded."""

    def __init__(self) -> None:
        """Bind the socket, and start without a recording."""
        super().__init__(("127.0.0.1", 0))
        self.recorded: list[bytes] = []

    def send(self, datagram: bytes, to: Address) -> None:
        """Record a datagram, and send it."""
        self.recorded.append(datagram)
        super().send(datagram, to)


@pytest.mark.parametrize("keys", few([None, SECRET], 1, 1))
def test_the_simulated_plant_yields_to_an_operator(keys: Keys | None) -> None:
    """Who need not know the problem file. The controller reports what is in effect, and an old recording changes it
    with a key not.
    """
    problem = tank()
    with (
        running(problem.close(problem.design()), keys) as (server, controller),
        closing(Tapped()) as tap,
        closing(Tapped()) as other,
    ):
        node = server.nodes[0]
        operator = Operator(tap, controller, keys)
        found = operator.give([1.0])
        assert (found.given, found.moves or found.in_effect == (1.0,)) == ((1.0,), True)
        beyond = Operator(other, controller, keys, patience=20.0)
        while (found := beyond.give([9.0])).moves:
            pass
        assert found.in_effect == (RANGE[1],)
        assert "5 in effect from step" in found.sentence()
        assert found.sentence().endswith("at the end of the range, instead of 9")
        for datagram in tap.recorded:  # the recording of the first operator
            other.send(datagram, controller)
        with pytest.raises(ProblemError, match="expected 1 finite number"):
            beyond.give([1.0, 2.0])
        assert beyond.ask().given == (9.0,)
    assert node.set_points is not None
    assert node.set_points.given == (9.0,)
    assert node.counters["overruled"] > 0
    assert node.counters["replayed"] + server.refused["unproven"] > 0


def test_only_the_holder_of_the_key_of_the_link_is_heard() -> None:
    """With the key of another link, or without a key, nobody answers, and the sentence says what to look at."""
    problem = tank()
    with running(problem.close(problem.design()), SECRET) as (server, controller), closing(Tapped()) as tap:
        for keys in (Keys({SETPOINT: SECRET.of("plant")}), None):
            with pytest.raises(ProblemError, match=r"nobody answers at 127\.0\.0\.1"):
                Operator(tap, controller, keys, patience=0.5).give([1.0])
        assert server.nodes[0].set_points == ((0.0,), (0.0,))
        Operator(tap, controller, SECRET).give([1.0])
        with pytest.raises(ProblemError, match="--epoch is 3, but the controller"):
            Operator(tap, controller, SECRET, epoch=3).give([1.0])
    assert min(server.refused["forged"], server.refused["malformed"]) > 0


@pytest.mark.evidence
def test_the_command_reads_lines_and_ignores_bad_ones() -> None:
    """It prints what is in effect at first and after each line."""
    problem, runner = tank(), CliRunner()
    with running(problem.close(problem.design()), None) as (server, (host, port)):
        found = runner.invoke(app, ["setpoint", f"{host}:{port}", "--json"], input="0.125\nmore\n1,2\n\n-0.125\n")
        once = runner.invoke(app, ["setpoint", f"{host}:{port}", "--value", "0"])
    assert (found.exit_code, once.exit_code) == (0, 0), found.output
    told = [json.loads(line) for line in found.stdout.splitlines()]
    assert [one["given"] for one in told][1:] == [[0.125], [-0.125]]
    assert "the line is 'more'; expected numbers" in found.stderr
    assert "expected 1 finite number" in found.stderr
    assert once.stdout.startswith("set-point 0 in effect from step")
    nobody = runner.invoke(app, ["setpoint", f"{host}:{port}", "--value", "0", "--wait", "0.3"])
    assert nobody.exit_code != 0
    assert server.report()["set_points"] == [{"loop": 0, "given": [0.0], "in_effect": [0.0]}]


@pytest.mark.evidence
def test_a_restored_node_tells_the_set_points_in_effect() -> None:
    """Before its next step, in Python and in C, on the ramp and with a range alone."""
    for changes in ({}, {"reference.ramp": None}):
        policy = tank(**changes).design()
        node, again = Node(policy, "controller"), Node(policy, "controller")
        first, second = (
            DeviceNode(
                DeviceCode(policy, "controller", policy.network), policy, "controller",
                network=policy.network, epoch=1, seed=0, watchdog=None, safe="hold",
            )
            for _ in range(2)
        )  # fmt: skip
        node.sort_in(operated(0, 9.0))
        first.receive(Wire(policy).encode(operated(0, 9.0)))
        for tick in range(3):
            node.step(tick, [0.0])
            first.step(tick, [0.0])
        again.restore(json.loads(json.dumps(node.save())))
        second.restore(first.save())
        assert again.set_points == node.set_points
        told = ctypes.c_double()
        assert second._code.tac_setpoints(second._self, ctypes.byref(told))
        assert node.set_points is not None
        assert (told.value,) == node.set_points.in_effect


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"tick": 1.5}, "tick is 1.5; expected a whole number"),
        ({"tick": 2**64}, r"tick is .*; expected a whole number below 2\^64"),
        ({"measurement": b"7"}, "the measurement of the controller is b'7'"),
        ({"measurement": [10**400]}, "the measurement of the controller"),
        ({"packets": [1]}, "packets"),
    ],
)
def test_a_step_that_cannot_be_is_refused_in_a_sentence(given: dict[str, Any], words: str) -> None:
    """And the node is as before."""
    node = Node(tank().design(), "controller")
    with pytest.raises(ProblemError, match=words):
        node.step(**{"tick": 0, "measurement": [0.0], **given})
    assert node.tick == -1
