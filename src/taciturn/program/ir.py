"""Straight-line programs for one time step of a loop or a node, in single-assignment form, and their builder.

``Builder`` collects operations. Equal ones are stored once, and what is known in advance is not computed: products with
zero and one, sums of nothing, rows of a matrix that are zero. Large constant matrices become one operation.
``Builder.finish`` merges states that agree at every step and removes operations without effect. The result is a
``Program``, the data that every back end reads.

States are merged as in the minimisation of automata. States with equal start values begin in one class. A class is
split if the next values of its states differ while each state is read from its class leader. At the fixed point, the
states of a class are equal at the start, and equal at step k + 1 if they are equal at step k; so they are always equal.
A program that became smaller is merged again: its operations may have been simplified.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import TypeVar

from taciturn.program.ops import EIGHT, LITERAL, MatrixRows, Name, Named, Op, Precision, State, Total, needed, tiles

BLOCK = 256  # least number of nonzero coefficients of a matrix that is multiplied in a loop instead of term by term
_FULL = 4  # least number of nonzero coefficients of a column that takes part in the loop
Coefficient = float | int  # a float is a known constant; an int is the index of an operation
Truth = int | bool  # an operation, or a truth value that is known during the translation

T = TypeVar("T", bound=Hashable)


@dataclass(frozen=True)
class Program:
    """Program for one time step: it computes next states, sums and outputs from states, inputs and constants."""

    ops: tuple[Op, ...]  # operations in order; each reads earlier ones only
    states: tuple[State, ...]  # scalars that keep their value from step to step
    following: tuple[int, ...]  # for each state, the operation that computes its next value
    inputs: tuple[Name, ...]  # names of the values supplied at each step
    constants: tuple[float, ...]  # values of the ``const`` operations
    tables: tuple[tuple[float, ...], ...]  # values of the ``lookup`` and ``pick`` operations
    sums: Named  # operations whose values are summed over the steps, by name
    outputs: Named  # operations whose values are recorded at each step, by name
    precision: Precision = "float64"  # precision of the numbers
    matrices: tuple[MatrixRows, ...] = ()  # matrices of the ``product`` operations

    @cached_property
    def operations(self) -> int:
        """Number of arithmetic operations per step. A matrix product counts with all its multiplications and
        additions.
        """
        single = sum(op.name not in ("const", "state", "input", "word", "half", "product", "entry") for op in self.ops)
        products = [self.matrices[op.arguments[0]] for op in self.ops if op.name == "product"]
        return single + sum(2 * tile.rows * (tile.end - tile.begin) for rows in products for tile in tiles(rows))

    @property
    def structure(self) -> Hashable:
        """Key that programs share if they differ only in their constants, so that one machine code runs all of them."""
        shapes = tuple(tuple(tiles(matrix)) for matrix in self.matrices)
        names = (tuple(self.sums.items()), tuple(self.outputs.items()))
        sizes = (len(self.constants), *(len(table) for table in self.tables))
        states = tuple(
            replace(state, start=0.0 if isinstance(state.start, float) else state.start) for state in self.states
        )
        return self.ops, states, self.following, self.inputs, names, sizes, shapes, self.precision

    @property
    def totals(self) -> dict[Name, Total]:
        """Sums over the steps, by name. Factor and offset of a sum, which are constant, apply after the last step."""
        return {name: self._total(index) for name, index in self.sums.items()}

    def _total(self, index: int) -> Total:
        # Σ(a·x + c) = a·Σx + c·steps: outer constants are removed one by one, so that a step adds up x alone
        factor, offset = 1.0, 0.0
        while True:
            op = self.ops[index]
            known = [self._known(i) for i in op.arguments] if op.name in ("mul", "add") else []
            number = next((value for value in known if value is not None), None)
            if number is None:
                return Total(index, factor, offset)
            if op.name == "mul":
                factor *= number
            else:
                offset += factor * number
            index = op.arguments[1 if known[0] is not None else 0]

    def _known(self, index: int) -> float | None:
        return self.constants[self.ops[index].arguments[0]] if self.ops[index].name == "const" else None

    def keep(
        self, sums: Set[Name] = frozenset(), outputs: Set[Name] = frozenset(), states: Set[str] = frozenset()
    ) -> Program:
        """Reduce the program to the named sums, outputs and states, and the operations that these need."""
        kept_sums = {name: index for name, index in self.sums.items() if name in sums}
        kept_outputs = {name: index for name, index in self.outputs.items() if name in outputs}
        smaller = replace(self, sums=kept_sums, outputs=kept_outputs)
        # every state leads its own class, since ``finish`` has merged the states that agree
        return _pruned(smaller, range(len(self.states)), states)


class Builder:
    """Collects the operations of one time step, stores equal operations once, and builds a program from them."""

    def __init__(self, precision: Precision = "float64") -> None:
        """Start without operations."""
        self.precision: Precision = precision
        self.ops: list[Op] = []
        self.constants: list[float] = []
        self.tables: list[tuple[float, ...]] = []
        self.matrices: list[MatrixRows] = []
        self.states: list[State] = []
        self.inputs: list[Name] = []
        self.known: dict[tuple[str, tuple[int, ...]], int] = {}
        self._constants: dict[float | str, int] = {}  # the operation that gives each constant
        self._places: dict[Hashable, int] = {}  # of states, inputs, tables and matrices in their lists

    def emit(self, name: str, *arguments: int) -> int:
        """Return the index of an operation. The operation is added unless an equal one exists."""
        new = len(self.ops)
        found = self.known.setdefault((name, arguments), new)
        if found == new:
            self.ops.append(Op(name, arguments))
        return found

    def constant(self, value: float) -> int:
        """Return the index of the operation whose value is the constant ``value``."""
        key = float(value) or str(value)  # 0.0 == −0.0, but the two constants have different bits
        if key not in self._constants:
            self.constants.append(float(value))
            self._constants[key] = self.emit("const", len(self.constants) - 1)
        return self._constants[key]

    def state(self, state: State) -> int:
        """Return the index of the operation that reads a state. A new state is declared."""
        return self.emit("state", self._place(self.states, state))

    def input(self, name: Name) -> int:
        """Return the index of the operation that reads a named input. The caller of the program gives its value in each
        step.
        """
        return self.emit("input", self._place(self.inputs, name))

    def lookup(self, values: Sequence[float], index: int) -> Coefficient:
        """Look up the entry ``values[index]`` of a table. If all entries are equal, their value becomes a constant."""
        if len(set(values)) == 1:
            return float(values[0])
        return self.emit("lookup", self._table(values), index)

    def pick(self, values: Sequence[float], word: int) -> int:
        """Select an entry of a table of eight by the last three bits of a word."""
        assert len(values) == EIGHT
        return self.emit("pick", self._table(values), word)

    def _table(self, values: Sequence[float]) -> int:
        """Return the index of a table, and store the table if it is new."""
        return self._place(self.tables, tuple(float(value) for value in values))

    def _place(self, listed: list[T], one: T) -> int:
        """Return the place of an entry in its list, where it is appended if it is new."""
        found = self._places.setdefault((id(listed), one), len(listed))
        if found == len(listed):
            listed.append(one)
        return found

    def value(self, coefficient: Coefficient | None) -> int:
        """Return the index of the operation whose value is a coefficient. None, the empty sum, has the value 0."""
        if isinstance(coefficient, int):
            return coefficient
        return self.constant(0.0 if coefficient is None else coefficient)

    def scale(self, coefficient: Coefficient, x: int) -> int:
        """Return coefficient · x."""
        if x == self.constant(1.0):
            return self.value(coefficient)
        return x if equals(coefficient, 1.0) else self.emit("mul", self.value(coefficient), x)

    def add(self, *terms: int | None) -> int | None:
        """Add all terms that are not None, from left to right. Return None if all are None."""
        total: int | None = None
        for term in terms:
            if term is not None:
                total = term if total is None else self.emit("add", total, term)
        return total

    def combine(self, coefficients: Sequence[Coefficient], values: Sequence[int]) -> int | None:
        """Compute Σ coefficient·value from left to right. Return None if all coefficients are zero."""
        # a single chain of sums, which become fused multiply-adds in the fast build; two half chains were 6 % slower
        total: int | None = None
        for coefficient, value in zip(coefficients, values, strict=True):
            if equals(coefficient, 0.0):
                continue
            if total is not None and equals(coefficient, -1.0):
                total = self.emit("sub", total, value)
            else:
                total = self.add(total, self.scale(coefficient, value))
        return total

    def transform(self, matrix: Sequence[Sequence[Coefficient]], values: Sequence[int]) -> list[int | None]:
        """Multiply a matrix by a vector: row by row or, if the matrix is large and constant, with one operation."""
        # M v = M_full v_full (one product) + M_few v_few: columns with few coefficients are cheaper term by term
        full = [sum(not equals(c, 0.0) for c in column) >= _FULL for column in zip(*matrix, strict=True)]
        rows = tuple(tuple(c for c in compress(row, full) if isinstance(c, float)) for row in matrix)
        known = all(len(row) == sum(full) for row in rows)
        if not known or sum(c != 0.0 for row in rows for c in row) < BLOCK:
            return [self.combine(row, values) for row in matrix]
        vector, few = self.product(rows, list(compress(values, full))), [not is_full for is_full in full]
        alone = [self.combine(list(compress(row, few)), list(compress(values, few))) for row in matrix]
        return [
            self.add(self.emit("entry", vector, i) if any(row) else None, rest)
            for i, (row, rest) in enumerate(zip(rows, alone, strict=True))
        ]

    def product(self, rows: MatrixRows, values: Sequence[int]) -> int:
        """Multiply a constant matrix by a vector, as one operation of the program."""
        return self.emit("product", self._place(self.matrices, rows), *values)

    def polynomial(self, coefficients: Sequence[float], x: int) -> int:
        """Evaluate the polynomial Σ coefficient·x^i by Horner's rule, with one multiplication and one addition per
        power.
        """
        total = self.constant(coefficients[-1])
        for coefficient in coefficients[-2::-1]:
            total = self.emit("add", self.emit("mul", total, x), self.constant(coefficient))
        return total

    def quadratic(self, Psi: Sequence[Sequence[Coefficient]], values: Sequence[int]) -> int | None:
        """Compute v'Ψv for a symmetric matrix Ψ. Return None if Ψ is zero."""
        # v'Ψv = Σ_i v_i (Ψ_ii v_i + Σ_{j>i} 2Ψ_ij v_j): the upper triangle holds every pair once.
        # Rows without off-diagonal terms are grouped by weight: ψ v_1² + ψ v_2² = ψ (v_1² + v_2²).
        alone: dict[int, list[int]] = {}
        mixed: list[tuple[int, list[Coefficient]]] = []  # a list, since the same value may occur more than once
        total: int | None = None
        for i, value in enumerate(values):
            row = [
                c if j == i else 2.0 * c if isinstance(c, float) else self.emit("add", c, c)
                for j, c in enumerate(Psi[i][i:], start=i)
            ]
            if all(equals(c, 0.0) for c in row):
                continue
            if all(equals(c, 0.0) for c in row[1:]):
                alone.setdefault(self.value(row[0]), []).append(self.emit("mul", value, value))
            else:
                mixed.append((value, [0.0] * i + row))
        for (value, _), inner in zip(mixed, self.transform([row for _, row in mixed], values), strict=True):
            total = self.add(total, None if inner is None else self.emit("mul", inner, value))
        one = self.constant(1.0)
        for weight, squares in alone.items():
            square = self.add(*squares)
            assert square is not None
            total = self.add(total, square if weight == one else self.emit("mul", weight, square))
        return total

    def choose(self, truth: Truth, yes: int, no: int) -> int:
        """Select the number ``yes`` if ``truth`` is true, and ``no`` otherwise."""
        if isinstance(truth, bool):
            return yes if truth else no
        if yes == no:
            return yes
        # (t ? c·x : 0) = c·(t ? x : 0): a constant factor outside can be applied to a sum once (``Program.totals``)
        op, zero = self.ops[yes], self.constant(0.0)
        if no == zero and op.name == "mul" and self.ops[op.arguments[0]].name == "const":
            return self.emit("mul", op.arguments[0], self.emit("select", truth, op.arguments[1], zero))
        return self.emit("select", truth, yes, no)

    def both(self, one: Truth, other: Truth) -> Truth:
        """Return the logical AND of two truth values."""
        if isinstance(one, bool):
            return one and other
        if isinstance(other, bool):
            return other and one
        return self.emit("and", one, other)

    def either(self, one: Truth, other: Truth) -> Truth:
        """Return the logical OR of two truth values."""
        if isinstance(one, bool):
            return one or other
        if isinstance(other, bool):
            return other or one
        return self.negated(self.both(self.negated(one), self.negated(other)))

    def negated(self, truth: Truth) -> Truth:
        """Return the logical NOT of a truth value."""
        if isinstance(truth, bool):
            return not truth
        op = self.ops[truth]
        return op.arguments[0] if op.name == "not" else self.emit("not", truth)

    def less_equal(self, one: Coefficient, other: Coefficient) -> Truth:
        """Return the truth value of one ≤ other."""
        return self.emit("less_equal", self.value(one), self.value(other))

    def greater(self, one: Coefficient, other: Coefficient) -> Truth:
        """Return the truth value of one > other."""
        return self.emit("greater", self.value(one), self.value(other))

    def finish(self, following: Sequence[int], sums: Named, outputs: Named | None = None) -> Program:
        """Build the program: merge equal states, and remove operations without effect."""
        return merge_states(self.collect(following, sums, outputs or {}))

    def collect(self, following: Sequence[int], sums: Named, outputs: Named) -> Program:
        """Build the program from the collected operations, without simplifying it."""
        return Program(
            tuple(self.ops),
            tuple(self.states),
            tuple(following),
            tuple(self.inputs),
            tuple(self.constants),
            tuple(self.tables),
            dict(sums),
            dict(outputs),
            self.precision,
            tuple(self.matrices),
        )


