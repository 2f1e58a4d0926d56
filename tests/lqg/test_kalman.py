"""Filters: conditioning, steady state, noise-free corners, refusals."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg
from drawn import law, left_out
from hypothesis import assume
from hypothesis import strategies as st

from taciturn._modes import radius
from taciturn._rational import is_semidefinite
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.queries import Predictor, follow_every_query
from taciturn.lqg.riccati import regulate
from taciturn.model.plant import Plant

seeds = st.integers(0, 2**32 - 1)


def plant_of(A, C, W, V):
    """Return a plant whose inputs move every state."""
    return Plant(A, np.eye(len(A)), W, C, V)


def riccati_step(A, C, W, V, Sigma):
    """Return the covariance of the next prediction."""
    predictor = Predictor(plant_of(A, C, W, V))
    return predictor.queried(Sigma, predictor.gain(Sigma))


def predict_covariances(A, C, W, V, initial, steps):
    """Return the covariances before and after each measurement, and the gains, for the steps 0 to ``steps``."""
    plant = plant_of(A, C, W, V)
    prior, _ = follow_every_query(plant, np.asarray(initial, dtype=float), steps + 1)
    gains = Predictor(plant).correction(prior)
    rest = np.eye(plant.states) - gains @ plant.C
    return SimpleNamespace(prior=prior, gains=gains, posterior=rest @ prior @ rest.mT + gains @ plant.V @ gains.mT)


def assert_consistent(found, A, C, W, V):
    """Check every equation of a steady filter."""
    size = np.abs(found.prior).max() + np.abs(W).max() + 1e-6 * np.abs(V).max() + 1e-300
    close = {"rel": 1e-7, "abs": 1e-8 * size}
    assert A @ found.posterior @ A.T + W == pytest.approx(found.prior, **close)
    assert riccati_step(A, C, W, V, found.prior) == pytest.approx(found.prior, **close)
    # a gain of outputs that are known in advance is not small, and multiplies the rounding of their variance twice
    close["abs"] += 1e-15 * np.abs(found.innovation).max() * np.abs(found.gain).max() ** 2
    assert found.gain @ found.innovation @ found.gain.T == pytest.approx(found.prior - found.posterior, **close)
    assert C @ found.prior @ C.T + V == pytest.approx(found.innovation, rel=1e-9, abs=1e-9 * size)
    assert radius(A - A @ found.gain @ C) < 1


@law(8, 100, seed=seeds)
def test_the_steady_filter_satisfies_its_equations(draw, seed):
    """Full-rank noise, stable and unstable plants."""
    c = draw(seed)
    assert_consistent(steady_filter(c.A, c.C, c.W, c.V), c.A, c.C, c.W, c.V)


@law(8, 100, seed=seeds)
def test_the_steady_filter_exists_for_noise_of_any_rank(draw, seed):
    """Process and measurement noise of random ranks, zero included, away from the unit circle.

    Where rounding hides the rank, the filter is refused, and its example does not count.
    """
    c = draw(seed)
    n, p = c.A.shape[0], c.C.shape[0]
    G = c.rng.normal(size=(n, c.rng.integers(0, n + 1)))
    D = c.rng.normal(size=(p, c.rng.integers(0, p + 1)))
    with left_out("too badly conditioned"):
        found = steady_filter(c.A, c.C, G @ G.T, D @ D.T)
    assert_consistent(found, c.A, c.C, G @ G.T, D @ D.T)


@law(8, 100, seed=seeds)
def test_the_filter_in_time_tends_to_the_steady_one(draw, seed):
    """From any start the covariances and gains settle."""
    c = draw(seed)
    steady = steady_filter(c.A, c.C, c.W, c.V)
    assume(radius(c.A - c.A @ steady.gain @ c.C) < 0.85)
    timed = predict_covariances(c.A, c.C, c.W, c.V, np.eye(len(c.A)), 150)
    close = {"rel": 1e-7, "abs": 1e-8 * np.abs(steady.prior).max()}
    assert timed.prior[-1] == pytest.approx(steady.prior, **close)
    assert timed.posterior[-1] == pytest.approx(steady.posterior, **close)
    assert timed.gains[-1] == pytest.approx(steady.gain, rel=1e-6, abs=1e-7 * np.abs(steady.gain).max())


@law(8, 100, seed=seeds)
def test_the_filter_in_time_is_gaussian_conditioning(draw, seed):
    """Prior and posterior equal the conditional covariances of one large joint Gaussian."""
    c = draw(seed)
    n, p, steps = len(c.A), len(c.C), 3
    initial = c.W[::-1, ::-1]
    found = predict_covariances(c.A, c.C, c.W, c.V, initial, steps)
    sources = scipy.linalg.block_diag(initial, *[c.W] * steps, *[c.V] * (steps + 1))  # x_0, w_k, v_k
    state = np.eye(n, len(sources))
    outputs = np.zeros((0, len(sources)))
    for k in range(steps + 1):
        for covariances in (found.prior[k], found.posterior[k]):
            cross, total = state @ sources @ outputs.T, outputs @ sources @ outputs.T
            known = cross @ np.linalg.solve(total, cross.T)
            assert covariances == pytest.approx(
                state @ sources @ state.T - known,
                rel=1e-6,
                abs=1e-7 * np.abs(state @ sources @ state.T).max(),
            )
            if covariances is found.prior[k] or len(outputs) == k * p:
                row = c.C @ state
                row[:, (1 + steps) * n + k * p : (1 + steps) * n + (k + 1) * p] = np.eye(p)
                outputs = np.vstack([outputs, row])
        state = c.A @ state
        if k < steps:
            state[:, (1 + k) * n : (2 + k) * n] = np.eye(n)


def test_the_two_masses_cost_what_the_thesis_prints(masses):
    """J_all = tr(QΣ) + tr(K(Σ̃−Σ)) = 0.733478 at ts = 0.1."""
    exponential = scipy.linalg.expm(np.block([[masses.A, masses.B], [np.zeros((1, 5))]]) * 0.1)
    A, B = exponential[:4, :4], exponential[:4, 4:]
    control = regulate(A, B, masses.Q, masses.R, masses.N)
    found = steady_filter(A, masses.C, masses.W, masses.V)
    cost = np.trace(masses.Q @ found.posterior) + np.trace(control.K @ (found.prior - found.posterior))
    assert cost == pytest.approx(0.733478, abs=5e-7)


def test_the_scalar_example_of_chapter_three_costs_what_the_thesis_prints():
    """J_all = tr(KW) + tr(PΣ̃) = .481486 in predicted form."""
    control = regulate([[2.0]], [[1.0]], [[1.0]], [[2.0]], [[0.0]])
    found = steady_filter([[2.0]], [[3.0]], [[0.01]], [[0.02]])
    P = control.L.T @ control.H @ control.L
    assert (0.01 * control.K + P * found.prior)[0, 0] == pytest.approx(0.481486, abs=5e-7)


@pytest.mark.parametrize("rank", [0, 1, 3])
def test_a_state_seen_without_noise_is_known_exactly(rank):
    """C = I and V = 0: the gain is exactly I, Σ = 0, Σ̃ = W, whatever the rank of W."""
    A, W = np.array([[1.0, 1, 0], [0, 1, 1], [0, 0, 2]]), np.diag([1.0, 1, 1]) * (np.arange(3) < rank)
    found = steady_filter(A, np.eye(3), W, np.zeros((3, 3)))
    assert np.array_equal(found.gain, np.eye(3))
    assert not found.posterior.any()
    assert np.array_equal(found.prior, W)


def test_without_any_noise_the_observer_is_stable_and_the_covariances_are_zero():
    """An oscillator and an unstable mode, seen through one output, W = 0 and V = 0."""
    A, C = scipy.linalg.block_diag([[0.0, 1], [-1, 0]], [[1.5]]), np.array([[1.0, 0, 1]])
    found = steady_filter(A, C, np.zeros((3, 3)), [[0.0]])
    assert not found.prior.any()
    assert not found.posterior.any()
    assert not found.innovation.any()
    assert radius(A - A @ found.gain @ C) < 1
    scaled = steady_filter(A, C, 1e-6 * np.eye(3), [[1e-6]])
    assert found.gain == pytest.approx(scaled.gain, rel=1e-8)


def test_an_undisturbed_unstable_plant_gets_the_limit_of_vanishing_disturbance():
    """W = 0 and V > 0: the stabilising solution, not Σ = 0."""
    A, C, V = np.array([[1.4, 1], [0, 0.6]]), np.array([[1.0, 1]]), [[0.5]]
    found = steady_filter(A, C, np.zeros((2, 2)), V)
    assert found.prior[0, 0] > 0.1
    assert steady_filter(A, C, 1e-9 * np.eye(2), V).prior == pytest.approx(found.prior, abs=1e-7)
    assert sorted(np.abs(np.linalg.eigvals(A - A @ found.gain @ C))) == pytest.approx([0.6, 1 / 1.4])


def test_an_undisturbed_stable_plant_is_known_in_the_end():
    """W = 0, V > 0 and A stable: exact zeros."""
    found = steady_filter([[0.5, 1], [0, 0.9]], [[1.0, 0]], np.zeros((2, 2)), [[1.0]])
    assert not found.prior.any()
    assert found.gain == pytest.approx(0, abs=1e-12)


def test_two_copies_of_one_perfect_sensor_share_the_work():
    """S is singular; the pseudo-inverse gives half a gain to each."""
    single = steady_filter([[1.0, 1], [0, 1]], [[1.0, 0]], np.eye(2), [[0.0]])
    double = steady_filter([[1.0, 1], [0, 1]], [[1.0, 0], [1.0, 0]], np.eye(2), np.zeros((2, 2)))
    assert double.prior == pytest.approx(single.prior)
    assert double.gain @ [1, 1] == pytest.approx(single.gain[:, 0])


def test_a_perfect_sensor_and_a_noisy_one_in_other_units():
    """Changing the unit of an output changes its gain and nothing else."""
    A, C, W, V = np.array([[1.0, 1], [0, 1.1]]), np.eye(2), np.diag([0.0, 1]), np.diag([0.0, 1])
    plain = steady_filter(A, C, W, V)
    for unit in (1e-8, 1e8):
        T = np.diag([1, unit])
        other = steady_filter(A, T @ C, W, T @ V @ T)
        assert other.prior == pytest.approx(plain.prior, rel=1e-8, abs=1e-10)
        assert other.gain @ T == pytest.approx(plain.gain, rel=1e-7, abs=1e-9)


def test_the_filter_in_time_stops_when_everything_is_known():
    """Without noise the state is found in n steps and exact zeros follow, however unstable the plant."""
    A, C = np.array([[2.0, 1], [0.3, 3]]), [[1.0, 0]]
    found = predict_covariances(A, C, np.zeros((2, 2)), [[0.0]], np.eye(2), 40)
    assert found.posterior[0].any()
    assert not found.posterior[1:].any()
    assert np.isfinite(found.gains).all()


def test_the_filter_in_time_of_a_constant_averages():
    """After k + 1 measurements of a constant the variance is that of the mean."""
    found = predict_covariances([[1.0]], [[1.0]], [[0.0]], [[2.0]], [[1e9]], 9)
    assert found.posterior[:, 0, 0] == pytest.approx(2 / np.arange(1, 11), rel=1e-8)
    assert found.gains[:, 0, 0] == pytest.approx(1 / np.arange(1, 11), rel=1e-8)


@law(8, 100, seed=seeds)
def test_a_riccati_step_is_the_formula(draw, seed):
    """Ric(Σ) = AΣA' + W − AΣC'(CΣC'+V)^{-1}CΣA'."""
    c = draw(seed)
    X = c.W[::-1, ::-1]
    F = c.A @ X @ c.C.T
    plain = c.A @ X @ c.A.T + c.W - F @ np.linalg.solve(c.C @ X @ c.C.T + c.V, F.T)
    size = np.abs(c.A @ X @ c.A.T).max()
    assert riccati_step(c.A, c.C, c.W, c.V, X) == pytest.approx(plain, rel=1e-8, abs=1e-9 * size)


def test_an_unstable_mode_that_no_output_shows_is_named():
    """Undetectable, complex and real."""
    rotation = 1.2 * np.array([[0.6, 0.8], [-0.8, 0.6]])
    with pytest.raises(UnstableError, match=r"0\.72[+-]0\.96i, which C does not observe"):
        steady_filter(scipy.linalg.block_diag(rotation, [[0.5]]), [[0.0, 0, 1]], np.eye(3), [[1.0]])


def test_a_mode_on_the_circle_that_no_noise_reaches_is_named():
    """A constant disturbance without noise has no steady filter; the remedy is in the message."""
    with pytest.raises(
        UnstableError, match=r"eigenvalue 1 on the unit circle.*add a small positive definite matrix to W"
    ):
        steady_filter([[1.0, 1], [0, 1]], [[1.0, 0]], np.diag([1.0, 0]), [[1.0]])


def test_noise_that_cancels_in_a_perfect_output_is_refused():
    """y_k = w_{k−1} − w_{k−2} has its zero on the circle: no stable filter recovers w."""
    with pytest.raises(UnstableError, match="add a small positive definite matrix to V"):
        steady_filter([[0.0, 0], [1, 0]], [[1.0, -1]], np.diag([1.0, 0]), [[0.0]])


def test_a_covariance_that_overflows_is_refused():
    """A growing mode without a measurement gives a sentence, not inf."""
    predictor = Predictor(plant_of([[1e3]], [[1.0]], [[1.0]], [[1.0]]))
    with pytest.raises(UnstableError, match="overflows"):
        predictor.follow(np.full((1, 1), 1e200), False)


def test_a_negative_covariance_is_refused():
    """Noise covariances are checked."""
    with pytest.raises(ProblemError, match="W has the eigenvalue -1"):
        steady_filter([[1.0]], [[1.0]], [[-1.0]], [[1.0]])


@pytest.mark.parametrize("size", [1e155, -1e308])
def test_outputs_whose_variance_no_number_holds_are_refused(size):
    """A sentence, instead of the filter of a plant that nobody measures."""
    with pytest.raises(ProblemError, match="use larger units"):
        steady_filter([[0.5]], [[size]], [[1.0]], [[1.0]])
    assert steady_filter([[0.5]], [[1e150]], [[1.0]], [[1.0]]).posterior.max() < 1e-290


def test_a_covariance_that_is_semidefinite_up_to_rounding_is_filtered_next_to_precise_sensors():
    """Noise of rank one on a chain of integrators: what its rounding leaves is far above the noise of the sensors."""
    A = np.eye(4) + np.diag([1.6e-6, 1.2e-7, 715.0], -1)
    C = np.array([[0.0, 0.0, 0.0, 4.4e-3], [0.0, 5.2e-4, 0.0, 8.2e-5]])
    spread = np.array([6.8e7, -6.6e4, 37.839, -3.28e4])
    W, V = np.outer(spread, spread), np.array([[2.1e-19, -4.8e-21], [-4.8e-21, 3.9e-22]])
    assert not is_semidefinite(W)
    found = steady_filter(A, C, W, V)
    assert found.slowest < 1
    assert np.abs(found.prior / riccati_step(A, C, W, V, found.prior) - 1).max() < 1e-6
    assert np.abs(found.prior / W - 1).max() < 1e-6  # almost all of the state is known
