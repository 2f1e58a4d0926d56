"""Translation of the operations of one time step to LLVM IR, on vectors with one lane per simulated path.

``Body`` maps every operation of a program to one or a few instructions. ``Body`` also selects fused operations,
records which values are words and halves, and writes large matrix products as loops. ``llvm`` adds the loops over paths
and steps.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Literal

from taciturn.program._llvm_lines import CodeLines, tile_columns
from taciturn.program.ir import Program
from taciturn.program.ops import EIGHT, Op, Tile, needed, tiles
from taciturn.program.target import Target

Build = Literal["parity", "fast"]
_FLAGS: Mapping[Build, str] = {
    "parity": "",  # every operation rounds once, as in NumPy
    "fast": "nsz ",  # zeros may change sign; no reassociation, which would break the bit operations of random numbers
}
# In programs with at most this many operations, constants are copied to all lanes once, before the first step. In a
# larger program these vectors would be spilled to the stack, whose alignment changes the speed by a fifth; so its
# constants are copied where they are used.
SMALL = 256
_ARITHMETIC = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv"}
_INTEGER = {"word_add": "add", "word_and": "and", "word_or": "or", "word_xor": "xor"}
_SHIFT = {"shift_left": "shl", "shift_right": "lshr"}


def _fused(program: Program, live: set[int]) -> tuple[dict[int, int], set[int]]:
    """Return the fused products of the fast build: by sum or difference, and the set of those summed over steps.

    A product is fused only if no other operation reads it; otherwise it would be computed twice. This module, not the
    compiler, selects the fused operations, so that the result does not depend on the processor.
    """
    uses = Counter([*(i for index in live for i in program.ops[index].reads), *_roots(program)])
    found: dict[int, int] = {}
    for index in sorted(live):
        op = program.ops[index]
        if op.name in ("add", "sub"):
            # of two products the later operand is fused, so that a chain a + b·c + d·e fuses each with the sum so far
            alone = [i for i in reversed(op.arguments) if program.ops[i].name == "mul" and uses[i] == 1]
            found |= {index: alone[0]} if alone else {}
    totals = {total.op for total in program.totals.values()}
    return found, {index for index in totals if program.ops[index].name == "mul" and uses[index] == 1}


def _roots(program: Program) -> list[int]:
    """Return the operations whose values a step stores: next states, outputs and sums."""
    totals = (total.op for total in program.totals.values())
    return [*program.following, *program.outputs.values(), *totals]


class Body(CodeLines):
    """Writer of the LLVM IR of one time step, which records the name of each operation's value.

    Args:
        program: the program to translate.
        target: the processor.
        lanes: number of paths per vector.
        build: ``"parity"`` or ``"fast"``, which fuses operations.
        own: whether each lane has its own constants.
    """

    def __init__(self, program: Program, target: Target, lanes: int, build: Build, own: bool) -> None:
        """Start without lines."""
        super().__init__(program, target, lanes, own)
        self.flags, self.fuses = _FLAGS[build], build == "fast"
        self.live = needed(program.ops, _roots(program))
        self.fused, self.summed = _fused(program, self.live) if self.fuses else ({}, set[int]())
        self.printed = sorted(self.live - {*self.fused.values(), *self.summed})
        self.names = [""] * len(program.ops)  # names of the values, by operation
        self.memory = "%state"  # prefix of the names of states
        self.vectors: dict[int, list[str]] = {}  # names of the entries of matrix products
        self.halves_known: set[str] = set()  # names whose values are half words
        self.alone = program.operations > SMALL  # constants are copied to all lanes where they are used
        self.constants: list[str] = []  # in small programs, vectors of the constants, loaded before the first step
        self.first_input = ""  # row of the first input of the step
        self.label = ""  # label of the current basic block

    def operations(self, indices: Iterable[int]) -> None:
        """Write the LLVM IR of operations in the given order, in which each must come after its operands."""
        for index in indices:
            op = self.program.ops[index]
            if op.name == "product":
                self.vectors[index] = self._product(op.arguments[0], op.reads)
            elif index in self.fused:
                self.names[index] = self._fused_sum(op, self.fused[index])
            else:
                self.names[index] = self._operation(op.name, op.arguments)

    def kind(self, index: int) -> str:
        """Return the LLVM type of the value of an operation."""
        name = self.program.ops[index].name
        if name in ("greater", "less_equal", "and", "not", "any_bit"):
            return self.truths
        if name not in (*_INTEGER, *_SHIFT, "rotate_left", "upper", "lower", "bits"):
            return self.numbers
        return self.halves if self.names[index] in self.halves_known else self.words

    def added_up(self, index: int, before: str) -> str:
        """Return the LLVM instruction that adds the value of this step to a sum over steps."""
        if index not in self.summed:
            return f"fadd {self.flags}{self.numbers} {before}, {self.names[index]}"
        one, other = (self.names[i] for i in self.program.ops[index].arguments)
        return self.multiply_add(one, other, before)

    def _fused_sum(self, op: Op, product: int) -> str:
        """Write a sum or difference with a fused product as one multiply-add."""
        # a·b + c; a·b − c = a·b + (−c); c − a·b = (−a)·b + c: negation is exact
        one, other = (self.names[i] for i in self.program.ops[product].arguments)
        first = op.arguments[0] == product
        rest = self.names[op.arguments[1 if first else 0]]
        if op.name == "sub" and first:
            rest = self._new(f"fneg {self.flags}{self.numbers} {rest}")
        elif op.name == "sub":
            one = self._new(f"fneg {self.flags}{self.numbers} {one}")
        return self._new(self.multiply_add(one, other, rest))

    def multiply_add(self, one: str, other: str, term: str) -> str:
        """Return the LLVM instruction for one·other + term, which is rounded once if the processor supports this."""
        V = self.numbers
        return f"call {self.flags}{V} @llvm.fmuladd.v{self.lanes}f{self.bits}({V} {one}, {V} {other}, {V} {term})"

    def _narrowed(self, numbers: str) -> str:
        """Round to single precision."""
        if self.number == "float":
            return numbers
        floats = f"<{self.lanes} x float>"
        return self._new(
            f"fpext {floats} {self._new(f'fptrunc {self.numbers} {numbers} to {floats}')} to {self.numbers}"
        )

    def _operation(self, name: str, rest: Sequence[int]) -> str:
        V, B, names = self.numbers, self.truths, self.names
        if name == "const":
            return self._coefficient(rest[0]) if self.alone else self.constants[rest[0]]
        if name == "state":
            return f"{self.memory}{rest[0]}"
        if name == "input":
            return self._load(self._row("%inputs", self.first_input, rest[0]))
        if name in _ARITHMETIC:
            return self._new(f"{_ARITHMETIC[name]} {self.flags}{V} {names[rest[0]]}, {names[rest[1]]}")
        if name == "sqrt":
            return self._new(f"call {self.flags}{V} @llvm.sqrt.v{self.lanes}f{self.bits}({V} {names[rest[0]]})")
        if name == "narrow":
            return self._narrowed(names[rest[0]])
        if name == "entry":
            return self.vectors[rest[0]][rest[1]]
        if name == "select":
            return self._new(f"select {B} {names[rest[0]]}, {V} {names[rest[1]]}, {V} {names[rest[2]]}")
        if name == "lookup":
            return self._lookup(*rest)
        if name == "pick":
            return self._pick(*rest)
        if name in ("greater", "less_equal"):
            return self._new(f"fcmp {'ogt' if name == 'greater' else 'ole'} {V} {names[rest[0]]}, {names[rest[1]]}")
        if name == "and":
            return self._new(f"and {B} {names[rest[0]]}, {names[rest[1]]}")
        if name == "not":
            return self._new(f"xor {B} {names[rest[0]]}, {self._every('i1', 'true')}")
        return self._on_bits(name, rest)

    def _on_bits(self, name: str, rest: Sequence[int]) -> str:
        """Write an operation on words or halves; a value not in ``halves_known`` is a word."""
        if name in ("word", "half"):
            kind = "i64" if name == "word" else "i32"
            return self._half(self._every(kind, str(rest[0])), name == "half")
        x = self.names[rest[0]]
        half = x in self.halves_known
        kind, T = ("i32", self.halves) if half else ("i64", self.words)
        if name in _INTEGER:
            return self._half(self._new(f"{_INTEGER[name]} {T} {x}, {self.names[rest[1]]}"), half)
        if name in _SHIFT:
            return self._half(self._new(f"{_SHIFT[name]} {T} {x}, {self._every(kind, str(rest[1]))}"), half)
        if name == "rotate_left":
            by = self._every(kind, str(rest[1]))
            return self._new(f"call {T} @llvm.fshl.v{self.lanes}{kind}({T} {x}, {T} {x}, {T} {by})")
        if name in ("upper", "lower"):
            return self._half(self._every_other(x, 1 if name == "upper" else 0), True)
        if name == "count":
            return self._new(f"uitofp {T} {x} to {self.numbers}")
        if name == "bits":
            half = self.number == "float"
            T = self.halves if half else self.words
            return self._half(self._new(f"bitcast {self.numbers} {x} to {T}"), half)
        if name == "number":
            return self._new(f"bitcast {T} {x} to {self.numbers}")
        assert name == "any_bit", name
        return self._new(f"icmp ne {T} {x}, {self._every(kind, '0')}")

    def _half(self, name: str, is_half: bool) -> str:
        if is_half:
            self.halves_known.add(name)
        return name

    def _every_other(self, words: str, first: int) -> str:
        """Return the lower (0) or upper (1) halves of words, by one permutation instead of three instructions."""
        wide = f"<{2 * self.lanes} x i32>"
        parts = self._new(f"bitcast {self.words} {words} to {wide}")
        chosen = ", ".join(f"i32 {2 * lane + first}" for lane in range(self.lanes))
        return self._new(f"shufflevector {wide} {parts}, {wide} poison, <{self.lanes} x i32> <{chosen}>")

    def _product(self, matrix: int, values: Sequence[int]) -> list[str]:
        """Return the entries of a matrix times a vector; each tile is a loop over its columns."""
        # memory order: constants, tables, matrices; ``before`` is the position of this matrix's first coefficient
        V, program = self.numbers, self.program
        before = len(program.constants) + sum(len(table) for table in program.tables)
        before += sum(len(tile_columns(rows, tile)) for rows in program.matrices[:matrix] for tile in tiles(rows))
        # the vector is stored in memory, so that the loop can index it
        column = self._new(f"getelementptr {V}, ptr %column, i64 0")
        for i, value in enumerate(values):
            address = self._new(f"getelementptr {V}, ptr {column}, i64 {i}")
            self.lines.append(f"  store {V} {self.names[value]}, ptr {address}, align 8")
        result = ["zeroinitializer"] * len(program.matrices[matrix])
        for tile in tiles(program.matrices[matrix]):
            rows = slice(tile.first, tile.first + tile.rows)
            result[rows] = self._tile(tile, before, column)
            before += tile.rows * (tile.end - tile.begin)
        return result

    def _tile(self, tile: Tile, before: int, column: str) -> list[str]:
        """Return the entries of a tile's rows; ``before`` is the position of its coefficients in the constants."""
        # s_i ← s_i + M_ij v_j for j = begin, …, end − 1; each row has its own s_i, so the rows' chains run side by side
        V, loop = self.numbers, f"columns{self.counter}"
        totals = [f"%{loop}_{i}" for i in range(tile.rows)]
        start = self._address(self.base, before - tile.begin * tile.rows)
        self.lines += [f"  br label %{loop}", f"{loop}:"]
        self.lines.append(f"  %{loop}_j = phi i64 [ {tile.begin}, %{self.label} ], [ %{loop}_next, %{loop} ]")
        for total in totals:
            self.lines.append(f"  {total} = phi {V} [ zeroinitializer, %{self.label} ], [ {total}_next, %{loop} ]")
        value = self._new(f"load {V}, ptr {self._new(f'getelementptr {V}, ptr {column}, i64 %{loop}_j')}, align 8")
        first = self._address(start, self._new(f"mul i64 %{loop}_j, {tile.rows}"))
        for i, total in enumerate(totals):
            coefficient = self._coefficient(i, first)
            if self.fuses:
                self.lines.append(f"  {total}_next = {self.multiply_add(coefficient, value, total)}")
            else:
                term = self._new(f"fmul {V} {coefficient}, {value}")
                self.lines.append(f"  {total}_next = fadd {V} {total}, {term}")
        self.lines += [
            f"  %{loop}_next = add i64 %{loop}_j, 1",
            f"  %{loop}_more = icmp slt i64 %{loop}_next, {tile.end}",
            f"  br i1 %{loop}_more, label %{loop}, label %after_{loop}",
            f"after_{loop}:",
        ]
        self.label = f"after_{loop}"
        return [f"{total}_next" for total in totals]

    def _pick(self, table: int, word: int) -> str:
        """Return entries of an eight-entry table, by permutations in registers (AVX-512 or AVX2) or by gathers."""
        base, U = self._table(table), self.words
        if not self.permutes:
            offsets = self._new(f"and {U} {self.names[word]}, {self._every('i64', str(EIGHT - 1))}")
            return self._gathered(base, U, offsets)
        wide, found = self.permutes, list[str]()
        for first in range(0, self.lanes, wide):
            part = self._part(self.names[word], U, range(first, first + wide), f"<{wide} x i64>")
            found.append(self._permuted(base, part))
        return self._joined(found)

    def _lookup(self, table: int, index: int) -> str:
        integers = self.halves  # every vector unit converts to 32 bits, and few convert to 64 bits
        offsets = self._new(f"fptosi {self.numbers} {self.names[index]} to {integers}")
        return self._gathered(self._table(table), integers, offsets)
