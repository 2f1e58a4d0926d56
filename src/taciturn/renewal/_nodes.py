"""Nodes for integrals over a region, of which only what Gaussian noise reaches matters."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
import numpy.typing as npt
from numpy.polynomial.legendre import leggauss

from taciturn._arrays import Array, frozen
from taciturn.renewal._whiten import White

STEEP = 4.0  # a map this much steeper than one has finer nodes at once
SPACING = 0.8  # noise standard deviations between the nodes of an axis that does not bind
LARGEST = 3000  # nodes of one rule, which take seconds: their time grows with the third power
FEWEST, PER_HALF_WIDTH = 10.0, 3.2  # Gauss–Legendre nodes: this many, and so many per half-width in noise spreads


class Region(Protocol):
    """Errors that are kept, symmetric about 0: a chord of them above each place of the outer axes."""

    def extent(self, outer: Array, low: Array, high: Array) -> tuple[Array, Array]:
        """Return the ends of the next axis, given the outer ones.

        Args:
            outer: (places, outer axes).
            low: where the window begins, (places,).
            high: where it ends, (places,).

        Returns:
            The ends, which need not be exact beyond the window; the same number twice where nothing is kept.
        """
        ...


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """The region Σ_i m_i x_i² ≤ 1.

    Args:
        m: (n,).
    """

    m: Array

    def extent(self, outer: Array, low: Array, high: Array) -> tuple[Array, Array]:
        """Return the ends of the next axis, exactly; infinite where nothing bounds it."""
        axis, left = outer.shape[1], np.ones(len(outer))
        for m, x in zip(self.m, outer.T, strict=False):
            left = np.maximum(left - m * x * x, 0.0)
        chord = np.sqrt(left / self.m[axis]) if self.m[axis] > 0 else np.full(len(left), np.inf)
        return -chord, chord


@dataclass(frozen=True, eq=False)
class Window:
    """Where kept errors are, axis by axis.

    Args:
        covariance: of kept errors, or about it: it gives each axis a mean and a deviation given the outer ones, (n, n).
        reach: of each axis, how many of those deviations away kept errors come, (n,).
    """

    covariance: Array
    reach: Array

    def scaled(self, factor: float) -> Window:
        """Return the window with so many times the reach."""
        return Window(self.covariance, self.reach * factor)

    def given_outer(self, outer: Array) -> tuple[Array, float]:
        """Return mean and standard deviation of the next axis, for each row of the outer ones."""
        d, covariance = outer.shape[1], self.covariance
        slope = np.linalg.solve(covariance[:d, :d], covariance[:d, d])
        return outer @ slope, float(np.sqrt(max(covariance[d, d] - covariance[d, :d] @ slope, 0.0)))


@dataclass(frozen=True, eq=False)
class Level:
    """The places of nested nodes on one axis.

    Args:
        x: (places,).
        first: the first of the places that share each place of the outer axes, ascending, (outer places,).
    """

    x: Array
    first: npt.NDArray[np.int64]

    def gathered(self, fall: Array, sums: Array) -> Array:
        """Return Σ fall ⊗ sums over what shares an outer place; (places, points), (places, k) to (outer, points·k)."""
        ends = (*self.first[1:], len(self.x))
        parts = [fall[low:high].T @ sums[low:high] for low, high in zip(self.first, ends, strict=True)]
        return np.stack(parts).reshape(len(parts), -1)

    def scattered(self, fall: Array, sums: Array) -> Array:
        """Return the transpose of gathering, (outer, points·k) to (places, k)."""
        ends = (*self.first[1:], len(self.x))
        cubes = sums.reshape(len(self.first), fall.shape[1], -1)
        return np.concatenate([fall[low:high] @ cube for low, high, cube in zip(self.first, ends, cubes, strict=True)])


@dataclass(frozen=True, eq=False)
class Nodes:
    """One of every pair ±x of nodes.

    Args:
        x: (nodes, n).
        weight: (nodes,).
        levels: the axes, outer ones first.
    """

    x: Array
    weight: Array
    levels: tuple[Level, ...]


class TooManyNodes(Exception):  # noqa: N818
    """More nodes than can be afforded."""


@dataclass(frozen=True, eq=False)
class _Span:
    """The part of an axis that is kept, one for each node of the outer axes: a chord, cut by a window."""

    first: Array
    last: Array
    low: Array
    high: Array
    slack: bool


def place(white: White, region: Region, window: Window, density: float, more: int, most: int) -> Nodes:
    """Return nodes for a region, axis by axis, each on the chord that the outer ones leave.

    An axis whose chord no kept error reaches has equidistant nodes, the others those of Gauss; outer ones of
    them in the angle, x = centre + c sin φ, as the inner integral ends like a square root.

    Args:
        white: the chain.
        region: where errors are kept.
        window: where kept errors are.
        density: of the nodes, 1 for the usual one.
        more: pairs of nodes on each Gaussian axis, so that a finer set is finer on all of them.
        most: nodes.

    Returns:
        One of every pair ±x.

    Raises:
        TooManyNodes: more than ``most``.
    """
    n = len(white.m)
    levels = list[Level]()
    x, weight = np.zeros((1, 0)), np.ones(1)
    bends = np.maximum(1.0, np.linalg.norm(white.F, axis=0) / STEEP)
    for axis in range(n):
        span = _span(x, region, window)
        rule = _equidistant if span.slack else _straight if axis == n - 1 else _angular
        afforded = 2 * most if axis == 0 else most / len(weight)  # half of the first ones are dropped
        inner, inner_weight = rule(span, density * float(bends[axis]), more, afforded)
        if axis == 0:
            inner, inner_weight = _upper_half(inner, inner_weight)
        outer = np.repeat(np.arange(len(x)), inner.shape[1])
        x = np.hstack([np.repeat(x, inner.shape[1], axis=0), inner.reshape(-1, 1)])
        weight = (weight[:, None] * inner_weight).ravel()
        kept = weight > 0
        x, weight = x[kept], weight[kept]
        levels.append(Level(x[:, axis], np.searchsorted(outer[kept], np.arange(len(span.low)))))
    return Nodes(x, weight, tuple(levels))


def _span(outer: Array, region: Region, window: Window) -> _Span:
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
    """Return nodes and weights of Gauss and Legendre on [−1, 1], which are the same for many integrals."""
    nodes, weights = leggauss(count)
    return frozen(nodes), frozen(weights)


def _affordable(half: float, most: float) -> int:
    """Return half the nodes of an axis as an integer."""
    if half > most:
        raise TooManyNodes
    return max(int(np.ceil(half)), 1)


def _upper_half(x: Array, weight: Array) -> tuple[Array, Array]:
    half = x.shape[1] // 2
    return x[:, half:], weight[:, half:]
