"""A unit does in a simulator what the loop does, bit for bit, and says why where it does not continue."""

from __future__ import annotations

import ctypes
import itertools
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from catalogue import POLICIES
from counts import few
from export.devices import STRICT
from export.test_set_points_in_c import TANK, tank
from export.units import FMI, SEED, Instance, build_driver, differing_ticks, drive, given, make_unit, record
from fmpy.build import build_platform_binary
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu
from parity.loops import with_functions
from runtime.late import WITHIN, late_sensor, pendulum
from runtime.test_nodes import PARTICULAR, long
from runtime.test_nodes import build as build_loop
from systems import make_system

import taciturn
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.problem import parse
from taciturn_export.fmu import Fmu, Version, list_variables, print_fmu, tick_length
from taciturn_export.node import identifier

VERSIONS: tuple[Version, ...] = ("3.0", "2.0")
LOSSY = "lossy-double-integrator"
LOOPS: dict[str, Callable[[], Loop]] = {
    "two-mass-lqg": lambda: of_problem("two-mass-lqg"),
    "rover": lambda: of_problem("rover"),
    "functions": lambda: with_functions(make_system(5, 3, 2, 2, False), 1),
    "several inputs": lambda: build_loop("lqg joint model"),
    LOSSY: lambda: of_problem(LOSSY),
    "several sensors": lambda: build_loop("tank, crossed"),
    "set-points": lambda: tank(),
    "own draws": lambda: build_loop("stochastic"),
    "delays": lambda: pendulum({"delta": 0.05}).close(pendulum({"delta": 0.05}).design()),
    "late measurements": lambda: late_sensor().close(late_sensor().design()),
    "single precision": lambda: replace(LOOPS["two-mass-lqg"](), precision="float32"),
}
Make = Callable[[str, Version], tuple[Loop, Fmu, Path]]


def of_problem(name: str) -> Loop:
    """Return the loop of a built-in problem."""
    return taciturn.load(name).close(taciturn.load(name).design())


@pytest.fixture(scope="module")
def make(tmp_path_factory: pytest.TempPathFactory) -> Make:
    """Return the unit of a loop in a folder, made once."""
    made: dict[tuple[str, Version], tuple[Loop, Fmu, Path]] = {}

    def get(name: str, version: Version) -> tuple[Loop, Fmu, Path]:
        if (name, version) not in made:
            loop, folder = LOOPS[name](), tmp_path_factory.mktemp("unit") / "unpacked"
            made[name, version] = loop, make_unit(loop, folder, version), folder
        return made[name, version]

    return get


@pytest.mark.parametrize("of", few(itertools.product(LOOPS, VERSIONS), 1, 1), ids=str)
def test_a_unit_is_valid_and_decides_as_the_loop(make: Make, of: tuple[str, Version]) -> None:
    """FMPy's validation finds nothing, and 300 steps agree in every decision and every bit of the input."""
    name, version = of
    loop, unit, folder = make(name, version)
    assert validate_fmu(str(folder.with_suffix(".fmu"))) == []
    assert unit.notes == ()
    vector = record(loop, 300)
    instance = Instance(folder).start()
    assert differing_ticks(instance, loop, vector, range(len(vector.sent))) == []
    counts = instance.get(*(f"sends_{identifier(link)}" for link in vector.links))
    assert counts == list(vector.sent.sum(axis=0).astype(int))
    assert min(counts) > 0
    assert instance.get("degraded") == [False]
    instance.fmu.terminate()
    instance.close()


@pytest.mark.evidence
@pytest.mark.parametrize("of", few(itertools.product(["two-mass-lqg", LOSSY, "own draws"], VERSIONS), 1, 2), ids=str)
def test_a_state_is_taken_up_again_in_any_instance(make: Make, of: tuple[str, Version]) -> None:
    """A restored state continues the same, in its instance, in another and from bytes; changed bytes are refused."""
    name, version = of
    loop, _, folder = make(name, version)
    vector = record(loop, 100)
    one, other = Instance(folder).start(), Instance(folder)
    assert differing_ticks(one, loop, vector, range(40)) == []
    state = one.told("getFMUState")
    assert differing_ticks(one, loop, vector, range(40, 60)) == []
    one.told("setFMUState", state)
    assert differing_ticks(one, loop, vector, range(40, 70)) == []
    other.told("setFMUState", state)
    assert differing_ticks(other, loop, vector, range(40, 100)) == []
    serialized = one.told("serializeFMUState", state)
    later = one.fmu.deserializeFMUState if one.new else one.fmu.deSerializeFMUstate
    one.told("setFMUState", later(serialized))
    assert differing_ticks(one, loop, vector, range(40, 100)) == []
    for i in (3, 12, 100, len(serialized) - 1):
        wrong = bytearray(serialized)
        wrong[i] ^= 4
        with pytest.raises(FMICallException):
            one.told("setFMUState", later(bytes(wrong)))
    with pytest.raises(FMICallException):
        later(serialized[:-1])
    assert "has been changed" in one.messages[-2]
    assert "another size" in one.messages[-1]
    one.told("freeFMUState", state)
    one.close()
    other.close()


