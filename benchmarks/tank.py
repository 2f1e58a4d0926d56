"""Steps per second on quadruple-tank: the engine, and the same law written by hand in C, in one run.

    python benchmarks/tank.py [--rounds 5]

All run the innovations form on one thread. The program by hand draws its normal numbers with the vector mathematics of
glibc, or with the shorter polynomials of the engine. The costs and rates must agree within four standard errors, and
the ratios of the speeds are medians over rounds in alternating order.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

import taciturn
from taciturn.base.certainty import design_certainty
from taciturn.loop import EXCESS
from taciturn.lqg.discrete import discretise
from taciturn.lqg.kalman import steady_filter
from taciturn.program import draws
from taciturn.program.machine import Kernel
from taciturn.program.ops import Sent
from taciturn_bench.bench import describe_machine

SOURCE = Path(__file__).with_name("tank_by_hand.c")
FLAGS = ["-O3", "-march=native", "-mprefer-vector-width=512", "-ffast-math", "-std=gnu11", "-shared", "-fPIC"]
PATHS, TICKS = 4096, 2000


def numbers(problem: taciturn.Problem) -> str:
    """Return the matrices of the loop as a header."""
    policy = problem.design()
    discrete = discretise(problem.plant, problem.cost, policy.tick)
    certainty = design_certainty("distributed", discrete)
    plant, L, gain = discrete.plant, certainty.regulator.L, certainty.filter.gain
    closed = plant.A + plant.B @ L
    W = plant.W + plant.B @ L @ certainty.filter.posterior @ L.T @ plant.B.T
    local = [steady_filter(closed, plant.C[[s]], W, plant.V[[s]][:, [s]]).gain[:, 0] for s in range(plant.outputs)]
    kept = [(np.eye(plant.states) - np.outer(one, plant.C[s])) @ closed for s, one in enumerate(local)]
    share = problem.parameters["theta"] * certainty.cost_all_time / 16
    arrays = {
        "A": plant.A, "B": plant.B, "C": plant.C.ravel(), "G": gain, "L": L, "H": certainty.regulator.H,
        "ROOT": np.linalg.cholesky(certainty.filter.innovation).ravel(), "CLOSED": closed,
        "OMEGA": (np.eye(plant.states) - gain @ plant.C) @ plant.A, "LOCAL": np.array(local), "KEPT": np.array(kept),
        "DELTA": np.full(4, share),
    }  # fmt: skip
    arrays |= {
        "INVERSES": np.array(draws._INVERSES), "LOGARITHMS": 2 * np.log(draws._INVERSES),
        "MINUS_TWO_LOG": np.array(draws._MINUS_TWO_LOG), "COS": np.array(draws._COS), "SIN": np.array(draws._SIN),
    }  # fmt: skip
    sizes = {"N": plant.states, "S": plant.outputs, "M": plant.inputs}
    lines = [f"enum {{ {', '.join(f'{name} = {size}' for name, size in sizes.items())} }};"]
    for name, array in arrays.items():
        size = "".join(f"[{n}]" for n in array.shape)
        lines.append(f"static const double {name}{size} = {str(array.tolist()).replace('[', '{').replace(']', '}')};")
    return "\n".join(lines) + "\n"


def by_hand(problem: taciturn.Problem, folder: Path) -> dict[str, ctypes.CDLL]:
    """Compile and load the loop by hand, with each of its ways to draw."""
    (folder / "tank_numbers.h").write_text(numbers(problem))
    found: dict[str, ctypes.CDLL] = {}
    for name, flag in (("by hand", []), ("by hand, polynomials", ["-DPOLYNOMIALS"])):
        library = str(folder / f"tank_{len(found)}.so")
        subprocess.run(["cc", *FLAGS, *flag, f"-I{folder}", str(SOURCE), "-o", library, "-lmvec", "-lm"], check=True)
        found[name] = ctypes.CDLL(library)
    return found


def main() -> None:
    """Print the speeds, their ratio, and the agreement of cost and rates as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    tank = taciturn.load("quadruple-tank")
    loop = tank.close(tank.design())
    program = loop.reduced_program().keep({EXCESS, *map(Sent, loop.policy.scheduled)})
    kernel = Kernel(program)
    known = taciturn.evaluate(tank, steps=PATHS * TICKS, seed=3)
    with tempfile.TemporaryDirectory() as name:
        codes = by_hand(tank, Path(name))
        all_sums = {name: (ctypes.c_double * 5)() for name in codes}
        speeds: dict[str, list[float]] = {name: [] for name in ("engine", *codes)}
        for seed in range(rounds + 1):
            begin = time.process_time()
            kernel.run(program, loop.start(program, PATHS, seed), TICKS, threads=1)
            speeds["engine"].append(PATHS * TICKS / (time.process_time() - begin))
            for name, code in codes.items():
                begin, sums = time.process_time(), ctypes.byref(all_sums[name])
                code.tank(ctypes.c_uint64(seed + 1), ctypes.c_long(PATHS), ctypes.c_long(TICKS), sums)
                speeds[name].append(PATHS * TICKS / (time.process_time() - begin))
    steps = (rounds + 1) * PATHS * TICKS
    assert known.cost_all_time is not None
    off: dict[str, dict[str, float]] = {}
    for name, sums in all_sums.items():
        cost = known.cost_all_time + sums[0] / steps / loop.problem.tick
        rates = {link: sums[1 + i] / steps / loop.problem.tick for i, link in enumerate(known.rates)}
        off[name] = {
            link: (rate - known.rates[link].value) / known.rates[link].standard_error for link, rate in rates.items()
        }
        off[name]["cost"] = (cost - known.cost.value) / known.cost.standard_error
    found = {name: statistics.median(each[1:]) for name, each in speeds.items()}
    ratios = {
        name: statistics.median(a / b for a, b in zip(speeds["engine"][1:], speeds[name][1:], strict=True))
        for name in codes
    }
    print(json.dumps({
        "machine": dict(describe_machine()), "steps_per_second": found,
        "engine_over": ratios,
        "difference_in_standard_errors": off,
    }, indent=1))  # fmt: skip


if __name__ == "__main__":
    main()
