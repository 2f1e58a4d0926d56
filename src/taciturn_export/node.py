"""Export a node of a policy as a C99 header and source file, with constant data and a step without branches.

The step is the program of the node, printed by ``taciturn.program.c``. The data are constants (``NodeData``), whose
CRC-32 the core checks when the node starts.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from struct import calcsize
from typing import Any

import numpy as np

from taciturn import __version__
from taciturn.errors import ProblemError
from taciturn.extend import Displayed
from taciturn.model.coverage import LATE, LOOPS, Coverage
from taciturn.model.names import Names, Role, unit_of
from taciturn.model.network import Network
from taciturn.model.packets import (
    carries_samples,
    fingerprint,
    inputs_at,
    outputs_at,
    packet_shapes,
    place_of,
    wire_links,
)
from taciturn.model.policy import Policy, longest_silence
from taciturn.model.wire import (
    CODES,
    CRC_SIZE,
    FULL_SCALE,
    HEADER_SIZE,
    KINDS,
    SETPOINT,
    TAG_SIZE,
    Encoding,
    PacketKind,
)
from taciturn.program.c import CONSTANTS, REAL, ROOT, c_literal, constant_array, print_c, print_root
from taciturn.program.draws import seed_generators
from taciturn.program.ir import Program
from taciturn.program.node import (
    Arrival,
    Layout,
    NodeProgram,
    first_inputs,
    lay_out,
    only_applies,
    translate_node,
)
from taciturn.program.ops import Precision

FORMAT = 6  # version of the data, TAC_FORMAT of the core
UINT32_MAX = 0xFFFFFFFF
MOST_WAITING = 64  # steps of a random delay
_KIND = {kind: f"TAC_{kind.upper()}" for kind in KINDS}
_ENCODED = {name: f"TAC_ENCODED_{name.upper()}" for name in CODES}
_SIZES = (
    "input_count", "memory_count", "output_count", "clocks_at", "drawn_at", "drawn_count", "manual",
    "applied", "limited",
)  # fmt: skip
_COUNTS = ("measurement_count", "applied_count", "channel_count", "send_count", "clock_count", "manual_count")


def link_code(policy: Policy, link: str) -> str:
    """Return the C expression for the number of a link; links of the default nodes have named constants."""
    named = not policy.network.own_nodes and link != SETPOINT
    return f"TAC_{link.upper()}_LINK" if named else f"{wire_links(policy).index(link)}u"


@dataclass(frozen=True, repr=False)
class NodeData(Displayed):
    """The constant data of an exported node."""

    policy: Policy  # policy that contains the node
    network: Network  # network, which defines the encoding of payloads
    program: NodeProgram  # program of the node
    layout: Layout  # positions of its inputs and outputs
    constants: list[float] = field(hash=False)  # numbers that the code of its step reads
    precision: Precision  # precision of the numbers
    seed: int  # seed of the random draws

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
            "manual": layout.manual or 0,
            "applied": -1 if layout.applied is None else layout.applied.start,
            "limited": -1 if layout.limited is None else layout.limited.start,
            "measurement_count": layout.measured,
            "applied_count": 0 if layout.applied is None else layout.applied.stop - layout.applied.start,
            "channel_count": len(layout.arrivals),
            "send_count": len(layout.departures),
            "clock_count": len(program.clocks),
            "manual_count": 0 if layout.manual is None else self.policy.model.inputs,
        }

    @property
    def crc(self) -> int:
        """CRC-32 checksum of all constant data, in the order in which the C function ``tac_check`` reads them."""
        numbers, layout = self._numbers, self.layout
        found = struct.pack(">I7H2h", FORMAT, *(numbers[name] for name in _SIZES))
        found += bytes([*(numbers[name] for name in _COUNTS), len(self._shapes), self.network.protocol == "ideal"])
        found += struct.pack(">II4Q", numbers["remembers"], numbers["constant_count"], *self._generator)
        found += struct.pack(">Q", fingerprint(self.policy, self.network))
        for (kind, link), (encoding, entries) in self._shapes.items():
            found += bytes([KINDS.index(kind), self._links.index(link), list(CODES).index(encoding.name), entries])
            found += bytes([carries_samples(kind, link)])
            found += b"".join(map(self._bytes, _steps(encoding)))
        for one in layout.arrivals:
            kind, link = KINDS.index(one.kind), self._links.index(one.link)
            found += struct.pack(">6BH", kind, link, one.lag, one.part, one.size, one.acknowledged, one.at)
            found += struct.pack(">I2B", self._interval(one), one.pieces, one.ages or one.every)
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
        """Return the C arrays to which the constant data of the node refer."""
        found, layout = list[str](), self.layout
        shapes = [
            (kind, link, encoding, entries, self._print_steps(found, f"{kind}_{self._links.index(link)}", encoding))
            for (kind, link), (encoding, entries) in self._shapes.items()
        ]
        found.append(
            constant_array("tac_shape", "shapes", [
                f"{{{_KIND[kind]}, {link_code(self.policy, link)}, {_ENCODED[encoding.name]}, {entries}u, {steps}, "
                f"{_truth(carries_samples(kind, link))}}}"
                for kind, link, encoding, entries, steps in shapes
            ])
        )  # fmt: skip
        channels = [
            f"{{{_KIND[one.kind]}, {link_code(self.policy, one.link)}, {one.lag}u, {one.part}u, {one.size}u, "
            f"{_truth(one.acknowledged)}, {one.at}u, {self._interval(one)}u, {one.pieces}u, {one.ages or one.every}u}}"
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
        """Return the C source code of the node's constant data."""
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


