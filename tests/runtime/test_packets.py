"""The wire format: what is written is read, what is not ours is refused, and nothing crashes on what anybody sends."""

from __future__ import annotations

import hashlib
import hmac
import struct
import zlib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from counts import scaled
from hypothesis import given, settings
from hypothesis import strategies as st

import taciturn
from taciturn import Network
from taciturn.errors import ProblemError
from taciturn.model.policy import Policy
from taciturn.model.wire import HEADER, HEADER_SIZE, Encoding, read_place
from taciturn.nodes.inbox import WIDTH, Window
from taciturn.nodes.keys import read_keys
from taciturn.nodes.node import Node
from taciturn.nodes.packet import REFUSALS, Packet, Wire

KEY = bytes(range(32))
U32 = st.integers(0, 2**32 - 1)


def policy() -> Policy:
    """Return a policy with packets on both links."""
    return taciturn.load("lossy-double-integrator").design()


def wire(key: bytes | None = None, **network: object) -> Wire:
    """Return the wire of that policy."""
    return Wire(policy(), Network("udp", 0.3, 0.6, **network), key)  # type: ignore[arg-type]


RANGES = {"sensor_range": 10.0, "actuator_range": 10.0}
WIRES = [
    (wire(key, payload=name, **more), Encoding(name, (10.0,) * 2 if more else ()))
    for key in (None, KEY)
    for name, more in (("float64", {}), ("float32", {}), ("int16", RANGES))
]
PAIRS = st.tuples(st.floats(-10, 10), st.floats(-10, 10))


@given(U32, U32, st.integers(0, 2**64 - 1), st.integers(0, 2**16 - 1), PAIRS)
@settings(deadline=None)
def test_what_is_written_is_read(sequence: int, epoch: int, tick: int, loop: int, values: tuple[float, float]) -> None:
    """Every field and number comes back, with and without a key, as rounded as the encoding says."""
    for found, encoding in WIRES:
        rounded = tuple(encoding.rounded(values).tolist())
        packet = Packet("data", "sensor", tick, sequence, rounded, epoch, loop)
        assert found.decode(found.encode(packet)) == packet


def test_the_layout_is_that_of_the_table() -> None:
    """A datagram taken apart by hand, with its checksum and its tag, as a peer in another language would."""
    datagram = wire(KEY).encode(Packet("data", "actuator", 9, 0x01020304, (0.5,), 7, 5))
    assert datagram[:4] == bytes([1, 2, 3, 4])
    fields = dict(zip((e.name for e in HEADER), struct.unpack(">IBBBBHBBIQQ", datagram[:HEADER_SIZE]), strict=True))
    assert fields.pop("fingerprint") == wire().fingerprint
    assert fields == {
        "sequence": 0x01020304, "version": 2, "kind": 0, "link": 1, "encoding": 128, "loop": 5, "entries": 1,
        "direction": 0, "epoch": 7, "tick": 9,
    }  # fmt: skip
    assert struct.unpack(">d", datagram[HEADER_SIZE : HEADER_SIZE + 8]) == (0.5,)
    assert struct.unpack(">I", datagram[-20:-16])[0] == zlib.crc32(datagram[:-20])
    tag = hashlib.blake2s(datagram[:-16], digest_size=16, key=KEY, person=b"taciturn").digest()
    assert hmac.compare_digest(tag, datagram[-16:])
    assert read_place(datagram) == (0x01020304, 0, 5, 9)


def test_what_is_not_ours_is_refused_with_its_reason() -> None:
    """Short, corrupted, of another policy, of another key, without one, and with impossible fields."""
    plain, keyed = wire(), wire(KEY)
    packet = Packet("data", "sensor", 1, 2, (0.5, -0.5))
    other = Wire(taciturn.load("lossy-double-integrator").changed({"price": 0.2}).design(), Network("udp", 0.3, 0.6))
    good = plain.encode(packet)
    assert plain.decode(good[:20]) == "malformed"
    assert plain.decode(b"") == "malformed"
    for place in range(len(good)):
        harmed = bytearray(good)
        harmed[place] ^= 0x10
        assert plain.decode(bytes(harmed)) in ("corrupted", "foreign")
    assert plain.decode(other.encode(packet)) == "foreign"
    assert plain.decode(keyed.encode(packet)) == "foreign"
    assert keyed.decode(good) in ("foreign", "malformed")
    assert keyed.decode(wire(bytes(32)).encode(packet)) == "forged"
    assert plain.decode(_with_crc(good[:HEADER_SIZE] + struct.pack("!2d", float("nan"), 1.0))) == "malformed"
    assert plain.decode(_with_crc(good[:HEADER_SIZE] + bytes(24))) == "malformed"
    for place, value in ((5, 9), (6, 2), (7, 1), (10, 3), (11, 1)):
        harmed = bytearray(good[:-4])
        harmed[place] = value
        assert plain.decode(_with_crc(bytes(harmed))) == "malformed"


