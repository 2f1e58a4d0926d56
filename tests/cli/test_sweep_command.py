"""``taciturn sweep``: what it says of its store, of results that were there, and of cells that were not precise."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
import xarray
from cli.conftest import Run, Write

from taciturn.cli import frame
from taciturn.cli.frame import left_text, progress_bar
from taciturn.simulation import sampling
from taciturn_sweep.sweep import SweepTable

EFFORT = ("--steps", "20000", "--workers", "1")


@pytest.mark.evidence
def test_a_result_of_another_grid_is_kept_under_a_name_of_its_own(run: Run, write: Write, tmp_path: Path) -> None:
    """And said; the same grid again, whose result is the same, leaves nothing next to it."""
    store = str(tmp_path / "s")

    def swept(values: str, *effort: str) -> tuple[str, list[Path]]:
        answer = run("sweep", write(), "--over", f"theta={values}", "--store", store, *(effort or EFFORT))
        assert answer.code == 0
        return answer.err, sorted((tmp_path / "s").glob("result-*.nc"))

    assert swept("0.1,1,3") == ("", [])
    large = (tmp_path / "s" / "result.nc").read_bytes()
    told, aside = swept("0.1,1")
    assert [path.read_bytes() for path in aside] == [large]
    assert told.endswith(
        f"taciturn: {store}/result.nc contained another result, which was renamed to {aside[0].name}\n"
    )
    assert xarray.load_dataset(tmp_path / "s" / "result.nc", engine="h5netcdf").sizes == {"theta": 2}
    told, again = swept("0.1,1")
    assert again == aside
    assert told.startswith(f"taciturn: 2 of 2 cells: read from {store}; 1 other answers in it are for other values")
    assert told.count("\n") == 1


@pytest.mark.evidence
def test_cells_that_are_not_precise_are_named(
    run: Run, write: Write, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The first three, with what they reached and how many steps there were."""
    monkeypatch.setattr(sampling, "MOST_OPERATIONS", 20_000)

    def sentence(values: str) -> str:
        grid = ("--over", f"theta={values}", "--over", "actuation=hold", "--standard-error", "1e-9")
        answer = run("sweep", write(), *grid, "--store", str(tmp_path / values), "--workers", "1")
        assert (answer.code, answer.err.count("\n")) == (2, 1)
        return answer.err

    told = sentence("0.1,1,2,3,4")
    assert "the standard error was not reached in 5 of 5 cells within 2e-05 billion steps each: theta=0.1" in told
    assert told.count("actuation=hold (standard error ") == 3
    assert told.endswith("; and 2 more; give a larger --standard-error\n")
    assert "theta=3" not in told
    assert "more:" not in sentence("0.1,1,2")


def test_a_summary_fits_80_columns() -> None:
    """With long values, which other grids have too."""
    cells = {name: (("theta", "cost.R"), [[value]]) for name, value in (("cost", 0.7405479), ("cost_error", 0.0))}
    cells |= {"cost_standard_error": (("theta", "cost.R"), [[5.6e-6]]), "refusal": (("theta", "cost.R"), [[""]])}
    cells |= {"cost_method": (("theta", "cost.R"), [["simulation"]])}
    cells |= {"rate_actuator": (("theta", "cost.R"), [[0.272]], {"units": "sends per step"})}
    found = xarray.Dataset(cells, {"theta": [0.05], "cost.R": ["[[0.1, 0.0], [0.0, 0.1]]"]})
    lines = str(SweepTable(found)).splitlines()
    assert max(map(len, lines)) <= 80
    told = SweepTable(found).verdict
    assert told[0].startswith("least cost 0.7405479 ± 0.0000056 at theta = 0.05, cost.R = [[0.1, 0.0], [0.0, 0.1]]")
    assert told[1] == "1 cell over theta (1) × cost.R (1): 1 evaluated, 0 refused"
    assert lines[-1].endswith("[[0.1, 0.0], [0.0, 0.1]]  0.7405479 ± 0.0000056")


def test_the_bar_counts_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that are done, of how many."""
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    with progress_bar("sweeping", 40) as progress:
        progress(23.5 / 40)
    assert "sweeping 23/40 cells" in terminal.getvalue()


def test_the_bar_tells_how_long_the_rest_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    """As long in proportion as what is done has taken; not in the first seconds, which say nothing yet."""
    assert [left_text(*one) for one in ((1.0, 0.5), (30.0, 0.0))] == ["", ""]
    assert left_text(30.0, 0.75) == "about 10 s left"
    assert left_text(60.0, 0.2) == "about 4 min left"
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setattr(frame, "SOON", 0.0)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    with progress_bar("computing") as progress:
        progress(0.5)
    assert "about 1 s left" in terminal.getvalue()
