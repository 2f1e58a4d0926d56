"""``taciturn tune`` and ``taciturn compare`` as a user runs them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli.conftest import Once, Run
from counts import few

import taciturn

MASSES = Path(taciturn.__file__).parent / "problems" / "two-mass-lqg.toml"


def with_policy(folder: Path, name: str, policy: str) -> str:
    """Write the two masses with another policy; return the file."""
    text = MASSES.read_text(encoding="utf-8")
    path = folder / f"{name}.toml"
    path.write_text(text[: text.index("[policy]")] + f"[policy]\n{policy}\n", encoding="utf-8")
    return str(path)


@pytest.mark.evidence
def test_tune_prints_the_parameter_and_the_answer(run: Run) -> None:
    """The parameter that meets the budget, then what evaluate prints, then the parameter with its error."""
    answer = run("tune", "two-mass-lqg", "--rate", "0.3", "--standard-error", "1e-3")
    assert answer.code == 0
    lines = answer.out.splitlines()
    assert lines[0].startswith("theta = 1.1")
    assert ": rate at most 0.3 per step, met with " in lines[0]
    assert " of the packets, " in lines[1]
    (error,) = [line for line in lines if line.startswith("theta          1.1")]
    assert " ± " in error
    assert any(line.startswith("this policy") and (" 0.3" in line or " 0.29" in line) for line in lines)


def test_tune_writes_the_tuned_problem(run: Run, tmp_path: Path) -> None:
    """A new file, whose evaluation is the answer; it is not overwritten, and its name ends as those of such files."""
    out = tmp_path / "tuned.toml"
    arguments = ["tune", with_policy(tmp_path, "clock", 'kind = "periodic"\nevery = 2'), "--rate", "0.3", "--out"]
    assert f"written: {out}" in run(*arguments, str(out)).unwrapped
    assert out.read_text(encoding="utf-8").startswith("# Written by taciturn tune, from ")
    written = taciturn.load(out)
    assert written.parameters["every"] == [4, 3]
    assert taciturn.evaluate(written).rates["actuator"].value == 2 / 7
    assert "already exists; expected the name of a new file" in run(*arguments, str(out)).sentence
    assert run(*arguments, str(tmp_path / "tuned.svg")).code == 2


def test_budgets_in_percent_are_of_sending_always(run: Run, tmp_path: Path) -> None:
    """A quarter of the steps; at most 12.5 % more."""
    file = with_policy(tmp_path, "clock", 'kind = "periodic"\nevery = 2')
    by_rate = json.loads(run("tune", file, "--rate", "25%", "--json").out)
    assert (by_rate["parameter"]["value"], by_rate["rates"]["actuator"]["value"]) == (4, 0.25)
    by_cost = json.loads(run("tune", file, "--cost", "+12.5%", "--json").out)
    costs = by_cost["cost"]["value"], by_cost["beyond"]["cost"]
    assert costs[0] <= 1.125 * by_cost["cost_all_time"] < costs[1]


def test_python_prints_what_the_commands_print(run: Run, tmp_path: Path) -> None:
    """Of an evaluation, and of the parameter that meets a budget, here within a jump; a repr still has all of it."""
    file = with_policy(tmp_path, "clock", 'kind = "periodic"\nevery = 2')
    problem = taciturn.load(file)
    found, tuned = taciturn.evaluate(problem), taciturn.tune(problem, rate=0.3)
    assert f"{found}\n" == run("evaluate", file).out
    assert f"{tuned}\n" == run("tune", file, "--rate", "0.3").out
    assert "beyond " in str(tuned)
    assert repr(found).startswith("Evaluation(policy='periodic', cost=0.7684")


@pytest.mark.parametrize("policy", ['kind = "periodic"\nevery = 1', 'kind = "all-time"'])
def test_a_policy_that_sends_every_sample_is_not_compared_with_itself(run: Run, tmp_path: Path, policy: str) -> None:
    """One row, and no percentage but that of the packets."""
    text = run("evaluate", with_policy(tmp_path, "clock", policy)).out
    assert text.startswith("100 % of the packets: this policy sends every sample, at a cost of 0.733478 per")
    assert text.count("0.733478") == 2
    assert text.count("%") == 1
    assert "periodic       the same as this policy, which sends every sample" in text


def test_tune_prints_one_document(run: Run, tmp_path: Path) -> None:
    """Exact numbers, and the other side of the jump."""
    answer = run("tune", with_policy(tmp_path, "clock", 'kind = "periodic"\nevery = 2'), "--rate", "0.3", "--json")
    assert answer.code == 0
    document = json.loads(answer.out)
    assert document["parameter"] == {"name": "every", "value": [4, 3], "standard_error": 0.0}
    assert document["beyond"]["value"] == [4, 3, 3, 3]
    assert document["rates"]["actuator"]["value"] == 2 / 7
    told = run("tune", with_policy(tmp_path, "clock", 'kind = "periodic"\nevery = 2'), "--rate", "0.3")
    assert "the rate jumps across the budget; on the other side: every = [4, 3, 3, 3]" in told.unwrapped


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        pytest.param(["--rate", "0.05"], "the rate ranges from 0.20", marks=pytest.mark.evidence),
        (["--cost", "0.1"], "expected at least 0.733"),
        ([], "expected exactly one budget"),
        (["--rate", "0.3", "--cost", "1"], "expected exactly one budget"),
        (["--violation", "1e-3"], "violation is given for a problem without state limits; expected state limits"),
        (["--rate", "nan"], "rate is nan"),
        (["--rate", "0"], "rate is 0"),
        (["--rate", "x"], "--rate is 'x'; expected a number, or"),
        (
            ["--rate", "+5%"],
            "--rate is '+5%'; expected a number, or a percentage such as 50% of the rate of",
        ),
        (
            ["--cost", "+5"],
            "--cost is '+5', a number with a sign; expected 5 for a cost of this size, or a percentage such as +5%",
        ),
        (["--traffic", "+.5"], "--traffic is '+.5', a number with a sign; expected .5 for a traffic of this size"),
        (["--cost", "5%"], "--cost is '5%'; expected a number, or a percentage such as +5%"),
        (["--rate", "5%", "--least-period", "0.1"], "expected --rate with a number, and no --cost"),
        (["--rate", "0.3", "--link", "radio"], "link is 'radio'"),
        (["--rate", "0.3", "--standard-error", "-1"], "--standard-error is -1"),
        (["--rate", "0.3", "--least-period", "0.1"], "lqg has no period to tune here"),
        (
            ["--cost", "1", "--least-period", "0.1"],
            "--least-period is given without a number for --rate, or with another budget; expected --rate with",
        ),
    ],
)
def test_a_budget_that_cannot_be_is_one_sentence(run: Run, arguments: list[str], words: str) -> None:
    """Exit code 2, nothing else printed."""
    answer = run("tune", "two-mass-lqg", *arguments)
    assert answer.code == 2
    assert answer.out == ""
    assert words in answer.sentence


@pytest.mark.evidence
def test_compare_ranks_and_draws(run: Run, once: Once, tmp_path: Path) -> None:
    """Names are those of the files; a policy that shares its time says so; the picture is written."""
    once("taciturn.compare")
    weight = [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    files = [
        "two-mass-lqg",
        with_policy(tmp_path, "clock", 'kind = "periodic"\nevery = 2'),
        with_policy(tmp_path, "drawn", f'kind = "stochastic"\nactuation = "model"\nweight = {weight}'),
    ]
    picture = tmp_path / "ranking.svg"
    answer = run("compare", *files, "--rate", "0.3", "--standard-error", "2e-3", "--plot", str(picture))
    assert answer.code == 0
    verdict, table, _ = answer.out.split("\n\n", 2)
    names = [line.split()[0] for line in table.splitlines() if line[0] != " "]
    assert names == ["drawn", "two-mass-lqg", "clock"]
    told = " ".join(verdict.split())
    assert told.startswith("drawn costs least at 0.3 sends per step: ")
    assert told.count("than every sample") == 3
    assert told.index("two-mass-lqg: ") < told.index("; clock: ")
    assert "clock: the first value in 35.0 % of the time, else the second" in answer.unwrapped
    assert picture.read_text(encoding="utf-8").startswith("<?xml")
    document = json.loads(run("compare", *files, "--rate", "0.3", "--standard-error", "2e-3", "--json").out)
    assert [place["name"] for place in document["ranking"]] == names
    assert document["ranking"][1]["above_best"]["standard_error"] > 0


@pytest.mark.parametrize(
    ("files", "words"),
    [
        (["two-mass-lqg"], "the number of policies is 1; expected at least two policies to compare, in problems"),
        (["two-mass-lqg", "two-mass-lqg"], "the problems two-mass-lqg (1) and two-mass-lqg (2) have the same policy"),
        (["two-mass-lqg", "rover"], "two-mass-lqg and rover differ in [plant]"),
        (["two-mass-lqg", "nowhere"], "there is no file 'nowhere'"),
    ],
)
def test_a_comparison_that_cannot_be_is_one_sentence(run: Run, files: list[str], words: str) -> None:
    """Exit code 2, nothing else printed."""
    answer = run("compare", *files, "--rate", "0.3")
    assert answer.code == 2
    assert answer.out == ""
    assert words in answer.sentence


@pytest.mark.evidence
def test_tune_seeks_the_period_of_the_looks(run: Run, once: Once, tmp_path: Path) -> None:
    """A table of what was tried, then the best; the document has all of it."""
    once("taciturn_studies.tune.tune_period")
    path = tmp_path / "walk.toml"
    path.write_text(
        "[plant]\nA = [[0.0]]\nB = [[1.0]]\nW = [[1.0]]\n[cost]\nQ = [[1.0]]\nR = [[1.0]]\n"
        '[policy]\nkind = "consistent"\nperiod = 0.5\n',
        encoding="utf-8",
    )
    answer = run("tune", str(path), "--rate", "1", "--least-period", "0.1", "--json")
    assert answer.code == 0
    document = json.loads(answer.out)
    assert document["period"] == min(row["period"] for row in document["periods"])
    assert document["rates"]["sensor"]["value"] == pytest.approx(1, rel=1e-8)
    assert document["consistency"] == "verified"
    told = run("tune", str(path), "--rate", "1", "--least-period", "0.1")
    lines = told.out.splitlines()
    assert lines[0].startswith(f"period = {document['period']:g} s, delta = ")
    assert ["period", "delta", "cost", "consistent"] in [line.split() for line in lines]
    assert f"period         {document['period']:g}" in lines


@pytest.mark.evidence
@pytest.mark.parametrize("rate", few(["0.203", "0.2033"], 1))
def test_a_budget_at_the_end_of_what_can_be_reached_ends_in_a_sentence(run: Run, rate: str) -> None:
    """A digit of the parameter decides on which side of the budget its limit is: an answer, and no traceback."""
    answer = run("tune", "two-mass-lqg", "--rate", rate, "--standard-error", "1e-3")
    assert answer.code in (0, 2)
    assert "Traceback" not in answer.err
    assert answer.err.count("\n") == (answer.code == 2)
