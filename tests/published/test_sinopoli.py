"""Sinopoli and others: Kalman filtering with intermittent observations (sinopoli2004).

A filter whose measurements arrive with probability λ is the dual of a regulator whose inputs do, and the critical λ is
one less the critical loss. The modified Riccati equation is also iterated here, without the library.
"""

from __future__ import annotations

import numpy as np
import pytest

from taciturn.lqg.critical_losses import Channel
from taciturn.lqg.lossy import critical_losses

ACKNOWLEDGED = Channel(0.0, 0.0, acknowledged=True, delayed=False)


def settles(A: np.ndarray, C: np.ndarray, W: np.ndarray, V: np.ndarray, arrival: float) -> bool:
    """Tell whether P ← APA' + W − λ APC'(CPC' + V)^{-1}CPA' settles."""
    P = W
    for _ in range(100_000):
        gain = A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + V)
        following = A @ P @ A.T + W - arrival * gain @ C @ P @ A.T
        if np.trace(following) > 1e12 * np.trace(W):
            return False
        if np.abs(following - P).max() <= 1e-12 * np.abs(P).max():
            return True
        P = following
    raise AssertionError("neither settles nor diverges")


def test_the_scalar_filter_needs_more_than_36_percent_of_its_measurements() -> None:
    """A = −1.25, C = 1, W = 1, V = 2.5: λ_c = 1 − 1/A² = 0.36."""
    A, C = np.array([[-1.25]]), np.eye(1)
    by_input, by_sensor = critical_losses(A.T, C.T, ACKNOWLEDGED)
    assert 1 - by_input == pytest.approx(0.36, abs=1e-6)  # the dual regulator
    assert 1 - by_sensor == pytest.approx(0.36, abs=1e-6)  # the state itself over a link
    assert settles(A, C, np.eye(1), 2.5 * np.eye(1), 0.37)
    assert not settles(A, C, np.eye(1), 2.5 * np.eye(1), 0.35)


def test_the_filter_of_two_unstable_modes_needs_between_36_and_47_percent() -> None:
    """A = [1.25 0; 1 1.1], C = [1 1]: at least 1 − 1/1.25² = 0.36; 0.471 is enough, 1 − 1/(1.25·1.1)².

    The lower bound is what a link that delivers the whole state needs, the upper one that of the modified equation.
    """
    A, C = np.array([[1.25, 0.0], [1.0, 1.1]]), np.array([[1.0, 1.0]])
    upper, lower = critical_losses(A.T, C.T, ACKNOWLEDGED)
    assert 1 - lower == pytest.approx(0.36, abs=1e-6)
    assert 1 - upper == pytest.approx(1 - (1.25 * 1.1) ** -2, abs=1e-6)
    assert settles(A, C, 20 * np.eye(2), 2.5 * np.eye(1), 0.48)
    assert not settles(A, C, 20 * np.eye(2), 2.5 * np.eye(1), 0.46)
