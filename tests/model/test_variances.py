"""Costs by variances: Bryson's rule, and the present variances of a loop that is kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import taciturn
from taciturn import PID, Cost, Disturbance, Plant, ProblemError, design
from taciturn.base.given_controller import cost_as_now
from taciturn.design.at_fixed_steps import sending_always
from taciturn.simulation.trajectory import simulate

STEP = 0.1
TANK = Plant([[1, STEP], [0, 0.9]], [[0], [STEP]], np.diag([1e-4, 4e-4]), [[1, 0]], [[1e-3]], dt=STEP)
KEPT = PID(1.2, 0.15, 1.0, 0.5, Disturbance(deviation=0.0))
FILE = """
[plant]
A = [[1.0, 0.1], [0.0, 0.9]]
B = [[0.0], [0.1]]
C = [[1.0, 0.0]]
W = [[1e-4, 0.0], [0.0, 4e-4]]
V = [[1e-3]]
dt = 0.1

[controller]
pid = {kp = 1.2, ki = 0.15, kd = 1.0, filter = 0.5}
disturbance = "none"

[policy]
kind = "excess"
theta = 0.1

[cost]
"""


def read(tmp_path: Path, cost: str) -> taciturn.Problem:
    """Return the problem of a file with this cost."""
    (tmp_path / "tank.toml").write_text(FILE + cost, encoding="utf-8")
    return taciturn.load(tmp_path / "tank.toml")


def test_the_present_loop_weighs_its_variances_equally() -> None:
    """Every output and every input costs 1 on average, with every sample; as in a simulation."""
    cost = cost_as_now(TANK, KEPT)
    policy = design.excess(TANK, cost, theta=0.1, controller=KEPT)
    assert policy.cost_all_time == pytest.approx(2.0, rel=1e-9)
    always = taciturn.close(TANK, sending_always(policy))
    run = simulate(always, steps=20_000, seed=1)
    x, u = np.asarray(run.state)[2000:], np.asarray(run.input)[2000:]
    assert np.var(x[:, 0]) * cost.Q[0, 0] == pytest.approx(1.0, rel=0.15)
    assert np.var(u) * cost.R.item() == pytest.approx(1.0, rel=0.15)


def test_several_outputs_and_inputs_count_equally() -> None:
    """Also in continuous time, where the variances are those at the sampling instants."""
    plant = taciturn.ContinuousPlant(
        [[-0.1, 0.05], [0.0, -0.2]], np.eye(2), 0.01 * np.eye(2), C=np.eye(2), V=0.01 * np.eye(2)
    )
    loops = taciturn.controller_from([PID(1.0), PID(0.5, input=2, output=2)])
    cost = cost_as_now(plant, loops, 0.1)
    sampled = cost_as_now(design.excess(plant, cost, theta=1, period=0.1, controller=loops).model, loops)
    assert pytest.approx(cost.Q, rel=1e-9) == sampled.Q
    assert pytest.approx(cost.R, rel=1e-9) == sampled.R


def test_a_problem_file_states_variances(tmp_path: Path) -> None:
    """Of outputs and inputs, or those of the controller's loop."""
    found = read(tmp_path, "output_variance = [0.01]\ninput_variance = [4.0]").cost
    assert found.Q.tolist() == [[100.0, 0.0], [0.0, 0.0]]
    assert found.R.tolist() == [[0.25]]
    assert found.same_as(Cost.of_variances(TANK.C, [0.01], [4.0]))
    assert read(tmp_path, "output_variance = [0.01]\ninput_variance = [4.0]\nhorizon = 9").cost.horizon == 9
    problem = read(tmp_path, 'weights = "as the controller"')
    assert problem.design().cost_all_time == pytest.approx(2.0, rel=1e-9)
    assert problem.changed({"theta": 0.2}).cost.same_as(problem.cost)


@pytest.mark.parametrize(
    ("cost", "words"),
    [
        (
            "Q = [[1.0, 0.0], [0.0, 1.0]]",
            "the key cost.R is missing; expected it in the table [cost], or output_variance",
        ),
        ("output_variance = [0.01]", "the key cost.input_variance is missing"),
        ("output_variance = [0.01]\nR = [[1.0]]", "cost.output_variance and cost.R are both given; expected only one"),
        ("output_variance = [0.01]\ninput_variance = [-4.0]", "input_variance contains -4; expected positive"),
        ("output_variance = [0.01, 1.0]\ninput_variance = [4.0]", "output_variance has shape (2,); expected"),
        ('weights = "mine"', "cost.weights is 'mine'; expected 'as the controller'"),
        ('weights = "as the controller"\nQ = [[1.0]]', "cost.weights and cost.Q are both given"),
    ],
)
def test_a_wrong_cost_is_refused(tmp_path: Path, cost: str, words: str) -> None:
    """In one sentence."""
    with pytest.raises(ProblemError) as told:
        read(tmp_path, cost)
    assert words in str(told.value)
