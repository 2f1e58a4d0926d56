"""The stabilising solution of the discrete Riccati equation: doubling starts, Newton's method adds the digits.

Serves the regulator and, by duality, the filter. H = R + B'KB may be singular (noise-free measurements): the
gain then obeys H L = −(B'KA + N') and keeps, in the directions where H vanishes, whatever makes A + BL
stable.
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from taciturn import _scipy
from taciturn._arrays import TINY, Array, is_definite, symmetrised
from taciturn._modes import radius, summed
from taciturn.lqg._axes import Quadratic
from taciturn.lqg._newton import Solution, Time

CIRCLE = 1e-7  # computed eigenvalues of a defective matrix scatter by the root of the rounding error
MARGIN = 1e-10  # a closed loop nearer to the unit circle than this is not called stable
# Where R is singular no test on the data foretells a closed-loop eigenvalue on the circle. Rounding pulls
# such a double eigenvalue about 1e-8 inside, so the answer must stand clear of that.
SINGULAR_MARGIN = 1e-6
DOUBLINGS = 40  # 10^12 steps
SETTLED = 1e-12  # relative: Newton's method adds the digits


def price(B: Array, K: Array, R: Array) -> tuple[Array, Array]:
    """Return H = R + B'KB and its inverse, or a pseudo-inverse that maps null directions to zero.

    A diagonal entry counts as zero when it is rounding of the products it sums; the rest is judged with a
    unit diagonal. So the units of the variables decide nothing.
    """
    H = symmetrised(R + B.T @ K @ B)
    diagonal = np.diag(H)
    products = (np.abs(B.T) @ np.sqrt(np.maximum(np.diag(K), 0))) ** 2 + np.abs(np.diag(R))
    kept = diagonal > np.maximum(1e-14 * products, TINY)
    scale = np.where(kept, 1 / np.sqrt(np.where(kept, diagonal, 1.0)), 0.0)
    values, vectors = np.linalg.eigh(H * scale * scale[:, None])
    # With R definite every direction is real; otherwise one this small may be the error of a computed K.
    inside = values > (1e-15 if is_definite(R) else 1e-10) * len(diagonal)
    vectors = scale[:, None] * vectors[:, inside]
    return H, (vectors / values[inside]) @ vectors.T


def solve(A: Array, B: Array, Q: Array, R: Array, N: Array) -> Solution | None:
    """Return the solution with A + BL stable, or None where none was found."""
    return STEPS.solve(Quadratic(A, B, Q, R, N))


def doubled(given: Quadratic) -> Array | None:
    """Return the limit of the cost-to-go of 1, 2, 4, 8, … steps, or None where R is not definite or there is none.

    It stabilises if every mode that does not decay costs something. It needs no scipy, whose import takes longer than
    most answers.
    """
    A, B, Q, R, N = given
    if not is_definite(R):
        return None
    with np.errstate(all="ignore"), suppress(np.linalg.LinAlgError):
        F, reached = A - B @ np.linalg.solve(R, N.T), symmetrised(B @ np.linalg.solve(R, B.T))
        K = symmetrised(Q - N @ np.linalg.solve(R, N.T))
        for _ in range(DOUBLINGS):
            moved = np.linalg.solve(np.eye(len(A)) + reached @ K, np.hstack([F, reached]))
            half, rest = moved[:, : len(A)], moved[:, len(A) :]
            more = symmetrised(F.T @ K @ half)
            F, reached, K = F @ half, symmetrised(reached + F @ rest @ F.T), K + more
            if not np.isfinite(K).all():
                return None
            if (np.abs(np.diag(more)) <= SETTLED * np.abs(np.diag(K))).all():
                return K
    return None


class _Steps(Time):
    def rough(self, given: Quadratic) -> Array | None:
        K = doubled(given)
        if K is not None and self.stable(given.under(self.answer(given, K, np.zeros(given.B.T.shape))[0])[0], given):
            return K
        return _scipy.discrete_riccati(*given)

    def stable(self, F: Array, given: Quadratic) -> bool:
        return radius(F) < 1 - (MARGIN if is_definite(given.R) else SINGULAR_MARGIN)

    def summed(self, F: Array, stage: Array) -> Array:
        return summed(F.T, stage)

    def answer(self, given: Quadratic, K: Array, L: Array) -> tuple[Array, Array]:
        H, inverse = price(given.B, K, given.R)
        best = -inverse @ (given.B.T @ K @ given.A + given.N.T)
        return best + (np.eye(len(H)) - inverse @ H) @ L, H

    def residual(self, given: Quadratic, F: Array, stage: Array, K: Array) -> tuple[Array, Array]:
        root = np.sqrt(np.maximum(np.diag(K), 0.0))
        return symmetrised(F.T @ K @ F + stage - K), np.abs(F).T @ root

    def saved(self, given: Quadratic, K: Array, L: Array) -> Array:
        off = given.R @ L + given.N.T + given.B.T @ K @ (given.A + given.B @ L)
        return off.T @ price(given.B, K, given.R)[1] @ off

    def step(self, F: Array) -> Array:
        return F


STEPS = _Steps()
