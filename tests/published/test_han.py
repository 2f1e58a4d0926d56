"""Han and others: a sensor that keeps silent with the probability exp(−½ y'Yy) (han2015)."""

from __future__ import annotations

import numpy as np
import pytest

from taciturn import Cost, Plant, average, close, design
from taciturn.lqg.equation import stationary
from taciturn.lqg.kalman import steady_filter
from taciturn.model.policy import Policy
from taciturn.model.steps import Assign, Decide, Draw, Received, Send
from taciturn.model.theory import Theory
from taciturn.model.trigger import Form, Trigger


def published(covariance: np.ndarray, weight: np.ndarray) -> float:
    """Return 1 − det(I + ΠY)^(−1/2)."""
    return 1 - float(np.linalg.det(np.eye(len(covariance)) + covariance @ weight)) ** -0.5


def open_loop(plant: Plant, weight: np.ndarray) -> Policy:
    """Return the sensor that draws whether to send its measurement, by that measurement alone; the input stays zero."""
    p, m = plant.outputs, plant.inputs
    rule = Trigger({"silent": Form(("y",), weight / 2), "send": Form(plus={"luck": 1.0})})
    return Policy(
        kind="open-loop stochastic schedule",
        steps=(
            Draw("sensor", "luck"),
            Decide("sensor", "query", rule),
            Send("sensor", "sensor", ("y",), "query"),
            Assign("controller", "heard", ({"heard": 0 * np.eye(p)}, {"y": np.eye(p)}), Received("sensor")),
            Assign("actuator", "input", {"heard": np.zeros((m, p))}),
        ),
        model=plant,
        theory=Theory(cost=Cost(np.eye(plant.states), np.eye(m))),
        sites=(frozenset({"controller", "actuator"}),),
    )


@pytest.mark.parametrize("scale", [0.1, 1.0])
@pytest.mark.parametrize("steps", [1_000_000, pytest.param(1_000_000_000, marks=pytest.mark.evidence)])
def test_the_rate_of_the_open_loop_schedule_is_the_published_one(scale: float, steps: int) -> None:
    """1 − det(I + ΠY)^(−1/2), Π = CΣC' + V the stationary covariance of y, whatever its correlation in time."""
    A, C, V = np.array([[0.8, 1.0], [0.0, 0.95]]), np.array([[1.0, 0.0], [0.5, 1.0]]), np.diag([1.0, 0.5])
    plant = Plant(A, [[0.0], [1.0]], 0.1 * np.eye(2), C=C, V=V)
    weight = scale * np.array([[0.5, 0.1], [0.1, 0.3]])
    found = average(close(plant, open_loop(plant, weight)), steps=steps).rates["sensor"]
    expected = published(C @ stationary(A, plant.W) @ C.T + V, weight)
    assert abs(found.value - expected) <= 4 * found.standard_error
    assert found.standard_error < 3e-3


def test_a_plant_without_memory_is_scheduled_at_the_published_rate() -> None:
    """A = 0: what the stochastic trigger weighs is drawn anew at every step, so that its closed form is the same."""
    W, weight = np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([[0.7, 0.2], [0.2, 0.4]])
    C, V = np.array([[1.0, 0.3]]), np.array([[0.5]])
    plant = Plant(np.zeros((2, 2)), np.eye(2), W, C=C, V=V)
    policy = design.stochastic(plant, Cost(np.eye(2), np.eye(2)), weight=weight, actuation="model")
    assert policy.theory.closed_form is not None
    told = W - steady_filter(plant.A, C, W, V).posterior  # covariance of the estimate
    assert policy.theory.closed_form.rates["actuator"] == pytest.approx(published(told, weight), rel=1e-12)
