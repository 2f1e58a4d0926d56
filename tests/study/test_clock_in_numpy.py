"""The cost of fair periodic control, computed again in plain NumPy without the library's own functions."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import pytest
from counts import few
from scipy.linalg import expm
from study.test_clock import TANK, WEIGHTS, fair

import taciturn
from taciturn import Network, Problem, design
from taciturn.model.plant import ContinuousPlant, Plant

PATHS, POINTS = 1000, 401  # of the simulation; of Simpson's rule over a step
TANKS = Problem(TANK, WEIGHTS, Network(), "excess", {"theta": 0.1, "period": 1.0})
PENDULUM = taciturn.load("inverted-pendulum")
MASSES = taciturn.load("two-mass-lqg")


@dataclass(frozen=True)
class Sampled:
    """From step to step: x⁺ = Ax + Bu + w, cost [x; u]'M[x; u] and what the noise costs between steps."""

    A: np.ndarray
    B: np.ndarray
    M: np.ndarray
    W: np.ndarray
    noise_cost: float
    C: np.ndarray
    V: np.ndarray
    tick: float

    @property
    def states(self) -> int:
        """How many."""
        return len(self.A)


def sampled(problem: Problem) -> Sampled:
    """Sample a plant by exponentials and Simpson's rule; one in discrete time is as it is."""
    plant, cost = problem.plant, problem.cost
    M, n = np.block([[cost.Q, cost.N], [cost.N.T, cost.R]]), plant.states
    if isinstance(plant, Plant):
        return Sampled(plant.A, plant.B, M, plant.W, 0.0, plant.C, plant.V, 1.0)
    assert isinstance(plant, ContinuousPlant)
    h = float(problem.parameters["period"])
    both = np.block([[plant.A, plant.B], [np.zeros((plant.inputs, n + plant.inputs))]])
    step = h / (POINTS - 1)
    once, flow = expm(both * step), np.eye(len(both))
    flows = [flow := flow if k == 0 else flow @ once for k in range(POINTS)]
    weights = step / 3 * np.array([1, *([4, 2] * (POINTS // 2))[:-1], 1])
    spread = [np.zeros((n, n))]
    for before, after in itertools.pairwise(flows):  # the noise of a step, by the trapezoidal rule of its halves
        ends = [part[:n, :n] @ plant.W @ part[:n, :n].T for part in (before, after)]
        half = expm(plant.A * step / 2) @ before[:n, :n]
        spread.append(spread[-1] + step / 6 * (ends[0] + 4 * half @ plant.W @ half.T + ends[1]))
    cost_of = [np.trace(cost.Q @ covariance) for covariance in spread]
    return Sampled(
        flows[-1][:n, :n],
        flows[-1][:n, n:],
        sum(w * (one.T @ M @ one) for w, one in zip(weights, flows, strict=True)),
        spread[-1],
        float(weights @ cost_of),
        plant.C,
        plant.V,
        h,
    )


def gains(plant: Sampled, cycle: tuple[int, ...]) -> list[np.ndarray]:
    """Return the gain of each interval of a cycle, by value iteration over the state at the sends."""
    n, m = plant.B.shape
    held = np.block([[plant.A, plant.B], [np.zeros((m, n)), np.eye(m)]])
    stretches = []
    for length in cycle:
        powers = [np.linalg.matrix_power(held, k) for k in range(length + 1)]
        stretches.append((powers[-1][:n], sum(one.T @ plant.M @ one for one in powers[:-1])))
    P, found = np.eye(n), [np.zeros((m, n))] * len(cycle)
    for _ in range(4000):
        before = P
        for place in reversed(range(len(cycle))):
            ahead, weight = stretches[place]
            G = weight + ahead.T @ P @ ahead
            found[place] = -np.linalg.solve(G[n:, n:], G[n:, :n])
            P = G[:n, :n] + G[:n, n:] @ found[place]
        if np.abs(P - before).max() <= 1e-13 * np.abs(P).max():
            break
    return found


def simulated(plant: Sampled, cycle: tuple[int, ...], model: bool, ticks: int) -> np.ndarray:
    """Return the cost per unit of time of each path, filtered at every step and sent by the cycle."""
    n, p, draws = plant.states, len(plant.C), np.random.default_rng(5)
    prior = plant.W + np.eye(n)
    for _ in range(4000):
        K = prior @ plant.C.T @ np.linalg.inv(plant.C @ prior @ plant.C.T + plant.V)
        posterior = prior - K @ plant.C @ prior
        prior = plant.A @ posterior @ plant.A.T + plant.W
    roots = [np.linalg.cholesky(S + 1e-13 * np.trace(S) * np.eye(len(S))) for S in (plant.W, plant.V)]
    L = gains(plant, (1,) if model else cycle)
    due = dict(zip(itertools.accumulate((0, *cycle[:-1])), itertools.count(), strict=False))
    x, seen, far = (np.zeros((n, PATHS)) for _ in range(3))
    u, total = np.zeros((plant.B.shape[1], PATHS)), np.zeros(PATHS)
    burn = ticks // 4 // sum(cycle) * sum(cycle)
    for tick in range(burn + ticks // sum(cycle) * sum(cycle)):
        seen = seen + K @ (plant.C @ x + roots[1] @ draws.standard_normal((p, PATHS)) - plant.C @ seen)
        place = due.get(tick % sum(cycle))
        if model:
            far = seen if place is not None else far
            u = L[0] @ far
            far = plant.A @ far + plant.B @ u
        elif place is not None:
            u = L[place] @ seen
        z = np.vstack([x, u])
        total += (tick >= burn) * (z * (plant.M @ z)).sum(axis=0)
        x = plant.A @ x + plant.B @ u + roots[0] @ draws.standard_normal((n, PATHS))
        seen = plant.A @ seen + plant.B @ u
    return (total / (tick + 1 - burn) + plant.noise_cost) / plant.tick


CASES = {
    "two masses, hold, 4": (MASSES, (4,), False),
    "two masses, hold, 5 and 4": (MASSES, (5, 4), False),
    "two masses, model, 4": (MASSES, (4,), True),
    "tanks, hold, 2": (TANKS, (2,), False),
    "tanks, hold, 3 and 1": (TANKS, (3, 1), False),
    "tanks, model, 2": (TANKS, (2,), True),
    "pendulum, hold, 3": (PENDULUM, (3,), False),
    "pendulum, hold, 3 and 2": (PENDULUM, (3, 2), False),
    "pendulum, model, 5": (PENDULUM, (5,), True),
}


def exact(problem: Problem, cycle: tuple[int, ...], model: bool) -> float:
    """Return what the library says: of a cycle that holds, or of the clock at the rate of a model's interval."""
    if model:
        clock = fair(problem.changed({"actuation": "model"})).at(1 / cycle[0] / problem.design().tick)
        assert clock is not None
        return clock.cost
    policy = design.periodic(problem.plant, problem.cost, every=cycle, period=problem.parameters.get("period"))
    assert policy.theory.closed_form is not None
    return policy.theory.closed_form.cost


@pytest.mark.parametrize("case", few(CASES, quick=1, start=1))
def test_a_fair_clock_costs_what_plain_numpy_simulates(case: str) -> None:
    """Within four standard errors of a thousand independent paths."""
    problem, cycle, model = CASES[case]
    found = simulated(sampled(problem), cycle, model, 400)
    error = found.std(ddof=1) / np.sqrt(PATHS)
    assert error < 0.02 * found.mean()
    assert abs(found.mean() - exact(problem, cycle, model)) <= 4 * error


@pytest.mark.evidence
@pytest.mark.parametrize("case", CASES)
def test_a_fair_clock_costs_what_a_long_simulation_in_plain_numpy_does(case: str) -> None:
    """To half a percent."""
    problem, cycle, model = CASES[case]
    found = simulated(sampled(problem), cycle, model, 8000)
    error = found.std(ddof=1) / np.sqrt(PATHS)
    assert error < 0.003 * found.mean()
    assert abs(found.mean() - exact(problem, cycle, model)) <= 4 * error
