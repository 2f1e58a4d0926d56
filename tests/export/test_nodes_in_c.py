"""Nodes in C do what the host's nodes do, whatever arrives: outputs, memory, counters and degradation, bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import pytest
from catalogue import POLICIES, closed
from counts import few
from export.devices import WIDTH, Device, Library, compile_node, with_small_inbox
from hypothesis import given, settings
from hypothesis import strategies as st
from parity.loops import every_feature, with_functions
from runtime.late import pendulum
from systems import make_system

import taciturn
from taciturn import Network
from taciturn.loop import Loop
from taciturn.model.network import Network as AnyNetwork
from taciturn.model.packets import roles
from taciturn.model.policy import Policy
from taciturn.nodes.inbox import USABLE
from taciturn.nodes.node import Node, Stepped
from taciturn.nodes.packet import Packet, Wire

LOOP, SEED = 7, 3


class Watch(NamedTuple):
    """After how many steps of silence an input is safe, and which that is; 0: never, None: the last one."""

    ticks: int = 0
    safe: tuple[float, ...] | None = None


class Case(NamedTuple):
    """A node, on the host and in C."""

    policy: Policy
    network: AnyNetwork
    role: str
    watch: Watch
    library: Library

    def host(self, epoch: int) -> Node:
        """Return it on the host, with the inbox of a device."""
        ticks, safe = self.watch.ticks or None, "hold" if self.watch.safe is None else self.watch.safe
        return with_small_inbox(
            Node(
                self.policy, self.role, network=self.network, epoch=epoch, seed=SEED, loop=LOOP, watchdog=ticks,
                safe=safe,
            )
        )  # fmt: skip


def ideal() -> Loop:
    """Return a loop whose theory takes every packet to arrive."""
    return taciturn.load("two-mass-lqg").close(taciturn.load("two-mass-lqg").design())


def lossy(**more: object) -> Loop:
    """Return a loop with packets on both links, and losses."""
    problem = taciturn.load("lossy-double-integrator")
    loop = problem.close(problem.design())
    network = Network("udp", 0.3, 0.6, **more)  # type: ignore[arg-type]
    return taciturn.close(problem.plant, loop.policy, network, problem.cost)


def everything(seed: int) -> Loop:
    """Return a loop with every feature, and a clock that does not come back to where it began."""
    loop = every_feature(make_system(5, 3, 2, 2, False), seed)
    clocks = [replace(one, table=np.array([1, 2, 1])) if one.name == "clock" else one for one in loop.policy.locations]
    policy = replace(loop.policy, locations=tuple(clocks))
    return taciturn.close(loop.problem.plant, policy, loop.network, loop.problem.cost)


LOOPS: dict[str, Callable[[], Loop]] = {
    "ideal": cache(ideal),
    "lossy": cache(lossy),
    "int16": cache(lambda: lossy(payload="int16", sensor_range=40.0, actuator_range=20.0)),
    "delayed": cache(lambda: closed(POLICIES["lossy tcp, delayed"](make_system(11, 3, 2, 2, True)))),
    "stochastic": cache(lambda: closed(POLICIES["stochastic"](make_system(11, 3, 2, 2, False)))),
    "late": cache(lambda: pendulum({"delta": 0.05}).close(pendulum({"delta": 0.05}).design())),
    "remote": cache(lambda: closed(POLICIES["remote"](make_system(11, 3, 2, 2, False)))),
    "told": cache(lambda: everything(1)),
    "untold": cache(lambda: everything(3)),
    "functions": cache(lambda: with_functions(make_system(11, 3, 2, 2, False), 1)),
}
WATCHES = (Watch(), Watch(5, (0.25, -0.5)), Watch(3))


@cache
def places() -> list[tuple[str, str]]:
    """Return every node of these loops."""
    return [(name, role) for name, build in LOOPS.items() for role in roles(build().policy)]


def case(name: str, role: str, watched: int) -> Case:
    """Return a node, compiled; one that acts and listens is watched."""
    loop = LOOPS[name]()
    node = Node(loop.policy, role, network=loop.network)
    ticks, safe = WATCHES[watched] if node.actuates and node.inbox.streams else Watch()
    watch = Watch(ticks, safe and safe[: loop.policy.model.inputs])
    return Case(loop.policy, loop.network, role, watch, compiled(name, role))


@cache
def compiled(name: str, role: str) -> Library:
    """Return a node in C, compiled once."""
    loop = LOOPS[name]()
    return compile_node(loop.policy, role, loop.network, Path(mkdtemp()), seed=SEED)


class Pair:
    """The same node twice, given the same."""

    def __init__(self, found: Case, seed: int) -> None:
        """Start both before the first step."""
        self.case, self.draws = found, np.random.default_rng(seed)
        self.host, self.device = found.host(epoch=9), Device(found.library, None, 9, LOOP)
        self.device.watch(*found.watch)
        self.every = (None, 0, 3)[seed % 3]  # steps without a packet after which a mark is sent; None: no marks
        if self.every is not None:
            self.device.mark_after(self.every)
        self.wire = Wire(found.policy, found.network)
        self.tick = -1
        self.numbers: dict[tuple[str, str], int] = {}  # sequence numbers that the device has given out
        self.sequences: dict[tuple[str, str], int] = {}  # of the next packet to come
        self.packets, self.recoveries, self.was_degraded = 0, 0, False
        inbox = self.host.inbox
        sizes = {name: stream.size for name, stream in inbox.streams.items()}
        self.sizes = {
            **sizes,
            **{("mark", link): 0 for _, link in sizes},
            ("input", "plant"): found.policy.model.inputs,
        }

    def receive(self, which: int, ahead: int, behind: int, epoch: int, loop: int) -> None:
        """Give both a packet, so many steps and sequence numbers from the next one."""
        kind, link = name = list(self.sizes)[which % len(self.sizes)]
        sequence = max(0, self.sequences.get(name, 0) - behind)
        self.sequences[name] = max(self.sequences.get(name, 0), sequence + 1)
        values = tuple(self.draws.normal(0, 5, self.sizes[name]).tolist())
        back = kind == "mark" and ("acknowledgement", link) in self.sizes
        tick: Any = max(0, self.tick + ahead)
        packet = Packet(kind, link, tick, sequence, values, epoch, loop, back)  # type: ignore[arg-type]
        datagram = self.wire.encode(packet)
        read = self.wire.decode(datagram)
        assert isinstance(read, Packet)
        assert self.device.receive(datagram) == (self.host.sort_in(read) in USABLE)

    def step(self, gap: int) -> None:
        """Let both go through a step, and compare all that they do and know."""
        tick = max(0, self.tick + gap)
        y = self.draws.normal(0, 3, self.case.policy.model.outputs).tolist() if self.host.measures else None
        self.later = tick > self.host.tick
        stepped = self.host.step(tick, y)
        assert self.device.step(tick, y) == self.later
        self.tick = self.host.tick
        assert self.device.input == stepped.input
        assert self.device.degraded == self.host.degraded
        assert self.device.silent == self.host.silent
        self.recoveries += self.was_degraded > self.device.degraded
        self.was_degraded = self.device.degraded
        assert self.device.inputs(len(self.host._inputs)) == list(self.host._inputs)
        numbers = [value for name in self.host.memory.values() for value in name]
        assert self.device.memory[: len(numbers)] == numbers
        self.compare_packets(stepped)

    def compare_packets(self, stepped: Stepped) -> None:
        """Check that the newest packets of the host are those of the device, in its own numbers."""
        marks = () if self.every is None or not self.later else self.host.mark(self.every)
        expected = {(packet.kind, packet.link): packet for packet in (*stepped.packets, *marks)}
        found = [self.wire.decode(datagram) for datagram in self.device.send()]
        for link in self.host.acknowledges if self.case.network.late else ():
            expected.pop(("acknowledgement", link), None)
            told = [packet for packet in stepped.packets if packet.kind == "acknowledgement"]
            own = [packet for packet in found if isinstance(packet, Packet) and packet.kind == "acknowledgement"]
            found = [packet for packet in found if packet not in own]
            first = self.numbers.get(("acknowledgement", link), 0)
            assert [packet.sequence for packet in own] == [*range(first, first + len(own))]
            after = [(packet.tick, min(packet.values[0], 255.0)) for packet in told]  # all packets that were read
            assert sorted((packet.tick, *packet.values) for packet in own) == sorted(after)[-len(own) or len(after) :]
            self.numbers["acknowledgement", link] = first + len(own)
        assert sorted(map(str, found)) == sorted(
            str(packet._replace(sequence=self.numbers.get(name, 0))) for name, packet in expected.items()
        )
        for name in expected:
            self.numbers[name] = self.numbers.get(name, 0) + 1
        self.packets += len(found)

    def compare_counts(self) -> None:
        """Check that both have counted the same."""
        counters = {k: n for k, n in self.host.counters.items() if n and not k.startswith("sent ")}
        assert self.device.counters == counters
        assert self.device.waiting == self.host.inbox.waiting


FATES = st.tuples(
    st.just("packet"), st.integers(0, 5), st.sampled_from([0, 0, 1, 1, 1, 2, -1, -2, 3, 4, 5, 6, 9, 40]),
    st.sampled_from([0, 0, 0, 0, 1, 2, -1, -3, 5, 63, 64, 65, -64, -200]), st.sampled_from([1, 1, 1, 1, 1, 2, 0]),
    st.sampled_from([LOOP] * 9 + [0]),
)  # fmt: skip
STEPS = st.tuples(st.just("step"), st.sampled_from([1] * 12 + [0, 2, 3, 5, 17]))
EVENTS = st.lists(FATES | STEPS, min_size=10, max_size=60)


all_or_some = pytest.mark.parametrize("every", few([3, 1], 1), ids=["every third node", "every node"])


@patch("taciturn.nodes.inbox.WIDTH", WIDTH)
def play(found: Case, events: list[tuple], seed: int) -> Pair:
    """Give a node on the host and in C what happens, and compare after each step."""
    pair = Pair(found, seed)
    for what, *rest in [*events, ("step", 1), ("step", 1)]:
        if what == "packet":
            pair.receive(*rest)
        else:
            pair.step(*rest)
            pair.compare_counts() if rest[0] <= 1 else None
    return pair


@pytest.mark.parametrize("place", few(places(), 2), ids=str)
@given(EVENTS, st.integers(0, 2), st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=15)
def test_a_node_in_c_does_and_counts_what_the_host_does(
    place: tuple[str, str], events: list[tuple], watched: int, seed: int
) -> None:
    """Packets that are late, doubled, reordered, replayed, early, of another loop or missing, and steps left out."""
    play(case(*place, watched), events, seed)


def random_events(draws: np.random.Generator, count: int) -> list[tuple]:
    """Return what happens to a node for long: mostly as it should."""
    found = list[tuple]()
    for _ in range(count):
        for _ in range(draws.integers(0, 4)):
            usual = draws.random() < 0.8
            ahead, behind = (1, 0) if usual else (int(draws.integers(-3, 8)), int(draws.integers(-3, 70)))
            loop = LOOP if draws.random() < 0.95 else 0
            found.append(("packet", int(draws.integers(6)), ahead, behind, 1 + int(len(found) > count), loop))
        found.append(("step", int(draws.choice([0, 1, 2, 9], p=[0.05, 0.85, 0.05, 0.05]))))
    return found


@pytest.mark.evidence
@all_or_some
def test_all_that_can_become_of_a_packet_does_and_is_counted_alike(every: int) -> None:
    """600 steps of nodes, and as many in peace: every counter moves, packets leave, and nodes recover."""
    met, recoveries, packets = set[str](), 0, 0
    for name, role in places()[::every]:
        events = [*random_events(np.random.default_rng(4), 600), *[("step", 1)] * 600]
        pair = play(case(name, role, 1), events, 5)
        met |= set(pair.device.counters)
        recoveries += pair.recoveries
        packets += pair.packets
    assert met - {"overflowed"} == {  # of an unstable loop
        "received", "used", "late", "ahead", "duplicate", "replayed", "misdirected", "superseded", "marks",
        "missed", "repeated",
    }  # fmt: skip
    assert recoveries > 3
    assert packets > 1000


@pytest.mark.parametrize(
    "sleep", few(product(["ideal", "lossy", "told", "delayed"], [9_000, 10_001, 25_000]), 1), ids=str
)
def test_a_node_that_has_slept_long_makes_up_for_the_same_ticks(sleep: tuple[str, int]) -> None:
    """Up to 10,000 steps are gone through again, and the newest packet of each link is sent."""
    name, gap = sleep
    for role in ("controller", "actuator"):
        if role in roles(LOOPS[name]().policy):
            play(case(name, role, 0), [("step", 1)] * 3 + [("step", gap), *[("step", 1)] * 3], 1)


@pytest.mark.evidence
@all_or_some
def test_a_packet_of_a_later_epoch_supersedes_one_of_its_tick(every: int) -> None:
    """A sender that began anew has smaller sequence numbers, and is believed."""
    for name, role in places()[::every]:
        for which in range(6):
            older = [("packet", which, 0, 0, 1, LOOP)] * 3
            events = [("step", 1), *older, ("packet", which, 1, 0, 1, LOOP), ("packet", which, 1, 3, 2, LOOP)]
            play(case(name, role, 1), [*events, ("step", 1), ("step", 1), ("step", 1)], which)


@pytest.mark.evidence
@all_or_some
def test_a_node_that_begins_late_has_joined(every: int) -> None:
    """A first step that is not 0, with packets that wait for it, for others, and for one far away."""
    for name, role in places()[::every]:
        for seed in range(4):
            draws = np.random.default_rng(seed)
            early = [("packet", i, int(draws.integers(0, 60)), 0, 1, LOOP) for i in draws.integers(0, 6, 40).tolist()]
            play(case(name, role, 1), [*early, ("step", 40), *early, *[("step", 1)] * 70], seed)


def test_the_last_sequence_number_ends_an_epoch() -> None:
    """4294967295 is given out once; the next packet begins a new epoch."""
    found = case("ideal", "controller", 0)
    node, wire = Device(found.library, None, 9, LOOP), Wire(found.policy, found.network)
    node.code.shim_number(node.node, 2**32 - 2)
    numbers = []
    for tick in range(100):
        node.step(tick, [100.0 * (-1) ** tick, 50.0])
        packets = [wire.decode(datagram) for datagram in node.send()]
        numbers += [(packet.epoch, packet.sequence) for packet in packets if isinstance(packet, Packet)]
    assert numbers[:4] == [(9, 2**32 - 2), (9, 2**32 - 1), (10, 0), (10, 1)]


def test_what_is_no_tick_and_no_measurement_changes_nothing() -> None:
    """A measurement that is not finite, a step that is past, and the one that has no number."""
    found = case("ideal", "controller", 0)
    node = Device(found.library)
    assert node.step(0, [1.0, 2.0])
    node.send()
    before = node.memory
    for y in ([float("inf"), float("nan")], [float("-inf"), 1.0], [1.0, -3.5e38]):
        assert not node.step(1, y)
    assert not node.step(2**64 - 1, [1.0, 2.0])
    assert node.counters == {}
    assert not node.step(0, [1.0, 2.0])
    assert node.counters == {"repeated": 1}
    assert (node.memory, node.send(), node.degraded) == (before, [], False)
    assert node.step(2**64 - 2, [1.0, 2.0])
    assert node.degraded


def test_a_node_whose_results_are_too_large_holds_and_starts_its_memory_again() -> None:
    """It keeps its input, sends nothing, and is degraded; a few steps later it is as before. So does one in Python."""
    loop = LOOPS["ideal"]()
    wire, device = Wire(loop.policy, loop.network), Device(compiled("ideal", "controller"))
    host = Node(loop.policy, "controller", network=loop.network, seed=SEED)
    start, sent = list(host._memory), 0
    for tick in range(30):
        y = [3.4e38, -3.4e38] if 10 <= tick < 13 else [1.0, 0.5]
        overflows, packets = host.counters["overflowed"], host.step(tick, y).packets
        assert device.step(tick, y)
        assert [wire.decode(one) for one in device.send()] == list(packets)
        assert device.memory == list(host._memory)
        assert device.degraded == host.degraded == (tick >= 10 and host.counters["overflowed"] > 0)
        if host.counters["overflowed"] > overflows:
            assert packets == ()
            assert list(host._memory) == start
        sent += len(packets) * (tick > 15)
    assert host.counters["overflowed"] == device.counters["overflowed"] == host.reasons["overflow"] > 0
    assert max(map(abs, host._memory)) < 100.0
    assert sent > 0


def test_a_node_that_starts_late_begins_in_the_tick_it_hears_of() -> None:
    """Counting from 0 it would drop what comes as too early."""
    found = case("ideal", "actuator", 0)
    wire, node = Wire(found.policy, found.network), Device(found.library, None, 9, LOOP)
    assert node.heard == 0
    assert node.receive(wire.encode(Packet("data", "actuator", 500, 0, (0.25,), 1, LOOP)))
    assert node.heard == 501
    assert node.step(500)
    assert node.input == (0.25,)
