"""Preparation of a robot: its camera is calibrated, then its model is identified with this camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from taciturn.extend import Displayed, count
from taciturn_twins.calibration import Calibration, calibrate
from taciturn_twins.catalogue import find_robot
from taciturn_twins.identification import Identification, identify
from taciturn_twins.mission import tables_of
from taciturn_twins.robot import Robot


@dataclass(frozen=True, eq=False, repr=False)
class Prepared(Displayed):
    """A robot with a calibrated camera and an identified model.

    Args:
        robot: the robot.
        calibration: calibration of its camera.
        model: identified model.
        seed: seed of both experiments.
    """

    robot: Robot
    calibration: Calibration
    model: Identification
    seed: int

    def tables(self, parameters: Mapping[str, float]) -> dict[str, Any]:
        """Return the tables of the robot's problem file, with the given policy parameters."""
        return tables_of(self.robot, self.model, parameters)


def prepare(name: str, seed: int = 0) -> Prepared:
    """Calibrate the camera of a robot from points at known positions, then identify the model with that camera.

    Args:
        name: ``"rover"`` or ``"omni"``.
        seed: seed of the camera noise and the disturbances.

    Raises:
        ProblemError: the robot is unknown, or an optional package or a driver is missing.
    """
    robot = find_robot(name)
    calibration = calibrate(robot, count("seed", seed, 0))
    return Prepared(robot, calibration, identify(robot, calibration, seed), seed)
