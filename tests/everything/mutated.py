"""Packets that somebody has changed, given to an exported node in C and to the same node in Python.

Some are lost, late or early, repeated, of another epoch, loop, link or kind; in others bits are flipped, bytes are
missing or added, or a number is NaN, infinite or too large, mostly with a right checksum. The node in C checks each
access and each operation. Both nodes must read each datagram alike, send the same packets and apply the same inputs,
all of them finite, and count the same.
"""

from __future__ import annotations

import math
import shutil
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from everything.interpreters import SkippedError, stepping

from taciturn.model.network import Network
from taciturn.model.packets import inputs_at, packet_shapes, roles
from taciturn.model.policy import Policy
from taciturn.model.wire import CRC_SIZE, HEADER_SIZE, KINDS, LARGEST, OFFSETS
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet, Wire
from taciturn.problem import Problem

TICKS = 60
EPOCH = 5  # of the senders
STRANGE = (math.nan, math.inf, -math.inf, 1.7e308, -1.7e308, 3.5e38, LARGEST, -LARGEST, 1e300, 5e-324, -0.0)
REPORTED = ("report", "mode")  # answers to an operator; in Python the server of a node gives them, not the node
COUNTED = ("received", "used", "late", "replayed", "ahead", "duplicate", "misdirected", "superseded", "overflowed",
           "malformed", "corrupted", "foreign")  # fmt: skip


def like_python(problem: Problem, seed: int, folder: Path) -> str | None:
    """Give a node of a problem mutated packets, in C and in Python; return what differs."""
    from export.devices import WIDTH, compile_checked, feed, with_small_inbox

    policy, network = stepping(problem), problem.network
    if shutil.which("cc") is None:
        raise SkippedError("there is no C compiler")
    listening = [role for role in roles(policy) if Node(policy, role, network=network).inbox.streams]
    if not listening:
        raise SkippedError("no node receives packets")
    rng = np.random.default_rng([seed, 4])
    role = listening[int(rng.integers(len(listening)))]
    (place := folder / "mutated").mkdir(exist_ok=True)
    program = compile_checked(policy, role, network, place)
    with patch("taciturn.nodes.inbox.WIDTH", WIDTH):
        host = with_small_inbox(Node(policy, role, network=network, epoch=9))
        given, expected = both(host, Wire(policy, network), policy, network, problem.cost.horizon or TICKS, rng)
    try:
        lines = feed(program, given, "steps", str(len(inputs_at(policy, role))))
    except AssertionError as error:
        return f"the {role} in C ends: {str(error)[-2000:]}"
    found = list(blocks(lines[:-1], Wire(policy, network)))
    for tick, (theirs, own) in enumerate(zip(found, expected, strict=True)):
        if theirs != own:
            return f"step {tick} of the {role}: in C {theirs}, in Python {own}"
        if not all(map(math.isfinite, (*own[1], *(value for packet in own[0] for value in packet.values)))):
            return f"step {tick} of the {role}: {own} is not finite"
    words = lines[-1].split()
    counted = {name: int(number) for name, number in zip(words[::2], words[1::2], strict=True)}
    different = {name: (counted[name], host.counters[name]) for name in COUNTED if counted[name] != host.counters[name]}
    return f"counters of the {role} in C and in Python: {different}" if different else None


Block = tuple[list[Packet], tuple[float, ...]]


