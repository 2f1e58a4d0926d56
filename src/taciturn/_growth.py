"""Asymptotic growth of moments of random linear systems, such as loops over lossy links.

The growth is the largest modulus of an eigenvalue of the map that moves the moments. Arnoldi's method computes the
largest eigenvalues of its restriction to the Krylov space of the moments, together with an estimate of their error: the
residual, divided by the cosine of the angle between the left and the right eigenvector. Several eigenvalues of the same
modulus, such as those of the modes of a loop with links of their own, do not delay it.

If the largest eigenvalue is defective, such as the common pole of a filter and of its copy, this angle is a right angle
and the estimate has no use. Then the growth is the average factor per step over the second half of many steps, which
converges for every map, but slowly: like 1/steps, and with beats of eigenvalues of the same modulus.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from taciturn._arrays import Array

STEPS = 4096  # largest number of steps from which the growth is computed
ACCURACY = 1e-3  # relative accuracy of the logarithm of the growth, if it is computed from steps
PRECISE = 1e-6  # relative error of an eigenvalue of Arnoldi's method that is accepted
BASIS = 64  # largest dimension of a Krylov space
LOOKS = 4  # dimensions between two computations of eigenvalues
FROM = (
    0,
    64,
    512,
)  # steps after which a Krylov space starts; they enlarge the share of the largest eigenvalues
VANISHES = 1e-14  # relative size of a new direction that is a rounding error


def growth(move: Callable[[Array], Array], moments: Array) -> float:
    """Return the asymptotic growth factor per step of moments that a linear map moves.

    The moments start from those of a distribution with a density. Then all other moments are at most a multiple of
    these, and grow at most as fast, so that the Krylov space of these moments contains the largest eigenvalue.

    Args:
        move: the moments after a step, from those before it; maps moments to moments.
        moments: moments of a distribution with a density, such as ``normal_moments``.

    Source: saad2011
    """
    size, earlier, paces = 0.0, 0.0, [math.inf, math.inf]  # logarithms
    for step in range(STEPS + 1):
        if step in FROM and (found := _largest(move, moments)) is not None:
            return found
        if step and step & (step - 1) == 0:  # the average of the second half of the steps
            paces.append((size - earlier) / max(1, step - step // 2))
            earlier = size
            if step > FROM[-1] and max(abs(pace - paces[-1]) for pace in paces[-3:]) <= ACCURACY * abs(paces[-1]):
                break
        moments = move(moments)
        factor = float(np.linalg.norm(moments))
        if not 0.0 < factor < math.inf:
            return factor
        moments = moments / factor
        size += math.log(factor)
    return math.exp(paces[-1])


def _largest(move: Callable[[Array], Array], start: Array) -> float | None:
    """Return the largest modulus of an eigenvalue by Arnoldi's method, or None if its error may be large."""
    basis = np.zeros((BASIS + 1, start.size))
    H = np.zeros((BASIS + 1, BASIS))
    basis[0] = start.ravel() / np.linalg.norm(start)
    for k in range(BASIS):
        moved = move(basis[k].reshape(start.shape)).ravel()
        length = float(np.linalg.norm(moved))
        if not length < math.inf:
            return None
        for _ in range(2):  # again, so that rounding errors do not spoil the orthogonality
            along = basis[: k + 1] @ moved
            moved = moved - along @ basis[: k + 1]
            H[: k + 1, k] += along
        H[k + 1, k] = new = float(np.linalg.norm(moved))
        ends = new <= VANISHES * length
        if ends or (k + 1) % LOOKS == 0:
            found = _eigenvalue(H[: k + 1, : k + 1], 0.0 if ends else new)
            if found is not None or ends:
                return found
        basis[k + 1] = moved / new
    return None


def _eigenvalue(H: Array, rest: float) -> float | None:
    """Return the largest modulus of an eigenvalue of a Hessenberg matrix, or None if its error may be too large."""
    values, right = np.linalg.eig(H)
    i = int(np.argmax(np.abs(values)))
    largest = float(np.abs(values[i]))
    if largest == 0.0:
        return 0.0 if rest == 0.0 else None
    others, left = np.linalg.eig(H.T)
    j = int(np.argmin(np.abs(others - values[i])))
    cosine = float(np.abs(left[:, j] @ right[:, i]))
    error = (rest * float(np.abs(right[-1, i])) + np.finfo(float).eps * float(np.linalg.norm(H))) / max(cosine, 1e-300)
    return largest if error <= PRECISE * largest else None


def normal_moments(size: int, order: int) -> Array:
    """Return all moments of an even order of a vector of independent standard normal variables.

    The result has one index per factor: the moment of order 2 is the unit matrix.
    """
    if order == 0:
        return np.ones(())
    first = np.multiply.outer(np.eye(size), normal_moments(size, order - 2))  # the first factor paired with the second
    return np.sum([np.moveaxis(first, 1, other) for other in range(1, order)], axis=0)
