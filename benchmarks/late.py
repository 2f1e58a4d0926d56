"""The engine on the two-mass loop over a link that delays packets by up to two steps, against C++ by hand.

    python benchmarks/late.py [--rounds 7] [--json docs/late.json]

Both simulate the same law with plant, filter and a ring of three packets, in turn on one core; medians of processor
time. The mean costs of both are compared, so that a fast wrong loop does not win.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
from pathlib import Path
from typing import Any

os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # their idle threads run in circles

from limit import Limit

from taciturn import Network, average, close
from taciturn.loop import Loop
from taciturn.model.link import LinkLaw
from taciturn_bench import bench
from taciturn_bench.bench import PATHS, TICKS, compiled, race

DELAYS = [0.6, 0.25, 0.1]  # of 0, 1 and 2 steps; the rest is lost
ENGINE, HAND, PROMPT = "engine, late", "C++ by hand, late", "engine, without delays"


def late_loop() -> Loop:
    """Return the two-mass loop over a link with random delays."""
    prompt = bench.masses()
    network = Network(links={"actuator": LinkLaw(delay=DELAYS)})  # type: ignore[arg-type]
    return close(prompt.problem.plant, prompt.policy, network, prompt.problem.cost)


def processor() -> str:
    """Return the name of the processor."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())


def main() -> None:
    """Race, print, and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    loop = late_loop()
    code = Limit(loop)
    contestants = {
        ENGINE: compiled(loop, loop.program()),
        HAND: lambda seed: (PATHS * TICKS, code.run("late", seed, PATHS, TICKS)[1]),
        PROMPT: compiled(bench.masses(), bench.masses().program()),
    }
    speeds = {name: statistics.median(values) for name, values in race(contestants, options.rounds).items()}
    by_hand = code.run("late", 7, PATHS, 40 * TICKS)[0]
    ours = average(loop, steps=4_000_000).cost
    found: dict[str, Any] = {
        "processor": processor(),
        "steps per second": speeds,
        "ratio": speeds[ENGINE] / speeds[HAND],
        "costs per second": {ENGINE: [ours.value, ours.standard_error], HAND: by_hand / loop.policy.tick},
    }
    print(json.dumps(found, indent=2))
    if options.json:
        options.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
