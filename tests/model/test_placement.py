"""Policies of three nodes on networks whose nodes have other names: the same results, by other names."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

import taciturn
from taciturn import PID, Cost, Plant, design
from taciturn.design.catalogue import CATALOGUE
from taciturn.design.kind import placed
from taciturn.errors import ProblemError, UnstableError
from taciturn.model.controller import PIDLoops
from taciturn.model.link import LinkLaw
from taciturn.model.network import Network, NodeRole
from taciturn.model.packets import fingerprint, roles
from taciturn.problem import Problem, parse

PLC = {"plc": {"controls": True}}
WIRED = {"level-1": {"measures": [1], "site": "plc"}, "level-2": {"measures": [0], "site": "plc"}}
APPLIED = {"valve": {"applies": True}}


def named(problem: Problem, nodes: Mapping[str, Any], links: Mapping[str, Any] | None = None) -> Problem:
    """Return a problem with nodes and links in place of its network."""
    tables = {name: table for name, table in (problem.source or {}).items() if name != "network"}
    return parse({**tables, "nodes": {**nodes, **PLC}, **({"links": links} if links else {})}, "named")


def test_sensors_at_one_place_are_one_sensor() -> None:
    """The outputs of two sensors beside the controller, in another order, give the same costs and packets to a bit."""
    problem = taciturn.load("two-mass")
    own = named(problem, {**WIRED, **APPLIED})
    found, before = (taciturn.evaluate(one, steps=20_000, seed=3) for one in (own, problem))
    assert found.rates["valve"].value == pytest.approx(before.rates["actuator"].value)
    assert (found.cost.value, found.cost_bound) == (before.cost.value, before.cost_bound)
    assert found.clock == before.clock
    policy = own.design()
    assert [place.nodes for place in policy.diagram().places] == [("level-1", "level-2", "plc"), ("valve",)]
    nodes, former = taciturn.Nodes(policy), taciturn.Nodes(problem.design())
    for y in np.random.default_rng(1).normal(size=(50, 2)):
        assert np.array_equal(nodes.step(y), former.step(y))
        assert nodes.sent["valve"] == former.sent["actuator"]


def test_losses_and_acknowledgements_belong_to_the_named_links() -> None:
    """As the same numbers in [network]."""
    problem = taciturn.load("lossy-double-integrator")
    nodes = {"gauge": {"measures": True}, "valve": {"applies": True}}
    losses = {"gauge": {"loss": 0.6}, "valve": {"loss": 0.3}}
    own = named(problem, nodes, losses)
    found, before = (taciturn.evaluate(one, steps=20_000, seed=3) for one in (own, problem))
    assert found.cost.value == before.cost.value
    assert own.network.short() == "udp (no acknowledgement); gauge drops 60 %, valve drops 30 %"
    acknowledged = {name: {**law, "acknowledged": True} for name, law in losses.items()}
    tcp = taciturn.evaluate(named(problem, nodes, acknowledged), steps=20_000, seed=3)
    assert (
        tcp.cost.value
        == taciturn.evaluate(problem.changed({"network.protocol": "tcp"}), steps=20_000, seed=3).cost.value
    )


def test_a_place_away_from_the_controller_merges_nodes_only_in_kinds_of_three_nodes() -> None:
    """With several nodes, it changes the fingerprint of the packets, and no cost."""
    beside = {"b": {"applies": True, "site": "a"}}
    nodes = {"a": {"measures": True}, "b": {"applies": True}}
    losses = {"a": {"loss": 0.6}, "b": {"loss": 0.3}}
    lossy = taciturn.load("lossy-double-integrator")
    assert roles(named(lossy, nodes, losses).design()) == ("a", "plc", "b")
    assert roles(named(lossy, {**nodes, **beside}, losses).design()) == ("a", "plc")
    several = taciturn.load("two-mass-lqg").changed({"kind": "distributed"})
    apart, together = (named(several, {**nodes, **more}) for more in ({}, beside))
    one, other = apart.design(), together.design()
    assert roles(one) == roles(other) == ("a", "plc", "b")
    costs = [taciturn.evaluate(problem, steps=20_000, seed=3).cost.value for problem in (apart, together)]
    assert costs[0] == costs[1]
    assert fingerprint(one, one.network) != fingerprint(other, other.network)


@pytest.mark.parametrize(
    ("nodes", "links", "expected"),
    [
        ({"a": {"measures": [0]}, "b": {"measures": [1]}, **APPLIED}, {}, "sensor node, but the network has a and b"),
        ({"a": {"measures": True}, **APPLIED}, {}, r"but the node 'a' has a link; expected nodes.a.site = \"plc\""),
        ({**WIRED, "valve": {"applies": True, "site": "plc"}}, {}, "between actuator and controller, but the node"),
        ({**WIRED, **APPLIED}, {"level-1": {"loss": 0.1}}, "but the node 'level-1' is at the controller's site"),
        ({**WIRED, "valve": {"applies": [0, 1]}}, {}, "nodes.valve.applies contains the index 1; expected indices"),
        ({"a": {"measures": [2.0]}, **APPLIED}, {}, r"nodes.a: measures is \[2.0\]; expected a list of whole numbers"),
        ({"a": {"measures": [True]}, **APPLIED}, {}, r"is \[True\]; expected a list of whole numbers, the indices"),
        ({"a": {"measures": 1}, **APPLIED}, {}, "measures is 1; expected .* of outputs from 0 on, or true for all"),
        ({**WIRED, "valve": {"applies": ["0"]}}, {}, r"applies is \['0'\]; expected .* the indices of inputs from 0"),
        ({**WIRED, "valve": {"applies": [-1]}}, {}, "applies contains the index -1; expected indices of inputs from 0"),
        ({"a": {"measures": [0, 0]}, **APPLIED}, {}, r"nodes.a: measures is \[0, 0\]; expected a list that"),
        ({"plant": {"measures": True}, **APPLIED}, {}, "nodes.plant has the name 'plant'"),
        ({"a": {"measures": True, "site": "b"}, **APPLIED}, {}, "nodes.a.site is 'b'; expected the name"),
        ({"a": {"measures": True, "controls": True}, **APPLIED}, {}, "2 nodes control"),
        ({**WIRED, **APPLIED}, {"level-1": {"delay": 2}}, "but the node 'level-1' is at the controller's site"),
        ({**WIRED, **APPLIED}, {"valve": {"delay": -2}}, "links.valve.delay is -2; expected a whole number of steps"),
        ({**WIRED, **APPLIED}, {"valve": {"price": 0.0}}, "links.valve.price is 0; expected 1e-100 ≤ price"),
        ({**WIRED, **APPLIED}, {"valve": {"price": 1e308}}, r"links.valve.price is 1e\+308; expected 1e-100 ≤ price"),
        ({**WIRED, **APPLIED}, {"valve": {"los": 0.1}}, r"links\.valve\.los is not a known .*, missing\. Did"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused(nodes: Mapping[str, Any], links: Mapping[str, Any], expected: str) -> None:
    """In one sentence that names the node."""
    with pytest.raises(ProblemError, match=expected):
        named(taciturn.load("two-mass"), nodes, links).design()


def test_a_kind_without_losses_names_the_key_of_the_link() -> None:
    """In the words of the file."""
    problem = named(taciturn.load("two-mass-lqg"), {**WIRED, **APPLIED}, {"valve": {"loss": 0.1}})
    with pytest.raises(ProblemError, match=r"links\.valve\.loss is given, which the policy kind lqg does not use"):
        problem.design()


def test_design_functions_take_the_network_as_problems_do() -> None:
    """The kind lqg by its argument, also for sets of links; other kinds by the function ``placed``."""
    unit, linked = np.eye(2), NodeRole(applies=(0,))
    nodes = {"gauge": NodeRole(measures=True, site="plc"), "plc": NodeRole(controls=True), "a": linked}
    network = Network(nodes={**nodes, "b": NodeRole(applies=(1,))}, links={"a": LinkLaw(price=3.0, payload="float32")})
    plant, cost = Plant(0.9 * unit, unit, unit), Cost(unit, unit)
    for name, parameters in (("lqg", {"theta": 0.1}), ("all-time", {})):
        one = Network(nodes={**nodes, "a": NodeRole(applies=True)}) if name == "all-time" else network
        expected = Problem(plant, cost, one, name, parameters).design()
        found = design.lqg(plant, cost, theta=0.1, network=one) if name == "lqg" else design.all_time(plant, cost)
        found = placed(found, one)
        assert fingerprint(found, one) == fingerprint(expected, one)
        assert (found.network, found.scheduled) == (one, expected.scheduled)
    with pytest.raises(
        ProblemError, match=r"links\.b\.loss is given, which the policy kind lqg does not use; expected ideal links"
    ):
        design.lqg(plant, cost, theta=0.1, network=replace(network, links={"b": LinkLaw(loss=0.1)}))
    with pytest.raises(ProblemError, match="network is 3; expected a Network"):
        design.lqg(plant, cost, theta=0.1, network=3)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("kind", ["send-on-delta", "excess", "lossy-lqg", "distributed"])
@pytest.mark.parametrize("controller", [None, PID(0.3)])
def test_a_refusal_names_only_kinds_that_accept_the_problem(kind: str, controller: PID | None) -> None:
    """For losses on one of two sensors."""
    nodes = {"a": NodeRole(measures=(0,)), "b": NodeRole(measures=(1,)), "plc": NodeRole(controls=True)}
    network = Network(nodes={**nodes, "valve": NodeRole(applies=True, site="plc")}, links={"a": LinkLaw(loss=0.1)})
    kept = None if controller is None else PIDLoops((controller, PID(0.2, input=2, output=2)))
    plant = Plant(0.9 * np.eye(2), np.eye(2), np.eye(2))
    problem = Problem(plant, Cost(np.eye(2), np.eye(2)), network, kind, CATALOGUE[kind].example, controller=kept)
    try:
        problem.design()
    except ProblemError as error:
        named = [name for name in CATALOGUE if name in str(error).partition(", or the kind ")[2].split(" or ")]
        assert named == ([] if controller else ["distributed"])
    else:
        assert (kind, controller) == ("distributed", None)


@pytest.mark.parametrize("horizon", [None, 10])
def test_messages_about_losses_name_the_keys_of_the_links(horizon: int | None) -> None:
    """Errors and notes of designs for three nodes, from a problem and from the design function."""
    nodes = {"gauge": NodeRole(measures=True), "plc": NodeRole(controls=True), "valve": NodeRole(applies=True)}
    network = Network(nodes=nodes, links={"gauge": LinkLaw(loss=0.1), "valve": LinkLaw(loss=0.9)})
    plant, cost = Plant([[2.0]], [[1.0]], [[0.1]]), Cost([[1.0]], [[1.0]], horizon=horizon)
    sentence = r"links\.valve\.loss is 0\.9 and links\.gauge\.loss is 0\.1, and for this plant"
    problem = Problem(plant, cost, network, "lossy-lqg", {"price": 0.1})
    for one in (problem.design, partial(design.lossy_lqg, plant, cost, price=0.1, network=network)):
        if horizon is None:
            with pytest.raises(UnstableError, match=sentence):
                one()
        else:
            assert re.match(sentence, one().notes[0])
    wired = Network(
        nodes={**nodes, "gauge": NodeRole(measures=True, site="plc")},
        links={"valve": LinkLaw(burst=taciturn.Burst(0.5, 0.5, 0.8, 0.9), acknowledged=True)},
    )
    if horizon is None:
        with pytest.raises(
            UnstableError,
            match=r"links\.valve\.burst sets the loss probability 0\.8 and 0\.9 in its states, so the mean",
        ):
            design.excess(plant, cost, theta=0.1, network=wired)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: NodeRole(controls="yes"), "controls is 'yes'; expected true or false"),  # type: ignore[arg-type]
        (lambda: NodeRole(measures=True, site=3), "site is 3; expected the name of a node"),  # type: ignore[arg-type]
        (lambda: LinkLaw(loss=0.1, acknowledged=1), "acknowledged is 1; expected true or false"),  # type: ignore[arg-type]
        (lambda: placed(None, Network()), "policy is None; expected a Policy"),  # type: ignore[arg-type]
    ],
)
def test_other_types_are_refused_in_python(make: Callable[[], object], words: str) -> None:
    """As a problem file refuses them."""
    with pytest.raises(ProblemError, match=words):
        make()
    assert NodeRole(measures=np.array([0, 2])).measures == (0, 2)
