"""Measure how fast this machine simulates the problem ``two-mass-lqg``, with Taciturn and with a NumPy program."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, cast

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Array, Progress, count, number, temporary_folder
from taciturn.loop import COST, EXCESS, Loop
from taciturn.model.result import VERDICT, Field, Tabular
from taciturn.model.steps import Assign
from taciturn.problem import load
from taciturn.program import machine
from taciturn.program.ir import Program
from taciturn.program.llvm import Build
from taciturn.program.machine import Kernel
from taciturn.program.ops import Control, Name, Sent
from taciturn.simulation.statistics import controlled_mean, mean

Contestant = Callable[[int], tuple[int, float]]
"""Function from a seed to the number of simulated steps and the rate of sending in them."""

PATHS, TICKS = 4096, 4000
MOST_ROUNDS = 1000  # about half an hour
SUMS = {COST, EXCESS, Sent("actuator")}
FULL, REDUCED, SINGLE, NUMPY = "full", "innovations", "innovations, float32", "NumPy over paths"


def _rounded(digits: int) -> Callable[[Mapping[str, float]], dict[str, float]]:
    return lambda numbers: {name: round(number, digits) for name, number in numbers.items()}


def _millions(row: tuple[str, float]) -> str:
    return f"{row[1] / 1e6:.4g}"


def _ratios(found: Bench) -> list[tuple[str, str]]:
    return [(name.replace("_", " "), f"{ratio:.3g}") for name, ratio in found.ratios.items()]


def _compiled(found: Bench) -> list[tuple[str, str]]:
    return [(f"machine code, {name}", f"{1000 * time:.3g} ms") for name, time in found.compile_seconds.items()]


def _variances(found: Bench) -> list[tuple[str, str]]:
    ratios = found.variance_ratios.items()
    return [(f"variance, {name}".replace("_", " "), f"{ratio:.3g} times less per step") for name, ratio in ratios]


@dataclass(frozen=True, repr=False)
class Bench(Tabular):
    """Measured speeds and ratios."""

    FIELDS: ClassVar[tuple[Field[Bench], ...]] = (
        VERDICT,
        Field("machine", say="", text=lambda found: list(found.machine.items()), part="method"),
        Field("speeds", key="steps_per_second", json=lambda speeds: {name: round(one) for name, one in speeds.items()}),
        Field("ratios", json=_rounded(4), say="", text=_ratios),
        Field("compile_seconds", json=_rounded(5), say="", text=_compiled),
        Field("variance_ratios", json=_rounded(2), say="", text=_variances),
    )
    heading: ClassVar[tuple[str, ...]] = ("machine", "ratios")

    machine: Mapping[str, str] = field(hash=False)  # processor, vector instructions and versions
    speeds: Mapping[str, float] = field(hash=False)  # steps per second of processor time on one thread, by contestant
    # ratios of these speeds, and the ratio of the wall times with one and with two threads
    ratios: Mapping[str, float] = field(hash=False)
    # compile times of the innovations form, without and with the cache on disk
    compile_seconds: Mapping[str, float] = field(hash=False)
    variance_ratios: Mapping[str, float] = field(hash=False)  # variance reductions of the estimators, per step

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentence that states the speed of the fastest program and names the processor of this machine."""
        name, speed = max(self.speeds.items(), key=lambda row: row[1])
        machine = f"{self.machine['processor']} ({self.machine['vectors']})"
        return (f"{speed / 1e6:.4g} million steps per second of the two-mass loop ({name}, one thread) on {machine}",)

    def table_rows(self) -> Sequence[tuple[str, float]]:
        """Return the rows of the table, one for each compared program with its speed."""
        return tuple(self.speeds.items())

    def row_fields(self) -> tuple[Field[tuple[str, float]], ...]:
        """Return the columns of the table: the name and the speed of each compared program."""
        return (
            Field("name", lambda row: row[0], column="name", say=""),
            Field("speed", lambda row: row[1], column="steps_per_second", say="million steps/s", text=_millions),
        )


