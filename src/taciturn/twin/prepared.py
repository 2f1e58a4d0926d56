"""A robot that is ready to be run: its camera calibrated, its model identified."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from taciturn._arrays import count
from taciturn.twin.calibration import Calibration, calibrate
from taciturn.twin.catalogue import find_robot
from taciturn.twin.identification import Identification, identify
from taciturn.twin.mission import tables_of
from taciturn.twin.robot import Robot


@dataclass(frozen=True, eq=False)
class Prepared:
    """A robot whose camera is calibrated and whose model is identified.

    Args:
        robot: which one.
        calibration: of its camera.
        model: what the experiment has found.
        seed: of both.
    """

    robot: Robot
    calibration: Calibration
    model: Identification
    seed: int

    def tables(self, parameters: Mapping[str, float]) -> dict[str, Any]:
        """Return the tables of its problem file, with parameters of the policy."""
        return tables_of(self.robot, self.model, parameters)


def prepare(name: str, seed: int = 0) -> Prepared:
    """Calibrate the camera of a robot by what is known of its scene, then identify a model with it.

    Args:
        name: ``"rover"`` or ``"omni"``.
        seed: of the camera's noise and of what disturbs the robot.

    Raises:
        ProblemError: no such robot, or an extra or a driver is missing.
    """
    robot = find_robot(name)
    calibration = calibrate(robot, count("seed", seed, 0))
    return Prepared(robot, calibration, identify(robot, calibration, seed), seed)
