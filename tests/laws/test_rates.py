"""Certified bounds bracket the exact rate: over random chains, against quadrature and conditional sampling."""

from __future__ import annotations

import pytest
from drawn import over
from hypothesis import given, settings
from hypothesis import strategies as st
from renewal.chains import KINDS, large_chain

from taciturn.renewal.chain import NoQuadratureError
from taciturn.renewal.gaussian import solve_gaussian
from taciturn.renewal.paths import solve_paths
from taciturn.renewal.rates import least_interval, rate_bounds

FEW_DIMENSIONS = st.builds(
    lambda seed, states, kind, power: large_chain(seed, states, states, kind, 10**power),
    st.integers(0, 2**32 - 1),
    st.integers(1, 2),
    st.sampled_from(sorted(KINDS)),
    st.floats(-1.0, 1.3),
)
MANY_DIMENSIONS = st.builds(
    lambda seed, states, noises, seen, kind, power: large_chain(
        seed, states, min(noises, states), kind, 10**power, min(seen, states)
    ),
    st.integers(0, 2**32 - 1),
    st.integers(3, 6),
    st.integers(1, 6),
    st.integers(1, 6),
    st.sampled_from(sorted(KINDS)),
    st.floats(-1.0, 0.7),
)


def bracket_the_quadrature(chain):
    """Check the bounds against the exact rate and the exact survival."""
    low, high = rate_bounds(chain)
    try:
        exact = solve_gaussian(chain, 1e-6)
    except NoQuadratureError:
        return  # nodes for too many noise deviations
    assert 0 < low <= high <= 1
    assert low - exact.rate_error <= exact.rate <= high + exact.rate_error
    assert 1 / least_interval(chain) >= high * (1 - 1e-12)


def bracket_the_paths(chain):
    """Check the bounds against conditional sampling, within four of their standard errors."""
    low, high = rate_bounds(chain)
    assert 0 < low <= high <= 1
    try:
        rate = solve_paths(chain, standard_error=2e-3, steps=3_000_000).rate
    except NoQuadratureError:
        return  # hardly ever sent
    assert low - 4 * rate.standard_error <= rate.value <= high + 4 * rate.standard_error


@given(FEW_DIMENSIONS)
@settings(max_examples=4)
def test_certified_bounds_bracket_the_exact_rate(chain):
    """One and two states, stable, neutral and unstable; thresholds from a tenth to twenty noise variances."""
    bracket_the_quadrature(chain)


@given(MANY_DIMENSIONS)
@settings(max_examples=2)
@pytest.mark.evidence
def test_certified_bounds_bracket_the_rate_in_many_dimensions(chain):
    """Three to six states, noise and Ψ of any rank."""
    bracket_the_paths(chain)


@pytest.mark.evidence
def test_certified_bounds_bracket_the_exact_rates_of_two_hundred_chains():
    """The same law, two hundred times."""
    over(bracket_the_quadrature, 200, chain=FEW_DIMENSIONS)


@pytest.mark.evidence
def test_certified_bounds_bracket_the_rates_of_sixty_chains_in_many_dimensions():
    """The same law, sixty times."""
    over(bracket_the_paths, 60, chain=MANY_DIMENSIONS)


@pytest.mark.evidence
@pytest.mark.parametrize("seed", range(8))
def test_certified_bounds_bracket_the_exact_rate_in_three_dimensions(seed):
    """Full noise, each kind."""
    bracket_the_quadrature(large_chain(seed, 3, 3, sorted(KINDS)[seed % 3], 1.0 + seed / 2))
