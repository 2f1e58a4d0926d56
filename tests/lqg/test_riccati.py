"""Regulators: optimality, limits, refusals."""

# ruff: noqa: SIM300 - ruff takes matrices, which carry their paper symbols, for constants
from __future__ import annotations

import numpy as np
import pytest
from drawn import law
from hypothesis import assume
from hypothesis import strategies as st

from taciturn._modes import radius
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.lyapunov import accumulate
from taciturn.lqg.riccati import regulate, regulate_continuous, regulate_discounted, regulate_finite

seeds = st.integers(0, 2**32 - 1)


@law(8, 100, seed=seeds)
def test_the_regulator_solves_the_riccati_equation_and_stabilises(draw, seed):
    """K, L and H satisfy their equations to rounding and A + BL is stable."""
    c = draw(seed)
    found = regulate(c.A, c.B, c.Q, c.R, c.N)
    K, L, H = found.K, found.L, found.H
    assert H == pytest.approx(c.R + c.B.T @ K @ c.B, rel=1e-12)
    assert -H @ L == pytest.approx(c.B.T @ K @ c.A + c.N.T, rel=1e-8, abs=1e-10 * np.abs(H).max())
    assert c.Q + c.A.T @ K @ c.A - L.T @ H @ L == pytest.approx(K, rel=1e-8, abs=1e-10 * np.abs(K).max())
    assert radius(c.A + c.B @ L) < 1


@law(8, 100, seed=seeds)
def test_any_other_gain_costs_the_completed_square(draw, seed):
    """The cost matrix X of a gain L + D is K plus the sum of D'HD along its own loop."""
    c = draw(seed)
    found = regulate(c.A, c.B, c.Q, c.R, c.N)
    D = 0.02 * c.rng.normal(size=found.L.shape)
    G = found.L + D
    loop = c.A + c.B @ G
    assume(radius(loop) < 0.999)
    X = accumulate(loop.T, c.Q + c.N @ G + G.T @ c.N.T + G.T @ c.R @ G)
    square = accumulate(loop.T, D.T @ found.H @ D)
    assert X == pytest.approx(found.K + square, rel=1e-8, abs=1e-9 * np.abs(X).max())


@law(8, 100, seed=seeds)
def test_a_long_horizon_approaches_the_infinite_one(draw, seed):
    """K_0 and L_0 of 150 steps agree with the steady gains as far as the loop has settled."""
    c = draw(seed)
    found = regulate(c.A, c.B, c.Q, c.R, c.N)
    assume(radius(c.A + c.B @ found.L) < 0.85)
    finite = regulate_finite(c.A, c.B, c.Q, c.R, c.N, c.Q, 150)
    assert finite.K[0] == pytest.approx(found.K, rel=1e-7, abs=1e-8 * np.abs(found.K).max())
    assert finite.L[0] == pytest.approx(found.L, rel=1e-7, abs=1e-7 * np.abs(found.L).max())


@law(8, 100, seed=seeds)
def test_the_finite_horizon_agrees_with_one_large_least_squares_problem(draw, seed):
    """x_0'K_0x_0 is the minimum of the quadratic form in all inputs of four steps at once."""
    c = draw(seed)
    n, m = c.B.shape
    steps = 4
    found = regulate_finite(c.A, c.B, c.Q, c.R, c.N, c.W, steps)
    state = np.hstack([np.eye(n), np.zeros((n, steps * m))])  # x_k as a map of (x_0, u_0, …)
    form = np.zeros((n + steps * m,) * 2)
    for k in range(steps):
        u = np.zeros((m, n + steps * m))
        u[:, n + k * m : n + (k + 1) * m] = np.eye(m)
        form += state.T @ c.Q @ state + u.T @ c.R @ u + state.T @ c.N @ u + u.T @ c.N.T @ state
        state = c.A @ state + c.B @ u
    form += state.T @ c.W @ state
    least = form[:n, :n] - form[:n, n:] @ np.linalg.solve(form[n:, n:], form[n:, :n])
    assert found.K[0] == pytest.approx(least, rel=1e-6, abs=1e-8 * np.abs(form).max())
    assert found.L.shape == (steps, m, n)
    assert found.H[-1] == pytest.approx(c.R + c.B.T @ c.W @ c.B)


