"""Translation of a program to LLVM IR on vectors, with one lane per path. States stay in registers between steps.

The generated function runs blocks of ``lanes`` paths for any number of steps:

    void run(i64 first, i64 end, i64 steps,
             double* state, double* sums, double* constants, double* inputs, double* outputs)

The arrays are state (blocks, states, lanes), sums (blocks, sums, lanes), inputs (blocks, steps, inputs, lanes) and
outputs (blocks, steps, outputs, lanes). They contain doubles for both precisions of the program; only constants that
all lanes share have the precision of the program. The sums of a window of steps are added to the sums in memory at its
end. Constants, tables and matrices are one array in memory, so that programs of equal structure share machine code.

``_CodeLines`` emits single instructions, access to memory and table lookups; ``_Body`` maps every operation of a time
step to one or a few of them, selects fused operations, and writes large matrix products as loops; ``_Printer`` adds the
loops over blocks, windows of steps, and steps. This module, not the compiler, selects the fused operations, so that
the result does not depend on the processor; the bit-exact build fuses none.

**One step ahead.** A time step is one long chain of dependent operations: a random word, a logarithm and a root, which
give a normal number, the next state, and the decision that depends on it. A processor reorders instructions within a
window of some 250 to 500 instructions, which is less than two steps, so that it would mostly wait for this chain.
Random numbers depend only on the words of the generator. They are computed one step ahead, while the previous step
computes its state.

**Processors.** Any program can be translated with any number of lanes for any processor (``Target``). Only the
instruction for lookups in small tables depends on the processor. LLVM terminates the process if a function uses an
instruction that the features do not include. Therefore the text contains the features, and is compiled for exactly
these.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from typing import Literal

from taciturn.errors import ProblemError
from taciturn.program.ir import Program
from taciturn.program.ops import EIGHT, WINDOW, MatrixRows, Op, Precision, Tile, needed, tiles

_FREE_OPERATIONS = ("const", "word", "half")  # operations that need no instructions in the step
VECTORS = "TACITURN_VECTORS"
# The function and the types of numbers and positions, by the number of doubles that one instruction permutes. AVX2 has
# no permutation of doubles by computed positions; the permutation of their halves, as floats, replaces it.
_PERMUTES = {
    8: ("llvm.x86.avx512.permvar.df.512", "<8 x double>", "<8 x i64>"),
    4: ("llvm.x86.avx2.permps", "<8 x float>", "<8 x i32>"),
}
_NUMBER: Mapping[Precision, tuple[str, int]] = {"float64": ("double", 64), "float32": ("float", 32)}
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


@dataclass(frozen=True)
class Target:
    """Description of a processor for the LLVM compiler."""

    triple: str  # architecture, vendor, and system
    cpu: str  # name of the processor; empty: any processor of the architecture
    features: str  # further features in LLVM's notation, such as ``"+avx2,-avx512f"``

    @property
    def permutes(self) -> int:
        """How many doubles one instruction can permute by computed indices: 8 (AVX-512), 4 (AVX2), or 0 (no
        instruction).
        """
        if self.triple.partition("-")[0] not in ("x86_64", "amd64", "i686", "i386"):
            return 0
        return 8 if self._has("avx512f") else 4 if self._has("avx2") else 0

    @property
    def lanes(self) -> int:
        """How many doubles the processor's widest vector register contains; 2 (SSE2, NEON) for an unknown processor."""
        return self.permutes or 2

    @property
    def heading(self) -> str:
        """First lines of an LLVM module for this processor: the target's name, and a symbol that Windows needs."""
        lines = [f'target triple = "{self.triple}"']
        if "windows" in self.triple:
            lines.append("@_fltused = global i32 0")  # a symbol that the linker requires for floating-point code
        return "\n".join(lines)

    @property
    def attributes(self) -> str:
        """Attributes of an LLVM function that name this processor."""
        return f'"target-cpu"="{self.cpu}" "target-features"="{self.features}"'

    def limited(self, vectors: str) -> Target:
        """Restrict the description of this processor to a set of vector instructions, such as ``avx2``."""
        there = {"avx512": self.permutes == 8, "avx2": self.permutes >= 4}
        known = [name for name, has in there.items() if has] + ["baseline"]
        if not vectors or vectors == known[0]:
            return self
        if vectors not in known:
            lacks = f", which this processor ({self.cpu}) does not support" if vectors in there else ""
            raise ProblemError(
                f"{VECTORS} is {vectors!r}{lacks}; expected one of {', '.join(known)}: leave the variable unset for "
                "the widest vectors of this processor"
            )
        if vectors == "baseline":
            return replace(self, cpu="", features="")
        wider = ("avx512", "avx10", "evex")
        kept = [flag for flag in self.features.split(",") if not flag[1:].startswith(wider)]
        return replace(self, cpu="haswell", features=",".join([*kept, "-avx512f"]))

    def _has(self, feature: str) -> bool:
        """Return whether a feature is in the list, and no feature that it requires is excluded."""
        flags, below = self.features.split(","), ("sse2", "avx", "avx2", "avx512f")
        return f"+{feature}" in flags and not any(f"-{name}" in flags for name in below[: below.index(feature) + 1])


