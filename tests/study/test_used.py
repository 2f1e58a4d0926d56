"""What is accepted is used, or it is refused: over all kinds of policy, nothing of a problem is silently ignored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from used import BURST, FULL, KINDS, LINKS, PROPERTIES, mark, table, uses_of

import taciturn
from taciturn import Cost, Network, Plant, Problem, close, design
from taciturn.design.catalogue import CATALOGUE
from taciturn.errors import ProblemError
from taciturn.model.policy import Policy
from taciturn.model.steps import Assign, Received, Send
from taciturn.study.evaluate import forgotten_start, without_effect

TABLE = Path(__file__).parents[2] / "docs" / "used.txt"
SOME = ("lqg", "lossy-lqg", "integral", "optimal")
COST = Cost(np.eye(2), [[0.5]])
ONE = np.eye(1)
SCALAR = Plant(ONE, ONE, ONE)


def printed() -> Mapping[str, Mapping[str, str]]:
    """Return the page's table, by kind and property."""
    lines = TABLE.read_text(encoding="utf-8").splitlines()
    heads, _, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    found: dict[str, dict[str, str]] = {kind: {} for kind in KINDS}
    for names, *marks in rows:
        for name in names.split(", "):
            for kinds, given in zip(heads[1:], marks, strict=True):
                for kind in [one for one in KINDS if one in split_kinds(kinds)]:
                    found[kind][name.strip("`")] = given
    return found


def split_kinds(head: str) -> set[str]:
    """Return the kinds of a column, some of which have a comma in their names."""
    parts = head.split(", ")
    joined = {", ".join(parts[i:j]) for i in range(len(parts)) for j in (i + 1, i + 2)} & set(KINDS)
    return {one for one in joined if not any(f"{one}, {rest}" in joined for rest in parts)}


def expect_no_property_ignored(kind: str) -> None:
    """Each property changes the law or is refused, and the page says which."""
    found = uses_of(kind)
    assert {name: ways for name, ways in found.items() if "IGNORED" in map(str, ways)} == {}
    assert {name: mark(ways) for name, ways in found.items()} == printed()[kind]


@pytest.mark.parametrize("kind", SOME)
def test_some_kinds_use_or_refuse_every_property(kind: str) -> None:
    """One whose loop runs, one that is designed for a network, one without steps, and one that is solved."""
    expect_no_property_ignored(kind)


@pytest.mark.evidence
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_uses_or_refuses_every_property(kind: str) -> None:
    """The rows of the page's table."""
    expect_no_property_ignored(kind)


@pytest.mark.evidence
def test_the_page_holds_the_table_that_is_printed() -> None:
    """To the letter."""
    assert table() + "\n" == TABLE.read_text(encoding="utf-8")


def test_the_table_has_every_kind_and_every_property() -> None:
    """Those of the catalogue, and the keys of a network."""
    assert {problem.kind for problem in KINDS.values()} == set(CATALOGUE)
    keys = {f"network.{name}" for name in signature(Network).parameters} - {
        "network.protocol",
        "network.nodes",
        "network.links",
        "network.stated",  # keys for messages
        "network.missing",  # in the tables of links, which every kind with steps simulates
    }
    keys |= {f"network.{link}_{name}" for link in ("actuator", "sensor") for name in ("delay", "buffer")}
    keys.add("network.actuator_acknowledgement_delay")
    assert keys == set(LINKS)
    assert all(row.keys() == {*PROPERTIES, *LINKS} for row in printed().values())


@pytest.mark.parametrize("given", [{"sensor_loss": 0.9}, {"sensor_burst": BURST}, {"sensor_range": 1.0}])
def test_a_link_that_carries_no_packet_has_no_properties(given: Mapping[str, Any]) -> None:
    """Sensor and controller share a place: nothing goes over a link between them."""
    policy = design.excess(FULL, COST, theta=0.3)
    (name,) = given
    network = Network("udp", **given, **({"payload": "int16", "actuator_range": 1.0} if name == "sensor_range" else {}))
    with pytest.raises(ProblemError) as refused:
        close(FULL, policy, network, COST)
    assert str(refused.value) == (
        f"network.{name} is given, but no node of the policy excess receives a packet on the sensor link; expected "
        f"properties of the actuator link only: remove network.{name}"
    )


def test_a_packet_that_nobody_receives_cannot_be_lost() -> None:
    """What counts is the condition of its arrival, not that it is sent."""
    place: frozenset[str] = frozenset({"sensor", "controller", "actuator"})
    send, hold = Send("sensor", "sensor", ("y",)), Assign("actuator", "input", {"y": -0.5 * ONE})
    heard = Assign("actuator", "input", ({"input": 0 * ONE}, {"y": -0.5 * ONE}), Received("sensor"))
    deaf, hearing = (Policy("mine", (send, last), SCALAR, sites=(place,)) for last in (hold, heard))
    lossy, weights = Network("udp", sensor_loss=0.1), Cost(ONE, ONE)
    with pytest.raises(ProblemError, match="no node of the policy mine receives a packet on the sensor link; expected"):
        close(SCALAR, deaf, lossy, weights)
    assert close(SCALAR, hearing, lossy, weights).violated_assumptions
    with pytest.raises(ProblemError, match="each receiver of the policy mine already has"):
        close(SCALAR, hearing, Network(payload="float32"), weights)


