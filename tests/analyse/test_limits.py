"""Lower bounds of loops: what they refuse, the line that they are, and their units."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

import taciturn
from taciturn import ContinuousPlant, Cost, Network, Plant, Policy, ProblemError, close, design
from taciturn.model.plant import Jumps
from taciturn.model.theory import LowerBound
from taciturn.problem import parse
from taciturn_limits import dual
from taciturn_limits.bounds import EASY, bound_below

PLANT = Plant([[1.0, 0.2], [0.0, 0.9]], [[0.0], [1.0]], [[0.5, 0.1], [0.1, 0.3]])
COST = Cost(np.eye(2), [[1.0]])
TABLES = {
    "plant": {"A": [[0, 1], [0, 0]], "B": [[0], [1]], "W": [[0.1, 0], [0, 2.5]]},
    "cost": {"Q": [[1, 0], [0, 1]], "R": [[10]]},
}


def excess(actuation: str = "model") -> Policy:
    """Return the trigger on what silence costs."""
    return design.excess(PLANT, COST, theta=0.5, actuation=actuation)


@pytest.mark.parametrize(
    ("policy", "words"),
    [
        (
            excess("hold"),
            "a lower bound requires that a send resets the error that determines the cost, but a send of excess does "
            "not reset it; ",
        ),
        (design.lqg(PLANT, COST, theta=0.3), "but a send of lqg does not reset it; "),
        (
            design.remote_lqg(PLANT, COST, theta=0.3, zeta=1.0),
            "but remote-lqg decides on several links (",
        ),
    ],
)
def test_a_loop_whose_sends_reset_no_error_has_no_bound(policy: Policy, words: str) -> None:
    """A held input is not an error that a send sets to zero and that moves by itself."""
    with pytest.raises(ProblemError) as refused:
        bound_below(close(PLANT, policy), 0.3)
    assert words in str(refused.value)


def test_a_loop_that_departs_from_its_design_has_no_bound() -> None:
    """Another plant, or links that lose."""
    other = Plant(0.9 * PLANT.A, PLANT.B, PLANT.W)
    with pytest.raises(
        ProblemError, match="the plant is not the one of the design; expected the plant, network and cost of the design"
    ):
        bound_below(close(other, excess()), 0.3)
    with pytest.raises(ProblemError, match="the network is not the one of the design; expected the plant, network"):
        bound_below(close(PLANT, excess(), Network("tcp", 0.1)), 0.3)


def test_noise_in_jumps_has_no_bound() -> None:
    """The error is the same, its law is not."""
    plant = ContinuousPlant([[0.0]], [[1.0]], jumps=Jumps(5.0, [[0.2]]))
    policy = design.consistent(plant, Cost([[1.0]], [[1.0]]), period=0.2)
    with pytest.raises(ProblemError, match="the noise consists of jumps; expected Gaussian noise for optima"):
        bound_below(close(plant, policy), 0.3)


@pytest.mark.parametrize(
    ("rate", "confidence", "words"),
    [
        (0.3, 1.0, "confidence is 1; expected 0 < confidence < 1"),
        (0.3, 1.5, "confidence is 1.5"),
        (0.3, 0.0, "confidence is 0"),
        (1.2, 0.9, "rate is 1.2; expected a rate of at most 1"),
        (0.0, 0.9, "rate is 0"),
        (float("nan"), 0.9, "rate is nan"),
    ],
)
def test_a_rate_or_a_confidence_that_cannot_be_is_one_sentence(rate: float, confidence: float, words: str) -> None:
    """What, got, expected."""
    with pytest.raises(ProblemError) as refused:
        bound_below(close(PLANT, excess()), rate, confidence)
    assert words in str(refused.value)


@pytest.mark.parametrize(
    ("rates", "times", "slack"),
    [((0.3, 0.6), 1, 1e-2), pytest.param((0.1, 0.3, 0.6), dual.MOST, 2e-3, marks=pytest.mark.evidence)],
)
def test_the_bound_falls_with_the_rate_to_the_cost_of_sending_always(
    rates: tuple[float, ...], times: int, slack: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its price falls as well, a line of one price is below the bounds of others, and the last is J_all itself."""
    monkeypatch.setattr(dual, "MOST", times)
    loop = close(PLANT, excess())
    found = [bound_below(loop, rate) for rate in rates]
    for rarer, oftener in pairwise(found):
        assert rarer.cost > oftener.cost > loop.policy.cost_all_time
        assert rarer.price > oftener.price > 0
    for one in found:
        assert one.at_rate(one.rate) == one.cost
        assert one.at_rate(one.rate + 0.01) == pytest.approx(one.cost - 0.01 * one.price, rel=1e-12)
        for other in found:
            size = other.cost - loop.policy.cost_all_time + other.price * other.rate
            assert one.at_rate(other.rate) <= other.cost + slack * size  # of draws and of tuning
    last = bound_below(loop, max(EASY, 0.98))
    assert last == LowerBound(loop.policy.cost_all_time, 0.999, 0.98, 0.0)


@pytest.mark.evidence
def test_another_trigger_with_the_same_controller_has_the_same_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is that of the loop, whatever its policy decides by."""
    monkeypatch.setattr(dual, "MOST", 1)
    loops = [close(PLANT, excess()), close(PLANT, design.lqg(PLANT, COST, theta=0.3, actuation="model"))]
    one, other = (bound_below(loop, 0.6) for loop in loops)
    assert one == other


def test_noise_that_no_input_answers_costs_nothing_in_silence() -> None:
    """An input that the cost forbids to use: sending never is as good as sending every sample."""
    plant, cost = Plant([[0.5]], [[0.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
    policy = design.excess(plant, cost, delta=1.0, actuation="model")
    found = bound_below(close(plant, policy), 0.1)
    assert found.cost == policy.cost_all_time
    assert found.price == 0


@pytest.mark.evidence
def test_the_bound_is_at_most_what_the_best_schedule_costs_per_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """A continuous plant that is looked at every half second: solved per check, said per second."""
    monkeypatch.setattr(dual, "MOST", 2)
    price = 9.0
    best = taciturn.evaluate(parse(TABLES | {"policy": {"kind": "optimal", "price": price, "period": 0.5}}, "here"))
    rate = best.rates["sensor"].value
    problem = parse(TABLES | {"policy": {"kind": "consistent", "period": 0.5}}, "here")
    loop = problem.close(problem.design())
    found = bound_below(loop, 0.5 * rate)
    assert best.cost_all_time == pytest.approx(loop.policy.cost_all_time, rel=1e-12)
    assert found.cost <= best.cost.value + best.cost.error
    assert found.cost >= best.cost.value - 0.01 * (best.cost.value - loop.policy.cost_all_time + price * rate)
    assert found.price == pytest.approx(price / 0.5, rel=0.2)  # λ/τ, of about this rate
    again = taciturn.evaluate(
        parse(TABLES | {"policy": {"kind": "near-optimal", "price": price, "period": 0.5}}, "here"),
        standard_error=1e-2,
        confidence=0.999,
    )
    assert again.lower_bound is not None
    error = np.hypot(again.cost.standard_error, price * again.rates["sensor"].standard_error)
    assert abs(again.cost.value + price * again.rates["sensor"].value - best.cost.value - price * rate) <= 4.5 * error
    assert again.lower_bound.cost <= again.cost.value + 4 * error
