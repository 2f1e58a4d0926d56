"""Where the policies of remote sensing and of lossy links must meet what is known: limits, and each other."""

from __future__ import annotations

import numpy as np
import pytest
from catalogue import closed, lossy, started
from counts import few
from drawn import law
from hypothesis import given, settings
from hypothesis import strategies as st
from measured import average
from systems import System, systems

from taciturn import Cost, Network, Plant, ProblemError, close, design
from taciturn._modes import radius
from taciturn.errors import InformationError
from taciturn.lqg.equation import accumulate
from taciturn.model.policy import Policy

FEW = settings(max_examples=15, deadline=None)
NETWORKS = (Network("udp"), Network("tcp"), Network())


def assert_same_numbers(one: Policy, other: Policy) -> None:
    """Compare costs, bounds and gains."""
    assert one.cost_all_time == pytest.approx(other.cost_all_time, rel=1e-12)
    assert one.guarantee is not None
    assert other.guarantee is not None
    assert one.guarantee.cost == pytest.approx(other.guarantee.cost, rel=1e-12)
    gains = [
        next(step.branches[0]["estimate"] for step in policy.steps if getattr(step, "signal", "") == "command")
        for policy in (one, other)
    ]
    one_gain, other_gain = (getattr(gain, "values", gain) for gain in gains)
    np.testing.assert_allclose(one_gain, other_gain, rtol=1e-9, atol=1e-12)


@law(10, 300, system=systems(), horizon=st.sampled_from([None, 1, 2, 17]), delay=st.booleans())
def test_zero_loss_makes_the_three_protocols_equal(system: System, horizon: int | None, delay: bool) -> None:
    """The same gains, costs and bounds, for finite-horizon runs and averages, with and without delay."""
    plant = started(Plant(system.plant.A, system.plant.B, system.plant.W), system.seed)
    cost = Cost(system.cost.Q, system.cost.R, horizon=horizon)
    udp, tcp, ideal = (
        design.lossy_lqg(plant, cost, price=0.1, network=Network(network.protocol, delay=int(delay)))
        for network in NETWORKS
    )
    assert_same_numbers(udp, tcp)
    assert_same_numbers(udp, ideal)
    if not delay:  # then it is optimal control of the measured state
        regulated = design.all_time(Plant(plant.A, plant.B, plant.W), Cost(system.cost.Q, system.cost.R))
        assert horizon is not None or udp.cost_all_time == pytest.approx(regulated.cost_all_time, rel=1e-9)


@pytest.mark.evidence
@FEW
@given(system=systems())
def test_zero_loss_makes_the_three_loops_equal(system: System) -> None:
    """The same draws give the same cost and the same sends."""
    plant = started(Plant(system.plant.A, system.plant.B, system.plant.W), system.seed)
    cost = Cost(system.cost.Q, system.cost.R, horizon=25)
    price = 0.1 * design.lossy_lqg(plant, cost, price=0.0).cost_all_time / 25
    found = [
        average(close(plant, design.lossy_lqg(plant, cost, price=price, network=network)), seed=1, steps=50_000)
        for network in NETWORKS
    ]
    for other in found[1:]:
        assert other.cost.value == pytest.approx(found[0].cost.value, rel=1e-9)
        assert other.rates["actuator"].value == found[0].rates["actuator"].value


@FEW
@given(system=systems(), horizon=st.sampled_from([None, 20]), discount=st.sampled_from([1.0, 0.9]))
@pytest.mark.evidence
def test_zeta_and_theta_of_zero_are_all_time_control(system: System, horizon: int | None, discount: float) -> None:
    """J = J_all exactly, every query and every input sent."""
    weights = system.cost
    discount = 1.0 if horizon is not None else discount
    cost = Cost(weights.Q, weights.R, weights.N, horizon=horizon, discount=discount)
    policy = design.remote_lqg(started(system.plant, system.seed), cost, theta=0.0, zeta=0.0)
    found = average(closed(policy), seed=system.seed, steps=50_000)
    assert policy.guarantee is not None
    assert policy.guarantee.cost == pytest.approx(policy.cost_all_time, rel=1e-12)
    assert policy.schedule is not None
    useful = policy.schedule.value > 1e-9 * policy.cost_all_time
    assert policy.schedule.queries[useful].all()
    assert found.cost.value == pytest.approx(policy.cost_all_time, rel=1e-9)
    if useful[policy.schedule.start or 0 :].all():
        assert found.rates["actuator"].value >= 1 - 1e-3  # a tie (an input that is already held) is silence


@pytest.mark.evidence
@pytest.mark.parametrize("protocol", few(["udp", "tcp"], quick=1))
@pytest.mark.parametrize("horizon", few([None, 20], quick=1))
@FEW
@given(system=systems())
def test_a_price_of_zero_is_all_time_control(system: System, protocol: str, horizon: int | None) -> None:
    """J = J_all exactly, whatever is lost."""
    policy = lossy(protocol, 0, horizon)(system)  # type: ignore[arg-type]
    assert policy.cost is not None
    free = design.lossy_lqg(policy.model, policy.cost, price=0.0, network=policy.network)
    found = average(closed(free), seed=system.seed, steps=50_000)
    assert free.guarantee is not None
    assert free.guarantee.cost == free.cost_all_time == policy.cost_all_time
    assert found.cost.value == pytest.approx(free.cost_all_time, rel=1e-9)


