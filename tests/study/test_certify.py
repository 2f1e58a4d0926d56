"""Certificates of problems: units, sending every sample, and what is not proved."""

from __future__ import annotations

import pytest
from counts import few

import taciturn
from taciturn import Cost, Network, Plant, Problem, ProblemError


@pytest.mark.parametrize(
    "name", few(["two-mass-lqg", "double-integrator", "inverted-pendulum", "wiener-double-integrator"], start=1)
)
def test_sending_always_costs_what_the_design_says(name: str) -> None:
    """By the switched map and by Riccati equations: per step or per second, inter-sample noise included."""
    problem = taciturn.load(name)
    found, policy = taciturn.certify(problem), problem.design()
    assert found.cost_all_time == pytest.approx(policy.cost_all_time, rel=1e-6)
    assert found.cost_bound is not None
    assert found.cost_bound >= policy.cost_all_time * (1 - 1e-9)
    assert found.unit == ("step" if name == "two-mass-lqg" else "second")


@pytest.mark.parametrize("name", few(["double-integrator", "inverted-pendulum"], quick=1))
def test_the_bound_is_in_the_units_of_the_cost(name: str) -> None:
    """What is simulated, per second and under jumps too, is below the bound and within a factor of it."""
    problem = taciturn.load(name)
    found, simulated = taciturn.certify(problem), taciturn.evaluate(problem, steps=400_000)
    assert found.cost_bound is not None
    assert simulated.cost.value - 4 * simulated.cost.standard_error <= found.cost_bound < 2 * simulated.cost.value


def test_without_noise_only_the_gain_is_missing() -> None:
    """The rest is proved, and a note says what is not."""
    plant, cost = Plant([[1.2]], [[1.0]], [[0.0]]), Cost([[1.0]], [[1.0]])
    found = taciturn.certify(Problem(plant, cost, Network(), "relative", {"sigma": 0.1}))
    assert found.gain is None
    assert found.notes == (
        "the loop has no noise (W and V are zero), so it has no gain from noise to cost; expected a nonzero W or V",
    )
    assert found.decay is not None
    assert found.limit == 0
    assert found.cost_bound == pytest.approx(0.0, abs=1e-6)
    assert found.document()["gain"] is None


def test_a_loop_that_sends_always_is_one_action() -> None:
    """All-time control is certified exactly: nothing is above it."""
    found = taciturn.certify(taciturn.load("two-mass-lqg").changed({"theta": None, "kind": "all-time"}))
    assert found.actions == ("always",)
    assert found.cost_bound == pytest.approx(found.cost_all_time, rel=1e-6)
    assert found.gain == pytest.approx(found.gain_all_time, rel=1e-6)
    assert found.limit == 0


def test_where_nothing_is_proved_the_loop_is_refused() -> None:
    """An unstable plant outruns a relative threshold of twenty times the state."""
    plant, cost = Plant([[1.5]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
    with pytest.raises(ProblemError, match="nothing could be proved for this loop"):
        taciturn.certify(Problem(plant, cost, Network(), "relative", {"sigma": 20.0}))
