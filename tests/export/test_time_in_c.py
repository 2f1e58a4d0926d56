"""Time on a device: steps that begin by received packets, bounded catching up, and watchdogs a program can read."""

from __future__ import annotations

import ctypes as c
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from export.devices import HERE, STRICT, Device, needs_compiler
from export.test_folders import two_mass, write
from export.test_nodes_in_c import LOOP, LOOPS, case, compiled
from hypothesis import given, settings
from hypothesis import strategies as st

from taciturn.nodes.clock import AGREED, Phase
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet, Wire
from taciturn_boards import cortex
from taciturn_export.folder import CORE_SOURCES, print_folder

CATCH_UP = 16  # TAC_CATCH_UP of the core


def test_one_call_makes_up_for_a_bounded_number_of_steps() -> None:
    """Of 100 missed steps 16 in each call; what is left is told, and the end is that of the host."""
    found = case("ideal", "actuator", 0)
    node, host, wire = Device(found.library, None, 9, LOOP), found.host(9), Wire(found.policy, found.network)
    datagram = wire.encode(Packet("data", "actuator", 0, 0, (0.25,), 1, LOOP))
    assert node.receive(datagram)
    host.step(0, packets=[Packet("data", "actuator", 0, 0, (0.25,), 1, LOOP)])
    assert node.step(0)
    left = []
    while node.behind(101) > 0:
        left.append(node.behind(101))
        done = node.step_once(101)
    assert left == [100 - CATCH_UP * i for i in range(7)]
    assert done
    host.step(101)
    assert node.counters["missed"] == host.counters["missed"] == 100
    assert node.input == host._output()
    assert node.degraded
    assert node.behind(102) == 0


def test_a_program_that_goes_on_with_the_present_step_catches_up() -> None:
    """Nothing but one call in each step: it gains 15 steps with each of them."""
    node = Device(compiled("ideal", "actuator"))
    assert node.step(0)
    tick = 200
    while not node.step_once(tick):
        tick += 1
    assert tick == 200 + (200 - 1) // (CATCH_UP - 1)
    assert node.counters["missed"] == tick - 1


def test_a_node_with_a_sensor_skips_the_steps_it_has_missed() -> None:
    """In one call: their measurements are not there."""
    node = Device(compiled("ideal", "controller"))
    assert node.step(0, [1.0, 2.0])
    assert node.behind(5000) == 0
    assert node.step_once(5000, [1.0, 2.0])
    assert node.counters["missed"] == 4999


@pytest.mark.parametrize("safe", [None, (0.75,)])
def test_a_program_reads_that_the_watchdog_has_expired(safe: tuple[float, ...] | None) -> None:
    """In the step in which it does on the host, and until a packet comes."""
    found = case("ideal", "actuator", 0)
    wire, node = Wire(found.policy, found.network), Device(found.library, None, 9, LOOP)
    node.watch(3, safe)
    host = Node(found.policy, "actuator", network=found.network, loop=LOOP, watchdog=3, safe=safe or "hold")
    for tick in range(12):
        packets = [Packet("data", "actuator", tick, tick, (2.0,), 1, LOOP)] if tick in (0, 7) else []
        assert all(node.receive(wire.encode(packet)) for packet in packets)
        assert node.step(tick)
        assert node.input == host.step(tick, packets=packets).input
        assert (node.silent, node.degraded) == (host.silent, host.degraded)
        assert node.silent == (tick in (3, 4, 5, 6, 10, 11))


def test_steps_for_which_a_node_did_not_run_are_no_silence_once_a_packet_has_come() -> None:
    """A node that starts from its saved state executes the missed steps after the packet: missed, but not silent."""
    found = case("ideal", "actuator", 0)
    wire, node = Wire(found.policy, found.network), Device(found.library, None, 9, LOOP)
    node.watch(3, (0.5,))
    host = Node(found.policy, "actuator", network=found.network, loop=LOOP, watchdog=3, safe=[0.5])
    for tick, last in ((0, 0), (4, 6), (10, 10)):
        packet = Packet("data", "actuator", tick, tick, (2.0,), 1, LOOP)
        if tick < 10:
            host.sort_in(packet)
            assert node.receive(wire.encode(packet))
        for step in range(tick, last + 1):
            assert node.step(step)
            assert node.input == host.step(step).input
            assert node.silent == host.silent == (step == 10)
    assert dict(host.reasons) == {"lost": 1, "missed": 2, "silent actuator": 1}