def rebuild(program: Program, substitute: Callable[[Builder, Op], int | None], states: Sequence[int]) -> Program:
    """Copy a program with only the given states. ``substitute`` may replace operations that read states or inputs."""
    roots = [program.following[i] for i in states] + list(program.sums.values()) + list(program.outputs.values())
    live = sorted(needed(program.ops, roots))
    builder = Builder(program.precision)
    for i in states:  # declared first, so that their order does not depend on the order of reading
        builder.state(program.states[i])
    new, chosen = [0] * len(program.ops), False
    known, ops = builder.known, builder.ops
    for index in live:
        op = program.ops[index]
        name, arguments = op
        if name in LITERAL:
            replaced = substitute(builder, op) if name in ("state", "input") else None
            new[index] = _copy(program, builder, op, new) if replaced is None else replaced
        else:  # the common case: as ``emit``, which takes twice as long
            moved = tuple([new[argument] for argument in arguments])
            if name == "select" and moved[1] == moved[2]:  # of states that have been merged
                new[index], chosen = moved[1], True
                continue
            new[index] = found = known.setdefault((name, moved), len(ops))
            if found == len(ops):
                ops.append(op if moved == arguments else Op(name, moved))
    following = [new[program.following[i]] for i in states]
    sums = {name: new[index] for name, index in program.sums.items()}
    found = builder.collect(following, sums, {name: new[index] for name, index in program.outputs.items()})
    # without the truth value of the choice, if nothing else needs it
    return rebuild(found, lambda builder, op: None, range(len(states))) if chosen else found


