"""The engine alone: loops of other chapters, the seconds to an answer, many loops at once, memory."""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import taciturn
from taciturn import ContinuousPlant, Cost, Jumps, close, design
from taciturn.loop import COST, Loop
from taciturn.model.policy import Policy
from taciturn.program import numpy as interpreter
from taciturn.program.ir import Program
from taciturn.program.machine import Kernel
from taciturn.program.ops import Sent
from taciturn.simulation.bank import Bank
from taciturn.simulation.statistics import mean
from taciturn_bench.bench import PATHS, Contestant, race

WANTED = 1e-4  # relative standard error of the cost


def chapters(rounds: int) -> list[dict[str, Any]]:
    """Return the speed on loops like those of chapters 3, 4 and 6, against the same operations in NumPy."""
    plant = ContinuousPlant([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], jumps=Jumps(1.0, np.eye(2)))
    jumping = close(plant, design.integral(plant, Cost(np.eye(2), [[0.1]]), slope=1.2, period=0.05))
    loops = {"remote sensing (chapter 3)": "remote-double-integrator", "remote sensing, a mission (chapter 6)": "rover"}
    known = {name: taciturn.load(file) for name, file in loops.items()}
    rows: list[dict[str, Any]] = []
    for name, loop in {
        **{name: problem.close(problem.design()) for name, problem in known.items()},
        "integral trigger under jumps, looked at (chapter 4)": jumping,
    }.items():
        program = loop.program().keep({COST, *(Sent(link) for link in loop.policy.scheduled)})
        found = race({"engine": _by_engine(loop, program), "NumPy": _by_numpy(loop, program)}, rounds)
        speeds = {key: statistics.median(values) for key, values in found.items()}
        rows.append({"loop": name, "operations": program.operations, **speeds})
    return rows


def _by_engine(loop: Loop, program: Program) -> Contestant:
    kernel, ticks = Kernel(program), min(loop.horizon or 1000, 1000)

    def run(seed: int) -> tuple[int, float]:
        for k in range(2000 // ticks):
            kernel.run(program, loop.start(program, PATHS, seed + k), ticks, threads=1)
        return PATHS * ticks * (2000 // ticks), 0.0

    return run


def _by_numpy(loop: Loop, program: Program) -> Contestant:
    ticks = min(loop.horizon or 20, 20)

    def run(seed: int) -> tuple[int, float]:
        interpreter.run(program, loop.start(program, PATHS, seed), ticks)
        return PATHS * ticks, 0.0

    return run


def answers(loop: Loop, speeds: Mapping[str, float]) -> dict[str, Any]:
    """Return the seconds to a cost that is known to 1e-4: ours measured, the others' from their speed."""
    program = loop.program().keep({COST})
    kernel = Kernel(program)
    settled = kernel.run(program, loop.start(program, PATHS, 1), 600).states
    per_path = kernel.run(program, settled, 20_000).sums[COST] / 20_000
    found = mean(per_path)
    steps = (found.standard_error / (WANTED * found.value)) ** 2 * PATHS * 20_000
    code = (
        "import time; t = time.perf_counter(); import taciturn; p = taciturn.load('two-mass');"
        "import taciturn.study.evaluate, taciturn.program.machine, llvmlite.binding; u = time.perf_counter();"
        "e = taciturn.evaluate(p); assert e.reached; print(u - t, time.perf_counter() - u)"
    )
    whole: list[float] = []
    parts: list[tuple[float, float]] = []
    for _ in range(7):
        begin = time.perf_counter()
        answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        whole.append(time.perf_counter() - begin)
        imports, evaluation = map(float, answer.stdout.split())
        parts.append((imports, evaluation))
    return {
        "steps_of_the_plain_average": steps,
        "seconds_by_plain_average": {name: steps / speed for name, speed in speeds.items()},
        "process_start_to_answer": statistics.median(whole),
        "of_which_imports": statistics.median(imports for imports, _ in parts),
        "of_which_evaluation": statistics.median(evaluation for _, evaluation in parts),
    }


def policies() -> list[dict[str, Any]]:
    """Return, for every built-in problem, the seconds to 1e-4 of the cost and what most of them go into."""
    rows: list[dict[str, Any]] = []
    for path in sorted((Path(taciturn.__file__).parent / "problems").glob("*.toml")):
        problem = taciturn.load(path.stem)
        taciturn.evaluate(problem)  # compiled before, as in daily use
        begin = time.perf_counter()
        policy = problem.designed()
        designed = time.perf_counter() - begin
        found = taciturn.evaluate(problem)
        loop = problem.close(policy) if isinstance(policy, Policy) else None
        burn_in = 0.0
        if loop is not None and loop.horizon is None and found.steps:
            run = taciturn.average(loop, steps=found.steps)
            burn_in = run.burn_in * PATHS / found.steps
        terms = {
            "design": designed,
            "burn-in": burn_in * (found.seconds - designed),
            "exact solution" if found.steps == 0 else "sampling": (1 - burn_in) * (found.seconds - designed),
        }
        rows.append({
            "problem": path.stem, "policy": found.policy, "method": found.cost.method, "seconds": found.seconds,
            "steps": found.steps, "reached": found.reached, "limited_by": max(terms, key=lambda term: terms[term]),
        })  # fmt: skip
    return rows


def memory() -> dict[str, float]:
    """Return the peak memory in megabytes of processes that run 1e7 and 1e9 steps."""
    code = (
        "import sys, taciturn; p = taciturn.load('two-mass');"
        "taciturn.evaluate(p, steps=int(float(sys.argv[1])));"
        "print(next(l.split()[1] for l in open('/proc/self/status') if l.startswith('VmHWM')))"
    )
    found: dict[str, float] = {}
    for steps in ("1e7", "1e9"):
        answer = subprocess.run([sys.executable, "-c", code, steps], capture_output=True, text=True, check=True)
        found[steps] = float(answer.stdout) / 1024
    return found


def many_loops() -> dict[str, float]:
    """Return what a step of ten thousand loops takes, with a hundred values of theta among them."""
    problem = taciturn.load("two-mass-lqg")
    begin = time.perf_counter()
    loops = [problem.close(problem.changed({"theta": float(t)}).design()) for t in np.linspace(0.05, 1, 100)]
    designed = (time.perf_counter() - begin) / 100
    bank = Bank(loops * 100)
    bank.run()
    times: list[float] = []
    for _ in range(21):
        begin = time.perf_counter()
        bank.run()
        times.append(time.perf_counter() - begin)
    return {
        "design_and_close": designed,
        "structures": bank.structures,
        "tick_of_ten_thousand": statistics.median(times),
    }
