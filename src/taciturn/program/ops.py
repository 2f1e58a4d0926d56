"""Operations of a program, and names of its inputs, states, sums and outputs.

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
    """One operation of a program: its name, and the indices of its operands."""

    name: str  # a name from the table above
    arguments: tuple[int, ...]  # indices of earlier operations, or literals

    @property
    def reads(self) -> tuple[int, ...]:
        """Indices of the operations whose values are operands of this operation."""
        literal = LITERAL.get(self.name)
        return self.arguments if literal is None else self.arguments[:literal] + self.arguments[literal + 1 :]


def needed(ops: Sequence[Op], roots: Sequence[int]) -> set[int]:
    """Find all operations that the operations ``roots`` need within one step."""
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
    """A state of a program: a number whose value is kept from one step to the next."""

    name: str  # the signal
    index: int  # entry of the signal
    start: float | tuple[str, int] = 0.0  # first value, or a key if the first value differs between paths
    word: bool = False  # whether it is a 64-bit word instead of a number


class Tile(NamedTuple):
    """Some rows of a matrix, without the columns in which all of these rows are zero."""

    # Every back end computes each row's sum from the left, starting at 0, so that all results are bit-identical.

    first: int  # first row
    rows: int  # number of rows
    begin: int  # first column
    end: int  # column after the last one


def tiles(matrix: MatrixRows) -> list[Tile]:
    """Split a matrix into tiles, which are blocks of rows, and omit tiles that are zero."""
    found: list[Tile] = []
    for first in range(0, len(matrix), _TILE):
        rows = matrix[first : first + _TILE]
        used = [j for j, column in enumerate(zip(*rows, strict=True)) if any(column)]
        found += [Tile(first, len(rows), used[0], used[-1] + 1)] if used else []
    return found


class Total(NamedTuple):
    """The sum factor·Σ op + offset·steps over time steps, where ``op`` is an operation of a program."""

    op: int  # index of the operation whose values are added up at each step
    factor: float  # applied once, after the last step
    offset: float  # added for each step, after the last step

    def of(self, added: Array, ticks: int) -> Array:
        """Compute this sum from ``added``, which is Σ op, and the number of steps."""
        return self.factor * added + self.offset * ticks


@dataclass(frozen=True)
class Entry:
    """Name of an entry of a signal that is an input, state or output of a program."""

    signal: str  # the signal, or a kind of random number
    index: int  # number of the entry, from 0
    link: str | None = None  # link whose packet contains the signal; None for a signal of the node itself
    piece: int = 0  # part of the step in which it holds, if packets arrive at random times within a step


@dataclass(frozen=True)
class Sent:
    """Name of the flag for a link and a step: 1 if a packet is sent, and 0 otherwise."""

    link: str


@dataclass(frozen=True)
class Arrived:
    """Name of the delay beyond its age of a packet of an age, in pieces: the piece of this step in which it arrives.

    It is as many or more than there are pieces if the packet has not arrived, or never will.
    """

    link: str
    age: int


@dataclass(frozen=True)
class Silence:
    """Name of the cost that a node adds in a step by not sending on the links on which it decides."""

    links: tuple[str, ...]


@dataclass(frozen=True)
class Option:
    """Name of the value of a trigger's option. It consists of the decision and the option's label."""

    decision: str
    label: str


@dataclass(frozen=True)
class Scalar:
    """The value of a scalar signal when a decision reads it."""

    decision: str
    signal: str


@dataclass(frozen=True)
class StepCounter:
    """Name of a discrete state that changes unconditionally in every step, such as the position in a schedule."""

    location: str


@dataclass(frozen=True)
class Control:
    """Name of a control variate: the normal number ``normal`` of a step times a state or another such number.

    The numbers −1 denote the one of ``analyse.every_sample``.
    """

    normal: int
    other: int | Entry


# A string names a single number. ``Received`` and ``Acknowledged`` name whether a packet arrived.
Name: TypeAlias = (
    str | Entry | Sent | Arrived | Silence | Received | Acknowledged | Option | Scalar | StepCounter | Control
)
Named: TypeAlias = Mapping[Name, int]  # operations by name


def named(signal: str, values: Iterable[int], link: str | None = None, piece: int = 0) -> dict[Name, int]:
    """Give names to the operations that compute the entries of a signal."""
    return {Entry(signal, i, link, piece): value for i, value in enumerate(values)}


def is_entry(name: Name, *signals: str) -> TypeGuard[Entry]:
    """Check whether a name is that of an entry of one of the given signals."""
    return isinstance(name, Entry) and name.link is None and name.signal in signals


def text_of(name: Name) -> str:
    """Write the name of an input, state, sum or output as text, for example as a key in the log of a node."""
    if isinstance(name, Entry):
        piece = f"in piece {name.piece}" if name.piece else None
        return " ".join(filter(None, (name.link, name.signal, str(name.index), piece)))
    if isinstance(name, Sent):
        return f"sent {name.link}"
    if isinstance(name, Received):
        return f"arrived {name.link}"
    if isinstance(name, Acknowledged):
        return f"acknowledged {name.link}"
    if isinstance(name, Arrived):
        return f"piece in which {name.link} of age {name.age} arrived"
    if isinstance(name, Option):
        return f"option {name.decision} {name.label}"
    if isinstance(name, Scalar):
        return f"{name.signal} in {name.decision}"
    if isinstance(name, StepCounter):
        return f"at {name.location}"
    return str(name)
