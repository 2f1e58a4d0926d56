"""Enclosures contain the exact results of their operations, and what they call definite or zero is so."""

import numpy as np
import pytest

from taciturn._rational import precision, rational
from taciturn.lqg.enclosures import Balls, Doubles, inner


@pytest.mark.parametrize("seed", range(6))
def test_products_in_doubles_contain_the_exact_ones(seed):
    """The entries differ by up to ten powers of ten, and some rows are zero."""
    draws = np.random.default_rng(seed)
    n, k, m = draws.integers(1, 9, size=3).tolist()
    left, right = (draws.normal(size=size) * 10.0 ** draws.uniform(-5, 5, size) for size in ((n, k), (k, m)))
    left[draws.random(n) < 0.2] = 0.0
    product, exact = Doubles.exact(left) @ Doubles.exact(right), rational(left) * rational(right)
    again, twice = product.T @ product, exact.transpose() * exact
    for found, expected in ((product, exact), (again, twice)):
        off = [abs(one - two) for one, two in zip(expected.entries(), rational(found.middle).entries(), strict=True)]
        assert all(one <= two for one, two in zip(off, rational(found.radius).entries(), strict=True))
        assert (found.radius <= 1e-13 * np.abs(left).max() ** 2 * np.abs(right).max() ** 2 * k * n + 1e-12).all()


def test_products_with_zero_are_zero():
    """The structure of a problem follows from entries that are exactly zero."""
    none, one = np.zeros((2, 3)), np.ones((3, 3))
    assert not (Doubles.exact(none) @ Doubles.exact(one)).most.any()
    with precision(128):
        assert not (Balls.exact(none) @ Balls.exact(one)).most.any()


def test_a_number_below_the_range_of_doubles_is_not_zero():
    """The square of 1e-200 is no double, but it couples states."""
    with precision(128):
        tiny = Balls.exact(np.array([[1e-200, 0.0]]))
        assert ((tiny.T @ tiny).most > 0).tolist() == [[True, False], [False, False]]


@pytest.mark.parametrize("size", [2, 12])
def test_definiteness_is_decided_by_digits_that_doubles_do_not_have(size):
    """A matrix of ones with a last entry of 1 + 2^-100 is definite next to the identity, one of 1 is not."""
    with precision(256):
        ones = np.eye(size)
        ones[:2, :2] = 1.0
        more = np.zeros((size, size))
        more[1, 1] = 2.0**-100
        assert (Balls.exact(ones) + Balls.exact(more)).definite()
        assert not Balls.exact(ones).definite()
        assert not (Balls.exact(ones) - Balls.exact(more)).definite()


@pytest.mark.parametrize("size", [2, 12])
def test_a_matrix_with_an_entry_that_is_no_number_is_not_definite(size):
    """Neither on the diagonal nor beside it."""
    with precision(128):
        for place in ((0, 0), (1, 0)):
            for value in (np.nan, np.inf):
                broken = np.eye(size)
                broken[place] = broken[place[::-1]] = value
                assert not Balls.exact(broken).definite()


def test_the_inner_product_is_the_trace():
    """1·5 + 2·6 + 3·7 + 4·8."""
    one, two = np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[5.0, 6.0], [7.0, 8.0]])
    assert inner(Doubles.exact(one), Doubles.exact(two)).middle.tolist() == [[70.0]]
    with precision(128):
        assert inner(Balls.exact(one), Balls.exact(two)).middle.tolist() == [[70.0]]
