"""The operations of a program.

An operation is a name with the indices of earlier operations (or literals, where the table below says so).
Values are numbers (doubles, or floats in single precision), truth values, 64-bit words, or half words of 32 bits;
vectors and loops belong to the printers, not to the program.

| operation | arguments | result |
|---|---|---|
| `const` | index into `constants` | number |
| `state`, `input` | index into `states`, `inputs` | number, or word |
| `add` `sub` `mul` `div` `sqrt` | numbers | number, rounded once each: the order is the meaning |
| `select` | truth value, two numbers | the first where true |
| `lookup` | index into `tables`, a number that is a small integer | number |
| `pick` | index into `tables` of eight entries, word | number: the entry at the word's last three bits |
| `product` | index into `matrices`, numbers | vector: the matrix times the numbers |
| `entry` | vector, literal | number: its entry |
| `greater` `less_equal` | two numbers | truth value |
| `and` `not` | truth values | truth value |
| `word` / `half` | literal | word / half |
| `word_add` `word_and` `word_or` `word_xor` | two words, or two halves | the same |
| `shift_left` `shift_right` `rotate_left` | word or half, literal | the same |
| `upper` `lower` | word | its half |
| `count` | half | number, the integer it holds (single precision) |
| `narrow` | number | the nearest number of single precision |
| `bits` / `number` | number / word (double), half (single precision) | the same bits as a word or half / as a number |
| `any_bit` | word or half | truth value: not zero |
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

from taciturn._arrays import Array

Precision = Literal["float64", "float32"]
TILE = 8  # rows of a product that are computed side by side
WINDOW = 256  # ticks whose sum is kept in the precision of the program; sums of windows are doubles
EIGHT = 8  # entries that a word can pick from: one vector of the widest kind

LITERAL: Mapping[str, int] = {  # position (from 0) of the argument that is no operation
    "const": 0,
    "state": 0,
    "input": 0,
    "word": 0,
    "half": 0,
    "lookup": 0,
    "pick": 0,
    "product": 0,
    "entry": 1,
    "shift_left": 1,
    "shift_right": 1,
    "rotate_left": 1,
}


class Op(NamedTuple):
    """One operation.

    Args:
        name: what it does.
        arguments: indices of earlier operations, or literals.
    """

    name: str
    arguments: tuple[int, ...]

    @property
    def reads(self) -> tuple[int, ...]:
        """The operations that this one reads."""
        literal = LITERAL.get(self.name)
        return self.arguments if literal is None else self.arguments[:literal] + self.arguments[literal + 1 :]


@dataclass(frozen=True)
class State:
    """One scalar of memory.

    Args:
        name: the signal.
        index: entry of the signal.
        start: key of its first value; states with equal keys start equal.
        word: whether it is a 64-bit word.
    """

    name: str
    index: int
    start: float | tuple[str, int] = 0.0
    word: bool = False


class Tile(NamedTuple):
    """Some rows of a matrix, and the columns from the first to the last where one of them is not zero.

    The rows times the numbers of these columns are added up from the left, to 0.

    Args:
        first: row.
        rows: how many.
        begin: first column.
        end: column after the last.
    """

    first: int
    rows: int
    begin: int
    end: int


Rows = tuple[tuple[float, ...], ...]


def tiles(matrix: Rows) -> list[Tile]:
    """Return a matrix as tiles; rows of zeros alone are in none."""
    found: list[Tile] = []
    for first in range(0, len(matrix), TILE):
        rows = matrix[first : first + TILE]
        used = [j for j, column in enumerate(zip(*rows, strict=True)) if any(column)]
        found += [Tile(first, len(rows), used[0], used[-1] + 1)] if used else []
    return found


class Total(NamedTuple):
    """How a sum is made of the operation that is added up at each tick: factor·Σ + offset·ticks.

    Args:
        op: index of the operation.
        factor: by which the sum is multiplied at the end.
        offset: added for each tick, at the end.
    """

    op: int
    factor: float
    offset: float

    def of(self, added: Array, ticks: int) -> Array:
        """Return the sum, given what was added up in so many ticks."""
        return self.factor * added + self.offset * ticks
