"""The wire format in C: the bytes of the host, and its verdict on whatever anybody sends."""

from __future__ import annotations

import json
import struct
import subprocess
import zlib
from functools import cache
from itertools import product
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest
from counts import few, scaled
from export.devices import CORE, HERE, STRICT, Device, Library, compile_node, needs_compiler, write_sizes
from hypothesis import given, settings
from hypothesis import strategies as st
from runtime.test_packets import KEY, mutated

import taciturn
from taciturn import Network
from taciturn.errors import ProblemError
from taciturn.model.wire import HEADER_SIZE, LARGEST
from taciturn.nodes.packet import REFUSALS, Packet, Wire, _tag
from taciturn_export.folder import CORE_SOURCES

RANGES = {"sensor_range": (10.0, 0.3), "actuator_range": 7.0}
PAYLOADS = ("float64", "float32", "int16")
KEYS = (None, KEY[:16], KEY)
NUMBERS = st.floats(allow_nan=False, allow_infinity=False, width=32) | st.floats(-12, 12) | st.just(-0.0)
SHAPES = {
    ("data", "sensor"): 2, ("data", "actuator"): 1, ("mark", "sensor"): 0, ("acknowledgement", "actuator"): 0,
    ("measurement", "plant"): 2, ("input", "plant"): 1, ("mark", "plant"): 0,
}  # fmt: skip


def network_of(payload: str) -> Network:
    """Return a network with packets of rounded numbers."""
    ranges = RANGES if payload == "int16" else {}
    return Network("udp", 0.3, 0.6, payload=payload, **ranges)  # type: ignore[arg-type]


@cache
def library(payload: str, precision: str) -> Library:
    """Return a node in C, compiled once for all keys."""
    policy = taciturn.load("lossy-double-integrator").design()
    return compile_node(policy, "controller", network_of(payload), Path(mkdtemp()), precision)  # type: ignore[arg-type]


@cache
def device(payload: str, secret: bytes | None, precision: str = "float64") -> tuple[Device, Wire]:
    """Return a node in C, and the wire of the host that it shall agree with."""
    policy = taciturn.load("lossy-double-integrator").design()
    return Device(library(payload, precision), secret), Wire(policy, network_of(payload), secret)


@st.composite
def packets(draw: st.DrawFn) -> Packet:
    """Return a packet that the policy has."""
    (kind, link), entries = draw(st.sampled_from(sorted(SHAPES.items())))
    tick, sequence, epoch = draw(st.integers(0, 2**64 - 1)), *draw(st.tuples(*[st.integers(0, 2**32 - 1)] * 2))
    values = tuple(draw(NUMBERS) for _ in range(entries))
    return Packet(kind, link, tick, sequence, values, epoch, draw(st.integers(0, 0xFFFF)))  # type: ignore[arg-type]


@given(st.sampled_from(PAYLOADS), st.sampled_from(KEYS), packets())
@settings(deadline=None, max_examples=100)
def test_the_bytes_of_a_packet_are_those_of_the_host_and_are_read_alike(
    payload: str, secret: bytes | None, packet: Packet
) -> None:
    """Written by either and read by either: every byte and every bit of a number."""
    found, wire = device(payload, secret)
    datagram = wire.encode(packet)
    assert found.encode(packet) == datagram
    assert repr(found.decode(datagram)) == repr(wire.decode(datagram))  # −0 is not 0


@given(st.sampled_from(PAYLOADS), packets())
@settings(deadline=None, max_examples=50)
def test_in_single_precision_numbers_are_narrowed_and_the_rest_is_the_same(payload: str, packet: Packet) -> None:
    """What fits 24 bits is written with the host's bytes where they are floats; what is read is the nearest float."""
    found, wire = device(payload, KEY, "float32")
    narrow = packet._replace(values=tuple(float(np.float32(value)) for value in packet.values))
    if payload != "int16" or packet.kind != "data":
        assert found.encode(narrow) == wire.encode(narrow)
    read = found.decode(wire.encode(packet))
    assert isinstance(read, Packet)
    expected = wire.decode(wire.encode(packet))
    assert isinstance(expected, Packet)
    assert read._replace(values=()) == expected._replace(values=())
    least = 2.0**-149  # what is smaller than a float can be is read as the nearest one
    assert read.values == pytest.approx(expected.values, rel=2.0**-23, abs=least)


