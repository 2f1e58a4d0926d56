"""A loop does what it does, whatever units its states, inputs, outputs, cost and time are measured in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from counts import few

from taciturn import ContinuousPlant, Cost, Network, Plant, Policy, close, design
from taciturn.simulation.average import average, completed_squares, plain_average

STEPS, SAME = 20_000, 1e-8  # relative; a decision that rounding turned would show in the rate as 5e-5


@dataclass(frozen=True)
class Units:
    """What one of the old units of each variable is in new ones: x = state·x̄, and so on."""

    state: np.ndarray
    input: np.ndarray
    output: np.ndarray
    cost: float
    time: float


def drawn(seed: int, digits: float) -> tuple[np.random.Generator, Units]:
    """Return the draws that make a plant, and random units; 0 digits: the old ones."""
    draws = np.random.default_rng(seed)
    exponents = np.random.default_rng(seed + 1).uniform(-digits, digits, (3, 3))
    last = np.random.default_rng(seed + 2).uniform(-digits, digits, 2)
    return draws, Units(*10.0**exponents, *(10.0**last).tolist())


def stated(seed: int, digits: float, continuous: bool) -> tuple[Plant | ContinuousPlant, Cost, Units]:
    """Return a plant of three states, two inputs and two outputs, with a cross term, in random units."""
    draws, u = drawn(seed, digits)
    n, m, p = 3, 2, 2
    A, B, C = draws.normal(size=(n, n)), draws.normal(size=(n, m)), draws.normal(size=(p, n))
    A *= draws.uniform(0.5, 1.2) / np.abs(np.linalg.eigvals(A)).max()
    joint, W, V = (np.cov(draws.normal(size=(size, 20))) for size in (n + m, n, p))
    x, v, y = u.state, u.input[:m], u.output[:p]
    cost = Cost(
        u.cost * joint[:n, :n] * x * x[:, None],
        u.cost * joint[n:, n:] * v * v[:, None],
        u.cost * joint[:n, n:] * x[:, None] * v,
    )
    A, B, W = A / x[:, None] * x, B / x[:, None] * v, W / x / x[:, None]
    C, V = C / y[:, None] * x, V / y / y[:, None]
    if continuous:
        return ContinuousPlant(A / u.time, B / u.time, W / u.time, C=C, V=V), cost, u
    return Plant(A, B, W, C, V), cost, u


def lossy(plant: Plant, cost: Cost, u: Units) -> Policy:
    """Return the policy over lossy links, which wants the full state and no cross term."""
    network = Network("udp", actuator_loss=0.1, sensor_loss=0.2)
    return design.lossy_lqg(Plant(plant.A, plant.B, plant.W), Cost(cost.Q, cost.R), price=0.3 * u.cost, network=network)


KINDS: dict[str, Callable[[Plant, Cost, Units], Policy]] = {
    "joint hold": lambda p, c, u: design.lqg(p, c, theta=0.3),
    "excess model": lambda p, c, u: design.excess(p, c, theta=0.1, actuation="model"),
    "remote": lambda p, c, u: design.remote_lqg(p, c, theta=0.1, zeta=0.02 * design.all_time(p, c).cost_all_time),
    "lossy": lossy,
    "sampled": lambda p, c, u: design.lqg(p, c, theta=0.3, period=0.3 * u.time),
}


def assert_same_loop(kind: str, seed: int) -> list[float]:
    """Return the rates of a loop whose J_all, cost and rates in units of 1e-8 … 1e8 were found to be the old ones."""
    told: list[tuple[float, float, list[float]]] = []
    for digits in (0.0, 8.0):
        plant, cost, u = stated(seed, digits, kind == "sampled")
        policy = KINDS[kind](plant, cost, u)
        model = Plant(plant.A, plant.B, plant.W) if kind == "lossy" else plant
        weights = Cost(cost.Q, cost.R) if kind == "lossy" else cost
        found = average(close(model, policy, cost=weights), steps=STEPS, seed=1)
        rates = [rate.value * policy.tick for rate in found.rates.values()]  # per step
        told.append((policy.cost_all_time / u.cost, found.cost.value / u.cost, rates))
    (plain, measured, sends), (other, again, sent) = told
    assert other == pytest.approx(plain, rel=SAME)
    assert again == pytest.approx(measured, rel=SAME)
    assert sent == pytest.approx(sends, rel=SAME)
    return sends


@pytest.mark.parametrize("kind", few(KINDS))
def test_a_loop_in_other_units_makes_the_same_decisions_at_the_same_cost(kind: str) -> None:
    """J_all, cost and rates of the same draws agree to 1e-8, and something is decided."""
    assert 0 < min(assert_same_loop(kind, 3)) < 1


@pytest.mark.evidence
@pytest.mark.parametrize("seed", range(10, 18))
@pytest.mark.parametrize("kind", KINDS)
def test_loops_in_other_units_make_the_same_decisions_at_the_same_cost(kind: str, seed: int) -> None:
    """The same for eight more plants of each kind."""
    assert_same_loop(kind, seed)


@pytest.mark.parametrize("actuation", few(["hold", "model"], quick=1))
def test_a_badly_scaled_loop_costs_the_same_by_squares_and_by_simulating_the_plant(actuation) -> None:
    """Completion of squares and the plain average agree within their standard errors, in units of 1e-8 … 1e8."""
    plant, cost, _ = stated(5, 8.0, continuous=False)
    assert isinstance(plant, Plant)
    policy = design.lqg(plant, cost, theta=0.5, actuation=actuation)
    loop = close(plant, policy, cost=cost)
    squares, plain = (average(loop, make(loop), seed=7, steps=400_000) for make in (completed_squares, plain_average))
    spread = np.hypot(squares.cost.standard_error, plain.cost.standard_error)
    assert abs(squares.cost.value - plain.cost.value) < 4 * spread
    assert plain.cost.standard_error < 0.02 * plain.cost.value
