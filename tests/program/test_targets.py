"""Programs compile for every processor: what LLVM cannot lower never reaches it, and no symbol is missing."""

from __future__ import annotations

import os
import pickle
import platform
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from program.symbols import undefined
from program.targets import SUPPLIED, TARGETS, Text, compiled, every_operation, printed, printed_kinds, wide_frame

import taciturn
from taciturn.errors import ProblemError
from taciturn.program import machine
from taciturn.program import numpy as interpreter
from taciturn.program.ir import Builder
from taciturn.program.llvm import VECTORS, Build, Target

BUILDS: tuple[Build, ...] = ("parity", "fast")
WIDTHS = (2, 4, 8, 16)
WITHOUT_FUSED = ("SSE2", "AVX2 without FMA", "Windows on any x86")
FUSED = ("vfma", "vfms", "vfnm", "fmla", "fmls", "fmadd", "fmsub")


def missing(texts: list[tuple[str, Text]], folder: Path, *more: str) -> dict[str, set[str]]:
    """Return what the object code of texts refers to and nobody supplies, by the name of the target."""
    found = {name: set[str]() for name, _ in texts}
    for (name, _), code in zip(texts, compiled([text for _, text in texts], folder, *more), strict=True):
        found[name] |= undefined(code) - SUPPLIED[name]
    return found


def test_the_small_program_holds_every_operation() -> None:
    """So that a new one is compiled for every processor, too."""
    found = {op.name for program in (every_operation("float64"), every_operation("float32")) for op in program.ops}
    tables = (interpreter._RULES, interpreter._OF_ONE, interpreter._OF_TABLES, interpreter._WITH_LITERAL)
    assert found == {*(name for table in tables for name in table), *interpreter._GIVEN, "product"}


@pytest.mark.evidence
def test_every_operation_compiles_for_every_processor(tmp_path: Path) -> None:
    """No function is missing, for there is no mathematical library; the bit-exact build has no fused operation."""
    double, single = every_operation("float64"), every_operation("float32")
    builds: list[Build] = []
    texts: list[tuple[str, Text]] = []
    for name, target in TARGETS.items():
        for program, build in ((double, "parity"), (double, "fast"), (single, "fast")):
            builds.append(build)
            texts.append((name, printed(program, target, build)))
    assert missing(texts, tmp_path, "assembly") == {name: set() for name in TARGETS}
    for number, (build, (name, _)) in enumerate(zip(builds, texts, strict=True)):
        lines = (tmp_path / f"{number}.s").read_text().splitlines()
        fused = any(line.split()[0].startswith(FUSED) for line in lines if line.startswith("\t"))
        assert fused == (build == "fast" and name not in WITHOUT_FUSED), name


@pytest.mark.evidence
def test_any_number_of_lanes_compiles_for_any_processor(tmp_path: Path) -> None:
    """Tables of eight are permuted as the target can, never as the lanes suggest."""
    b = Builder()
    program = b.finish([], {}, {"found": b.pick(tuple(map(float, range(8))), b.emit("bits", b.input("x")))})
    texts = [
        (name, printed(program, target, "fast", own, lanes))
        for name, target in TARGETS.items()
        for own, lanes in ((True, None), *((False, width) for width in WIDTHS))
    ]
    assert missing(texts, tmp_path) == {name: set() for name in TARGETS}
    for _, (target, text) in texts:
        assert ("permvar" in text) <= (target.permutes == 8)
        assert ("permps" in text) <= (target.permutes == 4)


@pytest.mark.evidence
@pytest.mark.parametrize("name", TARGETS)
def test_every_kind_of_program_compiles_for_every_processor(name: str, tmp_path: Path) -> None:
    """Loops of every kind, with constants of their own or shared, with any number of lanes, in either build in turn."""
    texts: list[tuple[str, Text]] = []
    for kind, program in printed_kinds():
        widths = WIDTHS if kind.startswith(("two masses", "every feature")) else (None,)
        for own, lanes in [*((False, width) for width in widths), (True, None)]:
            build = BUILDS[(len(texts) + list(TARGETS).index(name)) % 2]
            texts.append((name, printed(program, TARGETS[name], build, own, lanes)))
    assert missing(texts, tmp_path) == {name: set()}


SINE = """
declare double @llvm.sin.f64(double)
define double @run(double %x) {} {{
  %y = call double @llvm.sin.f64(double %x)
  ret double %y
}}
"""


