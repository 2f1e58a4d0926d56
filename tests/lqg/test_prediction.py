"""What acting on a prediction costs, against polynomials, plain integrals and differences."""

from __future__ import annotations

import numpy as np
import pytest
from drawn import law
from hypothesis import assume
from hypothesis import strategies as st
from scipy.integrate import quad, quad_vec
from scipy.linalg import expm, solve_continuous_are

from taciturn._modes import radius
from taciturn.lqg.equation import accumulate
from taciturn.lqg.prediction import PredictionCost, prediction_cost
from taciturn.lqg.sampling import sample_prediction

SEEDS = st.integers(0, 2**32 - 1)
DOUBLE = ([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], np.eye(2), [[10.0]], np.zeros((2, 1)), np.diag([0.0, 2.5]))


def random_cost(seed: int) -> tuple[PredictionCost, tuple[np.ndarray, ...]]:
    """Return the prediction cost of a random plant of up to three states with a cross term, and its data."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 4)), int(rng.integers(1, 3))
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
    root = rng.normal(size=(n + m, n + m))
    joint, noise = root @ root.T + 0.1 * np.eye(n + m), rng.normal(size=(n, int(rng.integers(1, n + 1))))
    data = (A, B, joint[:n, :n], joint[n:, n:], joint[:n, n:], noise @ noise.T)
    return prediction_cost(*data), data


def test_the_double_integrator_has_the_polynomial_of_the_thesis() -> None:
    """g(h) = .208333h³ + 2.255326h² + 9.155694h and tr(PW) = 21.395904."""
    found = prediction_cost(*DOUBLE)
    assert found.base == pytest.approx(21.395904, abs=5e-7)
    assert found.L[0] == pytest.approx([-0.316228, -0.855836], abs=5e-7)
    for h in (1e-6, 0.05, 0.7, 2.0, 9.0):
        assert found.growth(h) == pytest.approx(0.208333 * h**3 + 2.255326 * h**2 + 9.155694 * h, rel=1e-6)
        assert found.periodic(h) == found.base + found.growth(h)
    assert found.initial_slope == pytest.approx(9.155694, abs=5e-7)


@law(3, 40, seed=SEEDS, length=st.floats(0.01, 1.5))
def test_spread_weight_and_growth_are_their_integrals(seed: int, length: float) -> None:
    """V, Γ and g by adaptive quadrature of what defines them; P and L by scipy's equation."""
    found, (A, B, Q, R, N, W) = random_cost(seed)
    P = solve_continuous_are(A, B, Q, R, s=N)
    L = -np.linalg.solve(R, B.T @ P + N.T)
    assert pytest.approx(L, rel=1e-7, abs=1e-9 * np.abs(L).max()) == found.L
    assert found.base == pytest.approx(np.trace(P @ W), rel=1e-7)
    S = found.L.T @ R @ found.L

    def spread(s: float) -> np.ndarray:
        return quad_vec(lambda r: expm(A * r) @ W @ expm(A.T * r), 0, s, epsrel=1e-11)[0]

    assert found.spread(length) == pytest.approx(spread(length), rel=1e-8, abs=1e-11 * np.abs(W).max())
    weight = quad_vec(lambda t: expm(A.T * t) @ S @ expm(A * t), 0, length, epsrel=1e-11)[0]
    assert found.weight(length) == pytest.approx(weight, rel=1e-8, abs=1e-11 * np.abs(S).max())
    mean = quad(lambda s: np.trace(S @ spread(s)), 0, length, epsrel=1e-8, limit=20)[0] / length
    assert found.growth(length) == pytest.approx(mean, rel=1e-6)


@law(2, 30, seed=SEEDS, length=st.floats(0.01, 0.5), size=st.sampled_from([0.03, 0.3, 1.0]))
def test_no_other_gain_costs_less_between_sends(seed: int, length: float, size: float) -> None:
    """Sampled with the model of its own gain: J_per(h) with L, and more with any other."""
    found, (A, B, Q, R, N, W) = random_cost(seed)
    D = size * np.random.default_rng(seed + 1).normal(size=found.L.shape)

    def sent_every_period(L: np.ndarray) -> float:
        one = sample_prediction(A, B, Q, R, N, W, L, length)
        F = one.A + one.B  # what is sent is the state
        assume(radius(F) < 0.999)
        stage = one.Q + one.R + one.N + one.N.T
        return (float(np.trace(stage @ accumulate(F, one.W))) + one.noise_cost) / length

    best = sent_every_period(found.L)
    assert best == pytest.approx(found.periodic(length), rel=1e-7)
    assert sent_every_period(found.L + D) > best


