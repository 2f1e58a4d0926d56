"""Regulators: optimality, limits, refusals."""

# ruff: noqa: SIM300 - ruff takes matrices, which carry their paper symbols, for constants
from __future__ import annotations

import numpy as np
import pytest
from drawn import law
from hypothesis import assume
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are

from taciturn._modes import radius
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.equation import accumulate
from taciturn.lqg.riccati import regulate, regulate_continuous, regulate_finite

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
    found = regulate(c.A, c.B, c.Q, c.R, c.N, discount)
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
        lambda: regulate(A, B, Q, R, N, 0.9),
    ):
        with pytest.raises(UnstableError, match=r"A has the eigenvalue 1\.25, which is uncontrollable through B"):
            attempt()


def test_discounting_excuses_a_slowly_growing_mode_beyond_reach():
    """With √α·|λ| < 1 the discounted cost is finite."""
    A, B = np.diag([0.5, 1.25]), [[1.0], [0.0]]
    found = regulate(A, B, np.eye(2), [[1.0]], np.zeros((2, 1)), 0.5)
    assert found.K[1, 1] == pytest.approx(1 / (1 - 0.5 * 1.25**2))


def test_a_mode_on_the_circle_that_costs_nothing_is_named():
    """No optimal gain stabilises an integrator without weight; the message asks for one."""
    with pytest.raises(
        UnstableError,
        match=r"the mode 1 .*does not affect the cost.*expected a small positive weight in Q on this mode",
    ):
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
        regulate([[0.5]], [[1.0]], [[1.0]], [[1.0]], [[0.0]], discount)


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


def zeroed(*zeros):
    """Return a chain of delays whose weight is the square of an output with these zeros, and whose input costs nothing.

    The output is Σ c_i x_i with the coefficients c of the polynomial of the zeros.
    """
    c = np.real(np.poly(zeros))[::-1]
    n = len(c)
    A = np.diag(np.ones(n - 1), 1)
    A[-1] = np.arange(1, n + 1) / 4
    return A, np.eye(n)[:, -1:], np.outer(c, c), np.zeros((1, 1)), np.zeros((n, 1))


def test_an_input_that_costs_nothing_removes_the_state_in_a_step():
    """Deadbeat control: with R = 0 and an invertible B the cost-to-go is Q and the gain −B⁻¹A."""
    found = regulate([[2.0]], [[4.0]], [[5.0]], [[0.0]], [[0.0]])
    assert (found.K[0, 0], found.L[0, 0], found.H[0, 0]) == (5.0, -0.5, 80.0)
    assert found.slowest == 0
    A, B, Q = np.array([[1.5, 1.0], [0.25, -2.0]]), np.array([[1.0, 1.0], [0.0, 2.0]]), np.array([[2.0, 1.0], [1, 3]])
    found = regulate(A, B, Q, np.zeros((2, 2)), np.zeros((2, 2)))
    assert found.K == pytest.approx(Q, rel=1e-14)
    assert found.L == pytest.approx(-np.linalg.inv(B) @ A, rel=1e-13)


def test_a_register_of_a_free_input_lets_the_state_pass_once():
    """x₁⁺ = 1.5 x₁ + x₂, x₂⁺ = u with Q on x₁ alone: the state costs x₁² + (1.5 x₁ + x₂)² and is zero thereafter."""
    found = regulate([[1.5, 1.0], [0.0, 0.0]], [[0.0], [1.0]], np.diag([1.0, 0.0]), [[0.0]], np.zeros((2, 1)))
    assert found.K == pytest.approx(np.array([[3.25, 1.5], [1.5, 1.0]]), rel=1e-12)
    assert found.L == pytest.approx(np.array([[-2.25, -1.5]]), rel=1e-12)


def test_one_of_two_inputs_may_cost_nothing():
    """It alone is used where it suffices; of two copies of an actuator the free one is, and the cheap sum is."""
    found = regulate([[1.5]], [[1.0, 2.0]], [[1.0]], np.diag([0.0, 1.0]), np.zeros((1, 2)))
    assert found.K[0, 0] == pytest.approx(1, rel=1e-12)
    assert found.L == pytest.approx(np.array([[-1.5], [0.0]]), abs=1e-12)
    found = regulate([[1.5]], [[1.0, 2.0]], [[1.0]], np.ones((2, 2)), np.zeros((1, 2)))  # (u₁ + u₂)² costs
    assert found.L == pytest.approx(np.array([[1.5], [-1.5]]), abs=1e-12)


