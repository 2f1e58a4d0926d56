"""The growth of moments of random linear systems, against the eigenvalues of the map that moves these moments."""

from __future__ import annotations

import math

import numpy as np
import pytest
from counts import few

from taciturn._arrays import pushed
from taciturn._modes import growth, normal_moments


@pytest.mark.parametrize("order", [2, 4])
@pytest.mark.parametrize("seed", range(12))
def test_the_growth_is_the_largest_eigenvalue(seed, order):
    """Of a map that applies one of two matrices at random."""
    rng = np.random.default_rng(seed)
    size = int(rng.integers(1, 5))
    F, G = rng.normal(size=(2, size, size)) * rng.uniform(0.2, 0.8)
    share = rng.uniform()

    def move(moments):
        return (1 - share) * pushed(F, moments, order) + share * pushed(G, moments, order)

    unit = np.eye(size**order).reshape(-1, *[size] * order)
    matrix = np.stack([move(one).ravel() for one in unit], axis=1)
    largest = np.abs(np.linalg.eigvals(matrix)).max()
    assert math.log(growth(move, normal_moments(size, order))) == pytest.approx(math.log(largest), rel=5e-3, abs=1e-6)


@pytest.mark.parametrize("pole", few([0.9, 1.0, 1.05], 1, 1))
def test_a_defective_eigenvalue_does_not_stop_the_computation(pole):
    """Such as the common pole of a filter and of its copy, at which Arnoldi's method does not converge."""
    F = pole * np.eye(4) + np.eye(4, k=1)
    found = growth(lambda moments: pushed(F, moments, 4), normal_moments(4, 4))
    assert found == pytest.approx(pole**4, rel=0.01)  # the powers of a Jordan block grow faster, by polynomials


def test_moments_that_vanish_do_not_grow():
    """All of them are zero after as many steps as there are states."""
    assert growth(lambda moments: pushed(np.eye(2, k=1), moments, 2), normal_moments(2, 2)) == 0.0


def test_the_normal_moments_are_those_of_isserlis():
    """The sum over the pairings of four factors."""
    found = normal_moments(2, 4)
    assert (found[0, 0, 0, 0], found[0, 0, 1, 1], found[0, 1, 0, 1], found[0, 0, 0, 1]) == (3, 1, 1, 0)


@pytest.mark.parametrize("order", [2, 4])
def test_many_eigenvalues_of_one_modulus_are_found_at_once(order):
    """Turning modes at two links make beats that do not decay; eigenvalues of the whole matrix are the other way."""
    rng, turn = np.random.default_rng(3), 2.0
    turning = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    basis = rng.normal(size=(4, 4))
    blocks = np.zeros((4, 4))
    blocks[:2, :2], blocks[2:, 2:] = turning, turning @ turning @ turning
    F = 0.9 * basis @ blocks @ np.linalg.inv(basis)
    moves = 0

    def move(moments):
        nonlocal moves
        moves += 1
        return 0.7 * pushed(F, moments, order)

    found = growth(move, normal_moments(4, order))
    assert found == pytest.approx(0.7 * 0.9**order, rel=1e-5)
    assert moves < 100


def test_the_growth_over_a_bursty_link_is_that_of_the_whole_matrix():
    """A plant of three states whose packets are lost in bursts: fourth moments, in both states of the link."""
    rng = np.random.default_rng(5)
    F = [0.7 * rng.normal(size=(3, 3)) for _ in range(2)]
    turns, losses = np.array([[0.95, 0.05], [0.3, 0.7]]), (0.02, 0.8)

    def move(moments):
        each = [(1 - p) * pushed(F[0], X, 4) + p * pushed(F[1], X, 4) for p, X in zip(losses, moments, strict=True)]
        return np.tensordot(turns.T, np.stack(each), 1)

    start = np.stack([normal_moments(3, 4)] * 2)
    matrix = np.stack([move(one.reshape(start.shape)).ravel() for one in np.eye(start.size)], axis=1)
    assert growth(move, start) == pytest.approx(np.abs(np.linalg.eigvals(matrix)).max(), rel=1e-5)
