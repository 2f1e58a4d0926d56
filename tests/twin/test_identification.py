"""Models that an experiment finds, against what the physics does."""

from __future__ import annotations

import json

import numpy as np
import pytest
from twin.looks import true_calibration

from taciturn.errors import ProblemError
from taciturn_twins import identification
from taciturn_twins.body import Body
from taciturn_twins.calibration import Calibration, calibrate
from taciturn_twins.catalogue import ROBOTS
from taciturn_twins.identification import identify
from taciturn_twins.robot import Robot

both = pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)


def physics(robot: Robot, groups: int) -> tuple[np.ndarray, np.ndarray]:
    """Return B as true states have it, with standard errors, by a computation of its own.

    In other runs of the same kind of inputs: a robot with inertia has another B for inputs of another kind.
    """
    random = np.random.default_rng(99)
    estimates = []
    for _ in range(groups):
        U, D = [], []
        for _ in range(2):
            start = np.array(robot.low) + (np.array(robot.high) - robot.low) * random.uniform(0.3, 0.7)
            body = Body(robot, int(random.integers(2**31)), start=start)
            for k, u in enumerate(identification._excite(robot, start, random), 1):
                before = body.pose
                body.act(u)
                body.flow(k * robot.tick)
                U.append(u)
                D.append(body.pose - before)
        estimates.append(np.linalg.lstsq(np.array(U), np.array(D), rcond=None)[0].T)
    return np.mean(estimates, axis=0), np.std(estimates, axis=0, ddof=1) / np.sqrt(groups)


@pytest.mark.evidence
def test_the_rover_is_the_integrator_that_the_physics_makes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """B is within 4.5 standard errors of what true positions of other runs give; A, left free, is nearly 1.

    W has the order of the thesis's 1e-4 m², V is that of a repeated picture, and what was held out says the same.
    """
    for name, size in (("RUNS", 4), ("HELD_OUT", 1), ("TICKS", 13), ("PLACES", 1)):
        monkeypatch.setattr(identification, name, size)
    rover = identify(ROBOTS["rover"], true_calibration(ROBOTS["rover"]), 3)
    B, error = physics(ROBOTS["rover"], 3)
    assert abs(rover.B - B)[0, 0] < 4.5 * np.hypot(rover.B_standard_error, error)[0, 0]
    assert rover.B_standard_error[0, 0] < 0.1 * rover.B[0, 0]
    assert 0.75 < rover.B[0, 0] / rover.B_nominal[0, 0] < 1.05  # friction and slip only take
    assert abs(rover.A_free[0, 0] - 1) < 0.02
    assert 1e-5 < rover.W[0, 0] < 5e-4
    assert 1e-10 < rover.V[0, 0] < 1e-6
    # a run of 8 steps whose disturbance forgets within two steps: some 4 draws, of which the root is good to 35 %
    assert rover.held_out[0] == pytest.approx(np.sqrt(rover.W[0, 0] + 2 * rover.V[0, 0]), rel=0.6)
    document = json.loads(json.dumps(rover.document()))
    assert document["robot"] == "rover"
    assert document["B"] == rover.B.tolist()
    assert document["samples"] == 4 * (identification.TICKS - identification.START)


@pytest.mark.evidence
def test_a_camera_that_is_not_this_one_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A calibration that is wrong sees no marker where it looks."""
    monkeypatch.setattr(identification, "PLACES", 2)
    true = true_calibration(ROBOTS["rover"])
    wrong = Calibration(true.K, true.distortion, true.rotation, true.translation + np.array([0.0, 0.6, 0.0]), 0.0)
    with pytest.raises(ProblemError, match="calibrate"):
        identify(ROBOTS["rover"], wrong)


@pytest.mark.evidence
@both
def test_a_calibrated_camera_identifies_what_the_physics_does(robot: Robot) -> None:
    """All entries of B within 4.5 standard errors of what true states give; the same bits of the same seed."""
    calibration = calibrate(robot, 4)
    found = identify(robot, calibration, 5)
    B, error = physics(robot, 24)
    assert (abs(found.B - B) < 4.5 * np.hypot(found.B_standard_error, error)).all()
    assert found.document() == identify(robot, calibration, 5).document()
    assert np.linalg.eigvalsh(found.W)[0] > 0
    assert np.linalg.eigvalsh(found.V)[0] > 0
