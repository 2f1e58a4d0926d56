"""What a default adds to a plant is shown, and the verdict is about the plant that the user has written."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

import taciturn
from taciturn import Network, Plant, Problem
from taciturn.loop import close
from taciturn.problem import parse
from taciturn.study.record import decode, encode

MOTOR = """
[plant]
A = [[-4.0, 0.0], [1.0, 0.0]]
B = [[1.0], [0.0]]
C = [[0.0, 7.2]]
W = [[0.0018, 0.0], [0.0, 0.0]]
V = [[4e-6]]
[cost]
output_variance = [1e-4]
input_variance = [1.0]
[controller]
pid = {kp = 6.0, ki = 2.0, kd = 0.6, filter = 0.03}
[policy]
kind = "excess"
theta = 0.05
period = 0.02
"""


def motor(more: str = "") -> Problem:
    """Return a motor under a PID controller, whose file states no disturbance, or more keys of the controller."""
    return parse(tomllib.loads(MOTOR.replace("[policy]", f"{more}\n[policy]")), "motor")


def by_hand(problem: Problem, ticks: int, paths: int) -> tuple[float, float]:
    """Return the cost at sampling instants on a plant without disturbance, with its standard error, by trajectories."""
    policy = problem.design()
    assert isinstance(problem.plant, taciturn.ContinuousPlant)
    A = np.zeros((3, 3))
    A[:2, :2], A[:2, 2:] = problem.plant.A, problem.plant.B
    A[2, 2] = -1 / 20.0
    plant = taciturn.ContinuousPlant(
        A, [[1.0], [0.0], [0.0]], np.diag([0.0018, 0.0, 0.0]), C=[[0.0, 7.2, 0.0]], V=problem.plant.V
    )
    loop = close(plant, policy, Network(), problem.cost)
    costs = list[float]()
    for seed in range(paths):
        path = taciturn.simulate(loop, steps=ticks, seed=seed)
        stage = (7.2 * path.state[:, 1]) ** 2 / 1e-4 + path.input[:, 0] ** 2
        costs.append(float(stage[ticks // 5 :].mean()))
    return float(np.mean(costs)), float(np.std(costs, ddof=1) / np.sqrt(paths))


@pytest.mark.evidence
def test_the_loop_on_the_plant_as_written_stands_beside_the_one_with_the_disturbance_by_default() -> None:
    """Cost of every sample exactly, of the policy by a simulation, and the verdict is about this plant."""
    problem = motor()
    found = taciturn.evaluate(problem, standard_error=2e-3)
    written = found.as_written
    assert written is not None
    assert written.added == "time constant 20 s, deviation 0.15"
    without = motor('disturbance = "none"').design()
    assert written.cost_all_time == pytest.approx(without.cost_all_time, rel=1e-12)
    assert found.cost_all_time == pytest.approx(problem.design().cost_all_time, rel=1e-12)
    text = " ".join(str(found).split())
    assert text.startswith("plant as written: ")
    assert found.verdict[1].startswith("with a slow disturbance by default: ")
    assert "as written the table is for a slow disturbance at each input that the problem does not state" in text
    assert f"this policy costs {written.cost}, every sample 1.46833" in text
    assert found.document()["as_written"]["cost"]["value"] == written.cost.value
    assert decode(encode(found)).as_written == written


@pytest.mark.parametrize("paths", [8, pytest.param(64, marks=pytest.mark.evidence)])
def test_the_cost_on_the_plant_as_written_is_that_of_trajectories(paths: int) -> None:
    """Of a plant that is built by hand, whose disturbance is zero."""
    problem = motor().changed({"theta": 3.5})
    found = taciturn.evaluate(problem, standard_error=1e-2).as_written
    assert found is not None
    cost, error = by_hand(problem, 6000, paths)
    between = 0.02 * cost  # what an integral differs by from the mean at sampling instants
    assert abs(found.cost.value - cost) <= 4 * np.hypot(found.cost.standard_error, error) + between
    assert found.cost_all_time is not None
    assert found.cost.value > 1.2 * found.cost_all_time


@pytest.mark.evidence
def test_a_budget_in_percent_shows_what_it_is_on_the_plant_as_written() -> None:
    """Five percent with the disturbance are thirty without it; both are in the line of the budget."""
    found = taciturn.tune(motor(), cost="+5%", standard_error=5e-3)
    written = found.evaluation.as_written
    assert written is not None
    assert written.cost_all_time is not None
    assert 0.25 < written.cost.value / written.cost_all_time - 1 < 0.35
    (budget,) = [text for name, text in found.lines() if name == "budget"]
    assert "for the plant with the disturbance that is added by default" in budget
    assert f"on the plant as written, the cost is {written.cost}, +" in budget


@pytest.mark.parametrize("more", ['disturbance = "none"', "disturbance = {time_constant = 20.0, deviation = 0.15}"])
def test_what_the_user_states_is_what_the_user_has_written(more: str) -> None:
    """Nothing is added, so there is no other plant."""
    found = taciturn.evaluate(motor(more), steps=200_000)
    assert found.as_written is None
    assert "as_written" not in found.document()
    assert "plant as written" not in str(found)


def test_a_controller_without_an_integrator_gets_no_disturbance() -> None:
    """So nothing is shown."""
    plant = Plant([[0.9]], [[1.0]], [[0.1]], [[1.0]], [[0.1]])
    controller = taciturn.controller_from([[0.5]])
    problem = Problem(
        plant, taciturn.Cost([[1.0]], [[0.1]]), Network(), "excess", {"theta": 0.1}, controller=controller
    )
    assert taciturn.evaluate(problem, steps=100_000).as_written is None


def test_over_losses_the_loop_that_sends_every_sample_loses_packets_on_the_plant_as_written_too() -> None:
    """Its cost is simulated, as the exact cost of the controller is that without losses."""
    losses = '[network]\nprotocol = "udp"\nactuator_loss = 0.3'
    written = taciturn.evaluate(motor(losses), steps=2000, seed=1).as_written
    assert written is not None
    assert written.cost_all_time is None
    assert written.cost_every_sample is not None
    assert written.cost_every_sample.standard_error > 0.0
