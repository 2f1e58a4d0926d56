"""Every way to simulate the two-mass loop, side by side in one run on one core.

    pip install -e '.[bench]'
    python benchmarks/run.py [--rounds 7] [--json docs/benchmarks.json]

Contestants run in turn, so that a busy machine slows them alike; medians of processor time. Those that are not
installed are named and left out. Import, compilation and memory are measured in a process of their own for each.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # their idle threads run in circles

import numpy as np
from engine import answers, chapters, many_loops, memory, policies
from limit import Limit
from others import Data, control_steps, jax_scan, numba_loop

from taciturn import Cost, Plant, close, design
from taciturn.loop import Loop
from taciturn.program.draws import seed_generators, with_draws
from taciturn.program.ir import Builder, Program
from taciturn.program.machine import Kernel
from taciturn.program.ops import Entry
from taciturn_bench import bench
from taciturn_bench.bench import PATHS, TICKS, Contestant, by_matrices, compiled, race

HAND_FULL, HAND_REDUCED = "C++ by hand, full", "C++ by hand, innovations"
JAX_FULL, JAX_REDUCED = "JAX scan, full", "JAX scan, innovations"
NEWCOMER = "NumPy, path by path"
SAME = {  # what runs the same law in the same form, by hand and in JAX
    "full": (HAND_FULL, JAX_FULL),
    "innovations": (HAND_REDUCED, JAX_REDUCED),
}


def factories(loop: Loop) -> dict[str, Callable[[], Contestant]]:
    """Return what makes each contestant, by name; it raises where something is not installed."""
    single, data = replace(loop, precision="float32"), Data(loop)

    def by_hand(form: str) -> Contestant:
        code = Limit(loop)
        return lambda seed: (PATHS * TICKS, code.run(form, seed, PATHS, TICKS)[1])

    return {
        bench.FULL: lambda: compiled(loop, loop.program()),
        bench.REDUCED: lambda: compiled(loop, loop.reduced_program()),
        "full, float32": lambda: compiled(single, single.program()),
        bench.SINGLE: lambda: compiled(single, single.reduced_program()),
        "innovations, bit-exact build": lambda: compiled(loop, loop.reduced_program(), "parity"),
        HAND_FULL: lambda: by_hand("full"),
        HAND_REDUCED: lambda: by_hand("innovations"),
        "C++ by hand, innovations, two blocks at once": lambda: by_hand("innovations_paired"),
        "numba loop": lambda: numba_loop(data),
        JAX_FULL: lambda: jax_scan(data, "full"),
        JAX_REDUCED: lambda: jax_scan(data, "innovations"),
        bench.NUMPY: lambda: by_matrices(loop, PATHS, 200),
        NEWCOMER: lambda: by_matrices(loop, 1, 4000),
        "python-control, step by step": lambda: control_steps(data),
    }


def present(makers: Mapping[str, Callable[[], Contestant]]) -> dict[str, Contestant]:
    """Return those that are installed; name the others."""
    found: dict[str, Contestant] = {}
    for name, make in makers.items():
        try:
            found[name] = make()
        except (ImportError, OSError, subprocess.CalledProcessError) as error:
            print(f"LEFT OUT: {name} ({error})", file=sys.stderr)
    return found


def alone(name: str) -> dict[str, float]:
    """Return the import, compilation and memory of a contestant, from a new process with an empty cache."""
    with tempfile.TemporaryDirectory() as empty:
        environment = {**os.environ, "XDG_CACHE_HOME": empty}
        command = [sys.executable, __file__, "--alone", name]
        answer = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    found: dict[str, float] = json.loads(answer.stdout.splitlines()[-1])
    return found


def measure_alone(name: str) -> None:
    """Print what one contestant takes; it runs in this process."""
    modules = {"numba": "numba", "JAX": "jax", "python-control": "control", "NumPy": "numpy", "C++": "ctypes"}
    ours = "taciturn.study.evaluate, llvmlite.binding"
    library = modules.get(name.replace(",", "").split()[0], ours)
    code = f"import time; t = time.perf_counter(); import {library}; print(time.perf_counter() - t)"
    imported = [
        float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
        for _ in range(3)
    ]
    begin = time.perf_counter()
    run = factories(bench.masses())[name]()
    run(0)
    first = time.perf_counter() - begin
    begin = time.perf_counter()
    run(1)
    peak = peak_megabytes()
    compile_time = max(0.0, first - (time.perf_counter() - begin))
    print(json.dumps({"import": statistics.median(imported), "compile": compile_time, "peak_megabytes": peak}))


def peak_megabytes() -> float:
    """Return the most memory this process has held; the usual count of the system starts from that of its parent."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(float(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))