EXPORTED = Coverage(LOOPS | LATE, "exported C code does not carry out")
MOST = {
    "inputs": 0xFFFF,
    "memory": 0xFFFF,
    "outputs": 0x7FFF,
    "clock": 0xFFFF,
    "packets": 0xFF,
    "shapes": 0xFF,
    "sends": 31,
    "applied": 0xFF,
}  # limits of the types in the header


@dataclass(frozen=True, eq=False, repr=False)
class CNode(Displayed):
    """A node as C99."""

    role: str  # name of the process, such as ``"controller"``
    name: str  # name of its C type, and of its files without extension
    header: str  # text of the header
    source: str  # text of the source file
    operations: int  # number of arithmetic and logical operations per step, including random draws
    constants: int  # number of constants


def check_delays(network: Network, period: float) -> None:
    """Raise an error if packets arrive later than the buffer of a node can hold."""
    for link in network.late:
        most = network.longest(link, period)
        if most >= MOST_WAITING:
            raise ProblemError(
                f"{network.key(link, 'delay')} is random, and delays are up to {most} steps, which exported C code "
                f"does not carry out; expected delays below {MOST_WAITING} steps, or a buffer"
            )


def waiting_for(network: Network, period: float, least: int) -> int:
    """Return how many packets of a link a node must be able to store: a power of two, and at least ``least``."""
    longest = max((network.longest(link, period) for link in network.links), default=0)
    while least <= longest + 1:
        least *= 2
    return least


def identifier(text: str) -> str:
    """Convert a name to a C identifier."""
    found = re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_").lower()
    return f"p{found}" if not found or found[0].isdigit() else found


