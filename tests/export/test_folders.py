"""Folders of C99: what they compute has the bits of the design, whatever compiles them."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest
from catalogue import POLICIES
from counts import RUN, few, scaled
from export.devices import STRICT, needs_compiler
from hypothesis import given, settings
from hypothesis import strategies as st
from parity.loops import every_feature, with_functions
from runtime.test_nodes import COMPLETE, PARTICULAR, build, long
from systems import System, make_system, systems

import taciturn
from taciturn import Cost, Network, Plant, Reference, design
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.wire import KINDS
from taciturn.program.ops import Precision
from taciturn_export import node
from taciturn_export.export import bear_single, export_c
from taciturn_export.folder import CORE_SOURCES, GENERATED_BY, CFolder, print_folder, record_loop
from taciturn_export.node import identifier

AGREES = "steps compared, every decision and every bit of the input agrees"
SOME = (
    "lqg joint model", "stochastic", "rollout", "self-triggered", "remote", "lossy tcp, delayed", "lossy udp, 30 steps",
    "near-optimal", "variance", "integral",
)  # fmt: skip
DELTA = {"kind": "send-on-delta", "theta": None, "delta": 0.2}
BUILDS = [(compiler, level) for compiler in ("gcc", "clang") for level in ("-O0", "-O2")]


def two_mass() -> Loop:
    """Return the loop of the two masses."""
    problem = taciturn.load("two-mass-lqg")
    return problem.close(problem.design())


def compile_check(folder: Path, compiler: str = "", options: Sequence[str] = ("-O0",)) -> Path:
    """Return the self-check of a folder, compiled with every warning an error."""
    compiler = compiler or needs_compiler()
    if shutil.which(compiler) is None:
        pytest.skip(f"NOT SHOWN: what {compiler} makes of exported nodes; there is none")
    check = folder / "selfcheck"
    sources = sorted(map(str, folder.glob("*.c")))
    subprocess.run([compiler, *STRICT, *options, "-ffp-contract=off", *sources, "-lm", "-o", str(check)], check=True)
    return check


def run_check(check: Path, *arguments: str) -> tuple[int, str]:
    """Return how a self-check ends, and its last line."""
    done = subprocess.run([str(check), *arguments], capture_output=True, text=True, check=False)
    assert not done.stderr
    return done.returncode, done.stdout.strip().rpartition("\n")[2]


def write(folder: Path, found: CFolder) -> Path:
    """Write a folder, and return it."""
    found.write(folder)
    return folder


@pytest.mark.parametrize("name", few(SOME, 1))
def test_nodes_in_c_decide_as_the_design(name: str, tmp_path: Path) -> None:
    """Schedules, draws, memories, finite-horizon runs, losses, acknowledgements, bells, several labels: 500 steps."""
    loop = build(name)
    check = compile_check(write(tmp_path, print_folder(loop, "policy")))
    assert run_check(check) == (0, f"policy: {min(500, loop.horizon or 500)} {AGREES}")


@pytest.mark.evidence
@pytest.mark.parametrize("name", [*POLICIES, *PARTICULAR])
def test_nodes_in_c_decide_as_the_design_for_100_000_ticks(name: str, tmp_path: Path) -> None:
    """Every policy with a step, by gcc and clang, optimised or not: the bits of the build that has those of NumPy."""
    loop = build(name)
    ticks = min(long(name), loop.horizon or long(name))
    found = print_folder(loop, "policy", rows=1)
    rows = record_loop(loop, ticks, 4).rows
    rows.tofile(tmp_path / "rows")
    assert rows[:, -len(found.vector.links) - found.vector.applied.shape[1] :].any()
    one = (RUN.day.toordinal() + crc32(name.encode())) % len(BUILDS)  # in turn
    for compiler, level in BUILDS if name in COMPLETE else scaled(BUILDS, BUILDS[one : one + 1]):
        check = compile_check(write(tmp_path / compiler / level, found), compiler, [level])
        assert run_check(check, str(tmp_path / "rows")) == (0, f"policy: {ticks} {AGREES}")


@pytest.mark.evidence
@pytest.mark.parametrize("by", few(product(["float64", "float32"], BUILDS), 1, 1), ids=str)
def test_compilers_agree(by: tuple[Precision, tuple[str, str]], tmp_path: Path) -> None:
    """Nodes over links that drop packets, in both precisions, by both compilers, optimised or not."""
    precision, (compiler, level) = by
    problem = taciturn.load("lossy-double-integrator")
    loop = replace(problem.close(problem.design()), precision=precision)
    check = compile_check(write(tmp_path, print_folder(loop, "lossy")), compiler, [level])
    assert run_check(check) == (0, f"lossy: 100 {AGREES}")


@pytest.mark.evidence
@pytest.mark.parametrize("precision", few(["float64", "float32"], 1))
@given(system=systems(states=4), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=2, deadline=None)
def test_every_feature_of_a_policy_is_printed(
    precision: str, system: System, seed: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Losses, acknowledgements, clocks, locations, memories, draws and bells, all at once."""
    loop = replace(every_feature(system, seed), precision=precision)
    check = compile_check(write(tmp_path_factory.mktemp("every"), print_folder(loop, "every", rows=40)))
    assert run_check(check) == (0, f"every: 40 {AGREES}")


