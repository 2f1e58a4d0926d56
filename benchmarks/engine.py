"""Steps per second of the two-mass loop on one thread, against NumPy as one would write it.

    python benchmarks/engine.py [--rounds 7] [--json FILE]

Every contestant runs once per round, in turn, so that a busy machine slows them alike; medians of processor time are
printed with their ratio to NumPy over paths (4096 at once suit it best). All simulate the same law from the same start:
the rates of sending printed beside agree to the first ticks and standard errors.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

import taciturn
from taciturn.loop import Loop
from taciturn.program import numpy as interpreter
from taciturn.program._llvm_body import Build
from taciturn.program.ir import Program
from taciturn.program.machine import Kernel

Contestant = Callable[[int], tuple[int, float]]  # a seed → steps, and the rate of sending
REFERENCE = "NumPy over paths"


def compiled(loop: Loop, program: Program, build: Build) -> Contestant:
    """Return the contestant that runs machine code."""
    kept = program.keep({"cost", "excess", "sent actuator"})
    kernel, paths, ticks = Kernel(kept, build), 4096, 4000

    def run(seed: int) -> tuple[int, float]:
        sums = kernel.run(kept, loop.start(kept, paths, seed), ticks, threads=1).sums
        return paths * ticks, float(sums["sent actuator"].mean() / ticks)

    return run


def interpreted(loop: Loop, program: Program) -> Contestant:
    """Return the contestant that runs the program where llvmlite is missing."""
    kept = program.keep({"cost", "excess", "sent actuator"})
    paths, ticks = 4096, 400

    def run(seed: int) -> tuple[int, float]:
        sums = interpreter.run(kept, loop.start(kept, paths, seed), ticks).sums
        return paths * ticks, float(sums["sent actuator"].mean() / ticks)

    return run


def plain(loop: Loop, paths: int, ticks: int) -> Contestant:
    """Return the contestant of matrices and NumPy's generator: all paths side by side, or one alone."""
    problem, plant, policy = loop.problem, loop.problem.plant, loop.policy
    A, B, C = plant.A, plant.B, plant.C
    steps = {step.signal: step.branches for step in policy.steps if hasattr(step, "signal")}
    gain, L = steps["estimate"][0]["innovation"], steps["command"][0]["estimate"]
    silent, send = policy.decisions["send"].options.values()
    noise = [np.linalg.cholesky(covariance).T for covariance in (plant.W, plant.V)]

    def run(seed: int) -> tuple[int, float]:
        draws = np.random.default_rng(seed)
        x, prior = np.zeros((2, paths, 4))
        u, cost, sends = np.zeros((paths, 1)), np.zeros(paths), 0
        for _ in range(ticks):
            y = x @ C.T + draws.standard_normal((paths, 2)) @ noise[1]
            estimate = prior + (y - prior @ C.T) @ gain.T
            command = estimate @ L.T
            z = np.hstack([estimate, u, u - command])
            sending = ((z @ silent.Psi) * z).sum(axis=1) > send.constant
            u = np.where(sending[:, None], command, u)
            cost += ((x @ problem.Q) * x).sum(axis=1) + ((u @ problem.R) * u).sum(axis=1)
            sends += int(sending.sum())
            x = x @ A.T + u @ B.T + draws.standard_normal((paths, 4)) @ noise[0]
            prior = estimate @ A.T + u @ B.T
        return paths * ticks, sends / (paths * ticks)

    return run


def contestants() -> Mapping[str, Contestant]:
    """Return what is compared, by name."""
    problem = taciturn.load("two-mass")
    loop = problem.close(problem.design())
    full, reduced = loop.program(), loop.reduced_program()
    return {
        "full, fast build": compiled(loop, full, "fast"),
        "full, parity build": compiled(loop, full, "parity"),
        "reduced, fast build": compiled(loop, reduced, "fast"),
        "reduced, parity build": compiled(loop, reduced, "parity"),
        "full, interpreted by NumPy": interpreted(loop, full),
        "reduced, interpreted by NumPy": interpreted(loop, reduced),
        REFERENCE: plain(loop, 4096, 400),
        "NumPy path by path": plain(loop, 1, 5000),
    }


def main() -> None:
    """Run the rounds and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    entries = contestants()
    speeds: dict[str, list[float]] = {name: [] for name in entries}
    rates: dict[str, list[float]] = {name: [] for name in entries}
    for seed in range(options.rounds + 1):
        for name, run in entries.items():
            begin = time.process_time()
            steps, rate = run(seed)
            if seed:  # the first round warms up
                speeds[name].append(steps / (time.process_time() - begin))
                rates[name].append(rate)
    medians = {name: statistics.median(values) for name, values in speeds.items()}
    print(f"{'':32}{'Msteps/s':>10}{'spread':>16}{'ratio':>9}{'rate':>8}")
    for name, values in speeds.items():
        spread = f"{min(values) / 1e6:.4g} – {max(values) / 1e6:.4g}"
        ratio = medians[name] / medians[REFERENCE]
        print(f"{name:32}{medians[name] / 1e6:10.4g}{spread:>16}{ratio:9.3g}{statistics.mean(rates[name]):8.3f}")
    if options.json:
        table = {name: {"steps_per_second": medians[name], "rate": statistics.mean(rates[name])} for name in entries}
        options.json.write_text(json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main()