def test_a_range_has_an_entry_for_each_number_of_its_packet() -> None:
    """Or one for all; it is looked at when the loop is closed, and not when it runs."""
    policy = design.excess(FULL, COST, theta=0.3)
    with pytest.raises(ProblemError, match="its range has 2 numbers; expected one number for all entries"):
        close(FULL, policy, Network(payload="int16", actuator_range=(1.0, 2.0)), COST)
    with pytest.raises(ProblemError, match=r"network.actuator_range is missing, but network.payload is 'int16'"):
        close(FULL, policy, Network(payload="int16"), COST)


def test_acknowledgements_that_no_node_uses_are_reported() -> None:
    """They change nothing, and a policy that needs none may run where there are some."""
    policy = design.excess(FULL, COST, theta=0.3)
    told = "no node uses the acknowledgements of protocol 'tcp'"
    assert told in close(FULL, policy, Network("tcp", 0.1), COST).violated_assumptions
    assert told not in close(FULL, policy, Network("udp", 0.1), COST).violated_assumptions
    assert told not in close(FULL, policy, Network("tcp"), COST).violated_assumptions  # nothing is lost or late
    lossy = design.lossy_lqg(FULL, COST, price=0.1, network=Network("tcp", 0.1, 0.2))
    assert close(FULL, lossy).violated_assumptions == ()


def test_a_limit_of_the_design_alone_is_refused_and_the_same_limit_in_both_is_used() -> None:
    """The plant that is simulated decides; where it agrees, both are meant."""
    limited = [Plant(FULL.A, FULL.B, FULL.W, input_limit=[limit]) for limit in (1.0, 2.0)]
    other = Plant(0.9 * FULL.A, FULL.B, FULL.W, input_limit=[1.0])
    policy = design.lqg(limited[0], COST, theta=0.3)
    for plant in (FULL, limited[1]):
        with pytest.raises(
            ProblemError, match=r"plant.input_limit is given, but the simulated plant, plant.actual, has"
        ):
            close(plant, policy, None, COST)
    assert close(other, policy, None, COST).problem.plant.input_limit.tolist() == [[-1.0, 1.0]]
    unlimited = close(other, design.lqg(FULL, COST, theta=0.3), None, COST)
    assert "inputs are clipped (input_limit)" in unlimited.violated_assumptions


def test_a_function_of_the_design_alone_is_refused() -> None:
    """Another plant that is linear is simulated, and the function would be forgotten."""
    bent = Plant(FULL.A, FULL.B, FULL.W, function=lambda x, u, w: FULL.A @ x + FULL.B @ u + w)
    with pytest.raises(ProblemError, match=r"plant.function is given, but the simulated plant, plant.actual, has"):
        close(FULL, design.lqg(bent, COST, theta=0.3), None, COST)


def test_a_kind_that_is_unknown_is_refused_when_the_problem_is_made() -> None:
    """And not when it is designed."""
    with pytest.raises(
        ProblemError, match=r"policy.kind is 'decay'; expected one of the policy kinds absolute, all-time"
    ):
        Problem(FULL, COST, Network(), "decay")


def test_options_of_a_simulation_are_noted_where_nothing_is_simulated() -> None:
    """A closed form, a quadrature; nothing is noted of what was not given."""
    exact = Problem(SCALAR, Cost(ONE, ONE), Network(), "periodic", {"every": 2})
    found = taciturn.evaluate(exact, steps=2000, precision="float32")
    assert found.method == "exact"
    assert found.notes == ("steps = 2000 and precision = float32 had no effect: no loop was simulated",)
    assert taciturn.evaluate(exact).notes == ()
    assert without_effect({"steps": None}, "quadrature") == ()
    simulated = Problem(SCALAR, Cost(ONE, ONE), Network(), "lqg", {"theta": 0.5})
    assert taciturn.evaluate(simulated, steps=2000, precision="float32").notes == ()


def test_a_grid_has_each_value_once() -> None:
    """In a tradeoff as in a sweep; 1 and 1.0 are one value."""
    problem = Problem(SCALAR, Cost(ONE, ONE), Network(), "lqg", {"theta": 0.5})
    with pytest.raises(
        ProblemError, match="the list of values for theta contains 1 twice; expected each value only once"
    ):
        taciturn.tradeoff(problem, {"theta": [1, 0.5, 1.0]})


def test_an_initial_state_has_no_effect_on_an_average_and_a_note_says_so() -> None:
    """An average forgets it; a finite horizon and a discounted cost do not."""
    problem = taciturn.load("remote-scalar")
    given_plant = problem.plant
    plant = Plant(given_plant.A, given_plant.B, given_plant.W, mean=[1.0])
    given = replace(problem, plant=plant, cost=Cost([[1.0]], [[1.0]]))
    assert forgotten_start(given) == ("initial.mean had no effect: the cost is an average over all time",)
    assert forgotten_start(replace(given, cost=Cost([[1.0]], [[1.0]], horizon=9, terminal=[[1.0]]))) == ()
    assert forgotten_start(replace(given, cost=Cost([[1.0]], [[1.0]], discount=0.9))) == ()