def print_node(
    policy: Policy,
    role: str,
    network: Network,
    name: str,
    *,
    precision: Precision = "float64",
    seed: int = 0,
    names: Names | None = None,
) -> CNode:
    """Return the C99 sources of a policy's node, which are compiled with the sources of the common core.

    The header has constants for the places of measurements and inputs with names.
    """
    EXPORTED.check(policy.parts, policy.designed_for, network)
    check_delays(network, policy.tick)
    program = translate_node(policy, place_of(policy, role), network, precision)
    layout = lay_out(policy, program)
    _check_size(policy, network, program, layout)
    parts = ("first", "second")[: len(program.parts)]
    constants = list[float]()
    sources = [
        print_c(part, name, places, constants)
        for part, name, places in zip(program.parts, parts, layout.wiring, strict=True)
    ]
    if program.draws is not None:
        sources.append(print_c(program.draws, "draw", (), constants))
    programs: list[Program] = [*program.parts, *([] if program.draws is None else [program.draws])]
    data = NodeData(policy, network, program, layout, constants, precision, seed)
    title = f"/* Generated by taciturn {__version__}: the {role} of a policy of kind {policy.kind}. Do not edit. */\n"
    roots = [print_root(precision)] if any(f"{ROOT}(" in text for text in sources) else []
    silences = silences_of(policy, program)
    told = [_SILENCE.format(name=name, links=links, total=i, lasted=k) for links, (i, k) in silences.items()]
    # a second part reads the inputs of the step before, which a packet would overwrite
    at_once = only_applies(program, layout) and len(program.parts) == 1
    start = _START.format(name=name, spare="self->spare" if at_once else "NULL")
    body = "\n".join([*roots, *sources, *data.arrays(), data.text(), start, *told])
    needs = [f"#include <{one}.h>\n" for one, word in (("math", "INFINITY"), ("string", "memcpy")) if word in body]
    source = f'{title}{"".join(needs)}#include "{name}.h"\n\n{body}'
    header = title + _HEADER.format(
        guard=f"{name.upper()}_H", name=name, site=" and ".join(sorted(program.site)),
        inputs=max(1, len(layout.inputs)), memory=max(1, len(program.parts[0].states)),
        outputs=max(1, len(program.parts[0].outputs)), channels=max(1, len(layout.arrivals)),
        sends=max(1, len(layout.departures)), clocks=max(1, len(program.clocks)),
        applied=max(1, policy.model.inputs * program.acting),
        spare=f"  tac_real spare[{max(1, len(program.parts[0].states))}];\n" if at_once else "",
        places=_places(policy, role, name, names or Names()) + _pieces(name, program, network.cuts(policy.tick)),
        sized="".join(_SIZED_SILENCE.format(name=name, links=links) for links in silences),
        told="".join(
            _TOLD_SILENCE.format(name=name, links=links, stops=_STOPS if precision == "float32" else "")
            for links in silences
        ),
    )  # fmt: skip
    operations, numbers = sum(p.operations for p in programs), sum(_numbers(p) for p in programs)
    return CNode(role, name, header, source, operations, numbers)


def _places(policy: Policy, role: str, name: str, names: Names) -> str:
    """Return constants for the places of named signals in the arrays of a node."""
    both: list[tuple[str, Role, list[int]]] = [("y", "outputs", [*outputs_at(policy, role)])]
    if policy.prediction is None:  # otherwise the node returns the state of its model
        both.append(("u", "inputs", [*inputs_at(policy, role)]))
    lines = list[str]()
    for letter, what, entries in both:
        usual = [f"{letter}{i + 1}" for i in range(max(entries, default=-1) + 1)]
        labels = names.labels(what, usual) if getattr(names, what) else []
        known = [identifier(unit_of(label)[0]).upper() for label in labels]
        for place, i in enumerate(entries):
            if i < len(getattr(names, what)):
                own = known[i] if known.count(known[i]) == 1 else f"{known[i]}_{i + 1}"
                comment = f"{letter}[{place}]: {_comment(labels[i])}"
                lines.append(f"#define {name.upper()}_{letter.upper()}_{own} {place}u /* {comment} */")
    shown = "/* Places of measurements y of tac_step and inputs u of tac_input, counted from 0. */"
    return "\n".join(["", shown, *lines, ""]) if lines else ""


