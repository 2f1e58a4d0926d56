"""Paths and cycles along the nonzero entries of a matrix, and the largest geometric mean of entries along a cycle."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array, Bits


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


def closure(found: Bits, leads: Bits) -> Bits:
    """Return the given states and all states that they affect, directly or through other states.

    Args:
        found: the states, (n,).
        leads: entry (i, j) is true if state j affects state i directly, (n, n).
    """
    while not found.all():
        more = found | leads[:, found].any(axis=1)
        if (more == found).all():
            break
        found = more
    return np.asarray(found, dtype=np.bool_)


def paths(leads: Bits) -> Bits:
    """Return the matrix whose entry (i, j) is true if i = j or a path leads from state i to state j, (n, n)."""
    found = leads | np.eye(len(leads), dtype=np.bool_)
    while True:
        more = found.astype(np.float32) @ found.astype(np.float32) > 0
        if (more == found).all():
            return found
        found = np.asarray(more, dtype=np.bool_)


def in_cycles(leads: Bits) -> list[Bits]:
    """Return masks of the states that affect each other in cycles, (n,) each; every state is in one of them."""
    found = list[Bits]()
    linked = paths(leads)
    both, left = linked & linked.T, np.ones(len(leads), dtype=np.bool_)
    while left.any():
        found.append(both[int(np.argmax(left))])
        left &= ~found[-1]
    return found
