"""Lower and upper bounds on the distribution of a weighted sum of squared normal variables."""

from __future__ import annotations

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array

NEGLIGIBLE = 1e-18  # relative to the limit: smaller weights do not change the result
MOST_TERMS = 2000  # of a series
TERM = 1e-17  # size of the omitted terms of a series
ROUNDING, LAW = 1.2e-16, 4e-15  # relative errors: of an operation on positive terms, and of a chi-square distribution
POINTS, FEWER = 28, 24  # points on the contour: of the result, and of the coarser one that gives the error
FLOOR = 1e-13  # absolute rounding error of the integral along the contour


def enclosed(weights: Array, limit: float) -> tuple[float, float]:
    """Return tight lower and upper bounds on P(Σ_i μ_i z_i² ≤ x) for independent z_i ~ N(0, 1).

    Ruben's series is a mixture of chi-square distributions with positive weights. Any partial sum is a lower bound. The
    missing weight times the probability of the first omitted distribution completes it to an upper bound. If very
    different μ_i would make the series long, Imhof's integral is used instead, along a contour around the negative axis
    on which the integrand decays exponentially. Its error is estimated by the change from fewer to more points.

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
    """Return the number of terms after which the weights, or the chi-square probabilities, are negligible."""
    by_weight = 1.2 * np.log(TERM) / np.log1p(-spread) if spread < 1 else 1.0
    # P(χ²_d ≤ y) ≤ (y/d)^{d/2} e^{(d−y)/2} for y ≤ d
    by_law = max(0.5 * (ratio - count), 0.0) + 10 * np.sqrt(0.5 * ratio) + 40
    return float(np.ceil(min(max(by_weight, 1.0), by_law))) + 1


def _series(scaled: Array, terms: float) -> tuple[float, float]:
    """Return Ruben's bounds: Σ c_k P(χ²_{n+2k} ≤ 1/β) with Σ c_k s^k = Π_i √(β/μ_i) (1 − (1 − β/μ_i) s)^{−1/2}."""
    k = np.arange(int(terms))
    halves = np.cumprod(np.where(k > 0, (k - 0.5) / np.maximum(k, 1), 1.0))  # power series of (1 − s)^{−1/2}
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
    """Return ∫ e^p Π_i (1 + 2μ_i p)^{−1/2} dp/(2πi p) on Talbot's contour; only its upper half is computed."""
    angle = np.pi * (2 * np.arange(points // 2) + 1) / points
    bent = 0.6407 * angle
    place = points * (0.5017 * angle / np.tan(bent) - 0.6122 + 0.2645j * angle)
    slope = points * (0.5017 / np.tan(bent) - 0.5017 * bent / np.sin(bent) ** 2 + 0.2645j)
    product = np.prod(np.sqrt(1 + 2 * scaled[:, None] * place), axis=0)
    return 2 / points * float(np.imag(np.exp(place) * slope / (place * product)).sum())
