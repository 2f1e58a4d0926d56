"""Runs a program over many paths with NumPy, operation by operation: the meaning of a program, and the fallback.

Every operation rounds once, in the order of the program, so the printers' parity builds agree with it bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array
from taciturn.program.ir import Program
from taciturn.program.ops import EIGHT, WINDOW, Op, Rows, tiles

Value = npt.NDArray[Any]  # numbers, truth values, words or halves, one per path


def _shift_left(x: Value, k: int) -> Value:
    return x << x.dtype.type(k)


def _shift_right(x: Value, k: int) -> Value:
    return x >> x.dtype.type(k)


def _rotate_left(x: Value, k: int) -> Value:
    return _shift_left(x, k) | _shift_right(x, 8 * x.itemsize - k)


def _bits(x: Value) -> Value:
    return np.ascontiguousarray(x).view(f"u{x.itemsize}")


def _number(x: Value) -> Value:
    return np.ascontiguousarray(x).view(f"f{x.itemsize}")


def _upper(x: Value) -> Value:
    return (x >> np.uint64(32)).astype(np.uint32)


def _lower(x: Value) -> Value:
    return x.astype(np.uint32)


def _count(x: Value) -> Value:
    return x.astype(np.float32)


def _any_bit(x: Value) -> Value:
    return x != 0


def _divide(x: Value, y: Value) -> Value:
    with np.errstate(all="ignore"):  # lanes whose quotient is not used divide by what they like
        return np.divide(x, y)


_RULES: Mapping[str, Callable[..., Value]] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": _divide,
    "sqrt": np.sqrt,
    "select": np.where,
    "greater": np.greater,
    "less_equal": np.less_equal,
    "and": np.logical_and,
    "not": np.logical_not,
    "word_add": np.add,
    "word_and": np.bitwise_and,
    "word_or": np.bitwise_or,
    "word_xor": np.bitwise_xor,
    "shift_left": _shift_left,
    "shift_right": _shift_right,
    "rotate_left": _rotate_left,
    "bits": _bits,
    "number": _number,
    "upper": _upper,
    "lower": _lower,
    "count": _count,
    "any_bit": _any_bit,
}


@dataclass(frozen=True)
class Run:
    """What a run leaves: states (words as their 64 bits), sums and outputs.

    Args:
        states: value of each state after the last tick, (states, paths), doubles or the bits of words.
        sums: total of each sum over the ticks, (paths,), by name.
        outputs: record of each output, (ticks, paths), by name.
    """

    states: Array
    sums: Mapping[str, Array]
    outputs: Mapping[str, Array]


def run(program: Program, states: Array, ticks: int, inputs: Array | None = None) -> Run:
    """Run ``ticks`` ticks of a program on every path.

    Args:
        program: the program.
        states: value of each state at the first tick, (states, paths); words as the bits of doubles.
        ticks: number of ticks.
        inputs: what is supplied, (ticks, inputs, paths), if the program has inputs.

    Returns:
        The states after the last tick, the sums and the outputs.
    """
    paths = states.shape[1]
    kind = np.dtype(program.precision)
    tables = [np.array(table, dtype=kind) for table in program.tables]
    fixed = _fixed(program, paths)
    memory: list[Value] = [
        row.view(np.uint64) if state.word else row.astype(kind)
        for state, row in zip(program.states, states, strict=True)
    ]
    totals = program.totals
    added = {name: np.zeros(paths) for name in totals}
    window = {name: np.zeros(paths, dtype=kind) for name in totals}
    records = {name: np.empty((ticks, paths)) for name in program.outputs}
    for tick in range(ticks):
        values: list[Value] = []
        supplied = None if inputs is None else inputs[tick].astype(kind)
        for index, op in enumerate(program.ops):
            here = fixed[index] if index in fixed else _apply(op, values, memory, supplied, tables, program.matrices)
            values.append(here)
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
        row[:] = value.view(np.float64) if value.dtype == np.uint64 else value  # floats become doubles
    return Run(final, {name: total.of(added[name], ticks) for name, total in totals.items()}, records)


def _fixed(program: Program, paths: int) -> dict[int, Value]:
    fixed: dict[int, Value] = {}
    for index, op in enumerate(program.ops):
        if op.name == "const":
            fixed[index] = np.full(paths, program.constants[op.arguments[0]], dtype=program.precision)
        elif op.name in ("word", "half"):
            fixed[index] = np.full(paths, op.arguments[0], dtype=np.uint64 if op.name == "word" else np.uint32)
    return fixed


def _product(matrix: Rows, values: Sequence[Value]) -> Value:
    """Return the matrix times the values, (rows, paths)."""
    coefficients = np.array(matrix, dtype=values[0].dtype)
    result = np.zeros((len(matrix), len(values[0])), dtype=values[0].dtype)
    for tile in tiles(matrix):
        rows = slice(tile.first, tile.first + tile.rows)
        for j in range(tile.begin, tile.end):
            result[rows] += coefficients[rows, j, None] * values[j]
    return result


def _apply(
    op: Op,
    values: list[Value],
    memory: list[Value],
    supplied: Array | None,
    tables: list[Value],
    matrices: Sequence[Rows],
) -> Value:
    name, rest = op
    if name == "state":
        return memory[rest[0]]
    if name == "input":
        assert supplied is not None, "the program has inputs, and none are supplied"
        return supplied[rest[0]]
    if name == "product":
        return _product(matrices[rest[0]], [values[i] for i in rest[1:]])
    if name == "lookup":
        return tables[rest[0]][values[rest[1]].astype(np.int64)]
    if name == "pick":
        return tables[rest[0]][values[rest[1]] & np.uint64(EIGHT - 1)]
    if name == "entry":
        return values[rest[0]][rest[1]]
    if name in ("shift_left", "shift_right", "rotate_left"):
        return _RULES[name](values[rest[0]], rest[1])
    return _RULES[name](*(values[argument] for argument in rest))
