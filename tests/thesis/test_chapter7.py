"""Chapter 7 of the thesis: control over links that drop packets, and tracking over them."""

from __future__ import annotations

import numpy as np
import pytest
from counts import few
from drawn import rows

import taciturn
from taciturn import Cost, Network, Plant, Reference, close, design
from taciturn.simulation.average import average, plain_average

PLANT = Plant([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]], 0.01 * np.eye(2), mean=[1.0, 0.0])
COST = Cost(np.eye(2), [[1.0]], horizon=100)
NETWORKS = {"udp": Network("udp", 0.3, 0.6), "tcp": Network("tcp", 0.3, 0.6), "ideal": Network()}
ALL_TIME = {"udp": 63.7760, "tcp": 63.4150, "ideal": 49.9359}
# protocol, λ: cost and its uncertainty, rate and its half unit
FIGURE_7_2 = {
    ("udp", 0.1): (65.520, 0.004, 0.502, 5e-4),
    ("tcp", 0.1): (65.187, 0.004, 0.494, 5e-4),
    ("ideal", 0.1): (51.553, 0.004, 0.466, 5e-4),
    ("udp", 1.0): (95.03, 0.03, 0.1474, 2e-4),
    ("tcp", 1.0): (94.29, 0.03, 0.1452, 2e-4),
    ("ideal", 1.0): (78.15, 0.03, 0.1340, 2e-4),
}


@pytest.mark.parametrize(("protocol", "price"), rows(FIGURE_7_2, quick=1))
def test_the_points_of_figure_7_2(protocol: str, price: float) -> None:
    """Cost, rate and both bounds of the three protocols."""
    cost, spread, rate, half = FIGURE_7_2[protocol, price]
    policy = design.lossy_lqg(PLANT, COST, price=price, network=NETWORKS[protocol])
    found = average(close(PLANT, policy), seed=8, standard_error=4e-3)
    assert policy.cost_all_time == pytest.approx(ALL_TIME[protocol], abs=5e-5)
    assert abs(found.cost.value - cost) <= 4 * np.hypot(found.cost.standard_error, spread)
    sent = found.rates["actuator"]
    assert abs(sent.value - rate) <= 4 * np.hypot(sent.standard_error, half)
    assert policy.guarantee is not None
    assert policy.guarantee.cost == pytest.approx(policy.cost_all_time + 100 * price, rel=1e-14)
    sharper = policy.guarantee.at_rate(sent.value)
    assert sharper is not None
    assert sharper == pytest.approx(policy.cost_all_time + 100 * price * (1 - sent.value), rel=1e-14)
    assert found.cost.value < sharper < policy.guarantee.cost


def test_the_plain_total_agrees_with_the_identity() -> None:
    """The terminal weight and every stage cost, summed as they come."""
    policy = design.lossy_lqg(PLANT, COST, price=0.1, network=NETWORKS["udp"])
    loop = close(PLANT, policy)
    plain = average(loop, plain_average(loop), seed=9, standard_error=0.05).cost
    assert abs(plain.value - 65.520) <= 4 * np.hypot(plain.standard_error, 0.004)


# λ: rate, cost, bound with the delay
TRACKING = {
    0.0: (0.991, 0.9058, 0.906),
    0.001: (0.655, 0.9541, 1.156),
    0.002: (0.460, 1.0565, 1.406),
    0.01: (0.124, 2.0553, 3.406),
}


@pytest.mark.parametrize("price", few(TRACKING, quick=1))
def test_tracking_two_circles_with_a_step_of_delay(price: float) -> None:
    """Rates, costs and bounds of section 7.5 in simulation, around the reference and at rest alike."""
    rate, cost, bound = TRACKING[price]
    turn = 4 * np.pi * np.arange(251) / 250
    side = np.where(turn < 2 * np.pi, 1.0, -1.0)
    states = np.column_stack([side * (1 - np.cos(turn)), np.sin(turn), np.zeros(251)])
    reference = Reference(states, np.diff(states, axis=0) / 0.1)
    unit, network = np.eye(3), Network("udp", 0.1, 0.25, delay=1)
    plant, weights = Plant(unit, 0.1 * unit, 1e-4 * unit), Cost(unit, unit, horizon=250)
    at_rest = design.lossy_lqg(plant, weights, price=price, network=network)
    around = design.lossy_lqg(plant, weights, price=price, network=network, reference=reference)
    found = average(close(plant, around), seed=10, standard_error=1e-4)
    assert found.cost.standard_error <= 1e-4
    # the reference costs are simulations with an error of their own, some 2e-4 at the largest price
    assert abs(found.cost.value - cost) <= 4 * np.hypot(found.cost.standard_error, 1e-4) + 5e-5
    assert abs(found.rates["actuator"].value - rate) <= 4 * found.rates["actuator"].standard_error + 5e-4
    assert around.guarantee is not None
    assert around.guarantee.cost == pytest.approx(bound, abs=5e-4)
    assert around.cost_all_time == at_rest.cost_all_time == pytest.approx(0.9058, abs=5e-5)
    rest = average(close(plant, at_rest), seed=10, standard_error=1e-4)
    assert rest.cost.value == pytest.approx(found.cost.value, abs=1e-9)  # the same noise, the same deviations


def test_bursts_are_run_with_the_design_for_their_mean_and_nothing_is_claimed() -> None:
    """The same mean losses in bursts: the plain average, no bound, no all-time cost, and a note."""
    burst = {"to_bad": 0.05, "to_good": 0.15, "loss_good": 0.1, "loss_bad": 0.9}
    changed = {"network.actuator_loss": 0.0, "network.actuator_burst": burst}
    found = taciturn.evaluate(taciturn.load("lossy-double-integrator").changed(changed), seed=11, standard_error=0.5)
    assert (found.cost_bound, found.cost_bound_at_rate, found.cost_all_time) == (None, None, None)
    assert any("bursts" in note for note in found.notes)
    assert found.cost.value - 4 * found.cost.standard_error > 65.520 + 1  # the same loss of 30 %, but in a row