def print_llvm(program: Program, target: Target, lanes: int, build: Build, own: bool = False) -> str:
    """Write an LLVM module with a function ``run``, which runs a program for many steps and paths."""
    return _Printer(program, target, lanes, build, own).text()


def constants_of(program: Program) -> list[float]:
    """List the constants of a program in the order in which the machine code reads them."""
    # These are the constants, the tables, and the tiles of the matrices column by column.
    tables = (value for table in program.tables for value in table)
    matrices = (value for matrix in program.matrices for tile in tiles(matrix) for value in _tile_columns(matrix, tile))
    return [*program.constants, *tables, *matrices]


class _CodeLines:
    """Lines of LLVM IR for a program, and the types and addresses that they use."""

    def __init__(self, program: Program, target: Target, lanes: int, own: bool) -> None:
        """Start without lines."""
        self.program, self.lanes, self.own = program, lanes, own
        self.number, self.bits = _NUMBER[program.precision]
        self.numbers, self.doubles, self.truths = (f"<{lanes} x {kind}>" for kind in (self.number, "double", "i1"))
        self.words, self.halves = f"<{lanes} x i64>", f"<{lanes} x i32>"
        wide = target.permutes
        self.permutes = wide if wide and program.precision == "float64" and not own and lanes % wide == 0 else 0
        self.number_at = "double" if own else self.number  # type of the constants in memory
        self.entries = f"<{lanes} x {self.number_at}>"
        self.gather = f"llvm.masked.gather.v{lanes}f{64 if self.number_at == 'double' else 32}.v{lanes}p0"
        self.lines: list[str] = []
        self.base = ""  # address of the constants
        self.counter = 0

    def _new(self, text: str) -> str:
        self.counter += 1
        name = f"%v{self.counter}"
        self.lines.append(f"  {name} = {text}")
        return name

    def _every(self, kind: str, literal: str) -> str:
        return _filled_lanes(kind, literal, self.lanes)

    def _splat(self, scalar: str, kind: str) -> str:
        """Return a vector with a scalar in every lane."""
        vector = f"<{self.lanes} x {kind}>"
        one = self._new(f"insertelement {vector} poison, {kind} {scalar}, i32 0")
        return self._new(f"shufflevector {vector} {one}, {vector} poison, <{self.lanes} x i32> zeroinitializer")

    def _load(self, address: str) -> str:
        """Load numbers that are stored as doubles."""
        return self._narrow(self._new(f"load {self.doubles}, ptr {address}, align 8"))

    def _narrow(self, doubles: str) -> str:
        if self.number == "double":
            return doubles
        return self._new(f"fptrunc {self.doubles} {doubles} to {self.numbers}")

    def _widen(self, numbers: str) -> str:
        """Return numbers converted to doubles."""
        return numbers if self.number == "double" else self._new(f"fpext {self.numbers} {numbers} to {self.doubles}")

    def _row(self, base: str, first: str, index: int) -> str:
        """Return the address of row ``first + index`` in an array of vectors of doubles."""
        row = self._new(f"add i64 {first}, {index}")
        offset = self._new(f"mul i64 {row}, {self.lanes}")
        return self._new(f"getelementptr double, ptr {base}, i64 {offset}")

    def _address(self, base: str, index: int | str) -> str:
        """Return the address of a constant; with constants per lane, the address of that of the first lane."""
        if self.own:
            index = self._new(f"mul i64 {index}, {self.lanes}")
        return self._new(f"getelementptr {self.number_at}, ptr {base}, i64 {index}")

    def _coefficient(self, index: int | str, base: str | None = None) -> str:
        """Return a constant as a vector, given its position relative to an address."""
        address = self._address(base or self.base, index)
        if self.own:
            return self._load(address)
        return self._splat(self._new(f"load {self.number}, ptr {address}, align 4"), self.number)

    def _table(self, table: int) -> str:
        """Return the address of a table."""
        before = len(self.program.constants) + sum(len(values) for values in self.program.tables[:table])
        start = "%constants" if not self.own else self.base
        places = before * (self.lanes if self.own else 1)
        return self._new(f"getelementptr {self.number_at}, ptr {start}, i64 {places}")

    def _permuted(self, base: str, words: str) -> str:
        """Return the entries of a table at the last three bits of words, as many as one instruction permutes."""
        wide = self.permutes
        U, V = f"<{wide} x i64>", f"<{wide} x double>"
        function, numbers, places = _PERMUTES[wide]
        if wide == EIGHT:
            entries = self._new(f"load {V}, ptr {base}, align 8")
            return self._new(f"call {V} @{function}({V} {entries}, {U} {words})")
        # AVX2 permutes eight floats. Entry k of four doubles is the pair of floats 2k and 2k + 1, so position k becomes
        # the pair (2k, 2k + 1). Both halves of the table are permuted by the last two bits; the third bit selects one.
        twice = self._new(f"shl {U} {words}, {_filled_lanes('i64', 1, wide)}")
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
        # bit 2 is shifted to bit 63, the sign
        sign = self._new(f"shl {U} {words}, {_filled_lanes('i64', 61, wide)}")
        upper = self._new(f"icmp slt {U} {sign}, zeroinitializer")
        return self._new(f"select <{wide} x i1> {upper}, {V} {halves[1]}, {V} {halves[0]}")

    def _gathered(self, base: str, kind: str, offsets: str) -> str:
        # with constants per lane, entry k of lane i is at position k·lanes + i
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

    def _part(self, name: str, kind: str, lanes: range, narrower: str) -> str:
        """Return some lanes of a vector of type ``kind``, as a vector of type ``narrower``."""
        if kind == narrower:
            return name
        chosen = ", ".join(f"i32 {lane}" for lane in lanes)
        return self._new(f"shufflevector {kind} {name}, {kind} poison, <{len(lanes)} x i32> <{chosen}>")

    def _joined(self, parts: Sequence[str]) -> str:
        """Return the concatenation of vectors of doubles, in pairwise steps."""
        width = self.lanes // len(parts)
        while len(parts) > 1:
            kind, chosen = f"<{width} x double>", ", ".join(f"i32 {lane}" for lane in range(2 * width))
            width *= 2
            parts = [
                self._new(f"shufflevector {kind} {one}, {kind} {other}, <{width} x i32> <{chosen}>")
                for one, other in zip(parts[::2], parts[1::2], strict=True)
            ]
        return parts[0]


