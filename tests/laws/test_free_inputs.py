"""Inputs that cost nothing by themselves: each policy kind is the limit of small weights, or refuses it by name."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from counts import few

import taciturn
from taciturn import Cost, Plant, TaciturnError, design
from taciturn.design.catalogue import CATALOGUE
from taciturn.lqg.periodic import Held
from taciturn.problem import Problem
from taciturn_new.draft import example_of, suggest_value

CONTINUOUS = {"consistent", "integral", "near-optimal", "optimal"}  # their gain is −R⁻¹(B'K + N')


def numbers(problem: Problem) -> list[float]:
    """Return what a policy costs with every sample, and its guarantee if it has one."""
    policy: Any = problem.designed()
    theory = getattr(policy, "theory", None)
    guarantee = getattr(theory, "guarantee", None)
    return [policy.cost_all_time, *([] if guarantee is None else [guarantee.cost])]


@pytest.mark.parametrize("kind", few(CATALOGUE, 8))
def test_each_kind_is_the_limit_of_small_weights_or_refuses(kind: str) -> None:
    """Its cost and its guarantee with R = 0 are those with R = 10⁻⁹, up to this share."""
    example = example_of(CATALOGUE[kind])
    m = example.plant.inputs
    free, cheap = (example.changed({"cost.R": (r * np.eye(m)).tolist()}) for r in (0.0, 1e-9))
    if kind in CONTINUOUS:
        with pytest.raises(TaciturnError, match=r"R has the eigenvalue 0, .* needs a positive definite R"):
            free.designed()
        return
    assert numbers(free) == pytest.approx(numbers(cheap), rel=1e-4)


def test_deadbeat_control_costs_the_noise_of_a_step() -> None:
    """x⁺ = 2x + u + w with Q = 3, R = 0 and Var w = 4 costs 3·4 per step.

    If u is held for two steps, the state at a send costs 3x² + 3(2x + u)² + K(4x + 3u)². The least over u is
    K = 3 + 12K/(3 + 9K), so K² = 4K + 1; the noise costs 3·4 between the sends, and K·(4 + 16) at the next one.
    """
    plant, cost = Plant([[2.0]], [[1.0]], [[4.0]]), Cost([[3.0]], [[0.0]])
    assert design.all_time(plant, cost).cost_all_time == pytest.approx(12.0, rel=1e-12)
    K = 2 + np.sqrt(5)
    found = Held([[2.0]], [[1.0]], [[3.0]], [[0.0]], [[0.0]], [[4.0]]).solve((2,))
    assert found.values[0, 0, 0] == pytest.approx(K, rel=1e-12)
    assert found.cost == pytest.approx((12 + 20 * K) / 2, rel=1e-12)
    assert found.gains[0, 0, 0] == pytest.approx(-(6 + 12 * K) / (3 + 9 * K), rel=1e-12)


def test_a_period_is_suggested_without_a_fastest_mode() -> None:
    """The loop of a free input is as fast as the period allows; the plant itself sets the scale."""
    plant = taciturn.ContinuousPlant([[0.0, 1.0], [0.0, -0.5]], [[0.0], [1.0]], np.diag([0.0, 0.1]))
    found = suggest_value(CATALOGUE["excess"], "period", plant, Cost(np.diag([1.0, 0.0]), [[0.0]]), None)
    assert isinstance(found, float)
    assert design.all_time(plant, Cost(np.diag([1.0, 0.0]), [[0.0]]), period=found).cost_all_time > 0
