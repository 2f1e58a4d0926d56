"""Prints a program as LLVM IR for vectors of doubles: one lane, one path; the loop over ticks stays in registers.

The printed function runs blocks of ``lanes`` paths through any number of ticks:

    void run(i64 first, i64 end, i64 ticks,
             double* state, double* sums, double* constants, double* inputs, double* outputs)

with state (blocks, states, lanes), sums (blocks, sums, lanes), inputs (blocks, ticks, inputs, lanes) and outputs alike.
Constants and tables are read from memory, so programs of equal structure share one machine code.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

from taciturn.program.ir import Program

Build = Literal["parity", "fast"]
_FLAGS: Mapping[Build, str] = {
    "parity": "",  # every operation rounds once, as in NumPy
    "fast": "nsz contract ",  # fused multiply-add; no reassociation: it breaks the bit tricks of the draws
}
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
        self.doubles, self.words, self.truths = f"<{lanes} x double>", f"<{lanes} x i64>", f"<{lanes} x i1>"
        self.gather = f"llvm.masked.gather.v{lanes}f64.v{lanes}p0"
        self.lines: list[str] = []
        self.counter = 0

    def text(self) -> str:
        program, V, U = self.program, self.doubles, self.words
        entry = self._section(self._load_constants)
        outer = self._section(self._load_states)
        body = self._section(self._tick)
        phis = [
            f"  %state{i} = phi {U if state.word else V} [ %start{i}, %outer ], [ {self.names[index]}, %tick ]"
            for i, (state, index) in enumerate(zip(program.states, program.following, strict=True))
        ]
        phis += [
            f"  %sum{i} = phi {V} [ zeroinitializer, %outer ], [ %next_sum{i}, %tick ]"
            for i in range(len(program.sums))
        ]
        stores = self._section(self._store_results)
        return "\n".join(
            [
                f"declare {V} @llvm.sqrt.v{self.lanes}f64({V})",
                f"declare {U} @llvm.fshl.v{self.lanes}i64({U}, {U}, {U})",
                f"declare {V} @{self.gather}(<{self.lanes} x ptr>, i32, {self.truths}, {V})",
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
                "  br label %tick",
                "tick:",
                "  %k = phi i64 [ 0, %outer ], [ %next_k, %tick ]",
                *phis,
                *body,
                "  %next_k = add i64 %k, 1",
                "  %more = icmp slt i64 %next_k, %ticks",
                "  br i1 %more, label %tick, label %finish",
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

    def _row(self, base: str, first: str, index: int) -> str:
        """Return the address of row ``index`` behind row ``first`` of an array of vectors of doubles."""
        row = self._new(f"add i64 {first}, {index}")
        offset = self._new(f"mul i64 {row}, {self.lanes}")
        return self._new(f"getelementptr double, ptr {base}, i64 {offset}")

    def _load_constants(self) -> None:
        self.constants: list[str] = []
        for i in range(len(self.program.constants)):
            address = self._new(f"getelementptr double, ptr %constants, i64 {i}")
            self.constants.append(self._splat(self._new(f"load double, ptr {address}, align 8"), "double"))

    def _load_states(self) -> None:
        first = self._new(f"mul i64 %block, {len(self.program.states)}")
        for i, state in enumerate(self.program.states):
            address, kind = self._row("%state", first, i), self.words if state.word else self.doubles
            self.lines.append(f"  %start{i} = load {kind}, ptr {address}, align 8")

    def _store_results(self) -> None:
        first = self._new(f"mul i64 %block, {len(self.program.states)}")
        for i, index in enumerate(self.program.following):
            kind = self.words if self.program.states[i].word else self.doubles
            self.lines.append(f"  store {kind} {self.names[index]}, ptr {self._row('%state', first, i)}, align 8")
        first = self._new(f"mul i64 %block, {len(self.program.sums)}")
        for i in range(len(self.program.sums)):
            self.lines.append(f"  store {self.doubles} %next_sum{i}, ptr {self._row('%sums', first, i)}, align 8")

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
            self.lines.append(f"  store {self.doubles} {self.names[index]}, ptr {address}, align 8")
        for i, index in enumerate(program.sums.values()):
            self.lines.append(f"  %next_sum{i} = fadd {self.flags}{self.doubles} %sum{i}, {self.names[index]}")

    def _operation(self, name: str, rest: Sequence[int]) -> str:
        V, U, B, names = self.doubles, self.words, self.truths, self.names
        if name == "const":
            return self.constants[rest[0]]
        if name == "state":
            return f"%state{rest[0]}"
        if name == "input":
            return self._new(f"load {V}, ptr {self._row('%inputs', self.first_input, rest[0])}, align 8")
        if name in _ARITHMETIC:
            return self._new(f"{_ARITHMETIC[name]} {self.flags}{V} {names[rest[0]]}, {names[rest[1]]}")
        if name == "sqrt":
            return self._new(f"call {self.flags}{V} @llvm.sqrt.v{self.lanes}f64({V} {names[rest[0]]})")
        if name == "select":
            return self._new(f"select {B} {names[rest[0]]}, {V} {names[rest[1]]}, {V} {names[rest[2]]}")
        if name == "lookup":
            return self._lookup(*rest)
        if name in ("greater", "less_equal"):
            return self._new(f"fcmp {'ogt' if name == 'greater' else 'ole'} {V} {names[rest[0]]}, {names[rest[1]]}")
        if name == "and":
            return self._new(f"and {B} {names[rest[0]]}, {names[rest[1]]}")
        if name == "not":
            return self._new(f"xor {B} {names[rest[0]]}, {self._every('i1', 'true')}")
        if name == "word":
            return self._every("i64", str(rest[0]))
        if name in _INTEGER:
            return self._new(f"{_INTEGER[name]} {U} {names[rest[0]]}, {names[rest[1]]}")
        if name in _SHIFT:
            return self._new(f"{_SHIFT[name]} {U} {names[rest[0]]}, {self._every('i64', str(rest[1]))}")
        if name == "rotate_left":
            x, by = names[rest[0]], self._every("i64", str(rest[1]))
            return self._new(f"call {U} @llvm.fshl.v{self.lanes}i64({U} {x}, {U} {x}, {U} {by})")
        if name == "bits":
            return self._new(f"bitcast {V} {names[rest[0]]} to {U}")
        if name == "double":
            return self._new(f"bitcast {U} {names[rest[0]]} to {V}")
        assert name == "any_bit", name
        return self._new(f"icmp ne {U} {names[rest[0]]}, {self._every('i64', '0')}")

    def _every(self, kind: str, literal: str) -> str:
        return "<" + ", ".join([f"{kind} {literal}"] * self.lanes) + ">"

    def _lookup(self, table: int, index: int) -> str:
        before = len(self.program.constants) + sum(len(values) for values in self.program.tables[:table])
        base = self._new(f"getelementptr double, ptr %constants, i64 {before}")
        integers = f"<{self.lanes} x i32>"  # every vector unit converts to these; few to 64 bits
        offsets = self._new(f"fptosi {self.doubles} {self.names[index]} to {integers}")
        addresses = self._new(f"getelementptr double, ptr {base}, {integers} {offsets}")
        return self._new(
            f"call {self.doubles} @{self.gather}(<{self.lanes} x ptr> {addresses}, i32 8, "
            f"{self.truths} {self._every('i1', 'true')}, {self.doubles} zeroinitializer)"
        )
