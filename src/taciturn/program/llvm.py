"""Translation of a program to LLVM IR, on vectors with one lane per path; states stay in registers between steps.

The generated function runs blocks of ``lanes`` paths for any number of steps:

    void run(i64 first, i64 end, i64 steps,
             double* state, double* sums, double* constants, double* inputs, double* outputs)

The arrays are state (blocks, states, lanes), sums (blocks, sums, lanes), inputs (blocks, steps, inputs, lanes) and
outputs (blocks, steps, outputs, lanes). They contain doubles for both precisions of the program; only constants that
all lanes share have the precision of the program. The sums of a window of steps are added to the sums in memory at its
end. Constants and tables are read from memory, so that programs of equal structure share machine code.
"""

from __future__ import annotations

from collections.abc import Sequence

from taciturn.program._llvm_ahead import FREE_OPERATIONS, Ahead, find_ahead
from taciturn.program._llvm_body import Body, Build
from taciturn.program._llvm_lines import PERMUTES, constants_of
from taciturn.program.ir import Program
from taciturn.program.ops import WINDOW
from taciturn.program.target import Target


def print_llvm(program: Program, target: Target, lanes: int, build: Build, own: bool = False) -> str:
    """Return the text of an LLVM module whose function ``run`` runs a program for many steps and paths.

    Args:
        program: the program.
        target: the processor.
        lanes: paths per block and vector, a power of two, at least 2.
        build: ``"parity"``, bit-identical to NumPy, or ``"fast"``, which fuses multiplications and additions.
        own: whether each lane has its own constants, (blocks, constants, lanes).
    """
    return _Printer(program, target, lanes, build, own).text()


class _Printer(Body):
    """Writes a time step inside the loops over blocks, windows of steps, and steps."""

    def __init__(self, program: Program, target: Target, lanes: int, build: Build, own: bool) -> None:
        super().__init__(program, target, lanes, build, own)
        self.target = target
        # random numbers run ahead, unless a run has few steps (``own``, inputs), or a step fills the processor's window
        alone = own or self.alone or bool(program.inputs)
        self.ahead = Ahead() if alone else find_ahead(program, self.printed, self.fused, self.summed)

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

    def _section(self, write: object) -> list[str]:
        assert callable(write)
        self.lines = []
        write()
        return self.lines

    def _permutation(self) -> list[str]:
        """Return the declaration of the instruction that permutes tables."""
        if not self.permutes:
            return []
        function, numbers, places = PERMUTES[self.permutes]
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
            free = (*FREE_OPERATIONS, "state")
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
