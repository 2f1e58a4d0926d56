"""Reduction of a switched linear map to its reachable and observable states, scaled to about unit size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, symmetrised
from taciturn._display import Displayed
from taciturn._modes import balancing

SAME = 1e-10  # relative length below which a new direction is treated as a rounding error
PATHS, TICKS, DROPPED = 32, 600, 100  # paths, steps and discarded steps of the run that measures the coordinates
FORCED = 0.2  # share of its steps that take the last action, so that rarely sent signals are measured too
HUGE = 1e100
BLUR = 1e-9  # least eigenvalue of the correlation matrix that is used


@dataclass(frozen=True, eq=False, repr=False)
class Coordinates(Displayed):
    """A switched linear map with its cost and trigger, in given coordinates of the state.

    Args:
        F: dynamics matrix of each action.
        G: input matrix of the noise.
        M: cost matrix of each action.
        Psi: trigger matrix of each action.
        X: rows that must stay observable.
        starts: columns that must stay reachable.
    """

    F: tuple[Array, ...]
    G: Array
    M: tuple[Array, ...]
    Psi: tuple[Array, ...]
    X: Array
    starts: Array

    def changed(self, inverse: Array, T: Array) -> Coordinates:
        """Return this map in new coordinates y with z = T y, given the matrix T and its inverse."""
        return Coordinates(
            tuple(inverse @ F @ T for F in self.F),
            inverse @ self.G,
            tuple(symmetrised(T.T @ M @ T) for M in self.M),
            tuple(symmetrised(T.T @ Psi @ T) for Psi in self.Psi),
            self.X @ T,
            inverse @ self.starts,
        )


def reduce(raw: Coordinates, c: Sequence[float]) -> Coordinates:
    """Return an equivalent switched linear map in the fewest coordinates, scaled to about unit variance.

    The result contains the states that are reachable from the initial columns and the noise, and observable in the
    rows, the cost and the trigger. A certificate does not depend on the scaling; unit size makes the solver more
    accurate.

    Args:
        raw: map in the original coordinates.
        c: constants of the trigger.
    """
    found = relevant(raw)
    T = _sizes(found, c)
    return found.changed(np.asarray(np.linalg.inv(T), dtype=np.float64), T)


def relevant(raw: Coordinates) -> Coordinates:
    """Return a switched linear map restricted to reachable and observable states, without scaling to unit variance."""
    sizes = balancing(sum((np.abs(F) for F in raw.F), np.zeros_like(raw.F[0])))
    found = raw.changed(np.diag(1 / sizes), np.diag(sizes))
    reached = invariant(np.column_stack([_unit(found.G), _unit(found.starts)]), found.F)
    found = found.changed(reached.T, reached)
    differences = [Psi - found.Psi[0] for Psi in found.Psi[1:]]
    rows = np.vstack([_unit(found.X.T).T, *(_normed(each) for each in (*found.M, *differences))])
    seen = invariant(rows.T, [F.T for F in found.F])
    return found.changed(seen.T, seen)


def invariant(columns: Array, maps: Sequence[Array]) -> Array:
    """Return an orthonormal basis of the least subspace that contains given columns and is invariant under all maps."""
    basis = np.zeros((len(columns), 0))
    new = _added(columns, basis)
    scales = [float(np.linalg.norm(map_, 2)) or 1.0 for map_ in maps]
    while new.shape[1]:
        basis = np.column_stack([basis, new])
        moved = [map_ @ new / scale for map_, scale in zip(maps, scales, strict=True)]
        new = _added(np.column_stack(moved), basis)
    return basis


def _added(columns: Array, basis: Array) -> Array:
    """Return orthonormal columns for the part of the given columns that is orthogonal to the basis."""
    rest = columns
    for _ in range(2):  # the second pass removes rounding errors of the first
        rest = rest - basis @ (basis.T @ rest)
    left, values, _ = np.linalg.svd(rest, full_matrices=False)
    return left[:, values > SAME]


def _unit(columns: Array) -> Array:
    lengths = np.linalg.norm(columns, axis=0)
    return columns[:, lengths > 0] / lengths[lengths > 0]


def _normed(matrix: Array) -> Array:
    size = np.abs(matrix).max(initial=0.0)
    return matrix / size if size > 0 else matrix


def _sizes(found: Coordinates, c: Sequence[float]) -> Array:
    """Return T such that T T' is approximately the covariance of the coordinates, measured in a short run."""
    draws, states = np.random.default_rng(0), len(found.G)
    z, total, kept = np.zeros((states, PATHS)), np.zeros((states, states)), 0
    with np.errstate(all="ignore"):
        for tick in range(TICKS):
            values = [np.einsum("ip,ij,jp->p", z, Psi, z) + own for Psi, own in zip(found.Psi, c, strict=True)]
            action = np.where(draws.random(PATHS) < FORCED, len(c) - 1, np.argmin(values, axis=0))
            z = np.choose(action, [F @ z for F in found.F]) + found.G @ draws.standard_normal((found.G.shape[1], PATHS))
            if not np.abs(z).max(initial=0.0) < HUGE:
                return np.eye(states)
            if tick >= DROPPED:
                total, kept = total + z @ z.T, kept + PATHS
    covariance = total / kept
    largest = float(np.diag(covariance).max(initial=0.0))
    if largest == 0:  # no noise
        return np.eye(states)
    if not (np.diag(covariance) > 1e-12 * largest).all():  # noise that does not reach all coordinates
        covariance = covariance + 1e-4 * largest * np.eye(states)
    size = np.sqrt(np.diag(covariance))
    correlation = symmetrised(covariance / size / size[:, None])
    values, vectors = np.linalg.eigh(correlation)
    return size[:, None] * vectors * np.sqrt(np.maximum(values, BLUR))