def joined(
    first: Program,
    second: Program,
    sums: Mapping[Name, tuple[Name | None, Name, float]],
    states: Set[str] = frozenset(),
) -> Program:
    """Return two programs as one, with the same inputs and the sums of the first.

    ``sums`` adds sums: a sum of the first, or nothing, minus a sum of the second, plus a constant. ``states`` names
    states that are kept without effect; those that agree with others at every step are merged nevertheless.
    """
    builder, places = Builder(first.precision), list[list[int]]()
    for state in (*first.states, *second.states):  # of different names
        builder.state(state)
    for program in (first, second):
        new = list[int]()
        for op in program.ops:
            moved = tuple(new[argument] for argument in op.arguments) if op.name not in LITERAL else ()
            new.append(builder.emit(op.name, *moved) if moved else _copy(program, builder, op, new))
        places.append(new)
    one, other = places
    following = [*(one[i] for i in first.following), *(other[i] for i in second.following)]
    found = {name: one[index] for name, index in first.sums.items()}
    for name, (minuend, subtrahend, constant) in sums.items():
        before = builder.constant(constant) if minuend is None else one[first.sums[minuend]]
        found[name] = builder.emit("sub", before, other[second.sums[subtrahend]])
    outputs = {name: one[index] for name, index in first.outputs.items()}
    return merge_states(builder.collect(following, found, outputs), states)