def normals(loop: Loop, rounds: int) -> dict[str, float]:
    """Return normals per second of one thread: drawn by the engine, by NumPy, and by hand."""
    found: dict[str, Contestant] = {}
    for name, precision in (("engine", "float64"), ("engine, float32", "float32")):
        b = Builder(precision)
        pair = [b.input(Entry("normal", i)) for i in range(2)]
        square = b.add(*(b.emit("mul", n, n) for n in pair))
        total = b.add(*pair)
        assert square is not None
        assert total is not None
        program = with_draws(b.finish([], {"sum": total, "squares": square}))
        found[name] = _drawing(program)
    numpy_draws = np.empty(PATHS * 100)

    def by_numpy(seed: int) -> tuple[int, float]:
        draws = np.random.default_rng(seed)
        for _ in range(20):
            draws.standard_normal(out=numpy_draws)
        return 20 * len(numpy_draws), 0.0

    found["NumPy"] = by_numpy
    code = present({"C++ by hand": lambda: _hand_draws(loop)})
    return {name: statistics.median(speeds) for name, speeds in race({**found, **code}, rounds).items()}


def _hand_draws(loop: Loop) -> Contestant:
    code = Limit(loop)
    return lambda seed: (2 * PATHS * TICKS, code.run("draws", seed, PATHS, TICKS)[0])


def _drawing(program: Program) -> Contestant:
    kernel = Kernel(program)

    def run(seed: int) -> tuple[int, float]:
        kernel.run(program, seed_generators(seed, PATHS), TICKS, threads=1)
        return 2 * PATHS * TICKS, 0.0

    return run


def growth(loop: Loop) -> list[dict[str, float]]:
    """Return compile time and operations per second of random loops of many states, next to the peak of one core."""
    peak: float | None = None
    try:
        code = Limit(loop)
        begin = time.process_time()
        code.run("peak", 0, PATHS, 20 * TICKS)
        peak = 12 * 2 * PATHS * 20 * TICKS / (time.process_time() - begin)
    except (OSError, subprocess.CalledProcessError) as error:
        print(f"LEFT OUT: peak ({error})", file=sys.stderr)
    rows: list[dict[str, float]] = []
    for n, m, p in ((4, 1, 2), (8, 1, 3), (18, 2, 5), (38, 2, 8)):  # with the inputs 5, 9, 20 and 40
        draws = np.random.default_rng(n)
        A = draws.normal(size=(n, n))
        A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
        plant = Plant(A, draws.normal(size=(n, m)), 0.01 * np.eye(n), draws.normal(size=(p, n)), 0.01 * np.eye(p))
        large = close(plant, design.lqg(plant, Cost(np.eye(n), np.eye(m)), theta=0.1))
        for form, program in (("full", large.program()), ("innovations", large.reduced_program())):
            kept = program.keep(bench.SUMS)
            begin = time.perf_counter()
            with tempfile.TemporaryDirectory() as empty:
                os.environ["XDG_CACHE_HOME"] = empty
                kernel = Kernel(kept)
                del os.environ["XDG_CACHE_HOME"]
            compile_time = time.perf_counter() - begin
            ticks, states = max(20, int(1.5e9 / kept.operations / PATHS)), large.start(kept, PATHS, 0)
            kernel.run(kept, states, 2, threads=1)
            begin = time.process_time()
            kernel.run(kept, states, ticks, threads=1)
            speed = PATHS * ticks / (time.process_time() - begin)
            rows.append({
                "n_z": n + m, "form": form, "operations": kept.operations, "compile": compile_time,
                "products": len(kept.matrices), "steps": speed, "operations_per_second": speed * kept.operations,
                "share_of_peak": None if peak is None else speed * kept.operations / peak,
            })  # fmt: skip
    return rows


