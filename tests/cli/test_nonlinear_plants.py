"""Plants that are not linear, from the command line: what is shown of them, and what is refused in a sentence."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from conftest import Run, Write

PLANT = "[plant]\nA = [[1.2]]\nB = [[1.0]]\nW = [[{W}]]\ndt = 1.0\nfunction = '{named}'\n"
BENT = "import numpy as np\n\ndef step(x, u, w):\n    return {value}\n"
SINE = "1.2 * np.sin(x) + u + w"


def plant(folder: Path, value: str = SINE, W: float = 0.01, named: str = "bent.py:step", text: str = BENT) -> str:
    """Write the file of a function next to the problem's, and return the [plant] table that names it."""
    (folder / "bent.py").write_text(text.format(value=value), encoding="utf-8")
    return PLANT.format(W=W, named=named)


def test_no_guarantee_is_claimed_and_what_the_linearisation_promises_stands_beside(
    run: Run, write: Write, tmp_path: Path
) -> None:
    """In JSON and for people: the measured cost, no bound, and the linear theory under its own name."""
    path = write(plant(tmp_path))
    done = run("evaluate", path, "--json", "--steps", "100000")
    document = json.loads(done.out)
    assert (done.code, document["cost_bound"], document["cost_all_time"]) == (0, None, None)
    assert document["cost_bound_at_rate"] is None
    promised = document["linearisation"]
    assert set(promised) == {"cost_all_time", "cost_bound"}
    assert promised["cost_bound"] == pytest.approx(1.5 * promised["cost_all_time"])
    assert document["cost"]["method"] == "simulation"
    assert document["notes"] == ["the plant is not linear (A and B are its linearisation): no guarantee holds"]
    shown = run("evaluate", path, "--steps", "100000").unwrapped
    assert "no guarantee holds: the plant is not" in shown
    assert not any(line.startswith("guarantee") for line in shown.splitlines())
    (line,) = [line for line in shown.splitlines() if line.startswith("linearisation")]
    assert line.endswith("none of this is guaranteed for the nonlinear plant")


def test_the_plant_that_is_simulated_may_be_the_one_that_is_not_linear(run: Run, write: Write, tmp_path: Path) -> None:
    """A design on [plant] with a function in [plant.actual], its path counted from the problem file all the same."""
    table = plant(tmp_path).replace("[plant]", "[plant.actual]")
    linear = "[plant]\nA = [[1.25]]\nB = [[1.0]]\nW = [[0.01]]\ndt = 1.0\n"
    document = json.loads(run("evaluate", write(linear + table), "--json", "--steps", "100000").out)
    assert [note.split(":")[0] for note in document["notes"]] == [
        "the plant is not linear (A and B are its linearisation)",
        "the plant is not the one of the design",
    ]
    assert "linearisation" not in document  # the design's is another plant


@pytest.mark.parametrize(
    ("text", "named", "sentence"),
    [
        (BENT, "none.py:step", "/none.py', which cannot be read (No such file or directory); expected a Python file, "),
        (BENT, "bent.py:stop", "/bent.py' has no 'stop'; expected a function x, u, w → x⁺ of that name (it has step)"),
        (BENT, "bent.py:a b", "; expected 'file.py:name', a Python file and a function in it"),
        (BENT, "bent.py:np", "/bent.py' has 'np', which is <module 'numpy' from "),
        (
            "def step(x, u, w)\n",
            "bent.py:step",
            "/bent.py' has a syntax error in line 1 (expected ':'); expected a file that defines",
        ),
        (
            "import nothing_at_all\n",
            "bent.py:step",
            "/bent.py' fails when it is executed (ModuleNotFoundError: No module ",
        ),
        (
            "raise SystemExit(3)\n",
            "bent.py:step",
            "/bent.py' fails when it is executed (SystemExit: 3); expected a file that defines",
        ),
    ],
)
def test_a_file_without_the_function_is_told_in_a_sentence(
    run: Run, write: Write, tmp_path: Path, text: str, named: str, sentence: str
) -> None:
    """Which file, what is wrong with it, and what was expected."""
    path = write(plant(tmp_path, named=named, text=text.replace("{value}", SINE)))
    told = run("evaluate", path).sentence
    assert told.startswith(f"{path}: plant.function")
    assert sentence in told