def test_halves_are_rounded_to_even() -> None:
    """Every half of a step near zero and near the ends of the range, where the range makes halves exact."""
    policy = taciturn.load("lossy-double-integrator").design()
    network = Network("udp", 0.3, 0.6, payload="int16", sensor_range=32767.0, actuator_range=32767.0)
    for precision in ("float64", "float32"):
        library = compile_node(policy, "controller", network, Path(mkdtemp()), precision)  # type: ignore[arg-type]
        found = Device(library)
        wire = Wire(policy, network)
        ends = np.arange(32760.5, 32770.0, 0.5)
        for half in (*np.arange(-40.5, 41.0, 0.5), *ends, *-ends):
            packet = Packet("data", "actuator", 1, 1, (float(half),))
            assert found.encode(packet) == wire.encode(packet), half


def test_what_cannot_be_written_is_no_datagram() -> None:
    """Another number of entries, a kind without packets, no finite number, and what overflows 24 bits."""
    for payload in PAYLOADS:
        found, wire = device(payload, None)
        for packet in (
            Packet("data", "sensor", 0, 0, (1.0,)),
            Packet("measurement", "sensor", 0, 0, (1.0, 1.0)),
            Packet("data", "sensor", 0, 0, (1.0, float("inf"))),
            Packet("data", "sensor", 0, 0, (float("nan"), 1.0)),
            Packet("data", "sensor", 0, 0, (np.nextafter(LARGEST, np.inf), 1.0)),
        ):
            with pytest.raises(ProblemError):
                wire.encode(packet)
            assert found.encode(packet) == b""
        largest = Packet("data", "sensor", 0, 0, (LARGEST, -LARGEST))
        assert found.encode(largest) == wire.encode(largest) != b""
        assert isinstance(wire.decode(found.encode(largest)), Packet)
    assert float(np.finfo(np.float32).max) == LARGEST
    bad = Device(device("float64", None)[0].library, bytes(15))
    assert bad.encode(Packet("data", "actuator", 0, 0, (1.0,))) == b""


def test_what_is_not_finite_is_malformed_also_when_it_is_narrowed() -> None:
    """Infinities, no numbers, and doubles that are no floats, in a payload with a right checksum."""
    for payload, layout in (("float64", "!2d"), ("float32", "!2f")):
        for precision in ("float64", "float32"):
            found, wire = device(payload, None, precision)
            good = wire.encode(Packet("data", "sensor", 1, 2, (0.5, -0.5)))
            for value in (float("nan"), float("inf"), float("-inf"), *((1e39, -1.7e308) if layout == "!2d" else ())):
                datagram = sealed(good[:HEADER_SIZE] + struct.pack(layout, 1.0, value))
                assert found.decode(datagram) == wire.decode(datagram) == "malformed"
    found, wire = device("float64", None, "float32")
    assert isinstance(found.decode(wire.encode(Packet("data", "actuator", 1, 2, (1e38,)))), Packet)


def test_a_missing_output_is_nan_in_measurements_of_the_plant_alone() -> None:
    """Written and read as on the host, in both precisions; infinities stay malformed."""
    for precision in ("float64", "float32"):
        found, wire = device("float64", None, precision)
        packet = Packet("measurement", "plant", 3, 3, (float("nan"), 0.5), 5)
        datagram = wire.encode(packet)
        assert found.encode(packet) == datagram
        for read in (found.decode(datagram), wire.decode(datagram)):
            assert isinstance(read, Packet)
            assert np.array_equal(read.values, packet.values, equal_nan=True)
        infinite = sealed(datagram[:HEADER_SIZE] + struct.pack("!2d", float("inf"), 0.5))
        assert found.decode(infinite) == wire.decode(infinite) == "malformed"


