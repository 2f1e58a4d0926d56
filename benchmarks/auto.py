"""``evaluate`` against the best of its methods: is the one that it chooses by predicted work the cheapest in fact?

Fifty random problems of one to four states, stable and unstable, under triggers from frequent to rare sends, are each
measured to 1e-2, 1e-3 and 1e-4 of their cost: by ``measure`` as ``evaluate`` calls it, which chooses, predictions and
pilots included, and by every method that applies on its own. One that takes ten times as long as the best so far is
stopped. Times are processor seconds of one process, machine code compiled before.

    python benchmarks/auto.py docs/auto.json
"""

from __future__ import annotations

import itertools
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # their idle threads run in circles

import numpy as np

from taciturn import Cost, Plant, _progress, close, design
from taciturn._progress import OutOfTime, limited
from taciturn.errors import TaciturnError
from taciturn.loop import Loop
from taciturn.simulation.average import average
from taciturn.study.measure import Request, candidates_of, measure

PROBLEMS, SEED = 50, 20_240
ERRORS = (1e-2, 1e-3, 1e-4)
RADII = (0.6, 0.9, 0.98, 1.0, 1.1)
SLOWEST = 10.0  # times the best, at which the others are stopped
RAREST = 3e-4  # sends per tick
LEAST = 0.2  # seconds that the others may always take


def draw(seed: int) -> tuple[str, Loop]:
    """Return a random loop and what it is."""
    draws = np.random.default_rng((SEED, seed))
    n = 1 + seed % 4
    A = draws.normal(size=(n, n))
    A *= draws.choice(RADII) / np.abs(np.linalg.eigvals(A)).max()
    G, W = draws.normal(size=(n, n)), draws.normal(size=(n, n))
    plant = Plant(A, draws.normal(size=(n, max(1, n - 1))), W @ W.T + 0.1 * np.eye(n))
    cost = Cost(G @ G.T + 0.1 * np.eye(n), np.eye(max(1, n - 1)))
    theta = float(10 ** draws.uniform(-2.0, 0.5))
    kinds: dict[str, Callable[[], object]] = {
        "excess": lambda: design.excess(plant, cost, theta=theta, actuation="model"),
        "absolute": lambda: design.absolute(plant, cost, threshold=3 * theta, error="state", actuation="model"),
        "lqg": lambda: design.lqg(plant, cost, theta=theta, actuation="model"),
        "excess, held": lambda: design.excess(plant, cost, theta=theta),
    }
    kind = draws.choice(list(kinds), p=(0.5, 0.3, 0.1, 0.1))
    return f"{kind}, {n} states, radius {np.abs(np.linalg.eigvals(A)).max():.2f}, {theta:.3g}", close(
        plant, kinds[kind]()
    )


def problems() -> Iterator[tuple[str, Loop]]:
    """Yield random loops that send now and then, their machine code compiled."""
    for seed in itertools.count():
        try:
            name, loop = draw(seed)
            found = average(loop, steps=1 << 21)
        except TaciturnError as error:
            print(seed, f"no such loop: {error}", file=sys.stderr)
            continue
        if found.settled and found.rates[loop.policy.scheduled[0]].value > RAREST:
            yield name, loop


def spent(run: Callable[[], object]) -> tuple[float, bool]:
    """Return the processor seconds of a call, and whether it ended by itself."""
    began = time.process_time()
    try:
        run()
    except (OutOfTime, TaciturnError):
        return time.process_time() - began, False
    return time.process_time() - began, True


def contest(loop: Loop, error: float) -> dict[str, Any]:
    """Return the seconds of the choice, and of every method."""
    effort = Request(0, error, None, "auto")
    began = time.process_time()
    chosen = measure(loop, effort, None)
    mine = time.process_time() - began
    times, found = {}, candidates_of(loop, effort, None)[0]
    for candidate in sorted(found, key=lambda one: one.name != chosen.method):
        stop = limited(None, max(LEAST, SLOWEST * min(times.values(), default=mine)))
        fresh = next(one for one in candidates_of(loop, effort, stop)[0] if one.name == candidate.name)
        reached: list[bool] = []
        seconds, ended = spent(lambda one=fresh, at=stop, ok=reached: ok.append(one.run(at).reached))
        if ended and all(reached):
            times[candidate.name] = seconds
    best = min([mine, *times.values()])
    return {"chosen": chosen.method, "why": chosen.reason, "seconds": mine, "methods": times, "ratio": mine / best}


def tell(row: dict[str, Any]) -> None:
    """Print a line."""
    shown = ", ".join(f"{method} {seconds:.3f}" for method, seconds in row["methods"].items())
    chosen = f"{row['chosen']:20} {row['seconds']:.3f} x{row['ratio']:.2f}"
    print(f"{row['problem']:45} {row['relative_error']:g} {chosen} | {shown} | {row['why']}", flush=True)


def main() -> None:
    """Measure, print a line per contest, and write the document."""
    _progress.clock = time.process_time
    rows: list[dict[str, Any]] = []
    for name, loop in itertools.islice(problems(), PROBLEMS):
        constant = loop.policy.cost_all_time
        for relative in ERRORS:
            row = {"problem": name, "relative_error": relative} | contest(loop, relative * constant)
            rows.append(row)
            tell(row)
    ratios = np.array([row["ratio"] for row in rows])
    summary = {"cases": len(rows), "within_2": float((ratios <= 2).mean()), "worst": float(ratios.max())}
    print(json.dumps(summary))
    if len(sys.argv) > 1:
        Path(sys.argv[1]).write_text(json.dumps({"summary": summary, "rows": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
