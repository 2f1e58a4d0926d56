"""Coordinates that matter: what can be reached, what can be seen, each of about unit size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, symmetrised
from taciturn._modes import balancing

SAME = 1e-10  # relative: a direction this much shorter than what made it is taken for rounding
PATHS, TICKS, DROPPED = 32, 600, 100  # of the run that measures the size of the coordinates
FORCED = 0.2  # of its ticks take the last action, so that what is hardly ever sent has a size
HUGE = 1e100
BLUR = 1e-9  # of the correlations: a direction may be so much smaller than the rest, not more


@dataclass(frozen=True, eq=False)
class Coordinates:
    """A switched map with its cost and trigger in some coordinates.

    Args:
        F: map of each action.
        G: by which the noise acts.
        M: stage cost of each action.
        Psi: trigger of each action.
        X: rows that must stay visible.
        starts: columns that must stay reachable.
    """

    F: tuple[Array, ...]
    G: Array
    M: tuple[Array, ...]
    Psi: tuple[Array, ...]
    X: Array
    starts: Array

    def changed(self, inverse: Array, T: Array) -> Coordinates:
        """Return the map of the coordinates ``inverse`` z, of which z is T times."""
        return Coordinates(
            tuple(inverse @ F @ T for F in self.F),
            inverse @ self.G,
            tuple(symmetrised(T.T @ M @ T) for M in self.M),
            tuple(symmetrised(T.T @ Psi @ T) for Psi in self.Psi),
            self.X @ T,
            inverse @ self.starts,
        )


def reduce(raw: Coordinates, c: Sequence[float]) -> Coordinates:
    """Return the map in the fewest coordinates that do the same, scaled to about unit variance.

    Kept is what the starts and the noise reach, and of that what the rows, the cost and the trigger see. Any
    coordinates serve a certificate; those of unit size serve the solver.

    Args:
        raw: the map.
        c: constants of the trigger.
    """
    found = relevant(raw)
    T = _sizes(found, c)
    return found.changed(np.asarray(np.linalg.inv(T), dtype=np.float64), T)


def relevant(raw: Coordinates) -> Coordinates:
    """Return the map in coordinates of what starts and noise reach and rows, cost and trigger see."""
    sizes = balancing(sum((np.abs(F) for F in raw.F), np.zeros_like(raw.F[0])))
    found = raw.changed(np.diag(1 / sizes), np.diag(sizes))
    reached = invariant(np.column_stack([_unit(found.G), _unit(found.starts)]), found.F)
    found = found.changed(reached.T, reached)
    differences = [Psi - found.Psi[0] for Psi in found.Psi[1:]]
    rows = np.vstack([_unit(found.X.T).T, *(_normed(each) for each in (*found.M, *differences))])
    seen = invariant(rows.T, [F.T for F in found.F])
    return found.changed(seen.T, seen)


def invariant(columns: Array, maps: Sequence[Array]) -> Array:
    """Return orthonormal columns that span the least subspace that holds these columns and that every map keeps."""
    basis = np.zeros((len(columns), 0))
    new = _added(columns, basis)
    scales = [float(np.linalg.norm(map_, 2)) or 1.0 for map_ in maps]
    while new.shape[1]:
        basis = np.column_stack([basis, new])
        moved = [map_ @ new / scale for map_, scale in zip(maps, scales, strict=True)]
        new = _added(np.column_stack(moved), basis)
    return basis


def _added(columns: Array, basis: Array) -> Array:
    """Return orthonormal columns for what the basis does not hold."""
    rest = columns
    for _ in range(2):  # once more, for what rounding left
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
    """Return T with T T' about the covariance of the coordinates, as a short run shows it."""
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
    if not (np.diag(covariance) > 1e-12 * largest).all():  # noise that does not reach everything
        covariance = covariance + 1e-4 * largest * np.eye(states)
    size = np.sqrt(np.diag(covariance))
    correlation = symmetrised(covariance / size / size[:, None])
    values, vectors = np.linalg.eigh(correlation)
    return size[:, None] * vectors * np.sqrt(np.maximum(values, BLUR))
