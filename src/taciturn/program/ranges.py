"""Ranges in which the values of a program stay at every step, whatever finite numbers its inputs are.

The range of a value is an interval. Those of the states begin with their first values, or with those that they have
after the first steps. A step computes the ranges of all operations from those of the states, and each range of a state
is enlarged such that it contains the next value. This is repeated until no range changes any more: then it holds at
every step, by induction. A bound that still changes after some repetitions becomes infinite, so there is an end.

The bounds are computed with the operations of the program. Rounding to the nearest number is monotone, so a bound of
exact numbers, rounded, bounds the rounded numbers. A square is not negative, and a product of 0 and a finite number is
0; apart from that, it is ignored that two operands may depend on each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isnan, sqrt
from typing import NamedTuple

from taciturn.program.ir import Program
from taciturn.program.ops import Name, Op

_REPEATED = 8  # steps after which a bound that changes becomes infinite


class Range(NamedTuple):
    """The values from ``low`` to ``high``; for a truth value, 0 means false and 1 true."""

    low: float
    high: float

    def joined(self, other: Range) -> Range:
        """Return the least range that contains two ranges."""
        return Range(min(self.low, other.low), max(self.high, other.high))


ANY, UNDECIDED = Range(-inf, inf), Range(0.0, 1.0)


def ranges_of_sums(program: Program, starts: Sequence[float | None], first: int = 0) -> dict[Name, Range]:
    """Return the range of what each sum adds in every step from the step ``first`` on.

    ``starts`` are the first values of the states, None if one is unknown.
    """
    states, repeated = [ANY if start is None else Range(start, start) for start in starts], 0
    for _ in range(first):
        values = _step(program, states)
        states = [values[index] for index in program.following]
    while True:
        values = _step(program, states)
        larger = [state.joined(values[index]) for state, index in zip(states, program.following, strict=True)]
        if larger == states:
            return {name: values[index] for name, index in program.sums.items()}
        repeated += 1
        if repeated > _REPEATED:
            larger = [
                Range(new.low if new.low == old.low else -inf, new.high if new.high == old.high else inf)
                for new, old in zip(larger, states, strict=True)
            ]
        states = larger


def _step(program: Program, states: Sequence[Range]) -> list[Range]:
    """Return the range of each operation; that of a vector is in no use, because its entries are computed alone."""
    values: list[Range] = []
    for op in program.ops:
        first = op.arguments[0]
        if op.name == "const":
            values.append(Range(program.constants[first], program.constants[first]))
        elif op.name == "state":
            values.append(states[first])
        elif op.name == "entry":
            product = program.ops[first]
            row = program.matrices[product.arguments[0]][op.arguments[1]]
            values.append(_row(row, [values[i] for i in product.reads]))
        elif op.name in ("lookup", "pick"):
            values.append(_of_table(program.tables[first], op, values))
        else:
            values.append(_result(op, [values[i] for i in op.reads]))
    return values


def _row(row: Sequence[float], values: Sequence[Range]) -> Range:
    """Return the range of a row of a matrix times a vector, whose terms are added from the left."""
    total = Range(0.0, 0.0)
    for factor, value in zip(row, values, strict=True):
        total = _sum(total, _product(Range(factor, factor), value))
    return total


def _of_table(table: Sequence[float], op: Op, values: Sequence[Range]) -> Range:
    """Return the range of an entry of a table, which is one number if its place is known."""
    place = values[op.arguments[1]]
    if op.name == "lookup" and place.low == place.high:
        return Range(table[int(place.low)], table[int(place.low)])
    return Range(min(table), max(table))


def _result(op: Op, read: Sequence[Range]) -> Range:
    """Return the range of the result of an operation."""
    match op.name, read:
        case "add", (one, other):
            return _sum(one, other)
        case "sub", (one, other):
            return Range(0.0, 0.0) if len({*op.reads}) == 1 else _sum(one, Range(-other.high, -other.low))
        case "mul", (one, other):
            found = _product(one, other)
            return Range(max(found.low, 0.0), found.high) if len({*op.reads}) == 1 else found
        case "div", (one, other) if not other.low <= 0.0 <= other.high:
            return _corners([x / y for x in one for y in other])
        case "sqrt", (one,) if one.high >= 0.0:
            return Range(sqrt(max(one.low, 0.0)), sqrt(one.high))
        case "select", (truth, yes, no):
            return yes.joined(no) if truth == UNDECIDED else yes if truth.low else no
        case "greater", (one, other):
            return Range(float(one.low > other.high), float(one.high > other.low))
        case "less_equal", (one, other):
            return Range(float(one.high <= other.low), float(one.low <= other.high))
        case "and", (one, other):
            return Range(min(one.low, other.low), min(one.high, other.high))
        case "not", (one,):
            return Range(1.0 - one.high, 1.0 - one.low)
        case "any_bit", _:
            return UNDECIDED
        case _:  # inputs, words, and what is computed from them
            return ANY


def _sum(one: Range, other: Range) -> Range:
    return Range(one.low + other.low, one.high + other.high)


def _product(one: Range, other: Range) -> Range:
    return _corners([x * y if x and y else 0.0 for x in one for y in other])


def _corners(values: Sequence[float]) -> Range:
    """Return the range of an operation that is monotone in each operand, from its values at the ends."""
    return ANY if any(map(isnan, values)) else Range(min(values), max(values))
