"""Disturbances that enter as an input does: the input cancels them, and the gain of the plant stays what it was."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from systems import make_system, well_posed

from taciturn import Cost, Plant, design
from taciturn.errors import UnstableError
from taciturn.lqg.discrete import discretise
from taciturn.lqg.riccati import regulate
from taciturn.model.disturbance import follow
from taciturn.model.signals import ExternalDisturbance

SHAPES = {"ramp": None, "sinusoid": 0.3}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("direction", [0, 1], ids=["the input", "a mixture of inputs"])
def test_the_gain_of_the_plant_does_not_depend_on_a_disturbance_that_enters_like_an_input(
    shape: str, direction: int
) -> None:
    """The second state of the disturbance costs nothing but rounding; its modes lie on the unit circle."""
    checked = 0
    for seed in range(12):
        system = make_system(seed, 2, 1 + direction, 1 + direction, False)
        plant, cost = system.plant, system.cost
        if not (well_posed(plant.A, plant.B) and well_posed(plant.A.T, plant.C.T)):
            continue
        enters = plant.B @ np.ones(plant.inputs)
        push = ExternalDisturbance(enters, 0.01, shape, SHAPES[shape])  # type: ignore[arg-type]
        followed = follow(Plant(plant.A, plant.B, plant.W, plant.C, plant.V), plant.C, None, [push])
        problem = discretise(followed, cost, None)
        found = regulate(problem.plant.A, problem.plant.B, problem.Q, problem.R, problem.N)
        K = solve_discrete_are(plant.A, plant.B, cost.Q, cost.R, s=cost.N)
        L = -np.linalg.solve(cost.R + plant.B.T @ K @ plant.B, plant.B.T @ K @ plant.A + cost.N.T)
        assert np.allclose(found.L[:, :2], L, rtol=1e-9, atol=1e-11)
        closed = problem.plant.A + problem.plant.B @ found.L
        assert np.allclose(closed[:2, 2:], 0.0, atol=1e-9), "the disturbance is cancelled"
        checked += 1
    assert checked > 6


def test_the_cost_of_a_sinusoid_at_the_input_is_that_of_its_equations() -> None:
    """tr(K T W T') + tr(H L Σ L') by other solvers, for a plant with which every sample once cost six times as much."""
    A, B = np.array([[0.2179, 2.0409], [0.2007, 0.2021]]), np.array([[-0.7848], [0.7487]])
    C, turn = np.array([[1.6348, 0.2728]]), np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    plant = follow(
        Plant(A, B, 0.2 * np.eye(2), C, [[0.1]]), C, None, [ExternalDisturbance(B[:, 0], 0.01, "sinusoid", 0.3)]
    )
    found = design.all_time(plant, Cost(np.eye(2), [[0.5]])).cost_all_time
    K = solve_discrete_are(A, B, np.eye(2), [[0.5]])
    H = 0.5 + B.T @ K @ B
    L = -np.linalg.solve(H, B.T @ K @ A)
    joint = np.block([[A, B @ np.eye(1, 2)], [np.zeros((2, 2)), turn]])
    seen, noise = np.hstack([C, np.zeros((1, 2))]), np.diag([0.2, 0.2, 0.01, 0.01])
    prior = solve_discrete_are(joint.T, seen.T, noise, [[0.1]])
    posterior = prior - prior @ seen.T @ np.linalg.solve(seen @ prior @ seen.T + 0.1, seen @ prior)
    gain = np.hstack([L, -np.eye(1, 2)])
    assert found == pytest.approx(0.2 * np.trace(K) + float((H @ gain @ posterior @ gain.T)[0, 0]), rel=1e-8)


def test_a_ramp_that_a_held_input_cannot_follow_is_refused() -> None:
    """What it costs to hold the input grows with the ramp."""
    B = np.array([[1.152], [1.9106]])
    plant = Plant([[0.6439, 0.2553], [0.2012, 1.0485]], B, 0.2 * np.eye(2), [[0.7694, 0.0095]], [[0.1]], dt=1.0)
    pushed = follow(plant, plant.C, None, [ExternalDisturbance(B[:, 0], 0.01, "ramp")])
    with pytest.raises(UnstableError, match="the cost grows without limit and has no average"):
        design.periodic(pushed, Cost(np.eye(2), [[0.5]]), every=[5, 4, 3, 2])