def test_what_cannot_be_written_is_refused() -> None:
    """Another number of entries, a kind without packets, and what is no finite number."""
    for packet in (
        Packet("data", "sensor", 0, 0, (1.0,)),
        Packet("measurement", "sensor", 0, 0, (1.0, 1.0)),
        Packet("data", "sensor", 0, 0, (1.0, float("inf"))),
    ):
        with pytest.raises(ProblemError, match="expected"):
            wire().encode(packet)


def test_a_fingerprint_is_that_of_the_data_and_not_of_their_last_bits() -> None:
    """Other parameters, networks or roundings differ; a matrix that is off by rounding does not."""
    from dataclasses import replace

    from taciturn.model.packets import fingerprint
    from taciturn.model.steps import Assign

    def nudged(found: Policy, size: float) -> Policy:
        def turned(step: Assign) -> Assign:
            branches = tuple({n: (1 + size) * np.asarray(w) for n, w in terms.items()} for terms in step.branches)
            return Assign(step.at, step.signal, branches, step.on)

        steps = (turned(s) if isinstance(s, Assign) and s.signal == "seen" else s for s in found.steps)
        return replace(found, steps=tuple(steps))

    problem, udp = taciturn.load("lossy-double-integrator"), Network("udp", 0.3, 0.6)
    first = fingerprint(problem.design(), udp)
    assert fingerprint(nudged(problem.design(), 1e-13), udp) == first
    others = {
        fingerprint(nudged(problem.design(), 1e-3), udp),
        fingerprint(problem.changed({"price": 0.11}).design(), udp),
        fingerprint(problem.design(), Network("tcp", 0.3, 0.6)),
        fingerprint(problem.design(), Network("udp", 0.3, 0.6, payload="float32")),
    }
    assert len(others | {first}) == 5


