"""Stabilising solution of the discrete-time Riccati equation, by doubling and refined by Newton's method.

The regulator and, by duality, the filter use it. H = R + B'KB may be singular (noise-free measurements). The gain then
satisfies H L = −(B'KA + N'), and in the directions in which H is zero it is any gain with which A + BL is stable.
"""

from __future__ import annotations

import numpy as np

from taciturn._arrays import NO_VARIANCE, Array, is_definite, symmetrised
from taciturn._modes import Modes, summed
from taciturn.lqg._axes import Quadratic
from taciturn.lqg._doubling import double
from taciturn.lqg._newton import Gains, Solution, Time
from taciturn.lqg._worth import Worth

MARGIN = 1e-10  # least distance to the unit circle of a closed loop that counts as stable
# If R is singular, no test of the data excludes a closed-loop eigenvalue on the unit circle. Rounding moves such a
# double eigenvalue about 1e-8 inside, so the required distance is larger than that.
SINGULAR_MARGIN = 1e-6
CLEAR = 1e-4  # distance from the unit circle, much larger than rounding moves an eigenvalue
BEYOND = 1e250  # the cost of a gain that does not stabilise, up to rounding; its products with B would overflow
LAST = 1e-6  # small terminal weight, relative to the cost of moving a state, so that modes without weight count too


def price(B: Array, K: Array, R: Array) -> tuple[Array, Array]:
    """Return the input weight H = R + B'KB and its inverse, or a pseudo-inverse if H is singular.

    A diagonal entry counts as zero if it is smaller than the rounding of the products in its sum. The other entries
    are scaled to a unit diagonal, so that the result does not depend on the units of the variables.
    """
    H = symmetrised(R + B.T @ K @ B)
    diagonal = H.diagonal()
    products = (np.abs(B.T) @ np.sqrt(np.maximum(K.diagonal(), 0))) ** 2 + np.abs(R.diagonal())
    kept = diagonal > np.maximum(1e-14 * products, NO_VARIANCE)
    scale = 1 / np.sqrt(diagonal) if kept.all() else np.where(kept, 1 / np.sqrt(np.where(kept, diagonal, 1.0)), 0.0)
    values, vectors = np.linalg.eigh(H * scale * scale[:, None])
    # If R is definite, every direction counts; otherwise a small eigenvalue may be the error of a computed K.
    vectors = scale[:, None] * vectors
    inside = values > 1e-10 * len(diagonal)
    if not inside.all():
        if is_definite(R):
            inside = values > 1e-15 * len(diagonal)
        values, vectors = values[inside], vectors[:, inside]
    return H, (vectors / values) @ vectors.T


def solve(A: Array, B: Array, Q: Array, R: Array, N: Array) -> Solution | None:
    """Return the stabilising solution of the discrete-time Riccati equation, or None if none was found."""
    return STEPS.solve(Quadratic(A, B, Q, R, N))


def worth(A: Array, B: Array, Q: Array, R: Array, N: Array) -> Worth:
    """Return the states with a nonzero cost-to-go, and the modes of the other states."""
    return STEPS.worth(Quadratic(A, B, Q, R, N))


def is_clear(found: Solution) -> bool:
    """Return whether a Riccati solution is accurate and its closed-loop modes are well inside the unit circle.

    Then all modes that do not decay are controllable, and all modes on the unit circle affect the cost, except modes
    that have neither property.
    """
    return found.sound and found.slowest < 1 - CLEAR


class _Steps(Time):
    edge, fastest = 1.0, 0.0

    def rough(self, given: Quadratic) -> Array | None:
        worth, reached = np.trace(given.R) + np.sum(given.B * (given.Q @ given.B)), float(np.sum(given.B**2))
        last = given.Q + (LAST * worth / reached if reached > NO_VARIANCE else 0.0) * np.eye(len(given.A))
        return double(given.A, given.B, given.Q, given.N, last, *price(given.B, last, given.R))

    def pace(self, modes: Modes) -> Array:
        return np.asarray(np.abs(modes), dtype=np.float64)

    def margin(self, given: Quadratic) -> float:
        return MARGIN if is_definite(given.R) else SINGULAR_MARGIN

    def summed(self, F: Array, stage: Array) -> Array:
        K = summed(F.T, stage)
        return K if np.abs(K).max(initial=0.0) < BEYOND else np.full_like(K, np.inf)

    def answer(self, given: Quadratic, K: Array, L: Array) -> Gains:
        H, inverse = price(given.B, K, given.R)
        best = -inverse @ (given.B.T @ K @ given.A + given.N.T)
        return Gains(K, best + (np.eye(len(H)) - inverse @ H) @ L, H, inverse)

    def residual(self, given: Quadratic, F: Array, stage: Array, K: Array) -> tuple[Array, Array]:
        root = np.sqrt(np.maximum(K.diagonal(), 0.0))
        return symmetrised(F.T @ K @ F + stage - K), np.abs(F).T @ root

    def missed(self, given: Quadratic, F: Array, found: Gains) -> Array:
        return given.R @ found.L + given.N.T + given.B.T @ found.K @ F

    def step(self, F: Array) -> Array:
        return F


STEPS = _Steps()
