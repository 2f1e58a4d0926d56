"""Policies are exported at the command line: what it answers, and what a user can get wrong."""

from __future__ import annotations

import json
import platform
import re
import shutil
import subprocess
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from counts import few

if TYPE_CHECKING:
    from conftest import Once, Run

PLANT = "[plant]\nA = [[0, 1], [0, 0]]\nB = [[0], [1]]\n"


@pytest.mark.evidence
@pytest.mark.skipif(shutil.which("cc") is None, reason="NOT SHOWN: what is C needs a compiler, and there is no `cc`")
def test_the_next_command_passes_beside_files_of_one_s_own(run: Run, tmp_path: Path) -> None:
    """The whole way, as the page has it; a program in the folder is no part of the self-check."""
    folder = tmp_path / "my nodes"
    folder.mkdir()
    (folder / "main.c").write_text("int main(void) { return 1; }\n")
    shown = run("export", "two-mass-lqg", "--c", str(folder)).out
    found = re.search(r"^next ((?:.*\\\n)*.*)", shown, re.MULTILINE)
    assert found
    command = found[1]
    assert max(map(len, command.splitlines()[1:])) <= 80
    done = subprocess.run(command, shell=True, check=True, capture_output=True, text=True)
    assert done.stdout.startswith("two_mass_lqg: 500 steps compared")
    assert "every bit of the input agrees" in done.stdout


@pytest.mark.evidence
def test_what_double_precision_is_on_a_cortex_is_told(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where single precision was not asked for."""
    monkeypatch.setenv("PATH", str(tmp_path))  # nothing is compiled for that
    told = "a Cortex-M computes float64 in software"
    assert told in run("export", "double-integrator", "--c", str(tmp_path)).out
    assert told not in run("export", "double-integrator", "--c", str(tmp_path), "--precision", "float32").out


def test_an_export_is_told(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What it contains, and how it is checked; then a line for each node; on request also its files."""
    monkeypatch.setenv("PATH", str(tmp_path))  # nothing is compiled for that
    answer = run("export", "rover", "--c", str(tmp_path), "--node", "sensor")
    assert answer.code == 0
    lines = answer.out.splitlines()
    assert lines[0] == "C99 sources of sensor; the self-check compares 60 steps bit for bit"
    assert [line.split()[0] for line in lines[2:5]] == ["policy", "sensor", "self-check"]
    told = run("export", "rover", "--c", str(tmp_path), "--node", "sensor", "-v").out
    assert "file           selfcheck.c" in told
    assert "selfcheck.c" not in answer.out.split("next")[0]


@pytest.mark.evidence
@pytest.mark.skipif(shutil.which("cc") is None, reason="NOT SHOWN: what is C needs a compiler, and there is no `cc`")
def test_sizes_are_those_of_a_cortex_or_of_this_machine_or_none(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What there is a compiler for; without one that is said, and the export is whole; one that refuses is heard."""
    document = json.loads(run("export", "rover", "--c", str(tmp_path), "--json").out)
    assert [node["role"] for node in document["nodes"]] == ["sensor", "controller", "actuator"]
    sizes = document["sizes"]
    assert sizes["processor"] == ("Cortex-M3" if shutil.which("arm-none-eabi-gcc") else platform.machine())
    assert all(sizes[name]["code"] > 100 for name in ("sensor", "controller", "actuator", "core"))
    monkeypatch.setenv("PATH", str(tmp_path))
    answer = run("export", "rover", "--c", str(tmp_path))
    assert answer.code == 0
    assert answer.unwrapped.splitlines()[-1].split()[:3] == ["sizes", "not", "measured,"]
    compiler = tmp_path / "arm-none-eabi-gcc"
    compiler.write_text("#!/bin/sh\necho this is no C >&2\nexit 1\n")
    compiler.chmod(0o755)
    refused = run("export", "rover", "--c", str(tmp_path))
    assert refused.code != 0
    assert "arm-none-eabi-gcc fails (this is no C); correct the reported cause" in refused.err


@pytest.mark.evidence
@pytest.mark.parametrize("version", few(["3.0", "2.0"], 1, 1))
def test_two_masses_become_a_unit(run: Run, once: Once, version: str, tmp_path: Path) -> None:
    """Of either version; what it does is tested elsewhere."""
    once("taciturn.export_fmu")
    path = tmp_path / "two-mass.fmu"
    answer = run("export", "two-mass-lqg", "--fmu", str(path), "--fmi", version, "--json")
    assert (answer.code, answer.err) == (0, "")
    document = json.loads(answer.out)
    assert (document["name"], document["fmi"]) == ("two_mass_lqg", version)
    assert "modelDescription.xml" in zipfile.ZipFile(path).namelist()
    text = run("export", "two-mass-lqg", "--fmu", str(path)).out
    assert text.startswith("an FMU of ")
    assert ["policy", "lqg"] in [line.split() for line in text.splitlines()]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ([], "neither --c nor --fmu is given; expected one of the two options, with the path to write to"),
        (["--c", "nodes", "--fmu", "unit.fmu"], "--c and --fmu are both given; expected one of the two options"),
        (["--fmu", "unit.fmu", "--node", "actuator"], "--node is given without --c"),
        (["--c", "nodes", "--fmi", "2.0"], "--fmi is given without --fmu"),
        (["--fmu", "unit.fmu", "--fmi", "1.0"], "the version of FMI is '1.0'; expected '3.0' or '2.0'"),
        (["--fmu", "unit.zip"], "expected a name that ends in .fmu"),
        (["--fmu", "/proc/unit.fmu"], "/proc/unit.fmu cannot be written"),
        (["--c", "/proc/nodes"], "the folder /proc/nodes cannot be written to"),
        (["--c", ""], "--c is empty; expected the name of a folder"),
        (["--c", "nodes", "--node", "camera"], "the node is 'camera'"),
        (["--c", "nodes", "--precision", "float16"], "precision is 'float16'; expected"),
        (["--c", "nodes", "--seed", "-1"], "seed is -1"),
    ],
)
def test_mistakes_are_told_in_a_sentence(
    run: Run, arguments: list[str], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exit code 2, one line, nothing written; compilers, which are not there, have no part in it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert told in run("export", "two-mass-lqg", *arguments).sentence
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("policy", "told"),
    [
        ('kind = "optimal"\nprice = 1.0', "decides by a boundary that nodes cannot evaluate"),
        ('kind = "integral"\nslope = 0.8\nalpha = 0.1', "is triggered in continuous time"),
    ],
)
def test_policies_that_cannot_live_on_a_device_say_why(run: Run, policy: str, told: str, tmp_path: Path) -> None:
    """Those for analysis alone, and those that are triggered in continuous time."""
    noise = "[plant.jumps]\nrate = 5\ncovariance = [[0, 0], [0, 0.5]]\n"
    noise = noise if "integral" in policy else "W = [[0.1, 0], [0, 1]]\ndt = 0.1\n"
    file = tmp_path / "policy.toml"
    file.write_text(f"{PLANT}{noise}[cost]\nQ = [[1, 0], [0, 1]]\nR = [[0.1]]\n[policy]\n{policy}\n")
    assert told in run("export", str(file), "--c", str(tmp_path / "nodes")).sentence
    assert not (tmp_path / "nodes").exists()
