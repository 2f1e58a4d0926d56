"""Sweeps: the same bits wherever they run, cells that are evaluations, and what cannot be swept."""

from __future__ import annotations

import json
import logging
import multiprocessing
import os
import signal
import subprocess
import sys
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray
from counts import few, scaled

import taciturn
from taciturn import Cost, Plant, Problem, ProblemError, compare, evaluate, load, sweep, tradeoff
from taciturn.model.network import Network
from taciturn.model.result import Field
from taciturn.study.evaluation import Evaluation
from taciturn.study.record import save_whole
from taciturn_sweep.cluster import dask_workers
from taciturn_sweep.sweep import SweepTable

MASSES = load("two-mass-lqg")
GRID: dict[str, list[object]] = {"theta": [0.1, 1.0, 3.0], "actuation": ["hold", "model"]}
EFFORT = 3e-3  # standard error


@pytest.fixture(scope="module")
def whole() -> xarray.Dataset:
    """Return a small sweep, computed here."""
    return sweep(MASSES, GRID, standard_error=EFFORT, seed=3)


def test_a_cell_is_the_evaluation_with_its_seed(whole: xarray.Dataset) -> None:
    """Dimensions are the swept names; each cell is what ``evaluate`` says with the seed that stands there."""
    assert dict(whole.sizes) == {"theta": 3, "actuation": 2}
    assert len(np.unique(whole.seed)) == 6
    for theta in GRID["theta"]:
        for actuation in GRID["actuation"]:
            cell = whole.sel(theta=theta, actuation=actuation)
            changed = MASSES.changed({"theta": theta, "actuation": actuation})
            found = taciturn.evaluate(changed, seed=cell.seed.item(), standard_error=EFFORT)
            assert cell.cost.item() == found.cost.value
            assert cell.cost_standard_error.item() == found.cost.standard_error
            assert cell.rate_actuator.item() == found.rates["actuator"].value
            assert cell.cost_bound.item() == found.cost_bound
            assert cell.cost_method.item() == "simulation"
            assert cell.reached.item() == found.reached
            assert cell.steps.item() == found.steps
    assert whole.cost.units == "cost per step"
    assert whole.rate_actuator.units == "sends per step"
    assert whole.attrs["version"] == taciturn.__version__
    assert whole.attrs["seed"] == "3"
    assert (whole.refusal == "").all()


def test_numbers_are_the_same_however_they_are_written() -> None:
    """1 and 1.0, theta and policy.theta, lists and arrays; what is large fits a file."""
    problem = MASSES
    one = sweep(problem, {"theta": [1], "cost.R": [[[1]]]}, steps=2000)
    other = sweep(problem, {"policy.theta": np.array([1.0]), "cost.R": np.ones((1, 1, 1))}, steps=2000, seed=0)
    assert one.cost.item() == other.cost.item()
    assert one.seed.item() == other.seed.item()
    again = sweep(problem, {"theta": one.theta}, steps=2000, seed=2**70)
    assert again.attrs["seed"] == str(2**70)
    assert len(again.to_netcdf(None, engine="h5netcdf")) > 0


def test_costs_that_count_differently_are_not_in_one_grid() -> None:
    """A finite-horizon run next to an average."""
    with pytest.raises(
        ProblemError, match="the grid mixes results with the units cost in total and cost per step; expected one unit"
    ):
        sweep(load("lossy-double-integrator"), {"cost.horizon": [100, None]}, steps=2000)


@pytest.mark.evidence
def test_a_cell_is_the_same_in_every_grid(whole: xarray.Dataset) -> None:
    """Reversed, and alone; another seed gives other draws."""
    turned = {name: values[::-1] for name, values in GRID.items()}
    back = sweep(MASSES, turned, standard_error=EFFORT, seed=3)
    assert back.sortby("theta").sortby("actuation").identical(whole)
    alone = sweep(MASSES, {"theta": [1.0], "actuation": ["model"]}, standard_error=EFFORT, seed=3)
    xarray.testing.assert_identical(alone, whole.sel(theta=[1.0], actuation=["model"]))
    other = sweep(MASSES, {"theta": [1.0], "actuation": ["model"]}, standard_error=EFFORT, seed=4)
    assert other.cost.item() != alone.cost.item()


