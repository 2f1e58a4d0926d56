"""With a key, only a running sender is believed: recorded packets, restarts, reflected datagrams and changed keys."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import pytest
from runtime.test_packets import KEY
from runtime.test_servers import POLICY, soon

import taciturn
from taciturn.errors import ProblemError
from taciturn.nodes.keys import KeyFile, Keys
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet, Wire
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn_udp.endpoint import Endpoint
from taciturn_udp.nodes import NodeServer
from taciturn_udp.plant import PlantServer
from taciturn_udp.proofs import answer_to

WIRE = Wire(POLICY, key=KEY)
TICK = 0.02
FAR = 1_000_000  # step of an old recording


class Actuator:
    """The server of an actuator with a key, and an endpoint that plays its controller and its plant."""

    def __init__(self, here: Endpoint, wire: Wire = WIRE, tick: float | None = TICK, epoch: int = 7) -> None:
        """Start before the first step."""
        self.here, self.wire, self.numbers = here, wire, iter(range(100))
        node = Node(POLICY, "actuator", epoch=epoch, watchdog=10)
        self.server = NodeServer(
            [node], wire, Endpoint(("127.0.0.1", 0)), plant=here.address, tick=tick, draw=lambda: next(self.numbers)
        )

    def send(self, *packets: Packet, wire: Wire | None = None) -> list[Packet]:
        """Send packets, and return what comes back."""
        for packet in packets:
            self.here.send((wire or self.wire).encode(packet), self.server.endpoint.address)
        self.server.run(None, soon(0.02))
        found = map(self.wire.decode, self.here.receive(time.monotonic() + 0.01))
        return [packet for packet in found if isinstance(packet, Packet)]

    def challenges(self, *packets: Packet) -> list[Packet]:
        """Send packets, and return the challenges that come back."""
        return [packet for packet in self.send(*packets) if packet.kind == "challenge"]


@pytest.fixture
def actuator() -> Iterator[Actuator]:
    """Give a fresh actuator."""
    with Endpoint(("127.0.0.1", 0)) as here:
        made = Actuator(here)
        with made.server.endpoint:
            yield made


def data(tick: int, sequence: int, epoch: int, value: float = 0.25) -> Packet:
    """Return a command."""
    return Packet("data", "actuator", tick, sequence, (value,), epoch)


def test_an_old_recording_does_not_silence_a_fresh_node(actuator: Actuator) -> None:
    """A packet of step 1,000,000 with the newest epoch of all changes neither clock nor inbox, and is never used."""
    recorded = data(FAR, 5, epoch=2**31, value=9.0)
    (first,) = actuator.challenges(recorded)
    assert (first.link, first.back, first.tick) == ("actuator", True, 0)
    assert not actuator.server.phase.known
    assert actuator.server.report()["counters"] == {}
    # the true controller, which was started when its clock showed an earlier time, answers
    (again,) = actuator.challenges(data(40, 0, epoch=3))
    assert again.nonce == first.nonce
    actuator.send(answer_to(again, epoch=3, tick=40), data(40, 0, epoch=3))
    assert actuator.server.phase.known
    assert 40 <= actuator.server.nodes[0].tick < 60
    assert actuator.server.nodes[0].counters["used"] + actuator.server.nodes[0].counters["late"] == 1
    assert actuator.challenges(recorded)
    report = actuator.server.report()
    assert report["clock_jumps"] == 0
    assert report["refused"] == {"unproven": 3}
    assert report["proofs"] == {"challenges": 3, "proofs": 1}


def test_an_answer_is_valid_once(actuator: Actuator) -> None:
    """When the sender has started again, its former answer and its former packets are of no use to anybody."""
    (asked,) = actuator.challenges(data(3, 0, epoch=3))
    old = answer_to(asked, epoch=3, tick=3)
    actuator.send(old, data(3, 0, epoch=3))
    (asked,) = actuator.challenges(data(4, 0, epoch=2))
    assert asked.nonce == 1
    actuator.send(answer_to(asked, epoch=2, tick=4), data(4, 0, epoch=2))
    used = dict(actuator.server.nodes[0].counters)
    assert actuator.challenges(old, data(5, 1, epoch=3, value=9.0))
    actuator.send(old)
    assert actuator.server.nodes[0].counters == used
    assert actuator.server.report()["proofs"] == {"challenges": 3, "proofs": 2, "unasked": 2}


def test_packets_before_the_proof_are_refused(actuator: Actuator) -> None:
    """A node that starts without its state cannot know which packets of this epoch have been used before."""
    (asked,) = actuator.challenges(data(80, 9, epoch=3))
    actuator.send(
        answer_to(asked, epoch=3, tick=80), data(80, 9, epoch=3), *(data(k, k // 9, 3, 9.0) for k in range(79))
    )
    counters = actuator.server.report()["counters"]
    assert counters["received"] == 1
    assert actuator.server.report()["refused"]["replayed"] == 79


def test_what_a_node_has_sent_is_no_proof_for_itself(actuator: Actuator) -> None:
    """Its own challenge, and marks that travel in its own direction, come back: they are misdirected."""
    (asked,) = actuator.challenges(data(3, 0, epoch=3))
    own = asked._replace(kind="answer", epoch=7)
    actuator.send(asked, own, Packet("mark", "actuator", 3, 0, (), 3, back=True))
    assert actuator.server.report()["refused"] == {"unproven": 1, "misdirected": 3}
    assert actuator.server.report()["proofs"] == {"challenges": 1}


def test_a_sender_answers_and_repeats_its_last_packets() -> None:
    """The answer names the step before the last one; the packets of these steps follow, with their sequences."""
    node = Node(POLICY, "controller", epoch=5)
    with Endpoint(("127.0.0.1", 0)) as here, Endpoint(("127.0.0.1", 0)) as there:
        server = NodeServer([node], WIRE, there, peer=here.address, plant=here.address, draw=lambda: 11)
        measured = [Packet("measurement", "plant", k, k, (0.5, -0.5), 100) for k in range(3)]
        asked = Packet("challenge", "actuator", 0, 0, back=True, nonce=77)
        here.send(WIRE.encode(asked), there.address)
        here.send(WIRE.encode(measured[0]), there.address)
        server.run(None, soon(0.05))
        early, plea = [WIRE.decode(datagram) for datagram in here.receive(time.monotonic() + 0.1)]
        assert early == Packet("answer", "actuator", 0, 0, (), 5, nonce=77)
        assert isinstance(plea, Packet)
        assert (plea.kind, plea.link, plea.back, plea.nonce) == ("challenge", "plant", True, 11)
        here.send(WIRE.encode(answer_to(plea, epoch=100, tick=0)), there.address)
        for packet in measured:
            here.send(WIRE.encode(packet), there.address)
        server.run(3, soon(5.0))
        sent = [WIRE.decode(datagram) for datagram in here.receive(time.monotonic() + 0.1)]
        here.send(WIRE.encode(asked), there.address)
        server.run(None, soon(0.1))
        answer, *again = [WIRE.decode(datagram) for datagram in here.receive(time.monotonic() + 0.1)]
    assert answer == Packet("answer", "actuator", 1, 0, (), 5, nonce=77)
    assert again == [packet for packet in sent if isinstance(packet, Packet) and packet.tick > 0]
    assert len(again) >= 2


def test_a_restored_node_needs_no_new_proof(tmp_path: Path) -> None:
    """The proof is part of the saved state; a node without its state asks again."""
    from taciturn_udp.service import FileStorage

    storage = FileStorage(tmp_path / "state.json")
    with Endpoint(("127.0.0.1", 0)) as here:
        for kept, expected in ((storage, 1), (storage, 0), (None, 1)):
            with Endpoint(("127.0.0.1", 0)) as there:
                server = NodeServer(
                    [Node(POLICY, "actuator", epoch=7)], WIRE, there, plant=here.address, tick=TICK, keep=kept,
                    draw=lambda: 5,
                )  # fmt: skip
                here.send(WIRE.encode(data(40, expected, epoch=3)), there.address)
                here.send(
                    WIRE.encode(answer_to(Packet("challenge", "actuator", 0, 0, back=True, nonce=5), 3, 40)),
                    there.address,
                )
                here.send(WIRE.encode(data(40, 7 + expected, epoch=3)), there.address)
                server.run(None, soon(0.1))
                assert server.report()["proofs"].get("challenges", 0) == expected
                assert server.report()["counters"]["received"] >= 1


def test_a_silent_actuator_repeats_its_safe_input() -> None:
    """A plant that starts again challenges it: it also sends the safe input again, not only its last steps."""
    with Endpoint(("127.0.0.1", 0)) as here, Endpoint(("127.0.0.1", 0)) as there:
        node = Node(POLICY, "actuator", epoch=7, watchdog=2, safe=(-1.5,))
        server = NodeServer([node], WIRE, there, plant=here.address, tick=TICK)
        server.run(None, soon(0.08))
        assert node.silent
        here.receive(time.monotonic() + 0.05)
        here.send(WIRE.encode(Packet("challenge", "plant", 0, 0, nonce=4)), there.address)
        server.run(None, soon(0.01))
        found = [WIRE.decode(datagram) for datagram in here.receive(time.monotonic() + 0.05)]
    assert [packet.kind for packet in found if isinstance(packet, Packet)][:2] == ["answer", "input"]
    assert [packet.values for packet in found if isinstance(packet, Packet)][1] == (-1.5,)


def test_a_plant_drops_waiting_inputs_of_a_former_start() -> None:
    """With a key, the later start may have the smaller epoch."""
    problem = taciturn.load("two-mass-lqg")
    with Endpoint(("127.0.0.1", 0)) as here, Endpoint(("127.0.0.1", 0)) as there:
        plant = SimulatedPlant(problem.close(POLICY))
        numbers = iter(range(5))
        server = PlantServer([plant], WIRE, there, here.address, tick=0.1, epoch=50, draw=lambda: next(numbers))
        for nonce, epoch, tick in ((0, 60, 1), (1, 2, 0)):
            given = Packet("input", "plant", tick, tick, (float(epoch),), epoch)
            here.send(WIRE.encode(given), there.address)
            here.send(WIRE.encode(Packet("answer", "plant", 0, 0, (), epoch, back=True, nonce=nonce)), there.address)
            here.send(WIRE.encode(given), there.address)
        server.run(2, lambda: False)
    assert server.given(0) == (2.0,)


def test_a_plant_believes_only_a_running_actuator() -> None:
    """An input that was recorded earlier is not applied; the plant also answers the challenge of its sensor."""
    problem = taciturn.load("two-mass-lqg")
    with Endpoint(("127.0.0.1", 0)) as here, Endpoint(("127.0.0.1", 0)) as there:
        plant = SimulatedPlant(problem.close(POLICY))
        server = PlantServer([plant], WIRE, there, here.address, tick=0.2, epoch=50, draw=lambda: 9)
        given = Packet("input", "plant", 0, 0, (3.0,), 60)
        asked = Packet("challenge", "plant", 0, 0, back=True, nonce=4)
        for packet in (given, asked, asked._replace(back=False)):
            here.send(WIRE.encode(packet), there.address)
        server.run(1, lambda: False)
        found = [WIRE.decode(datagram) for datagram in here.receive(time.monotonic() + 0.1)]
        kinds = [packet.kind for packet in found if isinstance(packet, Packet)]
        assert sorted(kinds) == ["answer", "challenge", "measurement", "measurement"]
        assert server.given(0) == (0.0,)
        assert server.refused == {"unproven": 1, "misdirected": 1}
        for packet in (Packet("answer", "plant", 0, 0, (), 2, back=True, nonce=9), given._replace(epoch=2)):
            here.send(WIRE.encode(packet), there.address)
        server.run(1, lambda: False)
    assert server.given(0) == (3.0,)


def test_keys_change_without_a_stop(tmp_path: Path) -> None:
    """Accept the new key, use it, accept it alone: at each time a neighbour with the former file is understood."""
    old, new, path = "01" * 16, "02" * 32, tmp_path / "keys"

    def write(text: str) -> None:
        path.write_text(text)
        path.chmod(0o600)
        os.utime(path, ns=(next(times), next(times)))

    times = iter(range(10**18, 10**18 + 100))
    write(f"# both links\nactuator: {old}\nplant: {old}\n")
    keys = KeyFile(path)
    told = [keys.renew()]
    wires = {"old": Wire(POLICY, key=bytes.fromhex(old)), "new": Wire(POLICY, key=bytes.fromhex(new))}
    wire, packet = Wire(POLICY, key=keys), data(3, 0, epoch=3)

    def understood() -> tuple[list[str], str]:
        accepted = [name for name, one in wires.items() if wire.decode(one.encode(packet)) == packet]
        used = [name for name, one in wires.items() if one.decode(wire.encode(packet)) == packet]
        return accepted, *used  # type: ignore[return-value]

    def renew(text: str) -> None:
        write(text)
        keys._looked -= 10.0
        told.append(keys.renew())

    found = [understood()]
    for of_link in (f"{old} {new}", f"{new} {old}", new):
        renew(f"actuator: {of_link}\nplant: {of_link}\n")
        found.append(understood())
    assert found == [(["old"], "old"), (["old", "new"], "old"), (["old", "new"], "new"), (["new"], "new")]
    renew(f"plant: {new}\n")
    assert understood() == (["new"], "new")
    path.chmod(0o644)
    keys._looked -= 10.0
    told.append(keys.renew())
    assert told[0] is None
    assert all("the new keys are in use" in str(sentence) for sentence in told[1:4])
    assert "no key for the actuator link" in str(told[4])
    assert "can read it" in str(told[5])
    assert all("the former keys remain in use" in str(sentence) for sentence in told[4:])


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "contains no key"),
        ("bus: " + "01" * 16, "names the link 'bus'; expected one of the links sensor, actuator, plant"),
        ("sensor: " + "01" * 16 + "\nsensor: " + "02" * 16, "two lines for the sensor link"),
        ("sensor: " + "01" * 16 + "\n" + "02" * 16, "has both a key for all links and keys for single links"),
        ("sensor: 0102", "has 2 bytes"),
        ("sensor: secret", "characters that are not hexadecimal digits"),
    ],
)
def test_keys_that_are_not_valid_are_refused(text: str, sentence: str) -> None:
    """In a sentence; a node also refuses to start without the key of a link that it uses."""
    with pytest.raises(ProblemError, match=sentence):
        Wire(POLICY, key=Keys.parse(text))
    only = Wire(POLICY, key=Keys.parse("plant: " + "01" * 16))
    with Endpoint(("127.0.0.1", 0)) as there, pytest.raises(ProblemError, match="no key for the actuator link"):
        NodeServer([Node(POLICY, "actuator")], only, there, plant=("127.0.0.1", 1))


@pytest.mark.evidence
@pytest.mark.parametrize("key", [None, KEY], ids=["without key", "with key"])
def test_a_plant_that_starts_again_continues_with_the_step_of_its_nodes(key: bytes | None) -> None:
    """Its steps begin at 0, which the nodes have passed long ago; the first input tells it the present step."""
    problem, wire = taciturn.load("two-mass-lqg"), Wire(POLICY, key=key)
    ended, tick = threading.Event(), 0.01
    with ExitStack() as stack, ThreadPoolExecutor() as threads:
        ports = [stack.enter_context(Endpoint(("127.0.0.1", 0))) for _ in range(3)]
        controls, acts, plants = (port.address for port in ports)
        servers = [
            NodeServer([Node(POLICY, "controller", epoch=7)], wire, ports[0], peer=acts, plant=plants, tick=tick),
            NodeServer([Node(POLICY, "actuator", epoch=7)], wire, ports[1], plant=plants, tick=tick, wait=0.55),
        ]
        running = [threads.submit(server.run, None, ended.is_set) for server in servers]
        try:
            for epoch in (50, 51):
                plant = PlantServer(
                    [SimulatedPlant(problem.close(POLICY))], wire, ports[2], controls, tick=tick, epoch=epoch
                )
                report = plant.run(50, lambda: False)
        finally:
            ended.set()
        reports = [one.result() for one in running]
    assert report["held"] <= 25
    assert report["inputs"] >= 25
    assert all(90 <= one["tick"] < 130 for one in reports)
    assert reports[0]["measurements"] >= 75
