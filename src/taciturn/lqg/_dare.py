"""The stabilising solution of the discrete Riccati equation: scipy starts, Newton's method adds the digits.

Serves the regulator and, by duality, the filter. H = R + B'KB may be singular (noise-free measurements): the
gain then obeys H L = −(B'KA + N') and keeps, in the directions where H vanishes, whatever makes A + BL
stable.
"""

from __future__ import annotations

import numpy as np

from taciturn import _scipy
from taciturn._arrays import DEFINITENESS_TOLERANCE, Array
from taciturn._modes import TINY, radius, summed

Solution = tuple[Array, Array, Array]

CIRCLE = 1e-7  # computed eigenvalues of a defective matrix scatter by the root of the rounding error
MARGIN = 1e-10  # a closed loop nearer to the unit circle than this is not called stable
# Where R is singular no test on the data foretells a closed-loop eigenvalue on the circle. Rounding pulls
# such a double eigenvalue about 1e-8 inside, so the answer must stand clear of that.
SINGULAR_MARGIN = 1e-6


def is_definite(matrix: Array) -> bool:
    """Say whether a symmetric matrix is positive definite, each variable measured in its own unit."""
    diagonal = np.diag(matrix)
    if (diagonal <= TINY).any():
        return False
    scale = 1 / np.sqrt(diagonal)
    return bool(np.linalg.eigvalsh(matrix * scale * scale[:, None])[0] > DEFINITENESS_TOLERANCE)


def price(B: Array, K: Array, R: Array) -> tuple[Array, Array]:
    """Return H = R + B'KB and its inverse, or a pseudo-inverse that maps null directions to zero.

    A diagonal entry counts as zero when it is rounding of the products it sums; the rest is judged with a
    unit diagonal. So the units of the variables decide nothing.
    """
    H = R + B.T @ K @ B
    H = (H + H.T) / 2
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
    """Return (K, L, H) with A + BL stable, or None where no such solution was found."""
    n, m = B.shape
    K = _scipy.discrete_riccati(A, B, Q, R, N)
    if K is not None:
        found = _newton(A, B, Q, R, N, -price(B, K, R)[1] @ (B.T @ K @ A + N.T))
        if found is not None:
            return found
    # The problem with unit weights has a solution whenever (A, B) is stabilisable; its gain is a safe start.
    K = _scipy.discrete_riccati(A, B, np.eye(n), np.eye(m), np.zeros((n, m)))
    if K is None:
        return None
    return _newton(A, B, Q, R, N, -price(B, K, np.eye(m))[1] @ B.T @ K @ A)


def _newton(A: Array, B: Array, Q: Array, R: Array, N: Array, L: Array) -> Solution | None:
    """Iterate K = cost of the gain L, L = best answer to K, from a stabilising L; None if nothing settles."""
    margin = MARGIN if is_definite(R) else SINGULAR_MARGIN
    previous, change = None, np.inf
    for _ in range(100):
        if radius(A + B @ L) >= 1 - margin:
            return None
        K = summed((A + B @ L).T, Q + N @ L + L.T @ N.T + L.T @ R @ L)
        terms = np.abs(Q) + 2 * np.abs(N) @ np.abs(L) + np.abs(L.T) @ np.abs(R) @ np.abs(L)
        K = (K + K.T) / 2
        if not np.isfinite(K).all():
            return None
        H, inverse = price(B, K, R)
        L = -inverse @ (B.T @ K @ A + N.T) + (np.eye(len(H)) - inverse @ H) @ L
        # Where the terms cancel, K holds their rounding and cannot settle below it.
        size = float(np.maximum(np.abs(K), terms).max(initial=0.0))
        last, change = change, (np.inf if previous is None else float(np.abs(K - previous).max(initial=0.0)))
        # Down at the rounding error; where a closed-loop mode tends to the circle the changes halve instead.
        stalled = change <= 1e-5 * size and change >= 0.9 * last
        if change <= 1e-14 * size or stalled:
            return (K, L, H) if radius(A + B @ L) < 1 - margin else None
        previous = K
    return None
