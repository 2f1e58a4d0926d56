"""What the tests of the twins share: what only the simulator knows of a camera, and errors over the workspace."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from taciturn_twins import _cv2
from taciturn_twins.body import Body
from taciturn_twins.calibration import Calibration
from taciturn_twins.camera import Camera
from taciturn_twins.catalogue import ROBOTS
from taciturn_twins.robot import Robot
from taciturn_twins.vision import Eye


def true_calibration(robot: Robot) -> Calibration:
    """Return the camera as the simulator has it."""
    scene = robot.build(robot.variants[0])
    data: Any = scene.mujoco.MjData(scene.model)
    scene.mujoco.mj_forward(scene.model, data)
    axes = np.diag([1.0, -1.0, -1.0]) @ data.camera("webcam").xmat.reshape(3, 3).T
    rotation = _cv2.rotation_vector(axes)
    return Calibration(robot.lens.K, np.array(robot.lens.distortion), rotation, -axes @ data.camera("webcam").xpos, 0.0)


@cache
def _camera(name: str, seed: int) -> Camera:
    return Camera(ROBOTS[name], seed)


def camera_of(robot: Robot, seed: int = 0) -> Camera:
    """Return the camera of a robot, in its usual light and with nothing over the marker; it is made once."""
    camera = _camera(robot.name, seed)
    camera.lighting, camera.covered = 1.0, False
    return camera


def errors(
    robot: Robot, calibration: Calibration, places: int, lighting: float = 1.0, seed: int = 7
) -> npt.NDArray[np.float64]:
    """Return measured less true states at places all over the workspace, (found, n)."""
    random = np.random.default_rng(seed)
    body, camera, eye = Body(robot, disturbance=0.0), camera_of(robot, seed), Eye(robot, calibration)
    camera.lighting = lighting
    found = []
    for k in range(places):
        body.kidnap(random.uniform(robot.low, robot.high) - body.pose)
        measured = eye.see(camera.take(body.snapshot, k))
        if measured is not None:
            found.append(measured - body.pose)
            if robot.turns:
                found[-1][2] = math.remainder(found[-1][2], 2 * math.pi)
    return np.array(found)
