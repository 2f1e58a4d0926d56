"""A node in C that is saved and restored does what it would have done, as on the host; nothing else is restored."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from counts import few
from export.devices import Device, compile_node
from export.test_nodes_in_c import LOOP, LOOPS, Pair, all_or_some, case, compiled, places, play, random_events

from taciturn.model.network import Network


class Moved(Pair):
    """A pair whose node in C moves to other memory after every third step, as after a reset."""

    steps = moves = 0

    def step(self, gap: int) -> None:
        """Go through a step, and continue elsewhere."""
        self.steps += 1
        if self.steps % 3 == 0:
            old = self.device
            saved = old.save()
            self.device = Device(self.case.library, None, 1, LOOP)
            self.device.watch(*self.case.watch)
            if self.every is not None:
                self.device.mark_after(self.every)
            assert self.device.restore(saved)
            assert self.device.save() == saved
            assert 0 < len(saved) <= old.code.shim_size()
            self.moves += 1
        super().step(gap)


@all_or_some
def test_a_restored_node_goes_on_bit_for_bit(every: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever arrives, with packets that wait, steps left out, draws, acknowledgements and watchdogs: as the host."""
    monkeypatch.setattr("export.test_nodes_in_c.Pair", Moved)
    for i, (name, role) in enumerate(places()[::every]):
        pair = play(case(name, role, i % 3), random_events(np.random.default_rng(i), 120), i)
        assert isinstance(pair, Moved)
        assert pair.moves > 30


def sealed(saved: bytes) -> bytes:
    """Return a state with a right checksum."""
    return saved[:-4] + struct.pack(">I", zlib.crc32(saved[:-4]))


def running(steps: int = 5, loop: int = LOOP) -> Device:
    """Return a node that has run."""
    node = Device(compiled("ideal", "actuator"), None, 9, loop)
    for tick in range(steps):
        assert node.step(tick)
    return node


def test_damaged_and_foreign_states_are_refused_and_change_nothing(tmp_path: Path) -> None:
    """Every flipped bit, every length; another format, policy, role, loop and data; and counters out of their range."""
    node, other = running(), running(9)
    saved, before = node.save(), other.save()
    assert not any(other.restore(saved[:size]) for size in range(len(saved)))
    assert not other.restore(saved + b"\0")
    for bit in range(8 * len(saved)):
        harmed = bytearray(saved)
        harmed[bit // 8] ^= 1 << bit % 8
        assert not other.restore(bytes(harmed))
    for at in (3, 11, 15, 17):  # format, fingerprint, CRC of the data, loop
        harmed = bytearray(saved)
        harmed[at] ^= 1
        assert not other.restore(sealed(bytes(harmed)))
    loop = LOOPS["ideal"]()
    controller = Device(compiled("ideal", "controller"), None, 9, LOOP)
    assert controller.step(0, [1.0, 2.0])
    library = compile_node(loop.policy, "actuator", Network("udp", 0.1, 0.1), tmp_path)
    for foreign in (controller.save(), running(5, LOOP + 1).save(), Device(library, None, 9, LOOP).save()):
        assert foreign
        assert not other.restore(foreign)
    assert other.save() == before
    assert other.restore(saved)
    assert other.save() == saved


@pytest.mark.evidence
@pytest.mark.parametrize("seed", few(range(4), 1))
def test_no_state_with_a_right_checksum_harms_a_node(seed: int) -> None:
    """Its values are in their ranges, or it is refused: the node continues with either."""
    draws, taken = np.random.default_rng(seed), 0
    node = Device(compiled("told", "controller"), None, 9, LOOP)
    measured = [0.5] * node.library.sizes[0]
    for tick in range(4):
        node.step(tick, measured)
    saved = node.save()
    for _ in range(500):
        harmed = bytearray(saved)
        for at in draws.integers(18, len(saved) - 4, 3):
            harmed[at] = draws.integers(256)
        taken += node.restore(sealed(bytes(harmed)))
        node.step(int(draws.integers(2**40)), measured)
        node.send()
    assert taken > 100


def test_a_state_needs_its_room() -> None:
    """One byte less, and nothing is saved."""
    node = running()
    saved = node.save()
    assert node.save(len(saved)) == saved
    assert {node.save(size) for size in range(len(saved))} == {b""}
