"""Periodic packets over links that drop or delay them, with acknowledgements: exact costs against simulations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from counts import few
from laws.test_late_excess import LATE, PERIOD, WEIGHTS, drawn, network, seconds
from measured import agree_together, average

import taciturn
from taciturn import Burst, ContinuousPlant, Plant, Policy, ProblemError, UnstableError, close
from taciturn.base.filter import SEND
from taciturn.base.given_controller import SameControl
from taciturn.base.late import Delays, chain_of, periodic_cost
from taciturn.base.periods import discrete_periods
from taciturn.base.value import advantage
from taciturn.design import excess
from taciturn.design.late_base import PeriodicPackets
from taciturn.model.link import LinkLaw
from taciturn.model.steps import Decide, Location
from taciturn.model.theory import Theory
from taciturn.model.trigger import Form, Scheduled, Trigger


def timed(policy: Policy, every: int) -> Policy:
    """Return the policy that sends at every q-th step, whatever its nodes know."""
    turns = Scheduled("turn", np.array([-1.0, *[1.0] * (every - 1)]))
    rule = Trigger({"silent": Form(), SEND: Form(constant=turns)})
    steps = tuple(
        replace(one, trigger=rule) if isinstance(one, Decide) and one.decision == SEND else one for one in policy.steps
    )
    theory = Theory(cost=policy.theory.cost, settling=policy.theory.settling, covers=policy.theory.covers)
    place = Location("turn", np.array([*range(1, every), 0]))
    return replace(policy, steps=steps, locations=(place,), theory=replace(theory, functions=policy.theory.functions))


def differs(plant: Plant | ContinuousPlant, policy: Policy, exact: float, every: int, seed: int) -> float:
    """Return by how many standard errors a simulation of periodic packets differs from the exact cost."""
    found = average(close(plant, timed(policy, every)), steps=60_000, seed=seed)
    assert next(iter(found.rates.values())).value * policy.tick == pytest.approx(1 / every, abs=1e-3)
    return (found.cost.value - exact) / found.cost.standard_error


@pytest.mark.parametrize("first", few(range(0, 240, 8), 1))
def test_the_cost_of_periodic_packets_with_random_delays_is_that_of_simulations(first: int) -> None:
    """LQG and given controllers, losses, bursts, delays of whole periods and parts; each with two to four steps."""
    differences = list[float]()
    for seed in range(first, first + 8):
        every = 2 + seed % 3
        try:
            plant, policy = drawn(seed)
        except (UnstableError, ProblemError):
            continue
        periodic = policy.theory.periodic
        assert isinstance(periodic, PeriodicPackets)
        chain, problem = periodic.closed.found.chain, periodic.closed.loop.problem
        cost = periodic_cost(chain, every)
        if cost is None or (policy.theory.fourth or 2.0) > 0.9 or cost > 1.5 * policy.cost_all_time * problem.unit:
            continue  # such a loop is not stable, or its average has a large variance
        differences.append(differs(plant, policy, problem.per_unit(cost - problem.noise_cost), every, seed))
        assert periodic(every) <= cost - problem.noise_cost
    assert len(differences) > 1
    assert agree_together(differences), differences


@pytest.mark.parametrize("seed", few([1, 0, *range(2, 24)], 3))
def test_the_cost_of_periodic_packets_over_links_with_losses_is_that_of_simulations(seed: int) -> None:
    """Independent losses and bursts, a held input, zero and a model."""
    burst, every = Burst(0.1, 0.3, 0.0, 0.6), 2 + seed % 3
    law = LinkLaw(acknowledged=True, **({"loss": 0.2} if seed % 2 else {"burst": burst}))
    silence = ("hold", "zero", "model")[seed % 3]
    plant = Plant([[1.05, 0.1], [0.0, 0.9]], [[0.1], [0.5]], np.diag([0.1, 0.2]), [[1.0, 0.0]], [[0.1]])
    cost = taciturn.Cost(np.eye(2), [[0.5]])
    links = taciturn.Network(links={"actuator": law})
    policy = excess(plant, cost, theta=0.1, network=links, actuation=silence)  # type: ignore[arg-type]
    periodic = policy.theory.periodic
    assert isinstance(periodic, SameControl)
    pattern = replace(periodic.attempts, pattern=(True, *[False] * (every - 1)))
    found = advantage(periodic.base, "", pattern)
    exact = periodic.at_its_step(every)
    assert exact == found.cost
    assert found.fourth is not None
    if found.fourth < 0.95:  # otherwise, a simulated average has no useful error
        assert abs(differs(plant, policy, exact, every, seed)) < 4.5
    assert periodic(every) <= exact
    assert (periodic(4) < exact) or every < 4 or silence == "model"  # other gains are better for a held input


def test_sending_every_step_is_the_base() -> None:
    """The formula for cycles of one step is that of J_all; a cycle that no gain stabilises has no cost."""
    late = network(seconds([0.06, 0.15, 0.27], [0.45, 0.25, 0.2]))
    policy = excess(LATE, WEIGHTS, theta=0.1, period=PERIOD, network=late)
    periodic = policy.theory.periodic
    assert isinstance(periodic, PeriodicPackets)
    chain, problem = periodic.closed.found.chain, periodic.closed.loop.problem
    found = periodic_cost(chain, 1)
    assert found is not None
    assert problem.per_unit(found - problem.noise_cost) == pytest.approx(policy.cost_all_time, rel=1e-9)
    assert periodic_cost(chain, 12) is None
    one = np.eye(1)
    scalar = discrete_periods(0.5 * one, one, one, one, 0 * one, one)  # x⁺ = .5 x + u, with the cost x² + u²
    stable = chain_of(scalar, -0.3 * np.eye(1, 2), Delays.of([1], [1.0]))
    # u = −.3 x lasts for 500 steps, in which x has the mean 2u and the variance 4/3: E x² = 4/3 + 4·.09 E x²
    assert periodic_cost(stable, 500) == pytest.approx(1.09 * 4 / 3 / (1 - 0.36), rel=0.01)
    with pytest.raises(UnstableError, match="periodic control is unstable with one packet in 40 steps"):
        periodic(40)


@pytest.mark.evidence
def test_the_comparison_at_the_same_rate_is_fair() -> None:
    """It costs more than the policy, and no more than the policy's own gains with periodic packets."""
    law = {"network.protocol": "tcp", "network.actuator_delay": [0.2, 0.3, 0.5], "network.actuator_loss": 0.1}
    problem = taciturn.load("inverted-pendulum").changed({"kind": "excess", "theta": 0.2, **law})
    found = taciturn.evaluate(problem, standard_error=5e-3)
    assert found.periodic is not None
    assert found.periodic.value > found.cost.value + 10 * found.cost.standard_error
    unknown = problem.changed({"network.protocol": "udp"})
    told = str(taciturn.evaluate(unknown, standard_error=5e-3)).replace("\n", " ")
    assert "acknowledge those that arrive" in " ".join(told.split())
