"""Random linear-quadratic problems for the tests of this floor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest


@dataclass(frozen=True)
class Case:
    """A random problem: full-rank weights with a cross term, full-rank noise, A often unstable."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    N: np.ndarray
    W: np.ndarray
    V: np.ndarray
    rng: np.random.Generator


def _semidefinite(rng: np.random.Generator, size: int) -> np.ndarray:
    root = rng.normal(size=(size, size))
    return root @ root.T + 0.01 * np.eye(size)


def _draw(seed: int) -> Case:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 7))
    m, p = int(rng.integers(1, 4)), int(rng.integers(1, n + 1))
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.3, 1.4) / np.abs(np.linalg.eigvals(A)).max()
    joint = _semidefinite(rng, n + m)
    return Case(
        A,
        rng.normal(size=(n, m)),
        rng.normal(size=(p, n)),
        joint[:n, :n],
        joint[n:, n:],
        joint[:n, n:],
        _semidefinite(rng, n),
        _semidefinite(rng, p),
        rng,
    )


@pytest.fixture(scope="session")
def draw() -> Callable[[int], Case]:
    """Return the function that makes a case from a seed, for use inside hypothesis tests."""
    return _draw


@pytest.fixture(scope="session")
def masses() -> Case:
    """Return the two masses and a spring of the thesis in continuous time, weights and noise of chapter 2."""
    stiffness = 2 * np.pi**2
    A = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-stiffness, stiffness, 0, 0], [stiffness, -stiffness, 0, 0]])
    return Case(
        A,
        np.array([[0.0], [0], [1], [0]]),
        np.eye(2, 4),
        0.1 * np.eye(4),
        np.array([[0.1]]),
        np.zeros((4, 1)),
        0.01 * np.eye(4),
        0.01 * np.eye(2),
        np.random.default_rng(0),
    )
