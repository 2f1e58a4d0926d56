"""Machine code: kept on disk, shared by structure, printed for other processors, and replaced by NumPy where absent."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import taciturn
from taciturn.loop import Loop
from taciturn.program import machine
from taciturn.program.ir import Builder
from taciturn.program.llvm import Target
from taciturn.program.machine import Kernel

Compiled = list[str]


@pytest.fixture(scope="module")
def loop() -> Loop:
    """Return the loop of the two masses."""
    problem = taciturn.load("two-mass-lqg")
    return problem.close(problem.design())


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Compiled:
    """Start from an empty cache; return the list of what is compiled from now on."""
    texts: Compiled = []
    compile_object = machine.compile_object

    def note(text: str, target: Target) -> bytes:
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
    with pytest.warns(UserWarning, match="damaged; the program is compiled again"):
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

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.setattr("os.path.expanduser", lambda path: path)  # as where nobody tells which home is meant
    assert [play(), play()] == [first, first]
    assert len(compiled) == 3


def test_a_sweep_over_theta_compiles_once(compiled: Compiled) -> None:
    """Programs that differ only in constants share machine code, and are still different programs."""
    problem = taciturn.load("two-mass-lqg")
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
    with pytest.raises(AssertionError, match="structure of the program differs"):
        Kernel(program).run(other, loop.start(other, 3, 0), 1)


def test_inputs_must_be_supplied_for_every_tick_and_path() -> None:
    """Code that reads beyond an array does not say so."""
    b = Builder()
    program = b.finish([], {}, {"x": b.input("in 0")})
    kernel, states = Kernel(program), np.zeros((0, 3))
    with pytest.raises(AssertionError, match="none are supplied"):
        kernel.run(program, states, 2)
    with pytest.raises(AssertionError, match="does not fit"):
        kernel.run(program, states, 2, np.zeros((1, 1, 3)))
    assert kernel.run(program, states, 2, np.ones((2, 1, 3))).outputs["x"].sum() == 6


def test_a_program_without_states_runs() -> None:
    """A constant is summed over the steps; no steps or no paths sum to nothing."""
    b = Builder()
    program = b.finish([], {"x": b.constant(2.0)})
    kernel = Kernel(program)
    assert list(kernel.run(program, np.zeros((0, 3)), 5).sums["x"]) == [10, 10, 10]
    assert list(kernel.run(program, np.zeros((0, 3)), 0).sums["x"]) == [0, 0, 0]
    assert kernel.run(program, np.zeros((0, 0)), 5).sums["x"].shape == (0,)


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
problem = taciturn.load("two-mass-lqg")
loop = problem.close(problem.design())
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    for program in (loop.program(), loop.reduced_program()):
        result = prepare(program)(loop.start(program, 13, 5), 50, None)
        found = [result.states, *result.sums.values(), *result.outputs.values()]
        np.savez(f"{sys.argv[1]}/{len(program.states)}.npz", *found)
print([str(warning.message) for warning in caught if "llvmlite" in str(warning.message)])
"""


@pytest.mark.evidence
def test_without_llvmlite_the_loops_run_in_numpy_with_one_notice(loop: Loop, tmp_path: Path) -> None:
    """Every number has the bits of the bit-exact build."""
    command = [sys.executable, "-c", WITHOUT_LLVM, str(tmp_path)]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert said.count("llvmlite is missing") == 1
    for program in (loop.program(), loop.reduced_program()):
        expected = Kernel(program, "parity").run(program, loop.start(program, 13, 5), 50)
        found = np.load(tmp_path / f"{len(program.states)}.npz")
        values = [expected.states, *expected.sums.values(), *expected.outputs.values()]
        assert [found[f"arr_{i}"].tobytes() for i in range(len(found))] == [
            np.ascontiguousarray(value).tobytes() for value in values
        ]
