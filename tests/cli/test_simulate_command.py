"""``taciturn simulate``, and ``--set``: a path of the loop, and a problem with keys changed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd
import pytest

import taciturn

if TYPE_CHECKING:
    from conftest import Run


@pytest.mark.evidence
def test_a_path_is_the_one_that_python_simulates(run: Run, tmp_path: Path) -> None:
    """As JSON, as a table, as a picture, and on the terminal within 80 columns."""
    table, picture = tmp_path / "path.csv", tmp_path / "path.svg"
    problem = taciturn.load("two-mass-lqg").changed({"theta": 0.5})
    path = taciturn.simulate(problem.close(problem.design()), 40, seed=3)
    common = ("simulate", "two-mass-lqg", "--set", "theta=0.5", "--steps", "40", "--seed", "3")
    found = json.loads(run(*common, "--json").out)
    assert (found["policy"], found["ticks"], found["unit"]) == ("lqg", 40, "s")
    assert found["state"] == path.state.tolist()
    assert found["sends"] == {"actuator": path.sends["actuator"].tolist()}
    shown = run(*common, "--table", str(table), "--plot", str(picture))
    assert shown.err == ""
    assert max(map(len, shown.out.split("table:")[0].splitlines())) <= 80
    assert shown.out.startswith(f"{path.sends['actuator'].sum()} packets in 40 steps (4 s), ")
    assert "-0" not in shown.out.split()
    assert shown.out.count("sent\n") == path.sends["actuator"][list({*range(20), *range(30, 40)})].sum()
    assert pd.read_csv(table)["x1"].to_numpy() == pytest.approx(path.state[:, 0])
    assert "<svg" in picture.read_text()


@pytest.mark.evidence
def test_another_control_is_simulated_versus_a_policy(run: Run, tmp_path: Path) -> None:
    """Periodic control, or that of a file, on the same noise, in a figure of a style."""
    picture = tmp_path / "both.pdf"
    common = ("simulate", "two-mass-lqg", "--steps", "40", "--seed", "3")
    found = json.loads(run(*common, "--versus", "periodic", "--json").out)
    other = json.loads(run(*common, "--versus", "two-mass", "--json").out)
    assert found["state"] == other["state"] == json.loads(run(*common, "--json").out)["state"]
    assert found["versus"]["name"] == "periodic control (optimal gains)"
    assert other["versus"]["name"] == "event-triggered control (excess)"
    assert sum(found["versus"]["sends"]["actuator"]) == sum(found["sends"]["actuator"])
    shown = run(*common, "--versus", "periodic", "--plot", str(picture), "--style", "paper")
    assert "periodic control (optimal gains) with the same noise: " in " ".join(shown.out.split())
    assert picture.read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--style", "dark"), "--style is given without --plot; expected both options: add --plot OUT"),
        (("--plot", "x.svg", "--style", "papr"), "--style is 'papr'; expected 'light' or 'dark' for a screen, or"),
        (("--versus", "periodical"), "there is no file 'periodical'; expected a problem file"),
    ],
)
def test_a_wrong_style_or_control_is_one_sentence(run: Run, arguments: tuple[str, ...], sentence: str) -> None:
    """Before anything is simulated."""
    told = run("simulate", "two-mass-lqg", *arguments)
    assert told.code == 2
    assert sentence in told.err
    assert len(told.err.splitlines()) == 1


def test_keys_are_changed_without_a_file(run: Run) -> None:
    """As ``Problem.changed`` does; ``none`` removes a parameter that another kind does not have."""
    periodic = ("--set", "kind=periodic", "--set", "theta=none", "--set", "every=[4,3]")
    found = json.loads(run("evaluate", "two-mass-lqg", *periodic, "--json").out)
    problem = taciturn.load("two-mass-lqg").changed({"kind": "periodic", "theta": None, "every": [4, 3]})
    assert found["cost"]["value"] == taciturn.evaluate(problem).cost.value
    assert json.loads(run("show", "two-mass-lqg", "--set", "cost.R=[[2]]", "--json").out)["cost"]["R"] == [[2.0]]
    assert run("tune", "two-mass-lqg", *periodic, "--rate", "0.5").out.startswith("every = 2: ")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--set", "theta"), "--set 'theta' is malformed; expected NAME=VALUE, such as theta=0.1"),
        (("--set", "theta=1,2"), "--set theta has 2 values; expected one value: write a list as [v1,v2]"),
        (("--set", "theta=1", "--set", "policy.theta=2"), "--set policy.theta is given twice; expected it only once"),
        (("--set", "plant.A=[[nan]]"), "nan"),
        (("--set", "network.actuator_burst={to_bad=2}"), "network.actuator_burst"),
        (("--set", "thta=1"), "policy.thta is not a parameter of the policy kind lqg"),
        (("--set", "kind=optimal", "--set", "theta=none", "--set", "price=1"), "optimal"),
        (("--steps", f"1{14 * '0'}"), f"--steps is 1{14 * '0'}, and a record of so many steps needs 1.2e+07 GB, more"),
        (
            ("--steps", f"1{19 * '0'}"),
            "more than the memory of this machine; expected fewer steps, or an evaluation",
        ),
        (("--steps", "0"), "steps is 0; expected a whole number of at least 1"),
        (("--table", "nowhere/path.csv"), "the folder of the table 'nowhere/path.csv' does not exist"),
    ],
)
def test_what_cannot_be_simulated_is_refused(run: Run, arguments: tuple[str, ...], sentence: str) -> None:
    """In one sentence."""
    refused = run("simulate", "two-mass-lqg", *arguments)
    assert refused.code == 2
    assert sentence in refused.err
    assert refused.err.count("\n") == 1
