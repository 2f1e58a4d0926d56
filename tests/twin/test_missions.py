"""Problem files of robots, and what can be asked to go wrong."""

from __future__ import annotations

import tomllib
from typing import Any

import numpy as np
import pytest
from twin.crews import model

import taciturn
from taciturn.errors import ProblemError
from taciturn.problem import parse
from taciturn_twins.catalogue import ROBOTS
from taciturn_twins.faults import parse_fault, window
from taciturn_twins.mission import all_time, check_mission, tables_of, write_toml
from taciturn_twins.robot import Robot

both = pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)


@both
def test_a_mission_is_a_problem_file_that_keeps_all_digits(robot: Robot) -> None:
    """Written and read it is the same; its policy can be designed, and sends within its guarantee."""
    tables = tables_of(robot, model(robot), {})
    assert tomllib.loads(write_toml(tables)) == tables
    problem = parse(tables, "mission")
    policy = check_mission(robot, problem, "mission")
    assert policy.guarantee is not None
    assert policy.guarantee.cost > policy.cost_all_time
    assert policy.kind == problem.kind


@both
def test_the_policy_that_always_sends_is_the_one_whose_silence_is_worth_nothing(robot: Robot) -> None:
    """It has no loss to allow for, so its guarantee is the all-time cost, which is that of the other policy too."""
    problem = parse(tables_of(robot, model(robot), {}), "mission")
    policy, always = problem.design(), all_time(problem).design()
    assert always.guarantee is not None
    assert always.guarantee.cost == pytest.approx(always.cost_all_time)
    assert always.cost_all_time == pytest.approx(policy.cost_all_time)


def test_the_omni_follows_what_its_identified_model_goes_through() -> None:
    """The feedforward makes the model, not the data sheet's, follow the two circles."""
    robot = ROBOTS["omni"]
    tables = tables_of(robot, model(robot), {})
    states, inputs, B = (np.array(part) for part in (*tables["reference"].values(), tables["plant"]["B"]))
    np.testing.assert_allclose(np.diff(states, axis=0), inputs @ B.T, atol=1e-12)
    centres = np.where(np.arange(251) < 125, -1.0, 1.0)
    np.testing.assert_allclose(np.hypot(states[:, 0] - centres, states[:, 1]), 1.0, atol=1e-9)


def test_parameters_that_a_policy_does_not_have_are_refused() -> None:
    """The rover has no price of a send, the omni no θ."""
    for name, parameters in (("rover", {"price": 0.1}), ("omni", {"theta": 0.1})):
        with pytest.raises(ProblemError, match="expected "):
            tables_of(ROBOTS[name], model(ROBOTS[name]), parameters)


def changed(robot: Robot, **tables: Any) -> taciturn.Problem:
    """Return the robot's problem with other tables."""
    return parse({**tables_of(robot, model(robot), {}), **tables}, "file")


def test_a_policy_for_another_plant_is_refused() -> None:
    """Other sizes, another step, another output, no end, another kind of policy, nodes that share a place."""
    rover, omni = ROBOTS["rover"], ROBOTS["omni"]
    tables = tables_of(rover, model(rover), {})
    plant: dict[str, Any] = tables["plant"]
    endless = {"Q": [[1.0]], "R": [[1.0]]}
    cases = [
        (omni, taciturn.load("rover"), "is not that of the robot omni"),
        (rover, taciturn.load("two-mass-lqg"), "is not that of the robot rover"),
        (rover, taciturn.load("two-mass-continuous"), "is continuous"),
        (rover, changed(rover, plant={**plant, "dt": 0.2}), "dt = 0.2"),
        (rover, changed(rover, plant={**plant, "C": [[2.0]]}), "is not the identity matrix"),
        (rover, changed(rover, cost=endless), "no cost.horizon"),
        (rover, changed(rover, cost=endless, policy={"kind": "lqg", "theta": 0.1}), "no cost.horizon"),
        (rover, changed(rover, policy={"kind": "remote-lqg", "zeta": 0.004, "controller": "actuator"}), "same site"),
    ]  # fmt: skip
    for robot, problem, sentence in cases:
        with pytest.raises(ProblemError, match=sentence):
            check_mission(robot, problem, "file")


def test_faults_are_read_and_written() -> None:
    """What is left out is as usual; what is written reads the same."""
    for text in ("camera@6", "light@6+2=0.4", "kidnap@1.5=0.2,-0.1,0.3", "gain=0.2", "push@3+0.5=7,90", "controller@9"):
        fault = parse_fault(text)
        assert parse_fault(str(fault)) == fault
    assert parse_fault("camera@6").ticks(0.3) == (20, 27)
    assert parse_fault("kidnap@6").ticks(0.3) == (20, 21)
    assert window([parse_fault("actuator@1+1")], "actuator", 0.1) == (10, 20)
    assert window([], "actuator", 0.1) is None
    with pytest.raises(ProblemError, match="given 2 times"):
        window([parse_fault("actuator@1")] * 2, "actuator", 0.1)


@pytest.mark.parametrize(
    "text",
    ["", "camera", "fire@3", "camera@", "camera@x", "camera@-1", "camera@1+0", "camera@1=2", "kidnap@1+2", "gain@1=0.1",
     "kidnap@1=1,2,3,4", "light@1=0", "light@1=nan", "camera@1@2", "push@1+inf", "light@1=1,2,3", "push@1=1,2,3"],
)  # fmt: skip
def test_what_is_no_fault_is_refused(text: str) -> None:
    """One sentence that says what was got, and what is expected."""
    with pytest.raises(ProblemError, match=r"the fault is .*expected"):
        parse_fault(text)
