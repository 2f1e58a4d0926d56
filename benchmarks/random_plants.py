"""Rules and fair periodic control at equal rate on random plants: who costs less, how often.

    python benchmarks/random_plants.py [--json docs/random_plants.json] [--plants 20]

Plants that are in the file already are kept: it can be interrupted, and continues where it was.
"""

from __future__ import annotations

import argparse
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np

import taciturn
from taciturn import Cost, Network, Plant, Problem, TaciturnError

SHARES = (0.3, 0.6)  # of the steps that send
PRECISION = 1e-3  # standard error of a cost, in all-time costs
RULES: dict[str, tuple[str, dict[str, object]]] = {
    "excess": ("excess", {"theta": 0.1}),
    "lqg": ("lqg", {"theta": 0.1}),
    "relative": ("relative", {"sigma": 0.5}),
    "clock": ("periodic", {"every": 3}),
}


def plant(seed: int) -> tuple[Plant, Cost]:
    """Return a plant of one to four states with measured outputs, and a cost; three of ten are unstable."""
    draws = np.random.default_rng(seed)
    n = int(draws.integers(1, 5))
    m, p = int(draws.integers(1, n + 1)), int(draws.integers(1, n + 1))
    A = draws.normal(size=(n, n))
    A *= draws.uniform(0.7, 1.15) / np.abs(np.linalg.eigvals(A)).max()
    noise, weight = draws.normal(size=(n, n)), draws.normal(size=(n, n))
    made = Plant(A, draws.normal(size=(n, m)), noise @ noise.T / n, draws.normal(size=(p, n)), 0.1 * np.eye(p))
    return made, Cost(weight @ weight.T / n + 0.1 * np.eye(n), 10 ** draws.uniform(-1, 1) * np.eye(m))


def ranking(seed: int, actuation: str, share: float) -> dict[str, Any]:
    """Return the cost of every rule that reaches the rate, with its standard error, over that of every sample."""
    made, cost = plant(seed)
    rules = {
        name: Problem(made, cost, Network(), kind, {**settings, "actuation": actuation})
        for name, (kind, settings) in RULES.items()
    }
    base, left_out, found = rules["excess"].design().cost_all_time, dict[str, str](), None
    while found is None and len(rules) > 1:
        try:
            found = taciturn.compare(rules, share, seed=seed, standard_error=PRECISION * base)
        except TaciturnError as error:
            name = str(error).split(":")[0]
            if name not in rules:
                raise
            left_out[name] = str(error)
            del rules[name]
    ranked = [] if found is None else found.ranking
    costs = {one.name: [one.cost.value / base, one.cost.standard_error / base] for one in ranked}
    growth = float(np.abs(np.linalg.eigvals(made.A)).max())
    return {
        "seed": seed,
        "actuation": actuation,
        "share": share,
        "growth": growth,
        "costs": costs,
        "left_out": left_out,
    }


def main() -> None:
    """Write the rankings."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="where to write the rankings")
    parser.add_argument("--plants", type=int, default=20)
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    if options.json and options.json.is_file():
        rows = json.loads(options.json.read_text(encoding="utf-8"))
    done = {(row["seed"], row["actuation"], row["share"]) for row in rows}
    for seed in range(options.plants):
        for case in itertools.product([seed], ("hold", "model"), SHARES):
            if case not in done:
                rows.append(ranking(*case))
                print(json.dumps(rows[-1]), flush=True)
                if options.json:
                    options.json.write_text(json.dumps(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
