"""Stabilising solution of the continuous-time Riccati equation, from SciPy and refined by Newton's method."""

from __future__ import annotations

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array, symmetrised
from taciturn._modes import Modes
from taciturn.lqg._axes import Quadratic
from taciturn.lqg._newton import Gains, Solution, Time
from taciturn.lqg._worth import Worth


def solve(A: Array, B: Array, Q: Array, R: Array, N: Array) -> Solution | None:
    """Return the stabilising solution of the continuous Riccati equation for definite R, or None if none was found."""
    return _FLOW.solve(Quadratic(A, B, Q, R, N))


def worth(A: Array, B: Array, Q: Array, R: Array, N: Array) -> Worth:
    """Return the states with a nonzero cost-to-go, and the modes of the other states."""
    return _FLOW.worth(Quadratic(A, B, Q, R, N))


class _Flow(Time):
    edge, fastest = 0.0, -np.inf

    def rough(self, given: Quadratic) -> Array | None:
        return _scipy.continuous_riccati(*given)

    def pace(self, modes: Modes) -> Array:
        return np.asarray(modes.real, dtype=np.float64)

    def margin(self, given: Quadratic) -> float:
        return 0.0

    def summed(self, F: Array, stage: Array) -> Array:
        return _scipy.continuous_lyapunov(F.T, stage)

    def answer(self, given: Quadratic, K: Array, L: Array) -> Gains:
        best = -np.linalg.solve(given.R, given.B.T @ K + given.N.T)
        inverse = np.linalg.inv(given.R)
        return Gains(K, np.asarray(best, dtype=np.float64), given.R, np.asarray(inverse, dtype=np.float64))

    def residual(self, given: Quadratic, F: Array, stage: Array, K: Array) -> tuple[Array, Array]:
        return symmetrised(F.T @ K + K @ F + stage), np.sqrt(np.maximum(np.diag(K), 0.0))

    def missed(self, given: Quadratic, F: Array, found: Gains) -> Array:
        return given.R @ found.L + given.B.T @ found.K + given.N.T

    def step(self, F: Array) -> Array:
        return F / max(float(np.abs(np.diag(F)).max(initial=0.0)), 1e-300)


_FLOW = _Flow()
