"""Straight-line programs in single-assignment form: one tick of a loop or of a node, and how they are written down."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress

from taciturn.program.ops import EIGHT, LITERAL, Op, Precision, Rows, State, Total, tiles

BLOCK = 256  # coefficients of a matrix, zeros left out, from which on it is multiplied in loops instead of one by one
FULL = 4  # coefficients of a column of such a matrix, at least
Coefficient = float | int  # a float is a number known now; an int is the index of an operation


@dataclass(frozen=True)
class Program:
    """One tick: from states, inputs and constants to next states, sums and outputs.

    Args:
        ops: operations in order.
        states: what is remembered from tick to tick.
        following: operation that gives each state its next value.
        inputs: names of what is supplied at each tick.
        constants: values of the ``const`` operations; programs that differ only here share machine code.
        tables: values of the ``lookup`` operations.
        sums: operations that are summed over the ticks, by name.
        outputs: operations that are recorded at each tick, by name.
        precision: of its numbers.
        matrices: of the ``product`` operations.
    """

    ops: tuple[Op, ...]
    states: tuple[State, ...]
    following: tuple[int, ...]
    inputs: tuple[str, ...]
    constants: tuple[float, ...]
    tables: tuple[tuple[float, ...], ...]
    sums: Mapping[str, int]
    outputs: Mapping[str, int]
    precision: Precision = "float64"
    matrices: tuple[Rows, ...] = ()

    @cached_property
    def operations(self) -> int:
        """Number of operations that compute something; a product counts its multiplications and additions."""
        single = sum(op.name not in ("const", "state", "input", "word", "half", "product", "entry") for op in self.ops)
        products = [self.matrices[op.arguments[0]] for op in self.ops if op.name == "product"]
        return single + sum(2 * tile.rows * (tile.end - tile.begin) for rows in products for tile in tiles(rows))

    @property
    def structure(self) -> Hashable:
        """What programs share that differ in their numbers alone: they can run side by side."""
        shapes = tuple(tuple(tiles(matrix)) for matrix in self.matrices)
        names = (tuple(self.sums.items()), tuple(self.outputs.items()))
        sizes = (len(self.constants), *(len(table) for table in self.tables))
        states = tuple(
            replace(state, start=0.0 if isinstance(state.start, float) else state.start) for state in self.states
        )
        return self.ops, states, self.following, self.inputs, names, sizes, shapes, self.precision

    @property
    def totals(self) -> dict[str, Total]:
        """What is added up for each sum: known factors and terms wait until the end."""
        return {name: self._total(index) for name, index in self.sums.items()}

    def _total(self, index: int) -> Total:
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
        self, sums: Set[str] = frozenset(), outputs: Set[str] = frozenset(), states: Set[str] = frozenset()
    ) -> Program:
        """Return the program with only these sums, outputs and states, and what they depend on."""
        kept_sums = {name: index for name, index in self.sums.items() if name in sums}
        kept_outputs = {name: index for name, index in self.outputs.items() if name in outputs}
        smaller = replace(self, sums=kept_sums, outputs=kept_outputs)  # of its states no two agree
        return _pruned(smaller, range(len(self.states)), states)


class Builder:
    """Collects operations; equal operations are shared.

    Args:
        precision: of the numbers.
    """

    def __init__(self, precision: Precision = "float64") -> None:
        """Start empty."""
        self.precision: Precision = precision
        self.ops: list[Op] = []
        self.constants: list[float] = []
        self.tables: list[tuple[float, ...]] = []
        self.matrices: list[Rows] = []
        self.states: list[State] = []
        self.inputs: list[str] = []
        self._known: dict[tuple[str, tuple[int, ...]], int] = {}
        self._constant_index: dict[float | str, int] = {}

    def emit(self, name: str, *arguments: int) -> int:
        """Return the index of the operation, new or shared."""
        new = len(self.ops)
        found = self._known.setdefault((name, arguments), new)
        if found == new:
            self.ops.append(Op(name, arguments))
        return found

    def constant(self, value: float) -> int:
        """Return a number known now."""
        key = float(value) or str(value)  # 0 and −0 are two
        if key not in self._constant_index:
            self._constant_index[key] = len(self.constants)
            self.constants.append(float(value))
        return self.emit("const", self._constant_index[key])

    def state(self, state: State) -> int:
        """Return the value at the start of the tick, declaring the state when new."""
        if state not in self.states:
            self.states.append(state)
        return self.emit("state", self.states.index(state))

    def input(self, name: str) -> int:
        """Return what is supplied at this tick under a name."""
        if name not in self.inputs:
            self.inputs.append(name)
        return self.emit("input", self.inputs.index(name))

    def lookup(self, values: Sequence[float], index: int) -> Coefficient:
        """Return values[index]: a number where all values are equal."""
        if len(set(values)) == 1:
            return float(values[0])
        return self.emit("lookup", self._table(values), index)

    def pick(self, values: Sequence[float], word: int) -> int:
        """Return the entry of eight that the last three bits of a word name."""
        assert len(values) == EIGHT
        return self.emit("pick", self._table(values), word)

    def _table(self, values: Sequence[float]) -> int:
        """Return the index of a table, declared when new."""
        row = tuple(float(value) for value in values)
        if row not in self.tables:
            self.tables.append(row)
        return self.tables.index(row)

    def value(self, coefficient: Coefficient) -> int:
        """Return the operation of a coefficient."""
        return self.constant(coefficient) if isinstance(coefficient, float) else coefficient

    def scale(self, coefficient: Coefficient, x: int) -> int:
        """Return coefficient · x."""
        if x == self.constant(1.0):
            return self.value(coefficient)
        return x if _is(coefficient, 1.0) else self.emit("mul", self.value(coefficient), x)

    def add(self, *terms: int | None) -> int | None:
        """Return the sum of the terms that are there, from the left."""
        total: int | None = None
        for term in terms:
            if term is not None:
                total = term if total is None else self.emit("add", total, term)
        return total

    def combine(self, coefficients: Sequence[Coefficient], values: Sequence[int]) -> int | None:
        """Return Σ coefficient·value from the left without the zeros, or None when nothing is left.

        One chain, each link a fused multiply-add in the fast build: two halves, added at the end, were 6 % slower.
        """
        total: int | None = None
        for coefficient, value in zip(coefficients, values, strict=True):
            if _is(coefficient, 0.0):
                continue
            if total is not None and _is(coefficient, -1.0):
                total = self.emit("sub", total, value)
            else:
                total = self.add(total, self.scale(coefficient, value))
        return total

    def transform(self, matrix: Sequence[Sequence[Coefficient]], values: Sequence[int]) -> list[int | None]:
        """Return matrix·values, a ``combine`` for each row; a large matrix of known numbers is one operation.

        Its columns with few coefficients, as those of an identity, are added one by one.
        """
        full = [sum(not _is(c, 0.0) for c in column) >= FULL for column in zip(*matrix, strict=True)]
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

    def product(self, rows: Rows, values: Sequence[int]) -> int:
        """Return the vector of a matrix times numbers."""
        if rows not in self.matrices:
            self.matrices.append(rows)
        return self.emit("product", self.matrices.index(rows), *values)

    def polynomial(self, coefficients: Sequence[float], x: int) -> int:
        """Return Σ coefficient·x^i by Horner's rule: splitting into even and odd powers takes an operation more."""
        total = self.constant(coefficients[-1])
        for coefficient in coefficients[-2::-1]:
            total = self.emit("add", self.emit("mul", total, x), self.constant(coefficient))
        return total

    def quadratic(self, Psi: Sequence[Sequence[Coefficient]], values: Sequence[int]) -> int | None:
        """Return v'Ψv of a symmetric Ψ without the zeros; equal diagonal weights share one product."""
        alone: dict[int, list[int]] = {}
        mixed: list[tuple[int, list[Coefficient]]] = []  # a value may stand there more than once
        total: int | None = None
        for i, value in enumerate(values):
            row = [c if j == i else self._twice(c) for j, c in enumerate(Psi[i][i:], start=i)]
            if all(_is(c, 0.0) for c in row):
                continue
            if all(_is(c, 0.0) for c in row[1:]):
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

    def choose(self, truth: int, yes: int, no: int) -> int:
        """Return one of two values; what is scaled or nothing is scaled after the choice."""
        if yes == no:
            return yes
        op, zero = self.ops[yes], self.constant(0.0)
        if no == zero and op.name == "mul" and self.ops[op.arguments[0]].name == "const":
            return self.emit("mul", op.arguments[0], self.emit("select", truth, op.arguments[1], zero))
        return self.emit("select", truth, yes, no)

    def _twice(self, coefficient: Coefficient) -> Coefficient:
        return 2.0 * coefficient if isinstance(coefficient, float) else self.emit("add", coefficient, coefficient)

    def finish(
        self, following: Sequence[int], sums: Mapping[str, int], outputs: Mapping[str, int] | None = None
    ) -> Program:
        """Return the program, with states that always agree merged and dead operations removed."""
        program = Program(
            tuple(self.ops),
            tuple(self.states),
            tuple(following),
            tuple(self.inputs),
            tuple(self.constants),
            tuple(self.tables),
            dict(sums),
            dict(outputs or {}),
            self.precision,
            tuple(self.matrices),
        )
        return merge_states(program)


