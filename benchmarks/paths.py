"""Never-die paths against plain simulation, side by side in one run on one core.

    python benchmarks/paths.py [--rounds 3]

For chains of four to six states, and thresholds that make intervals longer and longer: processor time times the square
of the relative standard error, of the simulation over that of the paths, for the rate and for the excess. Above one
the paths are quicker to any accuracy. The simulations are the compiled engine with its best estimator, its compilation
left out, and the same chain in NumPy. ``SHORT`` in ``taciturn.renewal.paths`` is drawn from the engine's.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable

os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # their idle threads run in circles

import numpy as np

from taciturn import ContinuousPlant, Cost, average, close, design
from taciturn.analyse.renewal import chain_of
from taciturn.loop import Loop
from taciturn.renewal.chain import Chain
from taciturn.renewal.paths import SHORT, solve_paths
from taciturn.renewal.rates import least_interval

Errors = tuple[float, float]  # relative, of rate and excess


def plants() -> dict[str, tuple[ContinuousPlant, Cost, float]]:
    """Return plants with costs and periods: two masses and a spring, and random ones, noise of full and of low rank."""
    spring = np.array([[0, 0, 1.0, 0], [0, 0, 0, 1.0], [-1, 1, -0.1, 0.1], [1, -1, 0.1, -0.1]])
    force = np.array([[0.0], [0.0], [1.0], [0.0]])
    found = {"spring": (ContinuousPlant(spring, force, np.diag([0, 0, 0.1, 0.1])), Cost(np.eye(4), [[0.1]]), 0.5)}
    for states, noises in ((4, 4), (5, 1), (6, 6), (6, 2)):
        draws = np.random.default_rng(states + noises)
        A, G = draws.standard_normal((states, states)), draws.standard_normal((states, noises))
        A -= 0.8 * np.linalg.eigvals(A).real.max() * np.eye(states)
        plant = ContinuousPlant(A, draws.standard_normal((states, 2)), G @ G.T)
        found[f"{states} states, {noises} noises"] = (plant, Cost(np.eye(states), np.eye(2)), 0.2)
    return found


def timed(run: Callable[[int], Errors], rounds: int) -> Errors:
    """Return processor time times squared relative error of rate and excess: medians over rounds."""
    found: list[Errors] = []
    for seed in range(rounds):
        begin = time.process_time()
        errors = run(seed)
        spent = time.process_time() - begin
        found.append((spent * errors[0] ** 2, spent * errors[1] ** 2))
    return statistics.median(each[0] for each in found), statistics.median(each[1] for each in found)


def by_paths(chain: Chain) -> Callable[[int], Errors]:
    """Return conditional sampling to an accuracy that most need."""

    def run(seed: int) -> Errors:
        found = solve_paths(chain, standard_error=3e-4, seed=seed, steps=20_000_000)
        return found.rate.standard_error / found.rate.value, found.excess.standard_error / found.excess.value

    return run


def by_engine(loop: Loop, constant: float) -> Callable[[int], Errors]:
    """Return the compiled simulation, compiled already."""

    def run(seed: int) -> Errors:
        found = average(loop, seed=seed, steps=40_000_000, threads=1)
        (rate,) = found.rates.values()
        return rate.standard_error / rate.value, found.cost.standard_error / (found.cost.value - constant)

    run(0)
    return run


def by_numpy(chain: Chain) -> Callable[[int], Errors]:
    """Return the chain as an array program: many paths side by side."""
    paths, checks = 4000, 200
    values, vectors = np.linalg.eigh(np.asarray(chain.noise))
    half = vectors * np.sqrt(np.maximum(values, 0.0))

    def run(seed: int) -> Errors:
        draws, error = np.random.default_rng(seed), np.zeros((paths, len(values)))
        sums = np.zeros((2, paths))
        for _ in range(checks):
            error = error @ chain.F.T + draws.standard_normal(error.shape) @ half.T
            sent = np.einsum("ij,ij->i", error @ chain.Psi, error) > chain.delta
            error[sent] = 0.0
            sums += [sent, np.einsum("ij,ij->i", error @ chain.Gamma, error)]
        rate, excess = sums.std(axis=1, ddof=1) / np.sqrt(paths) / sums.mean(axis=1)
        return float(rate), float(excess)

    return run


def main() -> None:
    """Print how many times quicker paths are."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    rounds = parser.parse_args().rounds
    heads = ("δ/δ*", 6), ("least", 7), ("mean", 7), ("expected", 10), ("engine: rate, excess", 23), ("NumPy: same", 22)
    print(" " * 24 + "".join(f"{head:>{width}}" for head, width in heads))
    for name, (plant, cost, period) in plants().items():
        largest = chain_of(close(plant, design.consistent(plant, cost, period=period))).delta
        for multiple in (0.3, 1.0, 2.0, 4.0, 8.0):
            policy = design.consistent(plant, cost, period=period, delta=multiple * largest)
            loop = close(plant, policy)
            chain, identity = chain_of(loop), policy.theory.identity
            assert identity is not None
            mine = timed(by_paths(chain), rounds)
            others = timed(by_engine(loop, identity.constant), rounds), timed(by_numpy(chain), rounds)
            gains = [other[i] / mine[i] for other in others for i in (0, 1)]
            least = least_interval(chain)
            mean = 1 / solve_paths(chain, standard_error=1e-2).rate.value
            print(
                f"{name:24}{multiple:6.1f}{least:7.2f}{mean:7.2f}{least <= SHORT!s:>10}"
                f"{gains[0]:11.2g},{gains[1]:11.2g}{gains[2]:10.2g},{gains[3]:11.2g}",
                flush=True,
            )


if __name__ == "__main__":
    main()
