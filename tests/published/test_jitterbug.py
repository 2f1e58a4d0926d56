"""Jitterbug and its spin-off JitterTime: the LQG control of a DC motor (cervin2019, jittertime).

The example of JitterTime's ``lqg_dcmotor``: P(s) = 1/(s(s + 1)), input noise of intensity 1, measurement noise of
intensity 0.01. It prints 1.4583 for the continuous design, and draws the costs of two sampled ones relative to it in
``dcmotor.eps``. Number and drawing are those of Q = I and R = 1; the script's weights are others today.
"""

from __future__ import annotations

import numpy as np
import pytest

from taciturn import ContinuousPlant, Cost, Plant, design
from taciturn.lqg.riccati import Regulator, regulate, regulate_continuous
from taciturn.lqg.sampling import sample

A, B, C = np.array([[0.0, 1.0], [0.0, -1.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
W, V, NONE = B @ B.T, np.array([[0.01]]), np.zeros((2, 1))
MOTOR = Cost(np.eye(2), [[1.0]])
PUBLISHED = 1.4583

# The drawing: points' heights for the periods 0.001, 0.025, 0.05, …, 0.5; its axis has 1 at 323, 1.05 at 263.8.
PERIODS = (0.001, *(0.025 * k for k in range(1, 21)))
HELD = (
    322.594, 312.724, 302.196, 291.414, 280.379, 269.091, 257.55, 245.755, 233.707, 221.405, 208.849, 196.039, 182.975,
    169.657, 156.085, 142.26, 128.18, 113.847, 99.262, 84.424, 69.336,
)  # fmt: skip
PREDICTED = (
    322.594, 312.851, 302.702, 292.553, 282.404, 272.255, 262.105, 251.956, 241.807, 231.658, 221.509, 211.36, 201.211,
    191.062, 180.913, 170.764, 160.614, 150.465, 140.316, 130.167, 120.018,
)  # fmt: skip
UNIT = 0.05 / (323 - 263.8)  # of the cost, per unit of height
DIGIT = 1e-3 * UNIT  # heights have three decimals


def continuous() -> tuple[Regulator, Regulator, float]:
    """Return the regulator, the filter as its dual, and the cost tr(KW) + tr(L'RLΣ) of the continuous design."""
    regulator = regulate_continuous(A, B, MOTOR.Q, MOTOR.R, NONE)
    dual = regulate_continuous(A.T, C.T, W, V, NONE)
    cost = np.trace(regulator.K @ W) + np.trace(regulator.L.T @ MOTOR.R @ regulator.L @ dual.K)
    return regulator, dual, float(cost)


def averaged(period: float) -> float:
    """Return the least cost of an input that is held, from the integrals of the noisy output over the periods."""
    n, m = B.shape
    longer = np.zeros((n + 1, n + 1))
    longer[:n, :n], longer[n, :n] = A, C[0]
    noise, weight = np.diag([0.0, 1.0, V[0, 0]]), np.diag([1.0, 1.0, 0.0])
    found = sample(longer, np.vstack([B, np.zeros((1, m))]), weight, MOTOR.R, np.zeros((n + 1, m)), noise, period)
    emptied = found.A.copy()
    emptied[:, n] = 0  # the integral starts anew at every sample
    plant = Plant(emptied, found.B, found.W, C=[[0.0, 0.0, 1.0]], V=[[0.0]])
    policy = design.all_time(plant, Cost(found.Q, found.R, N=found.N))
    assert policy.cost_all_time is not None
    return (policy.cost_all_time + found.noise_cost) / period


def test_the_continuous_design_of_the_dc_motor_costs_what_jitterbug_says() -> None:
    """1.4583, which is 1 + √21/10."""
    cost = continuous()[2]
    assert cost == pytest.approx(PUBLISHED, abs=5e-5)
    assert cost == pytest.approx(1 + np.sqrt(21) / 10, rel=1e-12)


def test_sampling_ever_faster_costs_what_jitterbug_says_of_the_continuous_design() -> None:
    """The same number as the limit of sampled optima with their inter-sample cost; the excess is linear in h."""
    slow, fast = averaged(2e-3), averaged(1e-3)
    assert 2 * fast - slow == pytest.approx(PUBLISHED, abs=5e-5)
    assert fast > PUBLISHED


def test_a_held_input_costs_what_jitterbug_draws() -> None:
    """ZOH-sampled LQG control with reset sampling: every point, to one unit of its last digit."""
    whole = continuous()[2]
    for period, height in zip(PERIODS, HELD, strict=True):
        assert averaged(period) / whole == pytest.approx(1 + UNIT * (323 - height), abs=DIGIT)


def test_an_actuator_that_predicts_costs_what_jitterbug_draws() -> None:
    """Mirkin's sampled-data controller: the continuous filter's estimate is sent once a period to a model.

    The estimate is a plant whose noise is the innovation's, of intensity ΣC'V^{-1}CΣ; the error adds tr(QΣ).
    """
    _, dual, whole = continuous()
    estimate = ContinuousPlant(A, B, dual.L.T @ V @ dual.L)
    for period, height in zip(PERIODS, PREDICTED, strict=True):
        policy = design.periodic(estimate, MOTOR, period=period, actuation="model")
        assert policy.theory.closed_form is not None
        relative = (policy.theory.closed_form.cost + np.trace(MOTOR.Q @ dual.K)) / whole
        assert relative == pytest.approx(1 + UNIT * (323 - height), abs=DIGIT)


def test_the_gain_of_an_integrator_is_the_one_of_jitterbug() -> None:
    """JitterTime's first example has u = −(3 + √3)/(2 + √3) x/h as its minimum-variance controller."""
    for period in (0.1, 1.0, 3.0):
        found = sample([[0.0]], [[1.0]], [[1.0]], [[0.0]], [[0.0]], [[1.0]], period)
        gain = regulate(found.A, found.B, found.Q, found.R, found.N).L
        assert gain == pytest.approx(-(3 + np.sqrt(3)) / (2 + np.sqrt(3)) / period, rel=1e-12)
