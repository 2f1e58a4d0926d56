"""Chapter 3 of the thesis: a controller away from its sensor and its actuator."""

from __future__ import annotations

import pytest

import taciturn
from taciturn import Cost, Plant, design

# ζ: queries per step, sends per step, cost; printed digits are exact to half a unit
SCALAR = {1.65: (1 / 2, 0.93565, 1.25325), 1.5: (2 / 3, 0.90937, 0.97771)}


@pytest.mark.parametrize("zeta", SCALAR)
def test_rates_and_costs_of_the_scalar_example(zeta: float) -> None:
    """The schedule exactly, the rest within four standard errors and half a digit."""
    queried, sent, cost = SCALAR[zeta]
    problem = taciturn.load("remote-scalar").changed({"zeta": zeta})
    found = taciturn.evaluate(problem, seed=3, standard_error=1e-5)
    assert found.rates["sensor"].value == pytest.approx(queried, abs=1e-15)
    assert found.rates["sensor"].standard_error == 0
    assert found.rates["actuator"].standard_error < 2e-4
    # the reference values are simulations too: two errors combine
    assert abs(found.rates["actuator"].value - sent) <= 4 * 2**0.5 * found.rates["actuator"].standard_error + 5e-6
    assert abs(found.cost.value - cost) <= 4 * 2**0.5 * found.cost.standard_error + 5e-6
    assert found.cost_all_time == pytest.approx(0.481486, abs=5e-7)
    assert found.cost_bound == pytest.approx(1.2 * (0.481486 + zeta), abs=1e-6)


def test_the_double_integrator() -> None:
    """One query in seven; the noise covariances are a best guess, as the thesis prints none."""
    found = taciturn.evaluate(taciturn.load("remote-double-integrator"), seed=4, standard_error=2e-5)
    assert found.cost_all_time == pytest.approx(0.45755, abs=5e-6)
    assert found.rates["sensor"].value == pytest.approx(1 / 7, abs=1e-15)
    assert abs(found.rates["actuator"].value - 0.350) <= 4 * found.rates["actuator"].standard_error + 5e-4
    assert abs(found.cost.value - 0.70594) <= 4 * 2**0.5 * found.cost.standard_error + 5e-6


@pytest.mark.parametrize(("zeta", "inside"), [(1.4754, False), (1.4756, True), (1.5397, True), (1.5399, False)])
def test_the_printed_66_percent_belong_to_an_interval(zeta: float, inside: bool) -> None:
    """Two queries in three for ζ from 1.4755 to 1.5398 only: ζ = 1.65 is a misprint."""
    schedule = taciturn.load("remote-scalar").changed({"zeta": zeta}).design().schedule
    assert schedule is not None
    assert (abs(schedule.rate - 2 / 3) < 1e-12) == inside


def test_the_collocated_controllers() -> None:
    """At the actuator J ≤ J_all + ζ, exact; at the sensor J ≤ (1+θ) J_all."""
    plant, cost = Plant([[2.0]], [[1.0]], [[0.01]], [[3.0]], [[0.02]]), Cost([[1.0]], [[2.0]])
    actuator = design.remote_lqg(plant, cost, zeta=1.5, controller="actuator")
    assert actuator.theory.closed_form is not None
    assert actuator.guarantee is not None
    assert actuator.cost_all_time < actuator.theory.closed_form.cost <= actuator.guarantee.cost
    assert actuator.guarantee.cost == pytest.approx(0.481486 + 1.5, abs=5e-7)
    sensor = design.remote_lqg(plant, cost, theta=0.2, controller="sensor")
    assert sensor.guarantee is not None
    assert sensor.guarantee.cost == pytest.approx(1.2 * 0.481486, abs=1e-6)
