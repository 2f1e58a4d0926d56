"""Inputs held for several steps: lifting, and the cost against the moments of the closed loop."""

# ruff: noqa: SIM300 - ruff takes matrices, which carry their paper symbols, for constants
from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from drawn import law
from hypothesis import assume
from hypothesis import strategies as st

from taciturn._modes import radius
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.periodic import Held, cycles, lift
from taciturn.lqg.riccati import regulate
from taciturn.lqg.sampling import sample

seeds = st.integers(0, 2**32 - 1)


def solved(c, seen, intervals):
    """Return the best gains of a cycle of intervals, and their cost per step."""
    held = Held(c.A, c.B, c.Q, c.R, c.N, seen.gain @ seen.innovation @ seen.gain.T)
    found = held.solve(intervals)
    return found.gains, found.cost + np.sum(c.Q * seen.posterior)


def moments_cost(c, seen, gains, intervals):
    """Return the average cost from the second moments of (x, x̂, held u); None if the loop hardly decays.

    Independent of the theory under test: the loop is written down step by step, with its timing, and its
    periodic covariance solved for.
    """
    n, m = c.B.shape
    p = len(c.C)
    gain = seen.gain
    x = np.hstack([c.A, np.zeros((n, n)), c.B])
    predicted = np.hstack([np.zeros((n, n)), c.A, c.B])
    estimate = predicted + gain @ c.C @ (x - predicted)
    hold = np.vstack([x, estimate, np.hstack([np.zeros((m, 2 * n)), np.eye(m)])])
    noise = np.vstack([np.eye(n, n + p), np.hstack([gain @ c.C, gain]), np.zeros((m, n + p))])
    entering = noise @ scipy.linalg.block_diag(c.W, c.V) @ noise.T
    maps, noises = [], []
    for interval, L in zip(intervals, [*gains[1:], gains[0]], strict=True):  # right after an update, to the next
        renew = np.eye(2 * n + m)
        renew[2 * n :] = np.hstack([np.zeros((m, n)), L, np.zeros((m, m))])
        maps += [hold] * (interval - 1) + [renew @ hold]
        noises += [entering] * (interval - 1) + [renew @ entering @ renew.T]
    total, added = np.eye(2 * n + m), np.zeros_like(hold)
    for F, G in zip(maps, noises, strict=True):
        total, added = F @ total, F @ added @ F.T + G
    if radius(total) >= 0.98:
        return None
    moment = scipy.linalg.solve_discrete_lyapunov(total, added)  # right after an update
    weight = np.block([[c.Q, np.zeros((n, n)), c.N], [np.zeros((n, 2 * n + m))], [c.N.T, np.zeros((m, n)), c.R]])
    cost = 0.0
    for F, G in zip(maps, noises, strict=True):
        cost += np.sum(weight * moment) / len(maps)
        moment = F @ moment @ F.T + G
    return cost


CYCLES = st.lists(st.integers(1, 4), min_size=1, max_size=3)


@law(20, 300, seed=seeds, intervals=CYCLES)
def test_the_cost_is_that_of_the_moments_of_the_closed_loop(draw, seed, intervals):
    """The filter runs at every step, the input is renewed after each interval from the filtered estimate."""
    c = draw(seed)
    seen = steady_filter(c.A, c.C, c.W, c.V)
    gains, cost = solved(c, seen, intervals)
    expected = moments_cost(c, seen, gains, intervals)
    assume(expected is not None)
    assert cost == pytest.approx(expected, rel=1e-6)


@law(8, 100, seed=seeds)
def test_renewing_at_every_step_is_all_time_control(draw, seed):
    """For k = 1 the cost is tr(QΣ) + tr(K(Σ̃−Σ))."""
    c = draw(seed)
    seen, control = steady_filter(c.A, c.C, c.W, c.V), regulate(c.A, c.B, c.Q, c.R, c.N)
    (gain,), found = solved(c, seen, (1,))
    cost = np.trace(c.Q @ seen.posterior) + np.trace(control.K @ (seen.prior - seen.posterior))
    assert found == pytest.approx(cost, rel=1e-7)
    assert gain == pytest.approx(control.L, rel=1e-9, abs=1e-9)


@law(8, 100, seed=seeds, intervals=CYCLES)
def test_no_other_gains_of_the_same_cycle_cost_less(draw, seed, intervals):
    """Disturbing the optimal gains can only raise the cost of the moments."""
    c = draw(seed)
    seen = steady_filter(c.A, c.C, c.W, c.V)
    gains, cost = solved(c, seen, intervals)
    disturbed = moments_cost(c, seen, gains + 0.01 * c.rng.normal(size=gains.shape), intervals)
    assume(disturbed is not None)
    assert cost <= disturbed * (1 + 1e-6)