def merge_states(program: Program, wanted: Set[str] = frozenset()) -> Program:
    """Merge the states of a program that are always equal, and remove states without effect that are not wanted."""
    leader = _leaders(program)
    while True:
        found = _pruned(program, leader, wanted)
        if (len(found.states), len(found.ops)) == (len(program.states), len(program.ops)):
            return found
        program, leader = found, _leaders(found)
        if leader == list(range(len(found.states))) and _necessary(found, wanted):
            return found


def _necessary(program: Program, wanted: Set[str]) -> bool:
    """Return whether a program without equal states needs all of its states and operations, but for wanted states."""
    kept = {i for i, state in enumerate(program.states) if state.name in wanted}
    alive = _alive(program, range(len(program.states)), kept)
    roots = [*program.following, *program.sums.values(), *program.outputs.values()]
    return len(alive) == len(program.states) and len(needed(program.ops, roots)) == len(program.ops)


def _leaders(program: Program) -> list[int]:
    """Return the leader of the class of each state, as the operations are written."""
    starts: dict[object, int] = {}
    leader = [starts.setdefault((state.start, state.word), i) for i, state in enumerate(program.states)]
    live = sorted(needed(program.ops, program.following))
    while True:
        same = _same_values(program, live, leader)
        classes: dict[tuple[int, int], int] = {}
        split = [classes.setdefault((leader[i], same[op]), i) for i, op in enumerate(program.following)]
        if split == leader:
            return leader
        leader = split


