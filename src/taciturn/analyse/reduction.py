"""Switched linear maps, and their reduction to reachable and observable states, scaled to about unit size."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from taciturn._arrays import Array, symmetrised
from taciturn._display import Displayed
from taciturn._modes import balancing
from taciturn._subspaces import invariant, unit_columns

PATHS, TICKS, DROPPED = 32, 600, 100  # paths, steps and discarded steps of the run that measures the coordinates
FORCED = 0.2  # share of its steps that take the last action, so that rarely sent signals are measured too
HUGE = 1e100
BLUR = 1e-9  # least eigenvalue of the correlation matrix that is used


@dataclass(frozen=True, eq=False, repr=False)
class Switched(Displayed):
    """Switched linear map of a closed loop with its cost and trigger, in coordinates z of about unit size.

    Args:
        labels: names of the actions.
        F: dynamics matrix of each action, (r, r).
        G: input matrix of the noise w of a step, (r, q): plant noise, then the next measurement's, unit covariance.
        M: cost matrix of each action, (r, r): the stage cost of a step is z'M_i z + ``constant``.
        Psi: trigger matrix of each action, (r, r).
        c: trigger constant of each action.
        X: matrix (n, r) such that X z is the plant's state; in the innovations form, X z is the estimate.
        constant: cost of every step in addition to z'M_i z.
        hidden: mean square of the part of the plant's state that X z excludes.
        sends: the action under which every link that the policy decides on sends, or None.
    """

    labels: tuple[str, ...]
    F: tuple[Array, ...]
    G: Array
    M: tuple[Array, ...]
    Psi: tuple[Array, ...]
    c: tuple[float, ...]
    X: Array
    constant: float
    hidden: float
    sends: int | None

    @property
    def homogeneous(self) -> bool:
        """Whether the send decision depends only on the direction of the state z, so that z can converge to zero."""
        return len(set(self.c)) == 1

    @property
    def states(self) -> int:
        """Number of entries of z."""
        return len(self.G)

    def margins(self, action: int) -> list[tuple[Array, float]]:
        """Return the conditions z'Dz + d ≥ 0 under which an action is taken: (D, d) for every other action."""
        own, others = action, [j for j in range(len(self.labels)) if j != action]
        return [(self.Psi[j] - self.Psi[own], self.c[j] - self.c[own]) for j in others]

    def under(self, action: int) -> Switched:
        """Return the map of the loop that takes the given action at every step."""
        label, F, M, nothing = self.labels[action], self.F[action], self.M[action], np.zeros_like(self.Psi[action])
        return replace(self, labels=(label,), F=(F,), M=(M,), Psi=(nothing,), c=(0.0,), sends=0)

    def changed(self, inverse: Array, T: Array) -> Switched:
        """Return this map in new coordinates y with z = T y, given the matrix T and its inverse."""
        return replace(
            self,
            F=tuple(inverse @ F @ T for F in self.F),
            G=inverse @ self.G,
            M=tuple(symmetrised(T.T @ M @ T) for M in self.M),
            Psi=tuple(symmetrised(T.T @ Psi @ T) for Psi in self.Psi),
            X=self.X @ T,
        )


def reduce(raw: Switched, starts: Array) -> Switched:
    """Return an equivalent switched linear map in the fewest coordinates, scaled to about unit variance.

    The result contains the states that are reachable from the initial columns and the noise, and observable in the
    rows, the cost and the trigger. A certificate does not depend on the scaling; unit size makes the solver more
    accurate.

    Args:
        raw: map in the original coordinates.
        starts: columns that must stay reachable, such as initial states.
    """
    found = relevant(raw, starts)
    T = _sizes(found)
    return found.changed(np.asarray(np.linalg.inv(T), dtype=np.float64), T)


def relevant(raw: Switched, starts: Array) -> Switched:
    """Return a switched linear map restricted to reachable and observable states, without scaling to unit variance."""
    sizes = balancing(sum((np.abs(F) for F in raw.F), np.zeros_like(raw.F[0])))
    found = raw.changed(np.diag(1 / sizes), np.diag(sizes))
    reached = invariant(np.column_stack([unit_columns(found.G), unit_columns(starts / sizes[:, None])]), found.F)
    found = found.changed(reached.T, reached)
    differences = [Psi - found.Psi[0] for Psi in found.Psi[1:]]
    rows = np.vstack([unit_columns(found.X.T).T, *(_normed(each) for each in (*found.M, *differences))])
    seen = invariant(rows.T, [F.T for F in found.F])
    return found.changed(seen.T, seen)


def _normed(matrix: Array) -> Array:
    size = np.abs(matrix).max(initial=0.0)
    return matrix / size if size > 0 else matrix


def _sizes(found: Switched) -> Array:
    """Return T such that T T' is approximately the covariance of the coordinates, measured in a short run."""
    draws, states = np.random.default_rng(0), len(found.G)
    z, total, kept = np.zeros((states, PATHS)), np.zeros((states, states)), 0
    with np.errstate(all="ignore"):
        for tick in range(TICKS):
            values = [np.einsum("ip,ij,jp->p", z, Psi, z) + own for Psi, own in zip(found.Psi, found.c, strict=True)]
            action = np.where(draws.random(PATHS) < FORCED, len(found.c) - 1, np.argmin(values, axis=0))
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
