"""Bodies that move as the physics says, the same of the same seed, and do what they are asked for."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taciturn.errors import ProblemError
from taciturn_thesis.chapter7 import two_circles
from taciturn_twins.body import Body
from taciturn_twins.catalogue import ROBOTS, reference
from taciturn_twins.robot import Robot

ROVER, OMNI = ROBOTS["rover"], ROBOTS["omni"]
both = pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
MILLIMETRE = 1e-3


def drive(robot: Robot, seed: int, times: list[float]) -> tuple[list[float], tuple[float, ...]]:
    """Return where a run in which everything happens ends, and what a camera sees then."""
    body = Body(robot, seed, gain_error=0.05)
    for k, until in enumerate(times):
        body.act([0.2 * (k + 1)] * len(robot.inputs))
        if k == 1:
            body.push(5.0, 0.1, 0.3)
        if k == 2:
            body.kidnap([0.01] * len(robot.states))
        body.flow(until)
    return body.pose.tolist(), body.snapshot


@both
def test_a_run_repeats_with_its_seed_and_only_with_it(robot: Robot) -> None:
    """The same bits of the same seed and calls; others of another seed."""
    times = [0.1, 0.2, 0.4]
    assert drive(robot, 3, times) == drive(robot, 3, times)
    assert drive(robot, 3, times) != drive(robot, 4, times)


@both
@settings(max_examples=5)
@given(split=st.floats(0.0, 0.3))
def test_time_may_be_split_anywhere(robot: Robot, split: float) -> None:
    """Flowing to a time by way of another is flowing there."""
    whole, parts = Body(robot, 1), Body(robot, 1)
    for body in (whole, parts):
        body.act([0.3] * len(robot.inputs))
    whole.flow(0.3)
    parts.flow(split)
    assert parts.time <= split + 1e-9
    parts.flow(0.3)
    assert parts.time == whole.time == pytest.approx(0.3)
    assert parts.snapshot == whole.snapshot


@both
def test_a_body_stands_where_it_is_put(robot: Robot) -> None:
    """Its start is the robot's own or the one that is asked for, and a robot with nothing to do stays there."""
    body = Body(robot, disturbance=0.0)
    np.testing.assert_allclose(body.pose, robot.start, atol=1e-12)
    body.flow(1.0)
    np.testing.assert_allclose(body.pose, robot.start, atol=0.1 * MILLIMETRE)
    place = np.array(robot.low) + 0.3
    np.testing.assert_allclose(Body(robot, start=place).pose, place, atol=1e-12)
    assert len(body.snapshot) == robot.seen


@both
@settings(max_examples=10)
@given(by=st.floats(-3.0, 3.0), turn=st.floats(-9.0, 9.0))
def test_a_kidnapped_robot_is_moved_by_exactly_that(robot: Robot, by: float, turn: float) -> None:
    """Before and after, and twice; a heading continues beyond ±π, and while the robot moves."""
    body = Body(robot, 2)
    body.act([0.4] * len(robot.inputs))
    body.flow(0.2)
    offset = np.array([by, -by / 2, turn][: len(robot.states)])
    before = body.pose
    body.kidnap(offset)
    np.testing.assert_allclose(body.pose - before, offset, atol=1e-9)
    body.flow(0.202)
    np.testing.assert_allclose(body.pose - before, offset, atol=0.01)
    if robot.turns:
        w, x, y, z = body.snapshot[3:7]
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        assert math.remainder(yaw - body.pose[2], 2 * math.pi) == pytest.approx(0.0, abs=1e-9)


def test_a_push_moves_the_robot_while_it_lasts() -> None:
    """Along its direction, back by the opposite one, and for as long as it was asked for."""
    ways = {}
    for direction in (0.0, math.pi):
        body = Body(ROVER, disturbance=0.0)
        body.push(8.0, 0.5, direction)
        body.flow(0.5)
        pushed = body.pose[0] - 0.7
        body.flow(0.6)
        rest = body.pose[0]
        body.flow(1.6)
        assert abs(body.pose[0] - rest) < 0.1 * MILLIMETRE
        ways[direction] = pushed
    assert ways[0.0] > 5 * MILLIMETRE
    assert ways[math.pi] == pytest.approx(-ways[0.0], rel=0.05)


@both
def test_inputs_are_clipped_and_held(robot: Robot) -> None:
    """Ten times the limit is the limit, and it lasts until it is replaced."""
    limited, greedy = Body(robot), Body(robot)
    limited.act(robot.input_limit)
    greedy.act([10 * limit for limit in robot.input_limit])
    for body in (limited, greedy):
        body.flow(0.1)
        body.flow(0.2)
    assert limited.snapshot == greedy.snapshot
    assert np.abs(limited.pose - robot.start).max() > 5 * MILLIMETRE