@pytest.mark.evidence
def test_threads_and_processes_give_the_same_bits(whole: xarray.Dataset) -> None:
    """Whatever runs a cell."""
    pools: list[Executor] = [ThreadPoolExecutor(3), ProcessPoolExecutor(2, get_context("spawn"))]
    for pool in pools:
        with pool:
            xarray.testing.assert_identical(sweep(MASSES, GRID, executor=pool, standard_error=EFFORT, seed=3), whole)


@pytest.mark.evidence
def test_a_dask_cluster_gives_the_same_bits(whole: xarray.Dataset) -> None:
    """Two worker processes."""
    distributed: Any = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        dask_workers(cluster.scheduler_address) as executor,
    ):
        found = sweep(MASSES, GRID, executor=executor, standard_error=EFFORT, seed=3)
    xarray.testing.assert_identical(found, whole)


SCRIPT = """
import json
import sys
from pathlib import Path

from mpi4py.futures import MPIPoolExecutor

import taciturn
from taciturn.study.record import save_whole

if __name__ == "__main__":
    name, grid, effort, out = sys.argv[1:]
    with MPIPoolExecutor() as executor:
        found = taciturn.sweep(taciturn.load(name), json.loads(grid), executor=executor, seed=3, **json.loads(effort))
    save_whole(found, Path(out))
"""


def by_two_ranks(folder: Path, name: str, grid: dict[str, list[Any]], **effort: float) -> xarray.Dataset:
    """Return a sweep by MPI: one rank hands out, one computes."""
    pytest.importorskip("mpi4py")
    script, out = folder / "swept.py", folder / "mpi.nc"
    script.write_text(SCRIPT)
    launch = [str(Path(sys.executable).parent / "mpiexec"), "-n", "2", sys.executable, "-m", "mpi4py.futures"]
    command = [*launch, str(script), name, json.dumps(grid), json.dumps(effort), str(out)]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert ran.returncode == 0, ran.stderr
    return xarray.load_dataset(out, engine="h5netcdf")


@pytest.mark.evidence
def test_two_ranks_of_mpi_give_the_same_bits(whole: xarray.Dataset, tmp_path: Path) -> None:
    """By the pip package of an MPI."""
    xarray.testing.assert_identical(by_two_ranks(tmp_path, "two-mass-lqg", GRID, standard_error=EFFORT), whole)


def test_what_cannot_be_answered_is_told_and_the_rest_is_there() -> None:
    """A threshold below zero, at the end of an axis or within: a warning, its cells missing, its reason kept."""
    with pytest.warns(UserWarning, match=r"^no answer in 1 of 2 cells, first at theta=-2: the changed problem"):
        assert np.isnan(sweep(MASSES, {"theta": [0.1, -2]}, standard_error=EFFORT).cost.values).tolist() == [
            False,
            True,
        ]
    with pytest.warns(UserWarning, match=r"^no answer in 2 of 6 cells, first at theta=-1, actuation=hold: "):
        found = sweep(MASSES, {**GRID, "theta": [0.1, -1, 3.0]}, standard_error=EFFORT)
    assert ": policy.theta is -1; expected" in found.refusal.sel(theta=-1, actuation="model").item()
    missing = np.isnan(found.cost.values)
    assert missing.tolist() == [[False] * 2, [True] * 2, [False] * 2]
    assert not found.reached.values[missing].any()


def test_a_result_is_read_again_from_every_file(whole: xarray.Dataset, tmp_path: Path) -> None:
    """Bit for bit, with units and provenance; a table has a row for each cell, and parquet keeps its attributes."""
    save_whole(whole, tmp_path / "whole.nc")
    with xarray.open_dataset(tmp_path / "whole.nc", engine="h5netcdf") as found:
        xarray.testing.assert_identical(found.load(), whole)
    table = SweepTable(whole).to_pandas()
    assert len(table) == 6
    row = table[(table.theta == 1.0) & (table.actuation == "model")]
    assert row.cost.item() == whole.cost.sel(theta=1.0, actuation="model").item()
    pandas: Any = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    table.to_parquet(tmp_path / "whole.parquet")
    again = pandas.read_parquet(tmp_path / "whole.parquet")
    assert again.attrs == table.attrs == dict(whole.attrs)
    assert again.equals(table)


