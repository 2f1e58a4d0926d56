"""The period of the checks is sought together with the threshold."""

from __future__ import annotations

import pytest

import taciturn
from taciturn import ProblemError
from taciturn.lqg.prediction import prediction_cost
from taciturn.study.evaluation import Evaluation
from taciturn_studies.tune import TunedPeriod, tune_period

INTEGRATOR = taciturn.load("wiener-double-integrator").changed({"kind": "consistent", "theta": None, "period": 1.0})


def removed(found: Evaluation) -> float:
    """Return the share of what periodic control costs above a state that is always known, at the same rate."""
    plant, cost = INTEGRATOR.plant, INTEGRATOR.cost
    least = prediction_cost(plant.A, plant.B, cost.Q, cost.R, cost.N, plant.W).periodic(1e-9)
    assert found.cost_periodic_same_rate is not None
    return (found.cost_periodic_same_rate - found.cost.value) / (found.cost_periodic_same_rate - least)


def sought(least: float) -> tuple[Evaluation, TunedPeriod]:
    """Return the policy at its largest proved threshold, and what is found at its rate."""
    proved = taciturn.evaluate(INTEGRATOR)
    return proved, tune_period(INTEGRATOR, rate=proved.rates["sensor"].value, least=least)


@pytest.mark.evidence
def test_looking_more_often_and_asking_for_more_costs_less_at_the_same_rate() -> None:
    """Where the proved threshold removes 47 % of what periodic control costs too much; the rate is exactly the same."""
    proved, found = sought(0.4)
    best = found.best.evaluation
    assert best.rates["sensor"].value == pytest.approx(proved.rates["sensor"].value, rel=1e-8)
    assert removed(proved) == pytest.approx(0.47, abs=0.005)
    assert removed(best) > 0.55
    assert (proved.consistency, best.consistency) == ("guaranteed", "verified")
    costs = [one.evaluation.cost.value for one in found.tried]
    assert len(costs) > 1
    assert best.cost.value == min(costs)
    rows = found.document()["periods"]
    assert [row["cost"] for row in rows] == costs
    assert found.document()["period"] == rows[costs.index(min(costs))]["period"]


@pytest.mark.evidence
def test_at_most_71_percent_of_what_periodic_control_costs_too_much_is_removed() -> None:
    """Down to an eighth of a second: between 61 and 71 % of it."""
    _, found = sought(0.12)
    assert 0.61 <= removed(found.best.evaluation) <= 0.71


def test_a_period_that_cannot_be_sought_is_refused() -> None:
    """A discrete plant, no period, a least period above the first, a rate that is none."""
    with pytest.raises(ProblemError, match="lqg has no period to tune here; expected a continuous"):
        tune_period(taciturn.load("two-mass-lqg"), rate=0.3, least=0.1)
    with pytest.raises(ProblemError, match=r"the least period is 2 s, but at 1 send per second"):
        tune_period(INTEGRATOR, rate=1.0, least=2.0)
    with pytest.raises(ProblemError, match="rate is 0"):
        tune_period(INTEGRATOR, rate=0.0, least=0.1)
