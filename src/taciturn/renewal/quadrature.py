"""Solution of the renewal equations of an error on quadrature nodes, and estimates of its error.

In white coordinates the error is x⁺ = F x + w with w ~ N(0, I), and is unsent in a symmetric region E. A function X of
the error, summed until the next send, satisfies

    X(x) = known(x) + ∫_E (2π)^{−n/2} exp(−½|y − F x|²) X(y) dy,

so that nodes x_j with weights turn the integral into a map from node to node.

Nodes are placed axis by axis, on the chord of the region at given coordinates on the outer axes, within a window of the
errors that occur. An axis has equidistant nodes if the window ends before the chord on both sides, and Gauss–Legendre
nodes otherwise. An outer axis has them in the angle φ, x = centre + c sin φ, as the integral over the inner axes ends
like a square root. By symmetry one node represents both x and −x.

The map of a check is a stored matrix if the nodes are few. Otherwise, as the expectation over the noise is a smooth
function of F x, it is summed at the points of a grid, one axis after the other because the nodes are nested, and
interpolated between these points; the equations are then solved by GMRES.

The window is found by iteration on coarse nodes. Then nodes become finer and the window wider until rate and excess no
longer change. The claimed error is twice the last change, which is the error of the coarser answer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt
from numpy.polynomial.legendre import leggauss

from taciturn._arrays import Array, frozen, symmetrised
from taciturn._display import Displayed
from taciturn._progress import OutOfTime, Stages
from taciturn.renewal.chain import NoQuadratureError, White

if TYPE_CHECKING:
    import scipy.sparse

STEEP = 4.0  # norm of a column of F from which on nodes are finer in proportion
SPACING = 0.8  # noise standard deviations between equidistant nodes
LONGEST_RULE = 3000  # most nodes of one rule; computing them takes seconds, with the third power of their number
FEWEST, PER_HALF_WIDTH = 10.0, 3.2  # Gauss–Legendre nodes: a constant, and per noise deviation of the half-width


class Region(Protocol):
    """Set of the errors that are not sent. It is symmetric about 0, and a line parallel to an axis meets it in one
    segment.
    """

    def extent(self, outer: Array, low: Array, high: Array) -> tuple[Array, Array]:
        """Return both ends of the line segment in the region along the next axis, for coordinates on the
        earlier axes.
        """
        ...


@dataclass(frozen=True, eq=False, repr=False)
class Ellipsoid(Displayed):
    """Ellipsoid Σ_i m_i x_i² ≤ 1 of the errors x that are not sent."""

    m: Array  # weights, (n,)

    def extent(self, outer: Array, low: Array, high: Array) -> tuple[Array, Array]:
        """Compute both ends of the ellipsoid's line segment along the next axis; they are infinite if m is 0 there."""
        axis, left = outer.shape[1], np.ones(len(outer))
        for m, x in zip(self.m, outer.T, strict=False):
            left = np.maximum(left - m * x * x, 0.0)
        chord = np.sqrt(left / self.m[axis]) if self.m[axis] > 0 else np.full(len(left), np.inf)
        return -chord, chord


@dataclass(frozen=True, eq=False, repr=False)
class ErrorRegion(Displayed):
    """Bounded region with nearly all errors that are not sent: on each axis, an interval that depends on
    earlier axes.
    """

    covariance: Array  # approximate covariance of unsent errors, (n, n)
    reach: Array  # half-width of the window on each axis, in conditional standard deviations, (n,)

    def scaled(self, factor: float) -> ErrorRegion:
        """Return this region with half-widths that are multiplied by ``factor``."""
        return ErrorRegion(self.covariance, self.reach * factor)

    def given_outer(self, outer: Array) -> tuple[Array, float]:
        """Compute mean and standard deviation of the next coordinate, conditioned on the coordinates before it."""
        d, covariance = outer.shape[1], self.covariance
        slope = np.linalg.solve(covariance[:d, :d], covariance[:d, d])
        return outer @ slope, float(np.sqrt(max(covariance[d, d] - covariance[d, :d] @ slope, 0.0)))


