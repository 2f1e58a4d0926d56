"""The constant data of a node in C, and their CRC-32, which the core checks when the node starts."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from taciturn._display import Displayed
from taciturn.model.intervals import longest_silence
from taciturn.model.network import Network
from taciturn.model.packets import fingerprint, packet_shapes
from taciturn.model.places import wire_links
from taciturn.model.policy import Policy
from taciturn.model.wire import CODES, FULL_SCALE, KINDS, SETPOINT, Encoding, PacketKind
from taciturn.program.c import CONSTANTS, REAL, c_literal, constant_array
from taciturn.program.draws import seed_generators
from taciturn.program.layout import Arrival, Layout, first_inputs
from taciturn.program.node import NodeProgram
from taciturn.program.ops import Precision

FORMAT = 3  # version of the data, TAC_FORMAT of the core
UINT32_MAX = 0xFFFFFFFF
_KIND = {kind: f"TAC_{kind.upper()}" for kind in KINDS}
_ENCODED = {name: f"TAC_ENCODED_{name.upper()}" for name in CODES}
_SIZES = ("input_count", "memory_count", "output_count", "clocks_at", "drawn_at", "drawn_count", "applied")
_COUNTS = ("measurement_count", "applied_count", "channel_count", "send_count", "clock_count")


def link_code(policy: Policy, link: str) -> str:
    """Return the number of a link in C; the links of three nodes have names."""
    named = policy.network.triangle and link != SETPOINT
    return f"TAC_{link.upper()}_LINK" if named else f"{wire_links(policy).index(link)}u"


@dataclass(frozen=True, repr=False)
class NodeData(Displayed):
    """The constant data of a node.

    Args:
        policy: policy that contains the node.
        network: network, which defines the encoding of payloads.
        program: program of the node.
        layout: positions of its inputs and outputs.
        constants: numbers that the code of its step reads.
        precision: precision of the numbers.
        seed: seed of the random draws.
    """

    policy: Policy
    network: Network
    program: NodeProgram
    layout: Layout
    constants: list[float] = field(hash=False)
    precision: Precision
    seed: int

    @cached_property
    def _shapes(self) -> dict[tuple[PacketKind, str], tuple[Encoding, int]]:
        return packet_shapes(self.policy, self.network)

    @cached_property
    def _links(self) -> tuple[str, ...]:
        return wire_links(self.policy)

    @cached_property
    def _generator(self) -> list[int]:
        return [int(word) for word in seed_generators(self.seed, 1).view(np.uint64).ravel()]

    @cached_property
    def _start(self) -> list[float]:
        starts: list[Any] = [state.start for state in self.program.parts[0].states]
        inputs, given = first_inputs(self.policy.in_units, self.layout), list[float]()
        for one in self.layout.arrivals:
            given += inputs[one.at + 1 : one.at + 1 + one.size] if one.kind == "measurement" else []
        return [*(float(start) for start in starts), *given]

    @cached_property
    def _numbers(self) -> dict[str, int]:
        """Return the fields that are integers, in the order of their type."""
        layout, program = self.layout, self.program
        return {
            "constant_count": len(self.constants),
            "remembers": min(layout.remembers, UINT32_MAX),
            "input_count": len(layout.inputs),
            "memory_count": len(program.parts[0].states),
            "output_count": len(program.parts[0].outputs),
            "clocks_at": layout.clocks,
            "drawn_at": layout.drawn.start,
            "drawn_count": layout.drawn.stop - layout.drawn.start,
            "applied": -1 if layout.applied is None else layout.applied.start,
            "measurement_count": layout.measured,
            "applied_count": 0 if layout.applied is None else layout.applied.stop - layout.applied.start,
            "channel_count": len(layout.arrivals),
            "send_count": len(layout.departures),
            "clock_count": len(program.clocks),
        }

    @property
    def crc(self) -> int:
        """CRC-32 of all data, in the order of ``tac_check``."""
        numbers, layout = self._numbers, self.layout
        found = struct.pack(">I6Hh", FORMAT, *(numbers[name] for name in _SIZES))
        found += bytes([*(numbers[name] for name in _COUNTS), len(self._shapes), self.network.protocol == "ideal"])
        found += struct.pack(">II4Q", numbers["remembers"], numbers["constant_count"], *self._generator)
        found += struct.pack(">Q", fingerprint(self.policy, self.network))
        for (kind, link), (encoding, entries) in self._shapes.items():
            found += bytes([KINDS.index(kind), self._links.index(link), list(CODES).index(encoding.name), entries])
            found += b"".join(map(self._bytes, _steps(encoding)))
        for one in layout.arrivals:
            kind, link = KINDS.index(one.kind), self._links.index(one.link)
            found += struct.pack(">6BH", kind, link, one.lag, one.part, one.size, one.acknowledged, one.at)
            found += struct.pack(">I", self._interval(one))
        for one in layout.departures:
            found += struct.pack(">BBH", self._links.index(one.link), one.size, one.at)
        for place in self.program.clocks:
            found += np.array([*place.table, place.period, place.initial], dtype=">u2").tobytes()
        return zlib.crc32(found + self._bytes(self._start) + self._bytes(self.constants))

    def _interval(self, one: Arrival) -> int:
        """Return the largest number of steps between packets, or 0 if it is not known or beyond the type of C."""
        steps = longest_silence(self.network, one.link) if one.kind == "data" else None
        return steps if steps is not None and steps <= UINT32_MAX else 0

    def arrays(self) -> list[str]:
        """Return the arrays to which the node's data point."""
        found, layout = list[str](), self.layout
        shapes = [
            (kind, link, encoding, entries, self._print_steps(found, f"{kind}_{self._links.index(link)}", encoding))
            for (kind, link), (encoding, entries) in self._shapes.items()
        ]
        found.append(
            constant_array("tac_shape", "shapes", [
                f"{{{_KIND[kind]}, {link_code(self.policy, link)}, {_ENCODED[encoding.name]}, {entries}u, {steps}}}"
                for kind, link, encoding, entries, steps in shapes
            ])
        )  # fmt: skip
        channels = [
            f"{{{_KIND[one.kind]}, {link_code(self.policy, one.link)}, {one.lag}u, {one.part}u, {one.size}u, "
            f"{_truth(one.acknowledged)}, {one.at}u, {self._interval(one)}u}}"
            for one in layout.arrivals
        ]
        sends = [f"{{{link_code(self.policy, one.link)}, {one.size}u, {one.at}u}}" for one in layout.departures]
        clocks: list[str] = []
        for i, place in enumerate(self.program.clocks):
            found.append(constant_array("uint16_t", f"clock{i}", [f"{int(value)}u" for value in place.table]))
            clocks.append(f"{{clock{i}, {len(place.table)}u, {place.period}u, {place.initial}u}}")
        for kind, name, values in (
            ("tac_channel_data", "channels", channels),
            ("tac_send_data", "sends", sends),
            ("tac_clock_data", "clocks", clocks),
            (REAL, CONSTANTS, self._print(self.constants)),
            (REAL, "start", self._print(self._start)),
        ):
            if values:
                found.append(constant_array(kind, name, values))
        return found

    def text(self) -> str:
        """Return the data of the node."""
        layout, program = self.layout, self.program
        fields: Mapping[str, object] = {
            "format": f"{FORMAT}u",
            "crc": f"UINT32_C(0x{self.crc:08x})",
            "wire": f"{{UINT64_C(0x{fingerprint(self.policy, self.network):016x}), shapes, {len(self._shapes)}u}}",
            "channels": "channels" if layout.arrivals else "NULL",
            "sends": "sends" if layout.departures else "NULL",
            "clocks": "clocks" if program.clocks else "NULL",
            "first": "first",
            "second": "second" if len(program.parts) > 1 else "NULL",
            "draw": "NULL" if program.draws is None else "draw",
            "constants": CONSTANTS if self.constants else "NULL",
            "start": "start" if self._start else "NULL",
            "generator": "{" + ", ".join(f"UINT64_C(0x{word:016x})" for word in self._generator) + "}",
            **{name: number if number < 0 else f"{number}u" for name, number in self._numbers.items()},
            "lossless": _truth(self.network.protocol == "ideal"),
        }
        lines = "\n".join(f"  {value}, /* {field} */" for field, value in fields.items())
        return f"static const tac_node_data data = {{\n{lines}\n}};\n"

    def _print_steps(self, found: list[str], name: str, encoding: Encoding) -> str:
        """Define the arrays of the quantisation steps of an encoding, and return their names."""
        names = [f"{name}_per_unit", f"{name}_per_step"][: len(_steps(encoding))]
        found += [
            constant_array(REAL, one, self._print(steps)) for one, steps in zip(names, _steps(encoding), strict=True)
        ]
        return ", ".join(names or ["NULL", "NULL"])

    def _print(self, values: Iterable[Any]) -> list[str]:
        return [c_literal(float(value), self.precision) for value in values]

    def _bytes(self, values: Iterable[float]) -> bytes:
        return np.array(list(values), dtype=np.dtype(self.precision).newbyteorder(">")).tobytes()


def _steps(encoding: Encoding) -> list[list[float]]:
    """Return steps per unit and units per step of every entry, or nothing if an encoding has no steps."""
    scales = encoding.full_scale if encoding.name == "int16" else ()
    return [[FULL_SCALE / scale for scale in scales], [scale / FULL_SCALE for scale in scales]] if scales else []


def _truth(value: bool) -> str:
    return "true" if value else "false"