def test_a_watchdog_expires_while_no_step_begins() -> None:
    """The program says so, since nobody counts steps; a refused packet changes nothing, and a mark ends it."""
    loop = LOOPS["ideal"]()
    wire, node = Wire(loop.policy, loop.network), Device(compiled("ideal", "actuator"), None, 9, LOOP)
    host = Node(loop.policy, "actuator", network=loop.network, loop=LOOP, watchdog=3, safe=[0.5])
    node.watch(3, (0.5,))
    assert (node.silent, node.degraded, node.input) == (False, False, (0.0,))
    node.expire()
    assert host.expire() == node.input == (0.5,)
    assert (node.silent, node.degraded) == (host.silent, host.degraded) == (True, True)
    assert not node.receive(b"no packet")
    assert node.silent
    mark = Packet("mark", "actuator", 40, 0, (), 1, LOOP)
    host.sort_in(mark)
    assert node.receive(wire.encode(mark))
    assert (node.silent, host.silent, node.input) == (False, False, (0.0,))
    assert node.step(40)
    host.step(40)
    assert (node.silent, node.degraded) == (host.silent, host.degraded)
    node.expire()  # the device was stopped, and no packet tells for how long
    assert host.expire() == node.input == (0.5,)
    assert (node.silent, node.degraded) == (host.silent, host.degraded) == (True, True)
    assert node.receive(wire.encode(mark._replace(tick=42, sequence=1)))
    assert not node.silent


PERIOD = 10_000  # counts of the timer in a step
BEGAN = 2**40  # what the timer shows in the beginning
DRIFT = (HERE / "drift.c").read_text(encoding="ascii")


class Clock(c.Structure):
    """The clock of a device."""

    _fields_ = [
        *((name, c.c_uint64) for name in ("zero", "first", "last", "jump")),
        ("ticks", c.c_uint64 * 2), ("zeros", c.c_uint64 * 2), ("least", c.c_int64),
        *((name, c.c_uint32) for name in ("period", "agreed", "late", "jumps")), ("known", c.c_bool),
    ]  # fmt: skip

    def __init__(self, period: int = PERIOD) -> None:
        """Start without packets."""
        super().__init__()
        self.code = compiled("ideal", "actuator").code
        self.code.tac_clock_hear.restype = self.code.tac_clock_receive.restype = c.c_bool
        self.code.tac_clock_due.restype, self.code.tac_clock_offset.restype = c.c_uint64, c.c_int64
        self.code.tac_clock_start(c.byref(self), c.c_uint32(period))

    def hear(self, tick: int, now: int) -> bool:
        """Take the arrival of a packet into account."""
        return self.code.tac_clock_hear(c.byref(self), c.c_uint64(tick), c.c_uint64(now % 2**64))

    def due(self, now: int) -> int:
        """Number of steps that have begun."""
        return self.code.tac_clock_due(c.byref(self), c.c_uint64(now % 2**64))

    @property
    def offset(self) -> int:
        """What it tells of the difference in counts."""
        return self.code.tac_clock_offset(c.byref(self))

    @property
    def drift(self) -> int:
        """What it tells of the difference in speed, in parts per million."""
        return self.code.tac_clock_drift(c.byref(self))


@given(st.integers(0, 2**32 - 1), st.sampled_from([-500, 0, 500]), st.integers(0, 2**40))
@settings(max_examples=4, deadline=None)
def test_a_clock_in_c_is_the_clock_of_the_host(seed: int, drift: int, joined: int) -> None:
    """Packets that are late, doubled, missing and from elsewhere: the same estimate, and the same packets believed."""
    draws, clock, host = np.random.default_rng(seed), Clock(), Phase(PERIOD)
    for k in range(300):
        jumped = k in range(200, 230)
        if draws.random() < 0.3:
            continue
        now = BEGAN + k * PERIOD + k * PERIOD * drift // 10**6 + int(draws.exponential(0.1) ** 2 * PERIOD)
        tick = k - int(draws.integers(0, 3)) if jumped or draws.random() < 0.9 else int(draws.integers(0, 10**6))
        if jumped:
            tick += 5000
        assert clock.hear(joined + max(tick, 0), now) == host.hear(max(tick, 0), now)
        assert (clock.zero + joined * PERIOD - int(host.zero)) % 2**64 == 0
        assert clock.jumps == host.jumps
        if clock.due(now) > 0:
            assert clock.due(now) == joined + host.now(now) + 1
    assert clock.jumps > 0


