"""The operations of a program, and the names of the values that go into and come out of it.

An operation is a name with the indices of earlier operations, or with literals where the table below says so.
Values are numbers (doubles, or floats in single precision), truth values, 64-bit words, or half words of 32 bits.
Programs have no vectors of paths and no loops; the back ends add them.

| operation | arguments | result |
|---|---|---|
| `const` | index into `constants` | number |
| `state`, `input` | index into `states`, `inputs` | number, or word |
| `add` `sub` `mul` `div` `sqrt` | numbers | number; each operation rounds once |
| `select` | truth value, two numbers | number: the first if true, else the second |
| `lookup` | index into `tables`, a number that is a small integer | number |
| `pick` | index into `tables` of eight entries, word | number: the entry at the word's last three bits |
| `product` | index into `matrices`, numbers | vector: the matrix times the numbers |
| `entry` | vector, literal | number: an entry of the vector |
| `greater` `less_equal` | two numbers | truth value |
| `and` `not` | truth values | truth value |
| `word` / `half` | literal | word / half |
| `word_add` `word_and` `word_or` `word_xor` | two words, or two halves | word, or half |
| `shift_left` `shift_right` `rotate_left` | word or half, literal | word, or half |
| `upper` `lower` | word | half: the upper or lower one of the word |
| `count` | half | number: the half as an integer (single precision) |
| `narrow` | number | number: the nearest one of single precision |
| `bits` / `number` | number / word (double), half (single precision) | the same bits as a word or half / as a number |
| `any_bit` | word or half | truth value: not zero |
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias, TypeGuard

from taciturn._arrays import Array
from taciturn.model.steps import Acknowledged, Received

Precision = Literal["float64", "float32"]
_TILE = 8  # rows of a product that are computed together
WINDOW = 256  # steps that are summed in the precision of the program; the sums of windows are added as doubles
EIGHT = 8  # entries of a ``pick`` table, as many as the widest vector (AVX-512) has

LITERAL: Mapping[str, int] = {  # position (from 0) of the argument that is a literal, not an operation
    "const": 0, "state": 0, "input": 0, "word": 0, "half": 0, "lookup": 0, "pick": 0, "product": 0,
    "entry": 1, "shift_left": 1, "shift_right": 1, "rotate_left": 1,
}  # fmt: skip
MatrixRows = tuple[tuple[float, ...], ...]


class Op(NamedTuple):
    """One operation."""

    name: str  # a name from the table above
    arguments: tuple[int, ...]  # indices of earlier operations, or literals

    @property
    def reads(self) -> tuple[int, ...]:
        """Indices of the operations whose values this operation reads."""
        literal = LITERAL.get(self.name)
        return self.arguments if literal is None else self.arguments[:literal] + self.arguments[literal + 1 :]


def needed(ops: Sequence[Op], roots: Sequence[int]) -> set[int]:
    """Return all operations on which the operations ``roots`` depend within one step."""
    last = max(roots, default=-1)
    marks = bytearray(last + 1)
    for index in roots:
        marks[index] = 1
    # operations read earlier ones only, so one pass from the last to the first finds all
    for index in range(last, -1, -1):
        if marks[index]:
            name, arguments = ops[index]
            for argument in ops[index].reads if name in LITERAL else arguments:
                marks[argument] = 1
    return {index for index, mark in enumerate(marks) if mark}


@dataclass(frozen=True)
class State:
    """State variable of a program: one scalar that keeps its value from step to step."""

    name: str  # the signal
    index: int  # entry of the signal
    start: float | tuple[str, int] = 0.0  # first value, or a key if the first value differs between paths
    word: bool = False  # whether it is a 64-bit word instead of a number


class Tile(NamedTuple):
    """A block of a matrix: some rows, and the range of columns in which at least one of them is nonzero."""

    # Every back end computes each row's sum from the left, starting at 0, so that all results are bit-identical.

    first: int  # first row
    rows: int  # number of rows
    begin: int  # first column
    end: int  # column after the last one


def tiles(matrix: MatrixRows) -> list[Tile]:
    """Return the tiles (blocks of rows) of a matrix, without blocks of zero rows."""
    found: list[Tile] = []
    for first in range(0, len(matrix), _TILE):
        rows = matrix[first : first + _TILE]
        used = [j for j, column in enumerate(zip(*rows, strict=True)) if any(column)]
        found += [Tile(first, len(rows), used[0], used[-1] + 1)] if used else []
    return found


class Total(NamedTuple):
    """A sum over time steps of the form factor·Σ op + offset·steps, for an operation ``op`` of a program."""

    op: int  # index of the operation whose values are added up at each step
    factor: float  # applied once, after the last step
    offset: float  # added for each step, after the last step

    def of(self, added: Array, ticks: int) -> Array:
        """Return the value of this sum, given Σ op and the number of steps."""
        return self.factor * added + self.offset * ticks


@dataclass(frozen=True)
class Entry:
    """An entry of a signal."""

    signal: str  # the signal, or a kind of random number
    index: int  # number of the entry, from 0
    link: str | None = None  # link whose packet contains the signal; None for a signal of the node itself


@dataclass(frozen=True)
class Sent:
    """Whether a packet is sent on a link: 1 or 0."""

    link: str


@dataclass(frozen=True)
class Option:
    """The value of the form of an option in a trigger, by the decision and the label of the option."""

    decision: str
    label: str


@dataclass(frozen=True)
class StepCounter:
    """The value of a location that changes at each step without a condition, such as the phase of a schedule."""

    location: str


@dataclass(frozen=True)
class Control:
    """A control variate: the product of normal number ``normal`` of a step and a state, or another normal number."""

    normal: int
    other: int | Entry


# A string names a single number. ``Received`` and ``Acknowledged`` name whether a packet arrived.
Name: TypeAlias = str | Entry | Sent | Received | Acknowledged | Option | StepCounter | Control
Named: TypeAlias = Mapping[Name, int]  # operations by name


def named(signal: str, values: Iterable[int], link: str | None = None) -> dict[Name, int]:
    """Return the operations that compute the entries of a signal, by name."""
    return {Entry(signal, i, link): value for i, value in enumerate(values)}


def is_entry(name: Name, *signals: str) -> TypeGuard[Entry]:
    """Return whether a name is that of an entry of one of the given signals."""
    return isinstance(name, Entry) and name.link is None and name.signal in signals


def text_of(name: Name) -> str:
    """Return a name as text, for the description of a policy's nodes."""
    if isinstance(name, Entry):
        return " ".join(filter(None, (name.link, name.signal, str(name.index))))
    if isinstance(name, Sent):
        return f"sent {name.link}"
    if isinstance(name, Received):
        return f"arrived {name.link}"
    if isinstance(name, Acknowledged):
        return f"acknowledged {name.link}"
    if isinstance(name, Option):
        return f"option {name.decision} {name.label}"
    if isinstance(name, StepCounter):
        return f"at {name.location}"
    return str(name)