def test_keys_are_read_from_files_and_from_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hexadecimal digits of 16 to 32 bytes; whatever else is refused in a sentence."""
    path = tmp_path / "key"
    path.write_text(KEY.hex() + "\n")
    path.chmod(0o640)
    with pytest.raises(ProblemError, match=r"has the mode 0640, with which other users can read it; expected 0600"):
        read_keys(path)
    path.chmod(0o600)
    assert read_keys(path).of("plant") == (KEY,)
    monkeypatch.setenv("TACITURN_KEY", KEY[:16].hex())
    assert read_keys().of("sensor") == (KEY[:16],)
    monkeypatch.setenv("TACITURN_KEY", "")
    assert read_keys(hosts=["127.0.0.1", "::1"]) is None
    with pytest.raises(ProblemError, match=r"TACITURN_KEY is empty, so packets from and to 0\.0\.0\.0 would not be"):
        read_keys(hosts=["127.0.0.1", "0.0.0.0"])
    monkeypatch.delenv("TACITURN_KEY")
    assert read_keys(hosts=["0.0.0.0"]) is None
    for text, sentence in (("00" * 15, "has 15 bytes"), ("00" * 33, "has 33 bytes"), ("secret", "hexadecimal")):
        path.write_text(text)
        with pytest.raises(ProblemError, match=sentence):
            read_keys(path)
    with pytest.raises(ProblemError, match="cannot be read"):
        read_keys(tmp_path / "none")
    with pytest.raises(ProblemError, match="the key has 3 bytes"):
        wire(b"abc")


NEAR = [number for end in range(0, 3 * WIDTH, WIDTH) for number in range(max(0, end - 2), end + 3)]  # ends of a window


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 3 * WIDTH) | st.sampled_from(NEAR)), max_size=60))
def test_a_window_admits_each_packet_once(packets: list[tuple[int, int]]) -> None:
    """Against a set that remembers everything: none is new twice, and what is near the newest is not replayed."""
    window, seen = Window(), set()
    newest: tuple[int, int] = (-1, -1)
    for epoch, sequence in packets:
        news = window.admit(epoch, sequence)
        assert (news == "new") <= ((epoch, sequence) not in seen)
        if epoch >= newest[0] and (epoch > newest[0] or sequence > newest[1] - WIDTH):
            assert news == ("duplicate" if (epoch, sequence) in seen else "new")
        else:
            assert news == "replayed"
        if news == "new":
            seen.add((epoch, sequence))
            newest = max(newest, (epoch, sequence))
    assert window.missing == (newest[1] + 1 - sum(epoch == newest[0] for epoch, _ in seen) if seen else 0)


def _with_crc(content: bytes) -> bytes:
    return content + struct.pack("!I", zlib.crc32(content))


def mutated(draws: np.random.Generator, good: list[bytes], key: bool) -> bytes:
    """Return a datagram that is random, or a good one that is cut, lengthened, or changed with a right checksum."""
    what, one = draws.integers(5), good[draws.integers(len(good))]
    if what == 0:
        return draws.bytes(int(draws.integers(0, 90)))
    if what == 1:
        return one[: draws.integers(len(one))]
    if what == 2:
        return one + draws.bytes(int(draws.integers(1, 9)))
    harmed = bytearray(one)
    for _ in range(draws.integers(1, 4)):
        harmed[draws.integers(len(harmed))] ^= 1 << int(draws.integers(8))
    if what == 3:
        return bytes(harmed)
    end = len(harmed) - 4 - (16 if key else 0)
    return _with_crc(bytes(harmed[:end])) + bytes(harmed[end + 4 :])


def fuzz(count: int, seed: int, key: bytes | None) -> Counter[str]:
    """Send so many datagrams to the parser, and what it accepts to nodes; return what became of them."""
    draws, found, fate = np.random.default_rng(seed), wire(key), Counter[str]()
    packets = [
        Packet("data", "sensor", 5, 5, (0.1, 0.2)), Packet("data", "actuator", 5, 5, (0.3,)),
        Packet("mark", "sensor", 5, 5), Packet("acknowledgement", "actuator", 5, 5),
        Packet("measurement", "plant", 5, 5, (1.0, 1.0)), Packet("input", "plant", 5, 5, (1.0,)),
    ]  # fmt: skip
    good = [found.encode(packet) for packet in packets]
    nodes = [Node(policy(), "controller", network=Network("udp", 0.3, 0.6)), Node(policy(), "actuator")]
    # kinds of change are drawn once, and each is sent with every byte moved on: as many different datagrams, faster
    patterns = [mutated(draws, good, key is not None) for _ in range(2000)]
    genuine = set(good)
    for i in range(count):
        datagram = patterns[i % 2000]
        if i >= 2000 and datagram:
            place, turned = i // 2000 % len(datagram), (i // 2000 // len(datagram)) % 255 + 1
            datagram = datagram[:place] + bytes([datagram[place] ^ turned]) + datagram[place + 1 :]
            if key is None and i % 3 == 0:
                datagram = _with_crc(datagram[:-4])
        packet = found.decode(datagram)
        if isinstance(packet, str):
            fate[packet] += 1
        else:
            fate["accepted"] += 1
            assert key is None or datagram in genuine
            for node in nodes:
                node.sort_in(packet)
        if i % 997 == 0:
            for node in nodes:
                node.step(node.tick + 1)
    for node in nodes:
        assert np.isfinite(node.save()["memory"]).all()
        counted = {name: n for name, n in node.counters.items() if not name.startswith(("sent", "missed"))}
        assert counted.pop("received") == sum(counted.values()) + node.inbox.waiting
        assert node.inbox.waiting < 300
    assert set(fate) <= {*REFUSALS, "accepted"}
    assert sum(fate.values()) == count
    return fate


@pytest.mark.parametrize("key", [None, KEY], ids=["plain", "keyed"])
def test_no_datagram_crashes_parser_or_nodes(key: bytes | None) -> None:
    """40,000 random and changed datagrams: each is refused with a reason, or, without a key, sorted in."""
    fate = fuzz(40_000, 1, key)
    assert fate["malformed"] > 1000
    assert fate["corrupted"] > 1000
    assert (fate["accepted"] > 100) == (key is None)


@pytest.mark.evidence
@pytest.mark.parametrize("part", range(2))
def test_ten_million_datagrams_crash_nothing(part: int) -> None:
    """Ten million in two halves, one with a key, of which none is accepted without a valid tag."""
    fate = fuzz(scaled(5_000_000, 500_000), 7 + part, KEY if part else None)
    print(dict(fate))
    assert (fate["accepted"] > 1000) == (part == 0)
    if part:
        assert fate["forged"] > scaled(100_000, 10_000)
