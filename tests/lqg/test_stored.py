"""The cost of a stored loop: its enclosure contains the value at 1,024 bits, and guarantees are above it."""

import numpy as np
import pytest
from flint import arb, arb_mat
from scipy.linalg import block_diag

from taciturn import ContinuousPlant, Controller, Cost, Plant, design
from taciturn._precision import precision
from taciturn.design.certainty import design_certainty
from taciturn.lqg.discrete import discretise
from taciturn.lqg.enclosures import Balls
from taciturn.lqg.stored import cost_of_filter

BITS, DOUBLINGS = 1024, 40


def exact(matrix):
    """Return a matrix of doubles without an error."""
    return arb_mat(len(matrix), matrix.shape[1], matrix.ravel().tolist())


def reference(problem, steady, L):
    """Return the cost by the sum of the covariances of (x, x̂⁻), in other coordinates than those of the library."""
    p, n = problem.plant, problem.plant.states
    if problem.exact is None:
        A, B, Q, R, N, W = map(exact, (p.A, p.B, problem.Q, problem.R, problem.N, p.W))
    else:
        A, B, Q, R, N, W, _ = (part._balls.mid() for part in problem.exact.build(Balls))
    stored, own, C, gain, V, L = map(exact, (p.A, p.B, p.C, steady.gain, p.V, L))
    left = exact(np.eye(n)) - gain * C
    blocks = [[A + B * L * gain * C, B * L * left], [(stored + own * L) * gain * C, (stored + own * L) * left]]
    F = arb_mat([a + b for row in blocks for a, b in zip(row[0].tolist(), row[1].tolist(), strict=True)])
    J = arb_mat((B * L * gain).tolist() + ((stored + own * L) * gain).tolist())
    T = arb_mat([a + b for a, b in zip((L * gain * C).tolist(), (L * left).tolist(), strict=True)])
    G = exact(np.eye(2 * n, n))
    S, power = G * W * G.transpose() + J * V * J.transpose(), F
    for _ in range(DOUBLINGS):
        S, power = (S + power * S * power.transpose()).mid(), (power * power).mid()
    x, D = G.transpose(), L * gain
    M = G * Q * x + G * N * T + T.transpose() * N.transpose() * x + T.transpose() * R * T
    return sum((M * S)[i, i] for i in range(2 * n)) + sum((D.transpose() * R * D * V)[i, i] for i in range(len(p.C)))


def drawn(seed):
    """Return a random unstable problem with a cross term and a filter, sampled if the seed is odd."""
    draws = np.random.default_rng(seed)
    n, m, p = int(draws.integers(1, 6)), 2, 2
    A, half = draws.normal(size=(n, n)), draws.normal(size=(n + m, n + m))
    weight = half @ half.T
    cost = Cost(weight[:n, :n], weight[n:, n:], weight[:n, n:])
    rest = draws.normal(size=(n, m)), 0.3 * np.eye(n), draws.normal(size=(p, n)), 0.1 * np.eye(p)
    if seed % 2:
        B, W, C, V = rest
        return ContinuousPlant(A, B, W, C=C, V=V), cost, 0.1
    return Plant(1.2 * A / np.abs(np.linalg.eigvals(A)).max(), *rest), cost, None


@pytest.mark.parametrize("seed", range(8))
def test_the_enclosure_of_a_stored_loop_contains_its_value_at_1024_bits_and_guarantees_are_above(seed):
    """Unstable and sampled plants, with cross terms and filters."""
    plant, cost, period = drawn(seed)
    problem = discretise(plant, cost, period)
    found = design_certainty("lqg", problem)
    assert found.proved.radius <= 1e-9 * found.proved.value
    policy = design.lqg(plant, cost, theta=0.1, period=period)
    with precision(BITS):
        value = reference(problem, found.filter, found.regulator.L)
        assert abs(value - arb(found.proved.value)) <= arb(found.proved.radius)
        claimed = (arb(1.1) * value + arb(problem.noise_cost)) / arb(problem.tick if period else 1.0)
        assert arb(policy.guarantee.cost) >= claimed
    assert policy.guarantee.proved


@pytest.mark.parametrize("others", [0, 24])
def test_a_trace_that_cancels_is_proved_with_more_digits(others: int):
    """The noise moves only a direction in which K is 1e-13 of its largest entry: doubles leave no digit of tr(KW)."""
    T = np.array([[0.6, 0.8], [-0.8, 0.6]])
    A, q = T @ np.diag([1.5, 0.5]) @ T.T, T @ np.diag([1.0, 1e-13]) @ T.T
    quiet, none = T[:, 1:] @ T[:, 1:].T, np.zeros((others, others))
    plant = Plant(
        block_diag(A, none), np.eye(2 + others)[:, :2], block_diag((quiet + quiet.T) / 2, none), np.eye(2, 2 + others)
    )
    problem = discretise(plant, Cost(block_diag((q + q.T) / 2, none), np.eye(2)), None)
    found = design_certainty("lqg", problem)
    with precision(BITS):
        value = reference(problem, found.filter, found.regulator.L)
        assert abs(value - arb(found.proved.value)) <= arb(found.proved.radius)
    assert found.proved.radius <= 1e-9 * found.proved.value


def test_the_radius_covers_a_gain_that_is_not_the_best_one():
    """A gain that is wrong by 0.1 costs more, and its own cost is enclosed."""
    problem = discretise(Plant([[1.2]], [[1.0]], [[1.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]]), None)
    found = design_certainty("lqg", problem)
    L = found.regulator.L + 0.1
    worse = cost_of_filter(problem, found.filter, L)
    with precision(BITS):
        assert abs(reference(problem, found.filter, L) - arb(worse.value)) <= arb(worse.radius)
    assert worse.lower > found.proved.upper


def test_a_given_controller_has_a_proved_cost():
    """x⁺ = x/2 + u + w with u = −y/4 and y = x: the variance is 1/(1 − 1/16)."""
    kept = Controller(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[-0.25]]))
    policy = design.excess(Plant([[0.5]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]]), theta=0.1, controller=kept)
    assert abs(policy.cost_all_time - 17 / 15) <= policy.theory.cost_all_time_error + 2**-52 < 1e-9
    assert policy.guarantee.proved
    assert policy.guarantee.cost >= 1.1 * 17 / 15
