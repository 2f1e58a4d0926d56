"""Sets of links to several actuators whose packets arrive late or never, with acknowledgements: identity and bound."""

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
from taciturn.model.network import NodeRole
from taciturn.simulation.average import plain_average

SENSOR, BOARD = NodeRole(measures=True, site="board"), NodeRole(controls=True)


def network(laws: dict[str, LinkLaw | None]) -> Network:
    """Return a network with an actuator for each law, which applies one input; None: it is at the controller's site."""
    nodes = {"sensor": SENSOR, "board": BOARD}
    for i, (name, law) in enumerate(laws.items()):
        nodes[name] = NodeRole(applies=[i], site=None if law else "board")
    return Network(nodes=nodes, links={name: law for name, law in laws.items() if law})


def link(rng: np.random.Generator, parts: bool, told_late: int) -> LinkLaw | None:
    """Return the law of a link: ideal, wired, late, with losses, or with bursts of losses and delays."""
    told: Any = {"acknowledged": True, "acknowledgement_delay": told_late}
    form, loss, price = int(rng.integers(8)), float(rng.choice([0.0, 0.1])), float(rng.choice([1.0, 3.0]))
    if form == 0:
        return None
    if form == 1:
        return LinkLaw(price=price)
    if form == 2:
        return LinkLaw(loss=0.2, price=price, **told)
    count = int(rng.integers(1, 3))
    share = rng.dirichlet(np.ones(count)) * rng.uniform(0.8, 1.0)
    law: Any = share.tolist()
    if parts:
        law = {"seconds": sorted(rng.uniform(0, 0.35, count).round(2).tolist()), "probability": share.tolist()}
    if form == 3 and not told_late:
        other = {**law, "probability": share[::-1].tolist()} if parts else share[::-1].tolist()
        burst = Burst(*rng.uniform(0.05, 0.4, 2), 0.0, loss)
        return LinkLaw(delay={"states": [law, other]}, burst=burst, price=price, **told)
    return LinkLaw(delay=law, loss=loss, price=price, **told)


def drawn(seed: int, told_late: int = 0) -> tuple[Plant | ContinuousPlant, Policy]:
    """Return a plant with two inputs and a policy that decides on the links to its actuators.

    Acknowledgements come one step late, if ``told_late`` is 1, and then only with a given controller.
    """
    rng = np.random.default_rng(seed)
    parts, given = bool(rng.integers(2)), rng.integers(3) == 0 or bool(told_late)
    A, B = rng.normal(size=(2, 2)), rng.normal(size=(2, 2))
    C, W = rng.normal(size=(1, 2)), np.diag(rng.uniform(0.1, 1.0, 2))
    root = rng.normal(size=(4, 4))
    joint = root @ root.T / 4 + 0.1 * np.eye(4)
    cost, more = Cost(joint[:2, :2], joint[2:, 2:], joint[:2, 2:]), dict[str, Any]()
    if parts:
        A = A + np.eye(2) * (rng.uniform(-0.8, 0.3) - np.linalg.eigvals(A).real.max())
        plant: Plant | ContinuousPlant = ContinuousPlant(A, B, W, C=C, V=[[0.05]])
        more["period"] = 0.2
    else:
        A = A * rng.uniform(0.5, 1.1) / np.abs(np.linalg.eigvals(A)).max()
        plant = Plant(A, B, W, C, [[0.05]])
    if given:
        k = -rng.uniform(0.0, 0.2, (2, 1))
        more["controller"] = Controller([[0.5]], [[0.3]], k, k)
    laws = {"left": link(rng, parts, told_late), "right": link(rng, parts, told_late)}
    late = [law for law in laws.values() if law is not None and law.acknowledged]
    if not late:
        raise ProblemError("no link drops or delays packets")
    theta = float(rng.choice([0.0, 0.1, 0.5]))
    return plant, excess(plant, cost, theta=theta, network=network(laws), **more)


def usual(seed: int, told_late: int) -> tuple[Loop, Policy] | None:
    """Return the loop of a seed; None if it is not stable or its averages have no variance."""
    try:
        plant, policy = drawn(seed, told_late)
    except (UnstableError, ProblemError):
        return None
    fourth = policy.theory.fourth
    return None if fourth is None or fourth > 0.97 else (close(plant, policy), policy)


@pytest.mark.parametrize("told_late", [0, 1])
@pytest.mark.parametrize("first", few(range(0, 600, 8), 1))
def test_the_identity_holds_and_no_bound_is_broken(first: int, told_late: int) -> None:
    """The average of the stage cost is J_base plus what silence costs, on eight random loops together."""
    differences = list[float]()
    for seed in range(first, first + 8):
        made = usual(seed, told_late)
        if made is None:
            continue
        loop, policy = made
        assert loop.nominal
        assert policy.guarantee is not None
        square = average(loop, steps=60_000, seed=seed)
        plain = average(loop, plain_average(loop), steps=60_000, seed=seed + 1)
        error = np.hypot(plain.cost.standard_error, square.cost.standard_error)
        differences.append((plain.cost.value - square.cost.value) / error)
        assert square.cost.value - 4 * square.cost.standard_error <= policy.guarantee.cost
        rates = {name: one.scaled(policy.tick) for name, one in square.rates.items()}  # per step
        bound = policy.guarantee.at_rates(rates, policy.scheduled[0])
        assert bound is not None
        assert square.cost.value <= bound.value + 4 * (square.cost.standard_error + bound.standard_error)
    assert len(differences) > 1
    assert agree_together(differences), differences
