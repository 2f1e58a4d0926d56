"""Listeners take the phase of the ticks from the packets that arrive."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from taciturn.runtime.clock import JUMPED, Phase

TICK = 0.01


@given(st.floats(-5e-4, 5e-4), st.integers(0, 2**32 - 1))
def test_the_phase_follows_a_clock_that_drifts(drift: float, seed: int) -> None:
    """With packets up to half a tick late and clocks that differ by 500 ppm, ticks are told within a fifth of one."""
    draws, phase, off = np.random.default_rng(seed), Phase(TICK), []
    for k in range(4000):
        began = 3.0 + k * TICK * (1 + drift)
        phase.hear(k, began + draws.exponential(0.1) ** 2 * TICK)
        off.append(phase.begins(k) - began)
    assert np.abs(off[1000:]).max() < 0.2 * TICK
    assert phase.jumps == 0


def test_a_jump_is_followed_when_it_is_confirmed() -> None:
    """One packet that is off by many ticks is none; two are a jump."""
    phase = Phase(TICK)
    for k in range(10):
        phase.hear(k, k * TICK)
    phase.hear(10, 7.0)
    assert phase.jumps == 0
    assert abs(phase.begins(10) - 10 * TICK) < TICK
    phase.hear(11, 7.0 + TICK)
    assert phase.jumps == 1
    assert abs(phase.begins(12) - (7.0 + 2 * TICK)) < 1e-9
    assert phase.now(7.0 + 2.5 * TICK) == 12
    assert JUMPED * TICK < 6.9
