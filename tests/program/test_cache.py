"""The cache executes only what no other user can have written."""

from __future__ import annotations

import os
import stat
import warnings
from pathlib import Path

import numpy as np
import pytest

from taciturn.program import machine
from taciturn.program.ir import Builder, Program
from taciturn.program.machine import Kernel

pytestmark = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="Windows has no owners by number")
root = pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can give files away")


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Return the folder of an empty cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "taciturn"


def program(doublings: int) -> Program:
    """Return a program that doubles its input some times; the number is part of its machine code."""
    b = Builder()
    x = b.input("in 0")
    for _ in range(doublings):
        x = b.emit("add", x, x)
    return b.finish([], {}, {"x": x})


def answer(one: Program) -> float:
    """Return what a program makes of 1 in a process that has just begun."""
    machine.forget()
    return float(Kernel(one, "parity").run(one, np.zeros((0, 1)), 1, np.ones((1, 1, 1))).outputs["x"][0, 0])


def mode(path: Path) -> int:
    """Return the access bits of a file or folder."""
    return stat.S_IMODE(path.stat().st_mode)


def forge(folder: Path) -> None:
    """Replace the machine code of a program that doubles by that of one that quadruples, with a right digest."""
    before = {path.name for path in folder.iterdir()}
    assert answer(program(1)) == 2.0
    (one,) = {path.name for path in folder.iterdir()} - before
    assert answer(program(2)) == 4.0
    (two,) = {path.name for path in folder.iterdir()} - before - {one}
    code = machine.read_code(folder, two.removesuffix(".o"))
    assert code is not None
    machine.write_code(folder, one.removesuffix(".o"), code, 99)


def test_a_forgery_of_this_user_would_be_executed(folder: Path) -> None:
    """Otherwise the tests below could not fail."""
    assert machine.cache_folder() == folder
    forge(folder)
    assert answer(program(1)) == 4.0


def test_folder_and_files_are_private(folder: Path) -> None:
    """Whatever the mask of the process."""
    before = os.umask(0o002)
    try:
        answer(program(1))
    finally:
        os.umask(before)
    assert mode(folder) == 0o700
    assert [mode(path) for path in folder.iterdir()] == [0o600]


def test_a_folder_that_others_can_only_read_becomes_private(folder: Path) -> None:
    """What is in it is used."""
    folder.mkdir(0o755)
    folder.chmod(0o755)
    assert machine.cache_folder() == folder
    assert mode(folder) == 0o700


@pytest.mark.parametrize("bits", [0o775, 0o777, 0o1777, 0o720])
def test_a_folder_that_others_could_write_is_emptied(folder: Path, bits: int) -> None:
    """Whoever planted a file there executes nothing."""
    machine.cache_folder()
    forge(folder)
    folder.chmod(bits)
    with pytest.warns(UserWarning, match="other users could write to the cache folder .* were deleted"):
        assert answer(program(1)) == 2.0
    assert mode(folder) == 0o700
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert answer(program(1)) == 2.0


@pytest.mark.parametrize("bits", [0o620, 0o602, 0o666])
def test_a_file_that_others_can_write_is_not_executed(folder: Path, bits: int) -> None:
    """It is replaced by one that only this user can write."""
    machine.cache_folder()
    forge(folder)
    for path in folder.iterdir():
        path.chmod(bits)
    with pytest.warns(UserWarning, match="can be written by other users; the program is compiled again"):
        assert answer(program(1)) == 2.0
    assert answer(program(1)) == 2.0


@root
def test_what_another_user_owns_is_not_executed(folder: Path) -> None:
    """Neither a file, nor a folder."""
    machine.cache_folder()
    forge(folder)
    for path in folder.iterdir():
        os.chown(path, 12345, -1)
    with pytest.warns(UserWarning, match="belongs to another user; the program is compiled again"):
        assert answer(program(1)) == 2.0
    os.chown(folder, 12345, -1)
    with pytest.warns(UserWarning, match="belongs to another user, so it is not used"):
        assert answer(program(1)) == 2.0
    assert folder.stat().st_uid == 12345


def test_code_under_the_name_of_another_program_is_not_executed(folder: Path) -> None:
    """The digest covers the name."""
    machine.cache_folder()
    assert [answer(program(1)), answer(program(2))] == [2.0, 4.0]
    one, two = sorted(folder.iterdir())
    first, second = one.read_bytes(), two.read_bytes()
    one.write_bytes(second)
    two.write_bytes(first)
    with pytest.warns(UserWarning, match="is damaged"):
        assert [answer(program(1)), answer(program(2))] == [2.0, 4.0]


def test_a_relative_cache_home_is_ignored(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As its specification says: the folder of the platform is used, and nothing in the working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_CACHE_HOME", "here")
    found = machine.cache_folder()
    assert found is not None
    assert found.is_relative_to(tmp_path / "home")
    assert not (tmp_path / "here").exists()
