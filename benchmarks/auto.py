"""``evaluate(problem)`` next to ``evaluate(problem, method=...)``: does auto choose the method of least time?

Fifty random problems of one to four states, stable and unstable, with triggers that send often to rarely, are evaluated
to a standard error of 1e-2, 1e-3 and 1e-4 of their cost: with ``method="auto"``, and with each method by its name. A
user compares these calls, so both include everything: the design, the closed loop, predictions and pilots, the
comparison with periodic control and the result. Times are processor seconds in one process. Calls of less than a second
run three more times, in turn, and the median of these counts: modules are imported and machine code is compiled then.
A method that takes ten times as long as the best call so far is stopped by ``time_limit`` and does not count. Each
answer of auto is compared with the most precise answer of the same case; ``off`` is their difference in units of the
sum of their errors.

    python benchmarks/auto.py [--json docs/auto.json]
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # idle threads of theirs spin

import numpy as np

import taciturn
from taciturn import Cost, Network, Plant, Problem, _progress
from taciturn.errors import TaciturnError
from taciturn.study.evaluation import Evaluation

Asked = Literal["auto", "simulation", "exact", "conditional sampling"]
PROBLEMS, SEED = 50, 20_240
ERRORS = (1e-2, 1e-3, 1e-4)
METHODS: tuple[Asked, ...] = ("simulation", "exact", "conditional sampling")
RADII = (0.6, 0.9, 0.98, 1.0, 1.1)
SLOWEST = 10.0  # times the best, at which a call is stopped
LEAST = 0.2  # seconds that every call may take
QUICK, ROUNDS = 1.0, 3  # calls of fewer seconds run several times more
RAREST = 3e-4  # sends per sampling instant


def draw(seed: int) -> tuple[str, Problem]:
    """Return a random problem and what it is."""
    draws = np.random.default_rng((SEED, seed))
    n = 1 + seed % 4
    A = draws.normal(size=(n, n))
    A *= draws.choice(RADII) / np.abs(np.linalg.eigvals(A)).max()
    G, W = draws.normal(size=(n, n)), draws.normal(size=(n, n))
    plant = Plant(A, draws.normal(size=(n, max(1, n - 1))), W @ W.T + 0.1 * np.eye(n))
    cost = Cost(G @ G.T + 0.1 * np.eye(n), np.eye(max(1, n - 1)))
    theta = float(10 ** draws.uniform(-2.0, 0.5))
    kinds: dict[str, tuple[str, dict[str, Any]]] = {
        "excess": ("excess", {"theta": theta, "actuation": "model"}),
        "absolute": ("absolute", {"threshold": 3 * theta, "error": "state", "actuation": "model"}),
        "lqg": ("lqg", {"theta": theta, "actuation": "model"}),
        "excess, held": ("excess", {"theta": theta}),
    }
    kind = str(draws.choice(list(kinds), p=(0.5, 0.3, 0.1, 0.1)))
    name = f"{kind}, {n} states, radius {np.abs(np.linalg.eigvals(A)).max():.2f}, {theta:.3g}"
    return name, Problem(plant, cost, Network(), *kinds[kind])


def problems() -> Iterator[tuple[str, Problem]]:
    """Yield random problems whose loops are stable and send now and then."""
    for seed in itertools.count():
        name, problem = draw(seed)
        try:
            found = taciturn.evaluate(problem, steps=1 << 21)
        except TaciturnError as error:
            print(seed, f"no such loop: {error}", file=sys.stderr)
            continue
        if found.settled and next(iter(found.rates.values())).value > RAREST:
            yield name, problem


def call(problem: Problem, method: Asked, error: float, seconds: float | None) -> tuple[float, Evaluation | None]:
    """Return the processor seconds of a call, and its answer; None if it has none, or misses the asked error."""
    began = time.process_time()
    try:
        found = taciturn.evaluate(problem, method=method, standard_error=error, time_limit=seconds)
    except TaciturnError:
        return time.process_time() - began, None
    return time.process_time() - began, found if found.reached else None


def error_of(found: Evaluation) -> float:
    """Return the standard error of a cost, and its error bound, together."""
    return found.cost.standard_error + found.cost.error


def contest(problem: Problem, error: float) -> dict[str, Any]:
    """Return the seconds of the choice, and of every method by its name."""
    asked: tuple[Asked, ...] = ("auto", *METHODS)
    seconds, answers = dict[str, float](), dict[str, Evaluation]()
    for method in asked:
        limit = None if method == "auto" else max(LEAST, SLOWEST * min(seconds.values()))
        first, found = call(problem, method, error, limit)
        if found is not None:
            seconds[method], answers[method] = first, found
        elif method == "auto":
            raise SystemExit(f"auto missed the asked error {error:g}")
    quick = [method for method in seconds if seconds[method] < QUICK]
    rounds = [{method: call(problem, method, error, None)[0] for method in quick} for _ in range(ROUNDS)]
    seconds |= {method: float(np.median([each[method] for each in rounds])) for method in quick}
    chosen, best = answers["auto"], min(answers.values(), key=error_of)
    between = max(error_of(chosen) + error_of(best), 1e-12 * abs(chosen.cost.value))
    return {
        "chosen": chosen.method,
        "why": chosen.reason,
        "seconds": seconds.pop("auto"),
        "methods": seconds,
        "error": error_of(chosen),
        "off": abs(chosen.cost.value - best.cost.value) / between,
    }


def tell(row: dict[str, Any]) -> None:
    """Print a line."""
    shown = ", ".join(f"{method} {seconds:.3f}" for method, seconds in row["methods"].items())
    chosen = f"{row['chosen']:20} {row['seconds']:.3f} x{row['ratio']:.2f}"
    print(f"{row['problem']:45} {row['relative_error']:g} {chosen} | {shown} | {row['why']}", flush=True)


def summary_of(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Return how many calls there were, how many took at most twice the best time, and the worst ratio."""
    ratios = np.array([row["ratio"] for row in rows])
    return {"cases": len(rows), "within_2": float((ratios <= 2).mean()), "worst": float(ratios.max())}


def main() -> None:
    """Measure, print a line per contest, and write the document."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    _progress.clock = time.process_time
    rows: list[dict[str, Any]] = []
    for name, problem in itertools.islice(problems(), PROBLEMS):
        for relative in ERRORS:
            row = {"problem": name, "relative_error": relative}
            row |= contest(problem, relative * problem.design().cost_all_time)
            row["ratio"] = row["seconds"] / min([row["seconds"], *row["methods"].values()])
            rows.append(row)
            tell(row)
    document = {
        "summary": summary_of(rows) | {"most_off": max(row["off"] for row in rows)},
        "by_error": {
            f"{asked:g}": summary_of([row for row in rows if row["relative_error"] == asked]) for asked in ERRORS
        },
        "by_method": {
            chosen: summary_of([row for row in rows if row["chosen"] == chosen])
            for chosen in sorted({row["chosen"] for row in rows})
        },
        "rows": rows,
    }
    print(json.dumps({name: part for name, part in document.items() if name != "rows"}, indent=1))
    if args.json:
        args.json.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
