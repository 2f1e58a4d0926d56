"""How long a command takes from its start, next to the import of NumPy and SciPy's linear algebra.

Processes take turns; byte code and compiled programs are there, as in daily use. Processor and wall time, medians. The
linear algebra of NumPy has one thread, since the processor time of its idle threads would count.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path

from taciturn_bench.bench import describe_machine

IMPORT = "python -c 'import numpy, scipy.linalg'"
ANSWER = "import taciturn; taciturn.evaluate(taciturn.load('two-mass-lqg'), standard_error=1e-4)"
COMMAND = ["evaluate", "two-mass-lqg", "--standard-error", "1e-4"]
COMMANDS = {
    IMPORT: ["-c", "import numpy, scipy.linalg"],
    "python: taciturn.evaluate, standard error 1e-4": ["-c", ANSWER],
    "taciturn --help": ["-m", "taciturn", "--help"],
    f"taciturn {' '.join(COMMAND)}": ["-m", "taciturn", *COMMAND],
}


def seconds(arguments: list[str]) -> tuple[float, float]:
    """Return the processor and wall time of a new Python."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    environment |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([sys.executable, *arguments], env=environment, stdout=subprocess.DEVNULL, check=True)
    wall, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, wall


def measure(rounds: int) -> dict[str, dict[str, float]]:
    """Return, for each command, its seconds and how many times those of the import they are, round by round."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in COMMANDS}
    for _ in range(rounds + 1):  # the first round fills the caches
        for name, arguments in COMMANDS.items():
            found[name].append(seconds(arguments))
    table: dict[str, dict[str, float]] = {}
    for name, times in found.items():
        table[name] = {}
        for k, clock in enumerate(("processor", "wall")):
            ratios = [ours[k] / theirs[k] for ours, theirs in zip(times[1:], found[IMPORT][1:], strict=True)]
            table[name][clock] = statistics.median(one[k] for one in times[1:])
            table[name][f"{clock}_ratio"] = statistics.median(ratios)
    return table


def main() -> None:
    """Measure, print, and keep."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    found = {"machine": describe_machine(), "commands": measure(options.rounds)}
    for name, row in found["commands"].items():
        print(f"{name}: " + ", ".join(f"{key} {value:.3f}" for key, value in row.items()))
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
