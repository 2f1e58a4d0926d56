"""Linear-quadratic problems in double precision: their matrices, and the price of a deviation of the input."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from taciturn import _arrays
from taciturn._arrays import NO_VARIANCE, Array, ArrayLike, Bits, is_definite, symmetrised


class Quadratic(NamedTuple):
    """A linear-quadratic regulator problem: dynamics (A, B) and weights [[Q, N], [N', R]]."""

    A: Array
    B: Array
    Q: Array
    R: Array
    N: Array

    @classmethod
    def checked(cls, A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike) -> Quadratic:
        """Return the regulator problem with the given matrices, after a check of their shapes and symmetry.

        Raises:
            ProblemError: data of the wrong shape or not finite, or Q or R is not symmetric.
        """
        A = _arrays.square("A", A, "states × states")
        B = _arrays.array("B", B, (len(A), None), "states × inputs")
        n, m = B.shape
        return cls(
            A,
            B,
            _arrays.symmetric("Q", Q, n, "states × states"),
            _arrays.symmetric("R", R, m, "inputs × inputs"),
            _arrays.array("N", N, (n, m), "states × inputs"),
        )

    def among(self, states: Bits) -> Quadratic:
        """Return the regulator problem restricted to some of the states."""
        A, B, Q, R, N = self
        return Quadratic(A[np.ix_(states, states)], B[states], Q[np.ix_(states, states)], R, N[states])

    def beside(self, place: int, S: Array, P: Array) -> Quadratic:
        """Return the problem with further states z⁺ = S z + P u, which cost nothing and move no other state.

        Args:
            place: number of states before them.
            S: their dynamics, (r, r).
            P: how the inputs move them, (r, m).
        """
        kept, more = placed(len(self.A), place, len(S))
        A, B, Q, R, N = self
        return Quadratic(kept @ A @ kept.T + more @ S @ more.T, kept @ B + more @ P, kept @ Q @ kept.T, R, kept @ N)

    def under(self, L: Array) -> tuple[Array, Array]:
        """Return the closed-loop matrix A + BL for a gain L, and the weight of the state in its stage cost."""
        stage = self.Q + self.N @ L + L.T @ self.N.T + L.T @ self.R @ L
        return self.A + self.B @ L, symmetrised(stage)


def placed(states: int, place: int, more: int) -> tuple[Array, Array]:
    """Return the maps of the old states, and of ``more`` states after the first ``place``, to all states in order."""
    old, new = np.split(np.eye(states + more), [states], axis=1)
    order = np.insert(np.arange(states), [place] * more, range(states, states + more))
    return old[order], new[order]


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


def in_powers_of_two(sizes: Array) -> Array:
    """Return 1/√size as powers of two, the units in which a form with this diagonal has entries near 1; 1 for 0."""
    return np.exp2(-np.round(np.log2(np.where(sizes > 0, sizes, 1.0)) / 2))
