"""Prints a program as LLVM IR for vectors of numbers: one lane, one path; the loop over ticks stays in registers.

The printed function runs blocks of ``lanes`` paths through any number of ticks:

    void run(i64 first, i64 end, i64 ticks,
             double* state, double* sums, double* constants, double* inputs, double* outputs)

with state (blocks, states, lanes), sums (blocks, sums, lanes), inputs (blocks, ticks, inputs, lanes) and outputs alike.
All of it is doubles, whatever the precision of the program. What is added up over a window of ticks is added to the
sums in memory. Constants and tables are read from memory, so programs of equal structure share one machine code.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

from taciturn.program.ir import Program
from taciturn.program.ops import EIGHT, WINDOW, Precision

Build = Literal["parity", "fast"]
_FLAGS: Mapping[Build, str] = {
    "parity": "",  # every operation rounds once, as in NumPy
    "fast": "nsz contract ",  # fused multiply-add; no reassociation: it breaks the bit tricks of the draws
}
PERMUTE = "llvm.x86.avx512.permvar.df.512"
_NUMBER: Mapping[Precision, tuple[str, int]] = {"float64": ("double", 64), "float32": ("float", 32)}
_ARITHMETIC = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv"}
_INTEGER = {"word_add": "add", "word_and": "and", "word_or": "or", "word_xor": "xor"}
_SHIFT = {"shift_left": "shl", "shift_right": "lshr"}


def print_llvm(program: Program, lanes: int, build: Build) -> str:
    """Return the text of a module with the function ``run``.

    Args:
        program: the program.
        lanes: paths per block, the width of the vectors.
        build: ``"parity"`` agrees with NumPy bit for bit, ``"fast"`` lets multiplications and additions fuse.
    """
    return _Printer(program, lanes, build).text()


def constants_of(program: Program) -> list[float]:
    """Return what the argument ``constants`` must hold: the constants, then the tables."""
    return [*program.constants, *(value for table in program.tables for value in table)]


class _Printer:
    def __init__(self, program: Program, lanes: int, build: Build) -> None:
        self.program, self.lanes, self.flags = program, lanes, _FLAGS[build]
        self.number, self.bits = _NUMBER[program.precision]
        self.numbers, self.doubles, self.truths = (f"<{lanes} x {kind}>" for kind in (self.number, "double", "i1"))
        self.words, self.halves = f"<{lanes} x i64>", f"<{lanes} x i32>"
        self.halves_known: set[str] = set()
        self.permutes = lanes == EIGHT and program.precision == "float64"
        self.gather = f"llvm.masked.gather.v{lanes}f64.v{lanes}p0"
        self.lines: list[str] = []
        self.counter = 0

    def text(self) -> str:
        program, V, U, L = self.program, self.numbers, self.words, self.lanes
        entry = self._section(self._load_constants)
        outer = self._section(self._load_states)
        body = self._section(self._tick)
        phis = [
            f"  %state{i} = phi {U if state.word else V} [ %from{i}, %window ], [ {self.names[index]}, %tick ]"
            for i, (state, index) in enumerate(zip(program.states, program.following, strict=True))
        ]
        starts = [
            f"  %from{i} = phi {U if state.word else V} [ %start{i}, %outer ], [ {self.names[index]}, %flush ]"
            for i, (state, index) in enumerate(zip(program.states, program.following, strict=True))
        ]
        phis += [
            f"  %sum{i} = phi {V} [ zeroinitializer, %window ], [ %next_sum{i}, %tick ]"
            for i in range(len(program.sums))
        ]
        flush = self._section(self._add_sums)
        stores = self._section(self._store_states)
        return "\n".join(
            [
                f"declare {V} @llvm.sqrt.v{L}f{self.bits}({V})",
                f"declare {U} @llvm.fshl.v{L}i64({U}, {U}, {U})",
                *([f"declare {V} @{PERMUTE}({V}, {U})"] if self.permutes else []),
                f"declare {self.doubles} @{self.gather}(<{L} x ptr>, i32, {self.truths}, {self.doubles})",
                "",
                "define void @run(i64 %first, i64 %end, i64 %ticks, ptr noalias %state, ptr noalias %sums, "
                "ptr noalias readonly %constants, ptr noalias readonly %inputs, ptr noalias %outputs) "
                '"stackrealign" {',  # without it, spills are unaligned and speed is bimodal
                "entry:",
                *entry,
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
                "  %k = phi i64 [ %at, %window ], [ %next_k, %tick ]",
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

    def _section(self, write: object) -> list[str]:
        assert callable(write)
        self.lines = []
        write()
        return self.lines

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

    def _row(self, base: str, first: str, index: int) -> str:
        """Return the address of row ``index`` behind row ``first`` of an array of vectors of doubles."""
        row = self._new(f"add i64 {first}, {index}")
        offset = self._new(f"mul i64 {row}, {self.lanes}")
        return self._new(f"getelementptr double, ptr {base}, i64 {offset}")

    def _load_constants(self) -> None:
        self.constants: list[str] = []
        for i in range(len(self.program.constants)):
            address = self._new(f"getelementptr double, ptr %constants, i64 {i}")
            constant = self._new(f"load double, ptr {address}, align 8")
            if self.number != "double":
                constant = self._new(f"fptrunc double {constant} to {self.number}")
            self.constants.append(self._splat(constant, self.number))

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
            address, value = self._row("%state", first, i), self.names[index]
            shown = f"{self.words} {value}" if self.program.states[i].word else f"{self.doubles} {self._widen(value)}"
            self.lines.append(f"  store {shown}, ptr {address}, align 8")

    def _tick(self) -> None:
        program = self.program
        at = self._new("mul i64 %block, %ticks")
        at = self._new(f"add i64 {at}, %k")
        self.first_input = self._new(f"mul i64 {at}, {len(program.inputs)}")
        self.names: list[str] = []
        for op in program.ops:
            self.names.append(self._operation(op.name, op.arguments))
        first = self._new(f"mul i64 {at}, {len(program.outputs)}")
        for i, index in enumerate(program.outputs.values()):
            address = self._row("%outputs", first, i)
            self.lines.append(f"  store {self.doubles} {self._widen(self.names[index])}, ptr {address}, align 8")
        for i, total in enumerate(program.totals.values()):
            self.lines.append(f"  %next_sum{i} = fadd {self.flags}{self.numbers} %sum{i}, {self.names[total.op]}")

    def _operation(self, name: str, rest: Sequence[int]) -> str:
        V, B, names = self.numbers, self.truths, self.names
        if name == "const":
            return self.constants[rest[0]]
        if name == "state":
            return f"%state{rest[0]}"
        if name == "input":
            return self._load(self._row("%inputs", self.first_input, rest[0]))
        if name in _ARITHMETIC:
            return self._new(f"{_ARITHMETIC[name]} {self.flags}{V} {names[rest[0]]}, {names[rest[1]]}")
        if name == "sqrt":
            return self._new(f"call {self.flags}{V} @llvm.sqrt.v{self.lanes}f{self.bits}({V} {names[rest[0]]})")
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

    def _every(self, kind: str, literal: str) -> str:
        return "<" + ", ".join([f"{kind} {literal}"] * self.lanes) + ">"

    def _table(self, table: int) -> str:
        """Return the address of a table."""
        before = len(self.program.constants) + sum(len(values) for values in self.program.tables[:table])
        return self._new(f"getelementptr double, ptr %constants, i64 {before}")

    def _pick(self, table: int, word: int) -> str:
        """A table of eight doubles fits one register of AVX-512, and is permuted there; elsewhere it is gathered."""
        base, U = self._table(table), self.words
        if self.permutes:
            entries = self._new(f"load {self.doubles}, ptr {base}, align 8")
            return self._new(f"call {self.doubles} @{PERMUTE}({self.doubles} {entries}, {U} {self.names[word]})")
        offsets = self._new(f"and {U} {self.names[word]}, {self._every('i64', str(EIGHT - 1))}")
        return self._gathered(base, U, offsets)

    def _lookup(self, table: int, index: int) -> str:
        integers = self.halves  # every vector unit converts to these; few to 64 bits
        offsets = self._new(f"fptosi {self.numbers} {self.names[index]} to {integers}")
        return self._gathered(self._table(table), integers, offsets)

    def _gathered(self, base: str, kind: str, offsets: str) -> str:
        addresses = self._new(f"getelementptr double, ptr {base}, {kind} {offsets}")
        doubles = self._new(
            f"call {self.doubles} @{self.gather}(<{self.lanes} x ptr> {addresses}, i32 8, "
            f"{self.truths} {self._every('i1', 'true')}, {self.doubles} zeroinitializer)"
        )
        return self._narrow(doubles)