@pytest.mark.evidence
def test_links_bounds_and_matrices_have_their_columns() -> None:
    """A rule over two links; a matrix as a label; what a model-actuated loop is bounded by; dotted names."""
    both = sweep(load("remote-scalar"), {"zeta": [0.5, 1.5]}, standard_error=1e-2)
    assert {"rate_actuator", "rate_sensor"} <= set(both)
    weights = {"kind": ["absolute"], "threshold": [0.1], "theta": [None], "weight": [[[1.0]], [[2.0]]]}
    found = sweep(MASSES, weights, standard_error=1e-2)
    assert found.weight.values.tolist() == ["[[1.0]]", "[[2.0]]"]
    line = Problem(
        Plant([[1.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]]), Network(), "excess", {"actuation": "model"}
    )
    bounded = sweep(line, {"delta": [1.0, 2.0]}, confidence=0.99)
    assert (bounded.cost_lower_bound <= bounded.cost).all()
    assert (bounded.rate_lowest <= bounded.rate_actuator).all()
    assert (bounded.rate_actuator <= bounded.rate_highest).all()
    periods = sweep(load("double-integrator"), {"policy.period": [0.5], "cost.R": [[[0.1]], [[0.2]]]})
    assert periods.cost.values[0, 0] < periods.cost.values[0, 1]


@pytest.mark.evidence
def test_progress_only_grows_and_ends_at_one(tmp_path: Path) -> None:
    """Here, on a pool, and where all is there already."""
    for executor in (None, ThreadPoolExecutor(2), None):
        seen: list[float] = []
        sweep(MASSES, GRID, executor=executor, store=tmp_path, standard_error=EFFORT, progress=seen.append)
        assert seen == sorted(seen)
        assert seen[-1] == 1.0


class Dying(Executor):
    """Gives one block back, and no other."""

    def __init__(self) -> None:
        """Start alive."""
        self.alive = True

    def submit(self, fn: Any, /, *args: Any, **_: Any) -> Future[Any]:
        """Run the first, and fail the rest."""
        future: Future[Any] = Future()
        if self.alive:
            future.set_result(fn(*args))
        else:
            future.set_exception(RuntimeError("the line is cut"))
        self.alive = False
        return future


def test_an_executor_that_dies_loses_nothing_that_came_back(tmp_path: Path) -> None:
    """One sentence; a second run continues where it ended."""
    with pytest.raises(ProblemError, match=r"failed after 1 of 6 cells \(RuntimeError: the line is cut\); expected"):
        sweep(MASSES, GRID, executor=Dying(), store=tmp_path, standard_error=EFFORT, seed=3)
    assert len(list((tmp_path / "cells").glob("*/*"))) == 1


@pytest.mark.parametrize(
    ("over", "sentence"),
    [
        ({}, "no values are given; expected a name with at least one value"),
        ({"theta": []}, "no values are given"),
        ({"theta": "0.1"}, "the values of theta are '0.1'; expected a list"),
        ({"theta": [0.1, 0.1]}, "theta contains 0.1 twice; expected each value only once"),
        ({"thta": [0.1]}, "policy.thta is not a parameter of the policy kind lqg; .* Did you mean 'theta'"),
        ({"method": [1]}, "the dimension name method is reserved by xarray; expected the name policy.method"),
        ({"theta": [-1.0, -2.0]}, "theta is -1; expected 0 ≤ theta"),
        ({"theta": [0.1], "policy.theta": [0.2]}, "theta and policy.theta are the same, or one contains the other"),
        ({"plant.initial.mean": [[0.0]], "plant.initial": [{}]}, "plant.initial.mean and plant.initial are the same"),
        ({"policy.a.b": [1, 2]}, "policy.a.b is not a key of a problem; expected a key of "),
        ({"theta": [1j]}, "a value of theta is 1j; expected numbers or words, or lists or arrays"),
        ({"theta": np.array(0.1)}, "the values of theta are .*; expected a list"),
        ([("theta", [0.1])], r"over is .*; expected a Mapping"),
        ({"seed": [1, 2]}, r"seed is not a key of a problem; expected one sweep for each seed \(--seed, seed=\)"),
        ({3: [0.1]}, "a name in over is 3; expected a str"),
    ],
)
def test_what_cannot_be_swept_is_refused(over: dict[str, Any], sentence: str) -> None:
    """Before anything runs."""
    with pytest.raises(ProblemError, match=sentence):
        sweep(MASSES, over)


