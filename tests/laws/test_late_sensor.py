"""A sensor's link with random delays and acknowledgements: the identity, the bound, and a simulation by queues."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from counts import few
from measured import agree_together, average, times

from taciturn import Burst, ContinuousPlant, Controller, Cost, Network, Plant, ProblemError, UnstableError, close
from taciturn.base.given_controller import lqg_observer
from taciturn.design import excess
from taciturn.lqg.discrete import discretise
from taciturn.model.link import LinkLaw
from taciturn.simulation.average import plain_average

PLANT = Plant([[1.02, 0.1], [0, 0.98]], [[0.005], [0.1]], np.diag([0.001, 0.01]), [[1, 0]], [[0.05]])
COST = Cost(np.diag([1.0, 0.1]), [[0.1]])


def network(delay: Any, **more: Any) -> Network:
    """Return the usual nodes with a law of delay of the sensor's link."""
    return Network(links={"sensor": LinkLaw(delay=delay, acknowledged=True, **more)})


@pytest.mark.parametrize("first", few(range(0, 400, 8), 1))
def test_the_identity_holds_and_no_bound_is_broken(first: int) -> None:
    """LQG and given controllers, seconds and steps, losses and bursts, on eight random loops together."""
    differences = list[float]()
    for seed in range(first, first + 8):
        rng = np.random.default_rng(seed)
        parts, given = bool(rng.integers(2)), bool(rng.integers(2))
        n = int(rng.integers(1, 3))
        A, B, C = rng.normal(size=(n, n)), rng.normal(size=(n, 1)), rng.normal(size=(1, n))
        root = rng.normal(size=(n + 1, n + 1))
        S = root @ root.T / (n + 1) + 0.1 * np.eye(n + 1)
        cost, more = Cost(S[:n, :n], S[n:, n:], S[:n, n:]), dict[str, Any]()
        share = rng.dirichlet(np.ones(2)) * rng.uniform(0.8, 1.0)
        law: Any = share.tolist()
        A = A * rng.uniform(0.5, 1.1) / np.abs(np.linalg.eigvals(A)).max()
        plant: Plant | ContinuousPlant = Plant(A, B, np.diag(rng.uniform(0.1, 1, n)), C, [[0.05]])
        if parts:
            plant, more = ContinuousPlant(A - 0.8 * np.eye(n), B, np.eye(n), C=C, V=[[0.05]]), {"period": 0.2}
            law = {"seconds": sorted(rng.uniform(0, 0.4, 2).round(2).tolist()), "probability": share.tolist()}
        if given:
            k = -float(rng.uniform(0.0, 0.2))
            more["controller"] = Controller([[0.5]], [[0.3]], [[k]], [[k]], [[0.1 * (seed % 2)]])
        links = network(law, loss=float(rng.choice([0.0, 0.1])))
        if rng.integers(3) == 0 and not parts:
            links = network({"states": [law, law[::-1]]}, burst=Burst(0.1, 0.3, 0.0, 0.2))
        theta = float(rng.choice([0.0, 0.1, 0.5]))
        try:
            policy = excess(plant, cost, theta=theta, link="sensor", network=links, **more)
        except (UnstableError, ProblemError):
            continue
        if policy.theory.fourth is None or policy.theory.fourth > 0.95:
            continue
        loop = close(plant, policy)
        assert loop.nominal
        square = average(loop, steps=60_000, seed=seed)
        plain = average(loop, plain_average(loop), steps=60_000, seed=seed + 1)
        error = np.hypot(plain.cost.standard_error, square.cost.standard_error)
        differences.append((plain.cost.value - square.cost.value) / error)
        assert policy.guarantee is not None
        assert square.cost.value - 4 * square.cost.standard_error <= policy.guarantee.cost
    assert len(differences) > 1
    assert agree_together(differences), differences


def test_the_base_is_the_loop_of_queues() -> None:
    """Every measurement is sent; the newest that has arrived by a step is used, as simulated packet by packet."""
    chances, policy = [0.6, 0.2, 0.1], excess(PLANT, COST, theta=0.1, link="sensor", network=network([0.6, 0.2, 0.1]))
    kept = lqg_observer("excess", discretise(PLANT, COST, None))
    rng, count, steps = np.random.default_rng(3), 4000, 400 * times()
    x, state, used, newest = (
        np.zeros((count, 2)),
        np.zeros((count, len(kept.A))),
        np.zeros((count, 1)),
        np.full(count, -1),
    )
    sent: list[tuple[np.ndarray, np.ndarray]] = []
    total, counted = np.zeros(count), 0
    for k in range(steps):
        y = x @ PLANT.C.T + np.sqrt(0.05) * rng.normal(size=(count, 1))
        sent.append((y, rng.choice(4, count, p=[*chances, 0.1])))
        for age in range(2, -1, -1):  # the newest last
            if age <= k:
                values, delay = sent[k - age]
                come = (delay == age) & (newest < k - age)
                used[come], newest[come] = values[come], k - age
        u = state @ kept.C.T + used @ kept.D.T
        state = state @ kept.A.T + used @ kept.B.T + u @ kept.E.T
        if k >= 100:
            total += np.einsum("pi,ij,pj->p", x, COST.Q, x) + 0.1 * u[:, 0] ** 2
            counted += 1
        x = x @ PLANT.A.T + u @ PLANT.B.T + rng.normal(size=(count, 2)) * np.sqrt([0.001, 0.01])
    mean = total / counted
    assert abs(mean.mean() - policy.cost_all_time) < 4.5 * mean.std() / np.sqrt(count)
    assert mean.std() / np.sqrt(count) < 0.01 * policy.cost_all_time


def test_a_packet_within_a_period_is_heard_in_the_next_step() -> None:
    """So a delay of half a period is one of a whole step, and its cost is that of the registers of a constant delay."""
    plant = ContinuousPlant([[0.1]], [[1.0]], [[1.0]], C=[[1.0]], V=[[0.1]])
    half = {"seconds": [0.05], "probability": [0.9]}
    given: dict[str, Any] = {"theta": 0.1, "link": "sensor", "period": 0.1}
    late = [excess(plant, Cost([[1.0]], [[0.1]]), network=network(law), **given) for law in (half, [0.0, 0.9])]
    assert late[0].cost_all_time == pytest.approx(late[1].cost_all_time, rel=1e-12)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"retry": True}, "expected every = 1, gains = 'lqg', no retry"),
        ({"every": 2}, "expected every = 1"),
        ({"design_delay": 1.0}, "no design_delay"),
        ({"network": network([0.5, 0.4], acknowledgement_delay=1)}, "acknowledgements come one step late"),
    ],
)
def test_what_has_no_theory_is_refused(changes: dict[str, Any], words: str) -> None:
    """In one sentence."""
    with pytest.raises(ProblemError, match=words):
        excess(PLANT, COST, **{"theta": 0.1, "link": "sensor", "network": network([0.5, 0.4]), **changes})