def _pieces(name: str, program: NodeProgram, cuts: tuple[float, ...]) -> str:
    """Return constants for the pieces of a step in which an actuator hears packets."""
    if program.acting == 1:
        return ""
    told = "/* Pieces of a step in which packets arrive, and the parts of a period at which they begin. */"
    begins = ", ".join(c_literal(cut, "float64") for cut in cuts)
    return "\n".join([
        "", told, f"#define {name.upper()}_PIECES {program.acting}u", f"#define {name.upper()}_CUTS {{{begins}}}", ""
    ])  # fmt: skip


def _comment(text: str) -> str:
    """Return a text without what could end a comment in C, or the line."""
    return re.sub(r"[*/\\?]{2,}|\\", "-", text)


def name_of_links(links: tuple[str, ...]) -> str:
    """Return the C identifier for several links on which a node decides jointly."""
    return identifier("_and_".join(links))


def silences_of(policy: Policy, program: NodeProgram) -> dict[str, tuple[int, int]]:
    """Return where a node stores the total cost of not sending, and the number of steps counted, by C identifier."""
    places = {state.name: i for i, state in enumerate(program.parts[0].states)}
    return {
        name_of_links(links): (places[one.total], places[one.lasted])
        for links, one in policy.theory.silence.items()
        if one.total in places
    }


def _numbers(program: Program) -> int:
    tables = [*program.tables, *(row for matrix in program.matrices for row in matrix)]
    return len(program.constants) + sum(map(len, tables))


def _check_size(policy: Policy, network: Network, program: NodeProgram, layout: Layout) -> None:
    """Raise an error if a size of the node exceeds the range of the core's integer types."""
    shapes = packet_shapes(policy, network)
    found = {
        "inputs": len(layout.inputs),
        "memory": len(program.parts[0].states),
        "outputs": len(program.parts[0].outputs),
        "clock": max([len(place.table) for place in program.clocks], default=0),
        "packets": max(entries for _, entries in shapes.values()),
        "shapes": len(shapes),
        "sends": len(layout.departures),
        "applied": 0 if layout.applied is None else layout.applied.stop - layout.applied.start,
    }
    for what, size in found.items():
        if size > MOST[what]:
            raise ProblemError(
                f"the array {what!r} of a node of the policy {policy.kind} has {size} entries; expected at most "
                f"{MOST[what]} entries on a device"
            )


def core_links(policy: Policy) -> int:
    """Return how many entries the core's tables by link need: the largest link number between nodes, plus one.

    These are the links between nodes and the link of set-points. Measurements and inputs do not pass through the core.
    """
    codes = wire_links(policy)
    return 1 + max([codes.index(link) for link in (*policy.network.links, SETPOINT) if link in codes], default=0)


@dataclass(frozen=True, repr=False)
class CoreSizes(Displayed):
    """The sizes of tables and packets for which the core of an exported node is compiled."""

    links: int  # size of the tables by link (``core_links``)
    values: int  # entries of the largest packet
    datagram: int  # bytes of the largest datagram, with its tag
    waiting: int  # early packets of each link that a node stores, a power of two
    single: bool  # whether numbers have single precision

    @staticmethod
    def of(policy: Policy, network: Network, waiting: int, precision: Precision) -> CoreSizes:
        """Compute the sizes that the nodes of a policy need."""
        shapes = packet_shapes(policy, network).values()
        payload = max(calcsize(CODES[encoding.name]) * entries for encoding, entries in shapes)
        return CoreSizes(
            links=core_links(policy),
            values=max(1, *(entries for _, entries in shapes)),
            datagram=HEADER_SIZE + payload + CRC_SIZE + TAG_SIZE,
            waiting=waiting,
            single=precision == "float32",
        )

    @property
    def suffix(self) -> str:
        """Suffix of all function names, so that the linker refuses to mix files compiled for different sizes."""
        precision = "float32" if self.single else "float64"
        return f"{precision}_{self.links}_{self.values}_{self.datagram}_{self.waiting}"

    def text(self, title: str, named: bool = True) -> str:
        """Return the C header ``taciturn_config.h``; if ``named`` is true, the names of functions contain the sizes."""
        return _CONFIG.format(
            mark=title, single=int(self.single), links=self.links, values=self.values, datagram=self.datagram,
            waiting=self.waiting, sized=f"name##_{self.suffix}" if named else "name",
        )  # fmt: skip