@law(8, 100, seed=seeds, discount=st.floats(0.3, 1.0))
def test_the_discounted_regulator_satisfies_the_formulas_of_the_thesis(draw, seed, discount):
    """L = −(R+αB'KB)^{-1}(αB'KA+N') and K = Q + αA'KA − P, written out."""
    c = draw(seed)
    found = regulate_discounted(c.A, c.B, c.Q, c.R, c.N, discount)
    K = found.K
    cross, H = discount * c.A.T @ K @ c.B + c.N, c.R + discount * c.B.T @ K @ c.B
    P = cross @ np.linalg.solve(H, cross.T)
    size = np.abs(P).max()
    assert found.L == pytest.approx(-np.linalg.solve(H, cross.T), rel=1e-7, abs=1e-8)
    assert c.Q + discount * c.A.T @ K @ c.A - P == pytest.approx(K, rel=1e-8, abs=1e-9 * size)
    assert found.H == pytest.approx(H)


@law(8, 100, seed=seeds)
def test_the_continuous_regulator_solves_its_riccati_equation_and_stabilises(draw, seed):
    """0 = A'K + KA + Q − L'RL and A + BL is Hurwitz."""
    c = draw(seed)
    found = regulate_continuous(c.A, c.B, c.Q, c.R, c.N)
    K, L = found.K, found.L
    terms = np.abs(c.A.T @ K).max() + np.abs(c.Q).max() + np.abs(L.T @ c.R @ L).max()
    assert c.A.T @ K + K @ c.A + c.Q - L.T @ c.R @ L == pytest.approx(0, abs=1e-9 * terms)
    assert c.R @ L == pytest.approx(-(c.B.T @ K + c.N.T), rel=1e-8, abs=1e-10 * np.abs(K).max())
    assert np.linalg.eigvals(c.A + c.B @ L).real.max() < 0


def test_the_double_integrator_of_chapter_four_has_the_printed_gain_and_cost():
    """L = [−.316228, −.855836] and tr(PλW) = 21.395904."""
    found = regulate_continuous([[0, 1], [0, 0]], [[0], [1]], np.eye(2), [[10]], np.zeros((2, 1)))
    assert found.L == pytest.approx(np.array([[-0.316228, -0.855836]]), abs=5e-7)
    assert np.trace(found.K @ np.diag([0, 2.5])) == pytest.approx(21.395904, abs=5e-7)


def test_free_inputs_are_allowed_as_long_as_they_act_on_a_priced_state():
    """R = 0 gives dead-beat control of a priced scalar: L = −A/B and K = Q."""
    found = regulate([[2.0]], [[1.0]], [[3.0]], [[0.0]], [[0.0]])
    assert found.L[0, 0] == pytest.approx(-2)
    assert found.K[0, 0] == pytest.approx(3)


def test_an_unpriced_unstable_mode_is_still_stabilised():
    """With Q = 0 the cheapest stabilising gain mirrors the mode into the circle: A + BL = 1/A."""
    found = regulate([[2.0]], [[1.0]], [[0.0]], [[1.0]], [[0.0]])
    assert 2 + found.L[0, 0] == pytest.approx(0.5)


def test_results_are_read_only():
    """Nobody changes a gain behind the back of who computed it."""
    found = regulate([[2.0]], [[1.0]], [[1.0]], [[1.0]], [[0.0]])
    with pytest.raises(ValueError, match="read-only"):
        found.L[0, 0] = 0


def test_an_unstable_mode_beyond_reach_is_named():
    """Discrete, discounted and continuous regulators refuse it with its eigenvalue."""
    A, B, Q, R, N = np.diag([0.5, 1.25]), [[1.0], [0.0]], np.eye(2), [[1.0]], np.zeros((2, 1))
    for attempt in (
        lambda: regulate(A, B, Q, R, N),
        lambda: regulate_continuous(A, B, Q, R, N),
        lambda: regulate_discounted(A, B, Q, R, N, 0.9),
    ):
        with pytest.raises(UnstableError, match=r"A has the eigenvalue 1\.25, which is uncontrollable through B"):
            attempt()


