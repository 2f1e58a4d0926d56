"""Linear-quadratic problems in double precision: their matrices, the price of an input, and many steps of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from taciturn import _arrays
from taciturn._arrays import NO_VARIANCE, Array, ArrayLike, Bits, is_definite, symmetrised

TURNS = 40  # 2^40 steps
SETTLED = 1e-6  # last relative change; the remaining error is its square, which Newton's method squares again


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

    def back(self, K: Array) -> tuple[Array, Array]:
        """Return the cost-to-go before an optimal step, and how much its input saves, from the cost-to-go after it."""
        off = self.B.T @ K @ self.A + self.N.T
        saved = off.T @ price(self.B, K, self.R)[1] @ off
        return symmetrised(self.Q + self.A.T @ K @ self.A - saved), symmetrised(saved)

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


class Span(NamedTuple):
    """Some steps of a problem with optimal inputs: how they change a cost-to-go X + Δ, X being a terminal weight.

    The cost-to-go before the steps is X + K + F'Δ(I + GΔ)^{-1}F. With X ≻ 0, the input weight R + B'XB is definite even
    if R is not. A stack of problems has stacks of matrices.

    Args:
        F: the states after the steps, for Δ = 0.
        G: how a later Δ changes these states.
        K: the cost-to-go before the steps, less X, for Δ = 0.

    Source: anderson1978
    """

    F: Array
    G: Array
    K: Array

    @classmethod
    def of(cls, given: Quadratic, last: Array, inverse: Array) -> Span:
        """Return one step: F = A + BL, G = BH^{-1}B', K = Ric(X) − X, L = −H^{-1}(B'XA + N').

        Args:
            given: the problem.
            last: X.
            inverse: inverse of H = R + B'XB; with a pseudo-inverse, inputs without cost are 0.
        """
        A, B, Q, _, N = given
        off = B.T @ last @ A + N.T
        K = Q - last + A.T @ last @ A - off.T @ inverse @ off
        return cls(A - B @ inverse @ off, symmetrised(B @ inverse @ B.T), symmetrised(K))

    def then(self, later: Span) -> Span:
        """Return these steps and later ones."""
        return self._through(later, *self._onto(later.K))

    def before(self, change: Array) -> Array:
        """Return the Δ before the steps for the Δ after them."""
        return self._onto(change)[0]

    def _onto(self, change: Array) -> tuple[Array, Array]:
        """Return the Δ before the steps, and (I + GΔ)^{-1}[F, G]."""
        n = self.F.shape[-1]
        solved = _divided(np.eye(n) + self.G @ change, np.concatenate([self.F, self.G], axis=-1))
        return symmetrised(self.K + self.F.mT @ change @ solved[..., :n]), solved

    def _through(self, later: Span, K: Array, solved: Array) -> Span:
        n = self.F.shape[-1]
        return Span(later.F @ solved[..., :n], later.G + later.F @ solved[..., n:] @ later.F.mT, K)

    def for_ever(self, last: Array, crumb: Array | float = 0.0) -> Array:
        """Return the limit of the cost-to-go of more and more repetitions; not finite if there is none.

        Each iteration doubles the number of steps, and leaves the square of the error before.

        Args:
            last: X.
            crumb: change of each diagonal entry that counts as none, (n,). The rounding error of an entry that is 0, of
                a state that does not decay, doubles in each iteration, so it never settles relative to itself.
        """
        span, worth = self, np.diag(last)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for _ in range(TURNS):
                K, solved = span._onto(span.K)
                found, more = (np.diagonal(part, axis1=-2, axis2=-1) for part in (K, K - span.K))
                if not (np.abs(more) > SETTLED * np.abs(worth + found) + crumb).any():
                    return symmetrised(last + K)  # also if entries are not finite
                span = span._through(span, K, solved)
        return symmetrised(last + span.K)


def _divided(matrix: Array, right: Array) -> Array:
    """Return M^{-1}R for one matrix or a stack; NaN for singular matrices, without effect on the others."""
    try:
        return np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)
    except np.linalg.LinAlgError:
        if matrix.ndim == 2:
            return np.full_like(right, np.nan)
        return np.stack([_divided(one, part) for one, part in zip(matrix, right, strict=True)])


def in_powers_of_two(sizes: Array) -> Array:
    """Return 1/√size as powers of two, the units in which a form with this diagonal has entries near 1; 1 for 0."""
    return np.exp2(-np.round(np.log2(np.where(sizes > 0, sizes, 1.0)) / 2))
