"""Chapter 5 of the thesis: consistent periodic event-triggered control of a double integrator."""

from __future__ import annotations

import numpy as np
import pytest
from drawn import rows

import taciturn
from taciturn import ContinuousPlant, Cost
from taciturn.analyse.renewal import solve_renewal

A, B, W = [[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], np.diag([0.0, 2.5])
COST = Cost(np.eye(2), [[10.0]])
# rate of the checks, δ at its bound, rate of sending, cost: Wiener noise, without Monte Carlo
WIENER = [
    (0.5, 82.708, 0.28283645, 56.1351962),
    (1.0, 14.29135, 0.53982844, 35.1001509),
    (2.0, 2.891818, 1.04214824, 27.4372094),
    (4.0, 0.6451512, 2.03778693, 24.2270133),
    (10.0, 0.0961301, 5.01547188, 22.4845369),
    (20.0, 0.0234570, 9.97478298, 21.9330583),
]
GOLDEN = [  # τ, sends per check, cost
    (0.1, 0.50154718815, 22.48453691579),
    (0.2, 0.50689726308, 23.63130472075),
    (0.5, 0.52107412179, 27.43720939010),
    (1.0, 0.53982843573, 35.10015091224),
]
JUMPS = [
    (0.5, 0.2768078, 56.249621),
    (1.0, 0.5144399, 35.161147),
    (2.0, 0.9347559, 27.444051),
    (4.0, 1.5862694, 24.191170),
    (10.0, 2.6253108, 22.438081),
    (20.0, 3.3206635, 21.897809),
]


def wiener(period: float) -> taciturn.Loop:
    """Return the loop of the thesis under Wiener noise of the same intensity."""
    plant = ContinuousPlant(A, B, W)
    return taciturn.close(plant, taciturn.design.consistent(plant, COST, period=period))


@pytest.mark.parametrize(("checks", "delta", "rate", "cost"), WIENER)
def test_the_wiener_rows_without_simulation(checks: float, delta: float, rate: float, cost: float) -> None:
    """Every printed digit of δ, rate and cost."""
    loop = wiener(1 / checks)
    (decision,) = loop.policy.decisions.values()
    assert decision.options["send"].constant == pytest.approx(delta, rel=6e-6)
    found = solve_renewal(loop)
    assert found.rate * checks == pytest.approx(rate, abs=0.51e-8)
    assert loop.policy.theory.identity.constant + found.excess == pytest.approx(cost, abs=0.51e-7)


@pytest.mark.parametrize(("period", "rate", "cost"), GOLDEN)
def test_eleven_digits(period: float, rate: float, cost: float) -> None:
    """Far below the error that is claimed."""
    loop = wiener(period)
    found = solve_renewal(loop)
    assert found.rate == pytest.approx(rate, abs=1e-11)
    assert loop.policy.theory.identity.constant + found.excess == pytest.approx(cost, abs=3e-11)
    assert found.rate_error < 1e-8


@pytest.mark.parametrize(("checks", "rate", "cost"), rows(JUMPS, quick=1, start=4))
def test_the_rows_of_poisson_jumps(checks: float, rate: float, cost: float) -> None:
    """By simulation, within four standard errors."""
    problem = taciturn.load("double-integrator").changed({"period": 1 / checks})
    found = taciturn.evaluate(problem, method="simulation", standard_error=1e-3, seed=int(checks))
    assert abs(found.cost.value - cost) <= 4 * found.cost.standard_error
    assert abs(found.rates["sensor"].value - rate) <= 4 * found.rates["sensor"].standard_error
    assert found.mean_interval.value == pytest.approx(1 / found.rates["sensor"].value, rel=1e-12)


def test_the_cost_of_periodic_control_is_the_polynomial() -> None:
    """V_p(r) = 21.3959 + 9.1557/r + 2.2553/r² + .2083/r³, and a policy lies between it at both of its rates."""
    found = taciturn.evaluate(taciturn.load("double-integrator"), method="simulation", steps=400_000)
    rate = found.rates["sensor"].value
    polynomial = 21.395904 + 9.155694 / rate + 2.255326 / rate**2 + 0.208333 / rate**3
    assert found.cost_periodic_same_rate == pytest.approx(polynomial, rel=1e-6)
    assert found.cost_all_time < found.cost.value < found.cost_bound_at_rate < found.cost_periodic_same_rate
