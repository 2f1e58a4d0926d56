"""Distribution of the intervals between sends, by propagating the density of unsent errors from check to check."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array, frozen
from taciturn.renewal._trigger_check import CheckMatrix, GridCheck
from taciturn.renewal.chain import Intervals

NEGLIGIBLE = 1e-14  # survival probability that counts as 0
SETTLED = 1e-12  # change of the distribution of the unsent error below which the survival is geometric
SMALL = 1e-3  # share of the mean interval after the last check below which a difference would cancel
STEPS = 1024  # checks that are computed one by one; after them this many per product
SLOW_STEPS = 128  # checks that are computed one by one on a grid
MOST_NODES = 2500  # most nodes of a map that is raised to a power
MOST_CHECKS = 1 << 22


def intervals(start: Array, check: CheckMatrix | GridCheck, checks: Array, mean: float) -> Intervals:
    """Return the distribution of the number of checks between two sends.

    It is computed check by check until the probability of no send is negligible, or decreases geometrically.

    After the last check, the survival is assumed to decrease by a constant factor per check, such that its sum is the
    mean interval. If the survival is geometric, this factor is the dominant eigenvalue of the map.

    Args:
        start: probability of each node after the first check, (nodes,).
        check: the map of a check.
        checks: expected checks until the next send, with the next check included, (nodes,).
        mean: mean interval in checks.

    Returns:
        The distribution.

    Source: khashooei2017
    """
    survival, error, done = _one_by_one(start, check)
    if not done and isinstance(check, CheckMatrix) and len(start) <= MOST_NODES:
        more, error = _many_at_once(error, check.entries)
        survival = np.concatenate([survival, more])
    left = mean - float(survival.sum())
    if left < SMALL * mean:  # the difference cancels; the sum of the rest is then accurate enough
        left = float(error @ (checks - 1))
    left = left / survival[-1] if survival[-1] > 0 else 0.0
    return Intervals(frozen(survival), left / (1 + left))


def _one_by_one(start: Array, check: CheckMatrix | GridCheck) -> tuple[Array, Array, bool]:
    """Return the survival, the distribution of the unsent error after the last check, and whether it is complete."""
    survival, error = [1.0, float(start.sum())], start
    steps = STEPS if isinstance(check, CheckMatrix) else SLOW_STEPS
    while survival[-1] > NEGLIGIBLE:
        if len(survival) > steps:
            return np.array(survival), error, False
        before, error = error, check.after(error)
        survival.append(float(error.sum()))
        if _same(before, error):
            break
    return np.array(survival), error, True


def _many_at_once(error: Array, kernel: Array) -> tuple[Array, Array]:
    """Return the further survival, and the distribution after its last check, with STEPS checks per product."""
    ahead = np.empty((len(error), STEPS))  # column k: probability of no send at the next k + 1 checks
    column = np.ones(len(error))
    for k in range(STEPS):
        column = kernel @ column
        ahead[:, k] = column
    jump = np.linalg.matrix_power(kernel, STEPS)
    survival = list[Array]()
    for _ in range(MOST_CHECKS // STEPS):
        survival.append(error @ ahead)
        before, error = error, error @ jump
        if survival[-1][-1] <= NEGLIGIBLE or _same(before, error):
            break
    return np.concatenate(survival), error


def _same(before: Array, after: Array) -> bool:
    """Return whether two densities have the same shape."""
    sizes = before.sum(), after.sum()
    return bool(sizes[1] > 0 and np.abs(after / sizes[1] - before / sizes[0]).sum() <= SETTLED)