def both(
    host: Node, wire: Wire, policy: Policy, network: Network, horizon: int, rng: np.random.Generator
) -> tuple[list[bytes], list[Block]]:
    """Return the datagrams for a node, an empty one for each step, and what the node in Python does in each step."""
    given, expected = list[bytes](), list[Block]()
    shapes = {name: entries for name, (_, entries) in packet_shapes(policy, network).items()}
    streams = {name: stream.size for name, stream in host.inbox.streams.items()}
    sequences = dict.fromkeys(shapes, 0)
    for tick in range(min(TICKS, horizon)):
        for name in [*streams, *([list(shapes)[int(rng.integers(len(shapes)))]] if rng.random() < 0.2 else [])]:
            for datagram in news(name, shapes[name], tick, sequences, wire, rng):
                given.append(datagram)
                packet = wire.decode(datagram)
                if isinstance(packet, str):
                    host.counters[packet] += 1
                else:
                    host.sort_in(packet)
        given.append(b"")
        y = [(tick % 8 - 3) / 4, *[0.0] * (host._layout.measured - 1)] if host.measures else None
        stepped = host.step(tick, y)
        expected.append((sorted(packet._replace(sequence=0) for packet in stepped.packets), stepped.input or ()))
    return given, expected


def news(
    name: tuple[Any, str], entries: int, tick: int, sequences: dict[Any, int], wire: Wire, rng: np.random.Generator
) -> Iterator[bytes]:
    """Yield the datagrams of a kind and a link before a step: the packet that is due, and what somebody makes of it."""
    kind, link = name
    due = tick + int(rng.choice([0, 0, 0, 0, 0, -1, 1, 2, -3, 40]))
    values = tuple(rng.normal(0, 2, entries).tolist())
    epoch = EPOCH + (int(rng.integers(-1, 2)) if rng.random() < 0.03 else 0)
    loop = 1 if rng.random() < 0.03 else 0
    packet = Packet(kind, link, max(due, 0), sequences[name], values, epoch, loop)
    sequences[name] += 1
    good = wire.encode(packet)
    if rng.random() < 0.8:
        yield good
    for _ in range(int(rng.integers(3))):
        yield changed(good, entries, rng)
    if rng.random() < 0.1:
        yield good


def changed(good: bytes, entries: int, rng: np.random.Generator) -> bytes:
    """Return a datagram that somebody has changed; mostly its checksum is made right again."""
    content, what = bytearray(good[:-CRC_SIZE]), int(rng.integers(6))
    if what == 0:  # bits
        for _ in range(int(rng.integers(1, 4))):
            content[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))
    elif what == 1:  # a part is missing, or too much
        cut = int(rng.integers(len(content)))
        content = content[:cut] if rng.random() < 0.6 else content + rng.bytes(int(rng.integers(1, 9)))
    elif what == 2:  # another kind or link
        field = "kind" if rng.random() < 0.5 else "link"
        content[OFFSETS[field]] = int(rng.choice([*range(len(KINDS) + 1), 127, 255]))
    elif what == 3:  # another encoding, or number of entries
        content[OFFSETS["encoding" if rng.random() < 0.5 else "entries"]] = int(rng.choice([0, 1, 2, 3, 128, 255]))
    elif entries:  # a number that is none, or too large
        payload, size = len(content) - HEADER_SIZE, (len(content) - HEADER_SIZE) // entries
        at, value = HEADER_SIZE + size * int(rng.integers(entries)), float(rng.choice(STRANGE))
        with np.errstate(all="ignore"):
            layout = {8: ">f8", 4: ">f4"}.get(size)
            number = np.array(value, layout).tobytes() if layout else struct.pack("!h", -32768)
        if payload == size * entries and len(number) == size:
            content[at : at + size] = number
    if rng.random() < 0.15:
        return bytes(content) + good[-CRC_SIZE:]
    return bytes(content) + struct.pack("!I", zlib.crc32(content))


def blocks(lines: list[str], wire: Wire) -> Iterator[Block]:
    """Yield what a node in C sends and applies in each step."""
    sent = list[Packet]()
    for line in lines:
        if line.startswith("step"):
            yield sorted(sent), tuple(map(float.fromhex, line.split()[1:]))
            sent = []
        else:
            packet = wire.decode(bytes.fromhex(line))
            assert isinstance(packet, Packet), f"a node in C sends a {packet} packet"
            if packet.kind not in REPORTED:
                sent.append(packet._replace(sequence=0))