@dataclass(frozen=True, eq=False, repr=False)
class AxisNodes(Displayed):
    """Coordinates of quadrature nodes on one axis, in groups that belong to a node on the earlier axes."""

    x: Array  # coordinates, (places,)
    # for each point of the outer axes, the index of its first coordinate on this axis, ascending, (outer places,)
    first: npt.NDArray[np.int64]

    def gathered(self, fall: Array, sums: Array) -> Array:
        """Sum the products of ``fall`` and ``sums`` along this axis, for each node on the earlier axes."""
        # the shapes are (places, points) and (places, k) to (outer, points·k)
        ends = (*self.first[1:], len(self.x))
        parts = [fall[low:high].T @ sums[low:high] for low, high in zip(self.first, ends, strict=True)]
        return np.stack(parts).reshape(len(parts), -1)

    def scattered(self, fall: Array, sums: Array) -> Array:
        """Apply the transpose of the linear map ``gathered``; it maps (outer, points·k) to (places, k)."""
        ends = (*self.first[1:], len(self.x))
        cubes = sums.reshape(len(self.first), fall.shape[1], -1)
        return np.concatenate([fall[low:high] @ cube for low, high, cube in zip(self.first, ends, cubes, strict=True)])


@dataclass(frozen=True, eq=False, repr=False)
class QuadratureNodes(Displayed):
    """Quadrature nodes of a region that is symmetric about 0. Only one node of each pair ±x is stored."""

    x: Array  # nodes, (nodes, n)
    weight: Array  # weights, (nodes,)
    levels: tuple[AxisNodes, ...]  # the coordinates on each axis, outer axes first


class TooManyNodes(Exception):  # noqa: N818
    """Raised if a quadrature needs more nodes than the limit of the computation allows."""


@dataclass(frozen=True, eq=False)
class _Span:
    """The chord [first, last] on an axis for each node of the outer axes, and its part [low, high] in the window."""

    first: Array
    last: Array
    low: Array
    high: Array
    slack: bool


def place(white: White, region: Region, window: ErrorRegion, density: float, more: int, most: int) -> QuadratureNodes:
    """Place quadrature nodes in a region, axis by axis."""
    n = len(white.m)
    levels = list[AxisNodes]()
    x, weight = np.zeros((1, 0)), np.ones(1)
    bends = np.maximum(1.0, np.linalg.norm(white.F, axis=0) / STEEP)
    for axis in range(n):
        span = _span(x, region, window)
        rule = _equidistant if span.slack else _straight if axis == n - 1 else _angular
        afforded = 2 * most if axis == 0 else most / len(weight)  # half of the first axis is dropped, by symmetry
        inner, inner_weight = rule(span, density * float(bends[axis]), more, afforded)
        if axis == 0:
            half = inner.shape[1] // 2
            inner, inner_weight = inner[:, half:], inner_weight[:, half:]
        outer = np.repeat(np.arange(len(x)), inner.shape[1])
        x = np.hstack([np.repeat(x, inner.shape[1], axis=0), inner.reshape(-1, 1)])
        weight = (weight[:, None] * inner_weight).ravel()
        kept = weight > 0
        x, weight = x[kept], weight[kept]
        levels.append(AxisNodes(x[:, axis], np.searchsorted(outer[kept], np.arange(len(span.low)))))
    return QuadratureNodes(x, weight, tuple(levels))


def _span(outer: Array, region: Region, window: ErrorRegion) -> _Span:
    centre, deviation = window.given_outer(outer)
    reach = float(window.reach[outer.shape[1]]) * deviation
    low, high = centre - reach, centre + reach
    first, last = region.extent(outer, low, high)
    slack = bool(((low > first) & (high < last)).all())
    return _Span(first, last, np.clip(low, first, last), np.clip(high, first, last), slack)


def _equidistant(span: _Span, density: float, _: int, most: float) -> tuple[Array, Array]:
    half_width = float((span.high - span.low).max()) / 2
    spacing = SPACING / density
    half = _affordable(half_width / spacing, most / 2)
    steps = (np.arange(-half, half) + 0.5) * spacing
    x = (span.low + span.high)[:, None] / 2 + steps
    return x, np.full(x.shape, spacing)