def rebuild(program: Program, substitute: Callable[[Builder, Op], int | None], states: Sequence[int]) -> Program:
    """Replay a program: ``substitute`` may replace a state or an input; only the given states are kept.

    Unused operations, constants and tables disappear on the way.
    """
    roots = [program.following[i] for i in states] + list(program.sums.values()) + list(program.outputs.values())
    live = sorted(needed(program, roots))
    builder = Builder(program.precision)
    for i in states:  # the order of the states is that of the original, whatever is read first
        builder.state(program.states[i])
    new = [0] * len(program.ops)
    for index in live:
        op = program.ops[index]
        if op.name in LITERAL:
            replaced = substitute(builder, op) if op.name in ("state", "input") else None
            new[index] = _copy(program, builder, op, new) if replaced is None else replaced
        else:  # nearly all
            new[index] = builder.emit(op.name, *[new[argument] for argument in op.arguments])
    return Program(
        tuple(builder.ops),
        tuple(builder.states),
        tuple(new[program.following[i]] for i in states),
        tuple(builder.inputs),
        tuple(builder.constants),
        tuple(builder.tables),
        {name: new[index] for name, index in program.sums.items()},
        {name: new[index] for name, index in program.outputs.items()},
        program.precision,
        tuple(builder.matrices),
    )


