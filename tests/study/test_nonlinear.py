"""Studies of plants that are not linear: what is kept under which digest, and what goes to other processes."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taciturn import Plant, Problem, ProblemError, evaluate, load, sweep
from taciturn.study.record import decode, encode, fingerprint
from taciturn_studies.workers import processes

TEXT = "import numpy as np\n\nGAIN = 1.2\n\n\ndef step(x, u, w):\n    return GAIN * np.sin(x) + u + w\n"
TABLES = """
[plant]
function = "bent.py:step"
A = [[1.2]]
B = [[1.0]]
W = [[0.05]]
dt = 1.0
[cost]
Q = [[1.0]]
R = [[2.0]]
[policy]
kind = "lqg"
theta = 0.5
"""


def problem(folder: Path, text: str = TEXT) -> Problem:
    """Return the problem of a file in a folder, with the file of its function."""
    folder.mkdir(exist_ok=True)
    (folder / "bent.py").write_text(text, encoding="utf-8")
    (folder / "bent.toml").write_text(TABLES, encoding="utf-8")
    return load(folder / "bent.toml")


def test_a_digest_is_that_of_what_the_function_computes(tmp_path: Path) -> None:
    """Wherever its file is and however it is written; a number in it, or in its scope, makes another."""
    first = fingerprint(problem(tmp_path / "one"))
    assert fingerprint(problem(tmp_path / "two", TEXT.replace("GAIN", "SLOPE"))) == first
    other = TEXT.replace("np.sin(x)", "np.tanh(x)")
    assert fingerprint(problem(tmp_path / "three", other)) != first
    close_by = TEXT.replace("1.2", "1.2000000001")
    assert fingerprint(problem(tmp_path / "four", close_by)) != first
    linear = replace(problem(tmp_path / "one"), plant=Plant([[1.2]], [[1.0]], [[0.05]], dt=1.0))
    assert fingerprint(linear) != first


def test_what_a_function_prints_is_not_the_answer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A document on standard output stays one."""
    problem(tmp_path, TEXT.replace("    return", "    print('here')\n    return"))
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "here" in printed.err


def test_the_linearisation_is_that_of_the_design(tmp_path: Path) -> None:
    """Where another plant is simulated, which is a function, nothing is promised of it."""
    bent = problem(tmp_path)
    linear = replace(bent, plant=Plant([[1.2]], [[1.0]], [[0.05]], dt=1.0), actual=bent.plant)
    assert evaluate(bent, steps=20_000).linearisation is not None
    assert evaluate(linear, steps=20_000).linearisation is None


def test_the_values_that_a_function_of_python_closes_over_are_in_its_digest(tmp_path: Path) -> None:
    """Two functions of one text are two."""
    base = problem(tmp_path)

    def bent(third: float) -> Any:
        return lambda x, u, w: 1.2 * x + third * x * x * x + u + w

    plants = [Plant([[1.2]], [[1.0]], [[0.05]], function=bent(third)) for third in (0.1, 0.2, 0.1)]
    digests = [fingerprint(replace(base, plant=plant)) for plant in plants]
    assert digests[0] != digests[1]
    assert digests[0] == digests[2]


def test_a_sweep_is_kept_and_found_until_the_function_is_another(tmp_path: Path) -> None:
    """A second run computes nothing; after a change in the function's file all of it."""
    store, grid = tmp_path / "store", {"theta": [0.1, 0.5]}
    found = sweep(problem(tmp_path / "one"), grid, store=store, standard_error=0.01)
    kept = sorted((store / "cells").glob("*/*"))
    times = [path.stat().st_mtime_ns for path in kept]
    again = sweep(problem(tmp_path / "two"), grid, store=store, standard_error=0.01)
    assert again.identical(found)
    assert [path.stat().st_mtime_ns for path in kept] == times
    with pytest.warns(UserWarning, match="filled by another problem"):
        other = sweep(problem(tmp_path / "one", TEXT.replace("np.sin(x)", "np.tanh(x)")), grid, store=store,
                      standard_error=0.01)  # fmt: skip
    assert not np.array_equal(other.cost, found.cost)
    assert len(sorted((store / "cells").glob("*/*"))) == 2 * len(kept)


def test_an_evaluation_with_what_its_linearisation_promises_is_kept_whole(tmp_path: Path) -> None:
    """As text that gives the same again."""
    found = evaluate(problem(tmp_path), steps=100_000)
    assert found.linearisation is not None
    assert decode(encode(found)) == found


@pytest.mark.evidence
def test_a_problem_goes_to_other_processes_without_its_files(tmp_path: Path) -> None:
    """With the text of its function, so that keys outside [policy] can be changed there as well."""
    stated = problem(tmp_path)
    (tmp_path / "bent.py").unlink()
    (tmp_path / "bent.toml").unlink()
    there = pickle.loads(pickle.dumps(stated))
    moved = there.changed({"cost.R": [[1.0]], "plant.W": [[0.1]]})
    assert moved.plant.function([0.5], [0.0], [0.0]) == stated.plant.function([0.5], [0.0], [0.0])
    grid: dict[str, list[object]] = {"theta": [0.1, 0.5], "cost.R": [[[1.0]], [[3.0]]]}
    with processes(2) as pool:
        apart = sweep(stated, grid, executor=pool, standard_error=0.02)
    assert apart.identical(sweep(stated, grid, standard_error=0.02))


def test_a_problem_becomes_its_linearisation_without_its_function() -> None:
    """As any key is removed; with its guarantee then."""
    linear = load("omni-heading").changed({"plant.function": None})
    assert (load("omni-heading").nonlinear, linear.nonlinear) == (True, False)
    found = evaluate(linear, steps=100_000)
    assert found.linearisation is None
    assert found.cost_bound is not None


@pytest.mark.evidence
def test_a_lambda_is_refused_by_other_processes_in_a_sentence(tmp_path: Path) -> None:
    """And runs here."""
    plant = Plant([[1.2]], [[1.0]], [[0.05]], function=lambda x, u, w: 1.2 * np.sin(x) + u + w)
    stated = replace(problem(tmp_path), plant=plant)
    grid: dict[str, list[object]] = {"theta": [0.1, 0.5]}
    assert (sweep(stated, grid, standard_error=0.05).refusal == "").all()
    with (
        processes(2) as pool,
        pytest.raises(ProblemError, match=r"^function is <function .*other processes cannot import"),
    ):
        sweep(stated, grid, executor=pool, standard_error=0.05)
