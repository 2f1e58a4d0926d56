"""A policy kind of another package: an entry point gives it all that the kinds of this package have."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

RULE = Path(__file__).parents[2] / "docs" / "decaying.py"
COMMANDS = """
import json, sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from taciturn.cli import main
found = []
for command in json.loads(sys.argv[1]):
    out, err, code = StringIO(), StringIO(), 0
    sys.argv = ["taciturn", *command]
    with redirect_stdout(out), redirect_stderr(err):
        try:
            main()
        except SystemExit as ended:
            code = ended.code or 0
    found.append((code, out.getvalue(), err.getvalue()))
print(json.dumps(found))
"""
PROBLEM = """
[plant]
dt = 0.1
A = [[1.0, 0.1], [0.0, 0.9]]
B = [[0.005], [0.1]]
W = [[0.0, 0.0], [0.0, 0.01]]
[cost]
Q = [[1.0, 0.0], [0.0, 0.1]]
R = [[0.1]]
[policy]
"""


def installed(
    folder: Path, entries: dict[str, str], package: str = "decaying", group: str = "taciturn.kinds"
) -> dict[str, str]:
    """Install a package with these entry points in a folder, and return the environment that sees it."""
    about = folder / f"{package}-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n", encoding="utf-8")
    lines = [f"[{group}]", *(f"{name} = {place}" for name, place in entries.items())]
    (about / "entry_points.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    shutil.copy(RULE, folder)
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *sys.path])}


def told(env: dict[str, str], folder: Path, *commands: str) -> list[tuple[int, str, str]]:
    """Return exit code, output and messages of each command, all in one process."""
    listed = json.dumps([command.split() for command in commands])
    run = subprocess.run(
        [sys.executable, "-c", COMMANDS, listed], cwd=folder, env=env, capture_output=True, text=True, check=True
    )
    return [tuple(one) for one in json.loads(run.stdout)]


def problems(folder: Path) -> dict[str, str]:
    """Write a problem of the registered kind and one of periodic control, and return the environment."""
    (folder / "mine.toml").write_text(PROBLEM + 'kind = "decaying"\ndelta = 0.1\n', encoding="utf-8")
    (folder / "clock.toml").write_text(PROBLEM + 'kind = "periodic"\nevery = 3\n', encoding="utf-8")
    return installed(folder / "site", {"decaying": "decaying:KIND"})


@pytest.mark.evidence
def test_a_registered_kind_is_evaluated_run_and_exported(tmp_path: Path) -> None:
    """As the kinds of this package; a name that is nearly its name is recognised."""
    *right, written, wrong = told(
        problems(tmp_path),
        tmp_path,
        "show mine.toml --json",
        "evaluate mine.toml --steps 20000 --json",
        "network mine.toml --steps 50 --json",
        "export mine.toml --c code",
        "new own.toml --kind decaying",
        "evaluate mine.toml --set kind=decaing",
    )
    assert [(code, err) for code, _, err in right] == [(0, "")] * 4
    shown, evaluated, run = (json.loads(out) for _, out, _ in right[:3])
    assert shown["policy"] == evaluated["policy"] == "decaying"
    assert run["rates"]["actuator"]["value"] > 0
    assert (tmp_path / "code").is_dir()
    assert written[1].startswith("Is the model continuous in time")
    assert "Did you mean 'decaying'?" in wrong[2]


@pytest.mark.evidence
def test_a_registered_kind_is_tuned_and_compared(tmp_path: Path) -> None:
    """By the tuning parameter of its record."""
    right = told(
        problems(tmp_path),
        tmp_path,
        "tune mine.toml --rate 0.3 --standard-error 0.01 --json",
        "compare mine.toml clock.toml --rate 0.3 --standard-error 0.01 --json",
        "tradeoff mine.toml --over delta=0.1,0.2 --standard-error 0.01 --json",
    )
    assert [(code, err) for code, _, err in right] == [(0, "")] * 3
    tuned, compared, traded = (json.loads(out) for _, out, _ in right)
    assert tuned["parameter"]["name"] == "delta"
    assert tuned["rates"]["actuator"]["value"] == pytest.approx(0.3, abs=0.01)
    assert "decaying" in json.dumps(compared)
    assert len(traded["points"]) == 2


def test_a_registered_kind_is_completed_without_its_import(tmp_path: Path) -> None:
    """By the name of the entry point, also if the package is broken."""
    env = installed(tmp_path / "site", {"decaying": "decaying:KIND", "lost": "missing:KIND"})
    code = (
        "import sys\nfrom taciturn.cli.frame import complete_kind\n"
        "print(complete_kind('de'), complete_kind('lo'), 'decaying' in sys.modules, 'numpy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[0] == "['decaying'] ['lossy-lqg', 'lost'] False False"


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        (
            {"lost": "missing:KIND"},
            "the policy kind 'lost' needs the Python object missing:KIND, which cannot be imported (Module",
        ),
        (
            {"lost": "decaying:decaying"},
            "the policy kind 'lost' needs the object decaying:decaying of the package decaying, which is a function;",
        ),
        (
            {"lost": "decaying:KIND"},
            "the policy kind 'lost' needs the object decaying:KIND of the package decaying, which is the kind decaying",
        ),
        (
            {"lqg": "decaying:KIND"},
            "the policy kind 'lqg' is registered by taciturn itself and by the package decaying",
        ),
    ],
)
def test_a_wrong_registration_is_refused_when_it_is_asked_for(
    tmp_path: Path, entries: dict[str, str], words: str
) -> None:
    """In one sentence; other kinds are not affected."""
    (name,) = entries
    code = (
        "from taciturn.design.catalogue import CATALOGUE\nfrom taciturn.problem.parameters import find_kind\n"
        f"print(len(CATALOGUE), find_kind('periodic').name)\nfind_kind({name!r})"
    )
    env = installed(tmp_path / "site", entries)
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False)
    assert done.stdout.split()[1:] == ["periodic"]
    assert done.stderr.splitlines()[-1].startswith("taciturn.errors.ProblemError: the policy ")
    assert words in done.stderr.splitlines()[-1]


def test_two_packages_with_a_kind_of_the_same_name_are_named(tmp_path: Path) -> None:
    """Neither is preferred."""
    installed(tmp_path / "site", {"decaying": "decaying:KIND"})
    env = installed(tmp_path / "site", {"decaying": "decaying:KIND"}, "other")
    code = "from taciturn.design.catalogue import CATALOGUE\nCATALOGUE['decaying']"
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False)
    assert "the policy kind 'decaying' is registered by the package" in done.stderr.splitlines()[-1]


BROKEN = """
from dataclasses import replace

