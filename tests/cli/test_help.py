"""``--help`` teaches, and a shell completes."""

from __future__ import annotations

import shlex
import subprocess
import sys
from collections.abc import Callable
from inspect import signature
from pathlib import Path

import pytest
import typer.main
from cli.conftest import Run
from counts import few

import taciturn
from taciturn.cli import frame
from taciturn.cli.frame import EXAMPLE, GROUPS, app
from taciturn.cli.usage import parser_words
from taciturn.design.catalogue import CATALOGUE

COMMANDS = sorted(name for names in GROUPS.values() for name in names)


@pytest.fixture
def complete(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[str], list[str]]:
    """Return what bash offers for the last word of a line, asked for by typer's protocol."""
    monkeypatch.chdir(tmp_path)

    def complete(typed: str) -> list[str]:
        line = shlex.split(typed) + [""] * typed.endswith(" ")
        asked = {"_TACITURN_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": str(len(line) - 1)}
        for name, value in asked.items():
            monkeypatch.setenv(name, value)
        told = run()
        assert (told.code, told.err) == (0, "")
        return told.out.split()

    return complete


def test_help_lists_every_command_once_under_what_it_is_for(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """With its whole first sentence, a first example, and where to read on."""
    assert sorted(typer.main.get_group(app).commands) == COMMANDS
    monkeypatch.setenv("COLUMNS", "80")
    told = run("--help").out
    assert max(map(len, told.splitlines())) <= 80
    for title, names in GROUPS.items():
        section = told.partition(f"\n{title}:\n")[2].partition("\n\n")[0]
        assert [line.split()[0] for line in section.splitlines() if line[:2] == "  " and line[2] != " "] == list(names)
    assert "..." not in told.partition("COMMAND [ARGS]...")[2]
    assert "\n    taciturn evaluate two-mass    cost, rate" in told
    assert "docs/first-hour" in told


CALLED = {
    "evaluate": taciturn.evaluate,
    "tune": taciturn.tune,
    "tradeoff": taciturn.tradeoff,
    "compare": taciturn.compare,
    "sweep": taciturn.sweep,
    "channel": taciturn.share_channel,
    "certify": taciturn.certify,
    "export": taciturn.export_c,
}
OTHERWISE = {  # arguments that a command has in another form, and one that is only for programs
    *("problem", "problems", "progress", "executor", "time_limit"),
    *("name", "folder", "after_step"),
}


@pytest.mark.parametrize("name", CALLED)
def test_each_argument_of_a_function_is_an_option_of_its_command(name: str) -> None:
    """Options are stated apart from the signatures, which need numpy; no argument is forgotten."""
    options = {str(one.name) for one in typer.main.get_group(app).commands[name].params}
    assert set(signature(CALLED[name]).parameters) - OTHERWISE <= options


def test_every_command_that_designs_a_policy_changes_its_keys() -> None:
    """Those of twins take the price and theta as options of their own."""
    commands = typer.main.get_group(app).commands
    without = {"new", "bench", "delays", "reproduce", "relay", "setpoint", "twin", "camera", "help", "version"}
    for name, command in commands.items():
        assert any("--set" in option.opts for option in command.params) == (name not in without), name


def test_commands_that_print_results_print_methods_on_request() -> None:
    """Those with a result that has a text; the others ask, serve, or report what their processes counted."""
    commands = typer.main.get_group(app).commands
    asked = {name for name, one in commands.items() if any("-v" in option.opts for option in one.params)}
    assert asked == {
        *("show", "evaluate", "simulate", "tradeoff", "compare", "tune", "sweep", "channel", "certify", "network"),
        *("bench", "delays", "twin", "export", "reproduce"),
    }


@pytest.mark.parametrize("name", few(COMMANDS, 12))
def test_the_example_of_a_command_is_one(run: Run, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Its words are those that the command takes, and every file that it reads is a built-in problem."""
    command = typer.main.get_group(app).commands[name]
    assert command.epilog is not None
    first, second, *arguments = shlex.split(command.epilog.removeprefix(EXAMPLE))
    assert (first, second) == ("taciturn", name)
    given = command.make_context(name, arguments).params
    for word in [given.get("file"), *(given.get("files") or ())]:
        assert word is None or word in frame.complete_file("")
    monkeypatch.setenv("COLUMNS", "80")
    shown = run(name, "--help").out
    assert max(map(len, shown.splitlines())) <= 80
    assert f"\n    {command.epilog.removeprefix(EXAMPLE)}" in shown, "on one line, so that it can be pasted"


def test_help_and_version_are_also_commands_and_short_options(run: Run) -> None:
    """With the same text; ``help`` without a command is that of ``taciturn``."""
    assert run("help").out == run("--help").out == run("-h").out == run().out
    assert run("help", "evaluate").out == run("evaluate", "-h").out == run("evaluate", "--help").out
    assert run("version").out == run("--version").out == run("-V").out == f"{taciturn.__version__}\n"


@pytest.mark.parametrize("name", few(COMMANDS, 6))
def test_whole_numbers_may_have_an_exponent(name: str) -> None:
    """For every option that is a whole number, and only there: a text remains as it is typed."""
    command = typer.main.get_group(app).commands[name]
    for one in command.params:
        if one.opts[0].startswith("--") and not getattr(one, "is_flag", False):
            option = one.opts[0]
            whole = one.type_descriptor.annotation is int  # pyright: ignore[reportAttributeAccessIssue]
            for word, read in (("1e6", "1000000"), ("1_000_000", "1000000"), ("1.5", "1.5"), ("-2e0", "-2")):
                assert parser_words(command, [option, word]) == [option, read if whole else word]
                assert parser_words(command, [f"{option}={word}"]) == [f"{option}={read if whole else word}"]


def test_options_by_their_earlier_names_are_read(run: Run) -> None:
    """But not the values of options, nor the words after --."""
    path = run("simulate", "two-mass-lqg", "--ticks", "3", "--json")
    assert path.out == run("simulate", "two-mass-lqg", "--steps", "3", "--json").out
    command = typer.main.get_group(app).commands["simulate"]
    kept = ["--plot", "--ticks", "--set", "--ticks=1e2", "--", "--ticks", "1e2"]
    assert parser_words(command, kept) == kept


def test_pages_that_help_names_are_there() -> None:
    """In the folder of the documentation."""
    docs = Path(__file__).parent.parent.parent / "docs"
    epilog = typer.main.get_group(app).epilog
    assert epilog is not None
    named = [word.strip(",.") for word in epilog.split() if word.startswith("docs/")]
    assert len(named) == 3
    assert all((docs.parent / f"{page}.md").is_file() for page in named)


def test_files_and_built_in_problems_are_completed(complete: Callable[[str], list[str]], tmp_path: Path) -> None:
    """TOML files next to built-in problems, in folders too; where nothing fits the shell continues by itself."""
    (tmp_path / "two.toml").touch()
    (tmp_path / "two.mat").touch()
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "mine.toml").touch()
    assert complete("taciturn show two") == ["two.toml", "two-mass", "two-mass-continuous", "two-mass-lqg"]
    assert complete("taciturn evaluate sub/") == ["sub/mine.toml"]
    assert complete("taciturn compare two-mass rov") == ["rover"]
    assert complete("taciturn show su") == []


def test_commands_kinds_and_words_are_completed(complete: Callable[[str], list[str]]) -> None:
    """Each where it is asked for."""
    assert complete("taciturn sh") == ["show"]
    assert complete("taciturn new --kind re") == ["relative", "remote-lqg"]
    assert complete("taciturn tune two-mass --link ") == ["sensor", "actuator"]
    assert complete("taciturn tune quadruple-tank --rate 0.3 --link le") == ["level-1", "level-2"]
    assert complete("taciturn compare missing.toml --link ") == []
    assert complete("taciturn new --kind ") == list(CATALOGUE)


def test_completion_imports_nothing_heavy(tmp_path: Path) -> None:
    """So that it comes while one types."""
    code = (
        "import os, sys\nsys.argv = ['taciturn']\n"
        "os.environ.update(_TACITURN_COMPLETE='complete_bash', COMP_WORDS='taciturn show two', COMP_CWORD='2')\n"
        "from taciturn.cli import main\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        "print('heavy:', sorted({'numpy', 'scipy', 'matplotlib', 'llvmlite', 'xarray', 'h5py'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout.split("\n")[-2] == "heavy: []"


def test_the_script_for_a_shell_names_the_command(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the process is called, and whatever has started the tests."""
    monkeypatch.setattr("shellingham.detect_shell", lambda: ("bash", "/bin/bash"))
    assert "complete -o default -F _taciturn_completion taciturn" in run("--show-completion", "bash").out


def test_a_terminal_gets_a_refusal_in_80_columns(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between words; a file or a pipe gets it on one line."""
    sentence = run("evaluate", "two-mass", "--set", "delta=0.1", "--set", "trigger=1").sentence
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    wrapped = run("evaluate", "two-mass", "--set", "delta=0.1", "--set", "trigger=1").err
    assert " ".join(wrapped.split()) == f"taciturn: {sentence}"
    assert len(wrapped.splitlines()) > 1
    assert max(map(len, wrapped.splitlines())) <= 80