@law(10, 300, system=systems(), share=st.floats(0.1, 0.95))
def test_with_no_query_possible_the_estimator_is_open_loop(system: System, share: float) -> None:
    """Stable plants: Σ = AΣA' + W, x̂ stays 0, and the cost is tr(QΣ), that of doing nothing."""
    A = system.plant.A * share / radius(system.plant.A)
    plant = Plant(A, system.plant.B, system.plant.W, system.plant.C, system.plant.V)
    policy = design.remote_lqg(plant, system.cost, zeta=1e9, controller="actuator")
    Sigma = accumulate(A, plant.W)
    assert policy.schedule is not None
    assert policy.theory.closed_form is not None
    assert policy.schedule.rate == 0
    np.testing.assert_allclose(policy.schedule.covariance[0], Sigma, rtol=1e-8, atol=1e-9 * np.abs(Sigma).max())
    assert policy.theory.closed_form.cost == pytest.approx(float(np.trace(system.cost.Q @ Sigma)), rel=1e-8)


def test_the_open_loop_estimator_in_the_loop() -> None:
    """The estimate is the model's own motion, and the remote controller costs what the open loop costs."""
    plant = Plant([[0.9, 0.2], [0.0, 0.7]], [[0.0], [1.0]], 0.1 * np.eye(2), [[1.0, 0.0]], [[0.1]])
    policy = design.remote_lqg(plant, Cost(np.eye(2), [[1.0]]), theta=0.1, zeta=1e6)
    found = average(close(plant, policy), steps=100_000)
    assert found.rates["sensor"].value == 0
    assert found.cost.value == pytest.approx(float(np.trace(accumulate(plant.A, plant.W))), rel=1e-9)


@pytest.mark.parametrize("horizon", [None, 10])
def test_an_acknowledgement_under_udp_is_refused(horizon: int | None) -> None:
    """A policy for acknowledged links cannot run where nothing is acknowledged; the other way it may."""
    plant, cost = Plant([[1.1]], [[1.0]], [[0.1]]), Cost([[1.0]], [[1.0]], horizon=horizon)
    tcp, udp = Network("tcp", 0.1, 0.2), Network("udp", 0.1, 0.2)
    told = design.lossy_lqg(plant, cost, price=0.1, network=tcp)
    with pytest.raises(InformationError, match="protocol 'udp' sends none"):
        close(plant, told, udp)
    assert close(plant, told).nominal
    assert not close(plant, design.lossy_lqg(plant, cost, price=0.1, network=udp), tcp).nominal


def test_a_delay_is_that_of_the_design() -> None:
    """The order of a policy's steps is its delay; a network with another one is refused."""
    plant, cost = Plant([[1.1]], [[1.0]], [[0.1]]), Cost([[1.0]], [[1.0]])
    policy = design.lossy_lqg(plant, cost, price=0.1, network=Network("udp", 0.1, 0.2))
    with pytest.raises(ProblemError, match="designed for a delay of 0"):
        close(plant, policy, Network("udp", 0.1, 0.2, delay=1))


@FEW
@given(system=systems(), mission=st.booleans())
@pytest.mark.evidence
def test_information_costs(system: System, mission: bool) -> None:
    """The all-time cost rises with a delay, with an acknowledgement that is missing, and with what is lost."""
    horizon = 20 if mission else None
    costs = {kind: lossy(*kind, horizon)(system) for kind in (("udp", 0), ("udp", 1), ("tcp", 0), ("tcp", 1))}  # type: ignore[arg-type]
    network = costs["udp", 1].network  # bearable for the worst is bearable for all
    plant, cost = costs["udp", 1].model, costs["udp", 1].cost
    assert cost is not None

    def all_time(protocol: str, delay: int, actuator: float, sensor: float) -> float:
        links = Network(protocol, actuator, sensor, delay)  # type: ignore[arg-type]
        return design.lossy_lqg(plant, cost, price=0.0, network=links).cost_all_time

    alpha, beta = network.loss("actuator"), network.loss("sensor")
    worst = all_time("udp", 1, alpha, beta)
    slack = 1 + 1e-9
    assert all_time("tcp", 1, alpha, beta) <= worst * slack
    assert all_time("udp", 0, alpha, beta) <= worst * slack
    assert all_time("tcp", 0, alpha, beta) <= all_time("udp", 0, alpha, beta) * slack
    assert all_time("udp", 1, alpha / 2, beta) <= worst * slack
    assert all_time("udp", 1, alpha, beta / 2) <= worst * slack


@pytest.mark.evidence
@FEW
@given(system=systems())
def test_a_query_is_worth_what_its_place_says(system: System) -> None:
    """At the actuator the exact cost lies between J_all and J_all + ζ."""
    base = design.all_time(system.plant, system.cost).cost_all_time
    for share in (0.0, 0.05, 0.2, 0.5):
        policy = design.remote_lqg(system.plant, system.cost, zeta=share * base, controller="actuator")
        assert policy.theory.closed_form is not None
        assert policy.guarantee is not None
        assert policy.cost_all_time * (1 - 1e-9) <= policy.theory.closed_form.cost <= policy.guarantee.cost * (1 + 1e-9)
