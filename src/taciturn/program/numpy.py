"""Execution of a program on many simulated paths with NumPy: the reference back end, used if llvmlite is missing.

Each operation rounds once, in the order of the program. The bit-exact builds are bit-identical to it. The sums of
``WINDOW`` steps have the precision of the program, and the sums of windows are added as doubles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array
from taciturn.program.ir import Program
from taciturn.program.ops import EIGHT, WINDOW, Name, Op, Tile, tiles

Value = npt.NDArray[Any]  # numbers, truth values, words or halves, one per path
_GIVEN = ("const", "word", "half", "state", "input")  # operations without a computation


@dataclass(frozen=True, eq=False)
class Run:
    """Result of a program that has run for some steps: its states, sums and outputs."""

    states: Array  # states after the last step, as doubles; words are reinterpreted as doubles, (states, paths)
    sums: Mapping[Name, Array]  # sums over the steps by name, (paths,) each
    outputs: Mapping[Name, Array]  # outputs at each step by name, (steps, paths) each


@np.errstate(all="ignore")  # branches that a selection discards may divide by zero
def run(program: Program, states: Array, ticks: int, inputs: Array | None = None) -> Run:
    """Run a program for ``ticks`` steps of all simulated paths, with NumPy."""
    assert inputs is not None or not program.inputs, "the program has inputs, and none are supplied"
    paths = states.shape[1]
    kind = np.dtype(program.precision)
    fixed = _fixed(program, paths)
    read = [(index, op) for index, op in enumerate(program.ops) if op.name in ("state", "input")]
    rules = [(i, _rule(op, program), op.reads) for i, op in enumerate(program.ops) if op.name not in _GIVEN]
    memory: list[Value] = [
        row.view(np.uint64) if state.word else row.astype(kind)
        for state, row in zip(program.states, states, strict=True)
    ]
    totals = program.totals
    added = {name: np.zeros(paths) for name in totals}
    window = {name: np.zeros(paths, dtype=kind) for name in totals}
    records = {name: np.empty((ticks, paths)) for name in program.outputs}
    for tick in range(ticks):
        values = fixed.copy()
        supplied = None if inputs is None else inputs[tick].astype(kind)
        for index, (name, (place,)) in read:
            values[index] = memory[place] if supplied is None or name == "state" else supplied[place]
        for index, rule, reads in rules:
            values[index] = rule(*[values[i] for i in reads])
        for name, total in totals.items():
            window[name] = window[name] + values[total.op]
            if (tick + 1) % WINDOW == 0 or tick + 1 == ticks:
                added[name] += window[name]
                window[name] = np.zeros(paths, dtype=kind)
        for name, index in program.outputs.items():
            records[name][tick] = values[index]
        memory = [values[index] for index in program.following]
    final = np.empty((len(memory), paths))
    for row, value in zip(final, memory, strict=True):
        row[:] = value.view(np.float64) if value.dtype == np.uint64 else value  # floats are converted to doubles
    return Run(final, {name: total.of(added[name], ticks) for name, total in totals.items()}, records)


def _fixed(program: Program, paths: int) -> list[Value]:
    """Return the values of all operations, by index: constants, and empty arrays for other operations."""
    fixed: list[Value] = [np.empty(0)] * len(program.ops)
    for index, (name, rest) in enumerate(program.ops):
        if name == "const":
            fixed[index] = np.full(paths, program.constants[rest[0]], dtype=program.precision)
        elif name in ("word", "half"):
            fixed[index] = np.full(paths, rest[0], dtype=np.uint64 if name == "word" else np.uint32)
    return fixed


def _rule(op: Op, program: Program) -> Callable[..., Value]:
    """Return the function that computes an operation's value from the values that it reads."""
    name, rest = op
    if name == "product":
        matrix = program.matrices[rest[0]]
        return partial(_product, np.array(matrix, dtype=program.precision), tiles(matrix))
    if name in _OF_TABLES:
        return partial(_OF_TABLES[name], np.array(program.tables[rest[0]], dtype=program.precision))
    if name in _WITH_LITERAL:
        return partial(_WITH_LITERAL[name], k=rest[1])
    return _OF_ONE[name] if name in _OF_ONE else _RULES[name]


def _product(matrix: Value, parts: Sequence[Tile], *values: Value) -> Value:
    """Return the matrix times the values, (rows, paths)."""
    # tile by tile and column by column from 0, as in every back end, so that the sums are bit-identical
    result = np.zeros((len(matrix), len(values[0])), dtype=matrix.dtype)
    for tile in parts:
        rows = slice(tile.first, tile.first + tile.rows)
        for j in range(tile.begin, tile.end):
            result[rows] += matrix[rows, j, None] * values[j]
    return result


def _shift_left(x: Value, k: int) -> Value:
    return x << x.dtype.type(k)


def _shift_right(x: Value, k: int) -> Value:
    return x >> x.dtype.type(k)


def _rotate_left(x: Value, k: int) -> Value:
    return _shift_left(x, k) | _shift_right(x, 8 * x.itemsize - k)


def _entry(vector: Value, k: int) -> Value:
    return vector[k]


_RULES: Mapping[str, Callable[..., Value]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "sqrt": np.sqrt, "select": np.where,
    "greater": np.greater, "less_equal": np.less_equal, "and": np.logical_and, "not": np.logical_not,
    "word_add": np.add, "word_and": np.bitwise_and, "word_or": np.bitwise_or, "word_xor": np.bitwise_xor,
}  # fmt: skip
_OF_ONE: Mapping[str, Callable[[Value], Value]] = {
    "narrow": lambda x: x.astype(np.float32).astype(x.dtype),
    "bits": lambda x: np.ascontiguousarray(x).view(f"u{x.itemsize}"),
    "number": lambda x: np.ascontiguousarray(x).view(f"f{x.itemsize}"),
    "upper": lambda word: (word >> np.uint64(32)).astype(np.uint32),
    "lower": lambda word: word.astype(np.uint32),
    "count": lambda half: half.astype(np.float32),
    "any_bit": lambda word: word != 0,
}
_OF_TABLES: Mapping[str, Callable[[Value, Value], Value]] = {
    "lookup": lambda table, x: table[x.astype(np.int64)],
    "pick": lambda table, word: table[word & np.uint64(EIGHT - 1)],
}
_WITH_LITERAL: Mapping[str, Callable[..., Value]] = {
    "entry": _entry, "shift_left": _shift_left, "shift_right": _shift_right, "rotate_left": _rotate_left,
}  # fmt: skip