@law(2, 20, seed=SEEDS)
def test_the_growth_rises_from_zero_with_half_of_tr_sw(seed: int) -> None:
    """g is a mean of what only rises, and g(h)/h comes to ½ tr(SW) as h → 0."""
    found, (A, *_) = random_cost(seed)
    unit = 1 / (1 + np.abs(np.linalg.eigvals(A)).max())
    values = np.array([found.growth(h) for h in np.geomspace(1e-3, 2, 20) * unit])
    assert (np.diff(values) >= -1e-9 * values[1:]).all()
    near = [found.growth(h * unit) / (h * unit) for h in (2e-4, 1e-4)]
    assert 2 * near[1] - near[0] == pytest.approx(found.initial_slope, rel=1e-5)


@law(5, 60, seed=SEEDS, length=st.floats(0.05, 2.0))
def test_the_slope_in_the_rate_is_the_derivative_of_the_periodic_cost_and_the_curve_is_convex(seed, length) -> None:
    """δ* = −dV_p/dr; every chord of V_p lies above it."""
    found, _ = random_cost(seed)
    rate, step = 1 / length, 1e-5 / length
    slope = (found.periodic(1 / (rate - step)) - found.periodic(1 / (rate + step))) / (2 * step)
    assert found.slope_in_rate(length) == pytest.approx(slope, rel=1e-5, abs=1e-9 * found.base)
    rates = rate * np.array([0.5, 0.8, 1.0, 1.3, 2.0])
    costs = np.array([found.periodic(1 / r) for r in rates])
    chords = np.diff(costs) / np.diff(rates)
    assert (np.diff(chords) >= -1e-9 * np.abs(chords).max()).all()


@law(1, 15, seed=SEEDS, shortest=st.sampled_from([0.0, 0.3]))
def test_no_line_below_the_least_ratio_meets_the_growth(seed: int, shortest: float) -> None:
    """g(h) ≥ C h for the infimum C of g(h)/h, and it is attained where it is said to be."""
    found, _ = random_cost(seed)
    least, where = found.least_ratio(shortest, 2.0)
    assert shortest <= where <= 2.0
    for h in np.linspace(max(shortest, 0.01), 2.0, 60):
        assert found.growth(h) >= least * h * (1 - 1e-6)
    attained = found.initial_slope if where == 0 else found.growth(where) / where
    assert attained == pytest.approx(least, rel=1e-9)


@pytest.mark.evidence
def test_the_least_ratio_is_at_the_left_end_of_a_convex_growth_and_at_the_right_end_of_a_concave_one() -> None:
    """Growth is convex for integrators and unstable plants; for a stable plant it is not, and its ratio falls to 0."""
    for convex in (prediction_cost(*DOUBLE), prediction_cost([[0.5]], [[1.0]], [[1.0]], [[1.0]], [[0.0]], [[1.0]])):
        assert convex.least_ratio(0.3, 2.0)[1] == pytest.approx(0.3)
    stable = prediction_cost([[-1.0]], [[1.0]], [[1.0]], [[1.0]], [[0.0]], [[1.0]])
    assert stable.least_ratio(0.0, np.inf) == (0.0, np.inf)
    assert stable.least_ratio(0.0, 3.0) == (pytest.approx(stable.growth(3.0) / 3.0), 3.0)


@pytest.mark.evidence
def test_a_least_ratio_between_two_intervals_of_the_grid_is_found() -> None:
    """A plant whose ratio is least in the middle: on the grid alone it is 4e-4 above an interval between."""
    found, _ = random_cost(110014)
    least, where = found.least_ratio(0.0, 2.0)
    near = where * np.linspace(0.97, 1.03, 200)
    assert min(found.growth(h) / h for h in near) >= least * (1 - 1e-8)
