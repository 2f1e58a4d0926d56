"""Policies whose actuator predicts the state: the inputs are those of the plant, and predictions are named as such."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

import taciturn
from taciturn.loop import Loop
from taciturn.simulation.trajectory import Trajectory
from taciturn.study.describe import describe

PLANT = taciturn.ContinuousPlant(np.eye(2, k=1), np.array([[0.0], [1.0]]), np.diag([0.0, 2.5]))
COST = taciturn.Cost(np.eye(2), np.array([[10.0]]))
PROBLEM = taciturn.Problem(PLANT, COST, taciturn.Network(), "consistent", {"period": 0.1})


@cache
def loop() -> Loop:
    """Return the loop, whose plant has two states and one input."""
    return PROBLEM.close(PROBLEM.design())


@cache
def path() -> Trajectory:
    """Return a short path."""
    return taciturn.simulate(loop(), 30, seed=1)


def test_the_input_of_a_path_is_the_gain_times_the_prediction() -> None:
    """One input; a prediction equals the state after a send, and otherwise moves by its model."""
    found, prediction = path(), loop().policy.prediction
    assert prediction is not None
    assert found.predicts
    assert found.input.shape == (30, 1)
    assert found.input == pytest.approx(found.estimate @ prediction.L.T)
    sent = found.sends["sensor"]
    assert sent.any()
    assert found.estimate[sent] == pytest.approx(found.state[sent])
    sampled = loop().problem.plant
    silent = np.flatnonzero(~sent[1:])
    moved = found.estimate @ (sampled.A + sampled.B).T
    assert found.estimate[1:][silent] == pytest.approx(moved[:-1][silent])
    names = [name for name in found.columns() if name != "time"]
    assert names[:5] == ["x1", "x2", "xhat1", "xhat2", "u1"]
    assert "u2" not in names


def test_a_printed_path_names_inputs_and_predictions() -> None:
    """One column for the input, two for the prediction, and a sentence on them."""
    text = str(path())
    assert text.split("\n\n")[1].split("\n", 1)[0].split() == [
        "time",
        "(s)",
        "x1",
        "x2",
        "u1",
        "xhat1",
        "xhat2",
        "sensor",
    ]
    assert "prediction of x by the actuator's model" in text


@pytest.mark.evidence
def test_a_drawn_path_names_predictions() -> None:
    """In the key of the states; the only input needs none."""
    figure: Any = path().plot()
    states, inputs = figure.axes[:2]
    assert (states.get_ylabel(), inputs.get_ylabel(), inputs.get_legend()) == ("states", "input", None)
    shown = [text.get_text() for text in states.get_legend().get_texts()]
    assert shown == ["$x_{1}$", "$x_{2}$", "prediction of the actuator"]


def test_the_diagram_and_the_texts_count_the_inputs_of_the_plant() -> None:
    """One input next to two predicted states."""
    (actuator,) = (place for place in loop().policy.diagram().places if "actuator" in place.nodes)
    assert (actuator.applies, actuator.predicts) == (1, 2)
    assert actuator.tasks == ("applies u", "predicts it between steps")
    document = describe(PROBLEM).document()
    assert document["diagram"]["places"][-1]["predicts"] == 2
    for one in (loop(), loop().policy, loop().problem):
        assert "2 states, 1 input, 2 outputs" in repr(one)


def test_a_policy_that_holds_its_input_predicts_nothing() -> None:
    """Its path and its diagram are as before."""
    held = PROBLEM.changed({"kind": "lqg", "theta": 0.1})
    found = taciturn.simulate(held.close(held.design()), 5)
    assert not found.predicts
    assert found.input.shape == (5, 1)
    assert all(place.predicts == 0 for place in held.design().diagram().places)