@pytest.mark.parametrize("zero", [2.0, -3.0, 0.5, -0.25, 1.25])
def test_a_zero_outside_the_circle_is_mirrored(zero):
    """With R = 0 the output (x₂ − z x₁)² costs nothing after a step if |z| < 1, else as if its zero were 1/z.

    For |z| < 1 the cost-to-go is that of the present output alone. For |z| > 1 each state is worth z².
    """
    found = regulate(*zeroed(zero))
    z = zero
    expected = [[z * z, -z], [-z, 1.0]] if abs(z) < 1 else [[z * z, -z], [-z, z * z]]
    assert found.K == pytest.approx(np.array(expected), rel=1e-9)
    assert found.slowest == pytest.approx(min(abs(z), 1 / abs(z)), rel=1e-9)


@pytest.mark.parametrize(
    ("zeros", "mode"),
    [
        ((1.0,), "1"),
        ((-1.0,), "-1"),
        ((1j, -1j), r"0\+1i"),
        ((0.625 + 0.7806247498j, 0.625 - 0.7806247498j), "0.6"),
    ],
)
def test_a_motion_on_the_circle_without_cost_is_named(zeros, mode):
    """No gain is the best one then, and also that of smaller and smaller weights tends to a loop that is not stable."""
    A, B, Q, R, N = zeroed(*zeros)
    Q = np.round(Q * 16) / 16  # exactly the square of an exact zero on the circle
    with pytest.raises(UnstableError, match=rf"^R is singular, and inputs can keep the mode {mode}"):
        regulate(A, B, Q, R, N)
    with pytest.raises(UnstableError, match="on the circle of radius 1/√discount = 2 in motion without cost"):
        regulate(*zeroed(-2.0), 0.25)


def test_near_the_circle_the_solution_is_found():
    """The exact statement about the zero decides, not its distance from the circle."""
    for z in (1 - 2.0**-20, 1 + 2.0**-20):
        found = regulate(*zeroed(z))
        assert found.slowest == pytest.approx(min(z, 1 / z), rel=1e-9)


def test_a_continuous_regulator_needs_a_definite_weight():
    """Its gain contains R⁻¹; the message says what does without."""
    with pytest.raises(
        ProblemError, match=r"R has the eigenvalue 0, and the gain .* needs a positive definite R.*holds"
    ):
        regulate_continuous([[2.0]], [[1.0]], [[1.0]], [[0.0]], [[0.0]])


def test_the_last_input_of_a_horizon_may_be_free():
    """It moves a state that has no weight any more; with a terminal weight, it has a price."""
    one, none = [[1.0]], [[0.0]]
    with pytest.raises(ProblemError, match=r"at step 2: .* give R or the terminal weight a positive part"):
        regulate_finite([[2.0]], one, one, none, none, none, 3)
    assert regulate_finite([[2.0]], one, one, none, none, one, 3).L.ravel().tolist() == [-2.0, -2.0, -2.0]


@law(8, 200, seed=seeds)
def test_a_singular_weight_is_the_limit_of_definite_ones(seed):
    """K(R + rI) = K(R) + rX + O(r²) with X = F'XF + L'L, and K is that of scipy's pencil, for R of any rank below m."""
    draws = np.random.default_rng(seed)
    n = int(draws.integers(1, 5))
    m = int(draws.integers(1, n + 1))
    rank = int(draws.integers(0, m))
    A, B = draws.normal(size=(n, n)), draws.normal(size=(n, m))
    A *= draws.uniform(0.4, 1.5) / np.abs(np.linalg.eigvals(A)).max()
    r = draws.normal(size=(m, rank))
    D = np.hstack([draws.normal(size=(rank, n)), r.T])  # cross terms of the inputs that cost something
    M = D.T @ D
    Q, R, N = M[:n, :n] + np.eye(n), M[n:, n:], M[:n, n:]
    found = regulate(A, B, Q, R, N)
    K, L = found.K, found.L
    assume(radius(A + B @ L) < 0.95)
    assume(np.linalg.cond(found.H) < 1e4)
    X = accumulate((A + B @ L).T, L.T @ L)
    small = 1e-6 / max(1.0, np.abs(X).max())
    nearby = regulate(A, B, Q, R + small * np.eye(m), N).K
    assert nearby - K == pytest.approx(
        small * X, rel=1e-2, abs=1e-4 * small * np.abs(X).max() + 1e-12 * np.abs(K).max()
    )
    other = solve_discrete_are(A, B, Q, R, s=N)
    assert K == pytest.approx(other, rel=1e-6, abs=1e-7 * np.abs(K).max())
