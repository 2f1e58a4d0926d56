"""Sweeps by every executor, side by side: scaling, what a cell costs beyond its own work, and memory.

    python benchmarks/sweeps.py [--cells 10000] [--steps 2000] [--rounds 1] [--json docs/sweeps.json]

*Efficiency* is the time of one worker over that of two together (of the first row, where one worker is not measured).
Each contestant has a process of its own, one after the other, in turn; times are medians of the rounds, without the
start of the workers, which is told apart. Needs the extras dask and mpi.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

import numpy as np

import taciturn
from taciturn import Cost, Plant, Problem
from taciturn.model.network import Network
from taciturn.program.machine import one_thread

CONTESTANTS = ("here", "threads", "processes", "dask", "mpi")
TASKS = 1000  # that do nothing, to tell what one costs
WARM = 16  # cells before the clock starts, for each worker: imports, and the program's machine code


def line() -> Problem:
    """Return an unstable line with a price of silence: cells as short as they get."""
    return Problem(Plant([[1.2]], [[1.0]], [[0.01]]), Cost([[1.0]], [[0.5]]), Network(), "lqg", {"theta": 0.1})


def grid(cells: int) -> dict[str, list[object]]:
    """Return a grid over the prices of silence and every trigger, of at least so many cells."""
    prices = np.geomspace(0.01, 1.0, -(-cells // 4)).tolist()
    return {"theta": prices, "trigger": ["joint", "separate"], "actuation": ["hold", "model"]}


@contextmanager
def workers_by(name: str, workers: int) -> Generator[Executor | None]:
    """Give an executor with so many workers of one thread each."""
    if name == "here":
        with one_thread():
            yield None
    elif name == "threads":
        with ThreadPoolExecutor(workers) as pool:
            yield pool
    elif name == "processes":
        with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
            yield pool
    elif name == "dask":
        from distributed import LocalCluster

        from taciturn_sweep.cluster import dask_workers

        with (
            LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster,
            dask_workers(cluster.scheduler_address) as pool,
        ):
            yield pool
    else:
        from mpi4py.futures import MPIPoolExecutor

        with MPIPoolExecutor() as pool:
            yield pool


def peak(process: int | None = None) -> float:
    """Return the most memory that a process held, in megabytes."""
    status = Path(f"/proc/{process or os.getpid()}/status").read_text(encoding="utf-8")
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


def measure(name: str, workers: int, cells: int, steps: int, stored: bool) -> dict[str, Any]:
    """Return seconds, memory and a digest of one sweep."""
    problem, over = line(), grid(cells)
    begin = time.perf_counter()
    with workers_by(name, workers) as executor, tempfile.TemporaryDirectory() as folder:
        taciturn.sweep(problem, grid(WARM * workers), executor=executor, steps=steps)
        started, worked = time.perf_counter(), time.process_time()
        found = taciturn.sweep(problem, over, executor=executor, steps=steps, store=folder if stored else None)
        ended, hand = time.perf_counter(), time.process_time() - worked
        worker = max((peak(child.pid) for child in multiprocessing.active_children()), default=None)
        worked = time.process_time()
        for task in [] if executor is None else [executor.submit(abs, -1) for _ in range(TASKS)]:
            task.result()
        task = (time.process_time() - worked) / TASKS
    columns = [np.ascontiguousarray(found[one].values) for one in sorted(found) if found[one].dtype != object]
    return {
        "start": started - begin,
        "seconds": ended - started,
        "cells": found.cost.size,
        "hand": hand / found.cost.size,
        "task": task,
        "worker_megabytes": worker,
        "megabytes": peak(),
        "digest": hashlib.sha256(b"".join(column.tobytes() for column in columns)).hexdigest(),
    }


def apart(name: str, workers: int, cells: int, steps: int, stored: bool = False) -> dict[str, Any]:
    """Return the same, measured in a process of its own; with MPI, one rank more hands out."""
    asked = [
        __file__,
        "--one",
        name,
        "--workers",
        str(workers),
        "--cells",
        str(cells),
        "--steps",
        str(steps),
        *(["--stored"] * stored),
    ]
    launch = [str(Path(sys.executable).parent / "mpiexec"), "-n", str(workers + 1)] if name == "mpi" else []
    module = ["-m", "mpi4py.futures"] if name == "mpi" else []
    ran = subprocess.run([*launch, sys.executable, *module, *asked], capture_output=True, text=True, check=False)
    if ran.returncode:
        raise SystemExit(f"{name} with {workers} workers failed:\n{ran.stderr}")
    return json.loads(ran.stdout.strip().splitlines()[-1])


def medians(of: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the medians over rounds, and a digest if all have the same."""
    digests = {one["digest"] for one in of}
    assert len(digests) == 1, "two rounds differ"
    numbers = {name: value for name, value in of[0].items() if name != "digest"}
    held = {
        name: None if value is None else statistics.median(one[name] for one in of) for name, value in numbers.items()
    }
    return held | {"digest": digests.pop()}