def test_an_executor_is_one() -> None:
    """Not its class, and no word."""
    for wrong in ("processes", ThreadPoolExecutor):
        with pytest.raises(ProblemError, match=r"executor is .*; expected an Executor"):
            sweep(MASSES, {"theta": [0.1]}, executor=wrong, steps=2000)  # type: ignore[arg-type]


def test_a_bound_that_no_cell_has_is_refused() -> None:
    """A held input resets no error; a confidence is a probability."""
    with pytest.raises(ProblemError, match="a send of lqg does not"):
        sweep(MASSES, {"theta": [0.1]}, confidence=0.99)
    with pytest.raises(ProblemError, match="confidence is 2"):
        sweep(MASSES, {"theta": [0.1]}, confidence=2)


@pytest.mark.parametrize("address", few(["tcp://127.0.0.1:9", "nonsense", "", "foo://x:1"], 2, 1))
def test_no_scheduler_answers(address: str) -> None:
    """Where none is, and where none can be."""
    pytest.importorskip("distributed")
    with (
        pytest.raises(ProblemError, match=rf"no dask scheduler answers at '{address}'"),
        dask_workers(address),
    ):
        pass


@pytest.mark.evidence
def test_a_worker_killed_in_a_dask_sweep_costs_its_cells_only(whole: xarray.Dataset, tmp_path: Path) -> None:
    """As soon as something came back, one of two worker processes is killed; the other and its successor continue."""
    distributed: Any = pytest.importorskip("distributed")
    killed: list[int] = []

    def kill(done: float) -> None:
        if 0 < done < 1 and not killed:
            killed.append(next(iter(cluster.workers.values())).pid)
            os.kill(killed[0], signal.SIGKILL)

    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=logging.CRITICAL
        ) as cluster,
        dask_workers(cluster.scheduler_address) as executor,
    ):
        found = sweep(MASSES, GRID, executor=executor, store=tmp_path, standard_error=EFFORT, seed=3, progress=kill)
    assert killed
    xarray.testing.assert_identical(found, whole)
    assert len(list((tmp_path / "cells").glob("*/*"))) == 6


@pytest.mark.evidence
def test_a_killed_process_of_a_pool_is_a_sentence_and_the_next_run_goes_on(
    whole: xarray.Dataset, tmp_path: Path
) -> None:
    """The pool is broken; what came back before is kept."""

    def kill(done: float) -> None:
        if 0 < done < 1:
            for process in multiprocessing.active_children():
                process.kill()

    with (
        ProcessPoolExecutor(2, get_context("spawn")) as pool,
        pytest.raises(ProblemError, match=r"the executor failed after [1-5] of 6 cells \(BrokenProcessPool.*run again"),
    ):
        sweep(MASSES, GRID, executor=pool, store=tmp_path, standard_error=EFFORT, seed=3, progress=kill)
    assert len(list((tmp_path / "cells").glob("*/*"))) in range(1, 6)
    xarray.testing.assert_identical(sweep(MASSES, GRID, store=tmp_path, standard_error=EFFORT, seed=3), whole)


def peak() -> float:
    """Return the most memory that a child of this process held, in kilobytes."""
    children = [Path(f"/proc/{child.pid}/status") for child in multiprocessing.active_children()]
    return max(int(path.read_text(encoding="utf-8").partition("VmHWM:")[2].split()[0]) for path in children)


