"""Chapter 6 of the thesis: a robot's finite-horizon run of 60 steps, with a schedule for the camera."""

from __future__ import annotations

import pytest
from counts import few

import taciturn
from taciturn.simulation.average import average, plain_average

# initial position: all-time cost, cost; printed digits are exact to half a unit
MISSIONS = {0.6322: (103.65, 112.63), 0.7: (126.73, 137.74)}


@pytest.mark.parametrize("start", few(MISSIONS, quick=1))
def test_costs_and_rates_of_the_mission(start: float) -> None:
    """Totals by the identity and by the plain sum with its terminal weight; 11 queries; 7.5 % of the inputs."""
    all_time, cost = MISSIONS[start]
    problem = taciturn.load("rover").changed({"plant.initial.mean": [start]})
    found = taciturn.evaluate(problem, seed=5, standard_error=5e-3)
    assert found.unit == "mission"
    assert found.cost_all_time == pytest.approx(all_time, abs=5e-3)
    assert abs(found.cost.value - cost) <= 4 * found.cost.standard_error + 5e-3
    assert found.rates["sensor"].value == pytest.approx(11 / 60, abs=1e-15)
    assert abs(found.rates["actuator"].value - 0.075) <= 4 * found.rates["actuator"].standard_error + 5e-4
    loop = problem.close(problem.design())
    plain = average(loop, plain_average(loop), seed=6, standard_error=2e-2).cost
    assert abs(plain.value - cost) <= 4 * plain.standard_error + 5e-3


def test_when_the_camera_is_asked() -> None:
    """k = 5, 10, …, 45, 51, 58."""
    schedule = taciturn.load("rover").design().schedule
    assert schedule is not None
    assert schedule.ticks == [5, 10, 15, 20, 25, 30, 35, 40, 45, 51, 58]
    assert schedule.period is None


def test_the_bound_counts_59_queries() -> None:
    """(1+θ)(J_all + (N−1)ζ): a query at the last step comes too late to be used."""
    policy = taciturn.load("rover").design()
    assert policy.guarantee is not None
    assert policy.guarantee.cost == pytest.approx(1.5 * (policy.cost_all_time + 59 * 0.004), rel=1e-14)


def test_the_first_input_is_no_voltage() -> None:
    """Between 36 and 40, where the thesis says |u| ≤ 6 V: the input is a duty cycle in percent."""
    for start, low, high in ((0.6322, 35, 37), (0.7, 39, 41)):
        problem = taciturn.load("rover").changed({"plant.initial.mean": [start]})
        first = abs(taciturn.simulate(problem.close(problem.design()), 60).input[0, 0])
        assert low < first < high