@pytest.mark.parametrize("precision", few(["float64", "float32"], 1, 1))
def test_steps_that_are_functions_are_printed(precision: str, tmp_path: Path) -> None:
    """Sines, exponentials, logarithms and roots without a library, with the bits of the simulated loop."""
    loop = replace(with_functions(make_system(5, 3, 2, 2, False), 1), precision=precision)
    check = compile_check(write(tmp_path, print_folder(loop, "functions", rows=200)))
    assert run_check(check) == (0, f"functions: 200 {AGREES}")


@pytest.mark.evidence
@pytest.mark.parametrize("precision", few(["float64", "float32"], 1, 1))
def test_large_matrices_are_multiplied_in_loops(precision: str, tmp_path: Path) -> None:
    """A plant of twenty states: the bits are those of the tiles."""
    found = print_folder(replace(large(20), precision=precision), "large")
    assert "for (size_t j = 0;" in found.files["large_controller.c"]
    assert run_check(compile_check(write(tmp_path, found))) == (0, f"large: 500 {AGREES}")


def large(n: int) -> Loop:
    """Return the loop of a plant with so many states."""
    system = make_system(3, n, 2, n // 2, False)
    return taciturn.close(system.plant, design.lqg(system.plant, system.cost, theta=0.2, actuation="model"))


def test_a_wrong_bit_is_found(tmp_path: Path) -> None:
    """The self-check fails where a number is off by one unit in the last place, or a decision is another."""
    folder = write(tmp_path, print_folder(two_mass(), "two_mass"))
    source = folder / "two_mass_controller.c"
    text = source.read_text()
    for old, new in (("= constants[0];", "= constants[0] * 1.0000000000000002;"), ("<=", ">")):
        assert text.count(old) >= 1
        source.write_text(text.replace(old, new, 1))
        code, line = run_check(compile_check(folder))
        assert code == 1
        assert line.startswith("step ")
        assert "expected" in line


@pytest.mark.evidence
def test_one_node_is_exported_and_the_others_check_it(tmp_path: Path) -> None:
    """Its library holds that node alone; the other ones are the self-check's."""
    found = print_folder(two_mass(), "two_mass", nodes=["actuator"])
    assert [one.role for one in found.nodes] == ["actuator"]
    assert [one.role for one in found.peers] == ["controller"]
    library = found.files["CMakeLists.txt"].partition("add_executable")[0]
    assert "two_mass_actuator.c" in library
    assert "controller" not in library
    assert run_check(compile_check(write(tmp_path, found)))[0] == 0


@pytest.mark.evidence
@pytest.mark.skipif(shutil.which("cmake") is None, reason="there is no cmake")
def test_the_build_file_builds(tmp_path: Path) -> None:
    """And its test passes."""
    write(tmp_path, print_folder(two_mass(), "two_mass"))
    subprocess.run(["cmake", "-B", "build", "."], cwd=tmp_path, check=True, capture_output=True)
    subprocess.run(["cmake", "--build", "build"], cwd=tmp_path, check=True, capture_output=True)
    subprocess.run(["ctest", "--test-dir", "build"], cwd=tmp_path, check=True, capture_output=True)


def test_a_folder_that_is_written_again_holds_the_new_nodes_alone(tmp_path: Path) -> None:
    """What an earlier export left goes; what somebody else wrote stays, be it a pipe or a link that leads nowhere."""
    (tmp_path / "mine.c").write_text("int mine;\n")
    (tmp_path / ".#mine.c").symlink_to("nowhere")
    (tmp_path / "folder.c").mkdir()
    os.mkfifo(tmp_path / "pipe.c")
    write(tmp_path, print_folder(two_mass(), "old"))
    write(tmp_path, print_folder(two_mass(), "new"))
    names = {path.name for path in tmp_path.glob("*.[ch]")}
    assert {"mine.c", ".#mine.c", "folder.c", "pipe.c", "new_controller.c", "new_actuator.h"} <= names
    assert not any(name.startswith("old") for name in names)
    assert (tmp_path / "new_controller.c").read_text().startswith(GENERATED_BY)


@pytest.mark.parametrize("name", ["README.md", "CMakeLists.txt", "selfcheck.c", "two_mass_controller.c"])
def test_files_of_others_are_not_replaced(name: str, tmp_path: Path) -> None:
    """Nothing is written where one of them would be lost."""
    (tmp_path / name).write_text("# mine, with taciturn\n")
    with pytest.raises(
        ProblemError, match=rf"{name} already exists and is not from an earlier export; expected a folder"
    ):
        write(tmp_path, print_folder(two_mass(), "two_mass"))
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "# mine, with taciturn\n"


def test_the_names_of_problems_do_not_break_the_build_file() -> None:
    """Targets of CMake are called otherwise than its own."""
    text = print_folder(two_mass(), "test", rows=1).files["CMakeLists.txt"]
    assert "add_library(test_nodes " in text
    assert "add_executable(test_selfcheck" in text


def test_the_end_of_a_mission_is_told() -> None:
    """Where there is one."""
    problem = taciturn.load("rover")
    assert "a horizon of 60 steps" in print_folder(problem.close(problem.design()), "rover").files["README.md"]
    assert "mission" not in print_folder(two_mass(), "two_mass", rows=1).files["README.md"]


@pytest.mark.parametrize(
    ("file", "changes", "titles"),
    [
        ("two-mass-lqg", {}, ["controller (at the sensor)", "actuator"]),
        (
            "two-mass-lqg",
            {"kind": "send-on-delta", "theta": None, "delta": 0.2},
            ["sensor", "controller (at the actuator)"],
        ),
        ("remote-double-integrator", {}, ["sensor", "controller", "actuator"]),
    ],
)
def test_what_a_device_does_is_compiled_as_the_instructions_have_it(
    file: str, changes: dict[str, object], titles: list[str], tmp_path: Path
) -> None:
    """A piece for each node, headed by where it is."""
    problem = taciturn.load(file).changed(changes)
    folder = write(tmp_path, print_folder(problem.close(problem.design()), "policy", rows=1))
    text = (folder / "README.md").read_text(encoding="utf-8")
    assert re.findall(r"^### The (.*)$", text, re.MULTILINE) == titles
    pieces = re.findall(r"```c\n(.*?)```", text, re.DOTALL)
    assert len(pieces) == len(titles)
    for piece in pieces:
        (folder / "mine.c").write_text(piece, encoding="utf-8")
        subprocess.run([needs_compiler(), *STRICT, "-c", "mine.c", "-o", "mine.o"], cwd=folder, check=True)


def test_the_instructions_list_every_kind_of_packet_with_its_number() -> None:
    """Those of the wire format: three between nodes, two with a key, two with the plant, and four of an operator."""
    text = print_folder(two_mass(), "two_mass", rows=1).files["README.md"]
    found = re.findall(r"^\| (\d+) \| (\w+) \|", text, re.MULTILINE) + re.findall(r"(\d) \((measurement|input)\)", text)
    assert {int(number): kind for number, kind in found} == dict(enumerate(KINDS))
    assert "`tac_set_keys(node, link, key, other)`" in text
    assert "`{NULL, 0}`" in text


@pytest.mark.parametrize("option", ["-ffast-math", "-fassociative-math -fno-signed-zeros -fno-trapping-math"])
def test_options_that_change_bits_are_refused(option: str, tmp_path: Path) -> None:
    """What a compiler tells of itself; the rest is found by the self-check."""
    folder = write(tmp_path, print_folder(two_mass(), "two_mass", rows=1))
    command = [needs_compiler(), "-std=c99", "-O2", *option.split(), "-c", "taciturn_node.c", "-o", "node.o"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "numbers are rounded as the compiler likes" in done.stderr


@pytest.mark.evidence
def test_a_node_is_called_from_cpp(tmp_path: Path) -> None:
    """Sources as C, a main in C++."""
    if shutil.which("c++") is None:
        pytest.skip("NOT SHOWN: nodes called from C++; there is no `c++`")
    folder = write(tmp_path, print_folder(two_mass(), "two_mass", rows=1))
    sources = [*CORE_SOURCES, "two_mass_actuator.c"]
    subprocess.run([needs_compiler(), "-std=c99", "-c", *sources], cwd=folder, check=True)
    (folder / "main.cpp").write_text(
        '#include "two_mass_actuator.h"\n'
        "static two_mass_actuator memory;\n"
        "int main() {\n"
        "  tac_node *node = two_mass_actuator_start(&memory, 1, 0, tac_key{nullptr, 0});\n"
        "  return tac_step(node, 0, nullptr, nullptr) && tac_heard(node) == 0 ? 0 : 1;\n"
        "}\n"
    )
    objects = [name.replace(".c", ".o") for name in sources]
    subprocess.run(["c++", "-Wall", "-Wextra", "-Werror", "main.cpp", *objects, "-o", "main"], cwd=folder, check=True)
    assert subprocess.run([str(folder / "main")], check=False).returncode == 0


def test_the_same_problem_gives_the_same_files() -> None:
    """No date, no path, no order that changes."""
    assert print_folder(two_mass(), "same").files == print_folder(two_mass(), "same").files


@pytest.mark.parametrize(
    ("text", "name"), [("two-mass-lqg", "two_mass_lqg"), ("3 tanks", "p3_tanks"), ("Größe 1", "gr_e_1"), ("***", "p")]
)
def test_names_become_identifiers(text: str, name: str) -> None:
    """Letters, digits and underscores of ASCII, no digit first."""
    assert identifier(text) == name


def test_a_vector_holds_what_a_loop_did() -> None:
    """Packets that came were sent, and sends are neither none nor all."""
    problem = taciturn.load("lossy-double-integrator")
    vector = record_loop(problem.close(problem.design()), 100, seed=3)
    assert set(vector.links) == {"sensor", "actuator"}
    assert (vector.arrived <= vector.sent).all()
    assert 0 < vector.arrived.sum() < vector.sent.sum()
    assert vector.rows.shape == (100, 2 + 0 + 2 + 2 + 1)


def test_a_loop_that_leaves_the_range_of_numbers_is_refused() -> None:
    """A policy that was designed for another plant."""
    plant, cost = Plant([[0.9]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
    loop = taciturn.close(Plant([[9.0]], [[1.0]], [[1.0]]), design.lqg(plant, cost, theta=0.1), cost=cost)
    with pytest.raises(ProblemError, match=r"leaves the range of float64 after \d+ steps"):
        print_folder(loop, "unstable")


def test_what_a_device_cannot_hold_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A node with more numbers than the core's data can say."""
    monkeypatch.setitem(node.MOST, "memory", 3)
    with pytest.raises(ProblemError, match="has 5 entries; expected at most 3 entries on a device"):
        print_folder(two_mass(), "two_mass")
    system = make_system(3, 2, 1, 256, False)
    wide = taciturn.close(system.plant, design.lqg(system.plant, system.cost, theta=0.2))
    monkeypatch.undo()
    with pytest.raises(ProblemError, match="has 256 entries; expected at most 255 entries on a device"):
        print_folder(wide, "wide")


def test_what_has_no_nodes_is_refused(tmp_path: Path) -> None:
    """A policy without a step, one for analysis, a node that is none, a folder that cannot be."""
    problem = taciturn.load("two-mass-lqg")
    with pytest.raises(ProblemError, match="the node is 'sensor', which is at the site of the controller in lqg"):
        export_c(problem, tmp_path, nodes=["sensor"])
    (tmp_path / "file").write_text("")
    with pytest.raises(ProblemError, match=r"the folder .*file/x cannot be written to \(Not a directory\)"):
        export_c(problem, tmp_path / "file" / "x")
    with pytest.raises(ProblemError, match="precision is 'float16'; expected"):
        export_c(problem, tmp_path, precision="float16")  # type: ignore[arg-type]
    assert not (tmp_path / "x").exists()


def test_single_precision_is_refused_where_the_loop_does_not_bear_it() -> None:
    """Ten kilometres from the origin it cannot tell tenths of a millimetre apart; at a metre it can."""
    assert bear_single(hovering(1.0)).precision == "float32"
    with pytest.raises(
        ProblemError, match=r"precision is 'float32', with which the cost of the loop is .*'; expected 'float64'"
    ):
        bear_single(hovering(1e4))


def hovering(place: float) -> Loop:
    """Return a loop that keeps a robot at a place, to a tenth of a millimetre."""
    followed = Reference(np.full((101, 1), place), np.zeros((100, 1)))
    plant, cost = Plant([[1.0]], [[1.0]], [[1e-8]], mean=[place]), Cost([[1.0]], [[1.0]], horizon=100)
    network = Network("udp", 0.1, 0.1)
    return taciturn.close(plant, design.lossy_lqg(plant, cost, price=1e-9, network=network, reference=followed))


def test_no_library_of_mathematics_is_called() -> None:
    """Neither for roots nor for what is made of operations."""
    found = print_folder(with_functions(make_system(5, 3, 2, 2, False), 1), "functions", rows=10)
    text = "".join(found.files.values())
    assert "tac_root(" in text
    assert re.findall(r"\b(?:sqrt|sin|cos|tan|atan2?|exp|log|tanh|pow|fabs)[fl]?\(", text) == []
