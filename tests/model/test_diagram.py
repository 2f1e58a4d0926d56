"""A diagram shows what the steps of a policy say: who sends what to whom, when, and who is told."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import replace
from functools import cache
from html import escape
from typing import Any, cast

import numpy as np
import pytest
from catalogue import MISSIONS, POLICIES, outputs
from counts import few
from drawn import law
from hypothesis import assume
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from systems import make_system

import taciturn
from taciturn import Cost, Network, Plant, Policy, design, load
from taciturn.design.catalogue import CATALOGUE
from taciturn.errors import ProblemError
from taciturn.model.diagram import Diagram
from taciturn.model.network import LinkLaw, NodeRole
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


def wide(line: str) -> int:
    """Return the columns of a line, in which an accent has none of its own."""
    return sum(not unicodedata.combining(letter) for letter in line)


def boxes(shown: Diagram) -> list[str]:
    """Return the lines of the text without the meaning of the symbols."""
    return shown.text(legend=False).splitlines()


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


def expect_text(shown: Diagram) -> None:
    """Check that the text has a wire for each packet and each acknowledgement, in frames that are closed."""
    text, words = boxes(shown), " ".join(shown.text(legend=False).replace("│", " ").split())
    assert all(wide(line) <= 80 for line in shown.text().splitlines())
    assert len({wide(line) for line in text if line.endswith(("│", "┐", "┘"))}) <= 2  # both columns of boxes are even
    wires = [line for line in text if "──▶" in line or "◀──" in line]
    assert len(wires) == len(shown.links)
    assert sum("┄" in line for line in text) == sum(link.acknowledged for link in shown.links)
    hub_left = not any(map(shown.inwards, shown.links))
    order = [link for place in shown.places if place is not shown.hub for link in shown.wires(place)]
    for line, link in zip(wires, order, strict=True):
        assert ("▶" in line) == (shown.inwards(link) != hub_left)
        assert ("├" in line) == ("▶" in line)  # a wire begins at the frame of its sender
    for mark in ("≠", "_"):
        assert mark not in shown.text()
    for place in shown.places:
        assert all(word[:18] in words for name in place.nodes for word in re.split("[-+ ]", name))


@pytest.mark.parametrize("name", MARKED)
def test_the_text_has_a_wire_for_every_packet(name: str) -> None:
    """From the frame of the sender to that of the receiver, within 80 columns."""
    expect_text(made(name).diagram())


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


def test_a_delay_is_an_order_of_packets() -> None:
    """With it the input is sent before the measurement of the step is."""
    order = {name: [link.name for link in made(name).diagram().links] for name in ("lossy udp", "lossy udp, delayed")}
    assert order == {"lossy udp": ["sensor", "actuator"], "lossy udp, delayed": ["actuator", "sensor"]}
    later = {name: {link.name for link in made(name).diagram().links if link.later} for name in (*order, "remote")}
    assert later == {"lossy udp": set(), "lossy udp, delayed": {"sensor"}, "remote": {"sensor"}}


def test_a_label_that_is_never_least_sends_never() -> None:
    """And one that always is, at every step."""
    policy = design.periodic(SYSTEM.plant, SYSTEM.cost, every=3)
    for constants, told in (((1.0, 2.0, 3.0), "sends at every step"), ((-1.0, -2.0, -3.0), "never sends")):
        rule = Trigger(
            {"silent": Form(constant=0.0), "send": Form(constant=Scheduled("clock", np.negative(constants)))}
        )
        steps = tuple(replace(step, trigger=rule) if hasattr(step, "trigger") else step for step in policy.steps)
        assert replace(policy, steps=steps).diagram().links[0].rule.sentence == told


@pytest.mark.parametrize("name", ["lossy tcp", "send-on-delta", "remote, 30 steps", "near-optimal"])
def test_a_terminal_of_ascii_gets_the_same_words(name: str) -> None:
    """With other signs; its frames are even too."""
    shown = made(name).diagram()
    plain = shown.text(plain=True)
    assert plain.isascii()
    assert max(map(len, plain.splitlines())) <= 80
    assert all(link.packet.split(",")[0].split()[0] in plain for link in shown.links)
    assert len({len(line) for line in shown.text(plain=True, legend=False).splitlines() if line.endswith("|")}) <= 2


def extents(figure: Any) -> list[tuple[str, Any]]:
    """Return the texts of a figure with what they cover, in pixels."""
    renderer = FigureCanvasAgg(figure).get_renderer()
    return [(text.get_text(), text.get_window_extent(renderer)) for text in figure.axes[0].texts]


def expect_picture(shown: Diagram, figure: Any) -> None:
    """Check that no text of a picture meets another one, the frame of a box or the edge, and that all are there."""
    found = extents(figure)
    for i, (text, one) in enumerate(found):
        assert text.strip()
        assert "_" not in text
        assert "≠" not in text
        assert one.x0 >= figure.bbox.x0, text
        assert one.x1 <= figure.bbox.x1, text
        assert one.y0 >= figure.bbox.y0, text
        assert one.y1 <= figure.bbox.y1, text
        for other, two in found[:i]:
            # the line boxes of two neighbouring lines meet; their letters do not
            apart = min(one.x1, two.x1) - max(one.x0, two.x0), min(one.y1, two.y1) - max(one.y0, two.y0)
            assert min(apart[0], apart[1] - 0.2 * min(one.height, two.height)) <= 0, (text, other)
    frames = [patch.get_window_extent() for patch in figure.axes[0].patches if isinstance(patch, FancyBboxPatch)]
    assert len(frames) == len(shown.places) + 1  # and the plant
    for text, one in found:
        for frame in frames:
            inside = frame.x0 <= one.x0 and one.x1 <= frame.x1 and frame.y0 <= one.y0 and one.y1 <= frame.y1
            outside = one.x1 <= frame.x0 or frame.x1 <= one.x0 or one.y1 <= frame.y0 or frame.y1 <= one.y0
            assert inside or outside, text
    words = " ".join(text for text, _ in found).replace(" ", "")
    for place in shown.places:
        assert place.title.replace(" ", "") in words
        assert all(task.replace(" ", "") in words for task in place.tasks)
    for link in shown.links:
        assert all(told.replace(" ", "") in words for told in (link.name, link.packet, link.lost, *link.notes))
    assert sum(text == "acknowledgement" for text, _ in found) == sum(link.acknowledged for link in shown.links)


NODE = st.from_regex(re.compile(r"[A-Za-z][A-Za-z0-9-]{0,31}", re.ASCII), fullmatch=True).filter(lambda s: s != "plant")
LAWS = st.fixed_dictionaries({
    "loss": st.sampled_from([0.0, 0.1, 0.25]), "min_interval": st.sampled_from([1, 3]),
    "max_interval": st.sampled_from([None, 40]), "price": st.sampled_from([1.0, 3.0]),
})  # fmt: skip


@st.composite
def networks(draw: st.DrawFn) -> tuple[Network, int, int]:
    """Return a network of 1 to 8 nodes with any names, places and laws, and its numbers of outputs and inputs."""
    outputs, inputs = draw(st.integers(1, 4)), draw(st.integers(1, 3))
    own = draw(st.sampled_from(["apart", "with a sensor", "with an actuator", "alone"]))
    names = draw(st.lists(NODE, min_size=8, max_size=8, unique_by=str.lower))
    if own == "alone":
        return Network(nodes={names[0]: NodeRole(measures=True, applies=True, controls=True)}), outputs, inputs
    sensors, actuators = outputs - (own == "with a sensor"), inputs - (own == "with an actuator")
    hub = NodeRole(
        own == "with a sensor" and (outputs - 1,), own == "with an actuator" and (inputs - 1,), controls=True
    )
    nodes, links = {names[0]: hub}, dict[str, LinkLaw]()
    for i in range(sensors + actuators):
        name, role = names[i + 1], ("measures", i) if i < sensors else ("applies", i - sensors)
        homes = [None, names[0], *(one for one in names[1 : i + 1] if nodes[one].site is None)]
        site = draw(st.sampled_from([None, None, *homes]))
        nodes[name] = NodeRole(**{role[0]: (role[1],)}, site=site)
        if site != names[0]:
            law = draw(LAWS)
            links[name] = LinkLaw(**law, acknowledged=draw(st.booleans()) or law["loss"] > 0 or None)
    return Network(nodes=nodes, links=links), outputs, inputs


@law(4, 150, network=networks(), kind=st.sampled_from(["lqg", "hold", "bank", "dead band"]), factor=st.floats(0.5, 1.0))
def test_no_texts_of_any_network_meet_and_none_is_cut(
    network: tuple[Network, int, int], kind: str, factor: float
) -> None:
    """Of 1 to 8 nodes with names of up to 32 letters, in the picture of any size and in the text of 80 columns."""
    graph, outputs, inputs = network
    n = max(outputs, inputs)
    A, C, B = 0.9 * np.eye(n) + 0.02, np.eye(n)[:outputs], np.eye(n)[:, :inputs]
    plant, cost = Plant(A, B, np.eye(n), C, np.eye(outputs), dt=0.1), Cost(np.eye(n), np.eye(inputs))
    try:
        if kind == "dead band":
            policy = design.send_on_delta(plant, cost, delta=0.3, network=graph)
        elif kind == "bank":
            policy = design.distributed(plant, cost, theta=0.5, network=graph, guarantee="every path")
        else:
            actuation = "model" if kind == "lqg" else "hold"
            policy = design.distributed(
                plant, cost, theta=0.5, network=graph, actuation=actuation, prediction=actuation
            )
    except ProblemError as refused:
        # a few networks are refused: links that are decided together need every set, and some kinds need a link
        assume("link" not in str(refused) and "loss" not in str(refused))
        raise
    shown = policy.diagram()
    assert sorted(node for place in shown.places for node in place.nodes) == sorted(graph.nodes)
    expect_text(shown)
    natural = shown.plot()
    expect_picture(shown, natural)
    width, _ = natural.get_size_inches()
    expect_picture(shown, shown.plot(figsize=(factor * width, 5.0), style="dark"))


@pytest.mark.parametrize("name", few(NAMES, 6))
def test_the_picture_shows_what_the_text_shows(name: str) -> None:
    """The words of every box and of every wire, in any style and in given axes."""
    policy = made(name)
    shown = policy.diagram()
    expect_picture(shown, policy.plot(style="paper"))
    figure: Any = Figure(figsize=(5.0, 3.0))
    assert shown.plot(ax=figure.add_subplot()) is figure
    expect_picture(shown, figure)


def test_wires_of_one_picture_do_not_cross() -> None:
    """Each has a row of its own between two boxes; lines to the plant are outside of the wires."""
    shown = taciturn.load("vehicle-string").design().diagram()
    figure: Any = shown.plot()
    lines = [patch.get_path().vertices for patch in figure.axes[0].patches if isinstance(patch, FancyArrowPatch)]
    assert len(lines) >= len(shown.links)
    for i, one in enumerate(lines):
        for two in lines[:i]:
            level, steep = (one, two) if one[0, 1] == one[-1, 1] else (two, one)
            if level[0, 1] == level[-1, 1] and steep[0, 0] == steep[-1, 0]:
                x, y = steep[0, 0], level[0, 1]
                across = min(level[:, 0]) < x < max(level[:, 0]) and min(steep[:, 1]) < y < max(steep[:, 1])
                assert not across, (one, two)


def test_styles_are_named() -> None:
    """Another one is refused in a sentence."""
    with pytest.raises(ProblemError, match="style is 'blue'; expected 'light' or 'dark' for a screen, or 'paper'"):
        made("lqg joint hold").diagram().plot(style=cast("Any", "blue"))


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
    assert query["sends_when"].startswith("sends at 11 of the first 59 steps (5, 10, 15")
    command = document["links"][0]
    assert (command["packet"], command["sends_when"]) == ("input u", "sends when η'Ψη > c")
    assert command["symbols"]["e"] == "input without a packet minus computed input"


def test_a_policy_prints_itself_in_short() -> None:
    """What is proved, and the diagram; its repr is one line."""
    policy = load("two-mass-lqg").design()
    first, _, rest = str(policy).partition("\n")
    assert first == "lqg: J_all = 0.733478; J ≤ (1+θ) J_all, mean-square stable: at most 0.806826"
    assert rest == policy.diagram().text()
    assert str(load("lossy-double-integrator").design()).startswith("lossy-lqg: J_all = ")
    assert repr(policy).startswith("Policy(kind='lqg', cost_all_time=0.733478, guarantee=")
    shown = policy.diagram()
    assert shown.html() == f"<pre>{escape(shown.text())}</pre>"
