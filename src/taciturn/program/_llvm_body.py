"""Prints the operations of a program as LLVM IR, on vectors of numbers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Literal

from taciturn.program.ir import Program, needed
from taciturn.program.ops import EIGHT, Op, Precision, Rows, Tile, tiles
from taciturn.program.target import Target

Build = Literal["parity", "fast"]
_FLAGS: Mapping[Build, str] = {
    "parity": "",  # every operation rounds once, as in NumPy
    "fast": "nsz ",  # the sign of zero is free; no reassociation: it breaks the bit tricks of the draws
}
# Operations of a program whose constants are spread over vectors ahead of all ticks. In a larger one they would be
# spilled, and where the stack comes to lie would decide the speed, by a fifth: they are spread where they are used.
SMALL = 256
PERMUTES = {  # by doubles that are permuted: the function, and a type of as many bits, of numbers and of places
    8: ("llvm.x86.avx512.permvar.df.512", "<8 x double>", "<8 x i64>"),
    4: ("llvm.x86.avx2.permps", "<8 x float>", "<8 x i32>"),  # the halves of doubles
}
_NUMBER: Mapping[Precision, tuple[str, int]] = {"float64": ("double", 64), "float32": ("float", 32)}
_ARITHMETIC = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv"}
_INTEGER = {"word_add": "add", "word_and": "and", "word_or": "or", "word_xor": "xor"}
_SHIFT = {"shift_left": "shl", "shift_right": "lshr"}


def constants_of(program: Program) -> list[float]:
    """Return what the argument ``constants`` must hold: constants, tables, and the columns of the matrices' tiles."""
    tables = (value for table in program.tables for value in table)
    matrices = (value for matrix in program.matrices for tile in tiles(matrix) for value in _columns(matrix, tile))
    return [*program.constants, *tables, *matrices]


def _columns(matrix: Rows, tile: Tile) -> list[float]:
    """Return the coefficients of a tile, column by column."""
    return [row[j] for j in range(tile.begin, tile.end) for row in matrix[tile.first : tile.first + tile.rows]]


def _filled(kind: str, literal: object, lanes: int) -> str:
    """Return a vector with the same literal in every lane."""
    return "<" + ", ".join([f"{kind} {literal}"] * lanes) + ">"


def _fused(program: Program, live: set[int]) -> tuple[dict[int, int], set[int]]:
    """Return the sums and differences with the product that each is fused with, and the products added up over ticks.

    Nothing else reads these products. What is fused is decided here and not by the compiler, so that it does not depend
    on the processor.
    """
    uses = Counter([*(i for index in live for i in program.ops[index].reads), *_roots(program)])
    found: dict[int, int] = {}
    for index in sorted(live):
        op = program.ops[index]
        if op.name in ("add", "sub"):
            alone = [i for i in reversed(op.arguments) if program.ops[i].name == "mul" and uses[i] == 1]
            found |= {index: alone[0]} if alone else {}
    totals = {total.op for total in program.totals.values()}
    return found, {index for index in totals if program.ops[index].name == "mul" and uses[index] == 1}


def _roots(program: Program) -> list[int]:
    """Return the operations whose values leave the tick."""
    totals = (total.op for total in program.totals.values())
    return [*program.following, *program.outputs.values(), *totals]


