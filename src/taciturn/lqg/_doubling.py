"""Doubling algorithm for discrete-time Riccati equations: k iterations give the cost-to-go over 2^k steps."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array, symmetrised

TURNS = 40  # 2^40 steps
SETTLED = 1e-6  # last relative change; the remaining error is its square, which Newton's method squares again


def double(
    A: Array, B: Array, Q: Array, N: Array, last: Array, H: Array, inverse: Array, crumb: Array | float = 0.0
) -> Array:
    """Return the stabilising solution of a discrete-time Riccati equation; its entries are not finite if none exists.

    A stack of equations can be solved together.

    The solution K = X + Δ is the limit of the cost of more and more steps with a terminal weight X ≻ 0. Δ solves an
    equation without cross weight, with the input weight H = R + B'XB, which is definite even if R is not. From

        F = A + BL,  G = BH^{-1}B',  Δ = Ric(X) − X,  L = −H^{-1}(B'XA + N'),

    each iteration computes the same matrices for twice as many steps: with W = I + GΔ,

        F ← F W^{-1} F,  G ← G + F W^{-1} G F',  Δ ← Δ + F'Δ W^{-1} F.

    Args:
        A, B, Q, N: the problem, (…, n, n), (…, n, m), (…, n, n), (…, n, m).
        last: X, the terminal weight, (…, n, n).
        H: R + B'XB, (…, m, m).
        inverse: inverse of H; with a pseudo-inverse, inputs without cost are 0.
        crumb: change of each diagonal entry that counts as none, (…, n). The rounding error of an entry that is 0, of a
            state that does not decay, doubles in each iteration, so it never settles relative to itself.

    Source: anderson1978
    """
    turned = A.swapaxes(-1, -2)
    L = -inverse @ (B.swapaxes(-1, -2) @ last @ A + N.swapaxes(-1, -2))
    F, G = A + B @ L, symmetrised(B @ inverse @ B.swapaxes(-1, -2))
    K = symmetrised(Q - last + turned @ last @ A - L.swapaxes(-1, -2) @ H @ L)
    n, one, both, worth = A.shape[-1], np.eye(A.shape[-1]), np.concatenate([F, G], axis=-1), _diagonal(last)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for _ in range(TURNS):
            solved = _divided(one + G @ K, both)
            turned = F.swapaxes(-1, -2)
            more = turned @ K @ solved[..., :n]
            K = symmetrised(K + more)
            if not (np.abs(_diagonal(more)) > SETTLED * np.abs(worth + _diagonal(K)) + crumb).any():
                break  # also if entries are not finite
            G = G + F @ solved[..., n:] @ turned
            F = F @ solved[..., :n]
            both[..., :n], both[..., n:] = F, G
    return symmetrised(last + K)


def _divided(matrix: Array, right: Array) -> Array:
    """Return M^{-1}R for one matrix or a stack; NaN for singular matrices, without effect on the others."""
    try:
        return np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)
    except np.linalg.LinAlgError:
        if matrix.ndim == 2:
            return np.full_like(right, np.nan)
        return np.stack([_divided(one, part) for one, part in zip(matrix, right, strict=True)])


def _diagonal(matrix: Array) -> Array:
    return np.diagonal(matrix, axis1=-2, axis2=-1)