def _same_values(program: Program, live: Sequence[int], leader: Sequence[int]) -> list[int]:
    """Return for each live operation the first operation of equal value, assuming that states equal their leaders."""
    same, known = list(range(len(program.ops))), dict[tuple[str, tuple[int, ...]], int]()
    for index in live:
        name, arguments = program.ops[index]
        if name == "state":
            arguments = (leader[arguments[0]],)
        elif name in LITERAL:
            arguments = tuple([a if i == LITERAL[name] else same[a] for i, a in enumerate(arguments)])
        else:  # the common case
            arguments = tuple([same[a] for a in arguments])
            if name == "select" and arguments[1] == arguments[2]:  # such as a state that a packet repeats
                same[index] = arguments[1]
                continue
        same[index] = known.setdefault((name, arguments), index)
    return same


def _pruned(program: Program, leader: Sequence[int], wanted: Set[str] = frozenset()) -> Program:
    """Return a program that reads each state from its leader, without states that are neither needed nor wanted."""
    alive = _alive(program, leader, {leader[i] for i, state in enumerate(program.states) if state.name in wanted})
    places = {old: new for new, old in enumerate(alive)}

    def led(builder: Builder, op: Op) -> int | None:
        return builder.emit("state", places[leader[op.arguments[0]]]) if op.name == "state" else None

    return rebuild(program, led, alive)


def _alive(program: Program, leader: Sequence[int], alive: set[int]) -> list[int]:
    """Return the states on which sums, outputs and the given states depend, over any number of steps."""
    roots = [*program.sums.values(), *program.outputs.values(), *(program.following[i] for i in alive)]
    seen: set[int] = set()
    while roots:
        index = roots.pop()
        if index in seen:
            continue
        seen.add(index)
        op = program.ops[index]
        name, arguments = op
        if name != "state":
            roots += op.reads if name in LITERAL else arguments
        elif (state := leader[arguments[0]]) not in alive:
            alive.add(state)
            roots.append(program.following[state])
    return sorted(alive)


def _copy(program: Program, builder: Builder, op: Op, new: Sequence[int]) -> int:
    first = op.arguments[0]
    if op.name == "const":
        return builder.constant(program.constants[first])
    if op.name == "lookup":
        return builder.value(builder.lookup(program.tables[first], new[op.arguments[1]]))
    if op.name == "pick":
        return builder.pick(program.tables[first], new[op.arguments[1]])
    if op.name == "product":
        return builder.product(program.matrices[first], [new[value] for value in op.reads])
    if op.name == "state":
        return builder.state(program.states[first])
    if op.name == "input":
        return builder.input(program.inputs[first])
    return builder.emit(op.name, *(a if i == LITERAL[op.name] else new[a] for i, a in enumerate(op.arguments)))


def equals(coefficient: Coefficient, number: float) -> bool:
    """Return whether a coefficient is a constant that equals the given number."""
    return isinstance(coefficient, float) and coefficient == number