class Body:
    """Lines of LLVM IR, and the names of what they compute.

    Args:
        program: whose operations are printed.
        target: for which processor.
        lanes: width of the vectors.
        build: whether operations may fuse.
        own: whether each lane has constants of its own.
    """

    def __init__(self, program: Program, target: Target, lanes: int, build: Build, own: bool) -> None:
        """Start with no lines."""
        self.program, self.lanes, self.flags, self.own = program, lanes, _FLAGS[build], own
        self.number, self.bits = _NUMBER[program.precision]
        self.numbers, self.doubles, self.truths = (f"<{lanes} x {kind}>" for kind in (self.number, "double", "i1"))
        self.words, self.halves = f"<{lanes} x i64>", f"<{lanes} x i32>"
        wide = target.permutes
        self.permutes = wide if wide and program.precision == "float64" and not own and lanes % wide == 0 else 0
        self.number_at = "double" if own else self.number  # what stands at the base of the constants
        self.entries = f"<{lanes} x {self.number_at}>"
        self.gather = f"llvm.masked.gather.v{lanes}f{64 if self.number_at == 'double' else 32}.v{lanes}p0"
        self.fuses = build == "fast"
        self.live = needed(program, _roots(program))
        self.fused, self.summed = _fused(program, self.live) if self.fuses else ({}, set[int]())
        self.lines: list[str] = []
        self.printed = sorted(self.live - {*self.fused.values(), *self.summed})
        self.names = [""] * len(program.ops)  # of the operations' values
        self.memory = "%state"  # how the names of states begin
        self.vectors: dict[int, list[str]] = {}  # of the entries of products
        self.halves_known: set[str] = set()  # names of half words
        self.alone = program.operations > SMALL
        self.constants: list[str] = []  # those spread ahead of all ticks
        self.base = ""  # address of the constants
        self.first_input = ""  # row of the tick's first input
        self.label = ""  # of the block that is printed
        self.counter = 0

    def operations(self, indices: Iterable[int]) -> None:
        """Print some of the operations that something depends on, in their order."""
        for index in indices:
            op = self.program.ops[index]
            if op.name == "product":
                self.vectors[index] = self._product(op.arguments[0], op.reads)
            elif index in self.fused:
                self.names[index] = self._fused_sum(op, self.fused[index])
            else:
                self.names[index] = self._operation(op.name, op.arguments)

    def kind(self, index: int) -> str:
        """Return the type of an operation's value, once it is printed."""
        name = self.program.ops[index].name
        if name in ("greater", "less_equal", "and", "not", "any_bit"):
            return self.truths
        if name not in (*_INTEGER, *_SHIFT, "rotate_left", "upper", "lower", "bits"):
            return self.numbers
        return self.halves if self.names[index] in self.halves_known else self.words

    def added_up(self, index: int, before: str) -> str:
        """Return what computes a sum over ticks with one term more."""
        if index not in self.summed:
            return f"fadd {self.flags}{self.numbers} {before}, {self.names[index]}"
        one, other = (self.names[i] for i in self.program.ops[index].arguments)
        return self.multiply_add(one, other, before)

    def _fused_sum(self, op: Op, product: int) -> str:
        """Print a sum or difference one of whose terms is a product."""
        one, other = (self.names[i] for i in self.program.ops[product].arguments)
        first = op.arguments[0] == product
        rest = self.names[op.arguments[1 if first else 0]]
        if op.name == "sub" and first:
            rest = self._new(f"fneg {self.flags}{self.numbers} {rest}")
        elif op.name == "sub":
            one = self._new(f"fneg {self.flags}{self.numbers} {one}")
        return self._new(self.multiply_add(one, other, rest))

    def multiply_add(self, one: str, other: str, term: str) -> str:
        """Return what computes one·other + term, rounded once where the processor can."""
        V = self.numbers
        return f"call {self.flags}{V} @llvm.fmuladd.v{self.lanes}f{self.bits}({V} {one}, {V} {other}, {V} {term})"

    def _new(self, text: str) -> str:
        self.counter += 1
        name = f"%v{self.counter}"
        self.lines.append(f"  {name} = {text}")
        return name

    def _splat(self, scalar: str, kind: str) -> str:
        """Return a vector with the scalar in every lane."""
        vector = f"<{self.lanes} x {kind}>"
        one = self._new(f"insertelement {vector} poison, {kind} {scalar}, i32 0")
        return self._new(f"shufflevector {vector} {one}, {vector} poison, <{self.lanes} x i32> zeroinitializer")

    def _load(self, address: str) -> str:
        """Return the numbers that stand as doubles at an address."""
        return self._narrow(self._new(f"load {self.doubles}, ptr {address}, align 8"))

    def _narrow(self, doubles: str) -> str:
        if self.number == "double":
            return doubles
        return self._new(f"fptrunc {self.doubles} {doubles} to {self.numbers}")

    def _widen(self, numbers: str) -> str:
        """Return numbers as doubles."""
        return numbers if self.number == "double" else self._new(f"fpext {self.numbers} {numbers} to {self.doubles}")

    def _narrowed(self, numbers: str) -> str:
        """Round to single precision."""
        if self.number == "float":
            return numbers
        floats = f"<{self.lanes} x float>"
        return self._new(
            f"fpext {floats} {self._new(f'fptrunc {self.numbers} {numbers} to {floats}')} to {self.numbers}"
        )

    def _row(self, base: str, first: str, index: int) -> str:
        """Return the address of row ``index`` behind row ``first`` of an array of vectors of doubles."""
        row = self._new(f"add i64 {first}, {index}")
        offset = self._new(f"mul i64 {row}, {self.lanes}")
        return self._new(f"getelementptr double, ptr {base}, i64 {offset}")

    def _address(self, base: str, index: int | str) -> str:
        """Return the address of a constant, or of one in each lane."""
        if self.own:
            index = self._new(f"mul i64 {index}, {self.lanes}")
        return self._new(f"getelementptr {self.number_at}, ptr {base}, i64 {index}")

    def _coefficient(self, index: int | str, base: str | None = None) -> str:
        """Return a constant in every lane, given its place behind an address."""
        address = self._address(base or self.base, index)
        if self.own:
            return self._load(address)
        return self._splat(self._new(f"load {self.number}, ptr {address}, align 4"), self.number)

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
        """Print an operation on words or halves; what is not known as a half is a word."""
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
        """Return the lower (0) or upper (1) halves of words: one permutation, where truncating takes three steps."""
        wide = f"<{2 * self.lanes} x i32>"
        parts = self._new(f"bitcast {self.words} {words} to {wide}")
        chosen = ", ".join(f"i32 {2 * lane + first}" for lane in range(self.lanes))
        return self._new(f"shufflevector {wide} {parts}, {wide} poison, <{self.lanes} x i32> <{chosen}>")

    def _product(self, matrix: int, values: Sequence[int]) -> list[str]:
        """Return the entries of a matrix times numbers: for each tile a loop over its columns."""
        V, program = self.numbers, self.program
        before = len(program.constants) + sum(len(table) for table in program.tables)
        before += sum(len(_columns(rows, tile)) for rows in program.matrices[:matrix] for tile in tiles(rows))
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
        """Return the entries of a tile's rows; ``before`` is where its coefficients stand in the constants."""
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

    def _every(self, kind: str, literal: str) -> str:
        return _filled(kind, literal, self.lanes)

    def _table(self, table: int) -> str:
        """Return the address of a table."""
        before = len(self.program.constants) + sum(len(values) for values in self.program.tables[:table])
        start = "%constants" if not self.own else self.base
        places = before * (self.lanes if self.own else 1)
        return self._new(f"getelementptr {self.number_at}, ptr {start}, i64 {places}")

    def _pick(self, table: int, word: int) -> str:
        """A table of eight doubles fits one register of AVX-512 or two of AVX2, and is permuted there, or gathered."""
        base, U = self._table(table), self.words
        if not self.permutes:
            offsets = self._new(f"and {U} {self.names[word]}, {self._every('i64', str(EIGHT - 1))}")
            return self._gathered(base, U, offsets)
        wide, found = self.permutes, list[str]()
        for first in range(0, self.lanes, wide):
            part = self._part(self.names[word], U, range(first, first + wide), f"<{wide} x i64>")
            found.append(self._permuted(base, part))
        return self._joined(found)

    def _permuted(self, base: str, words: str) -> str:
        """Return the entries at the words' last bits, for as many words as one instruction permutes."""
        wide = self.permutes
        U, V = f"<{wide} x i64>", f"<{wide} x double>"
        function, numbers, places = PERMUTES[wide]
        if wide == EIGHT:
            entries = self._new(f"load {V}, ptr {base}, align 8")
            return self._new(f"call {V} @{function}({V} {entries}, {U} {words})")
        # both halves of the table by the last two bits, as pairs of half words; the third bit chooses
        twice = self._new(f"shl {U} {words}, {_filled('i64', 1, wide)}")
        parts = self._new(f"bitcast {U} {twice} to {places}")
        evens = ", ".join(f"i32 {2 * (k // 2)}" for k in range(8))
        pairs = self._new(f"shufflevector {places} {parts}, {places} poison, {places} <{evens}>")
        odds = ", ".join(f"i32 {k % 2}" for k in range(8))
        chosen = self._new(f"or {places} {pairs}, <{odds}>")
        halves: list[str] = []
        for first in (0, 4):
            address = self._new(f"getelementptr double, ptr {base}, i64 {first}")
            entries = self._new(f"load {numbers}, ptr {address}, align 8")
            found = self._new(f"call {numbers} @{function}({numbers} {entries}, {places} {chosen})")
            halves.append(self._new(f"bitcast {numbers} {found} to {V}"))
        sign = self._new(f"shl {U} {words}, {_filled('i64', 61, wide)}")
        upper = self._new(f"icmp slt {U} {sign}, zeroinitializer")
        return self._new(f"select <{wide} x i1> {upper}, {V} {halves[1]}, {V} {halves[0]}")

    def _part(self, name: str, kind: str, lanes: range, narrower: str) -> str:
        """Return some lanes of a vector."""
        if kind == narrower:
            return name
        chosen = ", ".join(f"i32 {lane}" for lane in lanes)
        return self._new(f"shufflevector {kind} {name}, {kind} poison, <{len(lanes)} x i32> <{chosen}>")

    def _joined(self, parts: Sequence[str]) -> str:
        """Return vectors of doubles end to end."""
        width = self.lanes // len(parts)
        while len(parts) > 1:
            kind, chosen = f"<{width} x double>", ", ".join(f"i32 {lane}" for lane in range(2 * width))
            width *= 2
            parts = [
                self._new(f"shufflevector {kind} {one}, {kind} {other}, <{width} x i32> <{chosen}>")
                for one, other in zip(parts[::2], parts[1::2], strict=True)
            ]
        return parts[0]

    def _lookup(self, table: int, index: int) -> str:
        integers = self.halves  # every vector unit converts to these; few to 64 bits
        offsets = self._new(f"fptosi {self.numbers} {self.names[index]} to {integers}")
        return self._gathered(self._table(table), integers, offsets)

    def _gathered(self, base: str, kind: str, offsets: str) -> str:
        if self.own:
            element = "i32" if kind == self.halves else "i64"
            lanes = "<" + ", ".join(f"{element} {lane}" for lane in range(self.lanes)) + ">"
            scaled = self._new(f"mul {kind} {offsets}, {self._every(element, str(self.lanes))}")
            offsets = self._new(f"add {kind} {scaled}, {lanes}")
        addresses = self._new(f"getelementptr {self.number_at}, ptr {base}, {kind} {offsets}")
        found = self._new(
            f"call {self.entries} @{self.gather}(<{self.lanes} x ptr> {addresses}, i32 4, "
            f"{self.truths} {self._every('i1', 'true')}, {self.entries} zeroinitializer)"
        )
        return self._narrow(found) if self.number_at == "double" else found
