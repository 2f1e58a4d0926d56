"""The plant of a network is that of the loop, also where a state affects nothing after it was measured."""

from __future__ import annotations

import numpy as np
import pytest

from taciturn import Cost, Plant, ProblemError, UnstableError, close, design
from taciturn.nodes.simulated_plant import SimulatedPlant


def test_a_plant_whose_register_is_measured_has_all_its_states() -> None:
    """The measurement of a step is the register: the program of a step need not keep it, but it is a state."""
    A = np.array([[0.9, 0.3, 0.0], [0.0, 0.7, 0.0], [1.0, 0.0, 0.0]])  # the third state is the first, a step late
    B, C, W = np.array([[0.0], [1.0], [0.0]]), np.array([[0.0, 0.0, 1.0]]), np.zeros((3, 3))
    first = np.array([2.0, -1.0, 5.0])
    plant = Plant(A, B, W, C, [[0.0]], mean=first)
    policy = design.all_time(Plant(A, B, np.diag([0.1, 0.1, 0.0]), C, [[0.1]]), Cost(np.diag([1.0, 1.0, 0.0]), [[1.0]]))
    simulated, x = SimulatedPlant(close(plant, policy), seed=1), first
    for u in (0.5, -0.25, 1.0, 0.0):
        assert np.allclose(simulated.state, x)
        assert np.allclose(simulated.measurement, C @ x)
        simulated.move([u])
        x = A @ x + B @ [u]


def test_a_plant_out_of_range_is_told_from_a_wrong_input() -> None:
    """A world of faults starts an unstable plant again that is cut off, and nothing else."""
    plant = Plant([[2.0]], [[1.0]], [[1.0]])
    simulated = SimulatedPlant(close(plant, design.all_time(plant, Cost([[1.0]], [[1.0]]))), seed=1)
    with pytest.raises(ProblemError, match="the input has 2 entries; expected 1"):
        simulated.move([0.0, 0.0])
    with pytest.raises(UnstableError, match="exceeds the range of double precision"):
        sum(simulated.move([0.0]) for _ in range(3000))
