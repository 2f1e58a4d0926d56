"""Optimal periodic control: stable and unstable plants, discrete and continuous, exact against simulated."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from taciturn import ContinuousPlant, Cost, close, design, load
from taciturn.simulation.average import average, plain_average

STABLE = ContinuousPlant([[-1.0, 1.0], [0.0, -0.5]], [[0.0], [1.0]], np.diag([0.1, 0.4]), C=[[1.0, 0.0]], V=[[0.01]])
UNSTABLE = ContinuousPlant([[0.0, 1.0], [2.0, 0.3]], [[0.0], [1.0]], np.diag([0.0, 0.4]), C=[[1.0, 0.0]], V=[[0.01]])
SEEN = ContinuousPlant([[0.0, 1.0], [2.0, 0.3]], [[0.0], [1.0]], np.diag([0.1, 0.4]))
COST = Cost([[1.0, 0.2], [0.2, 0.5]], [[0.2]], [[0.1], [0.05]])


@pytest.mark.parametrize("plant", [STABLE, UNSTABLE, SEEN], ids=["stable", "unstable", "full state"])
def test_the_curve_rises_with_the_period(plant: ContinuousPlant) -> None:
    """What can be done every 2h can be done every h."""
    costs = []
    for period in (0.05, 0.1, 0.2, 0.4, 0.8, 1.6):
        form = design.periodic(plant, COST, period=period).theory.closed_form
        assert form is not None
        assert form.rates == {"actuator": 1.0}
        costs.append(form.cost)
    assert np.diff(costs).min() > 0
    if plant is STABLE:
        open_loop = design.periodic(plant, COST, period=60.0).theory.closed_form
        A, W = plant.A, plant.W
        free = np.trace(
            COST.Q @ np.linalg.solve(np.kron(A, np.eye(2)) + np.kron(np.eye(2), A), -W.ravel()).reshape(2, 2)
        )
        assert open_loop is not None
        assert open_loop.cost == pytest.approx(free, rel=0.02)  # without control, nearly
    else:
        assert costs[-1] > 3 * costs[0]


def test_a_clock_that_does_not_divide_the_windows_settles() -> None:
    """Every third step: the simulation of a periodic policy reaches its precision."""
    problem = load("two-mass-lqg")
    loop = close(problem.plant, design.periodic(problem.plant, problem.cost, every=3))
    found = average(loop, plain_average(loop), standard_error=5e-3)
    assert found.reached
    assert found.burn_in <= 2000  # twelve time constants, not windows dropped one after the other
    assert abs(found.rates["actuator"].value - 1 / 3) < 1e-3


@pytest.mark.parametrize("plant", [STABLE, UNSTABLE], ids=["stable", "unstable"])
@pytest.mark.parametrize("period", [0.1, 0.7])
def test_the_closed_form_is_what_is_simulated(plant: ContinuousPlant, period: float) -> None:
    """Costs per second, the inter-sample noise cost included."""
    policy = design.periodic(plant, COST, period=period)
    loop = close(plant, policy, cost=COST)
    found = average(loop, plain_average(loop), seed=4, steps=20_000_000)
    assert policy.theory.closed_form is not None
    assert abs(found.cost.value - policy.theory.closed_form.cost) <= 4 * found.cost.standard_error


def test_a_continuous_prediction_costs_what_the_formula_says() -> None:
    """V_p(r) of the double integrator, by the closed form and by simulation; the sensor's link is scheduled."""
    plant = ContinuousPlant([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], np.diag([0.0, 2.5]))
    cost = Cost(np.eye(2), [[10.0]])
    for rate in (0.5, 1.0, 4.0):
        policy = design.periodic(plant, cost, period=1 / rate, actuation="model")
        assert policy.theory.closed_form is not None
        assert policy.theory.closed_form.cost == pytest.approx(
            21.395904 + 9.155694 / rate + 2.255326 / rate**2 + 0.208333 / rate**3, abs=2e-5
        )
        loop = close(plant, policy, cost=cost)
        found = average(loop, plain_average(loop), seed=5, steps=10_000_000)
        assert abs(found.cost.value - policy.theory.closed_form.cost) <= 4 * found.cost.standard_error
        assert found.rates["sensor"].value == rate
        assert found.rate_unit == "second"


@pytest.mark.evidence
def test_brute_force_integration_of_the_noisy_continuous_loop() -> None:
    """Euler–Maruyama of the plant with the sampled policy in the loop, 200 steps a step, against the exact problem."""
    period, parts, paths, ticks, burn = 0.4, 200, 2000, 60, 15
    policy = design.periodic(SEEN, COST, period=period)
    (L,) = (s.branches[0]["estimate"] for s in policy.steps if getattr(s, "signal", "") == "command")
    draws = np.random.default_rng(6)
    step = period / parts
    root = np.linalg.cholesky(SEEN.W * step)
    move = expm(SEEN.A * step)  # exact drift; noise and cost by small steps
    push = np.linalg.solve(SEEN.A, move - np.eye(2)) @ SEEN.B
    x = np.zeros((2, paths))
    cost = np.zeros(paths)
    for tick in range(ticks):
        u = L @ x
        for _ in range(parts):
            if tick >= burn:
                cost += step * (
                    np.einsum("ip,ij,jp->p", x, COST.Q, x) + COST.R[0, 0] * u[0] ** 2 + 2 * (x.T @ COST.N)[:, 0] * u[0]
                )
            x = move @ x + push @ u + root @ draws.standard_normal((2, paths))
    cost /= (ticks - burn) * period
    assert policy.theory.closed_form is not None
    error = cost.std(ddof=1) / np.sqrt(paths)
    bias = 0.006 * policy.theory.closed_form.cost  # left end points of 200 parts: about half of 1/200
    assert error < 0.01 * policy.theory.closed_form.cost
    assert abs(cost.mean() - policy.theory.closed_form.cost) <= 4 * error + bias