def bench(rounds: int = 5, progress: Progress | None = None) -> Bench:
    """Measure how fast Taciturn simulates the two-mass loop, and how much its estimators reduce the variance."""
    rounds = count("rounds", rounds, 3)
    number("rounds", rounds, high=MOST_ROUNDS)
    if not machine.available():
        raise ProblemError(
            "llvmlite is not installed, but the compiled engine, which bench measures, requires it: pip install "
            "llvmlite"
        )
    loop = masses()
    speeds = {name: statistics.median(found) for name, found in race(contestants(loop), rounds, progress).items()}
    ratios = {
        "full_over_numpy": speeds[FULL] / speeds[NUMPY],
        "innovations_over_numpy": speeds[REDUCED] / speeds[NUMPY],
        "float32_over_float64": speeds[SINGLE] / speeds[REDUCED],
    }
    if machine.available_processors() > 1:
        ratios["two_threads_over_one"] = gain_of_threads(loop, rounds)
    return Bench(describe_machine(), speeds, ratios, compile_times(loop), variance_ratios(loop))


def masses() -> Loop:
    """Return the closed loop of the built-in problem ``two-mass-lqg``."""
    problem = load("two-mass-lqg")
    return problem.close(problem.design())


def contestants(loop: Loop) -> dict[str, Contestant]:
    """Return the programs whose simulation speed is compared, by name."""
    single = replace(loop, precision="float32")
    return {
        FULL: compiled(loop, loop.program()),
        REDUCED: compiled(loop, loop.reduced_program()),
        SINGLE: compiled(single, single.reduced_program()),
        NUMPY: by_matrices(loop, PATHS, TICKS // 40),
    }


def compiled(loop: Loop, program: Program, build: Build = "fast", ticks: int = TICKS) -> Contestant:
    """Return the simulation program that is compiled to machine code and runs on one thread."""
    kept = program.keep(SUMS)
    kernel, link = Kernel(kept, build), Sent(loop.policy.scheduled[0])

    def run(seed: int) -> tuple[int, float]:
        sums = kernel.run(kept, loop.start(kept, PATHS, seed), ticks, threads=1).sums
        return PATHS * ticks, float(sums[link].mean() / ticks)

    return run


def by_matrices(loop: Loop, paths: int, ticks: int) -> Contestant:
    """Return a simulation of the loop written in NumPy, for one or several paths, with which Taciturn is compared."""
    problem, plant, policy = loop.problem, loop.problem.plant, loop.policy
    A, B, C = plant.A, plant.B, plant.C
    steps = {step.signal: step.branches[0] for step in policy.steps if isinstance(step, Assign)}
    gain, L = (cast(Array, steps[a][b]) for a, b in (("estimate", "innovation"), ("command", "estimate")))
    silent, send = policy.decisions["send"].options.values()
    Psi, gamma = np.asarray(silent.Psi, dtype=np.float64), cast(float, send.constant)
    noise = [np.linalg.cholesky(covariance).T for covariance in (plant.W, plant.V)]

    def squares(z: Array, weight: Array) -> Array:
        return ((z @ weight) * z).sum(axis=1)

    def run(seed: int) -> tuple[int, float]:
        draws = np.random.default_rng(seed)
        x, prior = np.zeros((2, paths, plant.states))
        u, cost, sends = np.zeros((paths, plant.inputs)), np.zeros(paths), 0
        for _ in range(ticks):
            y = x @ C.T + draws.standard_normal((paths, plant.outputs)) @ noise[1]
            estimate = prior + (y - prior @ C.T) @ gain.T
            command = estimate @ L.T
            sending = squares(np.hstack([estimate, u, u - command]), Psi) > gamma
            u = np.where(sending[:, None], command, u)
            cost += squares(x, problem.Q) + squares(u, problem.R)
            sends += int(sending.sum())
            x = x @ A.T + u @ B.T + draws.standard_normal((paths, plant.states)) @ noise[0]
            prior = estimate @ A.T + u @ B.T
        return paths * ticks, sends / (paths * ticks)

    return run


def race(
    entries: Mapping[str, Contestant],
    rounds: int,
    progress: Progress | None = None,
    clock: Callable[[], float] = time.thread_time,
) -> dict[str, list[float]]:
    """Measure how many steps per second each program simulates, in several rounds after a warm-up round."""
    speeds: dict[str, list[float]] = {name: [] for name in entries}
    for k in range(rounds + 1):
        for name, run in entries.items():
            begin = clock()
            steps, _ = run(k)
            if k:
                speeds[name].append(steps / (clock() - begin))
        if progress is not None:
            progress((k + 1) / (rounds + 1))
    return speeds


def gain_of_threads(loop: Loop, rounds: int) -> float:
    """Measure how much faster a simulation is on two threads than on one, as the median of several rounds."""
    program = loop.reduced_program().keep({EXCESS})
    kernel, states = Kernel(program), loop.start(program, PATHS, 0)
    found: list[float] = []
    for _ in range(rounds + 1):
        times: list[float] = []
        for threads in (1, 2):
            begin = time.perf_counter()
            kernel.run(program, states, 5 * TICKS, threads=threads)
            times.append(time.perf_counter() - begin)
        found.append(times[0] / times[1])
    return statistics.median(found[1:])


def compile_times(loop: Loop) -> dict[str, float]:
    """Measure compile times in seconds, without and with the cache on disk, as medians of five compilations."""
    program, cold, cached = loop.reduced_program().keep(SUMS), list[float](), list[float]()
    before = os.environ.get("XDG_CACHE_HOME")
    try:
        for _ in range(5):
            with temporary_folder() as empty:
                os.environ["XDG_CACHE_HOME"] = str(empty)
                for found in (cold, cached):
                    machine.forget()
                    begin = time.perf_counter()
                    Kernel(program)
                    found.append(time.perf_counter() - begin)
    finally:
        os.environ.pop("XDG_CACHE_HOME")
        os.environ |= {} if before is None else {"XDG_CACHE_HOME": before}
    return {"cold": statistics.median(cold), "cached": statistics.median(cached)}


def variance_ratios(loop: Loop) -> dict[str, float]:
    """Return the factors by which completed squares and control variates reduce the variance of the estimated cost."""
    full, reduced = loop.program().keep({COST}), loop.reduced_program()
    controls = [name for name in reduced.sums if isinstance(name, Control)]
    plain, squares = (_settled_sums(loop, program) for program in (full, reduced.keep({EXCESS, *controls})))
    alone = mean(squares[EXCESS]).standard_error
    sharp = controlled_mean(squares[EXCESS], np.array([squares[name] for name in controls])).standard_error
    return {
        "completed_squares": (mean(plain[COST]).standard_error / alone) ** 2,
        "control_variates": (alone / sharp) ** 2,
    }


def _settled_sums(loop: Loop, program: Program) -> Mapping[Name, Array]:
    """Return the sums of each path over the same number of steps, after a burn-in."""
    kernel = Kernel(program)
    settled = kernel.run(program, loop.start(program, PATHS, 1), 600).states
    return kernel.run(program, settled, TICKS // 2).sums


def describe_machine() -> dict[str, str]:
    """Return the name of the processor, its vector instructions, and the versions of the packages used."""
    name = platform.processor() or platform.machine()
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        name = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    widths: Mapping[int, str] = {8: "avx512", 4: "avx2", 2: "baseline"}
    packages = ("taciturn", "numpy", "scipy", "llvmlite")
    return {
        "processor": name,
        "processors": str(machine.available_processors()),
        "vectors": widths[machine.host().lanes],
        "system": f"{platform.system()} {platform.release()}",
        "date": time.strftime("%Y-%m-%d"),
        "python": platform.python_version(),
        **{package: version(package) for package in packages},
    }


def version(package: str) -> str:
    """Return the version of an installed package, or "none" if it is not installed."""
    with suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version(package)
    return "none"