def _straight(span: _Span, density: float, more: int, most: float) -> tuple[Array, Array]:
    half = (span.high - span.low)[:, None] / 2
    nodes, weights = _gauss(float(half.max()), density, more, most)
    return (span.high + span.low)[:, None] / 2 + half * nodes, half * weights


def _angular(span: _Span, density: float, more: int, most: float) -> tuple[Array, Array]:
    centre, chord = (span.last + span.first) / 2, (span.last - span.first) / 2
    unit = np.where(chord > 0, chord, 1.0)
    low, high = (np.arcsin(np.clip((end - centre) / unit, -1.0, 1.0)) for end in (span.low, span.high))
    half = (high - low)[:, None] / 2
    nodes, weights = _gauss(float((half[:, 0] * chord).max()), density, more, most)
    angle = (high + low)[:, None] / 2 + half * nodes
    return centre[:, None] + chord[:, None] * np.sin(angle), chord[:, None] * half * weights * np.cos(angle)


def _gauss(half_width: float, density: float, more: int, most: float) -> tuple[Array, Array]:
    half = _affordable(density * (FEWEST + PER_HALF_WIDTH * half_width) / 2 + more, min(most, LONGEST_RULE) / 2)
    return legendre(2 * half)


@lru_cache(maxsize=64)
def legendre(count: int) -> tuple[Array, Array]:
    """Return nodes and weights of Gauss–Legendre quadrature on [−1, 1]. They are computed only once."""
    nodes, weights = leggauss(count)
    return frozen(nodes), frozen(weights)


def _affordable(half: float, most: float) -> int:
    """Return half the number of nodes of an axis, as an integer."""
    if half > most:
        raise TooManyNodes
    return max(int(np.ceil(half)), 1)


STEP = 0.2  # noise standard deviations between points of the grid
STENCIL = 10  # points per axis of an interpolation
INTERPOLATED = 1e-7  # largest relative error of rate and excess due to the interpolation
NEAR = 7.0  # noise standard deviations beyond which the density of the noise is negligible
MOST_POINTS = 20_000_000
SOLVED = 1e-3  # residual of the equations, relative to the accuracy
LEAST = 1e-11  # least relative residual
DIRECTIONS, RESTARTS = 80, 2  # of GMRES


@dataclass(frozen=True, eq=False, repr=False)
class CheckMatrix(Displayed):
    """Matrix with the probability that an error moves from one quadrature node to another in a check, and is
    not sent.
    """

    entries: Array  # probability to go from the node of the row to that of the column without a send, (nodes, nodes)

    @property
    def slack(self) -> float:
        """Relative error of send rate and excess cost due to this map of a check. It is 0 for a stored matrix."""
        return 0.0

    def after(self, share: Array) -> Array:
        """Compute the probability of each node after a trigger check from the probabilities before the check."""
        return np.asarray(share @ self.entries, dtype=np.float64)

    def settled(self, known: Array) -> Array:
        """Solve X = known + entries·X: at each node, X is the expected sum of ``known`` until the next send."""
        return np.asarray(np.linalg.solve(np.eye(len(self.entries)) - self.entries, known), dtype=np.float64)

    def settled_shares(self, known: Array) -> Array:
        """Solve X = known + after(X): X is the expected number of visits to each node until the next send."""
        return CheckMatrix(self.entries.T).settled(known)


@dataclass(frozen=True, repr=False)
class QuadratureEffort(Displayed):
    """Requested accuracy of a quadrature, and the limits of its computation."""

    accuracy: float  # requested relative accuracy of rate and excess
    alive: Callable[[], None]  # called regularly; it may raise ``OutOfTime``
    dense: int  # largest number of nodes for which the map is a matrix


