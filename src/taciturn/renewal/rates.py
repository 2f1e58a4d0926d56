"""Certified bounds on the send rate of an error with Gaussian noise that each send resets, in any dimension.

Let n_j ~ N(0, S_j), S_j = F S_{j−1} F' + noise, be the error without sends, and E = {e: e'Ψe ≤ δ}, a convex and
symmetric set. Let p_j = P(n_j ∈ E), and a_j = P(n_1, …, n_j ∈ E), the survival of an interval. The rate is 1/Σ_j a_j.

Upper bound: a_j ≥ q_j = p_1 ⋯ p_j by the Gaussian correlation inequality (Royen). The omitted terms of the sum are
positive.

Lower bound: a_j ≤ min_k a_{j−k} p_k. Given the error e after check j − k, the error at check j without a send is
F^k e + n, where n is distributed as n_k. This error lies in E with the largest probability if e = 0 (Anderson). The
average over the unsent errors e gives the inequality. So u_0 = 1, u_j = min_{k ≤ j} u_{j−k} p_k is an upper bound of
a_j. For any k, the sum of the a_j after check J is at most (p_k + p_k² + …)(u_{J−k+1} + … + u_J). This is finite, since
some p_k < 1.

Sends in a window: intervals are independent and identically distributed, with a survival of at least q_j. So on one
probability space, each interval is at least as long as an X' with survival q. The first send of a window may come at
its first check, and every later send ends an interval. So the number of sends in k checks is at most 1 + N'(k − 1),
where N' counts the renewals with intervals X'. With f_j = q_{j−1} − q_j its mean solves U_m = Σ_{j ≤ m} f_j (1 +
U_{m−j}). Its distribution follows by convolution from P(1 + N'(k − 1) > m) = P(X'_1 + … + X'_m ≤ k − 1).

Each p_j is the probability P(Σ_i μ_i z_i² ≤ x) of independent z_i ~ N(0, 1). Ruben's series is a mixture of chi-square
distributions with positive weights. Any partial sum is a lower bound; the missing weight times the probability of the
first omitted distribution completes it to an upper bound. If very different μ_i would make the series long, Imhof's
integral is used instead, along a contour around the negative axis on which the integrand decays exponentially. Its
error is estimated by the change from fewer to more points.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array, count, number
from taciturn._display import Displayed
from taciturn._modes import radius, root, summed
from taciturn.renewal.chain import Chain, Data, reduced

NEGLIGIBLE = 1e-18  # relative to the limit: smaller weights do not change the result
MOST_TERMS = 2000  # of a series
TERM = 1e-17  # size of the omitted terms of a series
ROUNDING, LAW = 1.2e-16, 4e-15  # relative errors: of an operation on positive terms, and of a chi-square distribution
POINTS, FEWER = 28, 24  # points on the contour: of the result, and of the coarser one that gives the error
FLOOR = 1e-13  # absolute rounding error of the integral along the contour


def enclosed(weights: Array, limit: float) -> tuple[float, float]:
    """Compute tight lower and upper bounds on P(Σ_i μ_i z_i² ≤ x) for independent z_i ~ N(0, 1)."""
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


MOST_CHECKS = 2048  # checks that are computed one by one
SETTLED = 1e-10  # relative change from twice the checks below which the bounds are final
SLACK = 1e-13  # bound on the rounding error of a standard deviation, relative to the largest one
STABLE = 1 - 1e-9  # spectral radius from which on a map does not count as stable
FEW = 64  # checks that suffice to find whether intervals are short
NEVER = 1e-300  # survival probability that counts as 0
LARGE = 1e100  # standard deviation above which nothing remains unsent
SPARE = 1e-12  # relative increase of a covariance, so that it is certainly above others
TINY = 1e-16  # least 1 − p, against division by 0
ROUNDED = 1e-12  # absolute error of a probability that is convolved by Fourier transforms


@dataclass(frozen=True, eq=False, repr=False)
class WindowBound(Displayed):
    """Upper bounds on the number of sends in any window of successive checks."""

    mean: float  # upper bound on the mean number of sends
    most: int  # upper bound on the number of sends that holds with the requested confidence


def rate_bounds(chain: Chain) -> tuple[float, float]:
    """Compute certified bounds on the sends per check of an error with Gaussian noise, in any dimension."""
    data = _seen(chain)
    onward = _onward(data)
    kept = _kept(data)
    lows, highs = np.empty(MOST_CHECKS), np.empty(MOST_CHECKS)
    below, above = np.ones(MOST_CHECKS + 1), np.ones(MOST_CHECKS + 1)
    last, shortest, longest = 0, 1.0, np.inf
    for j in range(1, MOST_CHECKS + 1):
        lows[j - 1], highs[j - 1] = next(kept)
        below[j] = below[j - 1] * lows[j - 1]
        above[j] = (above[j - 1 :: -1] * highs[:j]).min()
        if j == max(2 * last, 1):
            before, last = (shortest, longest), j
            shortest = float(below[: j + 1].sum() + below[j] * onward)
            longest = float(above[: j + 1].sum()) + _rest(above[1 : j + 1], highs[:j])
            if (
                j >= 2 * len(data.F)
                and shortest - before[0] <= SETTLED * shortest
                and before[1] - longest <= SETTLED * longest
            ):
                break
    return 1 / longest, 1 / shortest


def least_interval(chain: Chain, checks: int = FEW) -> float:
    """Compute 1 + q_1 + … + q_k for k = ``checks``, a lower bound on the mean number of checks between sends."""
    return float(_survival(chain, count("checks", checks)).sum())


def sends_in_window(chain: Chain, checks: int, confidence: float) -> WindowBound:
    """Bound the number of sends in any window of ``checks`` successive checks from above."""
    count("checks", checks)
    number("confidence", confidence, 0.0, 1 - 1e-10)
    arrives = np.concatenate([[0.0], -np.diff(_survival(chain, checks))])[:checks]  # at 0, 1, …, k − 1
    renewals = np.zeros(checks)
    for m in range(1, checks):
        renewals[m] = arrives[1 : m + 1] @ (1 + renewals[m - 1 :: -1])
    return WindowBound(1 + float(renewals[-1]), _least(arrives, 1 - confidence))


def _least(arrives: Array, risk: float) -> int:
    """Return the least m for which m intervals are shorter than the window with at most the probability ``risk``."""
    # binary search: distributions of 1, 2, 4, … intervals by doubling, then the largest m from the longest down
    powers = [arrives]
    while powers[-1].sum() > risk - ROUNDED:
        powers.append(_convolved(powers[-1], powers[-1]))
    m, sums = 0, np.eye(1, len(arrives))[0]
    for step in range(len(powers) - 1, -1, -1):
        longer = _convolved(sums, powers[step])
        if longer.sum() > risk - ROUNDED:
            m, sums = m + (1 << step), longer
    return m + 1


def _convolved(one: Array, other: Array) -> Array:
    """Return the distribution of the sum of two independent times, up to the length of the window."""
    size = 1 << (2 * len(one) - 1).bit_length()
    product = np.fft.irfft(np.fft.rfft(one, size) * np.fft.rfft(other, size), size)
    return np.maximum(product[: len(one)], 0.0)


def _survival(chain: Chain, checks: int) -> Array:
    """Return q_0, …, q_checks."""
    survival = np.zeros(checks + 1)
    survival[0] = 1.0
    for j, (low, _) in zip(range(1, checks + 1), _kept(_seen(chain)), strict=False):
        survival[j] = survival[j - 1] * low
        if survival[j] < NEVER:
            break  # zeros are lower bounds too
    return survival


def _seen(chain: Chain) -> Data:
    """Return the chain restricted to the directions on which the trigger depends."""
    return reduced(replace(chain, Gamma=chain.Psi))


def _kept(data: Data) -> Iterator[tuple[float, float]]:
    """Yield bounds on p_1, p_2, …, from a factor of S_j, which has twice as many accurate digits as S_j."""
    noise, seen = root(data.noise), root(data.Psi).T
    factor: Array = noise
    while True:
        deviations = np.linalg.svd(seen @ factor, compute_uv=False)
        slack = SLACK * float(deviations[0])
        low, _ = enclosed(np.square(deviations + slack), 1.0)
        _, high = enclosed(np.square(np.maximum(deviations - slack, 0.0)), 1.0)
        large = float(deviations[0]) > LARGE  # nothing remains unsent from here on, and p_j decreases
        yield 0.0 if large else low, high
        if not large:
            _, upper = np.linalg.qr(np.hstack([data.F @ factor, noise]).T)
            factor = np.asarray(upper, dtype=np.float64).T


def _rest(above: Array, highs: Array) -> float:
    """Return a bound on Σ a_j over all later checks: the least over k of the extrapolation from the last k checks."""
    ends = np.cumsum(above[::-1])
    return float((ends * highs / np.maximum(1 - highs, TINY)).min())


def _onward(data: Data) -> float:
    """Return Σ_i p^i, where p ≤ p_j for all j follows from a covariance X ≥ F X F' + noise; 0 if there is no such X."""
    if radius(data.F) >= STABLE:
        return 0.0
    size = float(np.linalg.norm(summed(data.F, data.noise), 2))
    more = data.noise + SPARE * size * np.eye(len(data.F))
    X = summed(data.F, more)
    if not np.isfinite(X).all() or np.linalg.eigvalsh(X - data.F @ X @ data.F.T - data.noise)[0] <= 0:
        return 0.0
    seen = root(data.Psi).T
    weights = np.maximum(np.linalg.eigvalsh(seen @ X @ seen.T), 0.0)
    p, _ = enclosed(weights + SPARE * weights[-1], 1.0)
    return p / max(1 - p, TINY)
