"""What a plant reports of its costs: a mean with its error where it ran for long enough."""

from __future__ import annotations

import numpy as np
import pytest

import taciturn
from taciturn import Cost, Plant, close, design
from taciturn.simulation.statistics import batch_means
from taciturn.study.testbed.network import _unheard
from taciturn.study.testbed.ticks import plant_cost, settled

PROBLEM = taciturn.load("two-mass-lqg")
LOOP = PROBLEM.close(PROBLEM.design())


def test_a_long_run_has_a_mean_with_its_error() -> None:
    """Over all loops, without the steps in which the loop settles."""
    skipped = settled(LOOP)
    costs = np.random.default_rng(1).exponential(size=(2, skipped + 640))
    costs[:, :skipped] = 1e6
    found = plant_cost(PROBLEM, LOOP, costs.tolist(), 0.0)
    expected = batch_means(costs[:, skipped:].mean(axis=0))
    assert found["cost"]["value"] == pytest.approx(expected.value)
    assert found["cost"]["standard_error"] == pytest.approx(expected.standard_error)
    assert found["unit"] == "step"
    assert found["notes"] == [f"means omit the first {skipped} steps, in which the loop settles"]


def test_where_nothing_arrives_there_is_no_average() -> None:
    """Of a plant that drifts; one that comes to rest needs no input."""
    nothing, little = ({"sent": 600, "delivered": some, "lost": 600 - some} for some in (0, 1))
    (told,) = _unheard(LOOP, {"actuator": nothing})
    assert told.startswith("no packet arrived on the actuator link")
    assert _unheard(LOOP, {"actuator": little}) == ()
    plant, cost = Plant([[0.5]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
    assert _unheard(close(plant, design.lqg(plant, cost, theta=1.0)), {"actuator": nothing}) == ()


def test_a_cost_that_a_few_ticks_decide_is_told() -> None:
    """One step in a thousand costs a million times as much."""
    costs = np.ones((1, settled(LOOP) + 1000))
    costs[0, -1] = 1e6
    assert "its mean square may not exist" in plant_cost(PROBLEM, LOOP, costs.tolist(), 0.0)["notes"][-1]


def test_a_short_run_has_a_mean_alone() -> None:
    """Over all its steps, and it says how many an error takes; a run of no step has none."""
    found = plant_cost(PROBLEM, LOOP, [[1.0, 2.0, 6.0]], 0.0)
    assert found["cost"] == {"value": 3.0, "standard_error": None, "method": "simulation"}
    assert found["notes"][0].startswith("3 steps are too few for a mean cost with its error")
    assert plant_cost(PROBLEM, LOOP, [[], []], 0.0)["cost"] is None
