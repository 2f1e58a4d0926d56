"""The commands: what they print, what they refuse, and how they end."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import taciturn
from taciturn.simulation import sampling
from taciturn.study.evaluate import evaluate

if TYPE_CHECKING:
    from conftest import Run, Write

ALL_TIME = '[policy]\nkind = "all-time"\n'
PERIODIC = '[policy]\nkind = "periodic"\nevery = 2\n'
PLANT = "[plant]\nA = [[1.2]]\nB = [[1.0]]\nW = [[0.01]]\ndt = 1.0\n"


def execute(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command line as a process of its own."""
    return subprocess.run([sys.executable, "-m", "taciturn", *arguments], capture_output=True, text=True, check=False)


def test_evaluate_prints_cost_rate_and_guarantee_and_nothing_else() -> None:
    """As a process, to a pipe: no progress."""
    done = execute("evaluate", "two-mass-lqg", "--steps", "100000")
    assert (done.returncode, done.stderr) == (0, "")
    verdict, table, rest = done.stdout.split("\n\n")
    assert " % of the packets, " in verdict
    assert verdict.endswith("proven")
    heads = [line.split()[0] for line in rest.splitlines() if line[0] != " "]
    assert heads == ["policy", "periodic", "proof"]
    names = [line[:19].strip() for line in table.splitlines() if line[:19].strip()]
    assert names == ["this policy", "periodic, same rate", "every sample", "guarantee"]


def test_methods_and_times_are_printed_on_request(run: Run) -> None:
    """After what is printed without the option."""
    command = ("evaluate", "two-mass-lqg", "--steps", "100000")
    plain, more = run(*command).out, run(*command, "-v").out
    assert more.startswith(plain)
    assert [line.split()[0] for line in more[len(plain) :].splitlines()] == ["method", "seed", "time"]
    assert "simulation, completed squares: " in more


def test_evaluate_json_is_one_document_with_the_promised_keys(run: Run) -> None:
    """Standard output is JSON from its first to its last character."""
    done = run("evaluate", "two-mass-lqg", "--json", "--steps", "100000", "--seed", "3")
    assert (done.code, done.err) == (0, "")
    document = json.loads(done.out)
    promised = {
        "policy",
        "cost",
        "cost_all_time",
        "cost_bound",
        "cost_bound_at_rate",
        "rates",
        "seed",
        "seconds",
        "reached",
    }
    assert promised <= set(document)
    assert set(document["cost"]) == {"value", "standard_error", "method"}
    assert set(document["rates"]) == {"actuator"}
    assert set(document["rates"]["actuator"]) == {"value", "standard_error"}
    assert (document["policy"], document["seed"], document["reached"]) == ("lqg", 3, True)
    assert document["cost_bound"] == pytest.approx(1.1 * document["cost_all_time"])
    assert document["cost_bound_at_rate"] is None
    assert document["cost"]["method"] == "simulation"


def test_a_refusal_is_one_line_and_exit_code_2() -> None:
    """As a process: nothing on standard output, no traceback."""
    done = execute("nowhere")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert done.stderr.startswith("taciturn: there is no command 'nowhere'; see taciturn --help")


def test_a_reader_that_leaves_early_is_no_error() -> None:
    """``taciturn … | head -1`` prints no traceback."""
    shell = f"{sys.executable} -m taciturn --help | true"
    done = subprocess.run(shell, shell=True, capture_output=True, text=True, check=False)
    assert done.stderr == ""


@pytest.mark.skipif(os.name != "posix", reason="a POSIX shell")
@pytest.mark.parametrize("words", ["show two-mass", "--help"])
def test_every_command_ends_well_if_its_reader_leaves_early(words: str) -> None:
    """Exit code 0, as if the reader had left after the last line, also if nothing was read."""
    shell = f"({sys.executable} -m taciturn {words}; echo $? >&2) | true"
    done = subprocess.run(shell, shell=True, capture_output=True, text=True, check=False)
    assert done.stderr == "0\n"


