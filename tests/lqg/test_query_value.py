"""The value of a query: against its definition in sixty digits, in closed form and followed step by step."""

from __future__ import annotations

import numpy as np
import pytest
from drawn import law
from hypothesis import assume
from hypothesis import strategies as st
from watched import SEEDS, TIMES, follow, random_plant, semidefinite, sixty_digits

from taciturn import Cost, Plant, UnstableError, design
from taciturn._arrays import block_diagonal
from taciturn._modes import radius
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.queries import Predictor, QueryValue, Weights, schedule_queries

times = pytest.mark.parametrize("time", TIMES, ids=str)
KINDS = ["output", "full state", "singular W", "some outputs without noise"]


@pytest.mark.parametrize("discount", [1.0, 0.7])
@pytest.mark.parametrize("kind", KINDS)
@law(2, 8, seed=SEEDS)
def test_the_value_of_a_query_is_the_sum_of_what_every_later_error_costs_less(kind, discount, seed):
    """Average and discount, errors and weights of any rank, against sixty digits of plain subtraction."""
    plant = random_plant(seed, kind)
    rng, n = np.random.default_rng(seed + 1), plant.states
    Sigma, P = (semidefinite(rng, n, int(rng.integers(1, n + 1))) for _ in range(2))
    found = QueryValue(Predictor(plant), Weights(P, discount))(Sigma)
    assert found == pytest.approx(sixty_digits(plant, Sigma, P, discount), rel=1e-9, abs=1e-13 * np.trace(P))
    assert found >= 0


def test_a_query_is_worth_the_same_where_no_noise_renews_the_error():
    """A slow state without noise, whose steady covariance is zero: no block of many steps stands for its sum."""
    plant = Plant([[0.88138602]], [[1.0]], [[0.0]], [[-0.72926391]], [[0.82023861]])
    Sigma, P = np.array([[0.51660156]]), np.array([[0.00390625]])
    found = QueryValue(Predictor(plant), Weights(P))(Sigma)
    assert found == pytest.approx(sixty_digits(plant, Sigma, P), rel=1e-12)


