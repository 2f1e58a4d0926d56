"""A node that is built from the JSON description alone: an interpreter of its operations without the library."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

MASK = (1 << 64) - 1


class Sent(NamedTuple):
    """A packet as numbers: kind, link, step and entries."""

    kind: int
    link: int
    tick: int
    values: tuple[float, ...]


def bits(x: float) -> int:
    """Return the bits of a number."""
    return struct.unpack("<Q", struct.pack("<d", x))[0]


def number(word: int) -> float:
    """Return the number with these bits."""
    return struct.unpack("<d", struct.pack("<Q", word))[0]


def row(line: Mapping[str, Any], values: Sequence[float]) -> float:
    """Return the sum of a row, from the left and from 0."""
    total = 0.0
    for j, coefficient in enumerate(line["coefficients"], line["column"]):
        total += coefficient * values[j]
    return total


CALCULATE: Mapping[str, Callable[..., Any]] = {
    "add": lambda x, y: x + y,
    "sub": lambda x, y: x - y,
    "mul": lambda x, y: x * y,
    "div": lambda x, y: x / y,
    "sqrt": math.sqrt,
    "greater": lambda x, y: x > y,
    "less_equal": lambda x, y: x <= y,
    "and": lambda x, y: x and y,
    "not": lambda x: not x,
    "select": lambda chosen, x, y: x if chosen else y,
    "word_add": lambda x, y: (x + y) & MASK,
    "word_and": lambda x, y: x & y,
    "word_or": lambda x, y: x | y,
    "word_xor": lambda x, y: x ^ y,
    "any_bit": lambda x: x != 0,
    "bits": bits,
    "number": number,
    "narrow": lambda x: struct.unpack("<f", struct.pack("<f", x))[0],
}


def run(part: Mapping[str, Any], memory: Sequence[Any], inputs: Sequence[float]) -> tuple[list[Any], list[Any]]:
    """Return the next memories and the results of a part."""
    values: list[Any] = []
    for operation in part["operations"]:
        name, *rest = operation or ["unused"]
        if name == "unused":
            value = None
        elif name == "const":
            value = float(rest[0])
        elif name == "word":
            value = int(rest[0], 16)
        elif name == "state":
            value = memory[rest[0]]
        elif name == "input":
            value = inputs[rest[0]]
        elif name == "lookup":
            value = float(rest[0][int(values[rest[1]])])
        elif name == "pick":
            value = float(rest[0][values[rest[1]] & 7])
        elif name == "product":
            value = [row(line, [values[i] for i in rest[1:]]) for line in rest[0]]
        elif name == "entry":
            value = values[rest[0]][rest[1]]
        elif name == "shift_left":
            value = values[rest[0]] << rest[1] & MASK
        elif name == "shift_right":
            value = values[rest[0]] >> rest[1]
        elif name == "rotate_left":
            value = (values[rest[0]] << rest[1] | values[rest[0]] >> (64 - rest[1])) & MASK
        else:
            value = CALCULATE[name](*(values[i] for i in rest))
        values.append(value)
    return [values[i] for i in part["next"]], [values[i] for i in part["results"]]


class DescribedNode:
    """A node of a description, for packets that arrive in time."""

    def __init__(self, described: Mapping[str, Any], kinds: Sequence[str]) -> None:
        """Start before the first step."""
        self.data, self.tick = described, -1
        self.memory = [
            int(one["start"], 16) if str(one["start"]).startswith("0x") else float(one["start"])
            for one in described["memory"]
        ]
        self.inputs = [0.0] * len(described["inputs"])
        self.counters = [one["start"] for one in described["counters"]]
        self.drawn = [int(word, 16) for word in described["draws"]["memory"]] if described["draws"] else []
        self.box: dict[tuple[int, int, int], Sent] = {}
        self.acknowledgement, self.sent = kinds.index("acknowledgement"), list[Sent]()

    def collect(self, part: int, tick: int) -> None:
        """Set the inputs of the packets that a part reads."""
        for one in self.data["receives"]:
            if one["part"] == part:
                found = self.box.pop((one["kind"], one["link"], tick - one["lag"]), None)
                values = (0.0,) * (1 + one["entries"]) if found is None else (1.0, *found.values)
                self.inputs[one["input"] : one["input"] + len(values)] = values
                if found is not None and one["acknowledge"]:
                    self.sent.append(Sent(self.acknowledgement, one["link"], found.tick, ()))

    def step(self, tick: int, y: Sequence[float], packets: Sequence[Sent]) -> tuple[list[Sent], tuple[float, ...]]:
        """Execute a step; return the packets to send, and the plant input."""
        data, self.sent = self.data, []
        self.box |= {(packet.kind, packet.link, packet.tick): packet for packet in packets}
        if len(data["parts"]) > 1 and tick > 0:
            self.collect(1, tick)
            second = data["parts"][1]
            self.memory, _ = run(second, self.memory, [self.inputs[i] for i in second["reads"]])
        for i, one in enumerate(data["counters"]):
            if tick > 0:
                self.counters[i] = one["next"][self.counters[i]]
            self.inputs[one["input"]] = float(self.counters[i])
        size = data["measurement"]
        self.inputs[: 2 * size] = [*map(float, y[:size]), *[1.0] * size]
        self.collect(0, tick)
        if data["draws"]:
            self.drawn, drawn = run(data["draws"], self.drawn, ())
            self.inputs[data["draws"]["input"] : data["draws"]["input"] + len(drawn)] = drawn
        first = data["parts"][0]
        self.memory, results = run(first, self.memory, [self.inputs[i] for i in first["reads"]])
        for one in data["sends"]:
            if results[one["output"]]:
                begin = one["output"] + 1
                self.sent.append(Sent(0, one["link"], tick, tuple(results[begin : begin + one["entries"]])))
        applied = data["applies"]
        begin = applied["output"] if applied else 0
        return self.sent, tuple(results[begin : begin + applied["entries"]]) if applied else ()
