"""Lower bounds by duality: below the optimum whatever they are made of, near it where that is good, and refusals."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from counts import few
from drawn import rows

from taciturn.errors import ProblemError
from taciturn_limits import dual
from taciturn_limits.dual import DualBound, Martingale, bound_schedules
from taciturn_limits.fitted import Fitted, fit_schedule
from taciturn_limits.optimal import solve_optimal

UNIT = np.eye(1)
PLANE = (
    np.array([[0.9, 0.4], [-0.3, 1.0]]),
    np.array([[1.0, 0.3], [0.3, 0.5]]),
    np.array([[1.0, 0.2], [0.2, 0.4]]),
)
PRICE = 5.0


@pytest.fixture(autouse=True)
def fewer_paths(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spend an eighth of the paths on a bound in the quick suite: it holds as surely, and is a little lower."""
    if request.node.get_closest_marker("evidence") is None:
        monkeypatch.setattr(dual, "MOST", 2)


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    """Return the nearly best schedule in the plane."""
    return fit_schedule(*PLANE, PRICE)


@pytest.fixture(scope="module")
def least() -> float:
    """Return the least mean cost in the plane, sends at their price included."""
    return solve_optimal(*PLANE, PRICE).cost


@pytest.fixture(scope="module")
def line() -> tuple[Fitted, float]:
    """Return the nearly best schedule of a scalar, and the bound that it gives."""
    fitted = fit_schedule(UNIT, UNIT, UNIT, 4.0)
    return fitted, bound_schedules(UNIT, UNIT, UNIT, 4.0, fitted, 0.9999).gain


@pytest.fixture
def few_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take few draws: bounds are looser, and hold as surely."""
    monkeypatch.setattr(dual, "MOST", 2)


def bound(fitted: Fitted, confidence: float = 0.9999, seed: int = 0) -> DualBound:
    """Return the bound in the plane."""
    return bound_schedules(*PLANE, PRICE, fitted, confidence, seed)


@pytest.mark.parametrize(
    ("F", "price"),
    rows([(0.5, 2.0), (0.5, 4.5), (0.9, 5.0), (1.0, 10.0), (1.0, 0.5), (1.3, 20.0), (-1.1, 3.0)], quick=2),
)
def test_on_a_scalar_the_bound_is_within_a_percent_of_the_optimum(F: float, price: float) -> None:
    """Below it, stable and unstable."""
    A = np.array([[F]])
    found = bound_schedules(A, UNIT, UNIT, price, fit_schedule(A, UNIT, UNIT, price), 0.9999)
    best = solve_optimal(A, UNIT, UNIT, price).cost
    assert 0.99 * best <= found.gain <= best
    assert found.gain < found.expected


@pytest.mark.evidence
def test_bounds_of_two_seeds_agree_within_their_errors(fitted: Fitted, least: float, few_draws: None) -> None:
    """Estimates differ by no more than what their confidence costs, and none is above the optimum by more."""
    found = [bound(fitted, seed=seed) for seed in range(2)]
    for one in found:
        assert 0.98 * least <= one.gain <= least
        assert one.expected - least <= one.expected - one.gain
        for other in found:
            assert abs(one.expected - other.expected) <= (one.expected - one.gain) + (other.expected - other.gain)
    assert len({one.gain for one in found}) == 2
    assert bound(fitted, seed=1) == found[1]


def test_a_bound_that_is_surer_is_lower(fitted: Fitted, least: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the same draws, from an even chance to one in a million; usually the surer one is given more draws."""
    monkeypatch.setattr(dual, "MOST", 1)
    gains = [bound(fitted, confidence).gain for confidence in (0.5, 0.99, 0.999999)]
    assert gains[0] > gains[1] > gains[2] > 0.95 * least


@pytest.mark.evidence
def test_a_bound_is_above_the_optimum_no_more_often_than_it_says() -> None:
    """400 seeds of a scalar at a confidence of 90 %: at most 40 and four standard deviations are above."""
    fitted, best = fit_schedule(UNIT, UNIT, UNIT, 2.0), solve_optimal(UNIT, UNIT, UNIT, 2.0).cost
    found = [bound_schedules(UNIT, UNIT, UNIT, 2.0, fitted, 0.9, seed).gain for seed in range(400)]
    assert sum(gain > best for gain in found) <= 40 + 4 * 6


@pytest.mark.parametrize(
    "silly",
    few(
        [
            lambda f: replace(f, gain=1.3 * f.gain),
            lambda f: replace(f, gain=0.9 * f.gain),
            lambda f: replace(f, height=0.0),
            lambda f: replace(f, height=2 * f.height),
            lambda f: replace(f, Pi=10 * f.Pi),
            lambda f: replace(f, Pi=0 * f.Pi),
        ],
        quick=2,
    ),
)
def test_a_bound_made_of_a_bad_schedule_is_a_bound_that_is_loose(
    silly, line: tuple[Fitted, float], few_draws: None
) -> None:
    """Whatever the martingale is made of, nothing costs less; nothing is better than what is fitted."""
    fitted, good = line
    found = bound_schedules(UNIT, UNIT, UNIT, 4.0, silly(fitted), 0.9999)
    assert 0 <= found.gain <= solve_optimal(UNIT, UNIT, UNIT, 4.0).cost
    assert found.gain < good


