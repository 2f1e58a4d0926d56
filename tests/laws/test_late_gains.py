"""The best gains for links with random delays: no other gains cost less, and known special cases come out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from counts import few
from laws.test_late_excess import LATE, PERIOD, SLOW, WEIGHTS, network, seconds
from laws.test_late_sets import link
from laws.test_late_sets import network as several
from measured import agree_together, average

import taciturn
from taciturn import ContinuousPlant, Cost, Plant, ProblemError, UnstableError, close
from taciturn.base.gains import gains_for_losses
from taciturn.base.late import Delays, best_gains, chain_of, late_value
from taciturn.base.periods import discrete_periods
from taciturn.design import excess
from taciturn.lqg.discrete import discretise
from taciturn.lqg.riccati import regulate
from taciturn.simulation.average import plain_average

ONE = np.eye(1)


def test_the_references_become_cheaper() -> None:
    """The gains for the mean delay are not optimal in any of them."""
    for plant, law in (
        (LATE, seconds([0.0, 0.29], [0.5, 0.5])),
        (LATE, seconds([0.06, 0.15, 0.27], [0.45, 0.25, 0.2])),
        (SLOW, seconds([0.06, 0.15, 0.45, 0.66], [0.4, 0.25, 0.15, 0.1])),
    ):
        given: dict[str, Any] = {"theta": 0.1, "period": PERIOD, "network": network(law)}
        usual, best = excess(plant, WEIGHTS, **given), excess(plant, WEIGHTS, gains="loss-optimal", **given)
        assert best.cost_all_time < usual.cost_all_time
        ideal = excess(plant, WEIGHTS, theta=0.1, period=PERIOD)
        assert ideal.cost_all_time < best.cost_all_time


@pytest.mark.parametrize("seed", few(range(40), 3))
def test_no_other_gains_cost_less(seed: int) -> None:
    """Neither gains nearby, in all modes or in one, nor those for a constant delay; and J is that of the gains."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(2, 2))
    A *= rng.uniform(0.5, 1.15) / np.abs(np.linalg.eigvals(A)).max()
    B, root = rng.normal(size=(2, 1)), rng.normal(size=(3, 3))
    S = root @ root.T + 0.1 * np.eye(3)
    plant = discrete_periods(A, B, S[:2, :2], S[2:, 2:], S[:2, 2:], np.diag([1.0, 0.5]))
    delays = Delays.of(np.arange(3), rng.dirichlet(np.ones(3)) * rng.uniform(0.75, 1.0))
    try:
        gains = best_gains(plant, delays)
    except UnstableError:
        return
    J = late_value(chain_of(plant, gains.__getitem__, delays), "").cost
    assert np.isfinite(J)
    modes = [*gains]
    for i in range(6):
        moved = {mode: K + 1e-2 * rng.normal(size=K.shape) * (i % 2 == 0 or mode == modes[i % len(modes)])
                 for mode, K in gains.items()}  # fmt: skip
        try:
            other = late_value(chain_of(plant, moved.__getitem__, delays), "").cost
        except UnstableError:
            continue
        assert other >= J * (1 - 1e-10)


def test_known_gains_come_out() -> None:
    """A constant delay has the gains of registers; without delays, losses have those for an input that is held."""
    A, B = np.array([[1.05, 0.1], [0.0, 0.9]]), np.array([[0.1], [0.5]])
    plant = discrete_periods(A, B, np.eye(2), 0.5 * ONE, np.zeros((2, 1)), np.diag([0.1, 0.2]))
    (K,) = (K for mode, K in best_gains(plant, Delays.of([2], [1.0])).items() if mode.ages == (1, 2))
    wide = np.block([[A, np.zeros((2, 1)), B], [np.zeros((1, 4))], [np.zeros((1, 2)), ONE, np.zeros((1, 1))]])
    late = regulate(wide, np.eye(4, 1, -2), np.diag([1.0, 1.0, 0, 0.5]), 1e-12 * ONE, np.zeros((4, 1)))
    assert K[:, :4] == pytest.approx(late.L, rel=1e-6, abs=1e-9)
    problem = discretise(Plant(A, B, np.diag([0.1, 0.2]), np.eye(2), 0.1 * np.eye(2)), Cost(np.eye(2), 0.5 * ONE), None)
    known, found = gains_for_losses(problem, 0.3, zero=False), [*best_gains(plant, Delays.of([0], [0.7])).values()]
    costs = [
        late_value(chain_of(plant, K, Delays.of([0], [0.7])), "").cost for K in (np.hstack([known, 0 * ONE]), found[0])
    ]
    assert costs[1] <= costs[0] * (1 + 1e-9)
    assert costs[1] == pytest.approx(costs[0], rel=2e-3)  # the known gain does not use the input that is held