def test_discounting_excuses_a_slowly_growing_mode_beyond_reach():
    """With √α·|λ| < 1 the discounted cost is finite."""
    A, B = np.diag([0.5, 1.25]), [[1.0], [0.0]]
    found = regulate_discounted(A, B, np.eye(2), [[1.0]], np.zeros((2, 1)), 0.5)
    assert found.K[1, 1] == pytest.approx(1 / (1 - 0.5 * 1.25**2))


def test_a_mode_on_the_circle_that_costs_nothing_is_named():
    """No optimal gain stabilises an integrator without weight; the message asks for one."""
    with pytest.raises(UnstableError, match=r"the mode 1 .*does not affect the cost.*give Q a small positive weight"):
        regulate([[1.0]], [[1.0]], [[0.0]], [[1.0]], [[0.0]])
    with pytest.raises(UnstableError, match="the mode 0 on the imaginary axis does not affect the cost"):
        regulate_continuous([[0.0]], [[1.0]], [[0.0]], [[1.0]], [[0.0]])


def test_an_input_direction_without_price_is_refused():
    """Two copies of one actuator without R leave H singular."""
    with pytest.raises(ProblemError, match="not positive definite"):
        regulate([[2.0]], [[1.0, 1.0]], [[1.0]], np.zeros((2, 2)), np.zeros((1, 2)))
    with pytest.raises(ProblemError, match="not positive definite at step 1"):
        regulate_finite([[2.0]], [[1.0, 1.0]], [[1.0]], np.zeros((2, 2)), np.zeros((1, 2)), [[1.0]], 2)


def test_a_cost_that_overflows_is_refused():
    """A horizon over which an unreachable mode grows beyond all numbers gives a sentence, not inf."""
    with pytest.raises(UnstableError, match="overflows"):
        regulate_finite([[1e3]], [[0.0]], [[1.0]], [[1.0]], [[0.0]], [[1.0]], 200)


def test_a_transposed_input_matrix_is_refused_with_a_hint():
    """The message says what came, what was expected, and guesses the slip."""
    with pytest.raises(ProblemError, match="transpose"):
        regulate(np.eye(2), [[1.0, 0.0]], np.eye(2), [[1.0]], np.zeros((2, 1)))


@pytest.mark.parametrize("discount", [0.0, 1.5])
def test_a_discount_outside_its_range_is_refused(discount):
    """0 < α ≤ 1."""
    with pytest.raises(ProblemError, match="discount"):
        regulate_discounted([[0.5]], [[1.0]], [[1.0]], [[1.0]], [[0.0]], discount)


@law(8, 100, seed=seeds)
def test_states_that_cost_nothing_change_no_cost(draw, seed):
    """Stable states that move no other: K, L and error have zeros there, and are otherwise as before."""
    c = draw(seed)
    n, more = len(c.A), 2
    one = regulate(c.A, c.B, c.Q, c.R, c.N)
    A = np.zeros((n + more, n + more))
    A[:n, :n], A[n:, :n], A[n:, n:] = c.A, c.rng.normal(size=(more, n)), np.diag([0.0, 0.9])
    B = np.vstack([c.B, c.rng.normal(size=(more, c.B.shape[1]))])
    Q = np.zeros_like(A)
    Q[:n, :n] = c.Q
    found = regulate(A, B, Q, c.R, np.vstack([c.N, np.zeros((more, c.B.shape[1]))]))
    assert not found.K[n:].any()
    assert not found.L[:, n:].any()
    assert not found.error[n:].any()
    assert found.K[:n, :n] == pytest.approx(one.K, rel=1e-9, abs=1e-12 * np.abs(one.K).max())
    assert found.L[:, :n] == pytest.approx(one.L, rel=1e-8, abs=1e-10 * np.abs(one.L).max())