@pytest.mark.evidence
@pytest.mark.parametrize("version", VERSIONS)
def test_instances_are_apart_and_a_reset_begins_anew(make: Make, version: Version) -> None:
    """Two that run in turns do not disturb each other, and one that is reset does again what it did."""
    loop, _, folder = make("two-mass-lqg", version)
    first, second = record(loop, 60), record(loop, 60, seed=8)
    assert (first.applied != second.applied).any()
    one, other = Instance(folder).start(), Instance(folder).start()
    for tick in range(60):
        assert differing_ticks(one, loop, first, [tick]) == []
        assert differing_ticks(other, loop, second, [tick]) == []
    one.fmu.terminate()
    one.fmu.reset()
    assert one.get("sends_actuator", "u[1]", "y[1]") == [0, 0.0, 0.0]
    assert differing_ticks(one.start(), loop, second, range(60)) == []
    one.close()
    other.close()


@pytest.mark.parametrize("version", few(VERSIONS, 1))
def test_what_cannot_be_done_is_refused_with_a_sentence_and_changes_nothing(make: Make, version: Version) -> None:
    """Another step, another time, a measurement that is no number, an unknown variable, a wrong order."""
    loop, _, folder = make("two-mass-lqg", version)
    vector, tick = record(loop, 30), tick_length(loop)
    instance = Instance(folder)

    def refused(sentence: str, action: Callable[[], object]) -> None:
        with pytest.raises(FMICallException):
            action()
        assert re.search(sentence, instance.messages[-1]), instance.messages[-1]

    refused("does not run", lambda: instance.step(0.0, tick))
    refused("not finite", lambda: instance.start(np.nan))
    instance.start()
    refused("initialized already|experiment has begun", instance.start)
    assert differing_ticks(instance, loop, vector, range(10)) == []
    refused(f"step is {2 * tick:.9g} s long; expected {tick:.9g}", lambda: instance.step(10 * tick, 2 * tick))
    refused("step is 0 s long", lambda: instance.step(10 * tick, 0.0))
    refused(f"begins at {9 * tick:.9g} s; expected {10 * tick:.9g}", lambda: instance.step(9 * tick, tick))
    refused("begins at", lambda: instance.step(11 * tick, tick))
    for time in (np.nan, np.inf, -np.inf, 1e308):
        refused("begins at", lambda time=time: instance.step(time, tick))
    refused("step is inf s long", lambda: instance.step(10 * tick, np.inf))
    for value in (np.nan, np.inf, 1.7e308):
        instance.set({"y[1]": value})
        refused(
            r"y\[1\] is (-?(nan|inf)|1\.7e\+308); expected a finite number up to 3\.4",
            lambda: instance.step(10 * tick, tick),
        )
    set_number = instance.fmu.setFloat64 if instance.new else instance.fmu.setReal
    get_truth = instance.fmu.getBoolean
    refused("no number that can be set with reference 2048", lambda: set_number([2048], [1.0]))
    refused("no truth value with reference 17", lambda: get_truth([17]))  # nothing is lost on an ideal network
    refused("that this unit does", lambda: instance.fmu.getString([1]))
    refused("no such category", lambda: instance.fmu.setDebugLogging(True, ["everything"]))
    assert differing_ticks(instance, loop, vector, range(10, 30)) == []
    instance.fmu.terminate()
    refused("does not run", lambda: instance.step(30 * tick, tick))
    instance.close()


