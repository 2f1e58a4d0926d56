"""Certified bounds: probabilities of quadratic forms, the rate from both sides, and the sends in a window."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import scipy.integrate
import scipy.special
import scipy.stats
from counts import few
from renewal.chains import large_chain
from renewal.test_gaussian import double_integrator, scalar

from taciturn.errors import ProblemError
from taciturn.renewal import rates
from taciturn.renewal.chain import Chain, NoQuadratureError
from taciturn.renewal.gaussian import solve_gaussian
from taciturn.renewal.rates import least_interval, rate_bounds, sends_in_window

UNIT = np.eye(2)


def imhof(weights, limit):
    """Return P(Σ μ_i z_i² ≤ x) by Imhof's integral on the real line, and what scipy says it is off by."""

    def angle(u):
        return 0.5 * np.arctan(weights * u).sum() - 0.5 * limit * u

    def integrand(u):
        return np.sin(angle(u)) / (u * np.prod((1 + (weights * u) ** 2) ** 0.25))

    ends = np.concatenate([[1e-14], 2 * np.pi / limit * np.arange(1, 400)])
    parts = [scipy.integrate.quad(integrand, low, high, limit=400) for low, high in pairwise(ends)]
    total = sum(part[0] for part in parts)
    half = len(weights) / 2
    cut = 1 / (np.pi * half * ends[-1] ** half * np.sqrt(np.prod(weights)))
    return 0.5 - total / np.pi, cut + sum(part[1] for part in parts)


@pytest.mark.parametrize("states", [1, 2, 3, 6])
@pytest.mark.parametrize("limit", [1e-3, 0.5, 4.0, 30.0])
def test_equal_weights_have_a_chi_square_law(states, limit):
    """The enclosure holds it and is as narrow as rounding."""
    low, high = rates.enclosed(np.full(states, 0.7), 0.7 * limit)
    truth = scipy.stats.chi2.cdf(limit, states)
    assert low <= truth <= high
    assert high - low <= 1e-13 * (truth + 1e-3)


@pytest.mark.parametrize("seed", few(range(12), quick=3))
def test_the_series_the_contour_and_imhofs_integral_agree(seed):
    """Over random weights of three to six states: three formulas that share nothing."""
    draws = np.random.default_rng(seed)
    weights = 10.0 ** draws.uniform(-1.5, 1.0, 3 + seed % 4)
    series, contour = rates._series(weights, 2000), rates._contour(weights)
    assert series[1] - series[0] <= 1e-10
    assert contour[1] - contour[0] <= 1e-10
    assert max(series[0], contour[0]) <= min(series[1], contour[1])
    integral, off = imhof(weights, 1.0)
    assert abs(integral - series[0]) <= off + 1e-10
    assert off <= 1e-3


@pytest.mark.parametrize("terms", [1, 3, 10, 40])
def test_however_few_terms_the_series_encloses(terms):
    """What is missing is always between the two ends."""
    weights = np.array([0.03, 0.4, 1.3])
    low, high = rates._series(weights, terms)
    least, most = rates.enclosed(weights, 1.0)
    assert low <= least
    assert high >= most


def test_weights_far_apart_are_those_of_a_product():
    """A weight that is nothing next to the limit changes nothing; one that is huge leaves odds of μ^{-1/2}."""
    wide, tight = 1e8, 1e-12
    low, high = rates.enclosed(np.array([wide, 0.5, tight]), 1.0)
    inner, _ = scipy.integrate.quad(lambda x: scipy.stats.chi2.cdf(2 * (1 - x * x), 1), 0, 1, epsabs=1e-13)
    assert (low, high) == pytest.approx((2 * inner / np.sqrt(2 * np.pi * wide),) * 2, rel=1e-7)


def test_no_weight_is_certain():
    """Σ over nothing is 0."""
    assert rates.enclosed(np.zeros(3), 1.0) == (1.0, 1.0)


@pytest.mark.parametrize(("period", "high", "simple"), [(0.1, 0.560, 0.100), (0.5, 0.581, 0.187), (1.0, 0.600, 0.246)])
def test_the_double_integrator_of_the_thesis_is_bracketed(period, high, simple):
    """The upper end is the product's, the lower one is above that of the sum of min p, by far."""
    chain, _ = double_integrator(period)
    found, exact = rate_bounds(chain), solve_gaussian(chain)
    assert found[0] <= exact.rate <= found[1]
    assert found[1] == pytest.approx(high, abs=5e-4)
    assert found[0] > simple
    assert found[0] > 0.95 * exact.rate


@pytest.mark.parametrize("delta", [0.1, 1.0, 9.0, 36.0])
def test_without_memory_both_ends_are_the_rate(delta):
    """For F = 0 checks are independent, and both inequalities are equalities."""
    rate = scipy.special.erfc(np.sqrt(delta / 2))
    low, high = rate_bounds(scalar(0.0, delta))
    assert low <= rate * (1 + 1e-12)
    assert high >= rate * (1 - 1e-12)
    assert high - low <= 1e-9 * rate + 1e-13


def test_the_lower_end_is_the_least_over_all_ways_to_split():
    """u_j is the least product of p_k over the compositions of j, enumerated for ten checks of a walk."""
    chain = scalar(1.0, 4.0)
    p = scipy.special.erf(2 / np.sqrt(2 * np.arange(1, 11)))

    def least(j):
        return min([least(j - k) * p[k - 1] for k in range(1, j + 1)], default=1.0)

    bounds = [least(j) for j in range(11)]
    survival = solve_gaussian(chain).intervals.beyond(np.arange(11))
    assert (survival <= np.array(bounds) + 1e-7).all()
    assert (survival >= np.cumprod([1.0, *p]) - 1e-7).all()
    rest = min(p[k - 1] / (1 - p[k - 1]) * sum(bounds[-k:]) for k in range(1, 11))
    assert rate_bounds(chain)[0] >= 1 / (sum(bounds) + rest) - 1e-12  # more checks only help


