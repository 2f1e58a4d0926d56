"""Continuous plants with modes at zero: sampled, their eigenvalue 1 may be computed as slightly less than 1."""

from __future__ import annotations

import numpy as np
import pytest
from counts import few

import taciturn
from taciturn._modes import eigenvalues, radius
from taciturn.model.plant import ContinuousPlant
from taciturn_limits.fitted import decayed


def body(seed: int) -> ContinuousPlant:
    """Return two masses, a spring and a damper, in random units and coordinates; one of two cases floats freely."""
    draws = np.random.default_rng(seed)
    k, d, m = 10 ** draws.uniform(0, 2.5), 10 ** draws.uniform(-2, 0.5), 10 ** draws.uniform(-0.5, 0.5, 2)
    A = np.array(
        [
            [0, 1, 0, 0],
            [-k / m[0], -d / m[0], k / m[0], d / m[0]],
            [0, 0, 0, 1],
            [k / m[1], d / m[1], -k / m[1], -d / m[1]],
        ]
    )
    W = np.diag([0, 0.01, 0, 0.02])
    T = np.diag(10 ** draws.uniform(-1, 1, 4)) @ (np.eye(4) + 0.2 * draws.normal(size=(4, 4)) * (seed % 2))
    back = np.linalg.inv(T)
    C = np.eye(4)[[0, 2]] @ back
    return ContinuousPlant(T @ A @ back, T @ np.eye(4)[:, [1]] / m[0], T @ W @ T.T, C=C, V=1e-5 * np.eye(2))


@pytest.mark.evidence
@pytest.mark.parametrize("seed", few(range(30), 2))
def test_a_rigid_body_is_evaluated_with_its_lower_bound_or_a_note(seed: int) -> None:
    """Whether rounding puts its double mode at 1 inside or outside of the unit circle; also with the dearest sends."""
    plant = body(seed)
    cost = taciturn.Cost(plant.C.T @ plant.C, [[0.01]])
    parameters = {"theta": 0.3, "period": 0.05, "actuation": "model"}
    problem = taciturn.Problem(plant, cost, taciturn.Network(), kind="excess", parameters=parameters)
    found = taciturn.evaluate(problem, confidence=0.99, steps=20_000)
    assert found.cost_all_time is not None
    assert found.cost.value > found.cost_all_time * (1 - 1e-9)
    assert found.cost_bound is not None
    assert found.cost.value <= found.cost_bound + 5 * found.cost.standard_error
    lower = found.lower_bound
    assert lower is None or lower.cost <= found.cost.value + 5 * found.cost.standard_error
    assert lower is not None or any("no lower bound" in note for note in found.notes)


@pytest.mark.parametrize("seed", few(range(200), 20))
def test_a_sum_that_rounding_decides_is_not_computed(seed: int) -> None:
    """A rotation or a shear with modes at 1, moved by rounding: there is no sum, and none is invented."""
    draws = np.random.default_rng(seed)
    n = 2 + seed % 4
    T = draws.normal(size=(n, n)) + 3 * np.eye(n)
    block = np.diag(np.concatenate([[1.0, 1.0], draws.uniform(-0.9, 0.9, n - 2)]))
    block[0, 1] = seed % 3 == 0
    F = T @ block @ np.linalg.inv(T)
    assert abs(radius(F) - 1) < 1e-6
    assert decayed(F, np.eye(n)) is None
    assert decayed(0.9 * F, np.eye(n)) is not None
    assert np.isfinite(eigenvalues(F)).all()
