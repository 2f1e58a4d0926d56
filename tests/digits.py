"""Riccati equations in sixty digits: Newton's method on matrices of decimals, against which floats are held."""

from __future__ import annotations

from decimal import Decimal, getcontext, localcontext

import numpy as np

DIGITS = 60
getcontext().Emax, getcontext().Emin = 999999, -999999


def exactly(matrix: np.ndarray) -> np.ndarray:
    """Return the numbers of a matrix as decimals, each exactly."""
    return np.vectorize(Decimal, otypes=[object])(np.asarray(matrix, dtype=np.float64))


def solved(M: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return M^{-1} right, by elimination with the largest pivot."""
    n = len(M)
    rows = np.hstack([M, right])
    for k in range(n):
        pivot = k + int(np.argmax(np.abs(rows[k:, k])))
        rows[[k, pivot]] = rows[[pivot, k]]
        rows[k] = rows[k] / rows[k, k]
        for i in range(n):
            if i != k:
                rows[i] = rows[i] - rows[i, k] * rows[k]
    return rows[:, n:]


def summed(F: np.ndarray, M: np.ndarray) -> np.ndarray:
    """Return Σ_k F'^k M F^k by doubling."""
    X, power = M, F
    for _ in range(80):
        term = power.T @ X @ power
        X = X + term
        if np.abs(term).max() <= Decimal(10) ** -DIGITS * np.abs(X).max():
            return (X + X.T) / 2
        power = power @ power
        assert np.abs(power).max() < Decimal(10) ** 10000, "the gain from which Newton's method starts is not stable"
    raise AssertionError("the sum has not settled")


def regulated(
    A: np.ndarray,
    B: np.ndarray,
    Q: np.ndarray,
    R: np.ndarray,
    N: np.ndarray,
    start: np.ndarray,
    continuous: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Return (K, L) of the stabilising solution in sixty digits, as floats.

    Args:
        A, B, Q, R, N: the problem.
        start: a gain; it need only stabilise, and if it does not, that is noticed.
        continuous: whether time is.
    """
    with localcontext() as context:
        context.prec = DIGITS + 40
        A, B, Q, R, N, L = (exactly(part) for part in (A, B, Q, R, N, start))
        one, last = exactly(np.eye(len(A))), None
        for _ in range(60):
            F, M = A + B @ L, Q + N @ L + L.T @ N.T + L.T @ R @ L
            if continuous:  # Cayley's map to discrete time
                p = np.abs(F).max()
                inverse = solved(p * one - F, one)
                F, M = inverse @ (p * one + F), 2 * p * inverse.T @ M @ inverse
            K = summed(F, M)
            L = -solved(R, B.T @ K + N.T) if continuous else -solved(R + B.T @ K @ B, B.T @ K @ A + N.T)
            if last is not None and np.abs(K - last).max() <= Decimal(10) ** -40 * np.abs(K).max():
                return K.astype(np.float64), L.astype(np.float64)
            last = K
    raise AssertionError("Newton's method has not settled")


def sampled(
    A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray, N: np.ndarray, W: np.ndarray, period: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return [A_d, B_d], the joint weight and the noise of a period, as floats: power series, then doublings."""
    n, m = B.shape
    with localcontext() as context:
        context.prec = DIGITS + 40
        F = exactly(np.block([[A, B], [np.zeros((m, n + m))]]))
        M, G = exactly(np.block([[Q, N], [N.T, R]])), exactly(np.pad(W, ((0, m), (0, m))))
        step, doublings = Decimal(period), 0
        while np.abs(F).max() * step * (n + m) > Decimal("1e-3"):
            step, doublings = step / 2, doublings + 1
        one = exactly(np.eye(n + m))
        power, weight, noise = one, M * 0, M * 0
        Phi, m_k, g_k = one, M * step, G * step
        for k in range(1, 40):
            weight, noise, power = weight + m_k, noise + g_k, power @ F * step / k
            Phi = Phi + power
            m_k, g_k = (m_k @ F + F.T @ m_k) * step / (k + 1), (F @ g_k + g_k @ F.T) * step / (k + 1)
        for _ in range(doublings):
            weight, noise, Phi = weight + Phi.T @ weight @ Phi, noise + Phi @ noise @ Phi.T, Phi @ Phi
        return Phi[:n].astype(np.float64), weight.astype(np.float64), noise[:n, :n].astype(np.float64)
