"""The distribution of a weighted sum of squared normals, enclosed from both sides."""

from __future__ import annotations

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array

NEGLIGIBLE = 1e-18  # a weight so much smaller than the limit changes no digit
MOST_TERMS = 2000  # of a series
TERM = 1e-17  # what may be left of it
ROUNDING, LAW = 1.2e-16, 4e-15  # relative: of an operation on positive terms, and of a chi-square law
POINTS, FEWER = 28, 24  # on the contour
FLOOR = 1e-13  # absolute, of the sum of terms of both signs on it


def enclosed(weights: Array, limit: float) -> tuple[float, float]:
    """Return bounds on P(Σ_i μ_i z_i² ≤ x) for independent z_i ~ N(0, 1), a hair from each other.

    Ruben's series is a mixture of chi-square laws with positive weights: what is summed is a lower bound, and what
    is missing of a total weight of one, at the value of the first law that is left out, completes it to an upper one.
    Where weights far apart make it long, Imhof's integral is taken instead, along a contour around the negative axis
    on which it decays like an exponential; its error is taken to be what the last points changed.

    Args:
        weights: μ ≥ 0, (k,).
        limit: x > 0.

    Returns:
        A lower and an upper bound.

    Source: ruben1962, imhof1961, trefethen2006
    """
    scaled = weights[weights > NEGLIGIBLE * limit] / limit
    if not len(scaled):
        return 1.0, 1.0
    least, largest = float(scaled.min()), float(scaled.max())
    terms = _terms(len(scaled), 1 / least, least / largest)
    return _series(scaled, terms) if terms <= MOST_TERMS else _contour(scaled)


def _terms(count: int, ratio: float, spread: float) -> float:
    """Return the terms after which the weights are negligible, or the laws at that ratio of limit and least weight."""
    by_weight = 1.2 * np.log(TERM) / np.log1p(-spread) if spread < 1 else 1.0
    # P(χ²_d ≤ y) ≤ (y/d)^{d/2} e^{(d−y)/2} for y ≤ d
    by_law = max(0.5 * (ratio - count), 0.0) + 10 * np.sqrt(0.5 * ratio) + 40
    return float(np.ceil(min(max(by_weight, 1.0), by_law))) + 1


def _series(scaled: Array, terms: float) -> tuple[float, float]:
    """Return Ruben's bounds: Σ c_k P(χ²_{n+2k} ≤ 1/β) with Σ c_k s^k = Π_i √(β/μ_i) (1 − (1 − β/μ_i) s)^{−1/2}."""
    k = np.arange(int(terms))
    halves = np.cumprod(np.where(k > 0, (k - 0.5) / np.maximum(k, 1), 1.0))  # (1 − s)^{−1/2}
    least = float(scaled.min())
    weights = np.zeros(len(k))
    weights[0] = np.exp(0.5 * np.log(least / scaled).sum())
    for ratio in 1 - least / scaled[scaled > least]:
        powers: Array = np.power(float(ratio), k)
        weights = np.convolve(weights, halves * powers)[: len(k)]
    laws = _scipy.gamma_share(np.arange(len(k) + 1.0) + 0.5 * len(scaled), 0.5 / least)
    found = float(weights @ laws[:-1])
    slack = LAW + ROUNDING * (len(scaled) + 1) * (len(k) + 10)
    missing = max(1 - float(weights.sum()), 0.0) + slack
    low, high = found * (1 - slack), found * (1 + slack) + missing * float(laws[-1])
    return low, min(high, 1.0)


def _contour(scaled: Array) -> tuple[float, float]:
    found, before = (_along(scaled, points) for points in (POINTS, FEWER))
    error = abs(found - before) + FLOOR
    return max(found - error, 0.0), min(found + error, 1.0)


def _along(scaled: Array, points: int) -> float:
    """Return ∫ e^p Π_i (1 + 2μ_i p)^{−1/2} dp/(2πi p) on Talbot's contour, whose two halves mirror each other."""
    angle = np.pi * (2 * np.arange(points // 2) + 1) / points
    bent = 0.6407 * angle
    place = points * (0.5017 * angle / np.tan(bent) - 0.6122 + 0.2645j * angle)
    slope = points * (0.5017 / np.tan(bent) - 0.5017 * bent / np.sin(bent) ** 2 + 0.2645j)
    product = np.prod(np.sqrt(1 + 2 * scaled[:, None] * place), axis=0)
    return 2 / points * float(np.imag(np.exp(place) * slope / (place * product)).sum())