from decaying import KIND, decaying


def fails(plant, cost, *, delta: float):
    raise ValueError("not today")


def nothing(plant, cost, *, delta: float):
    return None


def of_another_name(plant, cost, *, delta: float):
    return decaying(plant, cost, delta=delta)


FAILS, NOTHING = replace(KIND, name="fails", design=fails), replace(KIND, name="nothing", design=nothing)
OTHER = replace(KIND, name="other", design=of_another_name)
"""


@pytest.mark.evidence
def test_what_a_registered_design_makes_of_a_problem_is_checked(tmp_path: Path) -> None:
    """An error, another value, a policy of another kind, and plants and costs that the record does not list."""
    env = problems(tmp_path)
    (tmp_path / "site" / "broken.py").write_text(BROKEN, encoding="utf-8")
    places = {"fails": "broken:FAILS", "nothing": "broken:NOTHING", "other": "broken:OTHER"}
    env = installed(tmp_path / "site", places, "broken") | {"PYTHONPATH": env["PYTHONPATH"]}
    found = told(
        env,
        tmp_path,
        *(f"show mine.toml --set kind={kind}" for kind in places),
        "show mine.toml --set cost.horizon=20",
        "show two-mass-continuous --set kind=decaying --set theta=none --set period=none --set delta=0.1",
    )
    expected = (
        r"broken:fails of the policy kind fails fails \(ValueError: not today\); expected a policy of this kind",
        r"broken:nothing of the policy kind nothing returns None; expected a policy of this kind",
        r"broken:of_another_name of the policy kind other returns Policy\(.*; expected a policy of this kind",
        r"the cost has a horizon \(cost.horizon\), which decaying does not support; expected another problem",
        r"the plant is in continuous time, which decaying does not support; expected another problem",
    )
    for (code, _, message), sentence in zip(found, expected, strict=True):
        assert code == 2, message
        assert re.search(sentence, message), message


def test_commands_of_a_package_are_added_unless_their_name_is_taken(tmp_path: Path) -> None:
    """One that is new runs; one of a known name, and one that cannot be imported, leave the others as they are."""
    body = "from taciturn.cli.frame import app\n\n\n@app.command()\ndef {name}() -> None:\n    print('hello')\n"
    site = tmp_path / "site"
    env = installed(site, {"one": "first_commands", "two": "second_commands", "three": "missing_commands"},
                    "more", "taciturn.commands")  # fmt: skip
    (site / "first_commands.py").write_text(body.format(name="greet"), encoding="utf-8")
    (site / "second_commands.py").write_text(body.format(name="show"), encoding="utf-8")
    run = [sys.executable, "-m", "taciturn", "greet"]
    done = subprocess.run(run, env=env, capture_output=True, text=True, check=True)
    assert done.stdout == "hello\n"
    assert "the commands of the package more are not used, since the command show exists already" in done.stderr
    assert "the command line needs the Python object missing_commands, which cannot be imported" in done.stderr


@pytest.mark.evidence
def test_a_package_that_ends_the_process_on_its_import_is_named(tmp_path: Path) -> None:
    """Commands, kinds, problems and laws that call ``sys.exit``; every command of this package still works."""
    site = tmp_path / "site"
    env = installed(site, {"gone": "gone"}, "first", "taciturn.commands")
    installed(site, {"gone": "gone:KIND"}, "second", "taciturn.kinds")
    installed(site, {"gone": "gone.problems"}, "third", "taciturn.problems")
    installed(site, {"gone": "gone:LAW"}, "fourth", "taciturn.bursts")
    (site / "gone.py").write_text("import sys\nsys.exit(3)\n", encoding="utf-8")

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "taciturn", *words]
        return subprocess.run(command, env=env, capture_output=True, text=True, check=False)

    shown = run("show", "two-mass")
    assert (shown.returncode, shown.stderr.count("\n")) == (0, 1)
    told = "cannot be imported (SystemExit: 3); expected an object that can be imported: repair or remove"
    assert told in shown.stderr
    missing = run("evaluate", "nosuch")
    assert missing.returncode == 2
    assert missing.stderr.count("the problems of the package third are not used, since gone.problems cannot be") == 1
    assert "there is no file 'nosuch'; expected a problem file, or one of the built-in problems" in missing.stderr
    kind = run("show", "two-mass", "--set", "kind=gone")
    assert kind.returncode == 2
    assert (
        "the policy kind 'gone' needs the Python object gone:KIND, which cannot be imported (SystemExit: 3)"
        in kind.stderr
    )


@pytest.mark.evidence
def test_entry_points_that_are_no_text_leave_all_other_packages_as_they_are(tmp_path: Path) -> None:
    """The package need not have to do with this library; it is named once."""
    site = tmp_path / "site"
    env = installed(site, {"decaying": "decaying:KIND"})
    installed(site, {"other": "other:KIND"}, "broken")
    (site / "broken-1.0.dist-info" / "entry_points.txt").write_bytes("[taciturn.kinds]".encode("utf-16"))
    code = "from taciturn.design.catalogue import CATALOGUE\nprint(CATALOGUE['decaying'].name)\n"
    code += "from taciturn import load\nprint(load('rover').kind)"
    run = [sys.executable, "-c", code]
    done = subprocess.run(run, env=env, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["decaying", "remote-lqg"]
    assert done.stderr.count("the package broken has entry points that cannot be read") == 1
