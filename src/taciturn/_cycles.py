"""The largest geometric mean of the entries of a matrix along a cycle of its indices."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array


def largest_cycle(A: Array) -> float:
    """Return the largest geometric mean of the entries of a nonnegative matrix along a cycle; 0 without a cycle.

    No change of units of the states changes it. If W_k(i) is the largest product of entries along k steps to i, it is
    the largest over i of the least (W_n(i) / W_k(i))^(1/(n − k)) over k < n (Karp's theorem).
    """
    n = len(A)
    with np.errstate(divide="ignore"):
        steps = np.log(A)
    walks = np.zeros((n + 1, n))
    for k in range(n):
        walks[k + 1] = (steps + walks[k]).max(axis=1, initial=-np.inf)
    cyclic = np.isfinite(walks[-1])
    if not cyclic.any():
        return 0.0
    means = (walks[-1, cyclic] - walks[:-1, cyclic]) / np.arange(n, 0, -1)[:, None]
    return float(np.exp(means.min(axis=0).max()))
