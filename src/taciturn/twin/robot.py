"""What differs between robots, as data: their inputs, their scene, what the camera looks for, where it stands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from taciturn._arrays import Array, frozen
from taciturn._cv2 import Colour
from taciturn._mujoco import FREE, Scene

Point = tuple[float, float, float]
WIDTH, HEIGHT = 640, 480  # of all pictures, in pixels


@dataclass(frozen=True)
class Lens:
    """The camera's own optics. Nothing but the camera knows them: who measures has to calibrate.

    Args:
        focal: focal length, in pixels.
        centre: where the optical axis meets the picture, in pixels.
        distortion: k1, k2, p1, p2 of Brown and Conrady.
        noise: standard deviation of the sensor's noise, in levels of 255.
        quality: of the JPEG, in 1..100.
    """

    focal: float
    centre: tuple[float, float]
    distortion: tuple[float, float, float, float] = (-0.10, 0.03, 0.0005, -0.0003)
    noise: float = 3.0
    quality: int = 85

    @property
    def K(self) -> Array:
        """The camera matrix, (3, 3)."""
        return np.array([[self.focal, 0, self.centre[0]], [0, self.focal, self.centre[1]], [0, 0, 1.0]])


@dataclass(frozen=True)
class Disc:
    """A round marker of one colour: its radius and its height above the floor, in metres, and where y may be."""

    colour: Colour
    radius: float
    height: float
    strip: tuple[float, float]


@dataclass(frozen=True)
class Tag:
    """An ArUco tag: its number in 0..49, the side of its black square and where its centre is, in metres."""

    number: int
    side: float
    centre: Point

    @property
    def corners(self) -> Array:
        """Its corners, clockwise from the upper left, (4, 3)."""
        h = self.side / 2
        return np.array(self.centre) + np.array([[-h, h, 0], [h, h, 0], [h, -h, 0], [-h, -h, 0]])


@dataclass(frozen=True)
class Cube:
    """A cube of one colour: where its centre is, and half its side, in metres."""

    colour: Colour
    centre: Point
    half: float = 0.04

    @property
    def corners(self) -> Array:
        """Its corners, (8, 3)."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return np.array(self.centre) + self.half * signs


@dataclass(frozen=True)
class Robot:
    """All that differs between the robots.

    Args:
        name: by which it is asked for.
        tick: seconds between decisions.
        states: what the camera measures, with units; a heading comes last.
        inputs: what the robot is told, with units.
        input_limit: largest size of each input.
        start: state in which a run begins.
        low: least state of the workspace, where the camera is to be trusted.
        high: greatest state of it.
        rate: B of ẋ = B u as the data sheet would have it, (states, inputs).
        stir: standard deviation of the forces that disturb it: N along x (and y), N·m about z.
        motor_errors: by how much each motor's gain is off, as a multiple of `Body`'s ``gain_error``.
        joints: of its driven wheels, in the order of the motors.
        excitation: largest size of each input in an identification.
        drive: inputs and heading → speed of each wheel in rad/s.
        build: variant → scene with a body ``robot`` that is free to move, a site ``marker``, a shape ``cover`` and a
            camera ``webcam``.
        variants: ways in which its wheels are modelled, the usual one first.
        lens: the camera's optics.
        marker: what the eye looks for.
        landmarks: what is in the scene at a known place, for the calibration.
        taped: where the camera is and where its x and y axes point (to the right and down in the picture), as measured
            by hand.
    """

    name: str
    tick: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    input_limit: tuple[float, ...]
    start: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    rate: tuple[tuple[float, ...], ...]
    stir: tuple[float, ...]
    motor_errors: tuple[float, ...]
    joints: tuple[str, ...]
    excitation: tuple[float, ...]
    drive: Callable[[Array, float], Array] = field(repr=False)
    build: Callable[[str], Scene] = field(repr=False)
    variants: tuple[str, ...]
    lens: Lens
    marker: Disc | Tag
    landmarks: tuple[Cube, ...] | tuple[Tag, ...]
    taped: tuple[Point, Point, Point]

    @property
    def seen(self) -> int:
        """How many coordinates a camera sees: those of a free body, and one per wheel."""
        return FREE + len(self.joints)

    @property
    def turns(self) -> bool:
        """Whether the last state is a heading."""
        return len(self.states) == 3

    @property
    def B(self) -> Array:
        """B of x⁺ = x + B u per tick as the data sheet would have it, (states, inputs)."""
        return frozen(self.tick * np.array(self.rate))
