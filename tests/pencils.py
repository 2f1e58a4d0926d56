"""Stabilising solutions of Riccati equations by another method: the invariant subspace of a pencil.

The states and costates of the optimal loop obey M z⁺ = L z with

    L = [ A − B R⁻¹N'   0 ]        M = [ I   B R⁻¹B'       ]
        [ −(Q − N R⁻¹N')  I ],         [ 0   (A − B R⁻¹N')' ].

Its solutions that decay span [I; K]. The sign of (L + M)⁻¹(L − M), by Newton's iteration S ← (S + S⁻¹)/2 in thousands
of bits, is −1 on them. Plants are sampled by one exponential of a block matrix (Van Loan), whose corner e^{−Ah} costs
as many bits as e^{Ah} has. Nothing of this is in the package.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from flint import arb, arb_mat, ctx

TURNS = 4000


class Exact(NamedTuple):
    """A problem of one step in balls."""

    A: arb_mat
    B: arb_mat
    Q: arb_mat
    R: arb_mat
    N: arb_mat
    W: arb_mat
    bits: int


def balls(a: np.ndarray) -> arb_mat:
    """Return the numbers of a matrix, each exactly."""
    return arb_mat(*np.shape(a), np.asarray(a, dtype=np.float64).ravel().tolist())


def block(rows: list[list[arb_mat]]) -> arb_mat:
    """Return a matrix of blocks."""
    return arb_mat([[one for part in row for one in part.tolist()[i]] for row in rows for i in range(row[0].nrows())])


def part(a: arb_mat, rows: range, columns: range) -> arb_mat:
    """Return some rows and columns."""
    return arb_mat(len(rows), len(columns), [a[i, j] for i in rows for j in columns])


def sampled(A, B, Q, R, N, W, h: float) -> Exact:
    """Return the problem of a held input over h seconds."""
    bits = 1536 + int(6 * np.abs(np.linalg.eigvals(A)).max(initial=0.0) * h)
    before, ctx.prec = ctx.prec, bits
    try:
        n, m = B.shape
        size = n + m
        F = balls(np.block([[A, B], [np.zeros((m, size))]]))
        M, none = balls(np.block([[Q, N], [N.T, R]])), arb_mat(size, size)
        E = (block([[F.transpose() * -1, M], [none, F]]) * arb(h)).exp()
        P = part(E, range(size, 2 * size), range(size, 2 * size))
        C = P.transpose() * part(E, range(size), range(size, 2 * size))
        own = balls(A)
        G = (block([[own * -1, balls(W)], [arb_mat(n, n), own.transpose()]]) * arb(h)).exp()
        D = part(G, range(n, 2 * n), range(n, 2 * n)).transpose() * part(G, range(n), range(n, 2 * n))
        x, u = range(n), range(n, size)
        return Exact(part(P, x, x), part(P, x, u), part(C, x, x), part(C, u, u), part(C, x, u), D, bits)
    finally:
        ctx.prec = before


def stabilising(given: Exact) -> tuple[arb_mat, arb_mat]:
    """Return the stabilising solution K and its gain, in balls, for a definite R."""
    before, ctx.prec = ctx.prec, given.bits
    try:
        A, B, Q, R, N, _, bits = given
        n = A.nrows()
        one, none = arb_mat(n, n, [int(i == j) for i in range(n) for j in range(n)]), arb_mat(n, n)
        share, push = R.solve(N.transpose()), R.solve(B.transpose())
        A_free, Q_free = A - B * share, Q - N * share
        L = block([[A_free, none], [Q_free * -1, one]])
        M = block([[one, B * push], [none, A_free.transpose()]])
        S = (L + M).solve(L - M)
        for _ in range(TURNS):
            following = ((S + S.inv()) * arb(0.5)).mid()
            moved = max(float(abs(one).mid()) for one in (following - S).entries())
            S = following
            if moved < 2.0 ** -(bits / 3):
                break
        left = part(S, range(2 * n), range(n)) + block([[one], [none]])
        right = part(S, range(2 * n), range(n, 2 * n)) + block([[none], [one]])
        K = ((right.transpose() * right).solve(right.transpose() * left) * -1).mid()
        H = R + B.transpose() * K * B
        miss = max(float(abs(one).upper()) for one in (S * S - block([[one, none], [none, one]])).entries())
        assert miss < 1e-60, "the pencil needs more bits"
        return K, H.solve(B.transpose() * K * A + N.transpose()) * -1
    finally:
        ctx.prec = before


def floats(a: arb_mat) -> np.ndarray:
    """Return a matrix of balls as floats."""
    return np.array([float(one.mid()) for one in a.entries()]).reshape(a.nrows(), a.ncols())


def spent(K: arb_mat, W: arb_mat) -> float:
    """Return tr(KW)."""
    before, ctx.prec = ctx.prec, 1024
    try:
        return float((K * W).trace().mid())
    finally:
        ctx.prec = before
