"""What silence costs as nodes in C and co-simulation units add it up: the bits of the loop, also after many steps."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest
from counts import few
from export.devices import Device, Library, compile_node
from export.units import Instance, given, make_unit, record
from runtime.silent import CASES, Links, Simulated, build, simulate

from taciturn import Nodes
from taciturn.loop import Loop
from taciturn.model.packets import inputs_at, outputs_at, roles
from taciturn.model.wire import SETPOINT
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet, Wire
from taciturn.program.ops import Precision
from taciturn_export.fmu import tick_length
from taciturn_export.node import identifier, print_node
from taciturn_worlds.devices import compile_devices

TICKS = 80
LAST = 2**24  # steps from which on single precision cannot count


@cache
def compiled(name: str, role: str, precision: Precision) -> Library:
    """Return a node in C, compiled once."""
    loop = build(name)
    return compile_node(loop.policy, role, loop.network, Path(mkdtemp()), precision)


class Devices:
    """All nodes of a loop in C, on a path that was simulated."""

    def __init__(self, name: str, path: Simulated, precision: Precision) -> None:
        """Start them."""
        self.loop, self.path, policy = build(name), path, build(name).policy
        self.hosts = {role: Node(policy, role, network=self.loop.network) for role in roles(policy)}
        self.nodes = {role: Device(compiled(name, role, precision)) for role in self.hosts}
        self.boxes: dict[str, list[bytes]] = {role: [] for role in self.hosts}
        self.wire = Wire(policy, self.loop.network)
        self.given = np.zeros(policy.model.inputs)
        self.packets = 0

    def step(self, tick: int) -> None:
        """Go through a step."""
        for role, device in self.nodes.items():
            host, (box, self.boxes[role]) = self.hosts[role], (self.boxes[role], [])
            if any(one.link == SETPOINT for one in host._layout.arrivals):
                point = Packet("measurement", SETPOINT, tick, tick, tuple(self.path.points[tick].tolist()), 1)
                box.append(self.wire.encode(point))
            for datagram in box:
                assert device.receive(datagram)
            y = self.path.y[tick, outputs_at(self.loop.policy, role)].tolist() if host.measures else None
            assert device.step(tick, y)
            if host.actuates:
                self.given[inputs_at(self.loop.policy, role)] = device.input
            for datagram in device.send():
                packet = self.wire.decode(datagram)
                assert isinstance(packet, Packet)
                if packet.kind not in ("data", "acknowledgement"):
                    continue
                self.packets += 1
                back = packet.kind == "acknowledgement"
                if back or self.path.arrived[packet.link][tick]:
                    ends = {r: n.program.sends if back else n.program.hears for r, n in self.hosts.items()}
                    self.boxes[next(r for r, links in ends.items() if packet.link in links)].append(datagram)

    def told(self, links: Links) -> tuple[float, float]:
        """Return what a node says that its silence has cost, and the steps of its life."""
        role = self.loop.policy.theory.silence[links].at
        device = self.nodes[role]
        found = list[float]()
        for what in ("silence", "lasted"):
            function = getattr(device.code, f"device_{what}_{identifier('_and_'.join(links))}")
            function.restype = device.library.number
            found.append(function(device.node))
        return found[0], found[1]

    def place(self, links: Links, what: str) -> int:
        """Return the place of a signal in the memory of its node."""
        states = self.hosts[self.loop.policy.theory.silence[links].at].program.parts[0].states
        return next(i for i, state in enumerate(states) if state.name == f"{what}_{' and '.join(links)}")

    def put(self, links: Links, what: str, value: float) -> None:
        """Write a number into the memory of a node."""
        device = self.nodes[self.loop.policy.theory.silence[links].at]
        values = (device.library.number * device.library.sizes[2]).from_address(device.code.shim_memory(device.node))
        values[self.place(links, what)] = value


IN_C = [(name, precision) for name in CASES for precision in ("float64", "float32")]


@pytest.mark.parametrize("case", few(IN_C, 1, IN_C.index(("one sensor", "float32"))), ids=str)
def test_nodes_in_c_add_up_what_the_loop_adds_up(case: tuple[str, Precision]) -> None:
    """In every bit and at every step, in both precisions, as their functions return it."""
    name, precision = case
    loop = build(name)
    path = simulate(loop, TICKS, precision=precision)
    devices = Devices(name, path, precision)
    for tick in range(TICKS):
        devices.step(tick)
        assert np.array_equal(devices.given, path.applied[tick])
        for links, one in loop.policy.theory.silence.items():
            last = tick - (len(devices.hosts[one.at].program.parts) > 1)
            if last >= 0:
                assert devices.told(links) == (path.total[links][last], path.lasted[links][last])
    assert path.total[next(iter(path.total))][-1] > 0
    if precision == "float32":
        sums = np.array([float(total[-1]) for total in path.total.values()])
        assert np.array_equal(sums, sums.astype(np.float32))
    assert not any(device.degraded for device in devices.nodes.values())


def test_a_sum_in_single_precision_does_not_stop_to_grow() -> None:
    """After so many steps that a plain sum would lose each addition, it grows by what is added, to its last bits."""
    steps, loop, links = 400, build("one sensor"), ("gauge",)
    path = simulate(loop, steps, precision="float32")
    fresh, old = (Devices("one sensor", path, "float32") for _ in range(2))
    for tick in range(10):
        fresh.step(tick)
        old.step(tick)
    before = fresh.told(links)[0]
    large = float(np.float32(2e8 * path.total[links][-1] / steps))  # of 2e8 steps
    old.put(links, "silence", large)
    old.put(links, "carry", 0.0)
    plain, added = np.float32(large), np.diff(path.total[links], prepend=0.0)
    for tick in range(10, steps):
        fresh.step(tick)
        old.step(tick)
        plain += np.float32(added[tick])
    grown = fresh.told(links)[0] - before
    spacing = float(np.spacing(np.float32(large)))
    states = (ctypes.c_float * old.nodes["gauge"].library.sizes[2]).from_address(
        old.nodes["gauge"].code.shim_memory(old.nodes["gauge"].node)
    )
    carried = old.told(links)[0] - large - states[old.place(links, "carry")]
    assert float(plain) == large  # a plain sum has stopped
    assert carried == pytest.approx(grown, rel=1e-4)  # roundings of single precision in both sums
    assert abs(old.told(links)[0] - large - grown) <= spacing


def test_steps_in_single_precision_stop_where_they_cannot_be_counted() -> None:
    """At 2^24, so that a bound over them is not too small, as the header says; the sum goes on."""
    loop, links = build("one sensor"), ("gauge",)
    devices = Devices("one sensor", simulate(loop, 40, precision="float32"), "float32")
    for tick in range(10):
        devices.step(tick)
    before = devices.told(links)[0]
    devices.put(links, "lasted", LAST - 3)
    for tick in range(10, 40):
        devices.step(tick)
    assert devices.told(links)[1] == LAST
    assert devices.told(links)[0] > before
    single, double = (
        print_node(loop.policy, "gauge", loop.network, "device", precision=precision).header
        for precision in ("float32", "float64")
    )
    assert "stop at 2^24" in single
    assert "2^24" not in double


@pytest.mark.parametrize("name", few(["one sensor", "held", "losses", "two valves", "set-points"], 1))
def test_a_unit_shows_what_silence_has_cost(name: str, tmp_path: Path) -> None:
    """In the bits of nodes in Python, in every step."""
    loop: Loop = build(name)
    vector = record(loop, TICKS)
    make_unit(loop, tmp_path / "unit")
    instance = Instance(tmp_path / "unit").start()
    nodes, seconds, p = Nodes(loop), tick_length(loop), loop.policy.model.sensed
    last: dict[str, float] = {}
    late = {links for links, one in loop.policy.theory.silence.items() if concluded_late(loop, one.at)}
    for tick in range(TICKS):
        instance.set(given(loop, vector, tick))
        instance.step(tick * seconds, seconds)
        fates = {link: bool(vector.arrived[tick, i]) for i, link in enumerate(vector.links) if vector.sent[tick, i]}
        y = vector.measured[tick].tolist()
        nodes.step(y[:p], reference=y[p:] or None, fates=fates)
        told = {
            links: instance.get(f"silence_{identifier('_and_'.join(links))}")[0] for links in loop.policy.theory.silence
        }
        expected = {"_and_".join(life.links): life.total for life in nodes.silence}
        for links, value in told.items():
            key = "_and_".join(links)
            assert value == (last.get(key, 0.0) if links in late else expected[key])
        last = expected
    assert all(value > 0 for value in last.values())
    instance.fmu.terminate()
    instance.close()


def concluded_late(loop: Loop, role: str) -> bool:
    """Return whether a node learns in the next step what has arrived."""
    return len(Node(loop.policy, role, network=loop.network).program.parts) > 1


def test_a_node_in_c_whose_numbers_overflow_begins_another_life() -> None:
    """As one in Python: its memory starts again, it is degraded, and it sends."""
    loop, draws = build("held"), np.random.default_rng(1)
    wire, plc = Wire(loop.policy, loop.network), Device(compiled("held", "plc", "float64"))

    def step(tick: int, value: float | None) -> list[str]:
        if value is not None:
            assert plc.receive(wire.encode(Packet("data", "gauge", tick, tick, (value,))))
        plc.step(tick)
        sent = map(wire.decode, plc.send())
        return [one.link for one in sent if isinstance(one, Packet) and one.kind == "data"]

    def told() -> list[float]:
        functions = [getattr(plc.code, f"device_{what}_valve") for what in ("silence", "lasted")]
        for function in functions:
            function.restype = ctypes.c_double
        return [function(plc.node) for function in functions]

    for tick in range(30):
        step(tick, float(draws.normal(0, 0.1)))
    assert told()[0] > 0
    assert step(30, 3e38) == []
    assert plc.counters["overflowed"] == 1
    assert plc.degraded
    assert told() == [0.0, 0.0]
    assert step(31, None) == ["valve"]
    assert told() == [0.0, 1.0]


def test_the_life_of_a_node_in_c_continues_from_a_saved_state() -> None:
    """And begins again without it."""
    loop, links = build("one sensor"), ("gauge",)
    path = simulate(loop, TICKS, precision="float32")
    devices, cut = Devices("one sensor", path, "float32"), 40
    for tick in range(cut):
        devices.step(tick)
    saved, before = devices.nodes["gauge"].save(), devices.told(links)
    devices.nodes["gauge"] = Device(compiled("one sensor", "gauge", "float32"), epoch=2)
    assert devices.told(links) == (0.0, 0.0)
    assert devices.nodes["gauge"].restore(saved)
    assert devices.told(links) == before
    for tick in range(cut, TICKS):
        devices.step(tick)
    assert devices.told(links) == (path.total[links][-1], path.lasted[links][-1])


@pytest.mark.evidence
def test_a_node_of_a_world_in_c_tells_its_life_from_a_saved_state_on() -> None:
    """Before its next step, too."""
    loop = build("one sensor")
    path, make = simulate(loop, 40), compile_devices(loop)["gauge"]
    node = make(loop.policy, "gauge", network=loop.network, epoch=1, seed=0, watchdog=None, safe=None)
    for tick in range(40):
        node.step(tick, path.y[tick].tolist())
    saved, (life,) = node.save(), node.silence
    assert (life.total, life.steps) == (path.total["gauge",][-1], 40)
    other = make(loop.policy, "gauge", network=loop.network, epoch=2, seed=0, watchdog=None, safe=None)
    assert [one.total for one in other.silence] == [0.0]
    other.restore(saved)
    assert other.silence == (life,)
