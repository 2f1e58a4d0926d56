"""Links that lose, double, reorder, delay and corrupt: of the law that is asked for, and the same of the same seed."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import taciturn
from taciturn import Burst
from taciturn.errors import ProblemError
from taciturn.nodes.packet import Packet, Wire
from taciturn_udp.relay import EmulatedLink, Fate

WIRE = Wire(taciturn.load("two-mass-lqg").design())


def datagram(k: int, kind: str = "data") -> bytes:
    """Return packet k of step k."""
    return WIRE.encode(Packet(kind, "actuator", k, k, (0.5,) if kind == "data" else ()))  # type: ignore[arg-type]


def within(found: float, expected: float, error: float) -> bool:
    """Tell whether a number is within 4.5 standard errors."""
    return abs(found - expected) <= 4.5 * error


@given(st.floats(0.02, 0.98), st.integers(0, 2**32))
@settings(max_examples=6, deadline=None)
def test_losses_are_independent_with_their_probability(loss: float, seed: int) -> None:
    """Share of the lost, and share of the lost behind a loss."""
    lost = np.array([Fate(seed, loss).lost(k, k) for k in range(4000)])
    assert within(lost.mean(), loss, np.sqrt(loss * (1 - loss) / 4000))
    behind = lost[1:][lost[:-1]]
    assert within(behind.mean(), loss, np.sqrt(loss * (1 - loss) / max(len(behind), 1)))


@given(st.floats(0.05, 0.9), st.floats(0.05, 0.9), st.integers(0, 2**32))
@settings(max_examples=5, deadline=None)
def test_bursts_have_the_law_of_gilbert_and_elliott(to_bad: float, to_good: float, seed: int) -> None:
    """Where bad loses everything and good nothing, turns and shares are those of the chain, from the first step on."""
    burst = Burst(to_bad, to_good, 0.0, 1.0)
    fate = Fate(seed, burst=burst)
    bad = np.array([fate.lost(k, k) for k in range(6000)])
    rho = 1 - to_bad - to_good
    variance = burst.share_bad * (1 - burst.share_bad) * (1 + rho) / (1 - rho)
    assert within(bad.mean(), burst.share_bad, np.sqrt(variance / 6000))
    left = bad[:-1]
    assert within(bad[1:][~left].mean(), to_bad, np.sqrt(to_bad * (1 - to_bad) / max((~left).sum(), 1)))
    assert within(bad[1:][left].mean(), 1 - to_good, np.sqrt(to_good * (1 - to_good) / max(left.sum(), 1)))
    first = np.array([Fate(i, burst=burst).lost(0, 0) for i in range(2000)])
    assert within(first.mean(), burst.share_bad, np.sqrt(burst.share_bad * (1 - burst.share_bad) / 2000))


def test_order_and_time_of_arrival_do_not_matter() -> None:
    """What is lost is the same whichever packets come before, and whenever."""
    for fate in (Fate(3, 0.4), Fate(3, burst=Burst(0.1, 0.2, 0.05, 0.8))):
        forwards = [fate.lost(k, k) for k in range(200)]
        assert [fate.lost(k, k) for k in reversed(range(200))] == forwards[::-1]


def test_every_datagram_is_accounted_for() -> None:
    """Loss, doubles, swaps and harm together: in − lost + doubled = out + still held."""
    channel = EmulatedLink(Fate(1, 0.2, duplicate=0.3, reorder=0.3, corrupt=0.1))
    out = [one for k in range(5000) for one in channel.take(datagram(k), 0.0)]
    count = channel.counters
    assert count["received"] == 5000
    assert len(out) == count["delivered"] == 5000 - count["lost"] + count["duplicated"] - channel.pending
    read = [WIRE.decode(one) for one in out]
    assert within(count["duplicated"] / 4000, 0.3, np.sqrt(0.21 / 4000))
    assert within(count["corrupted"] / 4000, 0.1, np.sqrt(0.09 / 4000))
    harmed = sum(isinstance(packet, str) for packet in read)
    assert count["corrupted"] <= harmed <= 2 * count["corrupted"]
    ticks = [packet.tick for packet in read if not isinstance(packet, str)]
    overtaken = sum(later < earlier for earlier, later in pairwise(ticks))
    assert 0.5 * count["reordered"] < overtaken <= count["reordered"]


def test_delays_are_kept_and_marks_overtake_nothing() -> None:
    """In real time a packet is due after its delay; in virtual time it waits for the mark that lets it go."""
    slow = EmulatedLink(Fate(delay=0.2, jitter=0.1))
    assert slow.take(datagram(0), 5.0) == []
    assert slow.due is not None
    assert 5.2 <= slow.due <= 5.3
    assert slow.release(5.19) == []
    assert slow.release(5.31) == [datagram(0)]
    assert slow.take(datagram(1), 6.0) == slow.take(datagram(1, "mark"), 6.0) == []
    assert slow.pending == 1
    assert slow.release(6.5) == [datagram(1), datagram(1, "mark")]
    assert slow.counters == {"received": 2, "marks": 1, "delivered": 2}
    shaken = EmulatedLink(Fate(jitter=0.1))
    assert shaken.take(datagram(0), 5.0) == shaken.take(datagram(0, "mark"), 5.1) == []
    assert shaken.release(5.1) == [datagram(0), datagram(0, "mark")]
    held = EmulatedLink(Fate(hold=2))
    assert held.take(datagram(0), 0.0) == []
    assert held.take(datagram(1, "mark"), 0.0) == [datagram(1, "mark")]
    assert held.take(datagram(2, "mark"), 0.0) == [datagram(0), datagram(2, "mark")]


def test_impossible_links_are_refused() -> None:
    """Probabilities, times, and loss next to bursts; what is too short for a packet is dropped."""
    for wrong in ({"loss": 1.5}, {"duplicate": -0.1}, {"delay": -1.0}, {"hold": -1}, {"seed": -1}):
        with pytest.raises(ProblemError, match="expected"):
            Fate(**wrong)  # type: ignore[arg-type]
    with pytest.raises(ProblemError, match="both given"):
        Fate(loss=0.1, burst=Burst(0.1, 0.1, 0.0, 1.0))
    channel = EmulatedLink(Fate())
    assert channel.take(b"short", 0.0) == []
    assert channel.counters == {"foreign": 1}


def test_loops_that_share_a_link_lose_other_packets_and_an_outage_is_one_for_all() -> None:
    """What is lost of one loop says nothing of another: as often both as chance has it; in an outage all is."""
    fate, other = Fate(5, 0.3), Fate(5, 0.3, outage=(10, 20))
    pairs = np.array([[fate.lost(k, k, loop) for loop in (0, 1)] for k in range(6000)])
    assert within(pairs.all(axis=1).mean(), 0.09, np.sqrt(0.09 * 0.91 / 6000))
    for loop in (0, 1):
        for k in range(30):
            assert other.lost(k, k, loop) == (10 <= k < 20 or fate.lost(k, k, loop))
    channel = EmulatedLink(Fate(outage=(3, 5)))
    assert [len(channel.take(datagram(k), 0.0)) for k in range(7)] == [1, 1, 1, 0, 0, 1, 1]
    with pytest.raises(ProblemError, match="the outage is"):
        Fate(outage=(5, 5))
