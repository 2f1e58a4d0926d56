"""Description of a policy's nodes and packets as JSON, with which nodes in other languages can be written.

It has the layout of the header, the payload of each packet, and for each node its inputs, memories and outputs with the
operations of its program (``program.ops``), in which constants and tables stand where they are read. So a few dozen
kinds of operations, each of which rounds once, suffice for a node that agrees with those of this library bit for bit.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from math import isfinite
from typing import Any

import numpy as np

from taciturn.model.coverage import INTERVALS, NETWORKS, Coverage
from taciturn.model.network import Network
from taciturn.model.packets import carries_samples, fingerprint, packet_shapes, place_of, roles, wire_links
from taciturn.model.policy import Policy
from taciturn.model.steps import Send
from taciturn.model.wire import AUTHENTICATED, CODES, CRC_SIZE, HEADER, KINDS, OFFSETS, PERSON, TAG_SIZE, VERSION
from taciturn.nodes.inbox import AHEAD, WIDTH
from taciturn.program.draws import seed_generators
from taciturn.program.ir import Program
from taciturn.program.node import lay_out, translate_node
from taciturn.program.ops import State, needed, text_of, tiles

DESCRIBED = Coverage(NETWORKS | INTERVALS, "the description of packets and nodes does not contain")
_DESCRIBED = 2  # version of the description


def describe_wire(policy: Policy, network: Network, seed: int = 0) -> dict[str, Any]:
    """Describe a policy's packets, their header, and its nodes, with values that JSON can represent.

    Args:
        policy: the policy that the nodes run.
        network: network, which determines the rounding of payloads.
        seed: seed of the random draws of the nodes.

    Raises:
        ProblemError: the nodes of the policy cannot be separated.
    """
    DESCRIBED.check(network)
    links = wire_links(policy)
    header: list[dict[str, object]] = []
    for entry in HEADER:
        size = struct.calcsize("!" + entry.code)
        header.append({"name": entry.name, "offset": OFFSETS[entry.name], "bytes": size, "meaning": entry.meaning})
    payloads = {step.link: step.payload for step in policy.steps if isinstance(step, Send)}
    packets: list[dict[str, object]] = []
    for (kind, link), (encoding, entries) in packet_shapes(policy, network).items():
        names = payloads[link] if kind == "data" else ()
        packets.append({
            "kind": KINDS.index(kind), "link": links.index(link), "encoding": list(CODES).index(encoding.name),
            "entries": entries, "ranges": list(encoding.full_scale),
            "samples": carries_samples(kind, link),
            "signals": [{"name": name, "size": policy.sizes[name]} for name in names],
        })  # fmt: skip
    return {
        "description": _DESCRIBED, "policy": policy.kind, "fingerprint": f"{fingerprint(policy, network):016x}",
        "seconds_per_step": policy.model.dt or policy.tick, "lossless": network.protocol == "ideal",
        "wire": {
            "version": VERSION, "byte_order": "big-endian", "header": header, "kinds": list(KINDS),
            "links": list(links), "encodings": list(CODES), "crc_bytes": CRC_SIZE, "tag_bytes": TAG_SIZE,
            "tag_flag": AUTHENTICATED, "tag_person": PERSON.decode(), "steps_ahead": AHEAD, "window": WIDTH,
        },
        "packets": packets,
        "nodes": [_node(policy, network, role, seed) for role in roles(policy)],
    }  # fmt: skip


def _node(policy: Policy, network: Network, role: str, seed: int) -> dict[str, Any]:
    """Return the inputs, memories, packets and operations of a node."""
    program, links = translate_node(policy, place_of(policy, role), network), wire_links(policy)
    layout = lay_out(policy, program)
    first = program.parts[0]
    words: list[int] = seed_generators(seed, 1).view(np.uint64)[:, 0].tolist()
    return {
        "role": role, "site": sorted(program.site),
        "inputs": [*map(text_of, layout.inputs)], "outputs": [*map(text_of, first.outputs)],
        "measurement": layout.measured,
        "counters": [
            {"input": layout.clocks + i, "start": place.initial, "next": [int(one) for one in place.table]}
            for i, place in enumerate(program.clocks)
        ],
        "receives": [
            {
                "kind": KINDS.index(one.kind), "link": links.index(one.link), "lag": one.lag, "input": one.at,
                "entries": one.size, "part": one.part, "acknowledge": one.acknowledged,
            }
            for one in layout.arrivals
        ],
        "draws": None if program.draws is None else {
            "input": layout.drawn.start, "memory": [f"{word:#x}" for word in words], **_steps(program.draws),
        },
        "memory": [{"signal": one.name, "entry": one.index, "start": _start(one)} for one in first.states],
        "parts": [
            {"reads": list(wiring), **_steps(part)} for wiring, part in zip(layout.wiring, program.parts, strict=True)
        ],
        "sends": [{"link": links.index(one.link), "output": one.at, "entries": one.size} for one in layout.departures],
        "applies": None if layout.applied is None else {
            "output": layout.applied.start, "entries": layout.applied.stop - layout.applied.start,
        },
    }  # fmt: skip


def _start(state: State) -> float | str:
    """Return the first value of a memory."""
    assert isinstance(state.start, float), "the memories of a node start from known values"
    return f"{int(state.start):#x}" if state.word else _number(state.start)


def _steps(program: Program) -> dict[str, Any]:
    """Return the operations of a program, and which of them give the next memories and the outputs."""
    # An unused operation is null. Constants, tables and rows of matrices are part of the operation that reads them.
    roots = [*program.following, *program.outputs.values()]
    live = needed(program.ops, roots)
    operations: list[list[object] | None] = []
    for index, (name, arguments) in enumerate(program.ops):
        read: Sequence[object] = arguments
        if name == "const":
            read = (_number(program.constants[arguments[0]]),)
        elif name in ("lookup", "pick"):
            read = ([*map(_number, program.tables[arguments[0]])], *arguments[1:])
        elif name == "product":
            read = (_rows(program, arguments[0]), *arguments[1:])
        elif name == "word":
            read = (f"{arguments[0]:#x}",)
        operations.append([name, *read] if index in live else None)
    return {"operations": operations, "next": list(program.following), "results": list(program.outputs.values())}


def _number(value: float) -> float | str:
    """Return a number, or the text inf, -inf or nan, since JSON has no such numbers."""
    return value if isfinite(value) else str(value)


def _rows(program: Program, number: int) -> list[dict[str, object]]:
    """Return the rows of a matrix, each with the first column of its sum and the coefficients from there."""
    matrix = program.matrices[number]
    rows: list[dict[str, object]] = [{"column": 0, "coefficients": []} for _ in matrix]
    for tile in tiles(matrix):
        for row in range(tile.first, tile.first + tile.rows):
            rows[row] = {"column": tile.begin, "coefficients": list(matrix[row][tile.begin : tile.end])}
    return rows
