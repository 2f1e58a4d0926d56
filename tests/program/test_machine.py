"""Machine code: kept on disk, shared by structure, printed for other processors, and replaced by NumPy where absent."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numpy as np
import pytest
from counts import few

import taciturn
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.plant import Jumps
from taciturn.program import machine
from taciturn.program.ir import Builder, Program
from taciturn.program.llvm import print_llvm
from taciturn.program.machine import Kernel
from taciturn.renewal.events import IntegralTrigger, JumpProcess, cycle_program

Compiled = list[str]


@pytest.fixture(scope="module")
def loop() -> Loop:
    """Return the loop of the two masses."""
    problem = taciturn.load("two-mass")
    return problem.close(problem.design())


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Compiled:
    """Start from an empty cache; return the list of what is compiled from now on."""
    texts: Compiled = []
    compile_object = machine.compile_object

    def note(text: str, target: object) -> bytes:
        texts.append(text)
        return compile_object(text, target)

    monkeypatch.setattr(machine, "compile_object", note)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    machine._load.cache_clear()
    return texts


@pytest.fixture
def play(loop: Loop) -> Callable[[], bytes]:
    """Return what runs the loop in this process as if it had just begun, and returns the bits of the cost."""
    program = loop.program().keep({"cost"})

    def run() -> bytes:
        machine._load.cache_clear()
        return Kernel(program, "parity").run(program, loop.start(program, 11, 1), 30).sums["cost"].tobytes()

    return run


def test_machine_code_is_kept_on_disk(compiled: Compiled, play: Callable[[], bytes], tmp_path: Path) -> None:
    """A second process compiles nothing and finds the same numbers."""
    first = play()
    assert [path.suffix for path in (tmp_path / "taciturn").iterdir()] == [".o"]
    assert play() == first
    assert len(compiled) == 1


@pytest.mark.parametrize("damage", [b"", b"short", b"\0" * 20_000, hashlib.sha256(b"").digest()])
def test_damaged_machine_code_is_compiled_again(
    compiled: Compiled, play: Callable[[], bytes], tmp_path: Path, damage: bytes
) -> None:
    """With a warning, once: the file is mended."""
    first = play()
    (kept,) = (tmp_path / "taciturn").iterdir()
    whole = kept.read_bytes()
    kept.write_bytes(damage or whole[:-1])
    with pytest.warns(UserWarning, match="damaged; it is compiled again"):
        assert play() == first
    assert kept.read_bytes() == whole
    assert play() == first
    assert len(compiled) == 2


def test_the_cache_keeps_what_was_used_last(
    compiled: Compiled, play: Callable[[], bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of many compiled programs the oldest go, when another one comes."""
    monkeypatch.setattr(machine, "MOST_KEPT", 3)
    folder = tmp_path / "taciturn"
    folder.mkdir()
    for age in range(5):
        (folder / f"{age}.o").write_bytes(b"")
        os.utime(folder / f"{age}.o", (1000.0 - age, 1000.0 - age))
    play()
    (new,) = {path.name for path in folder.iterdir()} - {"0.o", "1.o"}
    assert len(list(folder.iterdir())) == 3
    os.utime(folder / new, (0.0, 0.0))
    play()  # read, hence used
    assert (folder / new).stat().st_mtime > 1000
    assert len(compiled) == 1


