"""Sampling: closed forms, semigroup, quadrature, simulation, and the numbers of the corrected theory."""

# ruff: noqa: SIM300 - ruff takes matrices, which carry their paper symbols, for constants
from __future__ import annotations

import re

import numpy as np
import pencils
import pytest
import scipy.integrate
import scipy.linalg
from drawn import law
from hypothesis import strategies as st

from taciturn import ContinuousPlant, Cost, Network, Problem
from taciturn.design.kinds.excess import excess
from taciturn.errors import ProblemError, TaciturnError
from taciturn.lqg.equation import accumulate
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.periodic import lift
from taciturn.lqg.riccati import regulate, regulate_continuous
from taciturn.lqg.sampling import sample, sample_prediction
from taciturn.model.disturbance import follow
from taciturn.model.signals import ExternalDisturbance

seeds = st.integers(0, 2**32 - 1)
FIELDS = ("A", "B", "Q", "R", "N", "W", "noise_cost")
INTEGRATOR = (np.array([[0.0, 1], [0, 0]]), np.array([[0.0], [1]]))


def assert_same(one, other, rel):
    """Compare two sampled problems field by field, relative to the largest entry of each field."""
    for name in FIELDS:
        want = np.asarray(getattr(other, name))
        assert np.asarray(getattr(one, name)) == pytest.approx(want, rel=rel, abs=rel * np.abs(want).max()), name


@pytest.mark.parametrize("h", [1e-6, 0.1, 1.0, 37.0])
def test_the_double_integrator_is_sampled_as_in_the_books(h):
    """Polynomials in h, entry by entry, to 1e-12."""
    A, B = INTEGRATOR
    q1, q2, r, n1, n2, w = 2.0, 3.0, 0.7, 0.3, -0.2, 1.7
    found = sample(A, B, np.diag([q1, q2]), [[r]], [[n1], [n2]], np.diag([0, w]), h)
    expected = {
        "A": [[1, h], [0, 1]],
        "B": [[h**2 / 2], [h]],
        "Q": [[q1 * h, q1 * h**2 / 2], [q1 * h**2 / 2, q1 * h**3 / 3 + q2 * h]],
        "N": [
            [q1 * h**3 / 6 + n1 * h],
            [q1 * h**4 / 8 + q2 * h**2 / 2 + n1 * h**2 / 2 + n2 * h],
        ],
        "R": [[r * h + q1 * h**5 / 20 + q2 * h**3 / 3 + n1 * h**3 / 3 + n2 * h**2]],
        "W": [[w * h**3 / 3, w * h**2 / 2], [w * h**2 / 2, w * h]],
        "noise_cost": q1 * w * h**4 / 12 + q2 * w * h**2 / 2,
    }
    for name, want in expected.items():
        assert np.asarray(getattr(found, name)) == pytest.approx(np.asarray(want), rel=1e-12), name


@pytest.mark.parametrize("a", [-300.0, -1.0, 1e-9, 0.8, 40.0])
def test_a_scalar_plant_is_sampled_as_in_the_books(a):
    """Exponentials, to 1e-12 also where a·h is far from zero either way."""
    h, q, w = 1.5, 2.0, 3.0
    found = sample([[a]], [[1]], [[q]], [[0]], [[0]], [[w]], h)
    grown = np.expm1(2 * a * h) / (2 * a)
    assert found.A[0, 0] == pytest.approx(np.exp(a * h), rel=1e-12)
    assert found.B[0, 0] == pytest.approx(np.expm1(a * h) / a, rel=1e-12)
    assert found.Q[0, 0] == pytest.approx(q * grown, rel=1e-12)
    assert found.W[0, 0] == pytest.approx(w * grown, rel=1e-12)
    small = abs(a * h) < 1e-6
    cost = q * w * h**2 / 2 if small else q * w * (grown - h) / (2 * a)
    assert found.noise_cost == pytest.approx(cost, rel=1e-8 if small else 1e-12)


