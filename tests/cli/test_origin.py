"""Every document and every file says what it was computed from: version, seed, method and digest of the problem."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest
import xarray
from cli.conftest import Run, Write

import taciturn
from taciturn._figure import Panel, Series, draw, save
from taciturn.study.record import fingerprint, origin

SIMULATED = ("--standard-error", "0.1")


@pytest.mark.parametrize(
    ("command", "options", "keys"),
    [
        ("show", (), ()),
        ("certify", (), ("method",)),
        ("evaluate", ("--seed", "3", *SIMULATED), ("seed", "method")),
        ("simulate", ("--seed", "3", "--steps", "5"), ("seed", "method")),
        ("tradeoff", ("--seed", "3", "--over", "theta=0.5", *SIMULATED), ("seed", "method")),
        ("tune", ("--seed", "3", "--rate", "0.7", *SIMULATED), ("seed", "method")),
        ("compare", ("--seed", "3", "--rate", "0.7", *SIMULATED), ("seed", "method")),
        (
            "channel",
            ("--seed", "3", "--copies", "2", "--capacity", "1", "--scheduler", "tdma", "--steps", "100"),
            ("seed", "method"),
        ),
    ],
)
def test_a_document_says_what_it_was_computed_from(
    run: Run, write: Write, command: str, options: tuple[str, ...], keys: tuple[str, ...]
) -> None:
    """The digest is that of the problem that was solved; a seed only where numbers are drawn."""
    file = write()
    other = Path(file).with_name("other.toml")
    other.write_text(Path(file).read_text(encoding="utf-8").replace('"lqg"', '"excess"'), encoding="utf-8")
    files = (file, str(other)) if command == "compare" else (file,)
    found = json.loads(run(command, *files, *options, "--json").out)
    told = {name: found[name] for name in ("version", "seed", "method", "problem_digest") if name in found}
    assert set(told) == {"version", "problem_digest", *keys}
    assert told["version"] == taciturn.__version__
    assert told.get("seed", 3) == 3
    problems = [taciturn.load(one) for one in files]
    if command == "tune":
        problems = [problems[0].changed({found["parameter"]["name"]: found["parameter"]["value"]})]
    digests = told["problem_digest"]
    assert set(digests.values() if isinstance(digests, dict) else [digests]) == set(map(fingerprint, problems))


def test_equal_problems_have_one_digest_and_others_another() -> None:
    """A key that is changed and changed back; a file and Python."""
    problem = taciturn.load("two-mass")
    other = problem.changed({"cost.R": [[2.0]]})
    assert fingerprint(problem) != fingerprint(other)
    assert fingerprint(problem) == fingerprint(other.changed({"cost.R": problem.cost.R.tolist()}))
    assert set(origin(problem)) == {"version", "problem_digest"}
    assert set(origin()) == {"version"}


@pytest.mark.parametrize("ending", ["png", "pdf"])
def test_pictures_of_every_format_hold_their_origin(tmp_path: Path, ending: str) -> None:
    """In the metadata that the format has."""
    picture = tmp_path / f"line.{ending}"
    save(draw([Panel([Series([0.0, 1.0], [1.0, 2.0], "line")])], figsize=(1.0, 1.0)), picture, {"seed": 12345})
    assert b"12345" in picture.read_bytes()


@pytest.mark.evidence
def test_files_say_what_they_were_computed_from(run: Run, write: Write, tmp_path: Path) -> None:
    """A table, a picture, and the data set of a sweep."""
    file, digest = write(), fingerprint(taciturn.load(write()))
    table = tmp_path / "path.parquet"
    assert run("simulate", file, "--steps", "5", "--seed", "3", "--table", str(table)).code == 0
    assert pd.read_parquet(table).attrs == origin(taciturn.load(file), 3, "simulation")
    picture = tmp_path / "path.svg"
    assert run("simulate", file, "--steps", "5", "--seed", "3", "--plot", str(picture)).code == 0
    assert digest in picture.read_text(encoding="utf-8")
    store = tmp_path / "cells"
    assert run("sweep", file, "--over", "theta=0.5", "--seed", "3", "--store", str(store), *SIMULATED).code == 0
    with xarray.open_dataset(store / "result.nc", engine="h5netcdf") as found:
        told = {name: found.attrs[name] for name in ("version", "seed", "method", "problem_digest")}
    assert told == {"version": taciturn.__version__, "seed": "3", "method": "simulation", "problem_digest": digest}