def test_a_file_that_is_no_text_is_told(run: Run, write: Write, tmp_path: Path) -> None:
    """Before anything of it is run."""
    path = write(plant(tmp_path))
    (tmp_path / "bent.py").write_bytes(bytes(range(256)))
    assert "it is not UTF-8 text" in run("evaluate", path).sentence


@pytest.mark.parametrize(
    ("value", "sentence"),
    [
        ("x / 0.0", "function returns nan as state 1 at x = 0, u = 0, w = 0; expected finite numbers"),
        (
            "x + 1.0",
            "the function returns 1 as state 1 at x = 0, u = 0, w = 0; expected 0, because A and B are",
        ),
        (
            "1.3 * x + u + w",
            "the matrix A has 1.2 in row 1, column 1, but the derivative of the function with respect to x at 0",
        ),
        (
            "np.zeros(2)",
            "the function returns an array of the shape (2,); expected (1,), the shape of the next state",
        ),
        (
            "nonsense",
            "function fails at the point x = [0.0], u = [0.0], w = [0.0] (NameError: name 'nonsense' is not defined)",
        ),
    ],
)
def test_a_function_that_is_not_the_plants_is_told_when_the_file_is_read(
    run: Run, write: Write, tmp_path: Path, value: str, sentence: str
) -> None:
    """Without a run."""
    path = write(plant(tmp_path, value))
    assert run("evaluate", path).sentence.startswith(f"{path}: {sentence}")


@pytest.mark.parametrize("command", [("evaluate", "--steps", "100000"), ("network", "--steps", "400")])
def test_a_function_that_gives_no_number_where_the_loop_goes_is_told_with_the_state(
    run: Run, write: Write, tmp_path: Path, command: tuple[str, ...]
) -> None:
    """A root of what is negative from 1 on; it is not told as a loop that diverges alone."""
    path = write(plant(tmp_path, "1.2 * x * np.sqrt(1.0 - x * x) + u + w", W=0.1))
    told = run(command[0], path, *command[1:]).sentence
    assert "function returns no finite number as state 1" in told
    state = abs(float(told.split("x = [")[1].split("]")[0]))
    assert state > 1.0


def test_a_function_that_decides_by_its_numbers_is_told_how_to_say_it(run: Run, write: Write, tmp_path: Path) -> None:
    """It is called once, for all paths and steps: no number is known then."""
    path = write(plant(tmp_path, "1.2 * x + u + w if x[0] < 1e9 else x"))
    told = run("evaluate", path, "--steps", "100000").sentence
    assert "np.where" in told


@pytest.mark.evidence
def test_what_the_theory_of_linear_plants_serves_is_refused(run: Run, write: Write, tmp_path: Path) -> None:
    """Certificates, exact methods and lower bounds; cost against rate stands without the periodic curve."""
    path = write(plant(tmp_path), policy='[policy]\nkind = "excess"\ndelta = 0.1\nactuation = "model"\n')
    assert run("certify", path).sentence.startswith("the plant is not linear, which certificates do not support")
    assert "the plant is not linear" in run("evaluate", path, "--method", "exact").sentence
    assert "the plant is not linear" in run("evaluate", path, "--confidence", "0.99").sentence
    done = run("tradeoff", path, "--over", "delta=0.1,0.2", "--json", "--standard-error", "1e-3")
    document = json.loads(done.out)
    assert (document["periodic"], document["guarantee"]) == ({}, None)
    assert [point["cost_periodic_same_rate"] for point in document["points"]] == [None, None]


@pytest.mark.evidence
def test_a_policy_is_tuned_and_compared_on_a_plant_that_is_not_linear(run: Run, write: Write, tmp_path: Path) -> None:
    """By simulation alone."""
    path = write(plant(tmp_path, W=0.05))
    tuned = json.loads(run("tune", path, "--rate", "0.7", "--standard-error", "1e-3", "--json").out)
    rate = tuned["rates"]["actuator"]
    assert rate["value"] == pytest.approx(0.7, abs=0.01)
    other = tmp_path / "other.toml"
    other.write_text(Path(path).read_text(encoding="utf-8").replace("theta = 0.5", 'theta = 0.5\nactuation = "model"'))
    ranked = json.loads(run("compare", path, str(other), "--rate", "0.7", "--standard-error", "1e-3", "--json").out)
    assert [one["cost_bound"] for one in ranked["ranking"]] == [None, None]