def test_the_conditional_means_of_the_martingale_are_those_of_draws() -> None:
    """Of the bell in closed form, of the rest over given noises."""
    draws = np.random.default_rng(2)
    F, noise, Gamma = PLANE
    root = np.linalg.cholesky(noise)
    errors = 0.5 * draws.standard_normal((3, 5, 2))
    w = draws.standard_normal((3, 20_000, 2)) @ root.T
    for narrow in (1e-3, 1.0, 1e3):
        game = Martingale(F, noise, Gamma, Fitted(2.0, 3.0, narrow * np.linalg.inv(noise), 3.0))
        bell, off = game.now((errors @ F.T)[:, :, None] + w[:, None])
        assert off.mean(axis=2) == pytest.approx(game.after(errors, w), rel=1e-9, abs=1e-12)
        spread = bell.std(axis=2) / np.sqrt(w.shape[1])
        if narrow <= 1:  # else hardly a draw falls into the bell
            assert (np.abs(bell.mean(axis=2) - game.bell_after(errors)) < 5 * spread + 1e-9).all()


def test_the_conditional_means_are_exact_for_forms_of_large_entries() -> None:
    """One noise drives four slow modes: unsent errors nearly lie on a line, and entries of Π exceed 1e12."""
    draws = np.random.default_rng(3)
    F = np.diag([1.0, 0.999, 0.997, 0.994]) + np.diag([0.003, 0.003, 0.003], 1)
    half = np.ones((4, 1))
    reached = np.hstack([np.linalg.matrix_power(F, k) @ half for k in range(8)])
    modes, sizes, _ = np.linalg.svd(reached)
    Pi = modes / sizes**2 @ modes.T
    assert np.abs(Pi).max() > 1e12
    errors = draws.standard_normal((3, 5, 8)) @ reached.T
    w = draws.standard_normal((3, 20_000, 1)) @ half.T
    game = Martingale(F, half @ half.T, 0.01 * np.eye(4), Fitted(2.0, 3.0, Pi, 3.0))
    bell, off = game.now((errors @ F.T)[:, :, None] + w[:, None])
    assert off.mean(axis=2) == pytest.approx(game.after(errors, w), rel=1e-6)
    assert (np.abs(bell.mean(axis=2) - game.bell_after(errors)) < 5 * bell.std(axis=2) / np.sqrt(20_000) + 1e-9).all()


def test_a_bound_is_never_more_than_sending_always() -> None:
    """At a price that nothing is worth waiting for: the price, nearly."""
    price = 1e-3
    found = bound_schedules(UNIT, UNIT, UNIT, price, fit_schedule(UNIT, UNIT, UNIT, price), 0.9999)
    assert 0.9 * price <= found.gain <= price


def test_what_silence_may_never_cost_is_refused() -> None:
    """An error that the next check forgets, at a price of many: keeping it is hardly worse than sending it."""
    F, price = 0 * UNIT, 10.0
    fitted = fit_schedule(F, UNIT, UNIT, price)
    with pytest.raises(
        ProblemError, match=r"more than 4096 checks may pass without a send .*; expected a lower price, or"
    ):
        bound_schedules(F, UNIT, UNIT, price, fitted, 0.999)


@cache
def scalar(k: int, many: int) -> tuple[np.ndarray, float, Fitted, float]:
    """Return one of many scalars: its growth, the price, the nearly best schedule, and the least mean cost."""
    F, price = np.array([[0.8 + 0.4 * k / many]]), 2.0 * (1 + k)
    return F, price, fit_schedule(F, UNIT * (1 + k), UNIT, price), solve_optimal(F, UNIT * (1 + k), UNIT, price).cost


def scalars(many: int, seed: int) -> tuple[list[tuple[float, dual.SampledDual]], float]:
    """Return what draws tell of different scalars, weighted, and the sum of their least mean costs by quadrature."""
    terms: list[tuple[float, dual.SampledDual]] = []
    exact = 0.0
    for k in range(many):
        F, price, fitted, least = scalar(k, many)
        found = dual.sample_dual(F, UNIT * (1 + k), UNIT, price, fitted, 0.9, [seed, k], 1e-2 * fitted.gain)
        terms.append((1.0 / (1 + k), found))
        exact += least / (1 + k)
    return terms, exact


@pytest.mark.evidence
def test_a_sum_of_bounds_is_a_bound_and_above_the_sum_of_its_parts() -> None:
    """Each part at a share of the risk says less than the whole; estimates agree with quadrature."""
    many, confidence = 6, 0.999
    terms, exact = scalars(many, 0)
    found = dual.bound_sum(terms, confidence)
    parts = sum(dual.bound_sum([term], 1 - (1 - confidence) / many) for term in terms)
    assert parts < found <= exact
    assert found > 0.98 * exact
    for _, one in terms:
        assert 0 < one.least < one.most <= 1
    assert dual.bound_sum([], confidence) == 0


@pytest.mark.evidence
def test_a_sum_of_bounds_is_above_the_optimum_no_more_often_than_it_says() -> None:
    """200 seeds of six scalars at a confidence of 90 %: at most 20 and four standard deviations are above."""
    found = [scalars(6, seed) for seed in range(200)]
    assert sum(dual.bound_sum(terms, 0.9) > exact for terms, exact in found) <= 20 + 4 * np.sqrt(18)
