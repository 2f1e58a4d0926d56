"""The available robots by name, and the trajectories that they follow."""

from __future__ import annotations

from collections.abc import Mapping

from taciturn.errors import ProblemError
from taciturn.extend import Array
from taciturn_thesis.chapter7 import two_circles
from taciturn_twins.omni import OMNI
from taciturn_twins.robot import Robot
from taciturn_twins.rover import ROVER

ROBOTS: Mapping[str, Robot] = {robot.name: robot for robot in (ROVER, OMNI)}


def find_robot(name: str) -> Robot:
    """Return the robot with the given name.

    Raises:
        ProblemError: the name is unknown.
    """
    if name not in ROBOTS:
        raise ProblemError(f"the robot {name!r} does not exist; expected the robot {' or '.join(ROBOTS)}")
    return ROBOTS[name]


def reference(robot: Robot) -> Array | None:
    """Return the reference states that a robot follows, one per step; None if the robot drives to the origin.

    The omni-directional robot follows two tangent circles of 1 m radius in 250 steps, (251, 3).
    """
    return two_circles().states if robot.turns else None