LINE = """
[plant]
A = [[1.2]]
B = [[1.0]]
W = [[0.01]]
dt = 1.0

[cost]
Q = [[1.0]]
R = [[0.5]]

[policy]
kind = "lqg"
theta = 0.1
"""


@pytest.mark.evidence
def test_ten_thousand_cells_need_no_more_memory_and_four_executors_give_the_same_bits(tmp_path: Path) -> None:
    """Processes: ten times the cells, the same memory. Threads, dask and MPI: a tenth of the cells, the same bits."""
    distributed: Any = pytest.importorskip("distributed")
    (tmp_path / "line.toml").write_text(LINE)
    problem = load(tmp_path / "line.toml")
    variants: dict[str, list[object]] = {"trigger": ["joint", "separate"], "actuation": ["hold", "model"]}
    large = {"theta": np.geomspace(0.01, 1.0, scaled(2500, 500)).tolist(), **variants}
    small = {"theta": large["theta"][::10], **variants}
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        sweep(problem, small, executor=pool, steps=2000, seed=3)
        before = peak()
        found = sweep(problem, large, executor=pool, steps=2000, seed=3)
        after = peak()
    assert found.cost.size == 4 * len(large["theta"])
    assert np.isfinite(found.cost).all()
    assert len(np.unique(found.seed)) > 0.999 * found.cost.size  # of 32 bits
    assert after < 1.1 * before
    tenth = found.sel(theta=small["theta"])
    with ThreadPoolExecutor(2) as pool:
        assert sweep(problem, small, executor=pool, steps=2000, seed=3).identical(tenth)
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        dask_workers(cluster.scheduler_address) as executor,
    ):
        assert sweep(problem, small, executor=executor, steps=2000, seed=3).identical(tenth)
    assert by_two_ranks(tmp_path, str(tmp_path / "line.toml"), small, steps=2000).identical(tenth)


def test_a_field_of_an_evaluation_with_a_column_is_a_variable_of_a_sweep(monkeypatch: pytest.MonkeyPatch) -> None:
    """It has its unit, after the variables that each result has."""
    field = Field[Evaluation]("spared", lambda found: 1 - found.rates["actuator"].value, column="spared", unit="1")
    monkeypatch.setattr(Evaluation, "FIELDS", (*Evaluation.FIELDS, field))
    found = sweep(load("two-mass-lqg"), {"theta": [0.1]}, standard_error=1e-2)
    assert found.spared.item() == 1 - found.rate_actuator.item()
    assert found.spared.attrs == {"units": "1"}
    evaluation = evaluate(load("two-mass-lqg"), steps=20_000)
    assert evaluation.document()["spared"] == 1 - evaluation.rates["actuator"].value


@pytest.mark.evidence
def test_a_field_with_a_column_is_in_each_table_of_evaluations(monkeypatch: pytest.MonkeyPatch) -> None:
    """An estimate is one entry of a table, and two columns of pandas and of a sweep."""
    spared = Field[Evaluation]("spared", lambda found: found.rates["actuator"].scaled(-1.0, 1.0))
    field = replace(spared, column="spared", say="spared")
    monkeypatch.setattr(Evaluation, "FIELDS", (*Evaluation.FIELDS, field))
    mass = load("two-mass-lqg")
    one = evaluate(mass, steps=20_000)
    assert f"spared         {field.of(one)}" in str(one)
    assert one.columns()["spared"] == [field.of(one), *[None] * (len(one.columns()["name"]) - 1)]
    grid = tradeoff(mass, {"theta": [0.1]}, standard_error=1e-2)
    ranked = compare({"hold": mass, "model": mass.changed({"actuation": "model"})}, 0.3, standard_error=1e-2)
    for table in (grid, ranked):
        (heading,) = (line for line in str(table).splitlines() if "spared" in line)
        assert heading.split()[-1] == "spared"
        assert "spared_standard_error" in table.to_csv()
    assert ranked.document()["ranking"][0]["spared"]["value"] == pytest.approx(0.7, abs=0.01)
    assert "spared_standard_error" in sweep(mass, {"theta": [0.1]}, standard_error=1e-2)