class GridCheck:
    """Map of one trigger check on very many quadrature nodes. It is computed by sums on a grid, without a stored
    matrix.
    """

    def __init__(self, white: White, nodes: QuadratureNodes, effort: QuadratureEffort) -> None:
        """Store the nodes and their effort."""
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
        self.read_back = self.read.T

    def ahead(self, values: Array) -> Array:
        """Compute at each node the expected value of a function at the next check. After a send, the function is 0."""
        sums = (self.scale * values)[:, None]
        for level, fall in zip(reversed(self.levels), reversed(self.falls), strict=True):
            sums = level.gathered(fall, sums)
        even = sums.reshape(self.shape)
        return np.asarray(self.read @ (even + np.flip(even)).ravel(), dtype=np.float64)

    def after(self, share: Array) -> Array:
        """Compute the probability of each node after a trigger check from the probabilities before the check."""
        even = np.asarray(self.read_back @ share, dtype=np.float64).reshape(self.shape)
        sums = (even + np.flip(even)).reshape(1, -1)
        for level, fall in zip(self.levels, self.falls, strict=True):
            sums = level.scattered(fall, sums)
        return self.scale * sums[:, 0]

    def settled(self, known: Array) -> Array:
        """Solve X = known + ahead(X): at each node, X is the expected sum of ``known`` until the next send."""
        return np.stack([self._solved(self.ahead, column) for column in known.T], axis=1)

    def settled_shares(self, known: Array) -> Array:
        """Solve X = known + after(X): X is the expected number of visits to each node until the next send."""
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


MOST_STORED_NODES = 40_000  # most nodes; their equations take seconds
DENSE, DENSEST = 1200, 6000  # nodes up to which a matrix is faster than a grid, and up to which it is affordable
COARSE = 0.5  # density of the nodes from which the window of unsent errors is found
FIRST_DENSITY, USUAL_ACCURACY = 0.53, 1e-8  # the density is proportional to the root of the number of digits
USUAL_IN_SPACE = 1e-6  # default accuracy in three dimensions
LOOSEST = 1e-4  # loosest accuracy: the error of coarser nodes cannot be estimated
NARROW = 0.85  # first window, relative to the one found with coarse nodes
FINER, WIDER = 1.25, 1.1  # factors of density and window from one answer to the next
RUNGS = 12  # attempts, each with finer nodes and a wider window
WINDOW_PASSES = 12  # iterations in which the window is sought
REACH = 8.0  # first reach of a window, in conditional standard deviations
BEYOND = 0.01  # fraction of checks and of cost that a window may cut off, relative to the accuracy
ERROR_SAFETY = 2.0  # claimed error over the last change
ROUNDING = 1e-14  # relative rounding error per check of the mean interval
USELESS = 0.01  # relative error above which an answer is rejected


@dataclass(frozen=True, eq=False, repr=False)
class System(Displayed):
    """Discretised renewal equations: distribution of the unsent error after one check, and the map of a check."""

    x: Array  # nodes, (nodes, n)
    share: Array  # weight of each node times (2π)^{-n/2}, the factor of the normal density, (nodes,)
    start: Array  # probability of each node after the first check, (nodes,)
    check: CheckMatrix | GridCheck  # the map of a check
    cost: Array  # x'Γx at each node, (nodes,)


@dataclass(frozen=True, eq=False, repr=False)
class Solved(Displayed):
    """Solution of the renewal equations: send rate, excess cost, and expected time and cost until the next send."""

    system: System  # the equations that were solved
    checks: Array  # expected checks until the next send, (nodes,)
    costs: Array  # expected cost until the next send, (nodes,)
    rate: float  # sends per check
    excess: float  # cost per check
    left: float = 0.0  # relative error of rate and excess that further policy iterations would remove

    @property
    def rounding(self) -> float:
        """Relative rounding error of the solution, which finer nodes would not reduce."""
        return ROUNDING * (1 + 1 / self.rate) + self.system.check.slack

    def moved(self, previous: Solved) -> float:
        """Compute the relative changes of send rate and excess cost since the last solution, and return the
        larger one.
        """
        excess = abs(self.excess - previous.excess) / self.excess if self.excess > 0 else 0.0
        return max(abs(self.rate - previous.rate) / self.rate, excess)


