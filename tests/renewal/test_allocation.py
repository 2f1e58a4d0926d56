"""Intervals between sends on a clock, and the best rates of errors that share a channel."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taciturn.renewal.allocation import Clocked, LoopClass, allocate

EXAMPLES = settings(max_examples=30, deadline=None)


def error(seed: int) -> Clocked:
    """Return a random error, which grows or decays by itself."""
    draws = np.random.default_rng(seed)
    n = int(draws.integers(1, 4))
    F = draws.normal(size=(n, n))
    F *= draws.uniform(0.3, 1.3) / np.abs(np.linalg.eigvals(F)).max()
    noise, weigh = draws.normal(size=(n, n)), draws.normal(size=(n, n))
    return Clocked(F, noise @ noise.T, weigh @ weigh.T)


def mean_cost(clocked: Clocked, sends: list[bool]) -> float:
    """Return what a check costs on average if this pattern of sends is repeated, by following the covariance."""
    P, total = np.zeros_like(clocked.F), 0.0
    for sent in [*sends, *sends]:  # the second round begins where the first has ended
        P = clocked.F @ P @ clocked.F.T + clocked.noise
        total += 0.0 if sent else float(np.sum(clocked.Gamma * P))
        P = np.zeros_like(P) if sent else P
    return total / len(sends) / 2


@EXAMPLES
@given(st.integers(0, 2**32 - 1), st.integers(1, 7), st.integers(1, 5), st.integers(0, 4))
def test_a_rate_costs_what_taking_turns_of_two_intervals_costs(seed: int, k: int, once: int, more: int) -> None:
    """Between two whole intervals some of both are taken: the covariance of the error says what that costs."""
    clocked = error(seed)
    intervals = [k] * once + [k + 1] * more
    sends = [place == length - 1 for length in intervals for place in range(length)]
    assert clocked.cost(len(intervals) / len(sends)) == pytest.approx(mean_cost(clocked, sends), rel=1e-9, abs=1e-12)


@EXAMPLES
@given(st.integers(0, 2**32 - 1), st.floats(0.01, 30.0))
def test_the_best_interval_at_a_price_is_better_than_all_others(seed: int, price: float) -> None:
    """Nothing near it or far from it costs less, sends at their price included."""
    clocked = error(seed)
    price *= float(np.sum(clocked.Gamma * clocked.noise))
    best = clocked.interval(price)

    def total(interval: float) -> float:
        return clocked.cost(1 / interval) + price / interval

    least = min(total(k) for k in (*range(1, 60), 100.0, 1e3, np.inf))
    assert total(best) <= least * (1 + 1e-12)


@EXAMPLES
@given(st.integers(0, 2**32 - 1), st.integers(2, 4), st.floats(0.15, 0.95))
def test_no_other_rates_of_the_same_load_cost_less(seed: int, kinds: int, share: float) -> None:
    """The allocation loads the channel as asked, and random rates of that load cost as much or more."""
    draws = np.random.default_rng(seed)
    sharers = [
        LoopClass(error(int(draws.integers(2**32))), int(draws.integers(1, 9)), int(draws.integers(1, 4)))
        for _ in range(kinds)
    ]
    looks = np.array([sharer.count / sharer.every for sharer in sharers])
    counts = np.array([sharer.count for sharer in sharers])
    capacity = share * float(looks.sum())
    found = allocate(sharers, capacity)
    total = float(counts @ found.costs)
    assert found.rates @ looks <= capacity * (1 + 1e-9)
    if all(sharer.error.growth >= 1 for sharer in sharers):
        assert found.rates @ looks == pytest.approx(capacity)
    for _ in range(40):
        rates = draws.uniform(0.02, 1.0, kinds)
        for _ in range(60):  # scaled to the load, none above 1
            rates = np.minimum(rates * capacity / (rates @ looks), 1.0)
        costs = [s.error.cost(rate) / s.every for s, rate in zip(sharers, rates.tolist(), strict=True)]
        assert counts @ np.array(costs) >= total * (1 - 1e-9)


def test_all_send_always_where_there_is_room() -> None:
    """Nothing costs anything then, and a send has no price."""
    found = allocate([LoopClass(error(1), 3), LoopClass(error(2), 4, 2)], 5)
    assert found.rates.tolist() == [1.0, 1.0]
    assert found.price == 0.0
    assert found.costs.tolist() == [0.0, 0.0]


def test_the_least_rate_is_where_a_clock_costs_just_as_much() -> None:
    """At the rate a check costs at most the limit, at the next lower one more."""
    unit = np.eye(1)
    grows = Clocked(1.5 * unit, unit, unit)
    rate = grows.least_rate(1e6)
    assert grows.cost(rate) <= 1e6 < grows.cost(1 / (1 / rate + 1))


def test_what_overflows_is_infinite_and_no_error() -> None:
    """An unstable error that is hardly ever sent costs more than a number tells."""
    unit = np.eye(1)
    grows = Clocked(2.0 * unit, unit, unit)
    assert grows.cost(1 / 5000) == np.inf
    assert grows.cost(0.0) == np.inf
    assert Clocked(0.9 * unit, unit, unit).cost(0.0) == pytest.approx(1 / (1 - 0.81))


def test_a_stable_error_is_left_alone_above_a_price() -> None:
    """Where even an infinite interval is not worth a send, none is made: w∞ + Σ(w∞ − w_j) is that price."""
    unit = np.eye(1)
    clocked = Clocked(0.9 * unit, unit, unit)
    rest = clocked.forever + sum(clocked.forever - w for w in itertools.islice(_weights(), 2000))
    assert clocked.interval(1.001 * rest) == np.inf
    assert clocked.interval(0.9 * rest) < np.inf


def _weights() -> itertools.accumulate[float]:
    return itertools.accumulate(itertools.repeat(1.0), lambda w, one: 0.81 * w + one)
