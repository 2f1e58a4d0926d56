"""Asymptotic growth of moments of random linear systems, such as loops over lossy links."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from taciturn._arrays import Array

STEPS = 4096  # largest number of steps from which the growth is computed
ACCURACY = 1e-3  # relative accuracy of the logarithm of the growth


def growth(move: Callable[[Array], Array], moments: Array) -> float:
    """Return the asymptotic growth factor per step of moments that a linear map moves.

    The moments start from those of a distribution with a density. Then all other moments are at most a multiple of
    these, and grow at most as fast. This computation converges also if the largest eigenvalues of the map are defective
    or form a cluster, in which case iterative eigenvalue solvers may not converge.

    Args:
        move: the moments after a step, from those before it; maps moments to moments.
        moments: moments of a distribution with a density, such as ``normal_moments``.
    """
    size, earlier, paces = 0.0, 0.0, [math.inf, math.inf]  # logarithms
    for step in range(1, STEPS + 1):
        moments = move(moments)
        factor = float(np.linalg.norm(moments))
        if not 0.0 < factor < math.inf:
            return factor
        moments = moments / factor
        size += math.log(factor)
        if step & (step - 1) == 0:  # the average of the second half of the steps
            paces.append((size - earlier) / max(1, step - step // 2))
            earlier = size
            if max(abs(pace - paces[-1]) for pace in paces[-3:]) <= ACCURACY * abs(paces[-1]):
                break
    return math.exp(paces[-1])


def normal_moments(size: int, order: int) -> Array:
    """Return all moments of an even order of a vector of independent standard normal variables.

    The result has one index per factor: the moment of order 2 is the unit matrix.
    """
    if order == 0:
        return np.ones(())
    first = np.multiply.outer(np.eye(size), normal_moments(size, order - 2))  # the first factor paired with the second
    return np.sum([np.moveaxis(first, 1, other) for other in range(1, order)], axis=0)