def test_fast_and_slow_and_unstable_modes_share_one_exact_answer():
    """Eigenvalues from −400 to 6 over a period of 3: entrywise closed forms to 1e-12."""
    rates, h = np.array([-400.0, -1.0, 0.5, 6.0]), 3.0
    root = np.random.default_rng(5).normal(size=(4, 4))
    Q, W = root @ root.T, root.T @ root
    found = sample(np.diag(rates), np.zeros((4, 1)), Q, [[1.0]], np.zeros((4, 1)), W, h)
    sums = rates[:, None] + rates
    grown = np.expm1(sums * h) / sums
    assert found.A.diagonal() == pytest.approx(np.exp(rates * h), rel=1e-12)
    assert found.Q == pytest.approx(Q * grown, rel=1e-12)
    assert found.W == pytest.approx(W * grown, rel=1e-12)
    assert found.noise_cost == pytest.approx(np.sum(Q * W * (grown - h) / sums), rel=1e-12)


@law(2, 20, seed=seeds, h=st.floats(0.05, 3))
def test_sampling_agrees_with_brute_force_quadrature(draw, seed, h):
    """Every integral by adaptive quadrature of matrix exponentials."""
    c = draw(seed)
    n, m = c.B.shape
    F = np.block([[c.A, c.B], [np.zeros((m, n + m))]])
    M = np.block([[c.Q, c.N], [c.N.T, c.R]])

    def integrands(t):
        E = scipy.linalg.expm(F * t)
        V = E[:n, :n] @ c.W @ E[:n, :n].T
        # ∫_0^h tr(Q ∫_0^s V)ds = ∫_0^h (h − r) tr(Q V(r)) dr
        return np.concatenate([(E.T @ M @ E).ravel(), V.ravel(), [(h - t) * np.sum(c.Q * V)]])

    total, _ = scipy.integrate.quad_vec(integrands, 0, h, epsrel=1e-12)
    weights, noise = total[: (n + m) ** 2].reshape(n + m, n + m), total[(n + m) ** 2 : -1].reshape(n, n)
    found = sample(c.A, c.B, c.Q, c.R, c.N, c.W, h)
    close = {"rel": 1e-9, "abs": 1e-11 * np.abs(weights).max()}
    assert found.Q == pytest.approx(weights[:n, :n], **close)
    assert found.R == pytest.approx(weights[n:, n:], **close)
    assert found.N == pytest.approx(weights[:n, n:], **close)
    assert found.W == pytest.approx(noise, rel=1e-9, abs=1e-11 * np.abs(noise).max())
    assert found.noise_cost == pytest.approx(total[-1], rel=1e-10)
    assert np.hstack([found.A, found.B]) == pytest.approx(scipy.linalg.expm(F * h)[:n], rel=1e-9, abs=1e-12)


@law(2, 20, seed=seeds, h=st.floats(0.05, 2))
def test_sampling_a_prediction_agrees_with_brute_force_quadrature(draw, seed, h):
    """The input L x̂(t) follows the model; every integral by adaptive quadrature."""
    c = draw(seed)
    n = len(c.A)
    L = regulate_continuous(c.A, c.B, c.Q, c.R, c.N).L

    def integrands(t):
        plant, model = scipy.linalg.expm(c.A * t), scipy.linalg.expm((c.A + c.B @ L) * t)
        x, u = np.hstack([plant, model - plant]), np.hstack([np.zeros_like(L), L @ model])
        weight = x.T @ c.Q @ x + u.T @ c.R @ u + x.T @ c.N @ u + u.T @ c.N.T @ x
        return np.append(weight.ravel(), (h - t) * np.sum(c.Q * (plant @ c.W @ plant.T)))

    total, _ = scipy.integrate.quad_vec(integrands, 0, h, epsrel=1e-12)
    weight = total[:-1].reshape(2 * n, 2 * n)
    found = sample_prediction(c.A, c.B, c.Q, c.R, c.N, c.W, L, h)
    joint = np.block([[found.Q, found.N], [found.N.T, found.R]])
    assert joint == pytest.approx(weight, rel=1e-8, abs=1e-10 * np.abs(weight).max())
    assert found.noise_cost == pytest.approx(total[-1], rel=1e-10)
    assert found.A + found.B == pytest.approx(scipy.linalg.expm((c.A + c.B @ L) * h), rel=1e-8, abs=1e-9)
    held = sample(c.A, c.B, c.Q, c.R, c.N, c.W, h)
    assert found.W == pytest.approx(held.W, rel=1e-11, abs=1e-12 * np.abs(held.W).max())


