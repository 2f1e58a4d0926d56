"""The robot of chapter 7: it drives on three omni-directional wheels, and a camera above the field sees its tag."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from taciturn.extend import Array
from taciturn_twins._mujoco import Scene
from taciturn_twins.robot import Lens, Robot, Tag
from taciturn_twins.scenery import placed_sheet, printed_sheet, tag_picture

RADIUS, BASE = 0.05, 0.20  # radius of a wheel, and distance of the wheels from the centre, in metres
ANGLES = tuple(math.radians(degrees) for degrees in (60, 180, 300))  # directions of the wheels from the centre
FASTEST = 40.0  # largest speed of a wheel, in rad/s
ROLLERS = 8  # number of rollers in each of the two rows of a wheel
PLATE = 0.2045  # height of the tag above the axles, in metres
SIDE = 0.27  # side of the tag's black square, in metres

_FIELD_TAGS = tuple(
    Tag(k, 0.21, (x, y, 0.002)) for k, (x, y) in enumerate((x, y) for x in (-2.2, 0.0, 2.2) for y in (-1.4, 1.4))
)
_MARKER = Tag(7, SIDE, (0.0, 0.0, PLATE + RADIUS - 0.0002))  # 0.2 mm lower, because the tyres deform


def build_omni(variant: str) -> Scene:
    """Return the simulated scene of the omni-directional robot.

    In the variant ``capsule``, a wheel is a capsule with low friction along its axle and high friction across it. In
    the variant ``rollers``, a wheel has two rows of passive rollers on hinges, with equal friction in all directions.

    Raises:
        ProblemError: MuJoCo is missing.
    """
    rollers = variant == "rollers"
    tags = (*_FIELD_TAGS, _MARKER)
    sheets = "".join(printed_sheet(f"tag{tag.number}", tag.side * 8 / 6, tag.side * 8 / 6) for tag in tags)
    pairs = "" if rollers else "".join(_GRIP.format(k=k) for k in range(len(ANGLES)))
    text = _SCENE.format(
        sheets=sheets,
        lines="".join(_LINE.format(size=size, pos=pos) for size, pos in _lines()),
        field="".join(placed_sheet(f"tag{tag.number}", tag.centre) for tag in _FIELD_TAGS),
        tag=placed_sheet(f"tag{_MARKER.number}", (0.0, 0.0, PLATE)),
        plate=PLATE,
        cover=PLATE + 0.01,
        radius=RADIUS,
        wheels="".join(_wheel(k, angle, rollers) for k, angle in enumerate(ANGLES)),
        pairs=pairs,
        motors="".join(_MOTOR.format(k=k, fastest=FASTEST) for k in range(len(ANGLES))),
    )
    return Scene(text, {f"tag{tag.number}.png": tag_picture(tag.number) for tag in tags})


def wheel_speeds(inputs: Array, heading: float) -> Array:
    """Compute each wheel's speed in rad/s for a velocity in world coordinates (inverse kinematics).

    Args:
        inputs: vx and vy in m/s, ω in rad/s, (3,).
        heading: heading of the robot, in radians.
    """
    c, s = math.cos(heading), math.sin(heading)
    ahead, left = c * inputs[0] + s * inputs[1], -s * inputs[0] + c * inputs[1]
    return np.array(
        [(math.sin(a) * ahead - math.cos(a) * left - BASE * inputs[2]) / RADIUS for a in ANGLES]
    )  # a wheel that turns about its outward axle rolls backwards along the tangent


def _wheel(k: int, angle: float, rollers: bool) -> str:
    x, y = BASE * math.cos(angle), BASE * math.sin(angle)
    shapes = "".join(_rollers()) if rollers else _CAPSULE.format(k=k, radius=RADIUS)
    return f"""
      <body pos="{x} {y} 0" quat="{math.cos(angle / 2)} 0 0 {math.sin(angle / 2)}">
        <joint name="wheel{k}" type="hinge" axis="1 0 0" damping=".004" armature=".002" frictionloss=".03"/>{shapes}
      </body>"""


def _rollers() -> Iterable[str]:
    thick = 0.011
    middle = RADIUS - thick  # distance of the roller axles from the wheel axle
    half = 1.15 * middle * math.tan(math.pi / (2 * ROLLERS))
    yield _HUB.format(radius=0.62 * RADIUS)
    for row, beside in enumerate((-thick, thick)):
        for k in range(ROLLERS):
            turn = 2 * math.pi * (k + row / 2) / ROLLERS
            yield _ROLLER.format(
                x=beside,
                y=-middle * math.sin(turn),
                z=middle * math.cos(turn),
                w=math.cos(turn / 2),
                i=math.sin(turn / 2),
                thick=thick,
                half=half,
            )


def _lines() -> Iterable[tuple[str, str]]:
    yield from ((".025 1.6 .0005", f"{x} 0 .0005") for x in (-2.4, 0, 2.4))
    yield from (("2.4 .025 .0005", f"0 {y} .0005") for y in (-1.6, 1.6))


_LINE = '<geom class="look" type="box" size="{size}" pos="{pos}" rgba="1 1 1 1"/>'
_GRIP = '<pair geom1="floor" geom2="tyre{k}" condim="3" friction=".01 .9 .0001 .0001 .0001"/>'
_MOTOR = '<velocity joint="wheel{k}" kv=".4" forcerange="-1 1" ctrlrange="-{fastest} {fastest}" ctrllimited="true"/>'
_CAPSULE = """
        <geom name="tyre{k}" class="look" type="capsule" size="{radius} .004"
              euler="0 90 0" mass=".25" rgba=".4 .4 .42 1"/>"""
_HUB = """
        <geom class="look" type="cylinder" size="{radius} .014" euler="0 90 0" mass=".122" rgba=".4 .4 .42 1"/>"""
_ROLLER = """
        <body pos="{x} {y} {z}" quat="{w} {i} 0 0">
          <joint type="hinge" axis="0 1 0" damping="1e-5" armature="1e-6"/>
          <geom type="capsule" size="{thick} {half}" euler="90 0 0" mass=".008" condim="3" friction=".9 .005 .0001"
              rgba=".4 .4 .42 1"/>
        </body>"""
_SCENE = """
<mujoco model="omni">
  <option timestep="0.002" integrator="implicitfast" cone="elliptic"/>
  <visual>
    <quality shadowsize="0" offsamples="4"/>
    <headlight ambient=".4 .4 .4" diffuse=".2 .2 .2" specular="0 0 0"/>
    <global offwidth="640" offheight="480"/>
  </visual>
  <default>
    <geom contype="0" conaffinity="1"/>
    <default class="look"><geom contype="0" conaffinity="0"/></default>
  </default>
  <asset>{sheets}
  </asset>
  <worldbody>
    <light pos="1 1 4" dir="-.2 -.2 -1" diffuse=".2 .2 .2" specular="0 0 0" castshadow="false"/>
    <geom name="floor" type="plane" size="5 5 .1" rgba=".10 .42 .14 1" contype="1" conaffinity="0"/>
    {lines}
    {field}
    <camera name="webcam" pos="0 0 3.4" xyaxes="1 0 0 0 1 0" fovy="64"/>
    <body name="robot" pos="0 0 {radius}">
      <freejoint/>
      <geom class="look" type="cylinder" size=".17 .05" pos="0 0 .06" mass="6" rgba=".15 .15 .18 1"/>
      <geom class="look" type="cylinder" size=".04 .05" pos="0 0 .15" mass=".3" rgba=".3 .3 .3 1"/>
      <geom class="look" type="box" size=".19 .19 .002" pos="0 0 .2" mass=".3" rgba=".8 .8 .8 1"/>
      {tag}
      <geom name="cover" class="look" type="box" size=".16 .16 .002" pos="0 0 {cover}" mass="0" rgba=".55 .5 .4 0"/>
      <site name="marker" pos="0 0 {plate}" rgba="0 0 0 0"/>{wheels}
    </body>
  </worldbody>
  <contact>{pairs}</contact>
  <actuator>{motors}</actuator>
</mujoco>
"""

OMNI = Robot(
    name="omni",
    tick=0.1,
    states=("x [m]", "y [m]", "psi [rad]"),
    inputs=("vx [m/s]", "vy [m/s]", "omega [rad/s]"),
    input_limit=(FASTEST * RADIUS, FASTEST * RADIUS, FASTEST * RADIUS / BASE),  # each alone needs full wheel speed
    start=(0.0, 0.0, 0.0),
    low=(-2.1, -1.2, -math.pi),
    high=(2.1, 1.2, math.pi),
    rate=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    stir=(8.0, 8.0, 0.8),
    motor_errors=(1.0, -0.6, 0.3),
    joints=tuple(f"wheel{k}" for k in range(len(ANGLES))),
    excitation=(0.6, 0.6, 0.5),
    drive=wheel_speeds,
    build=build_omni,
    variants=("capsule", "rollers"),
    lens=Lens(415.0, (317.2, 241.8)),
    marker=_MARKER,
    landmarks=_FIELD_TAGS,
    taped=((0.03, -0.02, 3.42), (0.9994, 0.035, 0.0), (0.035, -0.9994, 0.0)),
)
