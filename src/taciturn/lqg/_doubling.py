"""The discrete Riccati equation by doubling: after k turns the cost of 2^k steps, by products of n×n matrices alone."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array, symmetrised
from taciturn.lqg._axes import Quadratic

TURNS = 40  # 2^40 steps
SETTLED = 1e-6  # relative change of the last turn: what is left is its square, which Newton's method squares again


def double(given: Quadratic, last: Array, H: Array, inverse: Array) -> Array | None:
    """Return the stabilising solution of a discrete Riccati equation, or None where it overflows.

    It is the limit of the cost of ever more steps with a price X ≻ 0 on the state after them, K = X + Δ. Δ solves an
    equation without cross weight, whose inputs have the price H = R + B'XB, definite also where R is not. From

        F = A + BL,  G = BH^{-1}B',  Δ = Ric(X) − X,  L = −H^{-1}(B'XA + N'),

    each turn makes the same of twice as many steps: with W = I + GΔ,

        F ← F W^{-1} F,  G ← G + F W^{-1} G F',  Δ ← Δ + F'Δ W^{-1} F.

    Args:
        given: the problem.
        last: X, (n, n).
        H: R + B'XB, (m, m).
        inverse: of H; a pseudo-inverse leaves the directions alone that cost nothing.

    Source: anderson1978
    """
    A, B, Q, _, N = given
    L = -inverse @ (B.T @ last @ A + N.T)
    F, G = A + B @ L, symmetrised(B @ inverse @ B.T)
    K = symmetrised(Q - last + A.T @ last @ A - L.T @ H @ L)
    n, one, both = len(A), np.eye(len(A)), np.hstack([F, G])
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for _ in range(TURNS):
            try:
                solved = np.linalg.solve(one + G @ K, both)
            except np.linalg.LinAlgError:
                return None
            more = F.T @ K @ solved[:, :n]
            K = symmetrised(K + more)
            if not np.isfinite(np.vdot(K, K)):
                return None
            if (np.abs(more.diagonal()) <= SETTLED * np.abs(last.diagonal() + K.diagonal())).all():
                break
            G = G + F @ solved[:, n:] @ F.T
            F = F @ solved[:, :n]
            both[:, :n], both[:, n:] = F, G
    return symmetrised(last + K)
