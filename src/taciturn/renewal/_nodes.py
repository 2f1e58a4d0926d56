"""Nodes for integrals over an ellipsoid, of which only what Gaussian noise reaches matters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array
from taciturn.renewal._whiten import White

SPACING = 0.8  # noise standard deviations between the nodes of an axis that does not bind
FEWEST, PER_HALF_WIDTH = 6.0, 3.2  # Gauss–Legendre nodes: this many, and so many per half-width in noise spreads


@dataclass(frozen=True)
class Resolution:
    """How finely and how far an integral is taken.

    Args:
        density: of the nodes, 1 for the usual one.
        reach: standard deviations of the kept error, given the outer axes, up to which nodes stand.
    """

    density: float
    reach: float


@dataclass(frozen=True, eq=False)
class Nodes:
    """One of every pair ±x of nodes, (nodes, n), and its weight, (nodes,)."""

    x: Array
    weight: Array


class TooManyNodes(Exception):
    """More nodes than asked for."""

    def __init__(self, needed: float) -> None:
        """Tell how many, about."""
        super().__init__(needed)
        self.needed = needed


@dataclass(frozen=True, eq=False)
class _Span:
    """The part of an axis that is kept, one for each node of the outer axes: a chord, cut by a window."""

    chord: Array
    low: Array
    high: Array
    slack: bool


def place(white: White, spread: Array, resolution: Resolution, most: int) -> Nodes:
    """Return nodes for Σ_i m_i x_i² ≤ 1, axis by axis, each on the chord that the outer ones leave.

    An axis whose chord no kept error reaches has equidistant nodes, the others those of Gauss; outer ones of
    them in the angle, x = c sin φ, as the inner integral ends like a square root.

    Args:
        white: the chain.
        spread: covariance of kept errors, (n, n).
        resolution: of the nodes.
        most: nodes.

    Returns:
        One of every pair ±x.

    Raises:
        TooManyNodes: more than ``most``.
    """
    n = len(white.m)
    x, weight, left = np.zeros((1, 0)), np.ones(1), np.ones(1)
    bends = np.sqrt(np.maximum(1.0, (1 + (white.F * white.F).sum(axis=0)) / 2))
    for axis in range(n):
        centre, deviation = _given_outer(spread, x)
        span = _span(centre, resolution.reach * deviation, left, float(white.m[axis]))
        density = resolution.density * float(bends[axis])
        rule = _equidistant if span.slack else _straight if axis == n - 1 else _angular
        inner, inner_weight = rule(span, density, most / len(weight))
        if axis == 0:
            inner, inner_weight = _upper_half(inner, inner_weight)
        x = np.hstack([np.repeat(x, inner.shape[1], axis=0), inner.reshape(-1, 1)])
        weight = (weight[:, None] * inner_weight).ravel()
        left = np.maximum(left[:, None] - white.m[axis] * inner * inner, 0.0).ravel()
        kept = weight > 0
        x, weight, left = x[kept], weight[kept], left[kept]
    return Nodes(x, weight)


def _given_outer(spread: Array, outer: Array) -> tuple[Array, float]:
    """Return mean and standard deviation of the next axis, given the outer ones."""
    d = outer.shape[1]
    slope = np.linalg.solve(spread[:d, :d], spread[:d, d])
    return outer @ slope, float(np.sqrt(max(spread[d, d] - spread[d, :d] @ slope, 0.0)))


def _span(centre: Array, reach: float, left: Array, m: float) -> _Span:
    chord = np.sqrt(left / m) if m > 0 else np.full(len(left), np.inf)
    low, high = centre - reach, centre + reach
    slack = bool(((low > -chord) & (high < chord)).all())
    return _Span(chord, np.clip(low, -chord, chord), np.clip(high, -chord, chord), slack)


def _equidistant(span: _Span, density: float, most: float) -> tuple[Array, Array]:
    half_width = float((span.high - span.low).max()) / 2
    spacing = SPACING / density
    half = _affordable(half_width / spacing, most / 2)
    steps = (np.arange(-half, half) + 0.5) * spacing
    x = (span.low + span.high)[:, None] / 2 + steps
    return x, np.full(x.shape, spacing)


def _straight(span: _Span, density: float, most: float) -> tuple[Array, Array]:
    half = (span.high - span.low)[:, None] / 2
    nodes, weights = _gauss(float(half.max()), density, most)
    return (span.high + span.low)[:, None] / 2 + half * nodes, half * weights


def _angular(span: _Span, density: float, most: float) -> tuple[Array, Array]:
    chord = np.where(span.chord > 0, span.chord, 1.0)
    low, high = np.arcsin(span.low / chord), np.arcsin(span.high / chord)
    half = (high - low)[:, None] / 2
    nodes, weights = _gauss(float((half[:, 0] * span.chord).max()), density, most)
    angle = (high + low)[:, None] / 2 + half * nodes
    return span.chord[:, None] * np.sin(angle), span.chord[:, None] * half * weights * np.cos(angle)


def _gauss(half_width: float, density: float, most: float) -> tuple[Array, Array]:
    half = _affordable(density * (FEWEST + PER_HALF_WIDTH * half_width) / 2, most / 2)
    nodes, weights = np.polynomial.legendre.leggauss(2 * half)
    return np.asarray(nodes, dtype=np.float64), np.asarray(weights, dtype=np.float64)


def _affordable(half: float, most: float) -> int:
    """Return half the nodes of an axis, an integer; the axis may hold 2·most when half of them are dropped."""
    if half > 2 * most + 2:
        raise TooManyNodes(half / most)
    return max(int(np.ceil(half)), 1)


def _upper_half(x: Array, weight: Array) -> tuple[Array, Array]:
    half = x.shape[1] // 2
    return x[:, half:], weight[:, half:]