@law(8, 100, seed=seeds)
def test_renewing_less_often_in_multiples_costs_more(draw, seed):
    """A controller of period 2k is one of period k that wastes every second update."""
    c = draw(seed)
    seen = steady_filter(c.A, c.C, c.W, c.V)
    costs = [solved(c, seen, (every,))[1] for every in (1, 2, 4)]
    assert costs[0] <= costs[1] * (1 + 1e-9)
    assert costs[1] <= costs[2] * (1 + 1e-9)


@law(8, 100, seed=seeds, turn=st.integers(1, 2))
def test_a_cycle_may_begin_anywhere_and_repeat(draw, seed, turn):
    """(1, 2, 4) costs what its rotations cost, and twice the same cycle what it costs once."""
    c = draw(seed)
    seen, cycle = steady_filter(c.A, c.C, c.W, c.V), (1, 2, 4)
    cost = solved(c, seen, cycle)[1]
    assert solved(c, seen, cycle[turn:] + cycle[:turn])[1] == pytest.approx(cost, rel=1e-8)
    assert solved(c, seen, cycle * 2)[1] == pytest.approx(cost, rel=1e-8)


@law(8, 100, seed=seeds, sends=st.integers(1, 4))
def test_screening_finds_the_costs_of_all_cycles_at_once(draw, seed, sends):
    """The doubling algorithm for a stack of cycles, against one Riccati equation for each."""
    c = draw(seed)
    seen = steady_filter(c.A, c.C, c.W, c.V)
    held = Held(c.A, c.B, c.Q, c.R, c.N, seen.gain @ seen.innovation @ seen.gain.T)
    listed = [cycle for cycle in cycles(range(1, 4), sends) if len(cycle) == sends]
    costs = [held.solve(cycle).cost for cycle in listed]
    assert held.screen(listed) == pytest.approx(costs, rel=1e-5)


@law(8, 100, seed=seeds, every=st.integers(1, 6))
def test_lifting_is_the_sum_over_the_steps(draw, seed, every):
    """Every field of the lifted problem, term by term."""
    c = draw(seed)
    n, m = c.B.shape
    found = lift(c.A, c.B, c.Q, c.R, c.N, c.W, every)
    state, u = np.eye(n, n + m), np.hstack([np.zeros((m, n)), np.eye(m)])
    weight, noise, cost = np.zeros((n + m, n + m)), np.zeros((n, n)), 0.0
    for _ in range(every):
        weight += state.T @ c.Q @ state + u.T @ c.R @ u + state.T @ c.N @ u + u.T @ c.N.T @ state
        cost += np.sum(c.Q * noise)
        state, noise = c.A @ state + c.B @ u, c.A @ noise @ c.A.T + c.W
    assert np.hstack([found.A, found.B]) == pytest.approx(state, rel=1e-10, abs=1e-11 * np.abs(state).max())
    joint = np.block([[found.Q, found.N], [found.N.T, found.R]])
    assert joint == pytest.approx(weight, rel=1e-10, abs=1e-11 * np.abs(weight).max())
    assert found.W == pytest.approx(noise, rel=1e-10)
    assert found.noise_cost == pytest.approx(cost, rel=1e-10)


def test_holding_a_sampled_plant_with_its_state_measured_is_sampling_it_more_slowly():
    """With the full state the cost per unit of time is that of the longer period, noise included."""
    A, B, N = np.array([[0.0, 1], [0.5, 0]]), np.array([[0.0], [1]]), np.array([[0.1], [0.0]])
    fine = sample(A, B, np.eye(2), [[0.1]], N, np.eye(2), 0.05)
    coarse = sample(A, B, np.eye(2), [[0.1]], N, np.eye(2), 0.5)
    held = Held(fine.A, fine.B, fine.Q, fine.R, fine.N, fine.W).solve((10,))
    control = regulate(coarse.A, coarse.B, coarse.Q, coarse.R, coarse.N)
    expected = (np.trace(control.K @ coarse.W) + coarse.noise_cost) / 0.5
    assert (held.cost + fine.noise_cost) / 0.05 == pytest.approx(expected, rel=1e-11)


def test_a_period_that_hides_an_unstable_mode_is_refused():
    """Held for two steps, an input cannot move an eigenvalue −1: its two effects cancel."""
    with pytest.raises(
        UnstableError, match=r"holding the input for 2 steps.*eigenvalue 1, which is uncontrollable through B"
    ):
        Held([[-1.0]], [[1.0]], [[1.0]], [[1.0]], [[0.0]], [[1.0]]).solve((2,))


def test_a_hold_over_which_the_plant_overflows_is_refused():
    """A sentence instead of inf."""
    with pytest.raises(ProblemError, match="hold the input for fewer steps"):
        lift([[2.0]], [[1.0]], [[1.0]], [[1.0]], [[0.0]], [[1.0]], 5000)


def test_a_hold_of_no_steps_is_refused():
    """The period is a whole number of at least one."""
    with pytest.raises(ProblemError, match="every is 0"):
        lift([[2.0]], [[1.0]], [[1.0]], [[1.0]], [[0.0]], [[1.0]], 0)