def test_old_programs_go_together_and_not_one_by_one(
    compiled: Compiled, play: Callable[[], bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An eighth more than are kept stays until one more comes; then those beyond go at once."""
    monkeypatch.setattr(machine, "MOST_KEPT", 16)
    folder = tmp_path / "taciturn"
    folder.mkdir()
    for before, after in ((17, 18), (18, 16)):
        for path in folder.iterdir():
            path.unlink()
        for age in range(before):
            (folder / f"{age}.o").write_bytes(b"")
            os.utime(folder / f"{age}.o", (1000.0 - age, 1000.0 - age))
        play()
        assert len(list(folder.iterdir())) == after
    assert len(compiled) == 2


def test_a_cache_that_cannot_be_written_costs_time_alone(
    compiled: Compiled, play: Callable[[], bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file stands where the folder should be."""
    first = play()
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert [play(), play()] == [first, first]
    assert len(compiled) == 3


def test_a_read_only_cache_is_read(
    compiled: Compiled, play: Callable[[], bytes], tmp_path: Path, loop: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is in it is used; what is not is compiled."""
    first, opened = play(), Path.open

    def refuse(path: Path, mode: str = "r", *rest: Any, **more: Any) -> Any:
        if "x" in mode:
            raise PermissionError("read-only")
        return opened(path, mode, *rest, **more)

    monkeypatch.setattr(Path, "open", refuse)
    assert play() == first
    Kernel(loop.reduced_program())
    assert len(compiled) == 2
    assert len(list((tmp_path / "taciturn").iterdir())) == 1


def test_a_disk_that_fails_leaves_no_part_of_a_file(
    compiled: Compiled, play: Callable[[], bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The name is given to a whole file or to none."""

    def fail(*_: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(Path, "replace", fail)
    play()
    assert list((tmp_path / "taciturn").iterdir()) == []
    assert len(compiled) == 1


def test_a_process_without_a_home_compiles_each_time(
    compiled: Compiled, play: Callable[[], bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    """No folder that others can write is trusted instead."""
    first = play()

    def fail() -> Path:
        raise RuntimeError("could not determine home directory")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(machine.Path, "home", fail)
    assert [play(), play()] == [first, first]
    assert len(compiled) == 3


def test_a_sweep_over_theta_compiles_once(compiled: Compiled) -> None:
    """Programs that differ only in constants share machine code, and are still different programs."""
    problem = taciturn.load("two-mass")
    costs = []
    for theta in np.linspace(0.05, 1.0, 7):
        loop = problem.close(problem.changed({"theta": float(theta)}).design())
        program = loop.reduced_program().keep({"excess"})
        costs.append(Kernel(program).run(program, loop.start(program, 64, 1), 200).sums["excess"].mean())
    assert len(compiled) == 1
    assert (np.diff(costs) > 0).all()


def test_a_kernel_refuses_a_program_of_another_structure(loop: Loop) -> None:
    """Its memory would not be where the code expects it."""
    program, other = loop.program(), loop.reduced_program()
    with pytest.raises(AssertionError, match="another structure"):
        Kernel(program).run(other, loop.start(other, 3, 0), 1)


def test_inputs_must_be_supplied_for_every_tick_and_path() -> None:
    """Code that reads beyond an array does not say so."""
    b = Builder()
    program = b.finish([], {}, {"x": b.input("in 0")})
    kernel, states = Kernel(program), np.zeros((0, 3))
    with pytest.raises(AssertionError, match="none are supplied"):
        kernel.run(program, states, 2)
    with pytest.raises(AssertionError, match="do not fit"):
        kernel.run(program, states, 2, np.zeros((1, 1, 3)))
    assert kernel.run(program, states, 2, np.ones((2, 1, 3))).outputs["x"].sum() == 6


def test_a_program_without_states_runs() -> None:
    """A constant is summed over the ticks; no ticks or no paths sum to nothing."""
    b = Builder()
    program = b.finish([], {"x": b.constant(2.0)})
    kernel = Kernel(program)
    assert list(kernel.run(program, np.zeros((0, 3)), 5).sums["x"]) == [10, 10, 10]
    assert list(kernel.run(program, np.zeros((0, 3)), 0).sums["x"]) == [0, 0, 0]
    assert kernel.run(program, np.zeros((0, 0)), 5).sums["x"].shape == (0,)


TARGETS = {
    "AVX-512": ("x86_64-unknown-linux-gnu", "skylake-avx512", "", 8),
    "AVX2": ("x86_64-unknown-linux-gnu", "haswell", "", 4),
    "AVX2 without FMA": ("x86_64-unknown-linux-gnu", "x86-64", "+avx2", 4),
    "SSE2": ("x86_64-unknown-linux-gnu", "x86-64", "", 2),
    "NEON": ("aarch64-unknown-linux-gnu", "", "", 2),
    "Apple": ("arm64-apple-darwin", "apple-m1", "", 2),
    "Windows": ("x86_64-pc-windows-msvc", "haswell", "", 4),
}


def programs(loop: Loop) -> list[Program]:
    """Return programs with every operation among them: the second looks into tables, the third divides.

    The last two are in single precision.
    """
    problem = taciturn.load("two-mass")
    clocked = problem.close(taciturn.design.periodic(problem.plant, problem.cost, every=3))
    process = JumpProcess(np.eye(2, k=1), Jumps(1.0, np.eye(2)), np.eye(2))
    written = [loop.program(), clocked.program(), cycle_program(process, IntegralTrigger(1.0))]
    return [*written, *(replace(each, precision="float32").program() for each in (loop, clocked))]


@pytest.mark.parametrize("name", few(TARGETS, quick=3))
@pytest.mark.parametrize("build", few(["parity", "fast"], quick=1))
def test_programs_compile_for_every_processor(loop: Loop, name: str, build: machine.Build) -> None:
    """No function is called, for there is no mathematical library; the parity build has no fused operation."""
    triple, cpu, features, lanes = TARGETS[name]
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple(triple).create_target_machine(cpu=cpu, features=features, opt=3, jit=True)
    for program in programs(loop):
        text = print_llvm(program, lanes * (2 if program.precision == "float32" else 1), build)
        assert len(machine.compile_object(text, target)) > 1000
        module = llvm.parse_assembly(f'target triple = "{triple}"\n{text}')
        module.data_layout = str(target.target_data)
        lines = [line.split() for line in target.emit_assembly(module).splitlines() if line.startswith("\t")]
        mnemonics = {line[0] for line in lines}
        assert not mnemonics & {"call", "callq", "bl", "blr"}
        fused = any(word.startswith(("vfma", "vfms", "vfnm", "fmla", "fmls", "fmadd", "fmsub")) for word in mnemonics)
        assert fused == (build == "fast" and name not in ("SSE2", "AVX2 without FMA"))


@pytest.mark.parametrize(
    ("features", "lanes"), [("+avx512f,+avx2", 8), ("-avx512f,+avx2", 4), ("-avx2,+sse2", 2), ("+neon", 2)]
)
def test_the_lanes_fill_the_widest_vector(monkeypatch: pytest.MonkeyPatch, features: str, lanes: int) -> None:
    """Eight, four or two doubles."""
    monkeypatch.setattr(machine, "_host", lambda: ("generic", features))
    assert machine.vector_lanes.__wrapped__() == lanes


WITHOUT_LLVM = """
import sys, warnings
import numpy as np

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "llvmlite":
            raise ModuleNotFoundError("No module named 'llvmlite'", name="llvmlite")

sys.meta_path.insert(0, Absent())
import taciturn
from taciturn.program.engine import prepare
problem = taciturn.load("two-mass")
loop = problem.close(problem.design())
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    for program in (loop.program(), loop.reduced_program()):
        result = prepare(program)(loop.start(program, 13, 5), 50, None)
        sums = {f"sum {name}": value for name, value in result.sums.items()}
        np.savez(f"{sys.argv[1]}/{len(program.states)}.npz", states=result.states, **sums, **result.outputs)
print([str(warning.message) for warning in caught if "llvmlite" in str(warning.message)])
"""


def test_without_llvmlite_the_loops_run_in_numpy_with_one_notice(loop: Loop, tmp_path: Path) -> None:
    """Every number has the bits of the parity build."""
    command = [sys.executable, "-c", WITHOUT_LLVM, str(tmp_path)]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert said.count("llvmlite is missing") == 1
    for program in (loop.program(), loop.reduced_program()):
        expected = Kernel(program, "parity").run(program, loop.start(program, 13, 5), 50)
        found = np.load(tmp_path / f"{len(program.states)}.npz")
        sums = {f"sum {name}": value for name, value in expected.sums.items()}
        for name, value in {"states": expected.states, **sums, **expected.outputs}.items():
            assert found[name].tobytes() == np.ascontiguousarray(value).tobytes()


ALL_BITS = """
import hashlib
from dataclasses import replace
import taciturn
from taciturn.program.machine import Kernel, vector_lanes
problem = taciturn.load("two-mass")
loop = problem.close(problem.design())
found = hashlib.sha256()
for each in (loop, replace(loop, precision="float32")):
    for program in (each.program(), each.reduced_program()):
        result = Kernel(program, "parity").run(program, each.start(program, 13, 5), 300)
        found.update(result.states.tobytes())
        for values in (*result.sums.values(), *result.outputs.values()):
            found.update(values.tobytes())
print(vector_lanes(), found.hexdigest())
"""


def test_every_width_of_vectors_gives_the_same_bits() -> None:
    """All that this processor has, and what every processor of its kind has."""
    features = llvm.get_host_cpu_features()
    widths = [name for name, flag in (("avx512", "avx512f"), ("avx2", "avx2")) if features.get(flag)]
    found: dict[str, str] = {}
    for asked in ("", *widths, "baseline"):
        command = [sys.executable, "-c", ALL_BITS]
        environment = {**os.environ, machine.VECTORS: asked}
        answer = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.split()
        found[answer[0]] = answer[1]
    assert len(found) == max(1, len(widths) + 1)
    assert len(set(found.values())) == 1


ALL_FEATURES = "+sse2,+avx,+avx2,+fma,+avx512f,+avx512dq"


@pytest.mark.parametrize(
    ("features", "asked", "lanes"),
    [
        (ALL_FEATURES, "", 8),
        (ALL_FEATURES, "avx512", 8),
        (ALL_FEATURES, "avx2", 4),
        (ALL_FEATURES, "baseline", 2),
        ("+sse2,+avx2,-avx512f", "avx2", 4),
        ("+neon", "baseline", 2),
    ],
)
def test_lesser_vectors_can_be_asked_for(
    monkeypatch: pytest.MonkeyPatch, features: str, asked: str, lanes: int
) -> None:
    """By name."""
    allowed = machine.allowed("some processor", features, asked)
    monkeypatch.setattr(machine, "_host", lambda: allowed)
    assert machine.vector_lanes.__wrapped__() == lanes


def test_vectors_that_are_not_there_are_refused() -> None:
    """In one sentence, with exit code 2 on the command line."""
    with pytest.raises(ProblemError, match=r"processor \(old\) lacks; expected one of avx2, baseline"):
        machine.allowed("old", "+sse2,+avx2,-avx512f", "avx512")
    with pytest.raises(ProblemError, match="'sse9'; expected one of avx512, avx2, baseline"):
        machine.allowed("new", ALL_FEATURES, "sse9")
    command = [sys.executable, "-m", "taciturn.cli", "evaluate", "two-mass"]
    environment = {**os.environ, machine.VECTORS: "wide"}
    answer = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert answer.returncode == 2
    assert answer.stderr.startswith("taciturn: TACITURN_VECTORS is 'wide'; expected ")
    assert answer.stderr.count("\n") == 1
