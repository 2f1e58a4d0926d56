"""Nodes, firmware and saved states of release 1.0.0 are refused, with a sentence that names the difference.

The datagrams and the state were written by that release, for the built-in problem ``two-mass``. Its wire format has the
version 1 and no proofs of running senders.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import mkdtemp

import pytest
from export.devices import Device, compile_node
from runtime.test_servers import soon

import taciturn
from taciturn.errors import ProblemError
from taciturn.model.wire import VERSION
from taciturn.nodes.node import FORMAT, Node
from taciturn.nodes.packet import Wire
from taciturn_udp.endpoint import Endpoint
from taciturn_udp.nodes import NodeServer

KEY = bytes(range(32))
PLAIN = (
    "000000030100010000000100000000050000000000000007a02ce65fb97db6643fd0000000000000b6671fcd",
    "000000000102010000000000000000050000000000000007a02ce65fb97db664ae68fb6d",
    "000000030103020000000200000000050000000000000007a02ce65fb97db6643fe0000000000000bfe0000000000000e357f02a",
)
KEYED = (
    "000000030100018000000100000000050000000000000007a02ce65fb97db6643fd0000000000000ce8a1d18fc78d2a405fa67e8a66bf49149"
    "5e53a5",
    "000000000102018000000000000000050000000000000007a02ce65fb97db6640342cade71a84ca147e100880da0b3b0683fce7a",
)
STATE = {
    "format": 1, "fingerprint": "a02ce65fb97db664", "role": "actuator", "loop": 0, "epoch": 0, "tick": 0,
    "memory": [0.0], "generator": [1, 2, 3, 4], "inputs": [0.0, 0.0, 0.0, 0.0], "places": [],
    "inbox": {
        "channels": {"data actuator": {"window": [-1, -1, 0, 0], "waiting": [], "behind": None, "missing": 0}},
        "marks": {"actuator": [-1, -1, 0, 0]}, "marked": {"actuator": -1},
    },
    "sequences": {}, "input": [0.0], "heard_at": -1, "degraded_until": -1, "counters": {}, "reasons": {},
}  # fmt: skip
POLICY = taciturn.load("two-mass").design()


@pytest.mark.parametrize("keyed", [False, True], ids=["plain", "keyed"])
def test_a_node_refuses_packets_of_the_release_before_and_says_why(keyed: bool) -> None:
    """Whether both sides have a key or neither; the sentence names both versions and is printed once."""
    said, key = list[str](), KEY if keyed else None
    with Endpoint(("127.0.0.1", 0)) as here, Endpoint(("127.0.0.1", 0)) as there:
        node = Node(POLICY, "actuator", epoch=1)
        server = NodeServer([node], Wire(POLICY, key=key), here, plant=there.address, tick=0.01, say=said.append)
        sender = there.address
        for text in KEYED if keyed else PLAIN:
            there.send(bytes.fromhex(text), here.address)
        server.run(None, soon(0.02))
    assert server.refused["foreign"] == len(KEYED if keyed else PLAIN)
    (sentence,) = said
    assert f"packets of version 1 of the wire format from {sender[0]}:{sender[1]}" in sentence
    assert f"expected version {VERSION}" in sentence
    assert "export firmware again" in sentence


@pytest.mark.evidence
def test_firmware_refuses_packets_of_the_release_before() -> None:
    """It counts them as foreign, and nothing else happens."""
    library = compile_node(POLICY, "actuator", POLICY.network, Path(mkdtemp()))
    for key, datagrams in ((None, PLAIN), (KEY, KEYED)):
        device = Device(library, key, 9)
        assert not any(device.receive(bytes.fromhex(text)) for text in datagrams)
        assert device.counters == {"foreign": len(datagrams)}
        assert device.send() == []


def test_a_state_of_the_release_before_is_refused_by_its_format() -> None:
    """The node starts without it."""
    with pytest.raises(
        ProblemError, match=f"format of the saved state is 1; expected {FORMAT}, as for this release: start the node"
    ):
        Node(POLICY, "actuator").restore(STATE)
