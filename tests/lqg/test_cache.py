"""Regulators and filters are kept: who asks again for the latest gets them, and nobody gets another's."""

from __future__ import annotations

import numpy as np
import pytest

from taciturn import UnstableError
from taciturn.lqg.cache import MOST
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.riccati import regulate

ONE = np.eye(1)


def test_the_same_numbers_get_the_same_answer_which_nobody_can_change() -> None:
    """Lists or arrays, in any order of memory."""
    A = np.array([[1.1, 0.2], [0.0, 0.9]])
    found = regulate(A, np.eye(2), np.eye(2), np.eye(2), np.zeros((2, 2)))
    assert regulate(np.asfortranarray(A), np.eye(2).tolist(), np.eye(2), np.eye(2), np.zeros((2, 2))) is found
    steady = steady_filter(A, np.eye(2), np.eye(2), np.eye(2))
    assert steady_filter(A.copy(), np.eye(2), np.eye(2), np.eye(2)) is steady
    for array in (found.K, found.L, found.H, steady.prior, steady.posterior, steady.gain, steady.innovation):
        assert not array.flags.writeable


def test_other_numbers_get_another_answer() -> None:
    """The same bytes in another shape, another discount, one digit."""
    found = regulate(2 * ONE, ONE, ONE, ONE, 0 * ONE)
    assert regulate((2 + 1e-15) * ONE, ONE, ONE, ONE, 0 * ONE) is not found
    assert regulate(2 * ONE, ONE, ONE, ONE, 0 * ONE, 0.9).L != found.L
    wide = regulate(2 * ONE, [[1.0, 1.0]], ONE, np.eye(2), [[0.0, 0.0]])
    assert wide.L.shape == (2, 1)


def test_what_is_refused_is_refused_again() -> None:
    """No answer is kept of it."""
    for _ in range(2):
        with pytest.raises(UnstableError, match="uncontrollable through B"):
            regulate(2 * ONE, 0 * ONE, ONE, ONE, 0 * ONE)


def test_only_the_latest_are_kept() -> None:
    """A sweep over plants does not fill the memory."""
    first = regulate(2 * ONE, ONE, ONE, ONE, 0 * ONE)
    for i in range(MOST):
        regulate((3 + i) * ONE, ONE, ONE, ONE, 0 * ONE)
    again = regulate(2 * ONE, ONE, ONE, ONE, 0 * ONE)
    assert again is not first
    assert again.K == first.K
