"""Mean-square stability, and exponential decay without noise."""

from __future__ import annotations

import numpy as np
import pytest
from catalogue import FIELD, POLICIES, STATIONARY, UNPROVED, VANISHING, closed
from counts import few
from drawn import over
from systems import System, systems

from taciturn import Plant, close
from taciturn.program.machine import Kernel


def quiet(plant: Plant) -> Plant:
    """Return the plant without noise, started away from rest."""
    spread = np.eye(plant.states)
    zero = np.zeros_like(plant.W)
    if plant.full_state:
        return Plant(plant.A, plant.B, zero, covariance=spread)
    return Plant(plant.A, plant.B, zero, plant.C, np.zeros_like(plant.V), covariance=spread)


def mean_square_stays(system: System, name: str, ticks: int = 2_000) -> None:
    """The mean square of the state over so many steps is that over as many before."""
    loop = closed(POLICIES[name](system))
    program = loop.program().keep({"cost"})
    kernel = Kernel(program)
    state = kernel.run(program, loop.start(program, 64, system.seed), 2000).states
    first = kernel.run(program, state, ticks)
    second = kernel.run(program, first.states, ticks)
    change = second.sums["cost"] - first.sums["cost"]
    assert np.isfinite(second.sums["cost"]).all()
    assert change.mean() <= 5 * change.std(ddof=1) / np.sqrt(64)


def decays_without_noise(system: System, name: str) -> None:
    """With W = 0 and V = 0 the state shrinks by any factor in proportionate time (Remarks 2.1 and 2.5)."""
    plant = quiet(system.plant)
    policy = POLICIES[name](System(plant, system.cost, system.seed))
    loop = close(plant, policy, cost=system.cost)
    program = loop.program().keep({"cost"})
    kernel = Kernel(program)
    state = loop.start(program, 64, system.seed)
    rows = [i for i, s in enumerate(program.states) if s.name == "x"]
    sizes = [np.linalg.norm(state[rows])]
    for _ in range(3):
        state = kernel.run(program, state, 400).states
        sizes.append(np.linalg.norm(state[rows]))
    decline = np.diff(np.log(np.maximum(sizes, 1e-250)))
    assert sizes[-1] < 1e-3 * sizes[0]
    assert (decline[1:] < -0.5).all() or sizes[1] < 1e-12


@pytest.mark.parametrize("name", few([*UNPROVED, *FIELD[1::3]], 4))
def test_the_mean_square_stays(name: str) -> None:
    """Long runs do not grow."""
    over(lambda system: mean_square_stays(system, name), 2, system=systems())


@pytest.mark.evidence
@pytest.mark.parametrize("name", [*UNPROVED, *FIELD])
def test_the_mean_square_stays_of_the_baselines(name: str) -> None:
    """Long runs do not grow, six systems each: that the cost stays below its bound is shown over 300."""
    over(lambda system: mean_square_stays(system, name), 6, system=systems())


@pytest.mark.evidence
@pytest.mark.parametrize("name", sorted(set(STATIONARY) - set(FIELD)))
def test_the_mean_square_stays_over_300_systems(name: str) -> None:
    """Long runs do not grow, 300 systems each."""
    over(lambda system: mean_square_stays(system, name), 300, system=systems())


@pytest.mark.parametrize("name", VANISHING[::3])
def test_the_state_decays_exponentially_without_noise(name: str) -> None:
    """W = 0 and V = 0 are legal and the loop decays."""
    over(lambda system: decays_without_noise(system, name), 2, system=systems())


@pytest.mark.evidence
@pytest.mark.parametrize("name", sorted(set(VANISHING) & set(FIELD)))
def test_the_state_of_a_baseline_decays_exponentially_without_noise(name: str) -> None:
    """W = 0 and V = 0 are legal and the loop decays, six systems each."""
    over(lambda system: decays_without_noise(system, name), 6, system=systems())


@pytest.mark.evidence
@pytest.mark.parametrize("name", sorted(set(VANISHING) - set(FIELD)))
def test_the_state_decays_exponentially_without_noise_over_300_systems(name: str) -> None:
    """W = 0 and V = 0 are legal and the loop decays, 300 systems each."""
    over(lambda system: decays_without_noise(system, name), 300, system=systems())