@pytest.mark.skipif(os.name != "posix", reason="a POSIX shell")
@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        ("show two-mass >&-", 0, ""),
        pytest.param("show two-mass >&- 2>&-", 0, "", marks=pytest.mark.evidence),
        pytest.param("evaluate nosuch 2>&-", 2, "", marks=pytest.mark.evidence),
        ("evaluate nosuch >&-", 2, "there is no file 'nosuch'"),
        pytest.param("evaluate nosuch > /dev/full", 2, "there is no file 'nosuch'", marks=pytest.mark.evidence),
        pytest.param("evaluate nosuch 2> /dev/full", 2, "", marks=pytest.mark.evidence),
        ("show two-mass > /dev/full 2> /dev/full", 2, ""),
        ("new none.toml <&-", 2, "the input ends before the time base is given"),
    ],
)
def test_streams_that_are_closed_or_full_change_only_what_is_printed(
    tmp_path: Path, words: str, code: int, told: str
) -> None:
    """The exit code is the same, a refusal is one sentence where it can be written, and there is no traceback."""
    if "/dev/full" in words and not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    shell = f"{sys.executable} -m taciturn {words}"
    done = subprocess.run(shell, shell=True, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == code
    assert "Traceback" not in done.stderr
    assert told in done.stderr
    assert done.stderr.count("\n") == bool(told)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_is_told_in_one_sentence() -> None:
    """And once."""
    shell = f"{sys.executable} -m taciturn --help > /dev/full"
    done = subprocess.run(shell, shell=True, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "No space left on device" in done.stderr


@pytest.mark.evidence
def test_a_terminal_without_mathematics_still_gets_its_text(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    """Letters that its encoding lacks are escaped."""
    monkeypatch.setenv("PYTHONIOENCODING", "latin-1")
    command = [sys.executable, "-m", "taciturn", "show", write()]
    done = subprocess.run(command, capture_output=True, encoding="latin-1", check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "J \\u2264 (1+" in done.stdout


def test_without_a_command_the_help_is_shown(run: Run) -> None:
    """And ``--version`` shows the version."""
    assert "\nMeasure and prove:\n" in run().out
    assert run("--version").out.strip().count(".") == 2


@pytest.mark.parametrize("policy", [ALL_TIME, PERIODIC], ids=["all-time", "periodic"])
def test_a_closed_form_is_exact_and_takes_no_steps(run: Run, write: Write, policy: str) -> None:
    """Standard error 0, whether asked for or not; what no simulation could do is refused all the same."""
    path = write(policy=policy)
    for method in ("exact", "auto"):
        document = json.loads(run("evaluate", path, "--json", "--method", method).out)
        assert (document["cost"]["method"], document["cost"]["standard_error"], document["steps"]) == ("exact", 0.0, 0)
    assert run("evaluate", path, "--steps", "0").sentence == "--steps is 0; expected a whole number of at least 1024"
    assert run("evaluate", path, "--standard-error", "nan").sentence.startswith("--standard-error is nan; expected")


@pytest.mark.parametrize(
    ("over", "sentence"),
    [
        ("theta", "the option --over 'theta' is malformed; expected NAME=v1,v2,…, such as theta=0.1,1"),
        ("theta=", "the option --over 'theta=' is malformed; expected NAME=v1,v2,…, such as theta=0.1,1"),
        ("=1", "the option --over '=1' is malformed; expected NAME=v1,v2,…, such as theta=0.1,1"),
        ("theta=1,,2", "the option --over 'theta=1,,2' is malformed; expected NAME=v1,v2,…, such as theta=0.1,1"),
        (".=1", "the option --over '.=1' is malformed; expected NAME=v1,v2,…, such as theta=0.1,1"),
        ("plant..dt=1", "the option --over 'plant..dt=1' is malformed; expected NAME=v1,v2,…, such as theta=0.1,1"),
        (
            "thet=1",
            "the changed problem: policy.thet is not a parameter of the policy kind lqg; expected one of theta,",
        ),
        ("theta=0.1,-1", "the changed problem: policy.theta is -1; expected 0 ≤ theta"),
        ("theta=nan", "the changed problem: policy.theta is nan; expected a finite number"),
        ("theta=true", "the changed problem: policy.theta is True; expected a number"),
        ("theta=0.1,a", "the changed problem: policy.theta is 'a'; expected a number"),
        ("trigger=joint,sep", "the changed problem: policy.trigger is 'sep'; expected 'joint' or 'separate'"),
        (
            "kind=periodic",
            "in the changed problem, policy.kind is 'periodic', which has no parameter theta; expected ",
        ),
        (
            "kind=nonsense",
            "the changed problem: policy.kind is 'nonsense'; expected one of the policy kinds absolute, all",
        ),
        ("plant.dt=x", "the changed problem: plant.dt is 'x'; expected a number"),
        ("plant.dt=0", "the changed problem: dt is 0; expected 0 < dt"),
        ("plant.foo=1", "the changed problem: plant.foo is not a known key; expected one of A, B, C, D, W, V, E, dt,"),
        ("foo.bar=1", "the changed problem: foo is not a known key; expected one of plant, cost, network,"),
        ("plant.dt.x=1", "plant.dt.x is not a key of a problem file: dt is 1.0; expected a key such as plant.dt"),
        ("plant.A.0=1", "plant.A.0 is not a key of a problem file: A is [[1.2]]; expected a key such as plant.dt"),
        (
            "cost.R=[1],[2]",
            "the changed problem: R has shape (1,); expected the shape (any, any) = (inputs, inputs), such as [[1]]",
        ),
        (
            "cost.discount=0.9",
            "the changed problem: cost.discount is 0.9, which the policy kind lqg does not use; expected an average",
        ),
        (
            "network.actuator_loss=0.1",
            "the changed problem: network.actuator_loss is given, which the policy kind lqg does not use",
        ),
        (
            "network.delay=1",
            "the changed problem: network.delay is given, which the policy kind lqg does not use; expected ideal",
        ),
    ],
)
def test_a_wrong_value_to_trade_off_over_is_refused_before_anything_runs(
    run: Run, write: Write, over: str, sentence: str
) -> None:
    """Malformed, unknown, of the wrong type, out of range, or of no use to the policy."""
    assert run("tradeoff", write(), "--over", over).sentence.startswith(sentence)


def test_a_name_given_twice_is_refused(run: Run, write: Write) -> None:
    """Under either of its names, so that no list is lost in silence."""
    told = run("tradeoff", write(), "--over", "theta=1", "--over", "policy.theta=2").sentence
    assert told.startswith("the option --over policy.theta is given twice; expected all its values in one list")


def test_words_and_truths_are_values(run: Run) -> None:
    """In quotes, a word is not the removal of a key."""
    shown = run("show", "pid-tank", "--json", "--set", 'controller.disturbance="none"')
    assert json.loads(shown.out)["cost_all_time"] == pytest.approx(0.00272706026)
    options = ("network.protocol='tcp'", "network.actuator_loss=0.1", "retry=true")
    shown = run("show", "pid-tank", "--json", *(word for option in options for word in ("--set", option)))
    assert json.loads(shown.out)["parameters"]["retry"] is True


def test_dotted_names_change_the_tables_of_the_file(run: Run, write: Write) -> None:
    """``policy.theta`` is ``theta``, and two names make a grid."""
    path = write()
    answer = run(
        "tradeoff", path, "--json", "--over", "policy.theta=0.1,1", "--over", "plant.dt=0.5", "--standard-error", "0.01"
    )
    assert (answer.code, answer.err) == (0, "")
    values = [point["values"] for point in json.loads(answer.out)["points"]]
    assert values == [{"policy.theta": 0.1, "plant.dt": 0.5}, {"policy.theta": 1, "plant.dt": 0.5}]


@pytest.mark.evidence
def test_tradeoff_draws_a_picture(run: Run, write: Write, tmp_path: Path) -> None:
    """Next to the table; a folder in its place is refused in a sentence."""
    picture = tmp_path / "ünï.svg"
    answer = run("tradeoff", write(), "--over", "theta=0.1,1", "--standard-error", "0.01", "--plot", str(picture))
    assert answer.code == 0
    assert answer.out.splitlines()[-1] == f"picture: {picture}"
    assert picture.read_text(encoding="utf-8").startswith("<?xml")
    (tmp_path / "folder.svg").mkdir()
    answer = run("tradeoff", write(policy=PERIODIC), "--over", "every=2", "--plot", str(tmp_path / "folder.svg"))
    assert "is a folder" in answer.sentence


def test_a_precision_out_of_reach_is_told_after_the_result(
    run: Run, write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exit code 2, and the JSON still printed, with ``"reached": false``."""
    monkeypatch.setattr(sampling, "MOST_OPERATIONS", 20_000)
    answer = run("evaluate", write(), "--json", "--standard-error", "1e-9")
    assert (answer.code, json.loads(answer.out)["reached"]) == (2, False)
    assert answer.err.count("\n") == 1
    assert answer.err.startswith("taciturn: the standard error 1e-09 was not reached within ")
    assert answer.err.endswith("; give a larger --standard-error\n")
    answer = run("tradeoff", write(), "--json", "--standard-error", "1e-9", "--over", "theta=0.1,1")
    assert (answer.code, [p["reached"] for p in json.loads(answer.out)["points"]]) == (2, [False, False])
    assert answer.err.startswith("taciturn: the standard error was not reached at 2 of 2 points, first at theta=0.1;")


def test_steps_that_do_not_outlast_the_start_are_told(run: Run, write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a run of so many steps has not settled, more steps are the remedy, not another standard error."""
    monkeypatch.setattr(taciturn, "evaluate", lambda *a, **k: replace(evaluate(*a, **k), reached=False), raising=False)
    answer = run("evaluate", write(), "--steps", "2000", "--json")
    assert (answer.code, json.loads(answer.out)["reached"]) == (2, False)
    assert answer.err.startswith("taciturn: the loop has not settled within ")
    assert answer.err.endswith(" steps; give more --steps\n")


@pytest.mark.parametrize("effort", [(), ("--steps", "20000")], ids=["precision", "steps"])
@pytest.mark.parametrize("A", [2.5, 1.9, 300.0])
def test_a_loop_that_diverges_says_so(run: Run, write: Write, A: float, effort: tuple[str, ...]) -> None:
    """An actual plant that the policy cannot hold."""
    actual = f"[plant.actual]\nA = [[{A}]]\nB = [[0.1]]\nW = [[0.01]]\ndt = 1.0\n"
    told = run("evaluate", write(plant=PLANT + actual), *effort).sentence
    assert told.startswith("the loop of lqg diverges: the ")
    assert "expected a stable loop: send more often, or check [plant.actual] and input_limit" in told


def test_an_actual_plant_takes_the_guarantee_away(run: Run, write: Write) -> None:
    """And a note says why."""
    actual = "[plant.actual]\nA = [[1.21]]\nB = [[1.0]]\nW = [[0.01]]\ndt = 1.0\n"
    document = json.loads(run("evaluate", write(plant=PLANT + actual), "--json", "--steps", "20000").out)
    assert document["cost_bound"] is None
    assert document["cost_all_time"] is None
    assert "no guarantee holds" in document["notes"][0]


def test_options_without_effect_are_noted_where_they_are_given(run: Run, write: Write) -> None:
    """Of an exact answer; scripts that always give a seed continue."""
    path = write(policy=PERIODIC)
    done = run("evaluate", path, "--seed", "0", "--steps", "20000", "--precision", "float32", "--json")
    assert (done.code, done.err) == (0, "")
    assert json.loads(done.out)["notes"] == [
        "steps = 20000 and precision = float32 had no effect: no loop was simulated"
    ]
    unused = "note: --seed 0 had no effect: nothing was drawn\n"
    for command in (["evaluate", path], ["tradeoff", path, "--over", "every=2,3"], ["tune", path, "--rate", "0.5"]):
        assert run(*command, "--seed", "0").out.endswith(unused)
    assert "no effect" not in run("evaluate", path).out
    assert "no effect" not in run("evaluate", "two-mass-lqg", "--steps", "20000", "--seed", "1").out