def main() -> None:
    """Measure, print, and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=10_000)
    parser.add_argument("--steps", type=int, default=2000, help="of a cell; with few, its time is that of its design")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--one", choices=CONTESTANTS, help=argparse.SUPPRESS)
    parser.add_argument("--workers", type=int, default=1, help=argparse.SUPPRESS)
    parser.add_argument("--stored", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.one:
        print(json.dumps(measure(asked.one, asked.workers, asked.cells, asked.steps, asked.stored)))
        return
    runs = [("here", 1), *((name, workers) for name in CONTESTANTS[1:] for workers in (1, 2))]
    rounds: dict[tuple[str, int], list[dict[str, Any]]] = {run: [] for run in runs}
    for _ in range(asked.rounds):
        for run in runs:
            rounds[run].append(apart(*run, asked.cells, asked.steps))
            print(*run, f"{rounds[run][-1]['seconds']:.2f} s", file=sys.stderr)
    table = {run: medians(found) for run, found in rounds.items()}
    here = table["here", 1]
    assert len({row["digest"] for row in table.values()}) == 1, "two executors differ"
    print(f"{here['cells']} cells, {1e3 * here['seconds'] / here['cells']:.2f} ms each here, on one thread")
    print(
        f"{'':12}{'workers':>8}{'seconds':>9}{'efficiency':>12}{'ms more per cell':>18}{'start s':>9}{'worker MB':>11}"
    )
    rows: list[dict[str, Any]] = []
    for (name, workers), row in table.items():
        ideal = table.get((name, 1), here)["seconds"] / workers
        rows.append(
            {"executor": name, "workers": workers}
            | {key: row[key] for key in ("seconds", "start", "hand", "task", "worker_megabytes", "megabytes")}
            | {
                "efficiency": ideal / row["seconds"],
                "overhead": (row["seconds"] * workers - here["seconds"]) / here["cells"],
            }
        )
        memory = "" if row["worker_megabytes"] is None else f"{row['worker_megabytes']:11.0f}"
        print(
            f"{name:12}{workers:8}{row['seconds']:9.2f}{rows[-1]['efficiency']:12.3f}{1e3 * rows[-1]['overhead']:18.3f}"
            f"{row['start']:9.2f}{memory}"
        )
    memory = {
        str(cells): apart("processes", 2, cells, asked.steps)
        for cells in (asked.cells // 10, asked.cells, 2 * asked.cells)
    }
    kept = apart("here", 1, asked.cells, asked.steps, stored=True)
    stored = (kept["seconds"] - here["seconds"]) / here["cells"]
    print("memory of a worker:", {cells: round(row["worker_megabytes"]) for cells, row in memory.items()}, "MB")
    print(f"a store: {1e3 * stored:.3f} ms more per cell")
    if asked.json:
        document = {
            "machine": {
                "processor": platform.machine(),
                "processors": os.cpu_count(),
                "python": platform.python_version(),
            },
            "cells": here["cells"],
            "cell": here["seconds"] / here["cells"],
            "rows": rows,
            "memory": {cells: row["worker_megabytes"] for cells, row in memory.items()},
            "parent_memory": {cells: row["megabytes"] for cells, row in memory.items()},
            "store": stored,
        }
        asked.json.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