@dataclass(frozen=True, eq=False, repr=False)
class SolutionPair(Displayed):
    """Solutions of the renewal equations on coarser and finer nodes, from which the error is estimated."""

    found: Solved  # the finer solution
    rate_error: float  # absolute error of the rate
    excess_error: float  # absolute error of the excess
    previous: Solved  # the coarser solution

    @property
    def off(self) -> float:
        """Relative error of the send rate or of the excess cost, whichever is larger."""
        excess = self.found.excess
        return max(self.rate_error / self.found.rate, self.excess_error / excess if excess > 0 else 0.0)


def usual_accuracy(white: White) -> float:
    """Return the default relative accuracy, which depends on the dimension of the error."""
    return USUAL_ACCURACY if len(white.m) < 3 else USUAL_IN_SPACE


def afforded(step: int, dimensions: int) -> int:
    """Return the largest number of quadrature nodes that one attempt to solve the equations may use."""
    # The first attempt uses fewer nodes, because its error estimate needs a finer one. The exponent is n/2, not n, as
    # part of the nodes of a chord does not depend on the density.
    return MOST_STORED_NODES if step else int(MOST_STORED_NODES / FINER ** (dimensions / 2))


def most_dense(dimensions: int, accuracy: float) -> int:
    """Return the largest number of nodes for which the map of a trigger check is stored as a matrix."""
    # it is larger for a fine accuracy, which the sums on a grid do not reach
    return DENSEST if dimensions < 3 and accuracy < 10 * INTERPOLATED else DENSE


def first_density(accuracy: float) -> float:
    """Return the density of quadrature nodes for the first attempt, given the requested accuracy."""
    return FIRST_DENSITY * float(np.sqrt(np.log(min(accuracy, LOOSEST)) / np.log(USUAL_ACCURACY)))


def climb(
    attempt: Callable[[float, float, int], Solved | None], accuracy: float, less: str, instead: str, told: Stages
) -> SolutionPair:
    """Solve the renewal equations with more and more nodes, until send rate and excess cost no longer change."""
    density, factor = first_density(accuracy), NARROW
    previous, best, missed = None, None, 0
    for step in range(RUNGS):
        try:
            found = attempt(density, factor, step)
        except TooManyNodes:
            break
        except OutOfTime:
            if best is None:
                raise
            break
        missed += found is None
        if missed > 1 or (found is not None and found.rounding > USELESS):
            break  # hardly ever sent: finer nodes would not be more accurate
        if previous is not None and found is not None:
            answer = _compared(found, previous)
            best = answer if best is None or answer.off <= best.off else best
            if best.off <= max(accuracy, 2 * found.rounding):
                break
            told.at = max(told.at, float(np.log(max(best.off, accuracy)) / np.log(accuracy)))
        previous = found
        density, factor = density * FINER, factor * WIDER
    if best is None:
        raise NoQuadratureError(
            f"between sends, the error spreads over too many standard deviations of the noise for {MOST_STORED_NODES} "
            f"quadrature nodes, or sends are too rare; expected {less} or more noise for a quadrature; {instead}"
        )
    if best.off > USELESS:
        raise NoQuadratureError(
            f"with {MOST_STORED_NODES} nodes in double precision, rate and excess cost have a relative error of "
            f"{best.off:.1g}; "
            f"expected at most {USELESS:g}; use {less}, or {instead}"
        )
    return best