@pytest.mark.evidence
def test_a_unit_names_the_set_point_that_is_too_large_and_the_page_lists_all_variables(make: Make) -> None:
    """Set-points are counted by themselves, after the measurements."""
    loop, _, folder = make("set-points", "3.0")
    instance = Instance(folder).start()
    instance.set({"y[1]": 1.0, "setpoint[1]": 1e39})
    with pytest.raises(FMICallException):
        instance.step(0.0, tick_length(loop))
    assert "setpoint[1] is 1e+39; expected a finite number up to 3.4" in instance.messages[-1]
    instance.close()
    page = (Path(__file__).parents[2] / "docs" / "devices.md").read_text(encoding="utf-8")
    for one in list_variables(loop):
        assert f"`{one.name.partition('_')[0]}" in page, one.name


@pytest.mark.evidence
def test_set_points_start_at_those_that_the_problem_states(make: Make) -> None:
    """In the description, in the unit before its first step and after a reset, and in the input that it computes."""
    loop, _, folder = make("set-points", "3.0")
    applied = list[float]()
    for told in ({}, {"setpoint[1]": 3.0}, {"setpoint[1]": 0.0}):
        instance = Instance(folder).start()
        assert instance.get("setpoint[1]") == [3.0]
        instance.set({"y[1]": 0.5, **told})
        instance.step(0.0, tick_length(loop))
        applied += instance.get("u[1]")
        instance.fmu.reset()
        assert instance.get("setpoint[1]", "y[1]") == [3.0, 0.0]
        instance.close()
    assert applied[0] == applied[1] != applied[2]
    starts = {one.name: one.start for one in instance.described.modelVariables if one.causality == "input"}
    assert starts.pop("missing[1]") == "false"
    assert {name: float(start) for name, start in starts.items()} == {"y[1]": 0.0, "setpoint[1]": 3.0}


def test_set_points_of_a_unit_are_in_the_units_of_the_plant() -> None:
    """Also if the loop counts from an operating point."""
    given = {**TANK["plant"], "operating_point": {"x": [0.5, 10.0], "u": [20.0]}}
    problem = parse(
        {**TANK, "plant": given, "reference": {"value": [13.0], "steps": TANK["reference"]["steps"]}}, "tank"
    )
    listed = {one.name: one.start for one in list_variables(problem.close(problem.design()))}
    assert listed["setpoint[1]"] == 13.0


@pytest.mark.parametrize("version", VERSIONS)
def test_a_token_of_another_unit_is_refused(make: Make, version: Version) -> None:
    """A description that belongs to other sources has no instance."""
    with pytest.raises(Exception, match="Failed to instantiate"):
        Instance(make("two-mass-lqg", version)[2], token="{another}")


@pytest.mark.parametrize("version", VERSIONS)
def test_every_function_of_fmi_is_there_and_nothing_else_is_seen(make: Make, version: Version) -> None:
    """The library exports what the header declares; its own functions stay its own."""
    _, unit, folder = make("two-mass-lqg", version)
    library = ctypes.CDLL(str(folder / str(unit.binary)))
    header = (FMI / f"fmi{version[0]}Functions.h").read_text(encoding="ascii")
    declared = re.findall(rf"FMI\d_Export fmi{version[0]}\w+TYPE\s+(fmi\w+);", header)
    assert len(declared) == {"3.0": 75, "2.0": 44}[version]
    assert [name for name in declared if not hasattr(library, name)] == []
    assert not any(hasattr(library, name) for name in ("tac_step", "fmu_step", "unit_controller_start"))


@pytest.mark.evidence
@pytest.mark.parametrize("by", few([("gcc", "3.0"), ("clang", "2.0"), ("gcc", "2.0"), ("clang", "3.0")], 1), ids=str)
def test_the_sources_are_strict_c99(make: Make, tmp_path: Path, by: tuple[str, Version]) -> None:
    """No warning of two compilers, and nothing is needed but the C library."""
    compiler, version = by
    if shutil.which(compiler) is None:
        pytest.skip(f"NOT SHOWN: there is no {compiler}")
    sources = sorted((make(LOSSY, version)[2] / "sources").glob("*.c"))
    options = [*STRICT, "-O1", "-fPIC", "-shared", "-nodefaultlibs", "-isystem", str(FMI)]
    linked = ["-lc", "-Wl,-z,defs", "-o", str(tmp_path / "unit.so")]
    subprocess.run([compiler, *options, *map(str, sources), *linked], check=True)


