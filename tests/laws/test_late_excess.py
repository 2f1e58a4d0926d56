"""The trigger over links with random delays and time-stamped acknowledgements: published costs, identity and bound."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from counts import few
from measured import agree_together, average

from taciturn import (
    Burst,
    ContinuousPlant,
    Controller,
    Cost,
    Loop,
    Network,
    Plant,
    Policy,
    ProblemError,
    UnstableError,
    close,
)
from taciturn.design import excess
from taciturn.model.link import LinkLaw
from taciturn.simulation.average import plain_average

LATE = ContinuousPlant([[0, 1], [2, -0.5]], [[0], [1]], np.diag([0.01, 0.3]), C=[[1, 0]], V=[[0.01]])
SLOW = ContinuousPlant([[0, 1], [0.3, -0.5]], [[0], [1]], np.diag([0.01, 0.3]), C=[[1, 0]], V=[[0.01]])
WEIGHTS, PERIOD = Cost(np.diag([1.0, 0.1]), [[0.1]]), 0.3


def network(delay: Any, acknowledged: bool = True, **more: Any) -> Network:
    """Return the usual nodes with a law of delay of the link to the actuator."""
    return Network(links={"actuator": LinkLaw(delay=delay, acknowledged=acknowledged, **more)})


def seconds(delays: list[float], chances: list[float]) -> dict[str, list[float]]:
    """Return a law of delays in seconds."""
    return {"seconds": delays, "probability": chances}


ROWS = [
    (LATE, seconds([0.0, 0.29], [0.5, 0.5]), 0.891574616, {0.1: (0.8105, 0.89169), 0.4: (0.6729, 0.92076)}),
    (
        LATE,
        seconds([0.06, 0.15, 0.27], [0.45, 0.25, 0.2]),
        0.827941847,
        {0.0: (0.931, 0.82572), 0.1: (0.8098, 0.82968)},
    ),
    (SLOW, seconds([0.06, 0.21, 0.36, 0.45], [0.4, 0.25, 0.15, 0.1]), 0.392159461, {0.4: (0.6260, 0.409477)}),
    (SLOW, seconds([0.06, 0.15, 0.45, 0.66], [0.4, 0.25, 0.15, 0.1]), 0.447738197, {0.4: (0.6548, 0.464184)}),
]  # base, and by θ: attempts per step and cost


@pytest.mark.parametrize("row", few(range(len(ROWS)), 2))
def test_costs_and_rates_are_those_of_the_references(row: int) -> None:
    """They were simulated packet by packet in continuous time."""
    plant, law, base, rows = ROWS[row]
    for theta, (rate, cost) in rows.items():
        delta = theta * base * PERIOD
        policy = excess(plant, WEIGHTS, delta=delta, period=PERIOD, network=network(law))
        assert policy.cost_all_time == pytest.approx(base, abs=6e-10)
        found = average(close(plant, policy), steps=400_000, seed=3)
        assert found.rates["actuator"].value * PERIOD == pytest.approx(rate, abs=0.002)
        assert found.cost.value == pytest.approx(cost, abs=4 * (found.cost.standard_error + 1e-4 * cost))
        assert policy.guarantee is not None
        assert found.cost.value < policy.guarantee.cost


def drawn(seed: int) -> tuple[Plant | ContinuousPlant, Policy]:
    """Return a plant and a policy over a link with random delays: LQG or a given controller, whole periods or parts."""
    rng = np.random.default_rng(seed)
    parts, given = bool(rng.integers(2)), bool(rng.integers(2))
    n = int(rng.integers(1, 3))
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, 1))
    C, W = rng.normal(size=(1, n)), np.diag(rng.uniform(0.1, 1.0, n))
    root = rng.normal(size=(n + 1, n + 1))
    joint = root @ root.T / (n + 1) + 0.1 * np.eye(n + 1)
    cost = Cost(joint[:n, :n], joint[n:, n:], joint[:n, n:])
    count = int(rng.integers(1, 4))
    chances = rng.dirichlet(np.ones(count + 1))
    share = chances[:count] / chances[:count].sum() * rng.uniform(0.8, 1.0)
    more: dict[str, Any] = {}
    if parts:
        A = A + np.eye(n) * (rng.uniform(-0.8, 0.3) - np.linalg.eigvals(A).real.max())
        plant: Plant | ContinuousPlant = ContinuousPlant(A, B, W, C=C, V=[[0.05]])
        more["period"] = 0.2
        law = seconds(sorted(rng.uniform(0, 0.4, count).round(2).tolist()), share.tolist())
    else:
        A = A * rng.uniform(0.5, 1.1) / np.abs(np.linalg.eigvals(A)).max()
        plant = Plant(A, B, W, C, [[0.05]])
        law = share.tolist()
    if given:
        k = -float(rng.uniform(0.0, 0.2))
        more["controller"] = Controller([[0.5]], [[0.3]], [[k]], [[k]])
    loss = float(rng.choice([0.0, 0.1]))
    theta = float(rng.choice([0.0, 0.1, 0.5]))
    late = network(law, loss=loss)
    if rng.integers(3) == 0 and count < 3:  # delays and losses in bursts
        other = share[::-1].tolist()
        states = [law, {**law, "probability": other} if isinstance(law, dict) else other]
        burst = Burst(*rng.uniform(0.05, 0.4, 2), 0.0, loss)
        late = network({"states": states}, burst=burst)
    return plant, excess(plant, cost, theta=theta, network=late, **more)


def usual(seed: int) -> tuple[Loop, Policy] | None:
    """Return the loop of a seed; None if it is not stable or its averages have no variance."""
    try:
        plant, policy = drawn(seed)
    except (UnstableError, ProblemError):
        return None
    fourth = policy.theory.fourth
    return None if fourth is None or fourth > 0.97 else (close(plant, policy), policy)


@pytest.mark.parametrize("first", few(range(0, 600, 8), 1))
def test_the_identity_holds_and_no_bound_is_broken(first: int) -> None:
    """The average of the stage cost is J_base plus what silence costs, on eight random loops together."""
    differences = list[float]()
    for seed in range(first, first + 8):
        made = usual(seed)
        if made is None:
            continue
        loop, policy = made
        assert loop.nominal
        assert policy.guarantee is not None
        square = average(loop, steps=60_000, seed=seed)
        plain = average(loop, plain_average(loop), steps=60_000, seed=seed + 1)
        differences.append(
            (plain.cost.value - square.cost.value) / np.hypot(plain.cost.standard_error, square.cost.standard_error)
        )
        assert square.cost.value - 4 * square.cost.standard_error <= policy.guarantee.cost
    assert len(differences) > 1
    assert agree_together(differences), differences