def find_window(white: White, region: Region, covariance: Array, effort: QuadratureEffort) -> ErrorRegion:
    """Find a bounded region that contains nearly all errors that are not sent, by iteration on coarse nodes."""
    window = ErrorRegion(covariance, np.full(len(covariance), REACH))
    accuracy, rough = min(effort.accuracy, LOOSEST), replace(effort, dense=DENSE)
    for _ in range(WINDOW_PASSES):
        try:
            system = discretise_renewal(white, place(white, region, window, COARSE, 0, MOST_STORED_NODES // 2), rough)
        except TooManyNodes:
            break
        visits = system.check.settled_shares(system.start)
        if not np.isfinite(visits).all() or visits.sum() <= 0:
            break
        found = symmetrised((system.x * visits[:, None]).T @ system.x / visits.sum())
        if np.linalg.eigvalsh(found)[0] <= 0:
            break
        reach, cut = _reach(system, visits, window, BEYOND * accuracy)
        ratio = np.linalg.eigvals(np.linalg.solve(window.covariance, found)).real
        if not cut.any() and ratio.min() > 0.8 and ratio.max() < 1.1:
            return ErrorRegion(window.covariance, reach)
        # widen only axes that the window cuts off; on others the chord ends before the window
        window = ErrorRegion(found, np.where(cut, 1.5 * window.reach, window.reach))
    return window


def discretise_renewal(white: White, nodes: QuadratureNodes, effort: QuadratureEffort) -> System:
    """Discretise the renewal equations on quadrature nodes. By symmetry, one node represents both x and −x."""
    n = len(white.m)
    density = (2 * np.pi) ** (-n / 2) * nodes.weight
    start = 2 * density * np.exp(-0.5 * (nodes.x * nodes.x).sum(axis=1))
    effort.alive()
    if len(start) > effort.dense:
        check = GridCheck(white, nodes, effort)
    else:
        kernel = gaussian_factors(nodes.x @ white.F.T, nodes.x)
        kernel += gaussian_factors(nodes.x @ white.F.T, -nodes.x)
        kernel *= density
        check = CheckMatrix(kernel)
    return System(nodes.x, density, start, check, ((nodes.x @ white.Gamma) * nodes.x).sum(axis=1))


def solve_on_nodes(white: White, nodes: QuadratureNodes, effort: QuadratureEffort) -> Solved | None:
    """Solve the renewal equations on the given nodes. Return None if the nodes are too coarse."""
    system = discretise_renewal(white, nodes, effort)
    known = np.stack([np.ones(len(system.start)), system.cost], axis=1)
    solution = system.check.settled(known)
    checks, cost = 1 + float(system.start @ solution[:, 0]), float(system.start @ solution[:, 1])
    if not np.isfinite(solution).all() or checks < 1 or cost < 0:
        return None
    return Solved(system, solution[:, 0], solution[:, 1], 1 / checks, cost / checks)


def _reach(system: System, visits: Array, window: ErrorRegion, share: float) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Return the reach of each axis that leaves out at most a share of checks and cost, and which axes are cut off."""
    # an axis is cut off if more than this share lies at the edge of the window
    weight = visits / visits.sum()
    if system.cost.any():
        weight = weight + visits * system.cost / (visits @ system.cost)
    reach, cut = np.empty_like(window.reach), np.zeros(len(window.reach), dtype=bool)
    for axis in range(len(reach)):
        centre, deviation = window.given_outer(system.x[:, :axis])
        away = np.abs(system.x[:, axis] - centre) / deviation
        order = np.argsort(-away)
        beyond = np.cumsum(weight[order])
        least = float(away[order[min(np.searchsorted(beyond, share), len(order) - 1)]])
        reach[axis] = 1.0 + 1.1 * least
        cut[axis] = least > window.reach[axis] - 2 / deviation - 0.5
    return reach, cut


def gaussian_factors(means: Array, x: Array) -> Array:
    """Compute the Gaussian factors exp(−½|x_j − mean_i|²) for all means and all points."""
    # from differences, because squares of large coordinates would cancel
    power = np.zeros((len(means), len(x)))
    for axis in range(x.shape[1]):
        difference = means[:, axis, None] - x[:, axis]
        difference *= difference
        power += difference
    power *= -0.5
    np.maximum(power, -600.0, out=power)  # subnormal numbers are slow
    return np.exp(power, out=power)


def _compared(found: Solved, previous: Solved) -> SolutionPair:
    """Return a solution with its error: the change from the coarser solution, and rounding."""
    floor = found.rounding + ERROR_SAFETY * found.left
    return SolutionPair(
        found,
        ERROR_SAFETY * abs(found.rate - previous.rate) + floor * found.rate,
        ERROR_SAFETY * abs(found.excess - previous.excess) + floor * found.excess,
        previous,
    )
