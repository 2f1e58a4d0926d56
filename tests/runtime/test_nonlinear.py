"""Plants that are not linear next to nodes: over UDP, in python-control, and with nodes in C."""

from __future__ import annotations

from pathlib import Path

import control
import numpy as np
import pytest
from export.test_folders import AGREES, compile_check, run_check, write

from taciturn import Nodes, Plant, UnstableError, load, run_network, to_control
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn_export.folder import print_folder

NAMES = ("pendulum-on-a-cart", "pendulum-by-encoders", "omni-heading")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.evidence
def test_processes_control_a_plant_that_is_not_linear_as_nodes_in_memory_do(name: str) -> None:
    """The same costs and sends to the last bit, and no guarantee."""
    problem, ticks = load(name), 150
    loop = problem.close(problem.design())
    found = run_network(name, steps=ticks, seed=4)
    plant, nodes = SimulatedPlant(loop, 4), Nodes(loop.policy)
    costs, sent = [], []
    for _ in range(ticks):
        u = nodes.step(plant.measurement)
        sent.append(nodes.sent["actuator"])
        costs.append(plant.move(u.tolist()))
    assert found.costs.tolist() == costs
    assert (found.sends["actuator"] > 0).tolist() == sent
    document = found.document()
    assert (document["cost_bound"], document["cost_all_time"]) == (None, None)
    assert document["notes"][-1].startswith("the plant is not linear")


def test_a_simulated_plant_that_gives_no_number_says_which() -> None:
    """With where it came from, and with what input."""
    problem = load("omni-heading")
    plant = problem.plant
    assert isinstance(plant, Plant)

    def edge(x: np.ndarray, u: np.ndarray, w: np.ndarray) -> np.ndarray:
        return x * np.sqrt(1.0 - x * x) + 0.1 * u + w

    other = Plant(plant.A, plant.B, 0 * plant.W, dt=plant.dt, mean=[0.0, 0.9, 0.0], function=edge)
    simulated = SimulatedPlant(type(problem)(other, problem.cost, problem.network, "lqg", {"theta": 0.1}).close(
        problem.design()
    ))  # fmt: skip
    simulated.move([0.0, 7.0, 0.0])
    with pytest.raises(
        UnstableError, match=r"^the loop drives .* no finite number as state 2 at step 2, from x = \[0.0, 1"
    ):
        simulated.move([0.0, 0.0, 0.0])


@pytest.mark.parametrize("name", NAMES)
def test_plants_and_loops_are_systems_of_python_control(name: str) -> None:
    """The function without its noise, and the loop with its noise supplied: the same numbers."""
    problem = load(name)
    plant, loop = problem.plant, problem.close(problem.design())
    assert isinstance(plant, Plant)
    assert plant.function is not None
    system = to_control(plant)
    draws = np.random.default_rng(1)
    u, start = 0.5 * draws.normal(size=(plant.inputs, 20)), 0.2 * draws.normal(size=plant.states)
    time = np.arange(20) * plant.dt
    found = control.input_output_response(system, time, u, start)
    x = start
    for k in range(20):
        np.testing.assert_allclose(found.states[:, k], x, rtol=1e-12, atol=1e-12)
        x = plant.function(x, u[:, k], np.zeros(plant.states))
    closed = to_control(loop)
    w = 0.01 * draws.normal(size=(plant.states + plant.outputs, 20))
    moved = control.input_output_response(closed, time, w, [*plant.mean, 0])
    assert np.isfinite(moved.outputs).all()
    assert moved.outputs[plant.outputs : plant.outputs + plant.inputs].any()


@pytest.mark.evidence
def test_nodes_in_c_decide_for_a_plant_that_is_not_linear(tmp_path: Path) -> None:
    """Exported as ever: the self-check was recorded with the plant that is not linear."""
    problem = load("pendulum-by-encoders")
    check = compile_check(write(tmp_path, print_folder(problem.close(problem.design()), "policy")))
    assert run_check(check) == (0, f"policy: 500 {AGREES}")
