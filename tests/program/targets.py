"""Processors to print for, what is printed, and how it is compiled without harm to the process that asks."""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from parity.loops import every_feature, programs, with_functions
from systems import make_system

import taciturn
from taciturn.model.plant import Jumps
from taciturn.program.functions import exponential_of, falling, logarithm
from taciturn.program.ir import Builder, Program
from taciturn.program.llvm import Build, Target, print_llvm
from taciturn.program.ops import Precision, State
from taciturn_events.events import IntegralTrigger, JumpProcess, cycle_program

LINUX, WINDOWS, APPLE = "x86_64-unknown-linux-gnu", "x86_64-pc-windows-msvc", "x86_64-apple-macosx"
TARGETS = {
    "AVX-512": Target(LINUX, "skylake-avx512", "+avx2,+fma,+avx512f,+avx512dq"),
    "AVX-512 without more": Target(LINUX, "x86-64", "+avx512f"),
    "Zen 3": Target(LINUX, "znver3", "+avx2,+fma"),
    "AVX2": Target(LINUX, "haswell", "+avx2,+fma"),
    "AVX2 without FMA": Target(LINUX, "x86-64", "+avx2"),
    "a name alone": Target(LINUX, "skylake-avx512", ""),
    "SSE2": Target(LINUX, "x86-64", ""),
    "NEON": Target("aarch64-unknown-linux-gnu", "cortex-a72", "+neon"),
    "any ARM": Target("aarch64-unknown-linux-gnu", "", ""),
    "Apple": Target("arm64-apple-macosx", "apple-m1", "+neon"),
    "Apple on x86": Target(APPLE, "haswell", "+avx2,+fma"),
    "Windows": Target(WINDOWS, "haswell", "+avx2,+fma"),
    "Windows on any x86": Target(WINDOWS, "x86-64", ""),
    "Windows with AVX-512": Target(WINDOWS, "skylake-avx512", "+avx2,+fma,+avx512f,+avx512dq"),
    "Windows on ARM": Target("aarch64-pc-windows-msvc", "", "+neon"),
}
SUPPLIED = {name: {"__chkstk"} if "windows" in target.triple else set[str]() for name, target in TARGETS.items()}
Text = tuple[Target, str]
CHILD = """
import pickle, sys
from pathlib import Path
import llvmlite.binding as llvm
from taciturn.program import machine
llvm.initialize_all_targets()
llvm.initialize_all_asmprinters()
folder = Path(sys.argv[1])
for number, (target, text) in enumerate(pickle.loads((folder / "texts").read_bytes())):
    (folder / "at").write_text(str(number))
    (folder / f"{number}.o").write_bytes(machine.compile_object(text, target))
    if "assembly" in sys.argv:
        (folder / f"{number}.s").write_text(machine._machine(target).emit_assembly(llvm.parse_assembly(text)))
"""


def compiled(texts: Sequence[Text], folder: Path, *more: str) -> list[bytes]:
    """Return the object code of each text, compiled in another process: LLVM ends it where it knows no way."""
    folder.mkdir(exist_ok=True)
    (folder / "texts").write_bytes(pickle.dumps(list(texts)))
    answer = subprocess.run(
        [sys.executable, "-c", CHILD, str(folder), *more], capture_output=True, text=True, check=False
    )
    if answer.returncode:
        number = int((folder / "at").read_text())
        raise AssertionError(f"text {number} for {texts[number][0]} does not compile:\n{answer.stderr}")
    return [(folder / f"{number}.o").read_bytes() for number in range(len(texts))]


def every_operation(precision: Precision) -> Program:
    """Return a small program in which every operation occurs, and a matrix that is multiplied in a loop."""
    b = Builder(precision)
    x, y = b.input("x"), b.state(State("y", 0, 1.5))
    large = b.transform(np.random.default_rng(1).normal(size=(20, 20)).tolist(), [x, y] * 10)
    dense = [index for index in large if index is not None]
    positive = b.emit("greater", x, y)
    both = b.emit("and", positive, b.emit("not", b.emit("less_equal", x, b.constant(2.0))))
    bits = b.emit("bits", x)
    if precision == "float32":
        word = b.emit("word", 77)
        half = b.emit("word_add", b.emit("upper", word), b.emit("lower", word))
        counted = b.emit("count", b.emit("word_xor", half, bits))
    else:
        word = b.emit("rotate_left", bits, 23)
        counted = b.pick(tuple(float(k) for k in range(8)), word)
    drawn = b.emit("select", b.emit("any_bit", word), counted, b.emit("narrow", x))
    table = b.value(b.lookup((1.0, 2.5, -3.0), b.emit("select", both, b.constant(2.0), b.constant(0.0))))
    values = [
        b.emit("div", x, b.emit("sqrt", y)),
        b.emit("select", positive, exponential_of(b, x), falling(b, y)),
        logarithm(b, x),
        drawn,
        table,
        *dense,
    ]
    return b.finish([values[1]], {"sum": values[0]}, {str(i): value for i, value in enumerate(values)})


def printed_kinds() -> Iterator[tuple[str, Program]]:
    """Return programs of every kind by name: loops, clocks, jumps, functions, nonlinear plants, large matrices."""
    two_mass = taciturn.load("two-mass-lqg")
    loops = {
        "two masses": two_mass.close(two_mass.design()),
        "a clock": two_mass.close(taciturn.design.periodic(two_mass.plant, two_mass.cost, every=3)),
        "every feature": every_feature(make_system(4, 4, 2, 2, False), 4),
        "functions": with_functions(make_system(5, 3, 1, 2, False), 5),
    }
    large = make_system(1, 20, 3, 5, False)
    loops["large"] = taciturn.close(large.plant, taciturn.design.lqg(large.plant, large.cost, theta=0.2))
    for name in ("pendulum-on-a-cart", "omni-heading"):
        problem = taciturn.load(name)
        loops[name] = problem.close(problem.design())
    for name, loop in loops.items():
        for each in (loop, replace(loop, precision="float32")):
            for program in programs(each):
                yield f"{name}, {each.precision}", program
    process = JumpProcess(np.eye(2, k=1), Jumps(1.0, np.eye(2)), np.eye(2))
    yield "jumps", cycle_program(process, IntegralTrigger(1.0))


def printed(program: Program, target: Target, build: Build, own: bool = False, lanes: int | None = None) -> Text:
    """Return a program as it is printed for a target, with as many lanes as fit its vectors if not told otherwise."""
    fitting = target.lanes * (2 if program.precision == "float32" else 1)
    return target, print_llvm(program, target, lanes or fitting, build, own)


def wide_frame() -> Program:
    """Return a program whose frame is larger than a page."""
    b = Builder()
    matrix = np.random.default_rng(2).normal(size=(8, 300)).tolist()
    values = [index for index in b.transform(matrix, [b.input(f"x {j}") for j in range(300)]) if index is not None]
    return b.finish([], {"sum": values[0]}, {str(i): value for i, value in enumerate(values)})
