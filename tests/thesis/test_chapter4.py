"""Chapter 4 of the thesis: the consistent dynamic trigger under Poisson jumps, and a threshold that is none."""

from __future__ import annotations

import numpy as np
import pytest
from counts import few

import taciturn
from taciturn import ContinuousPlant, Cost, Jumps, ProblemError, design
from taciturn.lqg.prediction import prediction_cost
from taciturn.problem import parse
from taciturn_events.cycles import estimate_cycles
from taciturn_events.events import JumpProcess, LevelTrigger

DOUBLE = ContinuousPlant([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], jumps=Jumps(5.0, np.diag([0.0, 0.5])))
COST = Cost(np.eye(2), [[10.0]])
# slope C: fixed point α*, cost J; h_max = 2
TABLE = {
    1: (0.330, 21.723), 2: (0.463, 22.296), 3: (0.640, 23.179), 4: (0.839, 24.308), 5: (1.020, 25.511),
    6: (1.168, 26.681), 7: (1.286, 27.783), 8: (1.380, 28.817), 9: (1.457, 29.79),
}  # fmt: skip
COUNTER = ContinuousPlant([[1.0, 0.01], [0.0, 1.0]], np.eye(2), jumps=Jumps(50.0, np.diag([0.001, 0.4])))
WEIGHTS = Cost(np.diag([10.0, 0.001]), np.diag([10.0, 0.001]))


@pytest.mark.evidence
@pytest.mark.parametrize("slope", few(TABLE, quick=1))
def test_fixed_points_and_costs(slope: int) -> None:
    """Each slope of the table, the cost by cycles of its own."""
    alpha, cost = TABLE[slope]
    policy = design.integral(DOUBLE, COST, slope=slope, h_max=2.0)
    assert abs(policy.alpha.value - alpha) <= 4 * policy.alpha.standard_error + 5e-4
    found = estimate_cycles(policy.process, policy.trigger, cycles=1_000_000, seed=slope)
    assert abs(found.interval.value - policy.alpha.value) <= 5 * policy.alpha.standard_error
    half = 5e-3 if slope == 9 else 5e-4
    sensitivity = 2 * slope * policy.alpha.standard_error  # of the cost, to the error of the fixed point
    error = 4 * found.cost.standard_error + 4 * sensitivity + half
    assert abs(policy.cost_all_time + found.cost.value - cost) <= error
    assert policy.cost_all_time + found.cost.value <= policy.bound() + 4 * found.cost.standard_error


@pytest.mark.evidence
def test_the_printed_slope() -> None:
    """C = 9.1557: α* = 1.46812 ± .00014, g = 8.5418 ± .0007, J = 29.9377, and periodic control costs 40.358."""
    policy = design.integral(DOUBLE, COST, slope=9.1557, h_max=2.0)
    assert abs(policy.alpha.value - 1.46812) <= 4 * np.hypot(policy.alpha.standard_error, 0.00014)
    found = estimate_cycles(policy.process, policy.trigger, cycles=4_000_000, seed=1)
    error = 4 * np.hypot(found.cost.standard_error, 0.0007) + 4 * 9.16 * policy.alpha.standard_error
    assert abs(found.cost.value - 8.5418) <= error
    price = prediction_cost(DOUBLE.A, DOUBLE.B, COST.Q, COST.R, COST.N, DOUBLE.W)
    assert policy.cost_all_time == pytest.approx(21.395904, abs=5e-7)
    assert price.periodic(1.46812) == pytest.approx(40.358, abs=5e-4)


@pytest.mark.evidence
def test_the_printed_alpha_is_not_admissible() -> None:
    """α = 1.50 violates α ≤ L(α), as L(1.5) = 1.47742."""
    with pytest.raises(ProblemError, match=r"alpha is 1.5, but the resulting mean interval L\(alpha\) is 1\.47"):
        design.integral(DOUBLE, COST, slope=9.1557, alpha=1.5, h_max=2.0)


@pytest.mark.evidence
def test_the_dynamic_trigger_beats_periodic_control_where_a_euclidean_threshold_loses_to_it() -> None:
    """Counter-example 4.5.2: E[θ] = .971 and g = 1.2 against 3.06; |e| ≥ 2: E[θ] = .256 and g = .858 against .439."""
    price = prediction_cost(COUNTER.A, COUNTER.B, WEIGHTS.Q, WEIGHTS.R, WEIGHTS.N, COUNTER.W)
    assert price.initial_slope == pytest.approx(1.427446, abs=5e-7)
    policy = design.integral(COUNTER, WEIGHTS, slope=6.0, alpha=0.2, h_max=10.0)
    dynamic = estimate_cycles(policy.process, policy.trigger, cycles=400_000, seed=2)
    assert abs(dynamic.interval.value - 0.971) <= 4 * dynamic.interval.standard_error + 5e-4
    assert abs(dynamic.cost.value - 1.2) <= 4 * dynamic.cost.standard_error + 1e-4
    assert price.growth(dynamic.interval.value) == pytest.approx(3.06, abs=0.02)
    process = JumpProcess(COUNTER.A, COUNTER.jumps, price.S)
    euclidean = estimate_cycles(process, LevelTrigger(np.eye(2), 4.0, 10.0), cycles=400_000, seed=3)
    assert abs(euclidean.interval.value - 0.256) <= 4 * euclidean.interval.standard_error + 5e-4
    assert abs(euclidean.cost.value - 0.858) <= 4 * euclidean.cost.standard_error + 5e-4
    assert price.growth(0.256) == pytest.approx(0.439, abs=5e-4)
    assert euclidean.cost.value > 1.9 * price.growth(euclidean.interval.value)


@pytest.mark.evidence
def test_where_nothing_limits_an_interval_the_cost_is_exact() -> None:
    """h_max = ∞ and linear f: every interval costs cθ, so J = tr(PλW) + c."""
    tables = {
        "plant": {"A": [[0, 1], [0, 0]], "B": [[0], [1]], "jumps": {"rate": 5, "covariance": [[0, 0], [0, 0.5]]}},
        "cost": {"Q": [[1, 0], [0, 1]], "R": [[10]]},
        "policy": {"kind": "integral", "slope": 5.0, "alpha": 1.0},
    }
    found = taciturn.evaluate(parse(tables, "here"), steps=200_000)
    assert found.cost.method == "exact"
    assert found.cost.value == pytest.approx(21.395904 + 5.0, abs=1e-6)
    assert found.cost_bound == found.cost_bound_at_rate == found.cost.value
    assert found.cost_periodic_same_rate > found.cost.value
