"""The best scheduler over random chains: no threshold, no period and no other price's scheduler costs less."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from taciturn.renewal.chain import Chain
from taciturn.renewal.gaussian import solve_gaussian
from taciturn_limits.optimal import Optimum, solve_optimal

FEW = settings(max_examples=3, deadline=None, suppress_health_check=[HealthCheck.too_slow])
ACCURACY = 1e-3
THRESHOLDS = (0.3, 0.5, 0.7, 0.85, 1.0)  # times the price: a boundary of the optimum costs less than the price


def random_chain(seed: int, states: int, radius: float, share: float) -> Chain:
    """Return a chain of spectral radius ``radius``, with a price, in ``delta``, of a multiple of one check's noise."""
    draws = np.random.default_rng(seed)
    F = draws.standard_normal((states, states))
    F *= radius / np.abs(np.linalg.eigvals(F)).max()
    noise, Gamma = (half @ half.T for half in draws.standard_normal((2, states, states)))
    noise += np.eye(states)
    if states == 3 or draws.random() < 0.5:
        Gamma += np.eye(states)
    else:
        Gamma = np.outer(Gamma[0], Gamma[0])  # of one direction only
    return Chain(F, noise, Gamma, float(share * np.trace(Gamma @ noise)), Gamma)


def optimum(chain: Chain, price: float) -> Optimum:
    """Return the optimum at a price."""
    return solve_optimal(chain.F, chain.noise, chain.Gamma, price, ACCURACY)


@FEW
@given(
    seed=st.integers(0, 10_000),
    states=st.integers(1, 2),
    radius=st.sampled_from([0.0, 0.6, 1.0, 1.3]),
    share=st.sampled_from([0.2, 0.6, 2.0]),
)
def test_no_threshold_and_no_other_scheduler_costs_less(seed: int, states: int, radius: float, share: float) -> None:
    """At equal price the optimum is least, and the optima of two prices do not beat each other at their own."""
    law(random_chain(seed, states, radius, share))


def law(chain: Chain) -> None:
    """Check one chain."""
    price = chain.delta
    found, dearer = optimum(chain, price), optimum(chain, 1.5 * price)
    for one, other in ((found, dearer), (dearer, found)):
        slack = one.cost_error + other.excess_error + one.price * other.rate_error
        assert one.cost <= other.excess + one.price * other.rate + slack
    assert dearer.rate - dearer.rate_error <= found.rate + found.rate_error
    for multiple in THRESHOLDS:
        rival = solve_gaussian(Chain(chain.F, chain.noise, chain.Gamma, price * multiple, chain.Gamma), ACCURACY)
        slack = found.cost_error + rival.excess_error + price * rival.rate_error
        assert found.cost <= rival.excess + price * rival.rate + slack
    period = _best_period(chain)
    assert found.cost <= period + found.cost_error
    assert found.cost >= min(period, price) / 8  # a bound that is loose, but not nothing


def _best_period(chain: Chain) -> float:
    """Return the least mean cost per check of a send in every so many checks."""
    covariance, total, costs = np.zeros_like(chain.F), chain.delta, [chain.delta]
    for checks in range(2, 30):
        covariance = chain.F @ covariance @ chain.F.T + chain.noise
        total += float(np.trace(chain.Gamma @ covariance))
        costs.append(total / checks)
    return min(costs)


@pytest.mark.evidence
@pytest.mark.parametrize("seed", range(20))
def test_twenty_chains_obey_the_law(seed: int) -> None:
    """One, two and three states; nilpotent in effect, stable, neutral and unstable; small and large prices."""
    draws = np.random.default_rng(seed)
    states = 1 + seed % 3
    law(random_chain(seed, states, float(draws.choice([0.0, 0.6, 1.0, 1.3])), float(draws.choice([0.2, 0.6, 2.0]))))
