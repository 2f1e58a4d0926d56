"""Nonlinear plants with disturbances and set-points: as the linear plant where they are linear, in all builds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from counts import few

import taciturn
from taciturn import Cost, Plant, close, design, simulate
from taciturn.model.disturbance import follow
from taciturn.model.dynamics import Map
from taciturn.model.operating_point import OperatingPoint
from taciturn.model.signals import Changes, ExternalDisturbance, RandomSteps, Timetable
from taciturn.nodes.simulated_plant import SimulatedPlant

A, B = np.array([[0.9, 0.2], [0.0, 0.8]]), np.array([[0.1], [0.5]])
C = np.array([[1.0, 0.0]])
COST = Cost(np.eye(2), [[0.1]])
X, U = np.array([5.0, 2.0]), np.array([3.0])
TABLE = Timetable([0, 30, 70, 100], [[5.0], [7.0], [4.0], [5.0]])
DISTURBANCES = {
    "constant": ExternalDisturbance([0.0, 0.3], wander=1e-3),
    "ramp": ExternalDisturbance([0.0, 0.3], wander=1e-6, shape="ramp"),
    "sinusoid, measured": ExternalDisturbance([0.1, 0.3], 1e-3, "sinusoid", frequency=0.2, measured=[0.5]),
}


def step_at(x: np.ndarray, u: np.ndarray) -> Map:
    """Return a linear step around a point, as a function in the units of the plant."""

    def step(state: Any, input: Any, noise: Any) -> Any:
        return A @ (state - x) + B @ (input - u) + noise + x

    return step


def plant(
    point: OperatingPoint | None, disturbance: ExternalDisturbance, changes: Changes | None, function: Map | None
) -> Plant:
    """Return the plant, whose output follows set-points in spite of a disturbance."""
    limit = [[-1.0, 3.0]] if point is None else [[2.0, 6.0]]
    found = Plant(A, B, 0.02 * np.eye(2), C, [[0.05]], None, None, None, limit, function, operating_point=point)
    return follow(found, None, None if isinstance(changes, Timetable) else [5.5], [disturbance], changes)


@pytest.mark.parametrize("located", [False, True])
@pytest.mark.parametrize("changes", [None, RandomSteps(0.1, [[1.0]]), TABLE], ids=lambda one: type(one).__name__)
@pytest.mark.parametrize("name", few(DISTURBANCES, 1))
def test_a_linear_function_with_disturbances_is_the_linear_plant(
    name: str, changes: Changes | None, located: bool
) -> None:
    """The same decisions, states of plant and disturbance, and inputs."""
    point = OperatingPoint(X, U) if located else None
    step = step_at(X, U) if located else step_at(np.zeros(2), np.zeros(1))
    plants = [plant(point, DISTURBANCES[name], changes, function) for function in (None, step)]
    policies = [design.excess(one, COST, delta=0.05) for one in plants]
    paths = [simulate(close(*both), 150, seed=3) for both in zip(plants, policies, strict=True)]
    assert np.array_equal(paths[0].sends["actuator"], paths[1].sends["actuator"])
    assert paths[1].state == pytest.approx(paths[0].state, abs=1e-9)
    assert paths[1].input == pytest.approx(paths[0].input, abs=1e-9)
    assert policies[1].cost_all_time == policies[0].cost_all_time


def test_the_set_points_of_a_nonlinear_plant_are_those_of_the_timetable() -> None:
    """In the units of the plant, without rounding errors, and nodes make the same decisions as the loop."""
    leaking = plant(OperatingPoint(X, U), DISTURBANCES["constant"], TABLE, step_at(X, U))
    policy = design.excess(leaking, COST, delta=0.05)
    simulated, nodes = SimulatedPlant(close(leaking, policy), 2), taciturn.Nodes(policy)
    seen = list[float]()
    for _ in range(100):
        y = simulated.measurement
        seen.append(y[1])
        simulated.move(nodes.step(y[:1], reference=y[1:]).tolist())
    assert seen == [5.0] * 30 + [7.0] * 40 + [4.0] * 30