def report(found: Mapping[str, Any]) -> None:
    """Print the main table."""
    print(f"{'':46}{'Msteps/s':>10}{'spread':>20}{'rate':>8}{'compile':>9}{'memory':>9}{'to 1e-4':>10}")
    for name, row in found["contestants"].items():
        spread = f"{row['slowest'] / 1e6:.4g} – {row['fastest'] / 1e6:.4g}"
        seconds = found["answers"]["seconds_by_plain_average"][name]
        print(
            f"{name:46}{row['steps_per_second'] / 1e6:10.4g}{spread:>20}{row['rate']:8.3f}"
            f"{row['compile']:8.2f}s{row['peak_megabytes']:6.0f} MB{seconds:9.3g}s"
        )
    for name in ("ratios", "variance_ratios", "compile_seconds", "normals", "many_loops", "memory"):
        print(name, json.dumps({key: round(value, 5) for key, value in found[name].items()}))
    print("answers", json.dumps({k: v for k, v in found["answers"].items() if not isinstance(v, dict)}))
    for row in found["growth"] + found["chapters"] + found["policies"]:
        print(json.dumps(row))


def main() -> None:
    """Run everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--alone", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.rounds < 1:
        parser.error(f"--rounds is {options.rounds}; expected at least 1")
    if options.alone:
        measure_alone(options.alone)
        return
    processors = os.sched_getaffinity(0)
    loop = bench.masses()
    threads = bench.gain_of_threads(loop, options.rounds) if len(processors) > 1 else None
    os.sched_setaffinity(0, {max(processors)})  # pinned, before any library starts its threads
    entries = present(factories(loop))
    rates = {name: statistics.mean(run(1000 + k)[1] for k in range(3)) for name, run in entries.items()}
    speeds = race(entries, options.rounds, clock=time.process_time)  # JAX has threads of its own
    medians = {name: statistics.median(values) for name, values in speeds.items()}
    ratios = {"float32_over_float64": medians[bench.SINGLE] / medians[bench.REDUCED]}
    ratios["float32_over_float64_full"] = medians["full, float32"] / medians[bench.FULL]
    for form, (hand, jax) in SAME.items():
        for other, label in ((hand, "C++"), (jax, "JAX"), (bench.NUMPY, "NumPy"), (NEWCOMER, "newcomer")):
            if other in medians:
                ratios[f"{form}_over_{label}"] = medians[form] / medians[other]
    if threads is not None:
        ratios["two_threads_over_one"] = threads
    drawn, chapter_rows, grown = normals(loop, options.rounds), chapters(options.rounds), growth(loop)
    os.sched_setaffinity(0, processors)
    table = {
        name: {
            "steps_per_second": medians[name], "slowest": min(values), "fastest": max(values), "rate": rates[name],
            **alone(name),
        }
        for name, values in speeds.items()
    }  # fmt: skip
    libraries = ("numba", "jax", "jaxlib", "control")
    found = {
        "machine": {**bench.describe_machine(), **{name: bench.version(name) for name in libraries}},
        "contestants": table,
        "ratios": ratios,
        "variance_ratios": bench.variance_ratios(loop),
        "compile_seconds": bench.compile_times(loop),
        "normals": drawn,
        "growth": grown,
        "chapters": chapter_rows,
        "answers": answers(loop, medians),
        "policies": policies(),
        "many_loops": many_loops(),
        "memory": memory(),
    }
    report(found)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
