"""Random systems for the laws: stable and unstable, with cross terms, several inputs and singular noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hypothesis import assume
from hypothesis import strategies as st

from taciturn import ContinuousPlant, Cost, Jumps, Plant
from taciturn._rational import Limit, unmoved
from taciturn.lqg.prediction import PredictionCost, prediction_cost

SHAPES = (
    (1, 1, 1, True, 1),
    (1, 1, 1, False, 1),
    (2, 1, 1, False, 2),
    (2, 1, 2, True, 1),
    (2, 2, 2, True, 2),
    (3, 1, 2, False, 3),
    (3, 2, 3, True, 2),
    (4, 1, 1, False, 4),
    (4, 2, 4, True, 4),
    (4, 3, 2, False, 4),
    (5, 2, 3, False, 5),
    (6, 1, 6, True, 3),
    (6, 2, 4, False, 6),
    (6, 3, 1, False, 6),
)
"""States, inputs, outputs, whether the state is measured, rank of its noise: programs of a shape share machine code."""


@dataclass(frozen=True, eq=False)
class System:
    """A discrete plant with its cost, and the seed that made it."""

    plant: Plant
    cost: Cost
    seed: int

    def __repr__(self) -> str:
        """Return what is needed to make the system again."""
        sizes = (self.plant.states, self.plant.inputs, self.plant.outputs)
        return f"make_system(seed={self.seed}, n, m, p={sizes}, full_state={self.plant.full_state})"


def make_system(seed: int, states: int, inputs: int, outputs: int, full_state: bool, rank: int | None = None) -> System:
    """Return the system of a seed: spectral radius from 0.4 to 1.25, weights and noises of moderate condition.

    The rank of the process noise is drawn if it is not given; where the output is noisy, all directions have some.
    """
    draws = np.random.default_rng(seed)
    A = draws.standard_normal((states, states))
    A *= draws.uniform(0.4, 1.25) / np.abs(np.linalg.eigvals(A)).max()
    B = draws.standard_normal((states, inputs))
    C = draws.standard_normal((outputs, states))
    size = states + inputs
    G = draws.standard_normal((size, size)) / np.sqrt(size)
    weight = G @ G.T + 0.05 * np.eye(size)
    rank = int(draws.integers(1, states + 1)) if rank is None else rank  # singular process noise included
    D = draws.standard_normal((states, rank)) * 0.3
    W = D @ D.T if full_state else D @ D.T + 1e-3 * np.eye(states)
    E = draws.standard_normal((outputs, outputs)) * 0.3
    V = E @ E.T + 1e-2 * np.eye(outputs)
    plant = Plant(A, B, W) if full_state else Plant(A, B, W, C, V)
    cost = Cost(weight[:states, :states], weight[states:, states:], weight[:states, states:])
    return System(plant, cost, seed)


@st.composite
def systems(draw: st.DrawFn, states: int = 6, inputs: int = 3) -> System:
    """Draw a system of one of the shapes that have at most so many states and inputs."""
    shape = draw(st.sampled_from([one for one in SHAPES if one[0] <= states and one[1] <= inputs]))
    system = make_system(draw(st.integers(0, 2**32 - 1)), *shape)
    assume(well_posed(system.plant.A, system.plant.B) and well_posed(system.plant.A.T, system.plant.C.T))
    return system


def uncontrollable_modes(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return the eigenvalues of A that the input through B cannot influence."""
    return np.concatenate(unmoved(np.asarray(A, dtype=float), np.asarray(B, dtype=float), Limit(False)))


def well_posed(A: np.ndarray, B: np.ndarray) -> bool:
    """Tell whether every persisting mode is clearly reached: a cost of 1e8 teaches nothing about a law."""
    slow = [value for value in np.linalg.eigvals(A) if abs(value) > 0.9]
    unit = np.eye(len(A))
    return all(np.linalg.svd(np.hstack([A - value * unit, B]), compute_uv=False)[-1] > 0.1 for value in slow)


def continuous_system(seed: int, law: str, states: int = 3) -> tuple[ContinuousPlant, Cost, float]:
    """Return a random plant with a cross term in its cost, and a period; stable or unstable, noise of any rank."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, states + 1)), int(rng.integers(1, 3))
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
    unit = np.eye(n)
    slow = [value for value in np.linalg.eigvals(A) if value.real > -0.1]
    assume(all(np.linalg.svd(np.hstack([A - value * unit, B]))[1][-1] > 0.1 for value in slow))
    root = rng.normal(size=(n + m, n + m)) / np.sqrt(n + m)
    joint, noise = root @ root.T + 0.05 * np.eye(n + m), 0.5 * rng.normal(size=(n, int(rng.integers(1, n + 1))))
    cost, period = Cost(joint[:n, :n], joint[n:, n:], joint[:n, n:]), float(rng.uniform(0.05, 0.5))
    if law == "wiener":
        return ContinuousPlant(A, B, noise @ noise.T), cost, period
    rate = float(rng.uniform(0.5, 8.0))
    return ContinuousPlant(A, B, jumps=Jumps(rate, noise @ noise.T / rate, law)), cost, period


def price_of(plant: ContinuousPlant, cost: Cost) -> PredictionCost:
    """Return what acting on predictions costs."""
    return prediction_cost(plant.A, plant.B, cost.Q, cost.R, cost.N, plant.W)
