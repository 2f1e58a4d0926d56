"""A diagram shows what the steps of a policy say: who sends what to whom, when, and who is told."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from typing import cast

import numpy as np
import pytest
from catalogue import MISSIONS, POLICIES, outputs
from systems import make_system

from taciturn import Cost, Plant, Policy, design, load
from taciturn.design.catalogue import CATALOGUE
from taciturn.model.diagram import PLAIN, Diagram, Link, Place
from taciturn.model.packets import packet_shapes, roles
from taciturn.model.steps import Send
from taciturn.model.trigger import Form, Scheduled, Trigger
from taciturn.nodes.node import Node
from taciturn.program.ops import Sent
from taciturn_limits.optimal_kind import OptimalPolicy
from taciturn_new.draft import example_of

SYSTEM = make_system(5, 2, 1, 2, full_state=False)
NAMES = (*POLICIES, *(kind for kind in CATALOGUE if kind not in POLICIES))
MARKED = [pytest.param(name, marks=pytest.mark.evidence) if name in MISSIONS else name for name in NAMES]


@cache
def made(name: str) -> Policy:
    """Return a policy of the tests, or the example of a kind; ``optimal`` by the policy of the same nodes."""
    if name in POLICIES:
        return POLICIES[name](SYSTEM)
    policy = example_of(CATALOGUE[name]).designed()
    return policy.looked_at if isinstance(policy, OptimalPolicy) else cast("Policy", policy)


def columns(shown: Diagram) -> list[int]:
    """Return where the lines under the boxes stand: on the last row there is nothing else."""
    return [i for i, letter in enumerate(shown.text().splitlines()[-1]) if letter == "│"]


@pytest.mark.parametrize("name", MARKED)
def test_links_are_those_of_the_wire(name: str) -> None:
    """As many data packets, between the same nodes, with as many entries; acknowledged where the receiver tells."""
    policy = made(name)
    shown = policy.diagram()
    shapes = packet_shapes(policy, policy.network)
    wire = {link: size for (kind, link), (_, size) in shapes.items() if kind == "data"}
    assert {link.name: sum(link.payload.values()) for link in shown.links} == wire
    assert [(link.name, link.sender) for link in shown.links] == [
        (step.link, step.at) for step in policy.steps if isinstance(step, Send)
    ]
    told = {link for role in roles(policy) for link in Node(policy, role).acknowledges}
    assert {link.name for link in shown.links if link.acknowledged} == told
    assert [place.nodes for place in shown.places] == sorted(
        (
            tuple(node for node in policy.network.nodes if node in site)
            for site in {policy.site(role) for role in roles(policy)}
        ),
        key=lambda nodes: list(policy.network.nodes).index(nodes[0]),
    )


@pytest.mark.parametrize("name", MARKED)
def test_the_text_has_an_arrow_for_every_packet(name: str) -> None:
    """From the line under the sender's box to that under the receiver's, with what is in it; in the order of a step."""
    policy = made(name)
    shown, text = policy.diagram(), policy.diagram().text().splitlines()
    if not any("└" in line for line in text):  # too wide for boxes side by side: a list
        rows = [f"{link.sender} ──▶ {link.receiver}" for link in shown.links]
        assert [line.partition("  ")[0] for line in text[len(shown.places) :]] == rows
        assert all(link.briefly in line for link, line in zip(shown.links, text[len(shown.places) :], strict=True))
        return
    stands = columns(shown)
    assert len(stands) == len(shown.places)
    arrows = [line for line in text if "▶" in line or "◀" in line]
    expected = [link for link in shown.links for _ in range(1 + link.acknowledged)]
    assert len(arrows) == len(expected)
    for row, link in zip(arrows, expected, strict=True):
        start, end = stands[shown.place_of(link.sender)], stands[shown.place_of(link.receiver)]
        if "┄" in row:  # what is told goes back
            start, end = end, start
            assert "acknowledged" in row[end:start]
        else:
            assert link.briefly in row[start:end]
            assert all(f"{name} ({policy.sizes[name]})" in row for name in link.payload)
        assert row[start] in "├┤"
        assert row[end - 1 if start < end else end + 1] in "▶◀"
        assert row[end] == "│"
    assert max(map(len, text)) <= 80
    head = "\n".join(text[: next(i for i, line in enumerate(text) if "└" in line)])
    for place in shown.places:
        assert all(line in head for line in place.lines)


@pytest.mark.parametrize("name", ["periodic hold", "pattern", "remote, 30 steps", "variance", "periodic model"])
def test_a_schedule_shows_the_ticks_at_which_the_loop_sends(name: str) -> None:
    """The clock is walked; the loop is run."""
    walk = Plant([[1.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
    policy = made(name) if name != "variance" else design.variance(*walk, threshold=2.5)
    (link,) = [link for link in policy.diagram().links if link.when == "schedule"]
    ticks = 30 if policy.cost is not None and policy.cost.horizon else 60
    sent = outputs(policy, 1, paths=2, ticks=ticks)[Sent(link.name)]
    turn = len(link.pattern) - link.repeats_from
    walked = [
        link.pattern[k if k < link.repeats_from else link.repeats_from + (k - link.repeats_from) % turn]
        for k in range(ticks)
    ]
    assert (sent == np.array(walked)[:, None]).all()
    assert len(set(walked)) == 2  # it tells steps apart


def test_what_decides_is_named() -> None:
    """Signals that a trigger reads, and places that weigh them; a clock alone is a schedule."""
    conditions = {name: [link.condition for link in made(name).diagram().links] for name in ("remote", "send-on-delta")}
    assert conditions["remote"][0] == "if send, by estimate, candidate, error"
    assert conditions["send-on-delta"] == ["if send ≠ silent, by moved"]
    assert made("downsampled").diagram().links[0].reads == ("deviation", "wait")
    assert made("pattern").diagram().links[0].condition == "if send, by the step counter: 3 of 5 steps"
    mission = load("rover").design().diagram().links[1]
    assert mission.condition.startswith("if query, by the step counter: 11 of the first 59 steps (5, 10, 15")
    assert mission.condition.endswith(", …), then never")


def test_a_delay_is_an_order_of_arrows() -> None:
    """With it the input is sent before the measurement of the step is."""
    order = {name: [link.name for link in made(name).diagram().links] for name in ("lossy udp", "lossy udp, delayed")}
    assert order == {"lossy udp": ["sensor", "actuator"], "lossy udp, delayed": ["actuator", "sensor"]}


def test_a_label_that_is_never_least_sends_never() -> None:
    """And one that always is, at every step."""
    policy = design.periodic(SYSTEM.plant, SYSTEM.cost, every=3)
    for constants, told in (((1.0, 2.0, 3.0), "every step"), ((-1.0, -2.0, -3.0), "never")):
        rule = Trigger(
            {"silent": Form(constant=0.0), "send": Form(constant=Scheduled("clock", np.negative(constants)))}
        )
        steps = tuple(replace(step, trigger=rule) if hasattr(step, "trigger") else step for step in policy.steps)
        assert replace(policy, steps=steps).diagram().links[0].condition == f"if send, by the step counter: {told}"


def test_packets_go_back_skip_a_place_or_stay_where_they_are() -> None:
    """Any places and links can be drawn: those of a policy of one's own."""
    places = (Place(("sensor",), 1, ("ask",), 0), Place(("controller",), 0, (), 0), Place(("actuator",), 0, (), 1))
    far = Link(
        "actuator", "sensor", "actuator", {"y": 1}, "decision", "ask", ("ask",), ("silent",), ("y",), acknowledged=True
    )
    back = Link("sensor", "actuator", "controller", {"wish": 2}, "always")
    still = Link("sensor", "controller", "controller", {"self": 3}, "always")
    shown = Diagram(places, (far, back, still))
    first, second, third = columns(shown)
    rows = [line for line in shown.text().splitlines() if "▶" in line or "◀" in line]
    assert (rows[0][first], rows[0][third - 1], rows[1][first + 1]) == ("├", "▶", "◀")
    assert "y (1), if ask" in rows[0][first:third]
    assert (rows[2][third], rows[2][second + 1]) == ("┤", "◀")
    assert "◀ self (3), always" in rows[3][second:]
    assert shown.plot().axes


