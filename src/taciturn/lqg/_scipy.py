"""The few calls into scipy, with types: every untyped edge of this floor is in this file."""

from __future__ import annotations

import warnings
from typing import cast

import numpy as np
import scipy.linalg

from taciturn._arrays import Array


def discrete_riccati(A: Array, B: Array, Q: Array, R: Array, N: Array) -> Array | None:
    """Return scipy's solution of the discrete Riccati equation, or None where it finds none."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # the caller verifies; a warning here would be an answer nobody reads
            K = cast(Array, scipy.linalg.solve_discrete_are(A, B, Q, R, s=N))
    except (np.linalg.LinAlgError, ValueError):
        return None
    return (K + K.T) / 2 if np.isfinite(K).all() else None


def continuous_riccati(A: Array, B: Array, Q: Array, R: Array, N: Array) -> Array | None:
    """Return scipy's solution of the continuous Riccati equation, or None where it finds none."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            K = cast(Array, scipy.linalg.solve_continuous_are(A, B, Q, R, s=N))
    except (np.linalg.LinAlgError, ValueError):
        return None
    return (K + K.T) / 2 if np.isfinite(K).all() else None


def continuous_lyapunov(F: Array, M: Array) -> Array:
    """Return X with F X + X F' + M = 0."""
    X = cast(Array, scipy.linalg.solve_continuous_lyapunov(F, -M))
    return (X + X.T) / 2