@given(st.sampled_from(PAYLOADS), st.binary(max_size=300), st.sampled_from(KEYS))
@settings(deadline=None, max_examples=60)
def test_tags_over_contents_of_every_length_are_those_of_the_host(
    payload: str, content: bytes, secret: bytes | None
) -> None:
    """A header with any payload behind it, sealed: malformed for both, and forged for both with a bit changed."""
    found, wire = device(payload, secret)
    header = wire.encode(Packet("data", "sensor", 1, 2, (0.5, 0.25)))[:HEADER_SIZE]
    datagram = sealed(header + content)
    if secret is not None:
        datagram += _tag(datagram, secret)
    assert repr(found.decode(datagram)) == repr(wire.decode(datagram))
    if secret is not None:
        forged = datagram[:-1] + bytes([datagram[-1] ^ 1])
        assert found.decode(forged) == wire.decode(forged) == "forged"


@pytest.mark.parametrize("of", [*few(product(PAYLOADS, [False, True], [10_000]), 0), ("int16", True, 3000)], ids=str)
def test_the_verdict_on_changed_datagrams_is_that_of_the_host(of: tuple[str, bool, int]) -> None:
    """Thousands of each kind: cut, lengthened, flipped, and resealed with a right checksum; every verdict occurs."""
    payload, secret, count = of
    found, wire = device(payload, KEY if secret else None)
    draws, fate = np.random.default_rng(5), dict.fromkeys((*REFUSALS, "accepted"), 0)
    shapes = [(*name, entries) for name, entries in SHAPES.items()]
    packets = [Packet(kind, link, 5, 6, (0.25,) * entries) for kind, link, entries in shapes]  # type: ignore[arg-type]
    good = [wire.encode(packet) for packet in packets]
    for i in range(count):
        datagram = good[i % len(good)] if i % 10 == 0 else mutated(draws, good, secret)
        expected = wire.decode(datagram)
        assert repr(found.decode(datagram)) == repr(expected), datagram.hex()
        fate[expected if isinstance(expected, str) else "accepted"] += 1
    assert min(count for name, count in fate.items() if name != "forged" or secret) >= count / 100, fate


def sealed(content: bytes) -> bytes:
    """Return a content with its checksum."""
    return content + struct.pack("!I", zlib.crc32(content))


def mutate(folder: Path, count: int, seed: int, keyed: bool, precision: str) -> dict[str, int]:
    """Throw so many changed datagrams at a node in C whose every access is checked; return what became of them."""
    compiler = needs_compiler()
    write_sizes(folder, 6, precision)  # type: ignore[arg-type]
    checks = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g", "-O1"]
    sources = [*(CORE / name for name in CORE_SOURCES), HERE / "mutate.c"]
    program = folder / "mutate"
    made = subprocess.run(
        [compiler, *STRICT, *checks, f"-I{CORE}", f"-I{folder}", "-o", str(program), *map(str, sources)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if "cannot find -lasan" in made.stderr or "libclang_rt" in made.stderr:
        pytest.skip("NOT SHOWN: the compiler has no checker of addresses")
    assert made.returncode == 0, made.stderr
    found = subprocess.run(
        [str(program), str(count), str(seed), str(int(keyed))], capture_output=True, text=True, check=False
    )
    assert found.returncode == 0, found.stderr
    return json.loads(found.stdout)


@pytest.mark.parametrize("of", few(product([False, True], ["float64", "float32"]), 1, 2), ids=str)
def test_no_datagram_crashes_a_node_in_c(tmp_path: Path, of: tuple[bool, str]) -> None:
    """20,000 changed datagrams, with every access and every operation checked: each is counted, and none harms."""
    keyed, precision = of
    _assert_fate(mutate(tmp_path, 20_000, 1, keyed, precision), 20_000, keyed)


@pytest.mark.evidence
@pytest.mark.parametrize("keyed", [False, True], ids=["plain", "keyed"])
def test_ten_million_datagrams_crash_no_node_in_c(tmp_path: Path, keyed: bool) -> None:
    """Ten million in two halves, one with a key, of which none is accepted that was not written with it."""
    count = scaled(5_000_000, 500_000)
    _assert_fate(mutate(tmp_path, count, 7, keyed, "float64"), count, keyed)


def _assert_fate(fate: dict[str, int], count: int, keyed: bool) -> None:
    print(fate)
    assert sum(fate[name] for name in (*REFUSALS, "accepted")) == count
    assert min(fate[name] for name in REFUSALS if name != "forged" or keyed) > count / 100
    assert min(fate[name] for name in ("accepted", "used", "late", "duplicate", "steps", "sent")) > count / 1000
