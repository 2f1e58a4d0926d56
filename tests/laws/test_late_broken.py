"""Attempts to break the guarantee under random delays: each is refused, or runs without a claim."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from laws.test_late_excess import network
from runtime.late import pendulum

import taciturn
from taciturn import Burst, Cost, Plant, close
from taciturn.design import excess
from taciturn.errors import InformationError, ProblemError
from taciturn.model.steps import ONE, Acted, Assign, Decide

STEPS = Plant([[1.02, 0.1], [0.0, 0.98]], [[0.005], [0.1]], np.diag([0.001, 0.01]), [[1.0, 0.0]], [[0.05]])
WEIGHTS = Cost(np.diag([1.0, 0.1]), [[0.1]])


def test_delays_in_bursts_are_not_independent_ones_with_the_same_mean() -> None:
    """The formula for independent delays is wrong for them, and a design for these claims nothing over bursts."""
    burst, states = Burst(0.05, 0.1, 0.0, 0.6), {"states": [[0.9, 0.1], [0.1, 0.9]]}
    bursts = network(states, burst=burst)
    alike = bursts.without_bursts()
    known, assumed = (excess(STEPS, WEIGHTS, theta=0.1, network=one) for one in (bursts, alike))
    assert known.cost_all_time > 1.02 * assumed.cost_all_time
    loop = close(STEPS, assumed, bursts, WEIGHTS)
    assert loop.violated_assumptions
    found = taciturn.average(loop, steps=200_000, seed=2)
    assert found.cost.value - 4 * found.cost.standard_error > assumed.cost_all_time
    true = close(STEPS, known)
    assert true.violated_assumptions == ()


@pytest.mark.evidence
def test_a_filter_that_does_not_learn_what_acts_has_no_claim() -> None:
    """Without acknowledgements, and without the delay in the design; with losses alone, it needs acknowledgements."""
    late = pendulum({"theta": 0.1, "delta": None})
    with pytest.raises(ProblemError, match="needs to know at the end of a step whether its packet"):
        close(late.plant, late.changed({"links.actuator.delay": None}).design(), late.network)
    untold = late.changed({"links.actuator.acknowledged": False})
    unaware = untold.changed({"links.actuator.delay": None}).design()
    assert close(untold.plant, unaware, untold.network).violated_assumptions
    assert taciturn.evaluate(untold, standard_error=1e-2).cost_bound is None
    assert taciturn.evaluate(late, standard_error=1e-2).cost_bound is not None


def test_nobody_knows_a_delay_in_advance() -> None:
    """A decision that depends on when its packet will arrive is refused when the loop is closed."""
    problem = pendulum()
    policy, one = problem.design(), np.ones((1, 1))
    place = next(i for i, step in enumerate(policy.steps) if isinstance(step, Decide) and step.decision == "send")
    foreseen = Assign("controller", "foreseen", ({ONE: 0 * one}, {ONE: one}), Acted("actuator", 0, 0))
    told = replace(policy, steps=(*policy.steps[:place], foreseen, *policy.steps[place:]))
    with pytest.raises(InformationError, match="no node knows a delay in advance"):
        close(problem.plant, told, problem.network)


def test_another_law_of_delays_has_no_claim() -> None:
    """As with longer delays than those of the design, or more losses."""
    usual = excess(STEPS, WEIGHTS, theta=0.1, network=network([0.5, 0.4]))
    for other in (network([0.4, 0.5]), network([0.5, 0.4], loss=0.1), network([0.5, 0.2, 0.2])):
        assert close(STEPS, usual, other, WEIGHTS).violated_assumptions
    assert close(STEPS, usual).violated_assumptions == ()
