"""Effect of one trigger check on functions of the error at quadrature nodes, as a matrix or by sums on a grid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from taciturn._arrays import Array
from taciturn.renewal._quadrature_nodes import QuadratureNodes, TooManyNodes
from taciturn.renewal._white_coordinates import White

if TYPE_CHECKING:
    import scipy.sparse

STEP = 0.2  # noise standard deviations between points of the grid
STENCIL = 10  # points per axis of an interpolation
INTERPOLATED = 1e-7  # largest relative error of rate and excess due to the interpolation
NEAR = 7.0  # noise standard deviations beyond which the density of the noise is negligible
MOST_POINTS = 20_000_000
SOLVED = 1e-3  # residual of the equations, relative to the accuracy
LEAST = 1e-11  # least relative residual
DIRECTIONS, RESTARTS = 80, 2  # of GMRES


@dataclass(frozen=True, eq=False)
class CheckMatrix:
    """Matrix of the probabilities that one trigger check moves an unsent error from one quadrature node to another.

    Args:
        entries: probability to go from the node of the row to that of the column without a send, (nodes, nodes).
    """

    entries: Array

    @property
    def slack(self) -> float:
        """Relative error that this map causes in send rate and excess cost; it is 0 for a stored matrix."""
        return 0.0

    def after(self, share: Array) -> Array:
        """Return the probability of each node after a trigger check, given the probabilities before the check."""
        return np.asarray(share @ self.entries, dtype=np.float64)

    def settled(self, known: Array) -> Array:
        """Return, for each node, the expected sum X of ``known`` until the next send: X = known + entries·X."""
        return np.asarray(np.linalg.solve(np.eye(len(self.entries)) - self.entries, known), dtype=np.float64)

    def settled_shares(self, known: Array) -> Array:
        """Return expected visits X to each node until the next send, X = known + after(X), from given first visits."""
        return CheckMatrix(self.entries.T).settled(known)


@dataclass(frozen=True)
class QuadratureEffort:
    """Requested accuracy of a quadrature, and limits on its computation.

    Args:
        accuracy: requested relative accuracy of rate and excess.
        alive: called regularly; it may raise ``OutOfTime``.
        dense: largest number of nodes for which the map is a matrix.
    """

    accuracy: float
    alive: Callable[[], None]
    dense: int


class GridCheck:
    """Effect of one trigger check on functions of the error at many quadrature nodes, computed by sums on a grid.

    The expectation over the noise is a smooth function of the error without noise, F x. So it is summed at the points
    of a grid, one axis after the other because the nodes are nested, and interpolated between these points.

    Args:
        white: the chain.
        nodes: nodes at which values are given.
        effort: accuracy to which the equations are solved.

    Raises:
        TooManyNodes: the grid would be too large.
    """

    def __init__(self, white: White, nodes: QuadratureNodes, effort: QuadratureEffort) -> None:
        self.effort, self.slack = effort, INTERPOLATED + SOLVED * effort.accuracy
        self.scale = (2 * np.pi) ** (-len(white.m) / 2) * nodes.weight
        self.levels = nodes.levels
        means = nodes.x @ white.F.T
        reach = np.minimum(np.abs(nodes.x).max(axis=0) + NEAR, np.abs(means).max(axis=0) + STEP)
        halves = np.ceil(reach / STEP).astype(int) + STENCIL
        self.shape = tuple(int(2 * half + 1) for half in halves)
        widest = max(len(nodes.levels[0].x), self.shape[0]) * np.prod(self.shape[1:], dtype=float)
        if widest > MOST_POINTS:
            raise TooManyNodes
        axes = [np.linspace(-STEP * int(half), STEP * int(half), 2 * int(half) + 1) for half in halves]
        self.falls = [
            np.exp(-0.5 * np.square(level.x[:, None] - axis)) for level, axis in zip(self.levels, axes, strict=True)
        ]
        self.read = _stencils(means, halves, self.shape)

    def ahead(self, values: Array) -> Array:
        """Return, for each node, the expectation of a function at the next check; its value after a send is 0."""
        sums = (self.scale * values)[:, None]
        for level, fall in zip(reversed(self.levels), reversed(self.falls), strict=True):
            sums = level.gathered(fall, sums)
        even = sums.reshape(self.shape)
        return np.asarray(self.read @ (even + np.flip(even)).ravel(), dtype=np.float64)

    def after(self, share: Array) -> Array:
        """Return the probability of each node after a trigger check, given the probabilities before the check."""
        even = np.asarray(self._read_back @ share, dtype=np.float64).reshape(self.shape)
        sums = (even + np.flip(even)).reshape(1, -1)
        for level, fall in zip(self.levels, self.falls, strict=True):
            sums = level.scattered(fall, sums)
        return self.scale * sums[:, 0]

    @cached_property
    def _read_back(self) -> scipy.sparse.csc_matrix:
        return self.read.T

    def settled(self, known: Array) -> Array:
        """Return, for each node, the expected sum X of ``known`` until the next send: X = known + ahead(X).

        The result is NaN if GMRES does not converge. Each column is solved separately.
        """
        return np.stack([self._solved(self.ahead, column) for column in known.T], axis=1)

    def settled_shares(self, known: Array) -> Array:
        """Return expected visits X to each node until the next send, X = known + after(X), from given first visits.

        The result is NaN if GMRES does not converge.
        """
        return self._solved(self.after, known)

    def _solved(self, check: Callable[[Array], Array], known: Array) -> Array:
        """Return x with x = known + check(x), by GMRES; NaN if the iteration does not converge."""
        import scipy.sparse.linalg  # takes 0.2 s, and few answers need it

        def less(x: Array) -> Array:
            self.effort.alive()
            return x - check(x)

        operator = scipy.sparse.linalg.LinearOperator((len(known), len(known)), matvec=less, dtype=np.float64)
        tolerance = max(SOLVED * self.effort.accuracy, LEAST)
        found, failed = scipy.sparse.linalg.gmres(
            operator, known, rtol=tolerance, atol=0.0, restart=DIRECTIONS, maxiter=RESTARTS
        )
        return np.full(len(known), np.nan) if failed else np.asarray(found, dtype=np.float64)


def _stencils(means: Array, halves: Array, shape: tuple[int, ...]) -> scipy.sparse.csr_matrix:
    """Return the matrix that interpolates from a grid to the means, by Lagrange polynomials through nearby points."""
    import scipy.sparse

    place = means / STEP
    inside = np.flatnonzero((np.abs(place) <= halves - STENCIL // 2).all(axis=1))
    first = np.floor(place[inside]).astype(int) - STENCIL // 2 + 1
    points = np.zeros((len(inside), 1), dtype=np.int64)
    weights = np.ones((len(inside), 1))
    for axis, size in enumerate(shape):
        along = first[:, axis, None] + np.arange(STENCIL)
        each = _lagrange(place[inside, axis, None] - along)
        points = (points[:, :, None] * size + (along + int(halves[axis]))[:, None]).reshape(len(inside), -1)
        weights = (weights[:, :, None] * each[:, None]).reshape(len(inside), -1)
    rows = np.zeros(len(means) + 1, dtype=np.int64)
    rows[inside + 1] = points.shape[1]
    return scipy.sparse.csr_matrix(
        (weights.ravel(), points.ravel(), np.cumsum(rows)), shape=(len(means), int(np.prod(shape)))
    )


def _lagrange(away: Array) -> Array:
    """Return the Lagrange weights of STENCIL points with spacing 1, given the distances to them, (places, STENCIL)."""
    weights = np.ones_like(away)
    for k in range(STENCIL):
        for other in range(STENCIL):
            if other != k:
                weights[:, k] *= away[:, other] / (k - other)
    return weights
