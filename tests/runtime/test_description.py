"""The JSON description of the nodes is sufficient: an interpreter that reads nothing else agrees bit for bit."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from catalogue import POLICIES
from counts import few
from runtime.described import DescribedNode, Sent
from runtime.test_nodes import PARTICULAR, build

from taciturn.model.packets import outputs_at, roles, wire_links
from taciturn.model.wire import KINDS
from taciturn.nodes.description import describe_wire
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet


def plain(packet: Packet, links: tuple[str, ...]) -> Sent:
    """Return a packet as the description numbers it."""
    return Sent(KINDS.index(packet.kind), links.index(packet.link), packet.tick, packet.values)


@pytest.mark.parametrize("name", few([*POLICIES, *PARTICULAR], 8))
def test_nodes_are_rebuilt_from_their_description(name: str) -> None:
    """Over 60 steps with the same packets, all packets and inputs are equal, also those of random draws."""
    loop, seed = build(name), 5
    policy, network = loop.policy, loop.network
    links = wire_links(policy)
    described: Any = json.loads(json.dumps(describe_wire(policy, network, seed), allow_nan=False))
    nodes = {role: Node(policy, role, network=network, seed=seed) for role in roles(policy)}
    others = {one["role"]: DescribedNode(one, described["wire"]["kinds"]) for one in described["nodes"]}
    assert list(others) == list(nodes)
    boxes: dict[str, list[Packet]] = {role: [] for role in nodes}
    draws, sent, inputs = np.random.default_rng(3), 0, 0
    for tick in range(min(60, loop.horizon or 60)):
        y = draws.normal(size=policy.model.outputs).tolist()
        for role, node in nodes.items():
            box, boxes[role] = boxes[role], []
            mine = [y[i] for i in outputs_at(policy, role)]
            packets, given = node.step(tick, mine if node.measures else None, box)
            found, applied = others[role].step(tick, mine, [plain(packet, links) for packet in box])
            assert found == [plain(packet, links) for packet in packets]
            assert applied == (given or ())
            sent, inputs = sent + len(packets), inputs + (given is not None)
            for packet in packets:
                back = packet.kind == "acknowledgement"
                ends = {name: one.program.sends if back else one.program.hears for name, one in nodes.items()}
                if draws.random() < 0.7:
                    boxes[next(name for name, links in ends.items() if packet.link in links)].append(packet)
    assert sent > 0
    assert inputs > 0