def table(rows: Sequence[Sequence[str]]) -> str:
    """Format rows as a Markdown table; the first row is the header."""
    head, *rest = rows
    return "\n".join("| " + " | ".join(row) + " |" for row in [head, ["---"] * len(head), *rest]) + "\n"


_CONFIG = """{mark}
#ifndef TACITURN_CONFIG_H
#define TACITURN_CONFIG_H

#define TAC_FLOAT32 {single}    /* 1: numbers are floats */
#define TAC_LINKS {links}      /* links on which nodes receive or send have smaller numbers */
#define TAC_VALUES {values}     /* numbers in the largest packet */
#define TAC_DATAGRAM {datagram}   /* bytes of the largest datagram, with its tag */
#define TAC_WAITING {waiting}    /* buffered early packets of each link, a power of two */

/* The name of a function for the linker. */
#define TAC_SIZED(name) {sized}

#endif
"""
_HEADER = """#ifndef {guard}
#define {guard}

#include "taciturn.h"

#define {name}_start TAC_SIZED({name}_start)
{sized}{places}
#ifdef __cplusplus
extern "C" {{
#endif

/* All memory of the node at the site of {site}. */
typedef struct {{
  tac_node node;
  tac_channel channels[{channels}];
  tac_real inputs[{inputs}];
  tac_real memory[{memory}];
  tac_real outputs[{outputs}];
  tac_real input[{applied}];
{spare}  uint32_t sequences[{sends}];
  uint16_t places[{clocks}];
}} {name};

/* Start the node before its first step, and return it: see tac_start. NULL: its data are damaged; see tac_check. */
tac_node *{name}_start({name} *self, uint32_t epoch, uint16_t loop, tac_key key);
{told}
#ifdef __cplusplus
}}
#endif

#endif
"""
_SIZED_SILENCE = """#define {name}_silence_{links} TAC_SIZED({name}_silence_{links})
#define {name}_lasted_{links} TAC_SIZED({name}_lasted_{links})
"""
_TOLD_SILENCE = """
/* Return what silence on {links} has added to the cost of its own response since the node started, now and later, in
 * the unit of the cost times that of its time; and the steps since the first packet arrived. Over a time T, the root of
 * the cost exceeds that of sending every sample by at most the sum of sqrt(silence / T) over all nodes, unless a node
 * was degraded. A node that starts without its state begins again with 0. Rounding may make a sum negative.{stops} */
tac_real {name}_silence_{links}(const {name} *self);
tac_real {name}_lasted_{links}(const {name} *self);
"""
_STOPS = """
 * The steps stop at 2^24 = 16777216, from which on they are too few, never too many; the sum continues."""
_SILENCE = """tac_real {name}_silence_{links}(const {name} *self)
{{
  return self->memory[{total}];
}}

tac_real {name}_lasted_{links}(const {name} *self)
{{
  return self->memory[{lasted}];
}}
"""
_START = """tac_node *{name}_start({name} *self, uint32_t epoch, uint16_t loop, tac_key key)
{{
  if (!tac_check(&data)) {{
    return NULL;
  }}
  self->node.data = &data;
  self->node.channels = self->channels;
  self->node.inputs = self->inputs;
  self->node.memory = self->memory;
  self->node.outputs = self->outputs;
  self->node.input = self->input;
  self->node.spare = {spare};
  self->node.sequences = self->sequences;
  self->node.places = self->places;
  tac_start(&self->node, epoch, loop, key);
  return &self->node;
}}
"""