@law(8, 100, seed=seeds, h=st.floats(0.01, 5), parts=st.integers(2, 7))
def test_a_period_is_the_sum_of_its_parts(draw, seed, h, parts):
    """Sampling h/k and holding the input for k steps is sampling h, noise cost included."""
    c = draw(seed)
    whole = sample(c.A, c.B, c.Q, c.R, c.N, c.W, h)
    part = sample(c.A, c.B, c.Q, c.R, c.N, c.W, h / parts)
    joined = lift(part.A, part.B, part.Q, part.R, part.N, part.W, parts)
    for name in FIELDS[:-1]:
        want = getattr(whole, name)
        assert getattr(joined, name) == pytest.approx(want, rel=1e-10, abs=1e-11 * np.abs(want).max()), name
    assert joined.noise_cost + parts * part.noise_cost == pytest.approx(whole.noise_cost, rel=1e-11)


@law(8, 100, seed=seeds, first=st.floats(0.01, 3), second=st.floats(0.01, 3))
def test_two_unequal_periods_compose(draw, seed, first, second):
    """The semigroup law for A, B, W and the noise cost with unequal parts, also for predictions."""
    c = draw(seed)
    L = regulate_continuous(c.A, c.B, c.Q, c.R, c.N).L
    one, two, both = (sample(c.A, c.B, c.Q, c.R, c.N, c.W, h) for h in (first, second, first + second))
    assert two.A @ one.A == pytest.approx(both.A, rel=1e-10, abs=1e-11 * np.abs(both.A).max())
    assert two.A @ one.W @ two.A.T + two.W == pytest.approx(both.W, rel=1e-10, abs=1e-11 * np.abs(both.W).max())
    cost = one.noise_cost + np.sum(two.Q * one.W) + two.noise_cost
    assert cost == pytest.approx(both.noise_cost, rel=1e-10)
    one, two, both = (sample_prediction(c.A, c.B, c.Q, c.R, c.N, c.W, L, h) for h in (first, second, first + second))
    carried = two.A @ one.B + two.B @ (one.A + one.B)  # the prediction continues undisturbed
    assert carried == pytest.approx(both.B, rel=1e-8, abs=1e-9 * (np.abs(both.B).max() + np.abs(both.A).max()))


def test_units_of_the_input_do_not_cost_digits():
    """An input measured in units 1e8 times larger or smaller changes B, R, N by exactly that factor."""
    A, B = np.array([[0.0, 1], [-2, -0.3]]), np.array([[0.0], [1]])
    plain = sample(A, B, np.eye(2), [[0.1]], [[0.2], [0.1]], np.eye(2), 0.7)
    for unit in (1e-8, 1e8):
        other = sample(A, B * unit, np.eye(2), [[0.1 * unit**2]], [[0.2 * unit], [0.1 * unit]], np.eye(2), 0.7)
        for name, power in (("A", 0), ("B", 1), ("Q", 0), ("R", 2), ("N", 1), ("W", 0)):
            assert getattr(other, name) == pytest.approx(getattr(plain, name) * unit**power, rel=1e-13), name


def test_the_shortcut_overstates_the_cost_of_the_double_integrator():
    """Exact weights give tr(KW)/h = 3.1033; R·h without the cross weight gives 4.8415."""
    A, B = INTEGRATOR
    found = sample(A, B, np.eye(2), [[0.1]], np.zeros((2, 1)), np.eye(2), 1.0)
    exact = regulate(found.A, found.B, found.Q, found.R, found.N)
    assert np.trace(exact.K @ found.W) == pytest.approx(3.1033, abs=5e-5)
    shortcut = regulate(found.A, found.B, found.Q, [[0.1]], np.zeros((2, 1)))
    assert np.trace(shortcut.K @ found.W) == pytest.approx(4.8415, abs=5e-5)


