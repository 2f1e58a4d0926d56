"""Rigid-body simulation of a robot with disturbing forces; equal seeds give equal motions."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from taciturn.extend import Array, ArrayLike, array, choice, count, number
from taciturn_twins._mujoco import FREE, Motion
from taciturn_twins.robot import Robot

CORRELATION = 0.2  # correlation time of a disturbing force in seconds
SETTLING = 200  # number of simulation steps in which the wheels come to rest on the ground
_AXES = (0, 1, 5)  # indices in a wrench: force along x and y, torque about z
_SLACK = 1e-6  # tolerance, in steps, with which a time is rounded up to a multiple of the step


class Body:
    """Rigid-body simulation of one robot with its wheels, motors and friction.

    Disturbing forces act on the chassis: Ornstein–Uhlenbeck processes, stationary from the start.

    Args:
        robot: the robot.
        seed: seed of the disturbance.
        start: pose at the start, (n,), in metres and radians; default: the start pose in the robot's data.
        gain_error: relative gain error of the motors; the robot's ``motor_errors`` scale it for each motor.
        disturbance: size of the disturbing forces relative to those in the robot's data; 0: no disturbance.
        variant: wheel model, one of the robot's variants.

    Raises:
        ProblemError: MuJoCo is missing, or an argument is not valid.

    Example:
        >>> from taciturn_twins.catalogue import ROBOTS
        >>> body = Body(ROBOTS["rover"], disturbance=0)
        >>> body.act([-20])
        >>> body.flow(0.3)
        >>> round(float(body.pose[0]), 2)
        0.69
    """

    def __init__(
        self,
        robot: Robot,
        seed: int = 0,
        *,
        start: ArrayLike | None = None,
        gain_error: float = 0.0,
        disturbance: float = 1.0,
        variant: str = "capsule",
    ) -> None:
        """Place the robot on the ground, and simulate until it is at rest."""
        n = len(robot.states)
        placed = array("start", robot.start if start is None else start, (n,), "states")
        self._robot = robot
        self._random = np.random.default_rng(count("seed", seed, 0))
        self._size = number("disturbance", disturbance, 0.0, closed=True) * np.array(robot.stir)
        self._gain = 1 + number("gain_error", gain_error, -1.0, 1.0) * np.array(robot.motor_errors)
        scene = robot.build(choice("variant", variant, robot.variants))
        self._dt = scene.step
        self._motion = Motion(scene)
        self._kept = [*range(FREE), *scene.addresses(robot.joints)]
        self._wrench = self._motion.force("robot")
        for _ in range(SETTLING):
            self._motion.step()
        self._motion.speed[:] = 0.0
        self._heading = _yaw(self._motion.position)
        self._inputs = np.zeros(len(robot.inputs))
        self._limit = np.array(robot.input_limit)
        self._steps = 0
        self._pushes: list[tuple[int, float, float]] = []  # step at which the push ends, and its force along x and y
        self._forget = math.exp(-self._dt / CORRELATION)
        self._force = self._size * self._random.standard_normal(n)
        self.kidnap(placed - self.pose)

    @property
    def time(self) -> float:
        """Seconds since the start."""
        return self._steps * self._dt

    @property
    def pose(self) -> Array:
        """Pose of the marker, (n,), as measured by an ideal camera; the heading may exceed ±π."""
        self._motion.settle()
        place = self._motion.site("marker")
        return np.array([place[0], place[1], self._heading]) if self._robot.turns else place[:1]

    @property
    def snapshot(self) -> tuple[float, ...]:
        """Coordinates of the body and its wheels, shape (`Robot.seen`,), from which the camera renders a picture."""
        return tuple(float(self._motion.position[k]) for k in self._kept)

    def act(self, inputs: Sequence[float] | Array) -> None:
        """Set the control input, shape (m,), limited to the robot's range; it stays constant until the next call.

        Raises:
            ProblemError: the input is not a vector of m finite numbers.
        """
        self._inputs = np.clip(array("inputs", inputs, (len(self._limit),), "inputs"), -self._limit, self._limit)

    def flow(self, until: float) -> None:
        """Simulate the robot up to the time ``until``, in a whole number of simulation steps.

        Raises:
            ProblemError: the time is not finite, or the simulation diverges.
        """
        last = math.floor(number("until", until) / self._dt + _SLACK)
        for _ in range(self._steps, last):
            self._step()
        self._motion.check()

    def push(self, newtons: float, seconds: float, direction: float = 0.0) -> None:
        """Push the chassis from now on for a given time, in the direction of an angle (radians) to the x axis.

        Raises:
            ProblemError: a number is not finite, or the duration is negative.
        """
        size, angle = number("newtons", newtons), number("direction", direction)
        ends = self._steps + round(number("seconds", seconds, 0.0, closed=True) / self._dt)
        self._pushes.append((ends, size * math.cos(angle), size * math.sin(angle)))

    def kidnap(self, offset: Sequence[float] | Array) -> None:
        """Move the robot at once by an offset (n,) in metres and radians; the robot turns about its marker.

        Raises:
            ProblemError: the offset is not a vector of n finite numbers.
        """
        by = array("offset", offset, (len(self._robot.states),), "states")
        motion, q = self._motion, self._motion.position
        if self._robot.turns:
            motion.settle()
            mark, c, s = motion.site("marker"), math.cos(by[2]), math.sin(by[2])
            turn = np.array([[c, -s], [s, c]])
            q[:2] = mark[:2] + turn @ (q[:2] - mark[:2])
            motion.speed[:2] = turn @ motion.speed[:2]
            q[3:FREE] = _turned(q[3:FREE], by[2])
            self._heading += by[2]
        across = 2 if self._robot.turns else 1
        q[:across] += by[:across]

    def _step(self) -> None:
        n, wrench = len(self._robot.states), self._wrench
        wrench[:] = 0.0
        wrench[list(_AXES[:n])] = self._force
        self._pushes = [one for one in self._pushes if one[0] > self._steps]
        for _, x, y in self._pushes:
            wrench[0] += x
            wrench[1] += y
        self._motion.command[:] = self._gain * self._robot.drive(self._inputs, self._heading)
        self._motion.step()
        fresh = self._random.standard_normal(n)
        self._force = self._forget * self._force + math.sqrt(1 - self._forget**2) * self._size * fresh
        self._heading += math.remainder(_yaw(self._motion.position) - self._heading, 2 * math.pi)
        self._steps += 1


def _yaw(position: Array) -> float:
    w, x, y, z = (float(one) for one in position[3:FREE])
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _turned(quaternion: Array, angle: float) -> Array:
    w, x, y, z = quaternion
    c, s = math.cos(angle / 2), math.sin(angle / 2)
    return np.array([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])