@pytest.mark.parametrize("name", ["lossy tcp", "send-on-delta"])
def test_a_terminal_of_ascii_gets_the_same_lines(name: str) -> None:
    """Letter for letter, but for a sign that takes two."""
    shown = made(name).diagram()
    plain = shown.text(plain=True)
    assert plain.isascii()
    assert plain == shown.text().translate(PLAIN)
    assert "->|" in plain


def test_the_figure_has_what_the_text_has() -> None:
    """The words of every box, the label of every arrow, and what is told."""
    policy = made("lossy tcp")
    shown, figure = policy.diagram(), policy.plot()
    words = [text.get_text() for text in figure.axes[0].texts]
    for place in shown.places:
        assert "\n".join(place.lines) in words
    for link in shown.links:
        assert link.briefly in words
    assert words.count("acknowledged") == 1


def test_the_document_holds_what_the_text_shows() -> None:
    """Plain words and numbers, which JSON holds."""
    document = load("rover").design().diagram().document()
    assert [place["nodes"] for place in document["places"]] == [["sensor"], ["controller"], ["actuator"]]
    query = document["links"][1]
    assert (query["from"], query["to"], query["payload"], query["when"]) == (
        "sensor",
        "controller",
        {"y": 1},
        "schedule",
    )
    assert query["ticks"] == load("rover").design().schedule.ticks
    assert re.fullmatch(r"\w+", query["decision"])


def test_a_policy_prints_itself_in_short() -> None:
    """What is proved, and the diagram; its repr is one line."""
    policy = load("two-mass-lqg").design()
    first, _, rest = str(policy).partition("\n")
    assert first == "lqg: J_all = 0.733478; J ≤ (1+θ) J_all, mean-square stable: at most 0.806826"
    assert rest == policy.diagram().text()
    assert str(load("lossy-double-integrator").design()).startswith("lossy-lqg: J_all = ")
    assert repr(policy).startswith("Policy(kind='lqg', cost_all_time=0.733478, guarantee=")