class _Body(_CodeLines):
    """Writer of the LLVM IR of one time step, which records the name of each operation's value."""

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
        """Write operations as LLVM IR in the given order, in which each operation follows its operands."""
        for index in indices:
            op = self.program.ops[index]
            if op.name == "product":
                self.vectors[index] = self._product(op.arguments[0], op.reads)
            elif index in self.fused:
                self.names[index] = self._fused_sum(op, self.fused[index])
            else:
                self.names[index] = self._operation(op.name, op.arguments)

    def kind(self, index: int) -> str:
        """Return the LLVM type of an operation's value."""
        name = self.program.ops[index].name
        if name in ("greater", "less_equal", "and", "not", "any_bit"):
            return self.truths
        if name not in (*_INTEGER, *_SHIFT, "rotate_left", "upper", "lower", "bits"):
            return self.numbers
        return self.halves if self.names[index] in self.halves_known else self.words

    def added_up(self, index: int, before: str) -> str:
        """Write the LLVM instruction that adds the value of an operation in this step to its sum over the steps."""
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
        """Write the LLVM instruction for one·other + term. It rounds only once if the processor can do this."""
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
        before += sum(len(_tile_columns(rows, tile)) for rows in program.matrices[:matrix] for tile in tiles(rows))
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


class _Printer(_Body):
    """Writes a time step inside the loops over blocks, windows of steps, and steps."""

    def __init__(self, program: Program, target: Target, lanes: int, build: Build, own: bool) -> None:
        super().__init__(program, target, lanes, build, own)
        self.target = target
        # random numbers run ahead, unless a run has few steps (``own``, inputs), or a step fills the processor's window
        alone = own or self.alone or bool(program.inputs)
        self.ahead = _Ahead() if alone else _find_ahead(program, self.printed, self.fused, self.summed)

    def text(self) -> str:
        program, V, U, L = self.program, self.numbers, self.words, self.lanes
        # sections are written in the order of execution, as each uses names that the previous one has defined
        outer = self._section(self._load_constants)
        body = self._section(self._tick)
        kinds = [U if state.word else V for state in program.states]
        # values that a step passes to the next one: states, and random numbers that run one step ahead. They enter the
        # loop over windows from ``outer``, and the loop over steps from the previous step.
        turning = [(f"state{i}", *row) for i, row in enumerate(zip(kinds, self.first, self.following, strict=True))]
        turning += [(f"early{i}", *row) for i, row in enumerate(zip(self.kinds, self.begun, self.drawn, strict=True))]
        starts = [f"  %{name}_from = phi {T} [ {a}, %outer ], [ {b}, %flush ]" for name, T, a, b in turning]
        phis = [f"  %{name} = phi {T} [ %{name}_from, %window ], [ {b}, %{self.label} ]" for name, T, _, b in turning]
        phis += [
            f"  %sum{i} = phi {V} [ zeroinitializer, %window ], [ %next_sum{i}, %{self.label} ]"
            for i in range(len(program.sums))
        ]
        flush = self._section(self._add_sums)
        stores = self._section(self._store_states)
        return "\n".join(
            [
                self.target.heading,
                f"declare {V} @llvm.sqrt.v{L}f{self.bits}({V})",
                f"declare {V} @llvm.fmuladd.v{L}f{self.bits}({V}, {V}, {V})",
                f"declare {U} @llvm.fshl.v{L}i64({U}, {U}, {U})",
                *self._permutation(),
                f"declare {self.entries} @{self.gather}(<{L} x ptr>, i32, {self.truths}, {self.entries})",
                "",
                "define void @run(i64 %first, i64 %end, i64 %ticks, ptr noalias %state, ptr noalias %sums, "
                "ptr noalias readonly %constants, ptr noalias readonly %inputs, ptr noalias %outputs) "
                # without "stackrealign", spilled vectors may be unaligned, so that the speed varies from run to run
                f'nounwind "stackrealign" {self.target.attributes} {{',
                "entry:",
                f"  %column = alloca {V}, i64 {max((len(op.arguments) for op in program.ops), default=1)}",
                "  %nought = alloca i64",
                "  store i64 0, ptr %nought",
                "  br label %outer",
                "outer:",
                "  %block = phi i64 [ %first, %entry ], [ %next_block, %finish ]",
                *outer,
                "  br label %window",
                "window:",
                "  %at = phi i64 [ 0, %outer ], [ %next_k, %flush ]",
                *starts,
                f"  %whole = add i64 %at, {WINDOW}",
                "  %is_whole = icmp slt i64 %whole, %ticks",
                "  %until = select i1 %is_whole, i64 %whole, i64 %ticks",
                "  br label %tick",
                "tick:",
                f"  %k = phi i64 [ %at, %window ], [ %next_k, %{self.label} ]",
                *phis,
                *body,
                "  %next_k = add i64 %k, 1",
                "  %more = icmp slt i64 %next_k, %until",
                "  br i1 %more, label %tick, label %flush",
                "flush:",
                *flush,
                "  %on = icmp slt i64 %next_k, %ticks",
                "  br i1 %on, label %window, label %finish",
                "finish:",
                *stores,
                "  %next_block = add i64 %block, 1",
                "  %again = icmp slt i64 %next_block, %end",
                "  br i1 %again, label %outer, label %done",
                "done:",
                "  ret void",
                "}",
                "",
            ]
        )

    def _section(self, write: Callable[[], None]) -> list[str]:
        self.lines = []
        write()
        return self.lines

    def _permutation(self) -> list[str]:
        """Return the declaration of the instruction that permutes tables."""
        if not self.permutes:
            return []
        function, numbers, places = _PERMUTES[self.permutes]
        return [f"declare {numbers} @{function}({numbers}, {places})"]

    def _load_constants(self) -> None:
        self.base = "%constants"
        if self.own:
            size = self._new(f"mul i64 %block, {len(constants_of(self.program)) * self.lanes}")
            self.base = self._new(f"getelementptr double, ptr %constants, i64 {size}")
        self.constants = [] if self.alone else [self._coefficient(i) for i in range(len(self.program.constants))]
        self._load_states()
        self.first = [f"%start{i}" for i in range(len(self.program.states))]
        self.memory = "%start"
        self.begun = self._draw()
        self.kinds = [self.kind(i) for i in self.ahead.carried]
        self.first, self.memory = self._moved(self.first), "%state"

    def _draw(self) -> list[str]:
        """Write the operations that run ahead; return the names of the values that the step reads."""
        ahead = {*self.ahead.operations}
        if ahead:
            free = (*_FREE_OPERATIONS, "state")
            self.operations(i for i in self.printed if i in ahead or self.program.ops[i].name in free)
        return [self.names[i] for i in self.ahead.carried]

    def _moved(self, before: Sequence[str]) -> list[str]:
        """Return the names of the states after random numbers are drawn; if these run ahead, the words have changed."""
        states = zip(self.program.states, self.program.following, before, strict=True)
        return [self.names[index] if state.word and self.ahead.carried else name for state, index, name in states]

    def _load_states(self) -> None:
        first = self._new(f"mul i64 %block, {len(self.program.states)}")
        for i, state in enumerate(self.program.states):
            address, name = self._row("%state", first, i), f"%start{i}"
            if state.word:
                self.lines.append(f"  {name} = load {self.words}, ptr {address}, align 8")
            elif self.number == "double":
                self.lines.append(f"  {name} = load {self.doubles}, ptr {address}, align 8")
            else:
                doubles = self._new(f"load {self.doubles}, ptr {address}, align 8")
                self.lines.append(f"  {name} = fptrunc {self.doubles} {doubles} to {self.numbers}")

    def _add_sums(self) -> None:
        first = self._new(f"mul i64 %block, {len(self.program.sums)}")
        for i in range(len(self.program.sums)):
            address = self._row("%sums", first, i)
            before = self._new(f"load {self.doubles}, ptr {address}, align 8")
            total = self._new(f"fadd {self.flags}{self.doubles} {before}, {self._widen(f'%next_sum{i}')}")
            self.lines.append(f"  store {self.doubles} {total}, ptr {address}, align 8")

    def _store_states(self) -> None:
        first = self._new(f"mul i64 %block, {len(self.program.states)}")
        for i, index in enumerate(self.program.following):
            address, word = self._row("%state", first, i), self.program.states[i].word
            value = f"%state{i}" if word and self.ahead.carried else self.names[index]  # words are one step ahead
            shown = f"{self.words} {value}" if word else f"{self.doubles} {self._widen(value)}"
            self.lines.append(f"  store {shown}, ptr {address}, align 8")

    def _tick(self) -> None:
        program = self.program
        at = self._new("mul i64 %block, %ticks")
        at = self._new(f"add i64 {at}, %k")
        self.first_input = self._new(f"mul i64 {at}, {len(program.inputs)}")
        self.label = "tick"
        # an address that is opaque to the compiler, so that it does not load all constants before the loop
        zero = self._new("load volatile i64, ptr %nought, align 8")
        self.base = self._new(f"getelementptr {self.number_at}, ptr {self.base}, i64 {zero}")
        self.drawn = self._draw()
        moved = self._moved([""] * len(program.states))
        for place, (index, name) in enumerate(zip(self.ahead.carried, self.drawn, strict=True)):
            self.names[index] = self._half(f"%early{place}", name in self.halves_known)
        ahead = {*self.ahead.operations}
        self.operations(i for i in self.printed if i not in ahead)
        self.following = [name or self.names[i] for name, i in zip(moved, program.following, strict=True)]
        first = self._new(f"mul i64 {at}, {len(program.outputs)}")
        for i, index in enumerate(program.outputs.values()):
            address = self._row("%outputs", first, i)
            self.lines.append(f"  store {self.doubles} {self._widen(self.names[index])}, ptr {address}, align 8")
        for i, total in enumerate(program.totals.values()):
            self.lines.append(f"  %next_sum{i} = {self.added_up(total.op, f'%sum{i}')}")


