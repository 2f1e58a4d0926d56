"""How long intervals last, from the map that a check makes of the density of the kept error."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array, frozen
from taciturn.renewal._check import Grid, Matrix
from taciturn.renewal.chain import Intervals

NEGLIGIBLE = 1e-14  # survival
SETTLED = 1e-12  # change of the kept error's distribution between looks: then survival is geometric
SMALL = 1e-3
STEPS = 1024  # checks that are taken one by one; after them so many at once
SLOW_STEPS = 128  # the same on a grid
MOST_NODES = 2500  # whose map is raised to a power
MOST_CHECKS = 1 << 22


def intervals(start: Array, check: Matrix | Grid, checks: Array, mean: float) -> Intervals:
    """Return the survival check by check, until it is negligible or geometric.

    The survival after the last check is given the factor with which it sums to the mean interval: where survival is
    geometric that is the dominant eigenvalue of the map.

    Args:
        start: of each node, its share of errors after the first check, (nodes,).
        check: the map.
        checks: mean of the checks that are still to come, the next one included, (nodes,).
        mean: interval in checks.

    Returns:
        The distribution.

    Source: khashooei2017
    """
    survival, error, done = _one_by_one(start, check)
    if not done and isinstance(check, Matrix) and len(start) <= MOST_NODES:
        more, error = _many_at_once(error, check.entries)
        survival = np.concatenate([survival, more])
    left = mean - float(survival.sum())
    if left < SMALL * mean:  # the difference has lost its digits, and the sum of the rest has few to lose
        left = float(error @ (checks - 1))
    left = left / survival[-1] if survival[-1] > 0 else 0.0
    return Intervals(frozen(survival), left / (1 + left))


def _one_by_one(start: Array, check: Matrix | Grid) -> tuple[Array, Array, bool]:
    """Return the survival, what is kept after its last check, and whether no more is needed."""
    survival, error = [1.0, float(start.sum())], start
    steps = STEPS if isinstance(check, Matrix) else SLOW_STEPS
    while survival[-1] > NEGLIGIBLE:
        if len(survival) > steps:
            return np.array(survival), error, False
        before, error = error, check.after(error)
        survival.append(float(error.sum()))
        if _same(before, error):
            break
    return np.array(survival), error, True


def _many_at_once(error: Array, kernel: Array) -> tuple[Array, Array]:
    """Return the further survival and what is kept after its last check, STEPS checks for one product."""
    ahead = np.empty((len(error), STEPS))  # column k: the chance to be kept k + 1 times
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
    """Say whether two densities have one shape."""
    sizes = before.sum(), after.sum()
    return bool(sizes[1] > 0 and np.abs(after / sizes[1] - before / sizes[0]).sum() <= SETTLED)