@pytest.mark.parametrize("r", [0.5, 1.0, 2.0, 4.0, 10.0, 20.0])
def test_predictive_periodic_control_costs_the_printed_polynomial(r):
    """V_p(r) = 21.3959 + 9.1557/r + 2.2553/r² + .2083/r³ for the double integrator of chapter 5."""
    A, B = INTEGRATOR
    W = 5 * np.diag([0, 0.5])
    control = regulate_continuous(A, B, np.eye(2), [[10.0]], np.zeros((2, 1)))
    found = sample_prediction(A, B, np.eye(2), [[10.0]], np.zeros((2, 1)), W, control.L, 1 / r)
    states = accumulate(found.A + found.B, found.W)  # the prediction is reset to the state at each sample
    cost = np.sum((found.Q + found.R + found.N + found.N.T) * states) + found.noise_cost
    printed = 21.395904 + 9.155694 / r + 2.255326 / r**2 + 0.208333 / r**3
    assert cost * r == pytest.approx(printed, abs=5e-7 * (1 + 1 / r + 1 / r**2 + 1 / r**3))


@pytest.mark.parametrize(
    ("period", "printed", "between"),
    [(0.1697, 0.38913, 0.0043), (0.26, 0.4149, 0.0102), (0.3396, 0.4452, 0.0168)],
)
def test_periodic_control_of_the_two_masses_costs_what_the_corrected_figure_shows(masses, period, printed, between):
    """Figure 2.2: the periodic column per unit of time, and the noise cost in between that it leaves out."""
    N, W, V = np.zeros((4, 1)), 0.1 * np.eye(4), 0.01 * np.eye(2)
    found = sample(masses.A, masses.B, 0.05 * np.eye(4), [[0.05]], N, W, period)
    control = regulate(found.A, found.B, found.Q, found.R, found.N)
    seen = steady_filter(found.A, masses.C, found.W, V)
    cost = np.trace(found.Q @ seen.posterior) + np.trace(control.K @ (seen.prior - seen.posterior))
    # The period is printed to four digits, of which the cost takes up to 2e-5.
    assert cost / period == pytest.approx(printed, abs=7e-5)
    assert found.noise_cost / period == pytest.approx(between, abs=5e-5)


@pytest.mark.evidence
def test_a_simulated_noisy_loop_has_the_sampled_moments_and_cost():
    """Euler–Maruyama at 1/2000 of the period: mean, covariance and cost within four standard errors."""
    rng = np.random.default_rng(11)
    A, B = np.array([[0.2, 1], [-2, -0.4]]), np.array([[0.3], [1]])
    Q, R, N = np.array([[2.0, 0.4], [0.4, 1]]), np.array([[0.5]]), np.array([[0.3], [-0.2]])
    W = np.array([[0.5, 0.2], [0.2, 1.0]])
    h, steps, paths = 0.8, 2000, 4000
    x0, u = np.array([1.0, -0.5]), np.array([0.7])
    dt, root = h / steps, np.linalg.cholesky(W * h / steps)
    x, cost = np.tile(x0, (paths, 1)), np.zeros(paths)
    for _ in range(steps):
        cost += dt * (np.einsum("ki,ij,kj->k", x, Q, x) + u @ R @ u + 2 * x @ N @ u)
        x = x + dt * (x @ A.T + B @ u) + rng.normal(size=(paths, 2)) @ root.T
    found = sample(A, B, Q, R, N, W, h)
    expected = x0 @ found.Q @ x0 + u @ found.R @ u + 2 * x0 @ found.N @ u + found.noise_cost
    bias = 4 * dt  # first order in the step; the rates here are below 4
    assert abs(cost.mean() - expected) < 4 * cost.std() / np.sqrt(paths) + bias
    deviations = x - (found.A @ x0 + found.B @ u)
    assert (np.abs(deviations.mean(axis=0)) < 4 * deviations.std(axis=0) / np.sqrt(paths) + bias).all()
    products = deviations[:, :, None] * deviations[:, None, :]
    assert (np.abs(products.mean(axis=0) - found.W) < 4 * products.std(axis=0) / np.sqrt(paths) + bias).all()


def test_a_period_over_which_the_state_overflows_is_refused():
    """A sentence instead of inf."""
    with pytest.raises(ProblemError, match="shorten the period"):
        sample([[10.0]], [[1]], [[1]], [[1]], [[0]], [[1]], 200.0)
    with pytest.raises(ProblemError, match="shorten the period"):
        sample([[1e150]], [[1]], [[1]], [[1]], [[0]], [[1]], 1e200)