def test_a_clock_tells_offset_and_drift() -> None:
    """After a million steps of a timer that is 123 ppm faster; after a jump it measures anew."""
    for ppm in (123, -123):
        clock, jitter = Clock(), np.random.default_rng(1)
        assert (clock.due(BEGAN), clock.drift, clock.offset) == (0, 0, 0)
        for k in range(0, 1_000_000, 50):
            clock.hear(k, BEGAN + k * PERIOD + k * PERIOD * ppm // 10**6 + int(jitter.integers(0, 2000)))
        assert abs(clock.drift - ppm) <= 20
        assert abs(clock.offset - 999_950 * PERIOD * ppm // 10**6) <= 2000
        for k in range(AGREED):
            clock.hear(10**7 + k, BEGAN + k * PERIOD)
        assert (clock.jumps, clock.drift) == (1, 0)


def test_a_step_is_due_when_it_begins_and_not_before() -> None:
    """To the count; and before the first step, none is. A node that waits subtracts its waiting."""
    clock = Clock()
    clock.hear(7, 100 * PERIOD)
    for k in range(1, 20):
        assert clock.due((93 + k) * PERIOD) == k + 1
        assert clock.due((93 + k) * PERIOD - 1) == k
    assert clock.due(93 * PERIOD - 1) == clock.due(0) == 0


def test_a_slow_timer_adds_up_what_is_less_than_a_count() -> None:
    """100 counts in a step, of which a thousandth is nothing: the clock follows all the same."""
    clock = Clock(100)
    for k in range(100_000):
        clock.hear(k, BEGAN + k * 100 + k * 100 * 500 // 10**6)
    assert abs(clock.drift - 500) <= 5
    assert abs(clock.offset - 5000) <= 20


def test_a_clock_hears_the_packets_that_a_node_accepts_or_finds_too_early() -> None:
    """Not what is refused or doubled; eight packets from far ahead are a jump."""
    found = case("ideal", "actuator", 0)
    wire, node, clock = Wire(found.policy, found.network), Device(found.library, None, 9, LOOP), Clock()

    def give(datagram: bytes, now: int) -> bool:
        size = c.c_size_t(len(datagram))
        return clock.code.tac_clock_receive(c.byref(clock), node.node, datagram, size, c.c_uint64(now))

    def mark(tick: int, sequence: int) -> bytes:
        return wire.encode(Packet("mark", "actuator", tick, sequence, (), 1, LOOP))

    assert not give(b"no packet", BEGAN)
    assert not clock.known
    assert give(mark(0, 0), BEGAN)
    assert clock.due(BEGAN) == 1
    assert node.step(0)
    assert not give(mark(0, 0), BEGAN - 500)
    assert clock.due(BEGAN - 500) == 0
    for i in range(AGREED):
        assert not give(mark(1000 + i, 1 + i), BEGAN + i * PERIOD)
    assert clock.jumps == 1
    assert clock.due(BEGAN + 8 * PERIOD) == 1009


def check_drift(lines: list[str], seconds: int) -> None:
    """Check what the program of `drift.c` tells: no step is missed but those of the stall, and each begins in time."""
    assert len(lines) == 2
    for line, ppm in zip(lines, (500, -500), strict=True):
        told, missed, last, least, most, drift, offset = map(int, line.split())
        assert told == ppm
        assert 0 < missed <= 10
        assert last == 100 * seconds - 1
        assert 0 <= least <= most < PERIOD / 2
        assert abs(drift - ppm) <= 20
        assert abs(offset - seconds * ppm) <= PERIOD / 2


@pytest.mark.evidence
def test_a_minute_of_drift_and_a_stall_misses_no_other_step(tmp_path: Path) -> None:
    """±500 ppm; ten steps in which nothing is executed and nothing arrives."""
    folder = write(tmp_path, print_folder(two_mass(), "policy", rows=1))
    sources = [HERE / "drift.c", *(folder / name for name in CORE_SOURCES), *folder.glob("policy_*.c")]
    options = [*STRICT, "-O1", "-DDRIFT_SECONDS=60", f"-I{folder}", "-o", str(tmp_path / "drift")]
    subprocess.run([needs_compiler(), *options, *map(str, sources)], check=True)
    done = subprocess.run([str(tmp_path / "drift")], capture_output=True, text=True, check=True)
    check_drift(done.stdout.splitlines(), 60)


@pytest.mark.evidence
@pytest.mark.parametrize("board", [cortex.M3, cortex.M4F], ids=lambda board: board.processor)
def test_an_hour_of_drift_on_a_board_misses_no_other_step(board: cortex.EmulatedBoard, tmp_path: Path) -> None:
    """360,000 steps of both nodes on the emulated board, for each sign."""
    if not all(map(shutil.which, (board.target.compiler, "qemu-system-arm"))):
        pytest.skip("NOT SHOWN: an hour on a board; compiler or emulator are missing")
    sources = (*CORE_SOURCES, "policy_controller.c", "policy_actuator.c")
    program = cortex.Main(sources, ("-DDRIFT_SECONDS=3600",), {"drift.c": DRIFT})
    made = cortex.compile_for(board, print_folder(two_mass(), "policy", rows=1), program, tmp_path)
    check_drift(cortex.run_on(board, made, patience=900.0).splitlines(), 3600)
