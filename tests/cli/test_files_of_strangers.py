"""Problem files from strangers: functions can be refused, and no file blocks a command or fills the memory."""

from __future__ import annotations

import inspect
import os
from pathlib import Path

import pytest
import typer
from cli.conftest import COST, PLANT, Run, Write

import taciturn
from taciturn.cli.frame import app

LQG = '[policy]\nkind = "lqg"\ntheta = 0.5\n'
EXECUTED = "from pathlib import Path\nPath('executed').touch()\ndef step(x, u, w):\n    return 1.2 * x + u + w\n"


@pytest.fixture
def named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return a problem file that names a function, which leaves a file when it is executed."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plant.py").write_text(EXECUTED, encoding="utf-8")
    file = tmp_path / "named.toml"
    file.write_text(PLANT + 'function = "plant.py:step"\n' + COST + LQG, encoding="utf-8")
    return str(file)


COMMANDS = {
    "evaluate": [],
    "explore": ["--no-browser"],
    "show": [],
    "simulate": [],
    "certify": [],
    "tune": ["--rate", "0.3"],
    "tradeoff": ["--over", "theta=0.1,1"],
    "sweep": ["--over", "theta=0.1,1", "--store", "cells"],
    "compare": ["two-mass", "--rate", "0.3"],
    "channel": ["--copies", "3", "--capacity", "1"],
    "network": [],
    "plant": ["--peer", "127.0.0.1:9"],
    "export": ["--c", "out"],
}
BEFORE = {"node": ["controller"], "camera": ["rover"], "twin": ["rover"]}  # arguments before FILE
AFTER = {"camera": ["--peer", "127.0.0.1:9"]}


@pytest.mark.parametrize("command", [*COMMANDS, *BEFORE])
def test_no_functions_executes_nothing(run: Run, named: str, command: str) -> None:
    """Every command that reads a problem refuses it before its function is read."""
    options = [*BEFORE.get(command, []), named, *COMMANDS.get(command, []), *AFTER.get(command, [])]
    told = run(command, *options, "--no-functions").sentence
    assert "plant.function is 'plant.py:step', which names Python code to execute" in told
    assert not Path("executed").exists()


def test_every_command_that_reads_a_problem_has_the_option() -> None:
    """The list above is complete."""
    command = typer.main.get_command(app)
    readers = {
        name
        for name, one in command.commands.items()  # pyright: ignore  # a group
        if any(parameter.name in ("file", "files") for parameter in one.params)
    }
    assert readers == {*COMMANDS, *BEFORE}
    assert all("no_functions" in inspect.signature(command.commands[name].callback).parameters for name in readers)


def test_a_problem_without_functions_is_accepted(run: Run, write: Write) -> None:
    """The option changes nothing else."""
    file = write()
    assert run("show", file, "--no-functions").out == run("show", file).out


@pytest.mark.parametrize(
    "plant",
    [
        PLANT + 'function = "plant.py:step"\n',
        PLANT + "function = 7\n",
        PLANT + "[plant.actual]\nA = [[1.2]]\nB = [[1.0]]\nW = [[0.01]]\ndt = 1.0\nfunction = 'plant.py:step'\n",
    ],
    ids=["plant", "not a name", "actual"],
)
def test_load_refuses_functions_wherever_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plant: str) -> None:
    """In Python: load(..., functions=False)."""
    monkeypatch.chdir(tmp_path)
    Path("plant.py").write_text(EXECUTED, encoding="utf-8")
    Path("p.toml").write_text(plant + COST + LQG, encoding="utf-8")
    with pytest.raises(taciturn.ProblemError, match=r"plant\.(actual\.)?function is .*functions=False"):
        taciturn.load("p.toml", functions=False)
    assert not Path("executed").exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in folders here")
@pytest.mark.parametrize("named", ["pipe", "/dev/zero", "link", "folder"])
def test_a_function_is_read_from_a_regular_file_only(run: Run, tmp_path: Path, named: str) -> None:
    """A pipe would block for ever, and a device would never end."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to("/dev/zero")
    (tmp_path / "p.toml").write_text(PLANT + f'function = "{named}:step"\n' + COST + LQG, encoding="utf-8")
    assert (
        "which cannot be read (it is not a regular file); expected a Python file"
        in run("show", str(tmp_path / "p.toml")).sentence
    )


def test_a_function_is_read_from_a_file_of_a_usual_size_only(run: Run, tmp_path: Path) -> None:
    """One megabyte is a thousand times what a plant takes."""
    (tmp_path / "plant.py").write_bytes(EXECUTED.encode() + b"#" * 2**20)
    (tmp_path / "p.toml").write_text(PLANT + 'function = "plant.py:step"\n' + COST + LQG, encoding="utf-8")
    assert "(it has more than 1,048,576 bytes)" in run("show", str(tmp_path / "p.toml")).sentence


def test_a_problem_file_without_an_end_is_refused(run: Run) -> None:
    """It is not read into the memory until none is left."""
    if not Path("/dev/zero").exists():
        pytest.skip("no such device here")
    assert "'/dev/zero' cannot be read (it is not a regular file)" in run("show", "/dev/zero").sentence
