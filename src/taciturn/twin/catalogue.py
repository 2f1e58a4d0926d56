"""The robots by name, and what they follow."""

from __future__ import annotations

from collections.abc import Mapping

from taciturn._arrays import Array
from taciturn.errors import ProblemError
from taciturn.study.chapter7 import two_circles
from taciturn.twin.omni import OMNI
from taciturn.twin.robot import Robot
from taciturn.twin.rover import ROVER

ROBOTS: Mapping[str, Robot] = {robot.name: robot for robot in (ROVER, OMNI)}


def find_robot(name: str) -> Robot:
    """Return the robot of a name.

    Raises:
        ProblemError: there is none.
    """
    if name not in ROBOTS:
        raise ProblemError(f"there is no robot by the name {name!r}; expected {' or '.join(ROBOTS)}")
    return ROBOTS[name]


def reference(robot: Robot) -> Array | None:
    """Return the states that a robot follows, one a tick, or None where it is driven to zero.

    Those of the omni-directional robot are two tangent circles of 1 m radius in 250 ticks, (251, 3).
    """
    return two_circles().states if robot.turns else None
