"""Optimal send schedule for a given price per send, by policy iteration on the renewal equations.

The error before a check is e⁺ = F e + w. A send resets it to 0 at the price λ; an unsent error costs e⁺'Γe⁺. The rule
with the least mean cost g per check is

    send iff U(e) > 0,   U(e) = e'Γe − g + E min(0, U(F e + w)),   g such that λ − g + E min(0, U(w)) = 0.

U is the cost of silence minus that of a send. Policy iteration: the renewal equations of a region of unsent errors give
T(e) and C(e), the expected checks and cost until the next send, and with them g = (C₀ + λ)/T₀ and U. The errors with
U < 0 form the next region (``improve``), whose cost is lower. Four or five iterations converge.

The expectation in U is a sum of Gaussians over the nodes x_k of the quadrature, Σ_k v_k φ(x_k − F x). So U and its
derivatives have a closed form at any x (``ContinuationRegion``), and the ends of the region along an axis are found by
Newton's method: where the least U over the later axes changes its sign.

The quadrature is that of a threshold (``taciturn.renewal.quadrature``): nodes on nested chords, with a resolution and a
window that are increased together until rate and excess no longer change. A region that is not convex may have gaps on
these chords. The visits to the nodes in the gaps give the cost of ignoring them (``holes``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from taciturn.extend import (
    NO_VARIANCE,
    Array,
    ArrayLike,
    Displayed,
    Progress,
    Stages,
    array,
    check_time,
    number,
    semidefinite,
    square,
)
from taciturn.renewal.chain import AGES, Chain, NoQuadratureError, Renewal, White, unsent_covariance, whiten
from taciturn.renewal.gaussian import intervals
from taciturn.renewal.quadrature import (
    COARSE,
    ERROR_SAFETY,
    LOOSEST,
    MOST_STORED_NODES,
    Ellipsoid,
    ErrorRegion,
    QuadratureEffort,
    Region,
    Solved,
    TooManyNodes,
    climb,
    find_window,
    gaussian_factors,
    most_dense,
    place,
    solve_on_nodes,
    usual_accuracy,
)

MOST_ENTRIES = 4_000_000  # entries of a table in memory
BATCH = 256  # neighbouring points that are evaluated together
NEAR = 9.0  # noise standard deviations beyond which the density of the noise is negligible
SHARP = 1e-13  # relative accuracy of an end of the region
FLAT = 1e-10  # accuracy of the position of a minimum, in noise standard deviations; its value has the squared error
NEWTON_ROUNDS = 60
STRIDE = 1.0  # length of the first step to a minimum, in noise standard deviations
LEAST_CURVED = 1e-9  # least curvature in a Newton step, relative to the largest


@dataclass(frozen=True, eq=False, repr=False)
class ContinuationRegion(Displayed):
    """The errors x that are not sent: those with U(x) < 0, where U(x) = Σ_i m_i x_i² − g + Σ_k v_k φ(x_k − F x)."""

    white: White  # the chain, with costs in units of the price of a send
    x: Array  # nodes, one of each pair ±x, (nodes, n)
    v: Array  # weight of each node times U at the node, (nodes,)
    deepest: float  # −U at the node where it is lowest, the largest saving of silence
    cost: float  # g, the mean cost per check
    covariance: Array  # approximate covariance of unsent errors, (n, n)

    @cached_property
    def _pairs(self) -> tuple[Array, Array]:
        """All nodes ±x, sorted along the longest axis, and their coefficients for value, gradient and curvature."""
        x, v = np.vstack([self.x, -self.x]), np.tile(self.v, 2)[:, None]
        order = np.argsort(x[:, self._longest])
        x, v = x[order], v[order]
        first, second = np.triu_indices(x.shape[1])
        return x, np.hstack([v, v * x, v * x[:, first] * x[:, second]])

    @cached_property
    def _longest(self) -> int:
        return int(np.abs(self.x).max(axis=0).argmax())

    def values(self, x: Array) -> Array:
        """Return U(x), the cost of not sending minus the cost of a send, at each of the points x."""
        return self._moments(x, 1)[:, 0] + (x * x) @ self.white.m - self.cost

    def slopes(self, x: Array) -> tuple[Array, Array]:
        """Return U(x), the cost of not sending minus the cost of a send, and its gradient at each of the points x."""
        # the gradient of Σ v_k φ(x_k − z) at z = F x is Σ v_k (x_k − z) φ; the chain rule multiplies it by F
        n, F = x.shape[1], self.white.F
        sums = self._moments(x, 1 + n)
        ahead = sums[:, 1:] - (x @ F.T) * sums[:, :1]
        return sums[:, 0] + (x * x) @ self.white.m - self.cost, ahead @ F + 2 * self.white.m * x

    def curves(self, x: Array) -> tuple[Array, Array, Array]:
        """Return U(x), the cost of not sending minus the cost of a send, with its first and second derivatives."""
        n, F = x.shape[1], self.white.F
        sums, z = self._moments(x, 1 + n + n * (n + 1) // 2), x @ F.T
        ahead = sums[:, 1 : 1 + n] - z * sums[:, :1]
        first, second = np.triu_indices(n)
        square = np.empty((len(x), n, n))
        square[:, first, second] = square[:, second, first] = sums[:, 1 + n :]
        across = z[:, :, None] * sums[:, None, 1 : 1 + n]
        square += z[:, :, None] * z[:, None] * sums[:, :1, None] - across - across.swapaxes(1, 2)
        square -= sums[:, :1, None] * np.eye(n)
        value = sums[:, 0] + (x * x) @ self.white.m - self.cost
        return value, ahead @ F + 2 * self.white.m * x, F.T @ square @ F + 2 * np.diag(self.white.m)

    def extent(self, outer: Array, low: Array, high: Array) -> tuple[Array, Array]:
        """Find both ends of the region along one coordinate axis, for given coordinates on the axes before it.

        At the ends, the minimum of U over the later axes changes its sign.
        """
        axis = outer.shape[1]
        inside, empty = self._inside(outer)
        last = self._end(inside, axis, np.maximum(high, inside[:, axis]), high - low)
        if axis == 0:
            return -last, last
        turned = self._end(-inside, axis, np.maximum(-low, -inside[:, axis]), high - low)
        return np.where(empty, inside[:, axis], -turned), np.where(empty, inside[:, axis], last)

    def _inside(self, outer: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Return for each outer point a full point with U < 0, and whether none exists."""
        # two cheap candidates, the conditional mean and 0; U is minimised only where both have U ≥ 0
        axis, covariance = outer.shape[1], self.covariance
        slope = np.linalg.solve(covariance[:axis, :axis], covariance[:axis, axis:])
        usual, middle = np.hstack([outer, outer @ slope]), np.hstack([outer, 0 * (outer @ slope)])
        first, second = self.values(usual), self.values(middle)
        found, least = np.where((first < second)[:, None], usual, middle), np.minimum(first, second)
        unsure = np.flatnonzero(least >= 0)
        if unsure.size:
            found[unsure], least[unsure], _ = self._lowest(found[unsure], axis)
        return found, least >= 0

    def _end(self, inside: Array, axis: int, limit: Array, span: Array) -> Array:
        """Return the upper end of the region on an axis, where the minimum of U over later axes becomes positive."""
        outer = (inside[:, :axis] ** 2) @ self.white.m[:axis]
        m, below = float(self.white.m[axis]), inside[:, axis].copy()
        most = np.maximum(self.cost + self.deepest - outer, 0.0)  # U > 0 if silence costs more than this now
        natural = np.sqrt(most / m) if m > 0 else np.full(len(most), np.inf)
        above = np.maximum(np.minimum(limit, natural), below)
        points = inside.copy()
        points[:, axis] = above
        points, value, slope = self._lowest_slope(points, axis)
        beyond = value <= 0
        end = np.where(beyond & (limit <= natural), limit + span, above)
        rows = np.flatnonzero(~beyond)
        points, value, slope, below, above = points[rows], value[rows], slope[rows], below[rows], above[rows]
        size = np.maximum(np.abs(below), np.abs(above))
        # Newton's method within the bracket [below, above], bisection where it leaves it
        for _ in range(NEWTON_ROUNDS):
            check_time()
            if not rows.size:
                break
            here = points[:, axis]
            above, below = np.where(value > 0, here, above), np.where(value > 0, below, here)
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                to = here - value / slope
            to = np.where((to >= below) & (to <= above), to, (below + above) / 2)
            going = np.abs(to - here) > SHARP * size
            end[rows] = to
            rows, points = rows[going], points[going]
            below, above, size = below[going], above[going], size[going]
            points[:, axis] = to[going]
            if rows.size:
                points, value, slope = self._lowest_slope(points, axis)
        return end

    def _lowest_slope(self, points: Array, axis: int) -> tuple[Array, Array, Array]:
        """Return the points that minimise U over the axes after ``axis``, U there, and its slope along ``axis``."""
        if axis == points.shape[1] - 1:
            value, gradient = self.slopes(points)
        else:
            points, value, gradient = self._lowest(points, axis + 1)
        return points, value, gradient[:, axis]

    def _lowest(self, points: Array, axis: int) -> tuple[Array, Array, Array]:
        """Return the points that minimise U over this axis and all later ones, U there, and its gradient."""
        points = points.copy()
        value, gradient, curvature = self.curves(points)
        # Newton steps of limited length: the limit doubles after a descent, and shrinks when U would increase
        rows, stride = np.arange(len(points)), np.full(len(points), STRIDE)
        for _ in range(NEWTON_ROUNDS):
            check_time()
            step = _downhill(gradient[rows, axis:], curvature[rows, axis:, axis:])
            length = np.linalg.norm(step, axis=1)
            going = length > FLAT
            rows, step, length = rows[going], step[going], length[going]
            if not rows.size:
                break
            step *= np.minimum(1.0, stride[rows] / length)[:, None]
            there = points[rows]
            there[:, axis:] += step
            tried = self.curves(there)
            lower = tried[0] <= value[rows]
            stride[rows] = np.where(lower, 2 * stride[rows], np.minimum(stride[rows], length) / 4)
            better = rows[lower]
            points[better] = there[lower]
            value[better], gradient[better], curvature[better] = (part[lower] for part in tried)
            rows = rows[lower | (stride[rows] > FLAT)]
        return points, value, gradient

    def _moments(self, x: Array, count: int) -> Array:
        """Return the first ``count`` noise-weighted sums of v, v x and v x x' over the nodes, (points, count)."""
        nodes, coefficients = self._pairs
        z, sums = x @ self.white.F.T, np.empty((len(x), count))
        # points are sorted, so that a batch needs only the nodes within NEAR along the longest axis
        along, places = z[:, self._longest], nodes[:, self._longest]
        order = np.argsort(along)
        rows = max(min(MOST_ENTRIES // len(nodes), BATCH), 1)
        for first in range(0, len(x), rows):
            part = order[first : first + rows]
            low, high = np.searchsorted(places, (along[part[0]] - NEAR, along[part[-1]] + NEAR))
            sums[part] = gaussian_factors(z[part], nodes[low:high]) @ coefficients[low:high, :count]
        return sums


def improve(white: White, solved: Solved, window: ErrorRegion) -> ContinuationRegion:
    """Improve the policy: return the set of errors not to send, from the cost difference U of the present policy."""
    system, dear = solved.system, beyond_a_send(solved)
    deepest = float(np.maximum(-dear, 0.0).max())
    return ContinuationRegion(
        white, system.x, system.share * dear, deepest, solved.excess + solved.rate, window.covariance
    )


def beyond_a_send(solved: Solved) -> Array:
    """Return U at each node, the cost of not sending minus the cost of a send, divided by the price, shape (nodes,)."""
    return solved.costs - (solved.excess + solved.rate) * solved.checks


def holes(solved: Solved, negligible: float) -> tuple[float, float, float]:
    """Compute how rate, excess cost and cost change if every error is sent at which a send costs less.

    A chord through a region that is not convex contains nodes at which a send costs less than silence. Removing a node
    changes a mean by the number of visits to the node times the change of the expected future by a send there. This is
    exact if the visits are counted after the removal.
    """
    dear = beyond_a_send(solved)
    inside = dear > negligible
    if not inside.any():
        return 0.0, 0.0, 0.0
    visits = np.maximum(solved.system.check.settled_shares(solved.system.start), 0.0) * inside
    checks, costs = float(visits @ solved.checks), float(visits @ solved.costs)
    rate, excess = solved.rate, solved.excess
    return rate * rate * checks, rate * abs(costs - excess * checks), rate * float(visits @ dear)


def _downhill(gradient: Array, curvature: Array) -> Array:
    """Return Newton steps, with the absolute values of the curvatures so that they always descend."""
    values, turn = np.linalg.eigh(curvature)
    values = np.abs(values)
    values = np.maximum(values, LEAST_CURVED * values.max(axis=1, keepdims=True) + np.finfo(float).tiny)
    along = (turn * gradient[:, :, None]).sum(axis=1)
    return -(turn * (along / values)[:, None]).sum(axis=2)


ROUGHLY = 1e-4  # relative accuracy to which the policy is iterated on coarse nodes
ROUNDS = 12  # of policy iteration on one set of nodes; it converges like Newton's method
LITTLE = 0.1  # remaining error of the policy iteration, as a fraction of the accuracy
BOUNDARY = 2.5  # factor on the error of the nodes: two answers may share part of the error of the boundary
START = 2.0  # first boundary, times the cost of the best period: about right in a few dimensions
SPLIT = 1e-3  # relative loss in cost that is accepted because the region has no holes
OTHERWISE = "use the policy 'near-optimal', which supports any number of states, and simulate it"


@dataclass(frozen=True, eq=False, repr=False)
class Optimum(Renewal):
    """Optimal send schedule for a price per send, with its rate, its cost, and bounds on their quadrature errors."""

    cost: float  # g = excess + price · rate, the least mean cost per check
    cost_error: float  # claimed absolute error of the cost
    price: float  # λ, the price of a send
    iterations: int  # number of policy iterations
    # the errors that are not sent, in coordinates with white noise and in units of the price
    region: ContinuationRegion

    def value(self, e: ArrayLike) -> Array:
        """Return U(e), the cost of not sending minus the cost of a send, for errors e before the decision.

        Beyond the window of the quadrature, where errors hardly ever occur, U(e) = e'Γe − g is returned.
        """
        states = self.region.white.rows.shape[1]
        given = np.asarray(e)
        points = array("e", given.reshape(-1, given.shape[-1] if given.ndim else 1), (None, states), "(…, n)")
        return self.price * self.region.values(points @ self.region.white.rows.T).reshape(given.shape[:-1])

    def sends(self, e: ArrayLike) -> np.typing.NDArray[np.bool_]:
        """Return, for each error e, whether the optimal schedule sends it: true if not sending costs more, U(e) > 0."""
        return self.value(e) > 0


def solve_optimal(
    F: ArrayLike,
    noise: ArrayLike,
    Gamma: ArrayLike,
    price: float,
    accuracy: float | None = None,
    progress: Progress | None = None,
) -> Optimum:
    """Compute the schedule with the least mean cost per check, which is e'Γe without a send and the price with one."""
    F = square("F", F)
    n = len(F)
    noise, Gamma = semidefinite("noise", noise, n), semidefinite("Gamma", Gamma, n)
    price = number("price", price, 0.0)
    white = whiten(Chain(F, noise, Gamma, price, Gamma / price), OTHERWISE)
    white = replace(white, Gamma=np.diag(white.m))
    accuracy = number("accuracy", usual_accuracy(white) if accuracy is None else accuracy, 0.0, 1.0)
    told = Stages(progress)
    iteration = _Iteration(white, accuracy, told)
    best = climb(iteration.attempt, accuracy / BOUNDARY, "a lower price", "near-optimal instead", told)
    found, costs = best.found, [solved.excess + solved.rate for solved in (best.found, best.previous)]
    gaps = _gaps(found, accuracy)
    return Optimum(
        rate=found.rate,
        excess=price * found.excess,
        rate_error=BOUNDARY * best.rate_error + ERROR_SAFETY * gaps[0],
        excess_error=price * (BOUNDARY * best.excess_error + ERROR_SAFETY * gaps[1]),
        intervals=intervals(found.system.start, found.system.check, found.checks, 1 / found.rate),
        nodes=len(found.system.start),
        cost=price * costs[0],
        cost_error=price * (BOUNDARY * ERROR_SAFETY * (abs(costs[0] - costs[1]) + gaps[2]) + found.rounding * costs[0]),
        price=price,
        iterations=iteration.count,
        region=improve(white, found, iteration.window),
    )


class _Iteration:
    """Policy iteration on the region of unsent errors; the nodes are placed anew in every iteration."""

    def __init__(self, white: White, accuracy: float, told: Stages) -> None:
        self.white = white
        self.effort = QuadratureEffort(accuracy, told.tick, most_dense(len(white.m), accuracy))
        self.settled = LITTLE * min(accuracy, LOOSEST)
        self.count = 0
        self.found: Solved | None = None
        soft = replace(white, m=white.m / min(START * _periodic(white), 1.0))
        self.region: Region = Ellipsoid(soft.m)
        self.window = find_window(white, self.region, unsent_covariance(soft), self.effort)
        try:
            self._iterate(COARSE, 1.0, 0, MOST_STORED_NODES // 2, ROUGHLY)
        except TooManyNodes:
            return
        self.window = find_window(white, self.region, self.window.covariance, self.effort)

    def attempt(self, density: float, factor: float, step: int) -> Solved | None:
        """Compute the optimal schedule with a given density of quadrature nodes, on a region scaled by ``factor``."""
        found = self._iterate(density, factor, step, MOST_STORED_NODES, self.settled)
        if found is not None and step == 1:
            _gaps(found, ROUGHLY)  # rejects a region with holes before many nodes are used
        return found

    def _iterate(self, density: float, factor: float, step: int, most: int, settled: float) -> Solved | None:
        window: ErrorRegion = self.window.scaled(factor)
        before = NO_VARIANCE
        for _ in range(ROUNDS):
            check_time()
            found = solve_on_nodes(self.white, place(self.white, self.region, window, density, step, most), self.effort)
            if found is None:
                return None
            self.count += 1
            moved = 1.0 if self.found is None else found.moved(self.found)
            # the next change is smaller by at least the last ratio; the first change is also due to the new nodes, so
            # that all of it counts as the remaining error
            found = replace(found, left=moved * min(1.0, moved / before))
            self.region, self.found, before = improve(self.white, found, window), found, max(moved, NO_VARIANCE)
            if found.left <= settled:
                break
        return self.found


def _gaps(solved: Solved, negligible: float) -> tuple[float, float, float]:
    """Return the errors of rate, excess and cost from ignoring holes in the region; reject a large error."""
    gaps = holes(solved, negligible)
    if gaps[2] > SPLIT * (solved.excess + solved.rate):
        raise NoQuadratureError(
            "the region of errors in which the policy does not send has gaps, and ignoring these gaps costs "
            f"{gaps[2]:.1g} times the price of a send per check; expected a region without gaps along every axis; "
            f"{OTHERWISE}"
        )
    return gaps


def _periodic(white: White) -> float:
    """Return the cost of the best periodic schedule, in units of the price."""
    spreads, total, best = np.zeros_like(white.F), 1.0, 1.0
    for checks in range(1, AGES):
        check_time()
        spreads = white.F @ spreads @ white.F.T + np.eye(len(white.m))
        total += float(white.m @ np.diag(spreads))
        if total >= best * (checks + 1):
            break
        best = total / (checks + 1)
    return best
