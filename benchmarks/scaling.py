"""Processor time and memory against the number of states: designs next to python-control, evaluation, limits.

    python benchmarks/scaling.py [--sizes 2 5 10 20 40 80 100 140 200] [--before FOLDER] [--json docs/scaling.json]

Each row has a process of its own, on one thread. A design is that of a plant and a cost from their matrices, checks
included. Within the process it and python-control's dlqr and dlqe of the same matrices take turns; each has the median
of its processor times, and their ratio the median of the turns' ratios. ``--before`` names a folder with the sources of
another version, measured as well. Memory is what a process holds at most beyond its imports.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

import numpy as np
import scipy.linalg

SIZES = (2, 5, 10, 20, 40, 80, 100, 140, 200)
LONGEST = 60  # seconds that a row may take
MOST = {"evaluate": 200, "near-optimal": 20, "lower bound": 20}  # states
SOURCE = Path(__file__).resolve().parent.parent / "src"
Array = np.ndarray
Plant = tuple[Array, Array, Array]


def dense(n: int, draws: np.random.Generator) -> Plant:
    """Return a random plant with a mode of 1.02, and an input and an output for every ten states."""
    A = draws.standard_normal((n, n))
    A *= 1.02 / np.abs(np.linalg.eigvals(A)).max()
    many = max(1, n // 10)
    return A, draws.standard_normal((n, many)), draws.standard_normal((many, n))


def sparse(n: int, draws: np.random.Generator) -> Plant:
    """Return a ring of states, each moved by two others that are drawn, an input and an output at every fifth."""
    A = 0.5 * np.eye(n) + np.roll(np.eye(n), 1, axis=0) * draws.uniform(0.2, 0.6, n)
    A[draws.integers(0, n, n), np.arange(n)] += draws.normal(0, 0.3, n)
    A *= 1.02 / np.abs(np.linalg.eigvals(A)).max()
    places = np.eye(n)[:: min(n, 5)]
    return A, places.T, places


def masses(n: int, _: np.random.Generator) -> Plant:
    """Return masses in a row between springs, hardly damped, pushed at one end and measured at the other: banded."""
    half = n // 2
    stiffness = 2 * np.eye(half) - np.eye(half, k=1) - np.eye(half, k=-1)
    A = np.block([[np.zeros((half, half)), np.eye(half)], [-stiffness, -0.02 * stiffness]])
    Phi = scipy.linalg.expm(0.2 * np.block([[A, np.eye(2 * half)[:, [half]]], [np.zeros((1, 2 * half + 1))]]))
    return Phi[:-1, :-1], Phi[:-1, -1:], np.eye(2 * half)[[half - 1]]


def stiff(n: int, draws: np.random.Generator) -> Plant:
    """Return modes that decay at paces a million times apart, and one that grows, in turned coordinates."""
    paces = -np.logspace(-3, 3, n)
    paces[0] = 0.05
    turn, _ = np.linalg.qr(draws.standard_normal((n, n)))
    many = max(1, n // 10)
    return (turn * np.exp(0.1 * paces)) @ turn.T, draws.standard_normal((n, many)), draws.standard_normal((many, n))


def hidden(n: int, draws: np.random.Generator) -> Plant:
    """Return a stable random plant next to a mode of 1.1 that inputs move and outputs see by a thousandth."""
    A, B, C = dense(n, draws)
    A *= 0.95 / 1.02
    A[-1], A[:, -1], A[-1, -1], B[-1], C[:, -1] = 0.0, 0.0, 1.1, 1e-3, 1e-3
    return A, B, C


def chain(n: int, _: np.random.Generator) -> Plant:
    """Return a chain moved at its start and measured at its end: hardly controllable when it is long."""
    A = 0.7 * np.eye(n) + 0.3 * np.eye(n, k=-1)
    A[0, 0] = 1.05
    return A, np.eye(n)[:, :1], np.eye(n)[-1:]


FAMILIES: dict[str, Callable[[int, np.random.Generator], Plant]] = {
    function.__name__: function for function in (dense, sparse, masses, stiff, hidden, chain)
}


def matrices(family: str, n: int, turn: int = 0) -> tuple[Array, ...]:
    """Return A, B, C, W, V, Q and R of a row, in every turn others by a trifle: answers to the same are kept."""
    A, B, C = FAMILIES[family](n, np.random.default_rng(n))
    unit = (1 + 1e-9 * turn) * np.eye(len(A))
    return A, B, C, 0.1 * unit, 0.1 * np.eye(len(C)), unit, np.eye(B.shape[1])


def timed(function: Callable[..., None], *asked: Array) -> tuple[float, str]:
    """Return seconds of processor time, and why there is no answer."""
    refused, start = "", time.process_time()
    try:
        function(*asked)
    except Exception as error:  # a refusal is an answer
        refused = str(error).split(";")[0]
    return time.process_time() - start, refused


def peak() -> float:
    """Return the most memory that this process held, in megabytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def row(task: str, family: str, n: int) -> dict[str, Any]:
    """Measure one row in this process."""
    import taciturn
    from taciturn import design
    from taciturn_limits.bounds import bound_below

    def solve(A: Array, B: Array, C: Array, W: Array, V: Array, Q: Array, R: Array) -> None:
        plant, cost = taciturn.Plant(A, B, W, C, V), taciturn.Cost(Q, R)
        if task == "design":
            design.excess(plant, cost, theta=0.1)
            return
        if task == "evaluate":
            taciturn.evaluate(taciturn.Problem(plant, cost, taciturn.Network(), "excess", {"theta": 0.1}))
            return
        price = 0.1 * design.all_time(plant, cost).cost_all_time
        asked = taciturn.Problem(plant, cost, taciturn.Network(), "near-optimal", {"price": price})
        asked.design()
        if task == "lower bound":
            policy = design.excess(plant, cost, delta=price, actuation="model")
            bound_below(taciturn.close(plant, policy), rate=0.2)

    def control(A: Array, B: Array, C: Array, W: Array, V: Array, Q: Array, R: Array) -> None:
        dlqr(A, B, Q, R)
        dlqe(A, np.eye(len(A)), C, W, V)

    solve(*matrices("dense", 4))
    before, ours, theirs = peak(), [timed(solve, *matrices(family, n))], []
    megabytes, refused = peak() - before, ours[0][1]
    if task == "design":
        from control import dlqe, dlqr

        timed(control, *matrices("dense", 4))  # what it imports when it is first used
        ours.clear()
        for turn in range(1, 2 if n > 140 else 4 if n > 40 else 8 if n > 20 else 32):
            asked = matrices(family, n, turn)
            theirs.append(timed(control, *asked))
            ours.append(timed(solve, *asked))
    seconds, control_seconds = ([one for one, _ in found] for found in (ours, theirs))
    ratios = [one / other for one, other in zip(seconds, control_seconds, strict=False)]
    found = {"seconds": seconds, "control": control_seconds, "ratio": ratios}
    medians = {name: statistics.median(values) if values else None for name, values in found.items()}
    return {**medians, "megabytes": megabytes, "refused": refused}


