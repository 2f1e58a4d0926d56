"""The data that describe a robot: its inputs, scene and marker, and the pose of its camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from taciturn.extend import Array, Displayed, frozen
from taciturn_twins._cv2 import Colour
from taciturn_twins._mujoco import FREE, Scene

Point = tuple[float, float, float]
WIDTH, HEIGHT = 640, 480  # size of all pictures in pixels


@dataclass(frozen=True, repr=False)
class Lens(Displayed):
    """True properties of the simulated camera's lens; image processing uses a calibration instead.

    Args:
        focal: focal length, in pixels.
        centre: point of the picture on the optical axis, in pixels.
        distortion: k1, k2, p1, p2 of Brown and Conrady.
        noise: standard deviation of the sensor noise, in units of 1/255 of full scale.
        quality: JPEG quality, 1 to 100.
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


@dataclass(frozen=True, repr=False)
class Disc(Displayed):
    """A round marker of one colour: radius and height above the ground in metres, and the range of its y coordinate."""

    colour: Colour
    radius: float
    height: float
    strip: tuple[float, float]


@dataclass(frozen=True, repr=False)
class Tag(Displayed):
    """An ArUco tag: its number (0 to 49), the side length of its black square and its centre, in metres."""

    number: int
    side: float
    centre: Point

    @property
    def corners(self) -> Array:
        """Corners of the black square, clockwise from the upper left, shape (4, 3), in metres."""
        h = self.side / 2
        return np.array(self.centre) + np.array([[-h, h, 0], [h, h, 0], [h, -h, 0], [-h, -h, 0]])


@dataclass(frozen=True, repr=False)
class Cube(Displayed):
    """A cube of one colour: its centre and half its side length, in metres."""

    colour: Colour
    centre: Point
    half: float = 0.04

    @property
    def corners(self) -> Array:
        """Corners of the cube, shape (8, 3), in metres."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return np.array(self.centre) + self.half * signs


@dataclass(frozen=True, repr=False)
class Robot(Displayed):
    """Data of a robot: its inputs, its scene, its marker, and the pose of its camera.

    Args:
        name: name of the robot.
        tick: sampling period in seconds.
        states: names of the states, with units; the camera measures all states, and a heading is the last state.
        inputs: names of the inputs, with units.
        input_limit: largest absolute value of each input.
        start: initial state of a run.
        low: lower limits of the states in the workspace, in which the camera is reliable.
        high: upper limits of the states in the workspace.
        rate: B in ẋ = B u from the data sheet, (states, inputs).
        stir: standard deviation of the disturbing forces: N along x (and y), N·m about z.
        motor_errors: gain error of each motor, as a multiple of ``gain_error`` of `Body`.
        joints: joints of the driven wheels, in the order of the motors.
        excitation: largest absolute value of each input in an identification.
        drive: function of inputs and heading that returns the speed of each wheel in rad/s.
        build: function of the variant that returns the scene, with a freely moving body ``robot``, a site ``marker``,
            a geometry ``cover`` and a camera ``webcam``.
        variants: names of the wheel models; the first one is the default.
        lens: optics of the camera.
        marker: marker of the robot.
        landmarks: objects at known positions, for the calibration.
        taped: position of the camera and directions of its x and y axes (right and down in the picture), measured by
            hand.
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
        """Number of coordinates from which a picture is rendered: 7 for the free body, and one for each wheel."""
        return FREE + len(self.joints)

    @property
    def turns(self) -> bool:
        """Whether the last state of the robot is a heading."""
        return len(self.states) == 3

    @property
    def B(self) -> Array:
        """Input matrix B of the model x⁺ = x + B u per step, computed from the data sheet, shape (states, inputs)."""
        return frozen(self.tick * np.array(self.rate))
