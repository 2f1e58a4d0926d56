"""The camera as a process and what its wire carries, without sockets to others: a camera that counts, light by hand."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, cast

import pytest

import taciturn
from taciturn.nodes.packet import Packet, Wire
from taciturn_twins.faults import Fault, parse_fault
from taciturn_twins.serve import CameraServer
from taciturn_twins.wire import UNSEEN, CameraWire, PictureWire, QuestionWire
from taciturn_udp.endpoint import LARGEST_OF_ALL, Endpoint

POLICY = taciturn.load("rover").design()
LIGHT, TICK = 3, 0.3
QUESTION, CAMERA = QuestionWire(POLICY), CameraWire(POLICY, LIGHT)
JPEG = b"\xff\xd8 a picture \xff\xd9"


class Counting:
    """A camera whose pictures say what was to be seen, and under which number."""

    def __init__(self) -> None:
        """Nothing was taken."""
        self.taken: list[tuple[tuple[float, ...], int, bool, float]] = []
        self.covered, self.lighting = False, 1.0

    def take(self, light: Sequence[float], number: int = 0) -> bytes:
        """Take one."""
        self.taken.append((tuple(light), number, self.covered, self.lighting))
        return JPEG + str(number).encode()


def question(tick: int, sequence: int | None = None, loop: int = 0) -> bytes:
    """Return a question, asked by a node that measures numbers."""
    return QUESTION.encode(Packet("data", "sensor", tick, tick if sequence is None else sequence, (0.0,), 0, loop))


def mark(tick: int) -> bytes:
    """Return what says that a step is over."""
    return QUESTION.encode(Packet("mark", "sensor", tick, tick))


def light(tick: int, sequence: int, value: float = 0.0) -> bytes:
    """Return what can be seen in a step."""
    return CAMERA.encode(Packet("measurement", "plant", tick, sequence, (value,) * LIGHT))


class Bench:
    """A server, somebody who asks, and somebody who gets the pictures."""

    def __init__(self, faults: Sequence[Fault] = (), loops: int = 1) -> None:
        """Bind three sockets."""
        self.camera = Counting()
        self.asking, self.endpoint, self.peer = (Endpoint(("127.0.0.1", 0), LARGEST_OF_ALL) for _ in range(3))
        self.server = CameraServer(
            cast("Any", self.camera), CAMERA, self.endpoint, self.peer.address, tick=TICK, loops=loops, faults=faults
        )

    def give(self, *datagrams: bytes) -> list[tuple[str, int]]:
        """Give datagrams to the server until it has taken all, and return kind and step of what comes out."""
        for datagram in datagrams:
            self.asking.send(datagram, self.endpoint.address)
        self.server.run(lambda: True)
        eye = PictureWire(POLICY, lambda picture: (float(picture[len(JPEG) :]),))
        found = [eye.decode(datagram) for datagram in self.peer.receive(0.0)]
        assert all(isinstance(packet, Packet) for packet in found), found
        return [(packet.kind, packet.tick) for packet in found if isinstance(packet, Packet)]

    def close(self) -> None:
        """Close the sockets."""
        for endpoint in (self.asking, self.endpoint, self.peer):
            endpoint.close()


@pytest.fixture
def bench() -> Iterator[Bench]:
    """Return a bench without faults."""
    made = Bench()
    yield made
    made.close()


def test_nothing_is_rendered_that_nobody_asks_for(bench: Bench) -> None:
    """Light and marks alone take no picture; a question takes one."""
    assert bench.give(light(0, 0), mark(0), light(1, 1), mark(1)) == [("mark", 0), ("mark", 1)]
    assert bench.camera.taken == []
    assert bench.give(light(2, 2, 7.0), question(2), mark(2)) == [("data", 2), ("mark", 2)]
    assert bench.camera.taken == [((7.0,) * LIGHT, 2, False, 1.0)]


def test_a_question_waits_for_its_light_and_marks_wait_behind_it(bench: Bench) -> None:
    """Who has the mark of a step has the picture, whatever overtakes on the way to the camera."""
    assert bench.give(question(3), mark(3)) == []
    assert bench.give(light(2, 2)) == []
    assert bench.give(light(3, 3)) == [("data", 3), ("mark", 3)]


def test_the_light_of_the_tick_is_taken_and_the_newest_of_it(bench: Bench) -> None:
    """The world may be a step ahead; within a step it shines again as the robot moves, and old light comes too late."""
    bench.give(light(4, 10, 1.0), light(4, 12, 3.0), light(4, 11, 2.0), light(5, 13, 9.0), question(4))
    assert bench.camera.taken[0][0] == (3.0,) * LIGHT


def test_a_question_that_comes_again_gets_the_same_picture_again(bench: Bench) -> None:
    """The answer may have been lost; it is counted apart."""
    bench.give(light(0, 0), question(0), question(0))
    assert bench.camera.taken[0] == bench.camera.taken[1]
    counted = bench.server.report()["counters"]
    assert (counted["questions"], counted["questions again"], counted["pictures"], counted["pictures again"]) == (
        1,
    ) * 4


def test_faults_happen_in_their_ticks() -> None:
    """A dead camera answers nothing, though the step goes by; a cover and the light are the renderer's."""
    faults = [parse_fault(text) for text in ("camera@0.6+0.6", "cover@1.2+0.3", "light@1.5+0.3=0.4")]
    bench = Bench(faults)
    asked = [part for tick in range(7) for part in (light(tick, tick), question(tick), mark(tick))]
    kinds = bench.give(*asked)
    assert [tick for kind, tick in kinds if kind == "data"] == [0, 1, 4, 5, 6]
    assert [tick for kind, tick in kinds if kind == "mark"] == list(range(7))
    assert [(number, covered, strong) for _, number, covered, strong in bench.camera.taken] == [
        (0, False, 1.0), (1, False, 1.0), (4, True, 1.0), (5, False, 0.4), (6, False, 1.0),
    ]  # fmt: skip
    assert bench.server.report()["counters"]["unanswered"] == 2
    bench.close()


