"""Workers that run other code are refused, and none of their cells is stored."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest

import taciturn
from taciturn import ProblemError, load, sweep
from taciturn_studies import workers
from taciturn_studies.workers import Code, answer_all, code_of, idle, own_code
from taciturn_sweep.cluster import dask_workers

PACKAGE = Path(taciturn.__file__).parent
MASSES = load("two-mass-lqg")
GRID: dict[str, list[object]] = {"theta": [0.1, 1.0]}


class Foreign(Executor):
    """A worker in this process that pretends to run other code."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, code: Code | None) -> None:
        """Pretend; None for a version that has no function for its report."""
        self._patch, self._code = monkeypatch, code

    def submit(self, fn: Any, /, *args: Any, **_: Any) -> Future[Any]:
        """Run a task under the other code."""
        future: Future[Any] = Future()
        with self._patch.context() as patch:
            if self._code is None:
                patch.setattr("taciturn._version.__version__", "0.9.0")
                if fn.__module__.startswith("taciturn"):
                    future.set_exception(ModuleNotFoundError(f"No module named {fn.__module__!r}"))
                    return future
            else:
                patch.setattr(workers, "own_code", lambda: self._code)
            future.set_result(fn(*args))
        return future


@pytest.mark.parametrize(
    ("code", "says"),
    [
        (Code("0.9.1", ""), r"^the worker \(process \d+ on .+\) runs taciturn 0.9.1, and this process .*: install"),
        (Code(own_code().version, "0" * 64), r"runs taciturn .* with the sources 0{12}, and this process the sources"),
        (None, r"^the worker \(one of them\) runs taciturn 0.9.0, and this process .*; expected the same version"),
    ],
)
def test_a_worker_with_other_code_is_refused(
    code: Code | None, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It computes nothing, and its cells are not stored under the key of this version."""
    computed: list[object] = []
    monkeypatch.setattr("taciturn_studies.points.evaluate", lambda *given, **_: computed.append(given))
    with pytest.raises(ProblemError, match=says):
        sweep(MASSES, GRID, executor=Foreign(monkeypatch, code), store=tmp_path, steps=2000)
    with pytest.raises(ProblemError, match=says):
        answer_all(Foreign(monkeypatch, code), abs, [-1], idle)
    assert computed == []
    assert not list((tmp_path / "cells").glob("*/*"))


def test_a_digest_covers_every_source(tmp_path: Path) -> None:
    """A changed, renamed or additional file changes it; the ends of lines do not."""
    (tmp_path / "taciturn").mkdir()
    (tmp_path / "taciturn_more" / "part").mkdir(parents=True)
    (tmp_path / "taciturn" / "a.py").write_bytes(b"x = 1\ny = 2\n")
    (tmp_path / "taciturn_more" / "part" / "b.py").write_bytes(b"")
    first = code_of(tmp_path, "1")
    (tmp_path / "taciturn" / "a.py").write_bytes(b"x = 1\r\ny = 2\r\n")
    assert code_of(tmp_path, "1") == first
    (tmp_path / "taciturn" / "a.py").write_bytes(b"x = 1\ny = 3\n")
    found = {first, code_of(tmp_path, "1")}
    (tmp_path / "taciturn_more" / "part" / "b.py").rename(tmp_path / "taciturn_more" / "part" / "c.py")
    found.add(code_of(tmp_path, "1"))
    (tmp_path / "taciturn" / "d.py").write_bytes(b"")
    found |= {code_of(tmp_path, "1"), code_of(tmp_path, "2")}
    assert len(found) == 5
    assert own_code() == code_of(PACKAGE.parent, taciturn.__version__)


def package_of(folder: Path, version: str, reports: bool = True) -> dict[str, str]:
    """Return the environment of a process that imports a copy of the package with another version."""
    for package in PACKAGE.parent.glob("taciturn*"):
        shutil.copytree(package, folder / package.name, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "taciturn" / "_version.py").write_text(f'__version__ = "{version}"\n')
    if not reports:  # as a version before there were reports
        for name in ("points", "workers"):
            (folder / "taciturn_studies" / f"{name}.py").unlink()
    return os.environ | {"PYTHONPATH": str(folder)}


@contextmanager
def ended(*processes: subprocess.Popen[bytes]) -> Iterator[None]:
    """Terminate processes at the end."""
    try:
        yield
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait(30)


@pytest.mark.evidence
@pytest.mark.parametrize("reports", [True, False])
def test_a_dask_worker_of_another_version_is_refused(reports: bool, tmp_path: Path) -> None:
    """It is named by its address, before a task stops it: a worker of dask ends if it cannot import a task."""
    distributed: Any = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=0, dashboard_address=":0", silence_logs=50) as cluster:
        command = [sys.executable, "-m", "distributed.cli.dask_worker", cluster.scheduler_address, "--nthreads", "1"]
        env = package_of(tmp_path / "other", "0.9.1", reports)
        worker = subprocess.Popen([*command, "--no-dashboard"], env=env, stderr=subprocess.DEVNULL)
        with ended(worker), distributed.Client(cluster, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=60)
            with (
                dask_workers(cluster.scheduler_address) as executor,
                pytest.raises(
                    ProblemError,
                    match=r"^the worker \(tcp://.+\) runs taciturn 0.9.1, and this process 1.*: install taciturn 1",
                ),
            ):
                sweep(MASSES, GRID, executor=executor, store=tmp_path / "store", steps=2000)
    assert not list((tmp_path / "store" / "cells").glob("*/*"))


MPI = """
from mpi4py.futures import MPIPoolExecutor

import taciturn

if __name__ == "__main__":
    with MPIPoolExecutor() as executor:
        try:
            taciturn.sweep(taciturn.load("two-mass-lqg"), {"theta": [0.1, 1.0]}, executor=executor, steps=2000)
        except taciturn.ProblemError as error:
            print(error)
"""


@pytest.mark.evidence
@pytest.mark.parametrize("reports", [True, False])
def test_an_mpi_rank_of_another_version_is_refused(reports: bool, tmp_path: Path) -> None:
    """One rank distributes the cells, and the other imports another version."""
    pytest.importorskip("mpi4py")
    script = tmp_path / "swept.py"
    script.write_text(MPI)
    other = package_of(tmp_path / "other", "0.9.1", reports)["PYTHONPATH"]
    rank = [sys.executable, "-m", "mpi4py.futures", str(script)]
    launch = [str(Path(sys.executable).parent / "mpiexec"), "-n", "1", "-env", "PYTHONPATH", str(PACKAGE.parent), *rank]
    command = [*launch, ":", "-n", "1", "-env", "PYTHONPATH", other, *rank]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert "runs taciturn 0.9.1, and this process" in ran.stdout, ran.stderr


@pytest.mark.evidence
def test_a_process_that_imports_changed_sources_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As when a file of the package is edited between the start of the sweep and that of a worker."""
    package_of(tmp_path / "other", taciturn.__version__)
    with (tmp_path / "other" / "taciturn" / "loop.py").open("a") as file:
        file.write("\n# edited\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "other"))
    monkeypatch.setattr(sys, "path", [str(tmp_path / "other"), *sys.path])  # spawned processes take it over
    began = time.monotonic()
    with (
        ProcessPoolExecutor(1, get_context("spawn")) as pool,
        pytest.raises(ProblemError, match=r"with the sources [0-9a-f]{12}, and this process the sources"),
    ):
        sweep(MASSES, GRID, executor=pool, steps=2000)
    assert time.monotonic() - began < 120
