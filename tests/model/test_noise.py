"""Noise by its amplitude at inputs and outputs is the same noise as W and V, in every realisation of a plant."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import taciturn
from taciturn import ContinuousPlant, Cost, Jumps, Plant, ProblemError
from taciturn.model.noise import Noise

A, B, C = np.array([[0.9, 0.1], [0.0, 0.8]]), np.array([[0.5, 0.0], [1.0, 2.0]]), np.array([[1.0, 0.0]])
NOISE = Noise(input=[0.3, 0.5], output=[0.1])
W = [[0.0225, 0.045], [0.045, 1.09]]  # B diag(0.09, 0.25) B', by hand


def test_the_covariances_are_those_by_hand() -> None:
    """W per step or per second, V of a sample; with E, of its equation."""
    for plant in (Plant(A, B, C=C, noise=NOISE), ContinuousPlant(A - np.eye(2), B, C=C, noise=NOISE)):
        np.testing.assert_allclose(plant.W, W, rtol=1e-15)
        np.testing.assert_allclose(plant.V, [[0.01]], rtol=1e-15)
    heavy = Plant(2 * A, 2 * B, C=C, E=2 * np.eye(2), noise=NOISE)
    np.testing.assert_allclose(heavy.W, W, rtol=1e-15)
    alone = Plant(A, B, W, C, noise=Noise(output=[0.1]))
    np.testing.assert_array_equal(alone.W, W)
    assert ContinuousPlant(A, B, jumps=Jumps(1.0, W), C=C, noise=Noise(output=[0.1])).V[0, 0] == pytest.approx(0.01)


@pytest.mark.parametrize("dt", [0, 0.1])
def test_the_cost_does_not_depend_on_the_realisation(dt: float) -> None:
    """A transfer function has states that the tool chooses: with W = σ²I in them, the cost depends on the choice."""
    control = pytest.importorskip("control")
    function = control.tf([1.0, 0.4], [1.0, -0.3, 0.1], dt)
    first = control.ss(function)
    T = np.random.default_rng(7).standard_normal((2, 2)) + 2 * np.eye(2)
    other = control.ss(np.linalg.solve(T, first.A @ T), np.linalg.solve(T, first.B), first.C @ T, first.D, dt)
    period: dict[str, Any] = {} if dt else {"period": 0.1}

    def cost(system: Any, **noise: Any) -> float:
        plant = taciturn.from_control(system, V=[[0.01]], **noise)
        return taciturn.design.all_time(plant, Cost.of_variances(plant.C, [1.0], [1.0]), **period).cost_all_time

    amplitude = {"noise": Noise(input=[0.3])}
    assert cost(function, **amplitude) == pytest.approx(cost(other, **amplitude), rel=1e-9)
    assert cost(function, W=np.eye(2)) != pytest.approx(cost(other, W=np.eye(2)), rel=0.01)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "W is missing; expected the process-noise covariance per step .zeros for none., or noise.input"),
        ({"noise": Noise(output=[0.1])}, "W is missing"),
        ({"noise": Noise(input=[0.1])}, r"noise.input has shape .1,.; expected the shape .2,. = .inputs,."),
        ({"noise": Noise(input=[0.1, 0.2], output=[0.1, 0.1])}, "noise.output has shape .2,.; expected the shape .1,."),
        ({"W": W, "noise": Noise(input=[0.1, 0.2])}, "W and noise.input are both given; expected only one of them"),
        ({"V": [[1.0]], "noise": NOISE}, "V and noise.output are both given; expected only one of them"),
        ({"noise": [0.1, 0.2]}, "noise is"),
    ],
)
def test_noise_that_does_not_fit_is_refused(given: dict[str, Any], message: str) -> None:
    """By name."""
    with pytest.raises(ProblemError, match=message):
        Plant(A, B, C=C, **given)


def test_amplitudes_are_standard_deviations() -> None:
    """At least zero, and given; jumps are noise of their own."""
    with pytest.raises(ProblemError, match=r"noise.input.1. is -0.1; expected a standard deviation, at least 0"):
        Noise(input=[0.1, -0.1])
    with pytest.raises(ProblemError, match=r"noise states no amplitude; expected noise.input, noise.output or both"):
        Noise()
    with pytest.raises(ProblemError, match=r"noise.input and jumps are both given; expected one kind of noise"):
        ContinuousPlant(A, B, jumps=Jumps(1.0, W), C=C, noise=NOISE)


def test_a_problem_file_states_amplitudes_that_settings_change() -> None:
    """Of the plant and of the simulated plant; a changed problem keeps them."""
    lqg = taciturn.load("two-mass-lqg")
    plant = {name: value for name, value in lqg.source["plant"].items() if len(name) == 1 and name not in "WV"}
    plant["dt"] = 0.1  # type: ignore[index]
    outputs = len(lqg.plant.C)
    noise = {"input": [0.3], "output": [0.01] * outputs}
    stated = lqg.changed({"plant": {**plant, "noise": noise, "actual": {**plant, "noise": {**noise, "input": [0.6]}}}})
    assert stated.actual is not None
    np.testing.assert_allclose(stated.plant.W, 0.09 * lqg.plant.B @ lqg.plant.B.T, atol=1e-18)
    np.testing.assert_allclose(stated.actual.W, 4 * stated.plant.W, atol=1e-18)
    assert stated.plant.V[0, 0] == pytest.approx(1e-4)
    louder = stated.changed({"plant.noise.input": 0.6, "plant.actual": None})
    np.testing.assert_array_equal(louder.plant.W, stated.actual.W)
    again = louder.changed({"cost.R": [[2.0]]}).changed({"plant.dt": 0.1})
    np.testing.assert_array_equal(again.plant.W, louder.plant.W)
    with pytest.raises(ProblemError, match=r"W and noise\.input are both given"):
        lqg.changed({"plant.noise.input": 0.6})
    with pytest.raises(ProblemError, match=r"plant.W is missing; expected .*, or plant.noise.input"):
        stated.changed({"plant.noise.input": None})