@pytest.mark.evidence
def test_memory_is_used_as_it_may_be(make: Make, tmp_path: Path) -> None:
    """The sanitizers of the compiler find nothing in 100 steps."""
    loop, unit, folder = make(LOSSY, "3.0")
    checked = ["-g", "-fsanitize=address,undefined", "-fno-sanitize-recover"]
    library, sources = tmp_path / "unit.so", sorted((folder / "sources").glob("*.c"))
    options = ["-std=c99", "-O0", *checked, "-fPIC", "-shared", f"-I{FMI}", "-o", str(library)]
    subprocess.run(["cc", *options, *map(str, sources)], check=True)
    assert drive(build_driver(tmp_path, *checked), library, unit, loop, record(loop, 100)) == 100


@pytest.mark.parametrize("version", few(VERSIONS, 0))
def test_the_sources_alone_are_enough(tmp_path: Path, version: Version, monkeypatch: pytest.MonkeyPatch) -> None:
    """FMPy builds a unit that has no binary, and it decides as the loop."""
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=":")
    if shutil.which("cmake") is None or shutil.which("cc") is None:
        pytest.skip("NOT SHOWN: units are built of sources by cmake and cc, and they are not there")
    loop = LOOPS["two-mass-lqg"]()
    unit = print_fmu(loop, "unit", version=version, compiler=None)
    assert unit.binary is None
    assert "none was requested" in unit.notes[0]
    unit.write(tmp_path / "unit.fmu")
    shutil.unpack_archive(tmp_path / "unit.fmu", tmp_path / "unpacked", "zip")
    assert not (tmp_path / "unpacked" / "binaries").exists()
    (tmp_path / "build").mkdir()
    build_platform_binary(tmp_path / "unpacked", tmp_path / "build", generator="Unix Makefiles")
    instance = Instance(tmp_path / "unpacked").start()
    assert differing_ticks(instance, loop, record(loop, 100), range(100)) == []
    instance.close()


def test_without_a_compiler_a_note_says_so_and_one_that_fails_is_told(tmp_path: Path) -> None:
    """Sources alone, and a note that says why."""
    loop = LOOPS["two-mass-lqg"]()
    unit = print_fmu(loop, "unit", compiler="cc-that-is-not-there")
    assert unit.notes == (
        "the unit has no binary because this machine has no compiler 'cc-that-is-not-there': the importing simulator "
        "compiles the sources, or `fmpy compile` does",
    )
    failing = tmp_path / "failing"
    failing.write_text("#!/bin/sh\necho 'unit.c:1: error: no such thing' >&2\nexit 1\n")
    failing.chmod(0o755)
    (note,) = print_fmu(loop, "unit", compiler=str(failing)).notes
    assert f"{failing} rejects the sources (unit.c:1: error: no such thing)" in note
    failing.write_text("#!/bin/sh\n")
    unit = print_fmu(loop, "unit", compiler=str(failing))
    assert "has written no file" in unit.notes[0]
    assert ("note", unit.notes[0]) in unit.lines()
    assert not any(path.startswith("binaries") for path in unit.files)
    with pytest.raises(ProblemError, match=r"ends in \.fmu"):
        unit.write(tmp_path / "unit.zip")
    with pytest.raises(ProblemError, match="cannot be written"):
        unit.write(failing / "unit.fmu")
    with pytest.raises(ProblemError, match=r"expected '3\.0' or '2\.0'"):
        print_fmu(loop, "unit", version="1.0")  # type: ignore[arg-type]
    with pytest.raises(ProblemError, match="expected a C identifier"):
        print_fmu(loop, "two-mass-lqg")


@pytest.mark.evidence
def test_a_unit_is_the_same_whenever_it_is_made(make: Make, tmp_path: Path) -> None:
    """The bytes of the file depend on the policy alone; the token tells policies and versions apart."""
    loop, unit, _ = make("two-mass-lqg", "3.0")
    again = print_fmu(loop, "unit", seed=SEED)
    assert again.archive() == unit.archive()
    with zipfile.ZipFile(make("two-mass-lqg", "3.0")[2].with_suffix(".fmu")) as held:
        assert {entry.date_time for entry in held.infolist()} == {(1980, 1, 1, 0, 0, 0)}
        assert held.namelist()[0] == "modelDescription.xml"
        assert not [name for name in held.namelist() if re.search(r"fmi\dFunction|fmi\dTypes|fmi\dPlatform", name)]
    tokens = {unit.token, make(LOSSY, "3.0")[1].token, make("two-mass-lqg", "2.0")[1].token}
    assert len(tokens) == 3


