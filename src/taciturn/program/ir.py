"""Straight-line programs of one time step of a loop or a node, in single-assignment form, and their builder.

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

from collections.abc import Callable, Hashable, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress

from taciturn.program.ops import EIGHT, LITERAL, MatrixRows, Name, Named, Op, Precision, State, Total, needed, tiles

BLOCK = 256  # least number of nonzero coefficients of a matrix that is multiplied in a loop instead of term by term
_FULL = 4  # least number of nonzero coefficients of a column that takes part in the loop
Coefficient = float | int  # a float is a known constant; an int is the index of an operation
Truth = int | bool  # an operation, or a truth value that is known during the translation


@dataclass(frozen=True)
class Program:
    """Program of one time step, which maps states, inputs and constants to next states, sums and outputs."""

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
        """Number of arithmetic operations in one step; a matrix product counts its multiplications and additions."""
        single = sum(op.name not in ("const", "state", "input", "word", "half", "product", "entry") for op in self.ops)
        products = [self.matrices[op.arguments[0]] for op in self.ops if op.name == "product"]
        return single + sum(2 * tile.rows * (tile.end - tile.begin) for rows in products for tile in tiles(rows))

    @property
    def structure(self) -> Hashable:
        """Key that is the same for programs that differ only in their constants, so that these can run together."""
        shapes = tuple(tuple(tiles(matrix)) for matrix in self.matrices)
        names = (tuple(self.sums.items()), tuple(self.outputs.items()))
        sizes = (len(self.constants), *(len(table) for table in self.tables))
        states = tuple(
            replace(state, start=0.0 if isinstance(state.start, float) else state.start) for state in self.states
        )
        return self.ops, states, self.following, self.inputs, names, sizes, shapes, self.precision

    @property
    def totals(self) -> dict[Name, Total]:
        """Sums over steps, each with a constant factor and term that are applied once, after the last step."""
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
        """Return the program reduced to given sums, outputs and states, and to the operations that these need."""
        kept_sums = {name: index for name, index in self.sums.items() if name in sums}
        kept_outputs = {name: index for name, index in self.outputs.items() if name in outputs}
        smaller = replace(self, sums=kept_sums, outputs=kept_outputs)
        # every state leads its own class, since ``finish`` has merged the states that agree
        return _pruned(smaller, range(len(self.states)), states)


class Builder:
    """Builder of a program: collects the operations of one time step, and stores equal operations once."""

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
        self._constant_index: dict[float | str, int] = {}

    def emit(self, name: str, *arguments: int) -> int:
        """Return the index of an operation; the operation is added if no equal one exists."""
        new = len(self.ops)
        found = self.known.setdefault((name, arguments), new)
        if found == new:
            self.ops.append(Op(name, arguments))
        return found

    def constant(self, value: float) -> int:
        """Return the index of the operation that gives a constant."""
        key = float(value) or str(value)  # 0.0 == −0.0, but the two constants have different bits
        if key not in self._constant_index:
            self._constant_index[key] = len(self.constants)
            self.constants.append(float(value))
        return self.emit("const", self._constant_index[key])

    def state(self, state: State) -> int:
        """Return the operation that reads a state at the start of the step; a new state is declared."""
        if state not in self.states:
            self.states.append(state)
        return self.emit("state", self.states.index(state))

    def input(self, name: Name) -> int:
        """Return the operation that reads the input with a given name, whose value is supplied at each step."""
        if name not in self.inputs:
            self.inputs.append(name)
        return self.emit("input", self.inputs.index(name))

    def lookup(self, values: Sequence[float], index: int) -> Coefficient:
        """Return the table entry values[index], or a constant if all values are equal."""
        if len(set(values)) == 1:
            return float(values[0])
        return self.emit("lookup", self._table(values), index)

    def pick(self, values: Sequence[float], word: int) -> int:
        """Return the entry of an eight-entry table that the last three bits of a word select."""
        assert len(values) == EIGHT
        return self.emit("pick", self._table(values), word)

    def _table(self, values: Sequence[float]) -> int:
        """Return the index of a table, and store the table if it is new."""
        row = tuple(float(value) for value in values)
        if row not in self.tables:
            self.tables.append(row)
        return self.tables.index(row)

    def value(self, coefficient: Coefficient | None) -> int:
        """Return the operation that gives the value of a coefficient; an empty sum (None) is 0."""
        if isinstance(coefficient, int):
            return coefficient
        return self.constant(0.0 if coefficient is None else coefficient)

    def scale(self, coefficient: Coefficient, x: int) -> int:
        """Return coefficient · x."""
        if x == self.constant(1.0):
            return self.value(coefficient)
        return x if equals(coefficient, 1.0) else self.emit("mul", self.value(coefficient), x)

    def add(self, *terms: int | None) -> int | None:
        """Return the sum of all terms that are not None, added from the left; None if all terms are None."""
        total: int | None = None
        for term in terms:
            if term is not None:
                total = term if total is None else self.emit("add", total, term)
        return total

    def combine(self, coefficients: Sequence[Coefficient], values: Sequence[int]) -> int | None:
        """Return Σ coefficient·value, added from the left; None if all coefficients are zero."""
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
        """Return the product of a matrix and a vector, row by row, or as one operation for a large constant matrix."""
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
        """Return the product of a constant matrix and a vector of values as one operation."""
        if rows not in self.matrices:
            self.matrices.append(rows)
        return self.emit("product", self.matrices.index(rows), *values)

    def polynomial(self, coefficients: Sequence[float], x: int) -> int:
        """Return the polynomial Σ coefficient·x^i by Horner's rule: one multiplication and one addition per power."""
        total = self.constant(coefficients[-1])
        for coefficient in coefficients[-2::-1]:
            total = self.emit("add", self.emit("mul", total, x), self.constant(coefficient))
        return total

    def quadratic(self, Psi: Sequence[Sequence[Coefficient]], values: Sequence[int]) -> int | None:
        """Return the quadratic form v'Ψv for a symmetric matrix Ψ; None if Ψ is zero."""
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
        """Return the number ``yes`` if the truth value ``truth`` is true, and ``no`` otherwise."""
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
        """Return whether both truth values are true."""
        if isinstance(one, bool):
            return one and other
        if isinstance(other, bool):
            return other and one
        return self.emit("and", one, other)

    def either(self, one: Truth, other: Truth) -> Truth:
        """Return whether at least one of two truth values is true."""
        if isinstance(one, bool):
            return one or other
        if isinstance(other, bool):
            return other or one
        return self.negated(self.both(self.negated(one), self.negated(other)))

    def negated(self, truth: Truth) -> Truth:
        """Return whether a truth value is false."""
        if isinstance(truth, bool):
            return not truth
        op = self.ops[truth]
        return op.arguments[0] if op.name == "not" else self.emit("not", truth)

    def less_equal(self, one: Coefficient, other: Coefficient) -> Truth:
        """Return whether a number is at most another."""
        return self.emit("less_equal", self.value(one), self.value(other))

    def greater(self, one: Coefficient, other: Coefficient) -> Truth:
        """Return whether a number is greater than another."""
        return self.emit("greater", self.value(one), self.value(other))

    def finish(self, following: Sequence[int], sums: Named, outputs: Named | None = None) -> Program:
        """Return the collected program; equal states are merged, and unused operations are removed."""
        return merge_states(self.collect(following, sums, outputs or {}))

    def collect(self, following: Sequence[int], sums: Named, outputs: Named) -> Program:
        """Return the collected operations as a program without simplification."""
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
    """Return a copy of a program with only the given states; ``substitute`` can replace a ``state`` or ``input``."""
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


def merge_states(program: Program) -> Program:
    """Return a program without redundant states: equal states are merged, and states without effect are removed."""
    found = _merged_once(program)
    while (len(found.states), len(found.ops)) != (len(program.states), len(program.ops)):
        program, found = found, _merged_once(found)
    return found


def _merged_once(program: Program) -> Program:
    """Return a program without the states that are redundant as its operations are written."""
    starts: dict[object, int] = {}
    leader = [starts.setdefault((state.start, state.word), i) for i, state in enumerate(program.states)]
    live = sorted(needed(program.ops, program.following))
    while True:
        same = _same_values(program, live, leader)
        classes: dict[tuple[int, int], int] = {}
        split = [classes.setdefault((leader[i], same[op]), i) for i, op in enumerate(program.following)]
        if split == leader:
            break
        leader = split
    return _pruned(program, leader)


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
    """Return whether a coefficient is a constant and equals a number."""
    return isinstance(coefficient, float) and coefficient == number
