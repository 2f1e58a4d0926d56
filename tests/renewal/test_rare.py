"""Errors that are hardly worth a send: closed forms against the equations of the best schedule."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from taciturn.renewal.chain import NoQuadratureError
from taciturn_limits.fitted import bound_rare_sends
from taciturn_limits.optimal import solve_optimal


@settings(max_examples=4, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.3, 12.0))
@pytest.mark.evidence
def test_the_best_schedule_keeps_both_bounds(seed: int, dear: float) -> None:
    """Rate and gain of the best schedule by quadrature, at prices from some to many times what silence costs."""
    draws = np.random.default_rng(seed)
    n = int(draws.integers(1, 3))
    F = draws.normal(size=(n, n))
    F *= draws.uniform(0.1, 0.8) / np.abs(np.linalg.eigvals(F)).max()
    noise, Gamma = np.diag(draws.uniform(0.5, 1.0, n)), np.diag(draws.uniform(0.5, 1.0, n))
    forever = float(np.sum(Gamma * scipy.linalg.solve_discrete_lyapunov(F, noise)))
    found = bound_rare_sends(F, noise, Gamma, dear * forever)
    assert found.gain <= forever
    try:
        best = solve_optimal(F, noise, Gamma, dear * forever, 1e-3)
    except NoQuadratureError:
        assert dear > 2  # hardly anything is sent
        return
    assert best.rate - best.rate_error <= found.rate
    assert found.gain <= best.cost + best.cost_error


def test_a_price_beyond_all_savings_leaves_nothing_to_send() -> None:
    """The rate is next to 0 and the gain next to that of never sending; an error that grows is another matter."""
    unit = np.eye(1)
    found = bound_rare_sends(0.5 * unit, unit, unit, 300.0)
    assert found.rate < 1e-15
    assert found.gain == pytest.approx(1 / 0.75, rel=1e-12)
    assert bound_rare_sends(1.1 * unit, unit, unit, 300.0).rate == 1.0
    assert bound_rare_sends(0.5 * unit, 0 * unit, unit, 1.0).rate == 0.0