@pytest.mark.parametrize("first", few(range(0, 160, 8), 1))
def test_the_identity_holds_with_gains_by_the_mode(first: int) -> None:
    """A change of the mode has a cost of its own; several actuators, parts of a period, losses."""
    differences = list[float]()
    for seed in range(first, first + 8):
        rng = np.random.default_rng(seed)
        parts = bool(rng.integers(2))
        A, B, root = rng.normal(size=(2, 2)), rng.normal(size=(2, 2)), rng.normal(size=(4, 4))
        joint, more = root @ root.T / 4 + 0.1 * np.eye(4), dict[str, Any]()
        cost = Cost(joint[:2, :2], joint[2:, 2:], joint[:2, 2:])
        A = A * rng.uniform(0.5, 1.1) / np.abs(np.linalg.eigvals(A)).max()
        plant: Plant | ContinuousPlant = Plant(A, B, 0.3 * np.eye(2), [[1.0, 0.3]], [[0.05]])
        if parts:
            plant, more = ContinuousPlant(A - 0.5 * np.eye(2), B, np.eye(2), C=[[1, 0.3]], V=[[0.05]]), {"period": 0.2}
        laws = {"left": link(rng, parts, 1), "right": link(rng, parts, 1)}  # 1: without bursts
        laws = {name: one and taciturn.model.link.replace(one, acknowledgement_delay=0) for name, one in laws.items()}
        if not any(one is not None and one.acknowledged for one in laws.values()):
            continue
        try:
            policy = excess(plant, cost, theta=0.2, network=several(laws), gains="loss-optimal", **more)
        except (UnstableError, ProblemError):
            continue
        if policy.theory.fourth is None or policy.theory.fourth > 0.95:
            continue
        loop = close(plant, policy)
        square = average(loop, steps=60_000, seed=seed)
        plain = average(loop, plain_average(loop), steps=60_000, seed=seed + 1)
        error = np.hypot(plain.cost.standard_error, square.cost.standard_error)
        differences.append((plain.cost.value - square.cost.value) / error)
        assert policy.guarantee is not None
        assert square.cost.value - 4 * square.cost.standard_error <= policy.guarantee.cost
    assert len(differences) > 1
    assert agree_together(differences), differences


def test_what_states_its_own_gains_is_refused() -> None:
    """A design delay, a given controller, and bursts, whose state nobody knows."""
    late = network(seconds([0.06, 0.15], [0.5, 0.5]))
    given: dict[str, Any] = {"theta": 0.1, "period": PERIOD, "gains": "loss-optimal"}
    with pytest.raises(ProblemError, match="design_delay is given, which states the gains"):
        excess(LATE, WEIGHTS, network=late, design_delay=0.1, **given)
    kept = taciturn.Controller([[0.5]], [[0.3]], [[-0.1]], [[-0.1]])
    with pytest.raises(ProblemError, match="a controller is given, which states the gains"):
        excess(LATE, WEIGHTS, network=late, controller=kept, **given)
    states = {"states": [seconds([0.06], [1.0]), seconds([0.06], [0.5])]}
    bursts = network(states, burst=taciturn.Burst(0.1, 0.3, 0.0, 0.2))
    with pytest.raises(ProblemError, match="the state of a link with bursts is unknown"):
        excess(LATE, WEIGHTS, network=bursts, **given)
