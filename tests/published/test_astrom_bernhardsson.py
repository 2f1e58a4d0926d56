"""Åström and Bernhardsson: events against the clock for first-order stochastic systems (astrom1999, astrom2002)."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize
from limits import assert_tends_to, waiting

from taciturn import ContinuousPlant, Cost, Plant, average, close, design
from taciturn.lqg.sampling import sample
from taciturn.renewal.chain import Chain
from taciturn.renewal.gaussian import solve_gaussian

ONE = np.eye(1)


def test_impulse_control_by_events_has_a_third_of_the_variance_of_periodic_control() -> None:
    """An integrator under Wiener noise that impulses reset: 3 at equal rate, as the threshold passes many looks.

    With looks every step the ratio is 3 + O(σ²/Y²): exactly, by quadrature; and as the policy simulates it.
    """
    plant, cost = Plant([[1.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1e-9]])  # free inputs: L = −1
    ratios = {}
    for threshold in (10.0, 20.0, 40.0):
        found = solve_gaussian(Chain(ONE, ONE, ONE, threshold**2, ONE))
        ratios[threshold] = (1 / found.rate - 1) / 2 / found.excess  # of periodic control, W(N − 1)/2 every N steps
        policy = design.absolute(plant, cost, threshold=threshold, error="state", actuation="model")
        loop = close(plant, policy)
        simulated = average(loop, steps=8_000_000)
        assert abs(simulated.rates["actuator"].value - found.rate) <= 4 * simulated.rates["actuator"].standard_error
        excess = simulated.cost.value - policy.cost_all_time
        assert abs(excess - found.excess) <= 4 * simulated.cost.standard_error + 1e-6 * found.excess
        every = round(1 / found.rate)
        clock = design.periodic(plant, cost, every=every, actuation="model").theory.closed_form
        assert clock is not None
        assert clock.cost - policy.cost_all_time == pytest.approx((every - 1) / 2, rel=1e-6)
    assert_tends_to(3, list(ratios.values()))
    assert ratios[10.0] > ratios[20.0] > ratios[40.0] > 3


def watched(a: float, looks: float) -> tuple[float, float]:
    """Return variance and mean wait of dx = ax dt + dv if impulses reset it where |x| > 1.

    It is looked at ``looks``² times a second; its variance in between counts.
    """
    period = looks**-2
    found = sample([[a]], [[0.0]], [[1.0]], [[0.0]], [[0.0]], [[1.0]], period)
    solved = solve_gaussian(Chain(found.A, found.W, ONE, 1.0, found.Q))
    return (solved.excess + found.noise_cost) / period, period / solved.rate


def test_a_held_input_must_be_sampled_nearly_five_times_as_fast_as_impulses_by_events() -> None:
    """An integrator: (3 + √3)h/6 for a held input, h/6 for impulses by events; "4.7 times faster" in print."""
    plant, cost = ContinuousPlant([[0.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1e-12]])
    held = design.periodic(plant, cost, period=1.0).theory.closed_form
    assert held is not None
    assert held.cost == pytest.approx((3 + np.sqrt(3)) / 6, rel=1e-9)
    ratios = [held.cost * wait / events for events, wait in (watched(0.0, looks) for looks in (10.0, 20.0, 40.0))]
    assert_tends_to(3 + np.sqrt(3), ratios)
    assert round(ratios[-1], 1) == 4.7


@pytest.mark.parametrize("a", [-1.0, 1.0], ids=["stable", "unstable"])
def test_the_variance_of_a_first_order_system_under_events_is_its_closed_form(a: float) -> None:
    """V = (d²/h − 1)/2a of the mean wait h for a level d, at equal rate, as looks come ever faster.

    A level that is looked at is passed by a little, as if it were higher; so d is the one with the same mean wait.
    """
    ratios = []
    for looks in (10.0, 20.0, 40.0):
        events, wait = watched(a, looks)
        level = float(scipy.optimize.brentq(lambda d, wait=wait: waiting(a, d) - wait, 0.5, 2.0))
        ratios.append(events / ((level**2 / wait - 1) / (2 * a)))
    assert_tends_to(1, ratios)
    assert ratios[0] > ratios[1] > ratios[2] > 1


@pytest.mark.parametrize("a", [-1.0, 1.0], ids=["stable", "unstable"])
def test_the_variance_of_a_first_order_system_under_periodic_impulses_is_its_closed_form(a: float) -> None:
    """(e^{2ah} − 1)/(4a²h) − 1/2a: inputs that are free, and come as impulses from a model."""
    for period in (0.1, 1.0):
        found = sample([[a]], [[0.0]], [[1.0]], [[0.0]], [[0.0]], [[1.0]], period)
        assert found.noise_cost / period == pytest.approx(np.expm1(2 * a * period) / (4 * a * a * period) - 1 / (2 * a))