def test_a_missing_symbol_is_found(tmp_path: Path) -> None:
    """In each kind of object file: a sine is nobody's."""
    chosen = [TARGETS[name] for name in ("SSE2", "NEON", "Apple", "Windows", "Windows on ARM")]
    texts = [(target, target.heading + SINE.format(target.attributes)) for target in chosen]
    expected = [{"_sin" if "apple" in target.triple else "sin"} for target in chosen]
    assert [undefined(code) for code in compiled(texts, tmp_path)] == expected


def test_a_text_for_another_processor_is_refused_before_llvm_sees_it() -> None:
    """LLVM would not refuse it, but end the process."""
    _, text = printed(every_operation("float64"), TARGETS["AVX-512"], "fast")
    with pytest.raises(AssertionError, match="for a processor other than"):
        machine.compile_object(text, TARGETS["AVX2"])


def test_a_compilation_that_ends_its_process_names_the_text(tmp_path: Path) -> None:
    """So that a worker of the tests never ends with it."""
    _, text = printed(every_operation("float64"), TARGETS["AVX-512"], "fast")
    less = TARGETS["SSE2"]
    changed = text.replace(TARGETS["AVX-512"].attributes, less.attributes)
    with pytest.raises(AssertionError, match=r"text 0 for Target.* does not compile"):
        compiled([(less, changed)], tmp_path)


def test_large_frames_ask_windows_for_their_pages(tmp_path: Path) -> None:
    """By the function that Windows itself supplies, and that is all that any program asks for."""
    texts = [printed(wide_frame(), TARGETS[name], "fast") for name in ("Windows", "Windows on ARM", "AVX2")]
    assert [undefined(code) for code in compiled(texts, tmp_path)] == [{"__chkstk"}, {"__chkstk"}, set()]


FOREIGN = """
import ctypes, pickle, sys
from dataclasses import replace
import llvmlite.binding as llvm
import numpy as np
from taciturn.program import machine
from taciturn.program.llvm import print_llvm

ENTER = '''
define void @probe() nounwind { ret void }
define void @enter(ptr %f, i64 %a, i64 %b, i64 %c, ptr %d, ptr %e, ptr %g, ptr %h, ptr %i) {
  call win64cc void %f(i64 %a, i64 %b, i64 %c, ptr %d, ptr %e, ptr %g, ptr %h, ptr %i)
  ret void
}
'''
host = machine.host()
bridge = llvm.create_mcjit_compiler(llvm.parse_assembly(ENTER), machine._machine(host))
bridge.finalize_object()
llvm.add_symbol("__chkstk", bridge.get_function_address("probe"))
kind = ctypes.CFUNCTYPE(None, ctypes.c_void_p, *[ctypes.c_int64] * 3, *[ctypes.c_void_p] * 5)
enter = kind(bridge.get_function_address("enter"))
llvm.initialize_all_targets()
windows = replace(host, triple="x86_64-pc-windows-msvc")
for program in pickle.loads(sys.stdin.buffer.read()):
    kernel = machine.Kernel(program, "parity")
    code = machine.compile_object(print_llvm(program, windows, kernel.lanes, "parity"), windows)
    empty = llvm.parse_assembly(f'target triple = "{windows.triple}"')  # the first object decides the format
    engine = llvm.create_mcjit_compiler(empty, machine._machine(windows))
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    address = engine.get_function_address("run")

    class There:
        function = staticmethod(lambda *arguments: enter(address, *arguments))

    draws = np.random.default_rng(3)
    states = draws.uniform(size=(len(program.states), 11))
    inputs = draws.normal(size=(40, len(program.inputs), 11))
    native = kernel.run(program, states, 40, inputs)
    kernel._code = There
    foreign = kernel.run(program, states, 40, inputs)
    assert native.states.tobytes() == foreign.states.tobytes()
    for one, other in ((native.sums, foreign.sums), (native.outputs, foreign.outputs)):
        assert one
        for name in one:
            assert np.ascontiguousarray(one[name]).tobytes() == np.ascontiguousarray(other[name]).tobytes(), name
    print(len(program.ops))
"""


@pytest.mark.skipif(platform.machine() != "x86_64" or sys.platform == "win32", reason="runs x86 code for Windows here")
def test_object_code_for_windows_links_and_has_the_bits_of_this_system() -> None:
    """LLVM loads it here as it does there, and a bridge calls it by the rules of Windows; no pages are asked for."""
    given = [every_operation("float64"), every_operation("float32"), wide_frame()]
    command = [sys.executable, "-c", FOREIGN]
    answer = subprocess.run(command, input=pickle.dumps(given), capture_output=True, check=False)
    assert answer.returncode == 0, answer.stderr.decode()
    assert len(answer.stdout.split()) == len(given)


