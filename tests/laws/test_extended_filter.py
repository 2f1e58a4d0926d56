"""An extended Kalman filter, as steps that are functions, is the Kalman filter where everything is linear."""

from __future__ import annotations

import numpy as np
import pytest
from drawn import over
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from systems import System, systems

import taciturn
from taciturn import Policy, close, design
from taciturn.errors import TaciturnError
from taciturn.loop import Loop
from taciturn.lqg.kalman import steady_filter
from taciturn.model.steps import Apply, Step
from taciturn.model.theory import Theory
from taciturn.program.numpy import run
from taciturn.program.ops import is_entry

SEEDS = st.integers(0, 2**32 - 1)


def extend(policy: Policy, spread: np.ndarray) -> Policy:
    """Return a policy with an extended Kalman filter of its own linear model in place of its filter."""
    model = policy.model
    A, B, C, W, V, n = model.A, model.B, model.C, model.W, model.V, model.states

    def correct(prior: np.ndarray, spread: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        P = spread.reshape(n, n)
        K = np.linalg.solve(C @ P @ C.T + V, C @ P).T
        kept = np.eye(n) - K @ C
        return prior + K @ (y - C @ prior), (kept @ P @ kept.T + K @ V @ K.T).ravel()

    def predict(estimate: np.ndarray, covariance: np.ndarray, held: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return A @ estimate + B @ held, (A @ covariance.reshape(n, n) @ A.T + W).ravel()

    new: dict[str, Step] = {
        "estimate": Apply("controller", {"estimate": n, "covariance": n * n}, correct, ("prior", "spread", "y")),
        "prior": Apply("controller", {"prior": n, "spread": n * n}, predict, ("estimate", "covariance", "held")),
    }
    steps = tuple(new.get(getattr(step, "signal", ""), step) for step in policy.steps)
    initial = {**policy.initial, "spread": spread.ravel()}
    return Policy("extended", steps, model, Theory(policy.cost), sites=policy.sites, initial=initial)


def designed(system: System) -> Policy:
    """Return the policy of a system whose state is measured in part, and whose filter settles within the test."""
    assume(not system.plant.full_state)
    try:
        policy = design.lqg(system.plant, system.cost, theta=0.2)
    except TaciturnError:
        assume(False)
        raise
    assume(policy.theory.settling < 30)
    return policy


@pytest.mark.evidence
@settings(max_examples=4)
@given(system=systems(states=4), seed=SEEDS)
def test_from_its_steady_covariance_it_decides_as_the_steady_filter(system: System, seed: int) -> None:
    """On the same noise: every send, and every estimate to rounding."""
    policy, plant = designed(system), system.plant
    prior = steady_filter(plant.A, plant.C, plant.W, plant.V).prior
    loops = [close(plant, one) for one in (policy, extend(policy, prior))]
    steady, found = (taciturn.simulate(loop, steps=100, seed=seed) for loop in loops)
    size = 1 + np.abs(steady.estimate).max()
    np.testing.assert_allclose(found.estimate, steady.estimate, rtol=0, atol=1e-7 * size)
    assert (found.sends["actuator"] == steady.sends["actuator"]).all()


def shown(loop: Loop, name: str, ticks: int, seed: int) -> np.ndarray:
    """Return a signal of one path, (steps, entries)."""
    program = loop.program()
    outputs = run(program, loop.start(program, 1, seed), ticks).outputs
    return np.array([values[:, 0] for key, values in outputs.items() if is_entry(key, name)]).T


@pytest.mark.evidence
@pytest.mark.parametrize("examples", [4, pytest.param(25, marks=pytest.mark.evidence)])
def test_from_any_covariance_it_is_the_filter_that_varies_in_time(examples: int) -> None:
    """Random systems."""
    over(it_varies_in_time, examples, system=systems(states=4), seed=SEEDS)


def it_varies_in_time(system: System, seed: int) -> None:
    """Against the recursion of a textbook, on what was measured and applied."""
    policy, plant = designed(system), system.plant
    P = 5.0 * np.eye(plant.states)
    loop = close(plant, extend(policy, P))
    y, applied, estimate = (shown(loop, name, 40, seed) for name in ("y", "applied", "estimate"))
    x, unit, size = np.zeros(plant.states), np.eye(plant.states), 1 + np.abs(estimate).max()
    for tick in range(40):
        K = P @ plant.C.T @ np.linalg.inv(plant.C @ P @ plant.C.T + plant.V)
        x = x + K @ (y[tick] - plant.C @ x)
        P = (unit - K @ plant.C) @ P
        P = (P + P.T) / 2
        assert estimate[tick] == pytest.approx(x, rel=0, abs=1e-7 * size)
        x, P = plant.A @ x + plant.B @ applied[tick], plant.A @ P @ plant.A.T + plant.W
