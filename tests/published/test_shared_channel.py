"""Integrators on one channel: TDMA against slotted ALOHA (blind2013), and against events with arbitration (cervin2008).

Forty integrators with noise of variance 1 a step share one packet a step. The papers' own numbers depend on delays and
slot lengths that Taciturn does not have; who wins does not.
"""

from __future__ import annotations

import pytest

from taciturn import Cost, Network, Plant, Problem, share_channel
from taciturn_channel.share import SchedulerName, Sharing

LOOPS = 40
TDMA = (LOOPS - 1) / 2  # the mean of 0, 1, …, 39: variance of an integrator in its turn


def shared(scheduler: SchedulerName, ticks: int, confidence: float = 0.0) -> Sharing:
    """Return what the integrators cost; inputs are free, so that a packet resets the state."""
    plant, cost = Plant([[1.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1e-9]])
    problem = Problem(plant, cost, Network(), "lqg", {"theta": 0.1})
    return share_channel(
        {"integrator": problem}, copies=LOOPS, capacity=1, scheduler=scheduler, steps=ticks, confidence=confidence
    )


def excess(found: Sharing) -> tuple[float, float]:
    """Return the variance of one integrator after the sends of a step, and its standard error."""
    return (found.cost.value - found.cost_all_time) / LOOPS, found.cost.standard_error / LOOPS


@pytest.mark.parametrize("ticks", [1000, pytest.param(20_000, marks=pytest.mark.evidence)])
def test_events_with_arbitration_beat_tdma(ticks: int) -> None:
    """The largest error goes first: about a third of what TDMA costs, whose cost is (n − 1)/2."""
    events = shared("largest", ticks)
    assert (events.cost_periodic - events.cost_all_time) / LOOPS == pytest.approx(TDMA, rel=1e-9)
    value, error = excess(events)
    assert value + 4 * error < TDMA
    assert value == pytest.approx(TDMA / 3, rel=0.1)
    assert events.consistent


@pytest.mark.evidence
def test_tdma_costs_its_closed_form_on_the_channel_too() -> None:
    """Simulated, round robin and TDMA cost what the periodic allocation says."""
    for scheduler in ("round-robin", "tdma"):
        value, error = excess(shared(scheduler, 20_000))
        assert abs(value - TDMA) <= 4 * error


@pytest.mark.evidence
def test_tdma_beats_events_with_slotted_aloha() -> None:
    """Thresholds at the best common price, in slots that are accessed at random, where packets collide."""
    events = shared("random-access", 20_000)
    value, error = excess(events)
    assert value - 4 * error > TDMA
    assert events.load.value < 0.4  # of the slots, 1/e of which slotted ALOHA can use at most when it is busy
    assert events.consistent is False