@pytest.mark.parametrize("kind", KINDS)
@law(2, 8, seed=SEEDS)
def test_of_a_mission_only_the_errors_until_its_end_count(kind, seed):
    """At step k the weights of k + 1 … N − 1 are summed, each with its own error; the last query is worth nothing."""
    plant = random_plant(seed, kind)
    rng, n = np.random.default_rng(seed + 1), plant.states
    Sigma, P = semidefinite(rng, n), np.array([semidefinite(rng, n) for _ in range(9)])
    for tick in (0, 4, 7, 8):
        plain = sixty_digits(plant, Sigma, P[tick + 1 :]) if tick < 8 else 0.0
        assert QueryValue(Predictor(plant), Weights(P))(Sigma, tick) == pytest.approx(plain, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(
    "A", [np.array([[0.99]]), np.diag([0.99, 0.985]), np.array([[0.99, 1.0], [0.0, 0.99]])], ids=str
)
def test_the_tail_of_a_slow_filter_is_summed_at_once(A):
    """An error that fades by 1 % a step: the rest of the sum is one Lyapunov equation, and agrees with every term."""
    n = len(A)
    plant = Plant(A, np.eye(n), 1e-6 * np.eye(n), np.eye(1, n) + np.eye(1, n, n - 1), [[10.0]])
    steady = steady_filter(A, plant.C, plant.W, plant.V)
    assert 0.98 < radius(A - A @ steady.gain @ plant.C) < 1
    value = QueryValue(Predictor(plant), Weights(np.eye(n)))(1.01 * steady.prior)
    assert value == pytest.approx(sixty_digits(plant, 1.01 * steady.prior, np.eye(n), terms=2500), rel=1e-9)


BIASED = Plant(  # a sensor whose bias wanders slowly, a second one without bias
    [[0.9, 0.1, 0.0], [0.0, 0.95, 0.0], [0.0, 0.0, 1.0]], [[0.005], [0.1], [0.0]], np.diag([1e-4, 4e-4, 1e-8]),
    [[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]], 1e-3 * np.eye(2),
)  # fmt: skip
BIAS_FREE = np.diag([1.0, 0.1, 0.0])


@pytest.mark.parametrize("discount", [1.0, 0.999])
def test_few_steps_of_a_slow_filter_have_the_sum_of_all(discount: float) -> None:
    """Thousands of steps, of which a few hundred are summed, for covariances of any size."""
    value, steady = (
        QueryValue(Predictor(BIASED), Weights(BIAS_FREE, discount)),
        steady_filter(BIASED.A, BIASED.C, BIASED.W, BIASED.V),
    )
    flow = value._flow
    assert flow is not None
    assert len(value._weighed) < len(flow.powers) / 10
    dense = QueryValue(Predictor(BIASED), Weights(BIAS_FREE, discount))
    dense._weighed, dense._observed = flow.weighed(BIAS_FREE, discount), flow.observed
    for Sigma in (steady.prior, 0.3 * steady.prior, 7 * steady.prior, BIASED.W, np.eye(3)):
        assert value(Sigma) == pytest.approx(dense(Sigma), rel=1e-11)


def test_a_schedule_is_computed_once_for_designs_with_other_triggers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every trial of a search for theta has the same queries."""
    plant, cost = (
        Plant([[0.9, 0.1], [0.0, 0.95]], [[0.0], [0.1]], np.diag([1e-4, 4e-4]), [[1.0, 0.0]], [[1e-3]]),
        Cost(np.eye(2), [[0.05]]),
    )
    first = design.remote_lqg(plant, cost, theta=0.1, zeta=2e-3)
    monkeypatch.setattr(QueryValue, "__call__", lambda *_: pytest.fail("computed again"))
    second = design.remote_lqg(plant, cost, theta=0.2, zeta=2e-3)
    assert first.schedule is not None
    assert second.schedule is not None
    assert np.array_equal(first.schedule.queries, second.schedule.queries)
    with pytest.raises(ValueError, match="read-only"):
        first.schedule.queries[0] = True


@law(5, 60, seed=SEEDS, discount=st.sampled_from([1.0, 0.6]))
def test_a_state_that_is_read_exactly_is_worth_the_error_it_ends(seed, discount):
    """C = I and V = 0: h(Σ) = α tr(PAΣA'), whatever the ranks of noise, error and weight."""
    plant, rng = random_plant(seed, "full state", 4), np.random.default_rng(seed + 1)
    n = plant.states
    Sigma, P = (semidefinite(rng, n, int(rng.integers(1, n + 1))) for _ in range(2))
    worth = discount * np.trace(P @ plant.A @ Sigma @ plant.A.T)
    assert QueryValue(Predictor(plant), Weights(P, discount))(Sigma) == pytest.approx(worth, rel=1e-9, abs=1e-12)


def test_a_query_that_tells_nothing_is_worth_nothing() -> None:
    """Where the output shows nothing, where nothing is uncertain, and where no error costs anything."""
    blind = Plant(np.diag([0.5, 0.9]), np.eye(2), np.eye(2), np.zeros((1, 2)), [[1.0]])
    seen = Plant(np.diag([0.5, 1.1]), np.eye(2), np.eye(2), [[1.0, 1.0]], [[1.0]])
    for plant, Sigma, P in (
        (blind, np.eye(2), np.eye(2)),
        (seen, np.zeros((2, 2)), np.eye(2)),
        (seen, np.eye(2), np.zeros((2, 2))),
    ):
        for weights in (Weights(P), Weights(P, 0.5), Weights(np.array([P] * 5))):
            assert QueryValue(Predictor(plant), weights)(Sigma) == 0.0


@times
@law(2, 15, seed=SEEDS)
def test_the_closed_form_of_a_query_is_what_following_it_tick_by_tick_gives(time, seed):
    """Two computations of h over random plants, from a vague start, a known one and the middle of a silence."""
    plant, weights = random_plant(seed), priced(seed, time)
    closed, followed = QueryValue(Predictor(plant), weights), QueryValue(Predictor(plant), weights)
    followed._flow = None
    assume(closed._flow is not None)
    for Sigma in (1e4 * plant.covariance, np.zeros_like(plant.A), follow(plant, follow(plant, plant.W, True), False)):
        for tick in (0, 3):
            assert closed(Sigma, tick) == pytest.approx(followed(Sigma, tick), rel=1e-8, abs=1e-12)


def priced(seed: int, time: dict) -> Weights:
    """Return random weights of an error, for an average, a discounted sum or each step of a horizon."""
    rng, plant = np.random.default_rng(seed + 4), random_plant(seed)
    steps = time.get("horizon")
    if steps is None:
        return Weights(semidefinite(rng, plant.states), time.get("discount", 1.0))
    return Weights(np.array([semidefinite(rng, plant.states) for _ in range(steps)]))


def test_a_start_that_stays_where_it_is_has_no_closed_form_and_the_right_value() -> None:
    """No noise moves an unstable state that is known: its covariance stays 0, whatever the steady filter's is."""
    plant = Plant(np.diag([1.5, 0.5]), np.eye(2), np.diag([0.0, 1.0]), [[1.0, 1.0]], [[1.0]])
    stable = Plant([[0.5]], [[1.0]], [[1.0]], [[1.0]], [[1.0]])
    found = QueryValue(Predictor(plant), Weights(np.eye(2)))(np.diag([0.0, 2.0]))
    assert found == pytest.approx(QueryValue(Predictor(stable), Weights(np.eye(1)))(2 * np.eye(1)), rel=1e-9)


@pytest.mark.parametrize("discount", [1.0, 0.99])
def test_a_known_state_that_does_not_decay_changes_no_value(discount: float) -> None:
    """A set-point costs, and has no error: a query is worth the same without it, over the slow filter of a bias too."""
    known = (
        block_diagonal(BIASED.A, np.eye(1)),
        np.vstack([BIASED.B, [[0.0]]]),
        block_diagonal(BIASED.W, np.zeros((1, 1))),
    )
    plant = Plant(*known, np.hstack([BIASED.C, np.zeros((2, 1))]), BIASED.V)
    row = np.array([[1.0, 0.3, 0.2, -2.0]])
    P = row.T @ row
    Sigma = steady_filter(BIASED.A, BIASED.C, BIASED.W, BIASED.V).prior
    found = QueryValue(Predictor(plant), Weights(P, discount))(block_diagonal(Sigma, np.zeros((1, 1))))
    assert found == pytest.approx(QueryValue(Predictor(BIASED), Weights(P[:3, :3], discount))(Sigma), rel=1e-8)


@times
def test_a_known_state_changes_no_schedule(time: dict) -> None:
    """For an average, a discounted sum and a horizon; the covariances have a row of zeros more."""
    plant = Plant([[0.9, 0.1], [0.0, 1.0]], [[0.2], [0.0]], np.diag([0.01, 1e-3]), [[1.0, 0.0]], [[0.02]])
    more = Plant(
        block_diagonal(plant.A, np.eye(1)), np.vstack([plant.B, [[0.0]]]), block_diagonal(plant.W, np.zeros((1, 1))),
        np.hstack([plant.C, [[0.0]]]), plant.V,
    )  # fmt: skip
    P, first = np.array([[1.0, 0.5, -2.0], [0.5, 1.0, -1.0], [-2.0, -1.0, 9.0]]), np.diag([0.02, 0.01])
    each = [P[:2, :2], P]
    if "horizon" in time:
        each = [np.array([one] * time["horizon"]) for one in each]
    short, long = (
        schedule_queries(one, Weights(weight, time.get("discount", 1.0)), 0.01, start)
        for one, weight, start in zip(
            (plant, more), each, (first, block_diagonal(first, np.zeros((1, 1)))), strict=True
        )
    )
    assert time.get("horizon") == 1 or 0 < short.queries.sum() < len(short.queries)
    assert np.array_equal(long.queries, short.queries)
    assert np.allclose(long.value, short.value, rtol=1e-9)
    assert np.array_equal(long.covariance[:, :2, :2], short.covariance)
    assert not long.covariance[:, 2].any()


def test_an_error_that_no_later_query_removes_is_refused() -> None:
    """Measured exactly through a zero outside the unit circle, a state that was once missed is never known again."""
    plant = Plant([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], np.diag([0.0, 1.0]), [[-2.0, 1.0]])
    known = np.diag([0.0, 1.0])
    with pytest.raises(UnstableError, match=r"the value of a query is not finite, .*; expected .* or a discount"):
        QueryValue(Predictor(plant), Weights(np.eye(2)))(known)
    assert QueryValue(Predictor(plant), Weights(np.eye(2), 0.5))(known) > 0
