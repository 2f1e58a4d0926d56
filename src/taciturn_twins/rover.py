"""The robot of chapter 6: a rover with six driven wheels and a pink marker, which drives on a line before a webcam."""

from __future__ import annotations

from importlib.resources import files

import numpy as np

from taciturn.extend import Array
from taciturn_twins._mujoco import Scene
from taciturn_twins.robot import Cube, Disc, Lens, Robot

WHEELS = 6
RADIUS = 0.04  # radius of a wheel, in metres
RATE = 0.0023  # metres per second and percent, as identified in the thesis
HEIGHT = 0.0989  # height of the marker above the ground in metres, measured with a caliper

_PINK = ((152, 80, 40), (175, 255, 255))
_CUBES = (
    Cube(((105, 120, 40), (125, 255, 255)), (-0.20, 0.35, 0.04)),
    Cube(((22, 120, 60), (34, 255, 255)), (0.90, 0.35, 0.04)),
    Cube(((55, 120, 40), (75, 255, 255)), (-0.15, -0.25, 0.04)),
    Cube(((3, 150, 60), (15, 255, 255)), (0.85, -0.25, 0.04)),
)


def build_rover(variant: str) -> Scene:
    """Return the simulated scene of the rover; it has no variants.

    Raises:
        ProblemError: MuJoCo is missing.
    """
    return Scene(files("taciturn_twins").joinpath("models/rover.xml").read_text(encoding="utf-8"))


def wheel_speeds(inputs: Array, heading: float) -> Array:
    """Return the speed of each wheel in rad/s for an input (1,) in percent; all wheels have the same speed."""
    return np.full(WHEELS, RATE * inputs[0] / RADIUS)


ROVER = Robot(
    name="rover",
    tick=0.3,
    states=("x [m]",),
    inputs=("percent of full PWM",),
    input_limit=(100.0,),
    start=(0.7,),
    low=(-0.1,),
    high=(0.9,),
    rate=((RATE,),),
    stir=(7.5,),  # with 13 N the rover would slide at times (tyre friction: 26 N), and residuals have heavy tails
    motor_errors=(1.0,) * WHEELS,
    joints=tuple(f"wheel{k}" for k in range(WHEELS)),
    excitation=(60.0,),
    drive=wheel_speeds,
    build=build_rover,
    variants=("capsule",),
    lens=Lens(620.0, (322.3, 237.6)),
    marker=Disc(_PINK, radius=0.025, height=HEIGHT, strip=(-0.06, 0.06)),
    landmarks=_CUBES,
    # measured with an error of 3 cm and 2°
    taped=((0.38, -1.17, 1.02), (0.9994, 0.035, 0.0), (0.024, -0.689, -0.7244)),
)