def _fused(program: Program, live: set[int]) -> tuple[dict[int, int], set[int]]:
    """Return the fused products of the fast build: by sum or difference, and the set of those summed over steps."""
    # a product is fused only if no other operation reads it; otherwise it would be computed twice
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


@dataclass(frozen=True)
class _Ahead:
    """The operations of a time step that are computed one step ahead."""

    operations: tuple[int, ...] = ()  # the operations in the order of the program
    carried: tuple[int, ...] = ()  # operations whose values the step itself reads


def _find_ahead(program: Program, printed: Sequence[int], fused: Mapping[int, int], summed: Set[int]) -> _Ahead:
    """Return the operations that can run one step ahead: those that depend only on words of the random generator."""
    # an operation runs ahead if each operand is a constant, a word in memory, or an operation that runs ahead
    found, words = set[int](), set[int]()
    reads = {index: _reads(program, index, fused) for index in printed}
    for index in printed:
        op = program.ops[index]
        if op.name == "state" and program.states[op.arguments[0]].word:
            words.add(index)
        elif op.name not in (*_FREE_OPERATIONS, "state", "input", "product", "entry"):
            computed = [i for i in reads[index] if program.ops[i].name not in _FREE_OPERATIONS]
            if computed and found.union(words).issuperset(computed):
                found.add(index)
    # values that the step itself reads: for next states, outputs, sums, and operations that do not run ahead
    numbers = [i for i, state in zip(program.following, program.states, strict=True) if not state.word]
    totals = {total.op for total in program.totals.values()}
    read = {*numbers, *program.outputs.values(), *totals - summed}
    read.update(i for product in totals & summed for i in program.ops[product].reads)
    read.update(i for index in printed if index not in found for i in reads[index])
    # The words must be advanced together with the random numbers. This is impossible if the step itself reads a word,
    # or if the next value of a word does not run ahead.
    moved = {i for i, state in zip(program.following, program.states, strict=True) if state.word}
    carried = tuple(sorted(found & read))
    if not carried or words & read or not moved <= found | words:
        return _Ahead()
    return _Ahead(tuple(sorted(found)), carried)


def _reads(program: Program, index: int, fused: Mapping[int, int]) -> tuple[int, ...]:
    """Return the operations that an operation reads, with the operands of a fused product instead of the product."""
    reads, product = program.ops[index].reads, fused.get(index)
    if product is None:
        return reads
    return (*program.ops[product].reads, *(i for i in reads if i != product))


def _tile_columns(matrix: MatrixRows, tile: Tile) -> list[float]:
    """Return the coefficients of a tile (block) of a matrix, column by column."""
    return [row[j] for j in range(tile.begin, tile.end) for row in matrix[tile.first : tile.first + tile.rows]]


def _filled_lanes(kind: str, literal: object, lanes: int) -> str:
    """Return an LLVM vector constant with the same number in every lane."""
    return "<" + ", ".join([f"{kind} {literal}"] * lanes) + ">"