def merge_states(program: Program) -> Program:
    """Merge states that provably agree at every tick, and drop states that nothing depends on.

    States are first taken to agree where they start equal; classes whose next values differ are split until
    none does (the coarsest partition, as in the minimisation of automata).
    """
    starts: dict[object, int] = {}
    leader = [starts.setdefault((state.start, state.word), i) for i, state in enumerate(program.states)]
    live = sorted(needed(program, program.following))
    while True:
        same = _same_values(program, live, leader)
        classes: dict[tuple[int, int], int] = {}
        split = [classes.setdefault((leader[i], same[op]), i) for i, op in enumerate(program.following)]
        if split == leader:
            break
        leader = split
    return _pruned(program, leader)


def _same_values(program: Program, live: Sequence[int], leader: Sequence[int]) -> list[int]:
    """Return the first operation that has the value of each of the live ones, where states are their leaders."""
    same, known = list(range(len(program.ops))), dict[tuple[str, tuple[int, ...]], int]()
    for index in live:
        name, arguments = program.ops[index]
        if name == "state":
            arguments = (leader[arguments[0]],)
        elif name in LITERAL:
            arguments = tuple([a if i == LITERAL[name] else same[a] for i, a in enumerate(arguments)])
        else:  # nearly all
            arguments = tuple([same[a] for a in arguments])
        same[index] = known.setdefault((name, arguments), index)
    return same


def _pruned(program: Program, leader: Sequence[int], wanted: Set[str] = frozenset()) -> Program:
    """Return a program whose states are read from their leaders, without those that nothing depends on or wants."""
    alive = _alive(program, leader, {leader[i] for i, state in enumerate(program.states) if state.name in wanted})
    return rebuild(program, _led(leader, alive), alive)


def _led(leader: Sequence[int], kept: Sequence[int]) -> Callable[[Builder, Op], int | None]:
    """Return the substitution that reads each state from its leader, one of those kept."""
    positions = {old: new for new, old in enumerate(kept)}
    return lambda builder, op: builder.emit("state", positions[leader[op.arguments[0]]]) if op.name == "state" else None


def _alive(program: Program, leader: Sequence[int], alive: set[int]) -> list[int]:
    """Return the states that sums, outputs and those already alive depend on, through any number of ticks."""
    roots = [*program.sums.values(), *program.outputs.values(), *(program.following[i] for i in alive)]
    seen: set[int] = set()
    while roots:
        index = roots.pop()
        if index in seen:
            continue
        seen.add(index)
        op = program.ops[index]
        if op.name != "state":
            roots += op.reads
        elif (state := leader[op.arguments[0]]) not in alive:
            alive.add(state)
            roots.append(program.following[state])
    return sorted(alive)


def needed(program: Program, roots: Sequence[int]) -> set[int]:
    """Return the operations that the roots depend on: each reads only earlier ones."""
    needed = set(roots)
    for index in range(max(needed, default=-1), -1, -1):
        if index in needed:
            needed.update(program.ops[index].reads)
    return needed


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


def _is(coefficient: Coefficient, number: float) -> bool:
    """Tell whether a coefficient is known now to be a number; an operation's index never is."""
    return isinstance(coefficient, float) and coefficient == number