@pytest.mark.evidence
def test_losses_are_inputs_only_where_packets_may_be_lost(make: Make) -> None:
    """Of an ideal network nothing can be lost."""
    ideal, lossy = Instance(make("two-mass-lqg", "3.0")[2]), Instance(make(LOSSY, "3.0")[2])
    names = [{one.name for one in instance.described.modelVariables} for instance in (ideal, lossy)]
    assert [{name for name in found if name.startswith("lost")} for found in names] == [
        set(),
        {"lost_sensor", "lost_actuator"},
    ]
    ideal.close()
    lossy.close()


@pytest.mark.evidence
def test_delays_are_inputs_only_where_packets_are_delayed_at_random(make: Make, tmp_path: Path) -> None:
    """In whole steps that the unit can wait; within a period, the input would change between two steps of a unit."""
    loop, _, folder = make("delays", "3.0")
    vector = record(loop, 200)
    assert {2.0, 3.0} <= set(vector.arrived[:, 0])
    assert differing_ticks(Instance(folder).start(), loop, vector, range(200)) == []
    assert [one.name for one in list_variables(LOOPS["delays"]()) if one.name.startswith("late")] == ["late_actuator"]
    assert not any(one.name.startswith("late") for one in list_variables(LOOPS[LOSSY]()))
    instance = Instance(folder).start()
    for wrong in (-1.0, 0.5, 1e9, float("nan")):
        instance.set({"late_actuator": wrong})
        with pytest.raises(FMICallException):
            instance.step(0.0, 0.02)
        assert "expected a whole number of steps below 4" in instance.messages[-1]
    instance.set({"late_actuator": 2.0})
    assert instance.get("late_actuator") == [2.0]
    instance.step(0.0, 0.02)
    instance.close()
    with pytest.raises(ProblemError, match=r"actuator\.delay: packets may arrive within a period"):
        taciturn.export_fmu(pendulum(delay=WITHIN), tmp_path / "unit.fmu")


@pytest.mark.evidence
def test_a_lost_packet_does_not_arrive(make: Make) -> None:
    """With every packet to the actuator lost, the input of the plant stays zero; without losses it does not."""
    loop, _, folder = make(LOSSY, "3.0")
    vector, inputs = record(loop, 50), dict[bool, list[float]]()
    for lost in (False, True):
        instance = Instance(folder).start()
        inputs[lost] = []
        for tick in range(50):
            instance.set({**given(loop, vector, tick), "lost_sensor": False, "lost_actuator": lost})
            instance.step(tick * tick_length(loop), tick_length(loop))
            inputs[lost] += instance.get("u[1]")
        assert instance.get("sends_actuator")[0] > 0
        instance.close()
    assert not any(inputs[True])
    assert any(inputs[False])


def test_a_simulation_may_begin_at_any_time_and_add_up_its_steps(make: Make) -> None:
    """Times that a simulator has summed up are taken, whatever rounding has made of them."""
    loop, _, folder = make("two-mass-lqg", "3.0")
    vector, time = record(loop, 300), 1.7e9
    instance = Instance(folder).start(time)
    for tick in range(300):
        instance.set(given(loop, vector, tick))
        instance.step(time, tick_length(loop))
        time += tick_length(loop)
        assert instance.get("time") == [time]
    instance.close()


def test_the_licence_that_units_carry_is_that_of_the_project() -> None:
    """A copy stands next to the core, since the project's own file is not where the package is."""
    root = Path(__file__).parents[2]
    assert (FMI.parent / "core" / "LICENSE").read_bytes() == (root / "LICENSE").read_bytes()


@pytest.mark.evidence
@pytest.mark.parametrize("name", [*POLICIES, *PARTICULAR])
def test_units_decide_as_the_loop_for_100_000_ticks(name: str, tmp_path: Path) -> None:
    """Every policy with a step: valid, and 100,000 steps in a row have every decision and every bit of the loop."""
    loop = build_loop(name)
    unit = make_unit(loop, tmp_path / "unpacked")
    assert validate_fmu(str(tmp_path / "unpacked.fmu")) == []
    vector = record(loop, long(name))
    library = tmp_path / "unpacked" / str(unit.binary)
    assert drive(build_driver(tmp_path), library, unit, loop, vector) == len(vector.sent) > 0
