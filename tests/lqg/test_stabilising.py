"""Proved solutions of Riccati equations: hard problems against another method, textbook sets, and structure."""

from __future__ import annotations

import numpy as np
import pencils
import pytest
from drawn import law
from hypothesis import strategies as st

from taciturn.errors import UnstableError
from taciturn.lqg.kalman import filter_sampled
from taciturn.lqg.riccati import regulate, regulate_continuous, regulate_sampled
from taciturn.lqg.sampling import sample

seeds = st.integers(0, 2**32 - 1)
FAMILIES = ("chain", "integrators", "stiff", "masses", "weak", "dense", "registers")


def hard(family: str, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Return A, B, Q, R, N and W of a plant in continuous time whose equations are hard in a way of their own."""
    n, m = int(rng.integers(1, 9)), int(rng.integers(1, 3))
    A, B = np.zeros((n, n)), rng.normal(size=(n, m))
    if family == "chain":  # of lags and integrators, moved at its end, with weight at its start
        A = np.diag(-rng.choice([0.0, 0.1, 1.0, 10.0], n)) + np.diag(10.0 ** rng.uniform(-2, 2, n - 1), 1)
        B = np.eye(n)[:, -1:]
    elif family == "integrators":
        A, B = np.diag(np.ones(n - 1), 1), np.eye(n)[:, -1:]
    elif family == "stiff":
        T = rng.normal(size=(n, n))
        A = T @ np.diag(rng.choice([-1, -1, 1], n) * 10.0 ** rng.uniform(-5, 3, n)) @ np.linalg.inv(T)
        A *= 5 / max(5.0, float(np.linalg.eigvals(A).real.max()))
    elif family == "masses":  # between springs, hardly damped
        n = 2 * max(1, n // 2)
        k = n // 2
        springs = 2 * np.eye(k) - np.eye(k, k=1) - np.eye(k, k=-1)
        A = np.block([[np.zeros((k, k)), np.eye(k)], [-springs, -(10.0 ** rng.uniform(-9, 0)) * springs]])
        B = np.eye(n)[:, -1:]
    elif family == "weak":  # an unstable mode that inputs hardly move, in coordinates that hide it
        T = np.linalg.qr(rng.normal(size=(n, n)))[0]
        A = T @ np.diag(rng.uniform(-2, 0.5, n)) @ T.T
        B = T @ (rng.normal(size=(n, m)) * 10.0 ** rng.uniform(-12, 0, (n, 1)))
    else:
        A = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-2, 1)
    m = B.shape[1]
    # small whole numbers, so that no product is rounded, and a weight of low rank is semidefinite
    seen = 2 * rng.integers(-5, 5, (int(rng.integers(1, n + 1)), n)) + 1 if rng.random() < 0.5 else np.eye(n)[:1]
    root = np.hstack([seen, rng.integers(-3, 4, (len(seen), m))]).astype(np.float64)
    M = root.T @ root + np.diag([0.0] * n + [10.0 ** rng.uniform(-8, 2)] * m)
    G = rng.normal(size=(n, n))
    x = 2.0 ** rng.integers(-20, 20, n) if rng.random() < 0.5 else np.ones(n)
    A, B, G = A / x[:, None] * x, B / x[:, None], G / x[:, None]
    M[:n] *= x[:, None]
    M[:, :n] *= x
    M = (M + M.T) / 2
    return A, B, M[:n, :n], M[n:, n:], M[:n, n:], G @ G.T


def spread(found: np.ndarray, exact: np.ndarray, error: np.ndarray) -> float:
    """Return the largest miss of each entry, relative to the bound that the claimed error gives for it."""
    bound = np.sqrt(np.outer(np.diag(error), np.diag(error)))
    missed = np.abs(found - exact)
    return float((missed / np.where(missed > 0, np.maximum(bound, 1e-300), 1.0)).max())


def check(found: np.ndarray, error: np.ndarray, exact: np.ndarray) -> None:
    """A solution is within its claimed error, which is at most 1e-9 of each cost-to-go."""
    assert spread(found, exact, error) <= 1.0
    assert (np.diag(error) <= 1.001e-9 * np.diag(exact)).all()


def near_enough(error: np.ndarray, exact: np.ndarray) -> float:
    """Return the most that a gain may be off: its squares are costs, which the claimed error contains."""
    return 1e-7 + float(np.sqrt((np.diag(error) / np.diag(exact)).max()))


def stored(solve, *given):
    """Return a solution; None if its gain is not stable once it is rounded to doubles."""
    try:
        return solve(*given)
    except UnstableError as error:
        if "more digits than a double holds" not in str(error):
            raise
        return None


def check_regulator(family: str, seed: int, exponent: float) -> None:
    """The regulator is that of the pencil of the plant as it was before sampling."""
    rng = np.random.default_rng(seed)
    A, B, Q, R, N, W = hard(family, rng)
    fastest = float(np.linalg.eigvals(A).real.max(initial=0.0))
    h = min(10.0**exponent, 15.0 / max(fastest, 1e-9), 300 / np.abs(np.linalg.eigvals(A)).max(initial=1e-9))
    plant = sample(A, B, Q, R, N, W, h)
    found = stored(regulate_sampled, plant.exact, plant.A, plant.B, plant.Q, plant.R, plant.N, 1.0)
    if found is None:
        return
    exact = pencils.sampled(A, B, Q, R, N, W, h)
    K, L = (pencils.floats(part) for part in pencils.stabilising(exact))
    check(found.K, found.error, K)
    price = np.sqrt(np.diag(found.H))
    assert np.abs((found.L - L) * price[:, None] / np.sqrt(np.diag(K))).max() < near_enough(found.error, K)


def check_filter(family: str, seed: int, exponent: float, noise: float) -> None:
    """The filter is the regulator of the dual pencil."""
    rng = np.random.default_rng(seed)
    A, C, W, _, _, _ = hard(family, rng)
    A, C, n = A.T, C.T, len(A)
    h = min(10.0**exponent, 15.0 / max(float(np.linalg.eigvals(A).real.max(initial=0.0)), 1e-9))
    V = 10.0**noise * np.eye(len(C))
    none = np.zeros((n, 1))
    W = W + 1e-6 * float(np.trace(W)) * np.diag(1 / np.maximum(np.diag(W), 1e-300)) * np.diag(W) ** 2 / np.trace(W)
    plant = sample(A, none, np.eye(n), np.eye(1), none, W, h)
    found = stored(filter_sampled, plant.exact, plant.A, C, plant.W, V, 0)
    if found is None:
        return
    exact = pencils.sampled(A, none, np.eye(n), np.eye(1), none, W, h)
    given = pencils.Exact(
        exact.A.transpose(), pencils.balls(C.T), exact.W, pencils.balls(V), pencils.balls(np.zeros(C.T.shape)), exact.W,
        exact.bits,
    )  # fmt: skip
    K, L = pencils.stabilising(given)
    check(found.prior, found.error, pencils.floats(K))
    size = np.sqrt(np.diag(found.prior))
    turned = -pencils.floats(L).T * np.sqrt(np.diag(found.innovation)) / size[:, None]
    missed = plant.A @ found.gain * np.sqrt(np.diag(found.innovation)) / size[:, None] - turned
    assert np.abs(missed).max() < near_enough(found.error, found.prior)
    assert 0 <= found.slowest < 1


@pytest.mark.parametrize("family", FAMILIES)
@law(3, 140, seed=seeds, exponent=st.floats(-7, 1))
def test_regulators_of_sampled_plants_are_right_within_their_error(family, seed, exponent):
    """With periods from 1e-7 to 10 s, to 2,048 bits."""
    check_regulator(family, seed, exponent)


@pytest.mark.parametrize("family", FAMILIES)
@law(2, 140, seed=seeds, exponent=st.floats(-7, 1), noise=st.floats(-16, 16))
def test_filters_of_sampled_plants_are_right_within_their_error(family, seed, exponent, noise):
    """With measurements of any precision."""
    check_filter(family, seed, exponent, noise)


V = np.eye(3) - 2 / 3 * np.ones((3, 3))
PAIR = np.array([[9.0, 6.0], [6.0, 4.0]])
INTO = (np.array([[4.0, 3.0], [-4.5, -3.5]]), np.array([[1.0], [-1.0]]), PAIR, np.eye(1), np.zeros((2, 1)))


def near(found: np.ndarray, exact: np.ndarray) -> None:
    """Each entry agrees to twelve digits of what its row and column cost."""
    size = np.sqrt(np.abs(np.diag(exact)))
    assert np.abs((found - exact) / size / size[:, None]).max() < 1e-12


def test_continuous_equations_of_the_textbook_set_have_their_closed_forms():
    """CAREX 1 and 2."""
    given = np.array([[0.0, 1], [0, 0]]), np.array([[0.0], [1]]), np.diag([1.0, 2]), np.eye(1), np.zeros((2, 1))
    near(regulate_continuous(*given).K, np.array([[2.0, 1], [1, 2]]))
    near(regulate_continuous(*INTO).K, (1 + np.sqrt(2)) * PAIR)


@pytest.mark.parametrize("e", [1.0, 1e-3, 1e-6, 1e-8])
def test_continuous_equations_with_a_parameter_have_their_closed_forms(e):
    """CAREX 7, 9, 10 and 12: hardly controllable, badly scaled, and hardly observable."""
    none, root = np.zeros((2, 1)), np.sqrt(1 + e * e)
    found = regulate_continuous(np.diag([1.0, -2]), np.array([[e], [0.0]]), np.ones((2, 2)), np.eye(1), none)
    side = 1 / (2 + root)
    near(found.K, np.array([[(1 + root) / e**2, side], [side, (1 - e * e * side**2) / 4]]))
    found = regulate_continuous(np.array([[0.0, e], [0, 0]]), np.array([[0.0], [1]]), np.eye(2), np.eye(1), none)
    root = np.sqrt(1 + 2 * e)
    near(found.K, np.array([[root / e, 1], [1, root]]))
    A = np.array([[e + 1, 1], [1, e + 1]])
    found = regulate_continuous(A, np.eye(2), e * e * np.eye(2), np.eye(2), np.zeros((2, 2)))
    both, apart = A[0, 0] + 1, A[0, 0] - 1  # the eigenvalues of A, on (1, 1) and (1, −1)
    values = both + np.sqrt(both**2 + e * e), apart + np.sqrt(apart**2 + e * e)
    near(found.K, np.array([[sum(values), values[0] - values[1]], [values[0] - values[1], sum(values)]]) / 2)


def test_discrete_equations_of_the_textbook_set_have_their_closed_forms():
    """DAREX 1, 3 (an input that costs nothing), 5, and the chain of a hundred delays."""
    near(regulate(*INTO).K, (1 + np.sqrt(5)) / 2 * PAIR)
    free = np.array([[2.0, -1], [1, 0]]), np.array([[1.0], [0]]), np.diag([0.0, 1]), np.zeros((1, 1)), np.zeros((2, 1))
    near(regulate(*free).K, np.eye(2))
    given = np.array([[0.0, 1], [0, 0]]), np.array([[0.0], [1]]), np.array([[1.0, 2], [2, 4]]), np.eye(1)
    near(regulate(*given, np.zeros((2, 1))).K, np.array([[1, 2], [2, 2 + np.sqrt(5)]]))
    n = 100
    found = regulate(np.eye(n, k=1), np.eye(n)[:, -1:], np.eye(n), np.eye(1), np.zeros((n, 1)))
    near(found.K, np.diag(np.arange(1.0, n + 1)))


@pytest.mark.parametrize("e", [1e6, 1.0, 1e-6])
def test_discrete_equations_with_a_parameter_have_their_closed_forms(e):
    """DAREX 9 and 11, whose weights are small or large."""
    found = regulate(np.array([[0.0, e], [0, 0]]), np.array([[0.0], [1]]), np.eye(2), np.eye(1), np.zeros((2, 1)))
    near(found.K, np.diag([1, 1 + e * e]))
    found = regulate(3 * V @ np.diag([0.0, 1, 3]) @ V / 3, np.eye(3), e * np.eye(3), e * np.eye(3), np.zeros((3, 3)))
    values = e * np.array([1, (1 + np.sqrt(5)) / 2, (9 + np.sqrt(85)) / 2])
    near(found.K, V @ np.diag(values) @ V)
