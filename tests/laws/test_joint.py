"""One controller that decides on sets of actuator links: identity, bound, and the same loop simulated in NumPy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from drawn import law
from hypothesis import strategies as st

import taciturn
from taciturn import Controller, Cost, Disturbance, Network, Plant, Policy, Problem, ProblemError
from taciturn.base.certainty import design_certainty
from taciturn.design.several_nodes import MOST_LINKS
from taciturn.lqg.discrete import discretise
from taciturn.model.link import LinkLaw
from taciturn.model.network import NodeRole
from taciturn.simulation.average import plain_average

STEPS = 200_000


def network_of(inputs: int, prices: np.ndarray, local: int = 0, **laws: LinkLaw) -> Network:
    """Return a controller with all sensors, and an actuator per input; the first ``local`` are at its place."""
    nodes = {"s": NodeRole(measures=True, site="plc"), "plc": NodeRole(controls=True)}
    for i in range(inputs):
        nodes[f"v{i}"] = NodeRole(applies=(i,), site="plc" if i < local else None)
    links = {f"v{i}": LinkLaw(price=float(prices[i])) for i in range(local, inputs)}
    return Network(nodes=nodes, links={**links, **laws})


def system(seed: int, inputs: int, full: bool = False) -> tuple[Plant, Cost, np.random.Generator]:
    """Return a random plant, often unstable, with cross terms in the cost."""
    draws = np.random.default_rng(seed)
    n = int(draws.integers(1, 4))
    A = draws.standard_normal((n, n))
    A *= draws.uniform(0.5, 1.2) / np.abs(np.linalg.eigvals(A)).max()
    L = draws.standard_normal((n + inputs, n + inputs))
    weights = L @ L.T + 0.1 * np.eye(n + inputs)
    C, V = (None, None) if full else (draws.standard_normal((n, n)) + np.eye(n), 0.1 * np.eye(n))
    plant = Plant(A, draws.standard_normal((n, inputs)), 0.2 * np.eye(n), C, V)
    return plant, Cost(weights[:n, :n], weights[n:, n:], weights[:n, n:]), draws


@law(
    6,
    100,
    seed=st.integers(0, 10**6),
    inputs=st.integers(2, 3),
    local=st.integers(0, 1),
    theta=st.floats(0.02, 1.0),
    kind=st.sampled_from(["excess", "lqg", "zero", "kept"]),
)
def test_the_identity_and_the_bound_hold(seed: int, inputs: int, local: int, theta: float, kind: str) -> None:
    """For LQG and for a detuned controller, for held inputs and for none, with prices of packets."""
    plant, cost, draws = system(seed, inputs)
    network = network_of(inputs, draws.uniform(0.5, 4.0, inputs), local)
    parameters: dict[str, Any] = {"theta": theta} | ({"actuation": "zero"} if kind == "zero" else {})
    controller = None
    if kind == "kept":
        found = design_certainty("lqg", discretise(plant, cost, None))
        left = np.eye(plant.states) - found.filter.gain @ plant.C
        L, gain = 0.9 * found.regulator.L, found.filter.gain
        none = Disturbance(deviation=0.0)
        controller = Controller(plant.A @ left, plant.A @ gain, L @ left, L @ gain, plant.B, disturbance=none)
        if np.abs(np.linalg.eigvals(plant.A + plant.B @ L)).max() >= 0.999:
            return
    name = "lqg" if kind == "lqg" else "excess"
    problem = Problem(plant, cost, network, name, parameters, controller=controller)
    policy = problem.design()
    assert isinstance(policy, Policy)
    loop = problem.close(policy)
    assert loop.nominal
    exact = taciturn.average(loop, steps=STEPS, seed=seed)
    plain = taciturn.average(loop, plain_average(loop), steps=STEPS, seed=seed + 1)
    error = np.hypot(exact.cost.standard_error, plain.cost.standard_error)
    assert abs(exact.cost.value - plain.cost.value) <= 4.5 * error
    assert policy.guarantee is not None
    assert exact.cost.value <= policy.guarantee.cost + 4 * exact.cost.standard_error
    sharper = policy.guarantee.at_rates(exact.rates, policy.scheduled[0])
    if name == "excess":
        assert sharper is not None
        assert exact.cost.value <= sharper.value + 4 * np.hypot(exact.cost.standard_error, sharper.standard_error)


def test_a_simulation_in_numpy_has_the_same_cost_and_rates() -> None:
    """The rule by hand: the set with the least sum of the cost of silence and the prices of packets."""
    plant, cost, _ = system(5, 2, full=True)
    prices, theta = np.array([1.0, 3.0]), 0.3
    problem = Problem(plant, cost, network_of(2, prices), "excess", {"theta": theta})
    loop = problem.close(problem.design())
    found = taciturn.average(loop, steps=1_000_000)
    certainty = design_certainty("lqg", discretise(plant, cost, None))
    L, H, delta = certainty.regulator.L, certainty.regulator.H, theta * certainty.cost_all_time
    sets = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], dtype=bool)
    draws, paths, steps = np.random.default_rng(1), 400, 1500
    root = np.linalg.cholesky(plant.W)
    x, held = np.zeros((plant.states, paths)), np.zeros((2, paths))
    total, sends = np.zeros(paths), np.zeros((2, paths))
    for _ in range(steps):
        error = held - L @ x
        remaining = np.where(sets[:, :, None], 0.0, error)
        values = np.einsum("sip,ij,sjp->sp", remaining, H, remaining)
        values += delta * (sets @ prices / prices.sum())[:, None]
        sent = sets[np.argmin(values, axis=0)].T
        held = np.where(sent, L @ x, held)
        total += np.einsum("ip,ij,jp->p", x, cost.Q, x) + np.einsum("ip,ij,jp->p", held, cost.R, held)
        total += 2 * np.einsum("ip,ij,jp->p", x, cost.N, held)
        sends += sent
        x = plant.A @ x + plant.B @ held + root @ draws.standard_normal(x.shape)
    mean = total / steps
    error = np.hypot(mean.std(ddof=1) / np.sqrt(paths), found.cost.standard_error)
    assert abs(mean.mean() - found.cost.value) <= 4 * error + 0.005 * found.cost.value  # the first steps from rest
    for i, link in enumerate(("v0", "v1")):
        rate = sends[i] / steps
        error = np.hypot(rate.std(ddof=1) / np.sqrt(paths), found.rates[link].standard_error)
        assert abs(rate.mean() - found.rates[link].value) <= 4 * error + 3 / steps


def test_the_dearer_packet_is_sent_less() -> None:
    """With equal actuators, a packet that costs five times as much is sent less often."""
    plant = Plant(0.95 * np.eye(2), np.eye(2), np.eye(2))
    problem = Problem(plant, Cost(np.eye(2), np.eye(2)), network_of(2, np.array([1.0, 5.0])), "excess", {"theta": 0.3})
    rates = taciturn.evaluate(problem, standard_error=0.01).rates
    assert rates["v1"].value < 0.9 * rates["v0"].value


@pytest.mark.parametrize(
    ("kind", "parameters", "laws", "sentence"),
    [
        (
            "excess",
            {"theta": 0.1, "actuation": "model"},
            {},
            "the packets of the policy kind excess carry more than the input",
        ),
        (
            "lqg",
            {"theta": 0.1, "actuation": "model"},
            {},
            "the packets of the policy kind lqg carry more than the input",
        ),
        (
            "excess",
            {"theta": 0.1, "every": 4},
            {},
            "the base policy of the policy kind excess sends only at some steps",
        ),
        (
            "excess",
            {"theta": 0.1},
            {"v0": LinkLaw(loss=0.1)},
            "links.v0.loss is 0.1, but the controller of the policy kind excess chooses among sets of the links v0, v1",
        ),
        (
            "absolute",
            {"threshold": 0.1},
            {},
            "the policy kind absolute has only one actuator node, but the network has v0 and v1",
        ),
    ],
)
def test_what_cannot_decide_on_sets_is_refused(
    kind: str, parameters: Mapping[str, Any], laws: Mapping[str, LinkLaw], sentence: str
) -> None:
    """By name, with the remedy."""
    plant, cost, _ = system(1, 2)
    with pytest.raises(ProblemError) as found:
        Problem(plant, cost, network_of(2, np.ones(2), **laws), kind, parameters).design()
    assert sentence in str(found.value)
    assert "expected" in str(found.value)


@pytest.mark.evidence
def test_certificates_of_sets_by_price_and_not_by_a_limit() -> None:
    """`excess` compares forms; `lqg` takes the first set within a limit, and the message says so."""
    plant, cost = Plant(0.9 * np.eye(2), np.eye(2), np.eye(2)), Cost(np.eye(2), np.eye(2))
    network = network_of(2, np.ones(2))
    found = taciturn.certify(Problem(plant, cost, network, "excess", {"theta": 0.1}))
    assert found.cost_bound is not None
    with pytest.raises(ProblemError, match="lqg decides on sets of links by a limit, which certificates do not"):
        taciturn.certify(Problem(plant, cost, network, "lqg", {"theta": 0.1}))


def test_too_many_links_are_refused() -> None:
    """Sixteen sets are compared at most."""
    plant, cost, _ = system(1, MOST_LINKS + 1)
    problem = Problem(plant, cost, network_of(MOST_LINKS + 1, np.ones(MOST_LINKS + 1)), "excess", {"theta": 0.1})
    with pytest.raises(
        ProblemError, match="chooses among the 32 sets of 5 actuator links; expected at most 4 actuator links"
    ):
        problem.design()


def test_designs_take_the_network_directly() -> None:
    """As a problem does: with one actuator of another name, and with several links."""
    plant, cost = Plant(0.9 * np.eye(2), np.eye(2), np.eye(2)), Cost(np.eye(2), np.eye(2))
    network = network_of(2, np.ones(2))
    policy = taciturn.design.excess(plant, cost, theta=0.1, network=network)
    assert policy.scheduled == ("v0", "v1")
    nodes = {"s": NodeRole(measures=True), "c": NodeRole(controls=True), "a": NodeRole(applies=True)}
    lossy = Network(nodes=nodes, links={"a": LinkLaw(loss=0.1)})
    assert taciturn.design.lossy_lqg(plant, cost, price=0.1, network=lossy).network.loss("a") == 0.1