def test_a_gain_error_is_one_of_the_motors() -> None:
    """A rover with 10 % more gain is 10 % faster; a robot whose three motors differ turns though it should not."""
    speeds = []
    for error in (0.0, 0.1):
        body = Body(ROVER, gain_error=error, disturbance=0.0)
        body.act([-50.0])
        body.flow(1.0)
        at = body.pose[0]
        body.flow(3.0)
        speeds.append(body.pose[0] - at)
    # friction costs each the same 1.4 % of full speed, which is 3 % of this one
    assert speeds[1] / speeds[0] == pytest.approx(1.1, abs=0.01)
    straight, askew = Body(OMNI, disturbance=0.0), Body(OMNI, disturbance=0.0, gain_error=0.1)
    for body in (straight, askew):
        body.act([0.4, 0.0, 0.0])
        body.flow(2.0)
    assert abs(straight.pose[2]) < 0.02
    assert abs(askew.pose[2]) > 3 * abs(straight.pose[2])


@pytest.mark.evidence
def test_wheels_of_capsules_and_of_rollers_drive_the_same_circle() -> None:
    """In open loop a circle of 0.5 m at 0.5 m/s while the robot turns: 3 cm apart at most, one hundredth of the way.

    The rollers of a wheel are a polygon, on which it rolls unevenly: that is what the capsules leave out.
    """
    ends = {}
    for variant in OMNI.variants:
        body = Body(OMNI, disturbance=0.0, variant=variant)
        path = []
        for k in range(63):
            body.act([-0.5 * math.sin(0.1 * k), 0.5 * math.cos(0.1 * k), 0.2])
            body.flow(0.1 * (k + 1))
            path.append(body.pose)
        ends[variant] = np.array(path)
    assert np.ptp(ends["rollers"][:, 0]) > 0.8
    away = np.linalg.norm((ends["capsule"] - ends["rollers"])[:, :2], axis=1)
    assert away.max() < 0.03
    assert np.abs((ends["capsule"] - ends["rollers"])[:, 2]).max() < 0.06


def test_the_disturbance_has_the_size_that_is_asked_for() -> None:
    """None leaves the robot where it is; twice as much moves it further; the motors hold against its mean."""
    spread = {}
    for size in (0.0, 1.0, 2.0):
        ends = []
        for seed in range(6):
            body = Body(ROVER, seed, disturbance=size)
            body.flow(0.9)
            ends.append(body.pose[0] - 0.7)
        spread[size] = float(np.sqrt(np.mean(np.square(ends))))
    assert spread[0.0] < 0.1 * MILLIMETRE
    assert spread[1.0] > 5 * MILLIMETRE
    assert spread[2.0] > 1.5 * spread[1.0]  # more than twice: stiction takes its part of each


def test_the_reference_is_that_of_the_thesis() -> None:
    """Two circles for one robot, none for the other; it begins where the robot does."""
    states = reference(OMNI)
    assert states is not None
    assert states.shape == (251, 3)
    np.testing.assert_array_equal(states, two_circles().states)
    np.testing.assert_allclose(states[0], OMNI.start, atol=1e-12)
    assert reference(ROVER) is None


def test_impossible_bodies_and_calls_are_refused() -> None:
    """Each by one sentence that says what is expected."""
    body = Body(ROVER)
    calls = [
        lambda: Body(ROVER, start=[0.1, 0.2]),
        lambda: Body(ROVER, variant="rollers"),
        lambda: Body(OMNI, variant="tracks"),
        lambda: Body(ROVER, disturbance=-1.0),
        lambda: Body(ROVER, -1),
        lambda: body.act([math.nan]),
        lambda: body.act([1.0, 2.0]),
        lambda: body.flow(math.inf),
        lambda: body.push(1.0, -1.0),
        lambda: body.kidnap([0.1, 0.1, 0.1]),
    ]
    for call in calls:
        with pytest.raises(ProblemError, match="expected"):
            call()


def test_a_body_that_is_thrown_out_of_the_range_of_numbers_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sentence, no number, and no file that MuJoCo would leave where the user is."""
    monkeypatch.chdir(tmp_path)
    for robot in ROBOTS.values():
        body = Body(robot)
        body.push(1e12, 1.0)
        with pytest.raises(ProblemError, match="the coordinates of the rigid bodies are out of range"):
            body.flow(1.0)
    assert list(tmp_path.iterdir()) == []
