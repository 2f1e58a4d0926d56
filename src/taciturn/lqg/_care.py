"""The stabilising solution of the continuous Riccati equation: scipy starts, Newton's method adds the digits."""

from __future__ import annotations

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array, symmetrised
from taciturn._modes import eigenvalues
from taciturn.lqg._axes import Quadratic
from taciturn.lqg._newton import Solution, Time


def solve(A: Array, B: Array, Q: Array, R: Array, N: Array) -> Solution | None:
    """Return the solution with A + BL stable, R definite, or None where none was found."""
    return _FLOW.solve(Quadratic(A, B, Q, R, N))


class _Flow(Time):
    def rough(self, given: Quadratic) -> Array | None:
        return _scipy.continuous_riccati(*given)

    def stable(self, F: Array, given: Quadratic) -> bool:
        return float(eigenvalues(F).real.max(initial=-np.inf)) < 0

    def summed(self, F: Array, stage: Array) -> Array:
        return _scipy.continuous_lyapunov(F.T, stage)

    def answer(self, given: Quadratic, K: Array, L: Array) -> tuple[Array, Array]:
        return np.asarray(-np.linalg.solve(given.R, given.B.T @ K + given.N.T), dtype=np.float64), given.R

    def residual(self, given: Quadratic, F: Array, stage: Array, K: Array) -> tuple[Array, Array]:
        return symmetrised(F.T @ K + K @ F + stage), np.sqrt(np.maximum(np.diag(K), 0.0))

    def saved(self, given: Quadratic, K: Array, L: Array) -> Array:
        off = given.R @ L + given.B.T @ K + given.N.T
        return off.T @ np.linalg.solve(given.R, off)

    def step(self, F: Array) -> Array:
        return F / max(float(np.abs(np.diag(F)).max(initial=0.0)), 1e-300)


_FLOW = _Flow()
