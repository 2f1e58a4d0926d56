"""Quadrature nodes for integrals over the part of a region that errors reach under Gaussian noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
import numpy.typing as npt
from numpy.polynomial.legendre import leggauss

from taciturn._arrays import Array, frozen
from taciturn.renewal._white_coordinates import White

STEEP = 4.0  # norm of a column of F from which on nodes are finer in proportion
SPACING = 0.8  # noise standard deviations between equidistant nodes
LARGEST = 3000  # most nodes of one rule; computing them takes seconds, with the third power of their number
FEWEST, PER_HALF_WIDTH = 10.0, 3.2  # Gauss–Legendre nodes: a constant, and per noise deviation of the half-width


class Region(Protocol):
    """Set of the errors that are not sent; it is symmetric about 0.

    For given coordinates on the outer axes, it contains one interval (chord) on the next axis.
    """

    def extent(self, outer: Array, low: Array, high: Array) -> tuple[Array, Array]:
        """Return the ends of the region's chord on the next axis, for given coordinates on the outer axes.

        Args:
            outer: coordinates on the outer axes, (places, outer axes).
            low: start of the window on the next axis, (places,).
            high: end of the window, (places,).

        Returns:
            The ends, which need not be exact outside the window; both are the same number where the chord is empty.
        """
        ...


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """Ellipsoid Σ_i m_i x_i² ≤ 1 of the errors x that are not sent.

    Args:
        m: weights, (n,).
    """

    m: Array

    def extent(self, outer: Array, low: Array, high: Array) -> tuple[Array, Array]:
        """Return the exact ends of the ellipsoid's chord on the next axis; they are infinite if m is 0 on this axis."""
        axis, left = outer.shape[1], np.ones(len(outer))
        for m, x in zip(self.m, outer.T, strict=False):
            left = np.maximum(left - m * x * x, 0.0)
        chord = np.sqrt(left / self.m[axis]) if self.m[axis] > 0 else np.full(len(left), np.inf)
        return -chord, chord


@dataclass(frozen=True, eq=False)
class ErrorRegion:
    """Bounded region that contains nearly all unsent errors: on each axis, an interval that depends on the outer axes.

    Args:
        covariance: approximate covariance of unsent errors, (n, n). This covariance determines the conditional mean
            and standard deviation of each axis, given the outer ones.
        reach: half-width of the window on each axis, in conditional standard deviations, (n,).
    """

    covariance: Array
    reach: Array

    def scaled(self, factor: float) -> ErrorRegion:
        """Return this window with its half-widths multiplied by a factor."""
        return ErrorRegion(self.covariance, self.reach * factor)

    def given_outer(self, outer: Array) -> tuple[Array, float]:
        """Return the conditional mean and standard deviation of the next coordinate for each row of the outer ones."""
        d, covariance = outer.shape[1], self.covariance
        slope = np.linalg.solve(covariance[:d, :d], covariance[:d, d])
        return outer @ slope, float(np.sqrt(max(covariance[d, d] - covariance[d, :d] @ slope, 0.0)))


@dataclass(frozen=True, eq=False)
class AxisNodes:
    """Coordinates of nested quadrature nodes on one axis.

    Args:
        x: coordinates, (places,).
        first: for each point of the outer axes, the index of its first coordinate on this axis, ascending,
            (outer places,).
    """

    x: Array
    first: npt.NDArray[np.int64]

    def gathered(self, fall: Array, sums: Array) -> Array:
        """Return, for each point on the outer axes, the sum over this axis of the products of ``fall`` and ``sums``.

        The shapes are (places, points) and (places, k) to (outer, points·k).
        """
        ends = (*self.first[1:], len(self.x))
        parts = [fall[low:high].T @ sums[low:high] for low, high in zip(self.first, ends, strict=True)]
        return np.stack(parts).reshape(len(parts), -1)

    def scattered(self, fall: Array, sums: Array) -> Array:
        """Apply the transpose of the linear map ``gathered``, which maps (outer, points·k) to (places, k)."""
        ends = (*self.first[1:], len(self.x))
        cubes = sums.reshape(len(self.first), fall.shape[1], -1)
        return np.concatenate([fall[low:high] @ cube for low, high, cube in zip(self.first, ends, cubes, strict=True)])


@dataclass(frozen=True, eq=False)
class QuadratureNodes:
    """Quadrature nodes of a symmetric region; only one node of each pair ±x is stored.

    Args:
        x: nodes, (nodes, n).
        weight: weights, (nodes,).
        levels: the coordinates on each axis, outer axes first.
    """

    x: Array
    weight: Array
    levels: tuple[AxisNodes, ...]


class TooManyNodes(Exception):  # noqa: N818
    """Raised if a quadrature needs more nodes than the limit on the computation allows."""


@dataclass(frozen=True, eq=False)
class _Span:
    """The chord [first, last] on an axis for each node of the outer axes, and its part [low, high] in the window."""

    first: Array
    last: Array
    low: Array
    high: Array
    slack: bool


def place(white: White, region: Region, window: ErrorRegion, density: float, more: int, most: int) -> QuadratureNodes:
    """Return quadrature nodes for a region, placed axis by axis.

    The nodes of an axis lie on the chord of the region at given coordinates on the outer axes.

    An axis has equidistant nodes if the window ends before the chord on both sides, and Gauss–Legendre nodes otherwise.
    An outer axis has them in the angle φ, x = centre + c sin φ, as the integral over the inner axes ends like a square
    root.

    Args:
        white: the chain.
        region: the errors that are not sent.
        window: the window of unsent errors.
        density: density of the nodes, relative to the usual one.
        more: additional pairs of nodes on each Gauss–Legendre axis, so that a finer set is finer on every axis.
        most: largest number of nodes.

    Returns:
        One node of every pair ±x.

    Raises:
        TooManyNodes: more than ``most`` nodes are needed.
    """
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
            inner, inner_weight = _upper_half(inner, inner_weight)
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
    half = _affordable(density * (FEWEST + PER_HALF_WIDTH * half_width) / 2 + more, min(most, LARGEST) / 2)
    return legendre(2 * half)


@lru_cache(maxsize=64)
def legendre(count: int) -> tuple[Array, Array]:
    """Return the nodes and weights of Gauss–Legendre quadrature on [−1, 1], from a cache."""
    nodes, weights = leggauss(count)
    return frozen(nodes), frozen(weights)


def _affordable(half: float, most: float) -> int:
    """Return half the number of nodes of an axis, as an integer."""
    if half > most:
        raise TooManyNodes
    return max(int(np.ceil(half)), 1)


def _upper_half(x: Array, weight: Array) -> tuple[Array, Array]:
    half = x.shape[1] // 2
    return x[:, half:], weight[:, half:]
