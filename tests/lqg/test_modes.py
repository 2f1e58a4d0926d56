"""Modes that an input cannot move, and stationary sums."""

# ruff: noqa: SIM300 - ruff takes matrices, which carry their paper symbols, for constants
from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
import scipy.linalg
from drawn import law
from flint import arb_mat
from hypothesis import assume
from hypothesis import strategies as st
from systems import uncontrollable_modes

from taciturn._arrays import block_diagonal
from taciturn._modes import balancing, largest_cycle
from taciturn._rational import precision
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.equation import accumulate

seeds = st.integers(0, 2**32 - 1)


def entries(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Random multiples of 1/64, whose sums and products are exact."""
    return np.round(64 * rng.normal(size=shape)) / 64


def mixed(A: np.ndarray, B: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The same plant in coordinates in which each of some states has another one added to it."""
    for i, j in rng.integers(0, len(A), (len(A), 2)).tolist():
        if i != j:
            A, B = A.copy(), B.copy()
            A[i], B[i] = A[i] + A[j], B[i] + B[j]
            A[:, j] -= A[:, i]
    return A, B


@law(8, 100, seed=seeds, reached=st.integers(0, 4), fixed=st.integers(0, 4))
def test_the_fixed_modes_are_those_of_the_block_that_no_input_enters(seed, reached, fixed):
    """A hidden block structure is found again after a change of coordinates."""
    rng = np.random.default_rng(seed)
    n = reached + fixed
    A, B = entries(rng, n, n), entries(rng, n, 2)
    A[reached:, :reached], B[reached:] = 0, 0
    found = uncontrollable_modes(*mixed(A, B, rng))
    expected = np.linalg.eigvals(A[reached:, reached:])
    assert np.sort_complex(found) == pytest.approx(np.sort_complex(expected), abs=1e-7)


@law(8, 100, seed=seeds, n=st.integers(1, 7))
def test_balancing_is_that_of_lapack(seed, n):
    """Up to a common factor, also of sparse matrices in units that lie far apart."""
    rng = np.random.default_rng(seed)
    units = np.exp2(rng.integers(-30, 30, n))
    A = rng.normal(size=(n, n)) * (rng.random((n, n)) < 0.6) * units / units[:, None]
    theirs = scipy.linalg.matrix_balance(A, permute=False, separate=True)[1][0]
    assert balancing(A).tolist() == theirs.tolist()


@law(8, 100, seed=seeds, n=st.integers(1, 5))
def test_the_largest_mean_along_a_cycle_is_that_of_all_cycles(seed, n):
    """Of every order of some states in turn; the mean of a matrix without cycles is 0."""
    rng = np.random.default_rng(seed)
    A = np.exp(rng.normal(size=(n, n), scale=4.0)) * (rng.random((n, n)) < 0.4)
    cycles = (list(c) for k in range(1, n + 1) for c in permutations(range(n), k))
    best = max(np.prod(A[c, np.roll(c, -1)]) ** (1 / len(c)) for c in cycles)
    assert largest_cycle(A) == pytest.approx(best, rel=1e-12, abs=0)


def test_blocks_stand_on_the_diagonal():
    """Of any shapes, as scipy puts them; without any, nothing."""
    blocks = [np.arange(1.0, 7).reshape(2, 3), np.ones((1, 2)), np.zeros((0, 2)), np.full((2, 1), 7.0)]
    assert block_diagonal(*blocks).tolist() == scipy.linalg.block_diag(*blocks).tolist()
    assert block_diagonal().shape == (0, 0)


def test_a_repeated_eigenvalue_is_fixed_as_often_as_it_is_beyond_reach():
    """Of three equal decoupled integrators one input moves only one combination."""
    assert uncontrollable_modes(np.eye(3), [[1.0], [2.0], [3.0]]) == pytest.approx([1, 1])


def test_a_long_chain_of_integrators_is_moved_from_its_end():
    """A Jordan block, whose computed eigenvalues scatter, is moved from its end, not from its start."""
    A = np.eye(6) + np.diag(np.ones(5), 1)
    end = np.eye(6)[:, 5:]
    assert uncontrollable_modes(A, end).size == 0
    assert uncontrollable_modes(A, end[::-1]).size == 5


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_units_of_the_input_do_not_decide_what_is_reached(scale):
    """Measuring one of two inputs in other units leaves the answer as it is."""
    A, B = np.diag([2.0, 3.0, 4.0]), np.array([[1.0, 0], [0, scale], [0, 0]])
    assert uncontrollable_modes(A, B) == pytest.approx([4.0])


@law(8, 100, seed=seeds, fixed=st.integers(0, 2))
def test_units_of_the_states_do_not_decide_what_is_reached(seed, fixed):
    """Micrometres next to megametres: the modes beyond reach are those of the same plant in metres."""
    rng = np.random.default_rng(seed)
    A, B = entries(rng, 4, 4), entries(rng, 4, 1)
    A[4 - fixed :, : 4 - fixed], B[4 - fixed :] = 0, 0
    units = np.exp2(rng.integers(-20, 21, size=4))
    A, B = mixed(A, B, rng)
    assert uncontrollable_modes(A / units[:, None] * units, B / units[:, None]).size == fixed


@pytest.mark.parametrize("n", [5, 20, 60])
@law(2, 10, seed=seeds)
def test_a_mode_that_nothing_moves_is_named_among_many_that_decay(n, seed):
    """A plant whose input moves the mode by 1e-12 is not accused."""
    draws = np.random.default_rng(seed)
    A, B = np.diag([1.3125, *(draws.permutation(115)[: n - 1] / 128)]), 1 + entries(draws, n, 1) ** 2
    B[0] = 0.0
    assert uncontrollable_modes(*mixed(A, B, draws)) == pytest.approx([1.3125])
    B[0] = 2.0**-40
    assert not uncontrollable_modes(*mixed(A, B, draws)).size


def test_without_any_input_every_mode_is_fixed():
    """A zero input matrix, or none, moves nothing."""
    assert uncontrollable_modes([[0.0, 1], [-1, 0]], [[0.0], [0]]) == pytest.approx([1j, -1j])
    assert uncontrollable_modes([[2.0]], np.zeros((1, 0))) == pytest.approx([2])


@law(8, 100, seed=seeds)
def test_the_stationary_sum_solves_its_equation(draw, seed):
    """X = F X F' + W, also close to the unit circle and far from normal."""
    case = draw(seed)
    F = case.A * case.rng.uniform(0.1, 0.9999) / np.abs(np.linalg.eigvals(case.A)).max()
    X = accumulate(F, case.W)
    assert F @ X @ F.T + case.W == pytest.approx(X, rel=1e-9, abs=1e-11 * np.abs(X).max())


@law(8, 100, seed=seeds, lag=st.floats(-9, -0.5), digits=st.floats(0, 8))
def test_the_stationary_sum_is_the_solution_of_its_linear_equations_in_512_bits(draw, seed, lag, digits):
    """The entries of X in one system, with any units, up to a distance of 1e-9 from the limit of stability."""
    case = draw(seed)
    n, units = len(case.A), 10 ** case.rng.uniform(-digits, digits, len(case.A))
    F = case.A * (1 - 10**lag) / np.abs(np.linalg.eigvals(case.A)).max() * units[:, None] / units
    W = case.W * np.outer(units, units)
    try:
        X = accumulate(F, W)
    except UnstableError:
        assume(False)
    with precision(512):
        step, terms = arb_mat(F.tolist()), arb_mat(n * n, 1, W.ravel().tolist())
        rows = arb_mat(n * n, n * n, [step[i, p] * step[j, q] for i, j, p, q in np.ndindex(n, n, n, n)])
        found = (arb_mat(np.eye(n * n).tolist()) - rows).solve(terms)
        exact = np.array([float(x) for x in found.entries()]).reshape(n, n)
    size = np.sqrt(exact.diagonal())
    assert np.abs((X - exact) / size / size[:, None]).max() < 1e-6


def test_a_rotation_that_rounding_leaves_inside_the_circle_has_no_sum():
    """The true rotation has none, and no digit of the sum of the stored one is known."""
    c, s = np.cos(0.3) * (1 - 1e-15), np.sin(0.3) * (1 - 1e-15)
    with pytest.raises(UnstableError, match="could not be proved"):
        accumulate([[c, s], [-s, c]], np.eye(2))


def test_the_stationary_sum_of_an_unstable_map_is_refused():
    """The message names the eigenvalue."""
    with pytest.raises(UnstableError, match=r"eigenvalue 1\.5"):
        accumulate([[1.5]], [[1.0]])


def test_a_matrix_that_is_not_square_is_refused():
    """Shapes are checked at the door."""
    with pytest.raises(ProblemError, match="F has shape"):
        accumulate(np.zeros((2, 3)), np.eye(2))