def apart(task: str, family: str, n: int, source: Path) -> dict[str, Any]:
    """Return the same, measured in a process of its own, by the sources of a folder."""
    asked = [sys.executable, __file__, "--row", task, family, str(n)]
    try:
        done = subprocess.run(
            asked, env={**os.environ, "PYTHONPATH": str(source)}, capture_output=True, text=True, timeout=LONGEST
        )
    except subprocess.TimeoutExpired:
        return {"seconds": None, "control": None, "ratio": None, "megabytes": None, "refused": f"> {LONGEST} s"}
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def processor() -> str:
    """Return the name of the processor."""
    about = Path("/proc/cpuinfo")
    lines = about.read_text(encoding="utf-8").splitlines() if about.exists() else []
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def main() -> None:
    """Measure and print, or write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES))
    parser.add_argument("--before", type=Path)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--row", nargs=3, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.row:
        task, family, n = args.row
        print(json.dumps(row(task, family, int(n))))
        return
    sources = {"after": SOURCE} | ({} if args.before is None else {"before": args.before.resolve()})
    rows: list[dict[str, Any]] = []
    machine = {"processor": processor(), "cores": os.cpu_count(), "python": platform.python_version()}
    for task, families in (("design", list(FAMILIES)), *((task, ["dense"]) for task in MOST)):
        for n in args.sizes:
            for family in families if n <= MOST.get(task, n) else []:
                found = {name: apart(task, family, n, source) for name, source in sources.items()}
                rows.append({"task": task, "family": family, "states": n, **found})
                print(task, family, n, found, flush=True)
                if args.json:
                    args.json.write_text(json.dumps({"machine": machine, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