def test_lanes_and_permutations_follow_from_the_features() -> None:
    """Listed, on x86, and with nothing taken away that they are built upon."""
    expected = {
        ("x86_64-unknown-linux-gnu", "+avx512f,+avx2"): (8, 8),
        ("x86_64-unknown-linux-gnu", "-avx512f,+avx2"): (4, 4),
        ("x86_64-unknown-linux-gnu", "-avx,+avx2,+avx512f"): (0, 2),
        ("x86_64-unknown-linux-gnu", "-avx2,+sse2"): (0, 2),
        ("x86_64-unknown-linux-gnu", ""): (0, 2),
        ("aarch64-unknown-linux-gnu", "+neon"): (0, 2),
        ("arm64-apple-macosx", "+avx512f,+avx2"): (0, 2),
    }
    found = {(triple, features): Target(triple, "generic", features) for triple, features in expected}
    assert {key: (target.permutes, target.lanes) for key, target in found.items()} == expected


ALL_BITS = """
import hashlib
from dataclasses import replace
import taciturn
from taciturn.program.machine import Kernel, host
problem = taciturn.load("two-mass-lqg")
loop = problem.close(problem.design())
found = hashlib.sha256()
for each in (loop, replace(loop, precision="float32")):
    for program in (each.program(), each.reduced_program()):
        result = Kernel(program, "parity").run(program, each.start(program, 13, 5), 300)
        found.update(result.states.tobytes())
        for values in (*result.sums.values(), *result.outputs.values()):
            found.update(values.tobytes())
print(host().lanes, found.hexdigest())
"""


def test_every_width_of_vectors_gives_the_same_bits() -> None:
    """All that this processor has, and what every processor of its kind has."""
    lanes = machine.host().lanes
    widths = [name for name, wide in (("avx512", 8), ("avx2", 4), ("baseline", 2)) if wide <= lanes]
    found: dict[str, str] = {}
    for asked in widths:
        command = [sys.executable, "-c", ALL_BITS]
        environment = {**os.environ, VECTORS: asked}
        answer = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.split()
        found[answer[0]] = answer[1]
    assert len(found) == len(widths)
    assert len(set(found.values())) == 1


NEW = replace(TARGETS["AVX-512"], cpu="new")
OLD = Target("x86_64-unknown-linux-gnu", "old", "+sse2,+avx2,-avx512f")


@pytest.mark.parametrize(
    ("target", "asked", "lanes"),
    [
        (NEW, "", 8),
        (NEW, "avx512", 8),
        (NEW, "avx2", 4),
        (NEW, "baseline", 2),
        (OLD, "avx2", 4),
        (OLD, "baseline", 2),
        (TARGETS["NEON"], "baseline", 2),
    ],
)
def test_lesser_vectors_can_be_asked_for(target: Target, asked: str, lanes: int) -> None:
    """By name."""
    assert target.limited(asked).lanes == lanes


def test_vectors_that_are_not_there_are_refused() -> None:
    """In one sentence, with exit code 2 on the command line."""
    with pytest.raises(ProblemError, match=r"processor \(old\) does not support; expected one of avx2, baseline"):
        OLD.limited("avx512")
    with pytest.raises(ProblemError, match="'sse9'; expected one of avx512, avx2, baseline"):
        NEW.limited("sse9")
    command = [sys.executable, "-m", "taciturn", "evaluate", "two-mass-lqg"]
    environment = {**os.environ, VECTORS: "wide"}
    answer = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert answer.returncode == 2
    assert answer.stderr.startswith("taciturn: TACITURN_VECTORS is 'wide'; expected ")
    assert answer.stderr.count("\n") == 1


def test_draws_are_done_ahead_and_the_words_in_memory_do_not_tell() -> None:
    """In a program without inputs; one that reads the generator's words itself draws within its step."""
    problem = taciturn.load("two-mass-lqg")
    program = problem.close(problem.design()).reduced_program()
    _, text = printed(program, TARGETS["AVX2"], "fast")
    assert "%early0" in text
    assert "%early0" not in printed(program, TARGETS["AVX2"], "fast", own=True)[1]
    words = [i for i, op in enumerate(program.ops) if op.name == "state" and program.states[op.arguments[0]].word]
    read = replace(program, outputs={"word": words[0]})
    assert "%early" not in printed(read, TARGETS["AVX2"], "fast")[1]