@pytest.mark.parametrize(("period", "told"), [(5.0, "e^22"), (20.0, "e^88"), (1000.0, "e^4400")])
def test_a_period_that_is_too_long_for_an_unstable_mode_is_told_as_such(period, told):
    """A pendulum that falls at 4.4/s, and not a mode that no input moves, which rounding made of it."""
    pendulum = ContinuousPlant([[0, 1], [4.4**2, 0]], [[0], [1]], np.eye(2))
    words = re.escape(f"grows by the factor {told}; expected a factor of at most 1e+08, so a period below about 4.19")
    with pytest.raises(ProblemError, match=words):
        excess(pendulum, Cost(np.eye(2), [[1.0]]), theta=0.1, period=period)


@pytest.mark.parametrize("period", [1e-9, 1e-7, 1e-4, 0.1, 4.0])
def test_a_falling_pendulum_is_right_at_any_period(period):
    """Its cost is that of the pencil; within 4 s, it falls by e^17.6."""
    A, B, N = np.array([[0.0, 1.0], [4.4**2, 0.0]]), np.array([[0.0], [1.0]]), np.zeros((2, 1))
    found = excess(ContinuousPlant(A, B, np.eye(2)), Cost(np.eye(2), [[1.0]]), theta=0.1, period=period)
    exact = pencils.sampled(A, B, np.eye(2), np.eye(1), N, np.eye(2), period)
    spent = pencils.spent(pencils.stabilising(exact)[0], exact.W)
    alone = sample(A, B, np.eye(2), np.eye(1), N, np.eye(2), period).noise_cost
    assert found.cost_all_time == pytest.approx((spent + alone) / period, rel=1e-12)


@pytest.mark.parametrize("period", [0.0, -1.0, np.inf])
def test_a_period_that_is_not_positive_is_refused(period):
    """h > 0 and finite."""
    with pytest.raises(ProblemError, match="period"):
        sample([[1.0]], [[1]], [[1]], [[1]], [[0]], [[1]], period)


@pytest.mark.parametrize("period", [1e-12, 1e-14])
def test_a_period_that_rounding_hides_is_named(period: float) -> None:
    """Neither the noise V nor the weight Q is the reason; an error of another kind keeps its own."""
    plant = ContinuousPlant([[-0.1, 1.0], [0.0, -0.2]], [[0.0], [1.0]], 0.01 * np.eye(2), C=[[1.0, 0.0]], V=[[0.01]])
    cost = Cost(np.diag([1.0, 0.0]), [[0.1]])
    with pytest.raises(TaciturnError, match=rf"^period is {period:g} s, in which the plant moves by .*longer"):
        Problem(plant, cost, Network(), "excess", {"theta": 0.1, "period": period}).designed()
    with pytest.raises(ProblemError, match="neither delta nor theta is given"):
        Problem(plant, cost, Network(), "excess", {"period": period}).designed()


@pytest.mark.parametrize(("period", "longer"), [(1e-300, "longer"), (1e-12, "longer"), (1e100, "shorter")])
def test_a_period_far_from_the_time_scale_of_the_plant_is_named_and_not_the_disturbance(
    period: float, longer: str
) -> None:
    """With a period that has a design; the disturbance and the noise are the same."""
    plant = ContinuousPlant([[0, 1], [-1, -0.4]], [[0], [1]], np.diag([0, 1.0]), C=[[1.0, 0.0]], V=[[0.01]])
    plant = follow(plant, disturbances=[ExternalDisturbance([0.0, 1.0], 1e-4)])
    problem = Problem(plant, Cost(np.eye(2), [[1.0]]), Network(), "lqg", {"theta": 0.1, "period": period})
    words = re.escape(f"period is {period:g} s, in which the plant moves")
    with pytest.raises(TaciturnError, match=f"^{words} .*; expected a {longer} period, such as 0.1 s$"):
        problem.designed()
    Problem(plant, problem.cost, Network(), "lqg", {"theta": 0.1, "period": 0.1}).designed()


@pytest.mark.parametrize("A", [-1.0, 0.0])
def test_a_period_of_which_nothing_is_left_in_a_step_is_refused_without_a_problem(A: float) -> None:
    """Also of an integrator, which has no time scale of its own."""
    with pytest.raises(
        ProblemError,
        match=r"period is 1e-300, but in so short a step, rounding hides the motion of the plant; .* at least 1e-1",
    ):
        excess(ContinuousPlant([[A]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]]), theta=0.1, period=1e-300)
