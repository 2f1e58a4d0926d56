"""What a channel costs to compute: processor time and memory over the number of loops, equal and different.

    python benchmarks/loops.py [--json docs/loops.json] [--name after] [--source src] [--only different]

A run is a process of its own without workers; it ends after so many seconds of processor time. Loops are those of
random plants with three states, stable and unstable, with a slot for every fifth loop. Runs that are in the file
already are kept. Another state of the code is measured by the path to its ``src``.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

SIZES = (2, 10, 40, 100, 1000)
LIMIT = 150  # seconds of processor time
CHILD = "--run"


def problem(seed: int) -> Any:
    """Return a random plant with three states and a cost."""
    import numpy as np

    from taciturn import Cost, Network, Plant, Problem

    draws = np.random.default_rng(seed)
    A = draws.standard_normal((3, 3))
    A *= draws.uniform(0.8, 1.15) / np.abs(np.linalg.eigvals(A)).max()
    B, root = draws.standard_normal((3, 1)), draws.standard_normal((3, 3))
    W = root @ root.T / 3 + 0.05 * np.eye(3)
    return Problem(Plant(A, B, W), Cost(np.eye(3), [[float(draws.uniform(0.1, 1))]]), Network(), "all-time", {})


def share(loops: int, different: bool) -> None:
    """Share a channel among loops, and print what that took."""
    import taciturn

    problems = {f"plant {i}": problem(i) for i in range(loops if different else 1)}
    found = taciturn.share_channel(problems, copies=1 if different else loops, capacity=max(1, loops // 5))
    used = resource.getrusage(resource.RUSAGE_SELF)
    bound = found.lower_bound
    assert bound is not None
    print(
        json.dumps(
            {
                "seconds": used.ru_utime + used.ru_stime,
                "megabytes": used.ru_maxrss / 1024,
                "cost": found.cost.document(),
                "bound": bound.cost,
                "price": found.price,
            }
        )
    )


def measure(source: Path, loops: int, different: bool) -> dict[str, Any]:
    """Return what a run took, or that it did not end."""
    environment = {**os.environ, "PYTHONPATH": str(source), "OPENBLAS_NUM_THREADS": "1"}
    kind = "different" if different else "copies"
    run = subprocess.run(
        [sys.executable, __file__, CHILD, kind, str(loops)],
        env=environment,
        stdout=subprocess.PIPE,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (LIMIT, LIMIT)),
        check=False,
    )
    row = {"kind": kind, "loops": loops, "limit": LIMIT}
    if run.returncode in (-signal.SIGKILL, -signal.SIGXCPU):
        return row
    if run.returncode:
        raise SystemExit(f"{kind} {loops}: the run ended with {run.returncode}; expected 0, or the limit of its time")
    return row | json.loads(run.stdout)


def main() -> None:
    """Fill the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, default=Path("docs/loops.json"))
    parser.add_argument("--name", default="after", help="of this state of the code, in the file")
    parser.add_argument("--source", type=Path, default=Path(__file__).parent.parent / "src")
    parser.add_argument("--only", choices=["copies", "different"], help="one kind of loops")
    parser.add_argument("--most", type=int, default=SIZES[-1], help="loops")
    given = parser.parse_args()
    done: dict[str, Any] = json.loads(given.json.read_text()) if given.json.exists() else {}
    for kind in [given.only] if given.only else ["copies", "different"]:
        for loops in SIZES:
            name = f"{given.name} {kind} {loops}"
            if name not in done and loops <= given.most:
                done[name] = measure(given.source.resolve(), loops, kind == "different")
                given.json.write_text(json.dumps(done, indent=1) + "\n", encoding="utf-8")
                print(name, done[name], flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == [CHILD]:
        share(int(sys.argv[3]), sys.argv[2] == "different")
    else:
        main()
