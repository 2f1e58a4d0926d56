"""Intervals between sends on a clock, and the best rates of errors that share a channel."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taciturn_channel.classes import Clocked, LoopClass, allocate, allocate_slots

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


@pytest.mark.evidence
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


def after_a_send(turns: list[bool]) -> list[bool]:
    """Return a repeated pattern from the step after a send on."""
    begin = turns.index(True) + 1
    return turns[begin:] + turns[:begin]


def cheapest_schedule(errors: list[Clocked], capacity: int, longest: int) -> float:
    """Return the least cost per step of all schedules of one loop each that repeat after at most so many steps."""
    best = np.inf
    choices = [set(sent) for sent in itertools.combinations(range(len(errors)), capacity)]
    for length in range(1, longest + 1):
        for schedule in itertools.product(choices, repeat=length):
            if set().union(*schedule) == set(range(len(errors))):
                costs = [mean_cost(one, after_a_send([i in sent for sent in schedule])) for i, one in enumerate(errors)]
                best = min(best, sum(costs))
    return best


def test_the_bound_by_the_mean_load_is_below_every_schedule_and_slots_of_their_own_are_a_schedule() -> None:
    """Three integrators on one slot, with different noise: the mean load allows more than any order of the sends."""
    unit = np.eye(1)
    errors = [Clocked(unit, noise * unit, unit) for noise in (1.0, 4.0, 8.0)]
    apart = [LoopClass(one, 1) for one in errors]
    assert allocate(apart, 1).costs.sum() == pytest.approx(10.5)
    assert cheapest_schedule(errors, 1, 6) == pytest.approx(67 / 6)
    assert allocate_slots(apart, 1) == np.inf
    calm = errors[0]
    same = 3 * float(allocate([LoopClass(calm, 3)], 2).costs[0])
    assert allocate_slots([LoopClass(calm, 1), LoopClass(calm, 2)], 2) == pytest.approx(same)
    assert cheapest_schedule([calm] * 3, 2, 3) == pytest.approx(same)


@EXAMPLES
@given(st.integers(0, 2**32 - 1), st.integers(1, 12))
def test_slots_of_their_own_cost_no_less_than_the_bound_and_what_each_division_costs(seed: int, capacity: int) -> None:
    """All divisions of the slots among three classes, some of which check at every other step."""
    draws = np.random.default_rng(seed)
    sharers = [LoopClass(error(seed + i), int(draws.integers(1, 7)), int(draws.integers(1, 3))) for i in range(3)]
    found = allocate_slots(sharers, capacity)
    assert found >= float(allocate(sharers, capacity).costs @ [one.count for one in sharers]) * (1 - 1e-9)
    best = np.inf
    for slots in itertools.product(range(capacity + 1), repeat=3):
        if sum(slots) > capacity:
            continue
        total = 0.0
        for one, mine in zip(sharers, slots, strict=True):
            for phase in range(one.every):
                size = len(range(phase, one.count, one.every))
                total += size * one.error.cost(min(1.0, mine / size)) / one.every if size > mine else 0.0
        best = min(best, total)
    assert found == best or found == pytest.approx(best, rel=1e-9, abs=1e-12)
