"""Listeners take the phase of the steps from the packets that arrive."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from taciturn.nodes.clock import AGREED, Phase

TICK = 0.01


@given(st.floats(-5e-4, 5e-4), st.integers(0, 2**32 - 1))
@settings(max_examples=10)
def test_the_phase_follows_a_clock_that_drifts(drift: float, seed: int) -> None:
    """With packets up to half a step late and clocks that differ by 500 ppm, steps are told within a fifth of one."""
    draws, phase, off = np.random.default_rng(seed), Phase(TICK), []
    for k in range(4000):
        began = 3.0 + k * TICK * (1 + drift)
        phase.hear(k, began + draws.exponential(0.1) ** 2 * TICK)
        off.append(phase.begins(k) - began)
    assert np.abs(off[1000:]).max() < 0.2 * TICK
    assert phase.jumps == 0


def test_a_jump_is_followed_when_many_packets_in_a_row_agree_on_it() -> None:
    """What tells of another phase changes nothing but at the end of a row; one of the old phase ends it."""
    for off in (7.0, -7.0):
        phase = Phase(TICK)
        for k in range(10):
            assert phase.hear(k, k * TICK)
        row = [(k, k * TICK + off) for k in range(10, 10 + AGREED)]
        for k, now in row[:-1]:
            assert phase.hear(k, now) == (off > 0)  # late is possible, early is not
        assert phase.hear(10, 10 * TICK)
        for k, now in row[:-1]:
            phase.hear(k, now)
        assert phase.jumps == 0
        assert abs(phase.begins(10) - 10 * TICK) < TICK
        assert phase.hear(*row[-1])
        assert phase.jumps == 1
        assert abs(phase.begins(30) - (30 * TICK + off)) < 1e-9
        assert phase.now(off + 30.5 * TICK) == 30


def test_a_tick_that_cannot_have_begun_is_not_believed() -> None:
    """Packets of the far future, each another, change nothing."""
    phase = Phase(TICK)
    phase.hear(0, 0.0)
    for k in range(1, 100):
        assert not phase.hear(10_000 * k, 0.001 * k)
    assert phase.jumps == 0
    assert phase.begins(1) == TICK


def test_a_small_jump_forward_is_followed_after_a_row_of_late_packets() -> None:
    """A clock that is some steps fast recovers after a row of packets, not after thousands; one on time ends a row."""
    for off in (0.4, 6.0):
        phase = Phase(TICK)
        for k in range(10):
            phase.hear(k, k * TICK)
        for k in range(10, 10 + AGREED - 1):
            phase.hear(k, (k + off) * TICK)
        assert phase.begins(30) - 30 * TICK < 0.1 * TICK
        phase.hear(17, 17 * TICK)
        for k in range(18, 18 + AGREED):
            assert phase.begins(30) - 30 * TICK < 0.1 * TICK
            phase.hear(k, (k + off) * TICK)
        assert abs(phase.begins(30) - (30 + off) * TICK) < 0.1 * TICK
        assert phase.jumps == (off >= 1.0)
