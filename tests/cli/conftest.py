"""The command line, run in this process."""

from __future__ import annotations

import io
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest
import typer

from taciturn import cli

PLANT = "[plant]\nA = [[1.2]]\nB = [[1.0]]\nW = [[0.01]]\ndt = 1.0\n"
COST = "[cost]\nQ = [[1.0]]\nR = [[2.0]]\n"
POLICY = '[policy]\nkind = "lqg"\ntheta = 0.5\n'


@dataclass(frozen=True)
class Answer:
    """What a command left: its exit code and both its streams."""

    code: int
    out: str
    err: str

    @property
    def unwrapped(self) -> str:
        """Standard output with the continuation lines of names and values joined."""
        return re.sub(r"\n {15,}(?=\S)", " ", self.out)

    @property
    def sentence(self) -> str:
        """The one sentence of a refusal: exit code 2, nothing on standard output, no traceback."""
        assert (self.code, self.out) == (2, "")
        assert self.err.count("\n") == 1
        assert self.err.startswith("taciturn: ")
        return self.err.removeprefix("taciturn: ").strip()


Run = Callable[..., Answer]
Ask = Callable[..., Answer]
Write = Callable[..., str]
Once = Callable[[str], None]
command_of = cache(typer.main.get_command)  # built for each call it would be most of what a refusal takes


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Return the function that runs ``taciturn`` with arguments."""

    monkeypatch.setattr(typer.main, "get_command", command_of)

    def run(*arguments: str) -> Answer:
        monkeypatch.setattr(sys, "argv", ["taciturn", *arguments])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        code = ended.value.code
        assert isinstance(code, int)
        return Answer(code, *capsys.readouterr())

    return run


@pytest.fixture
def ask(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Ask:
    """Return the function that runs ``taciturn new new.toml`` with options, and answers from a pipe."""
    monkeypatch.chdir(tmp_path)

    def ask(answers: tuple[str, ...], *options: str, patient: bool = False) -> Answer:
        typed = io.StringIO("".join(f"{answer}\n" for answer in answers))
        monkeypatch.setattr(typed, "isatty", lambda: patient)
        monkeypatch.setattr(sys, "stdin", typed)
        return run("new", "new.toml", *options)

    return ask


@pytest.fixture
def once(monkeypatch: pytest.MonkeyPatch) -> Once:
    """Return what lets a function of the package answer with its first answer ever after, to be printed twice."""

    def once(path: str) -> None:
        module, _, name = path.rpartition(".")
        function, found = getattr(import_module(module), name), list[object]()

        def answer(*arguments: object, **options: object) -> object:
            if not found:
                found.append(function(*arguments, **options))
            return found[0]

        monkeypatch.setattr(import_module(module), name, answer, raising=False)

    return once


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Return the function that writes a problem file, tables replaced by name or added, and returns its path."""

    def write(plant: str = PLANT, cost: str = COST, policy: str = POLICY, more: str = "") -> str:
        path = tmp_path / "problem.toml"
        path.write_text("\n".join((plant, cost, more, policy)), encoding="utf-8")
        return str(path)

    return write