def test_what_is_not_for_a_camera_is_counted_and_nothing_else(bench: Bench) -> None:
    """Another policy's question, noise, an input, a loop that there is not."""
    other = QuestionWire(taciturn.load("remote-scalar").design())
    foreign = other.encode(Packet("data", "sensor", 0, 0, (0.0,)))
    astray = CAMERA.encode(Packet("input", "plant", 0, 0, (0.0,)))
    assert bench.give(foreign, b"noise" * 20, astray, question(0, loop=1)) == []
    assert bench.server.report()["refused"] == {"foreign": 2, "misplaced": 1, "misdirected": 1}


def test_a_question_is_a_packet_of_the_sensor_link_without_numbers() -> None:
    """It has the sequence and the step of what answers it, and nodes that measure numbers refuse it."""
    datagram = question(5, 3)
    packet = CAMERA.decode(datagram)
    assert packet == Packet("data", "sensor", 5, 3)
    assert Wire(POLICY).decode(datagram) == "malformed"
    assert len(datagram) == len(Wire(POLICY).encode(Packet("data", "sensor", 5, 3, (0.0,)))) - 8


def test_a_picture_is_read_as_the_measurement_that_is_seen_in_it() -> None:
    """With the sequence of its question; a picture in which nothing is seen, or nonsense, is no measurement."""
    told: list[tuple[int, object]] = []
    found: dict[bytes, tuple[float, ...] | None] = {
        b"here": (0.25,),
        b"none": None,
        b"nan": (float("nan"),),
        b"two": (1, 2),
    }
    wire = PictureWire(POLICY, found.__getitem__, told=lambda packet, _, seen: told.append((packet.sequence, seen)))
    asked = Packet("data", "sensor", 9, 4, (), 2)
    read = {name: wire.decode(CAMERA.encode_picture(asked, name)) for name in found}
    assert read[b"here"] == asked._replace(values=(0.25,))
    assert {read[name] for name in (b"none", b"nan", b"two")} == {UNSEEN}
    assert told[:2] == [(4, (0.25,)), (4, None)]
    assert wire.decode(Wire(POLICY).encode(asked._replace(values=(0.5,)))) == "malformed"
    assert wire.decode(Wire(POLICY).encode(Packet("mark", "sensor", 9, 4))) == Packet("mark", "sensor", 9, 4)


def test_a_picture_is_guarded_by_checksum_and_tag() -> None:
    """A bit that turns, a key that is not ours."""
    key = bytes(range(32))
    camera, eye = CameraWire(POLICY, LIGHT, key=key), PictureWire(POLICY, lambda picture: (0.0,), key=key)
    datagram = camera.encode_picture(Packet("data", "sensor", 1, 1), JPEG)
    assert isinstance(eye.decode(datagram), Packet)
    for place in range(8, len(datagram), 5):
        harmed = bytearray(datagram)
        harmed[place] ^= 4
        assert isinstance(eye.decode(bytes(harmed)), str)
    other = PictureWire(POLICY, lambda picture: (0.0,), key=key[::-1])
    assert other.decode(datagram) == "forged"
    assert PictureWire(POLICY, lambda picture: (0.0,)).decode(datagram) == "foreign"
