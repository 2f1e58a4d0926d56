"""Errors that the optimal scheduler keeps: a region whose boundary is where the value of a send is nought."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array
from taciturn.renewal._nodes import Window
from taciturn.renewal._system import Solved, gauss
from taciturn.renewal._whiten import White

MOST_ENTRIES = 4_000_000  # of a table at once
BATCH = 256  # points that are near each other
NEAR = 9.0  # noise standard deviations beyond which nothing comes
SHARP = 1e-13  # relative width of an end
FLAT = 1e-10  # noise standard deviations, of a minimum: the value at it is right to the square
ROUNDS = 60
STRIDE = 1.0  # noise standard deviations, of the first step to a minimum
LEAST_CURVED = 1e-9  # relative to the largest curvature


@dataclass(frozen=True, eq=False)
class Quiet:
    """What silence costs more than a send, U(x) = Σ_i m_i x_i² − g + E min(0, U(F x + w)), and where it is negative.

    The expectation is a sum of Gaussians, Σ_k v_k φ(x_k − F x), so U and its derivatives are known everywhere.

    Args:
        white: the chain, in units of the price of a send.
        x: nodes, of which −x is one too, (nodes, n).
        v: weight of a node times what silence costs there, (nodes,).
        deepest: the most that silence saves at a node.
        cost: g.
        covariance: of kept errors, about, (n, n).
    """

    white: White
    x: Array
    v: Array
    deepest: float
    cost: float
    covariance: Array

    @cached_property
    def _pairs(self) -> tuple[Array, Array]:
        """Both of each pair of nodes along their longest axis; the coefficients of value, gradient and curvature."""
        x, v = np.vstack([self.x, -self.x]), np.tile(self.v, 2)[:, None]
        order = np.argsort(x[:, self._longest])
        x, v = x[order], v[order]
        first, second = np.triu_indices(x.shape[1])
        return x, np.hstack([v, v * x, v * x[:, first] * x[:, second]])

    @cached_property
    def _longest(self) -> int:
        return int(np.abs(self.x).max(axis=0).argmax())

    def values(self, x: Array) -> Array:
        """Return U, (points, n) to (points,)."""
        return self._moments(x, 1)[:, 0] + (x * x) @ self.white.m - self.cost

    def slopes(self, x: Array) -> tuple[Array, Array]:
        """Return U and its gradient."""
        n, F = x.shape[1], self.white.F
        sums = self._moments(x, 1 + n)
        ahead = sums[:, 1:] - (x @ F.T) * sums[:, :1]
        return sums[:, 0] + (x * x) @ self.white.m - self.cost, ahead @ F + 2 * self.white.m * x

    def curves(self, x: Array) -> tuple[Array, Array, Array]:
        """Return U, its gradient and its second derivatives."""
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
        """Return the ends of the next axis: where the least of U over what is inside of it changes its sign.

        Args:
            outer: (places, outer axes).
            low: where the window begins, (places,).
            high: where it ends, (places,).

        Returns:
            The ends, within the window to rounding; beyond it where it is beyond; one number twice where U > 0.
        """
        axis = outer.shape[1]
        inside, empty = self._inside(outer)
        last = self._end(inside, axis, np.maximum(high, inside[:, axis]), high - low)
        if axis == 0:
            return -last, last
        turned = self._end(-inside, axis, np.maximum(-low, -inside[:, axis]), high - low)
        return np.where(empty, inside[:, axis], -turned), np.where(empty, inside[:, axis], last)

    def _inside(self, outer: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Return a place where U < 0 above each of the outer ones, and whether there is none."""
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
        """Return where U, at its least over the later axes, ceases to be negative on the way up one axis."""
        outer = (inside[:, :axis] ** 2) @ self.white.m[:axis]
        m, below = float(self.white.m[axis]), inside[:, axis].copy()
        most = np.maximum(self.cost + self.deepest - outer, 0.0)  # U > 0 where silence costs more than that
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
        for _ in range(ROUNDS):
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
        """Return the points where U is least over the axes after one, U and its slope along that one."""
        if axis == points.shape[1] - 1:
            value, gradient = self.slopes(points)
        else:
            points, value, gradient = self._lowest(points, axis + 1)
        return points, value, gradient[:, axis]

    def _lowest(self, points: Array, axis: int) -> tuple[Array, Array, Array]:
        """Return the points where U is least over this axis and the later ones, U and its gradient; by Newton steps."""
        points = points.copy()
        value, gradient, curvature = self.curves(points)
        rows, stride = np.arange(len(points)), np.full(len(points), STRIDE)
        for _ in range(ROUNDS):
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
        """Return the first sums of v, v x, v x x' over the nodes, as the noise spreads them, (points, count)."""
        nodes, coefficients = self._pairs
        z, sums = x @ self.white.F.T, np.empty((len(x), count))
        along, places = z[:, self._longest], nodes[:, self._longest]
        order = np.argsort(along)
        rows = max(min(MOST_ENTRIES // len(nodes), BATCH), 1)
        for first in range(0, len(x), rows):
            part = order[first : first + rows]
            low, high = np.searchsorted(places, (along[part[0]] - NEAR, along[part[-1]] + NEAR))
            sums[part] = gauss(z[part], nodes[low:high]) @ coefficients[low:high, :count]
        return sums


def improve(white: White, solved: Solved, window: Window) -> Quiet:
    """Return what silence costs more than a send where the region of a solution is kept later on.

    Its negative part is a region that costs less: a step of policy iteration.

    Args:
        white: the chain, in units of the price of a send.
        solved: the renewal equations of the region.
        window: where kept errors are.

    Returns:
        The new region.

    Source: khashooei2017
    """
    system, dear = solved.system, beyond_a_send(solved)
    deepest = float(np.maximum(-dear, 0.0).max())
    return Quiet(white, system.x, system.share * dear, deepest, solved.excess + solved.rate, window.covariance)


def beyond_a_send(solved: Solved) -> Array:
    """Return what silence costs more than a send at the nodes, in units of its price, (nodes,)."""
    return solved.costs - (solved.excess + solved.rate) * solved.checks


def holes(solved: Solved, negligible: float) -> tuple[float, float, float]:
    """Return by how much rate, excess and cost differ from those of a region without the nodes that should be sent.

    A chord through a region that is not convex has such nodes. Leaving a node out changes a mean by how often it is
    visited times how much a send there changes what is to come: exactly, if the visits are those after the change.

    Args:
        solved: in units of the price.
        negligible: what silence may cost more than a send.

    Returns:
        Rate, excess, cost.

    Source: khashooei2017
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
    """Return Newton's steps, with the curvature taken positive."""
    values, turn = np.linalg.eigh(curvature)
    values = np.abs(values)
    values = np.maximum(values, LEAST_CURVED * values.max(axis=1, keepdims=True) + np.finfo(float).tiny)
    along = (turn * gradient[:, :, None]).sum(axis=1)
    return -(turn * (along / values)[:, None]).sum(axis=2)