def test_more_threshold_means_less_of_both_ends():
    """AnyController sets that grow keep more, and so do their bounds."""
    chains = [large_chain(4, 5, 2, delta=delta) for delta in (0.5, 1.0, 2.0, 4.0)]
    ends = np.array([rate_bounds(chain) for chain in chains])
    assert (np.diff(ends, axis=0) < 0).all()


def test_an_unstable_chain_that_is_kept_long_has_a_sharp_lower_end():
    """At F = 1.2 and ten noise deviations the split at the best check is within a thousandth."""
    chain = scalar(1.2, 100.0)
    low, _ = rate_bounds(chain)
    exact = solve_gaussian(chain).rate
    assert (1 - 1e-3) * exact <= low <= exact


def test_noise_that_is_seen_late_is_bounded():
    """Integrators in a row, seen at the end of the row: the first two checks keep every error."""
    F = np.eye(3) + np.diag([0.5] * 2, -1)
    chain = Chain(F, np.diag([1.0, 0, 0]), np.diag([0, 0, 1.0]), 0.02, np.eye(3))
    low, high = rate_bounds(chain)
    assert 0 < low < high <= 1 / 3
    assert least_interval(chain, 2) == pytest.approx(3.0, abs=1e-12)


def test_a_growing_direction_that_nobody_sees_does_not_count():
    """Bounds are those of what Ψ sees, though Γ sees more."""
    chain = Chain(np.diag([0.5, 3.0]), UNIT, np.diag([1.0, 0.0]), 2.0, UNIT)
    assert rate_bounds(chain) == pytest.approx(rate_bounds(scalar(0.5, 2.0)), rel=1e-9)


def renewals(chain, checks, paths, seed):
    """Return the sends in a window that begins after a hundred checks, on each path."""
    draws, half = np.random.default_rng(seed), np.linalg.cholesky(chain.noise)
    error, sent = np.zeros((paths, len(chain.F))), np.zeros(paths, dtype=int)
    for check in range(100 + checks):
        error = error @ chain.F.T + draws.standard_normal(error.shape) @ half.T
        over = ((error @ chain.Psi) * error).sum(axis=1) > chain.delta
        error[over] = 0.0
        sent += over & (check >= 100)
    return sent


@pytest.mark.parametrize("checks", few([1, 5, 40], quick=1, start=1))
@pytest.mark.parametrize("confidence", [0.5, 0.99])
def test_windows_of_a_simulation_stay_below_their_bound(checks, confidence):
    """Mean and quantile, within four standard errors."""
    chain = large_chain(2, 3, 3, delta=1.0)
    bound, sent = sends_in_window(chain, checks, confidence), renewals(chain, checks, 4000, 0)
    assert sent.mean() - 4 * sent.std() / np.sqrt(len(sent)) <= bound.mean <= checks + 1e-12
    risk = 1 - confidence
    assert (sent > bound.most).mean() <= risk + 4 * np.sqrt(risk * confidence / len(sent))


@pytest.mark.parametrize("delta", [0.3, 1.0, 4.0])
def test_a_window_without_memory_is_a_binomial_one(delta):
    """For F = 0 sends are independent; after one at once the k − 1 checks left see Binomial(k − 1, rate) of them."""
    rate, checks = scipy.special.erfc(np.sqrt(delta / 2)), 30
    for confidence in (0.1, 0.9, 0.999, 1 - 1e-8):
        found = sends_in_window(scalar(0.0, delta), checks, confidence)
        assert found.mean == pytest.approx(1 + (checks - 1) * rate, rel=1e-10)
        assert found.most == 1 + scipy.stats.binom.ppf(confidence, checks - 1, rate)


def test_a_long_window_sees_little_more_than_the_bound_of_the_rate():
    """Per check the mean goes to the upper end of the rate, and the quantile with it."""
    chain = large_chain(3, 4, 2, delta=1.0)
    _, high = rate_bounds(chain)
    found = sends_in_window(chain, 4000, 0.999)
    assert found.mean / 4000 == pytest.approx(high, rel=2e-3)
    assert found.mean < found.most < 1.1 * found.mean


def test_a_window_that_is_always_sent_in_has_as_many_sends_as_checks():
    """With a threshold of nothing every check sends."""
    found = sends_in_window(scalar(0.5, 1e-14), 7, 0.999)
    assert found.most == 7
    assert found.mean == pytest.approx(7.0, abs=1e-5)


@pytest.mark.parametrize("solve", [rate_bounds, least_interval, lambda chain: sends_in_window(chain, 3, 0.9)])
def test_a_chain_that_is_never_sent_is_refused(solve):
    """Neither without noise nor with a Ψ that sees none of it."""
    for chain in (Chain(UNIT, 0 * UNIT, UNIT, 1.0, UNIT), Chain(UNIT, np.diag([0, 1.0]), np.diag([1.0, 0]), 1.0, UNIT)):
        with pytest.raises(NoQuadratureError, match="the policy would never send"):
            solve(chain)


@pytest.mark.parametrize(("checks", "confidence"), [(0, 0.9), (2.5, 0.9), (3, 0.0), (3, 1.0), (3, np.nan)])
def test_a_window_or_a_confidence_that_is_none_is_refused(checks, confidence):
    """No checks, half a check, certainty, no number."""
    with pytest.raises(ProblemError, match=r"(checks|confidence) is"):
        sends_in_window(scalar(0.5, 1.0), checks, confidence)
