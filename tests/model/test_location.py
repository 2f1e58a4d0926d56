"""Finite locations: which of them are clocks, and what averages make of their cycle."""

from __future__ import annotations

import numpy as np
import pytest

import taciturn.model.steps as location_module
from taciturn import Cost, Plant, Policy, Trigger, average, close
from taciturn.model.steps import Assign, Decide, Location, Received, Send, joint_cycle
from taciturn.model.theory import Theory
from taciturn.model.trigger import Form, Scheduled

ONE = np.eye(1)
TURN = np.roll(np.arange(5), -1)  # from each of five places to the next
SECOND = {"go": Trigger({"silent": Form(constant=Scheduled("count", [0.0, 1.0])), "send": Form(constant=0.5)})}
MEASURED = {"go": Trigger({"silent": Form(("y",), ONE), "send": Form(constant=0.5)})}
COUNT = Location("count", np.array([[1, 1], [0, 0]]), "sensor", "go")


def owned(*columns: np.ndarray) -> Location:
    """Return a location that a node owns, moved by a decision."""
    return Location("place", np.stack(columns, axis=1), "sensor", "go")


def test_a_location_whose_columns_agree_is_a_clock_wherever_it_lives() -> None:
    """Shared by all nodes, or a node's own, whatever moves it."""
    assert Location("place", TURN).period == 5
    assert owned(TURN, TURN).period == 5
    assert Location("place", np.stack([TURN, TURN], axis=1), "controller", Received("sensor")).period == 5
    assert joint_cycle([owned(TURN, TURN), COUNT], MEASURED) == 10


def test_what_data_decide_is_no_clock() -> None:
    """One column for each outcome, and they differ where the location comes."""
    assert owned(TURN, 0 * TURN).period == 1
    assert joint_cycle([owned(TURN, 0 * TURN), COUNT], MEASURED) == 2
    assert owned(np.array([1, 0, 0, 0, 4]), np.array([1, 0, 0, 0, 0])).period == 2


def test_a_decision_that_a_clock_makes_moves_a_clock() -> None:
    """Silence costs 0 and 1 in turn: the place moves on at every second step."""
    moved = owned(np.arange(5), TURN)
    assert joint_cycle([moved, COUNT], SECOND) == 10
    assert joint_cycle([moved, COUNT], MEASURED) == 2
    alone = {"go": Trigger({"silent": Form(constant=1.0), "send": Form(constant=0.5)})}
    assert joint_cycle([moved], alone) == 5
    tied = {"go": Trigger({"silent": Form(constant=0.5), "send": Form(constant=0.5)})}
    assert joint_cycle([moved], tied) == 1  # ties go to the first: it stays


def test_a_cycle_of_several_locations_that_is_too_long_to_walk_counts_for_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A single location is walked to its end."""
    monkeypatch.setattr(location_module, "LONGEST", 3)
    assert joint_cycle([owned(np.arange(5), TURN), COUNT], SECOND) == 2
    assert joint_cycle([owned(TURN, TURN)], SECOND) == 5


def test_a_rule_that_counts_at_its_node_has_its_rate_exactly() -> None:
    """Two packets in each 1600 steps: windows are whole turns, and no window has another number."""
    ticks = 1600
    silence = np.zeros(ticks)
    silence[[0, 7]] = 1.0
    turn = np.roll(np.arange(ticks), -1)
    rule = Trigger({"silent": Form(constant=Scheduled("count", silence)), "send": Form(constant=0.5)})
    policy = Policy(
        "mine",
        (
            Decide("sensor", "go", rule),
            Send("sensor", "sensor", ("y",), "go"),
            Assign("controller", "seen", ({"seen": 0 * ONE}, {"y": -0.2 * ONE}), Received("sensor")),
            Assign("actuator", "input", {"seen": ONE}),
        ),
        Plant(0.5 * ONE, ONE, ONE),
        Theory(),
        (frozenset({"controller", "actuator"}),),
        (Location("count", np.stack([turn, turn], axis=1), "sensor", "go"),),
    )
    assert policy.cycle == ticks
    found = average(close(policy.model, policy, cost=Cost(ONE, ONE)), steps=400_000).rates["sensor"]
    assert found.value == pytest.approx(2 / ticks, rel=1e-12)
