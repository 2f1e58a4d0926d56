"""Calibration of a camera: lens parameters from pictures of a board, and pose from points at known positions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Array, array, least_squares, number, number_of
from taciturn.model.result import Result
from taciturn_twins._cv2 import (
    Board,
    Pixels,
    calibrate_lens,
    convex_hull,
    find_colour,
    find_outlines,
    find_tags,
    project,
    read_picture,
    rotation_matrix,
    rotation_vector,
    solve_pose,
    unproject,
    write_png,
)
from taciturn_twins._mujoco import Scene
from taciturn_twins.body import Body
from taciturn_twins.camera import Camera, Optics
from taciturn_twins.polygons import measure_outside, measure_polygon
from taciturn_twins.robot import HEIGHT, WIDTH, Cube, Robot, Tag
from taciturn_twins.scenery import placed_sheet, printed_sheet

VIEWS = 14  # number of pictures of the board
AVERAGED = 8  # number of pictures of the landmarks that are averaged to reduce noise
SQUARE, PIXELS = 0.04, 100  # side of a square of the board, in metres and in pixels of its texture
_SHAPES = {"K": (3, 3), "distortion": (4,), "rotation": (3,), "translation": (3,)}


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Result):
    """A measured camera model.

    Args:
        K: camera matrix, (3, 3), in pixels.
        distortion: k1, k2, p1, p2 of Brown and Conrady, (4,).
        rotation: rotation vector from the world to the camera, (3,), in radians.
        translation: origin of the world in camera coordinates, (3,), in metres.
        error: root mean square reprojection error of the landmarks, in pixels.

    Raises:
        ProblemError: an array has the wrong shape, or a number is not finite.
    """

    K: Array
    distortion: Array
    rotation: Array
    translation: Array
    error: float

    def __post_init__(self) -> None:
        """Check the shapes."""
        for name, shape in _SHAPES.items():
            object.__setattr__(self, name, array(name, getattr(self, name), shape))
        object.__setattr__(self, "error", number("error", self.error, 0.0, closed=True))

    @property
    def place(self) -> Array:
        """Position of the camera in space, shape (3,), in metres."""
        return -rotation_matrix(self.rotation).T @ self.translation

    def see(self, points: Array) -> Array:
        """Return the pixels, (points, 2), at which the camera shows points in space, (points, 3)."""
        return project(points, self.rotation, self.translation, self.K, self.distortion)

    def meet(self, seen: Array, height: float) -> Array:
        """Return the points of a horizontal plane that the camera shows at given pixels; both are (points, 2)."""
        rays = unproject(seen, self.K, self.distortion) @ rotation_matrix(self.rotation)
        place = self.place
        return (place + rays * ((height - place[2]) / rays[:, 2])[:, None])[:, :2]

    @classmethod
    def from_document(cls, document: Mapping[str, object]) -> Calibration:
        """Return the calibration from the JSON object that ``document`` returned.

        Raises:
            ProblemError: a key is missing, or a value is malformed.
        """
        missing = [name for name in (*_SHAPES, "error") if name not in document]
        if missing:
            raise ProblemError(
                f"the calibration lacks the entries {', '.join(missing)}; expected a document that "
                "Calibration.document returned"
            )
        return cls(**{name: document[name] for name in (*_SHAPES, "error")})  # type: ignore[arg-type]


def calibrate(robot: Robot, seed: int = 0) -> Calibration:
    """Calibrate the camera of a robot from its pictures, without knowledge of the simulated lens.

    Pictures of a ChArUco board in ``VIEWS`` poses determine the lens parameters. Landmarks at known positions determine
    the pose of the camera: tags by their corners, cubes by their outlines. The search starts at a pose measured by
    hand.

    Args:
        robot: robot that the camera observes.
        seed: seed of board poses and picture noise.

    Raises:
        ProblemError: a landmark is not found, or MuJoCo, OpenCV or a graphics driver is missing.

    Example:
        >>> from taciturn_twins.catalogue import ROBOTS
        >>> calibrate(ROBOTS["omni"]).error < 0.3
        True
    """
    K, distortion = _calibrate_lens(robot, seed)
    picture = _still(robot, seed)
    if isinstance(robot.landmarks[0], Tag):
        return _place_by_tags(picture, [one for one in robot.landmarks if isinstance(one, Tag)], K, distortion)
    right, down = (np.array(axis) for axis in robot.taped[1:])
    turn = rotation_vector(np.array([right, down, np.cross(right, down)]))
    guess = Calibration(K, distortion, turn, -rotation_matrix(turn) @ np.array(robot.taped[0]), 0.0)
    return _place_by_cubes(picture, [one for one in robot.landmarks if isinstance(one, Cube)], guess)


def _calibrate_lens(robot: Robot, seed: int) -> tuple[Array, Array]:
    """Return the lens parameters from pictures of the board at many distances, angles and positions."""
    board, random = Board(SQUARE), np.random.default_rng((seed, 0))
    wide, high = (side * SQUARE for side in board.SHAPE)
    focal = robot.lens.focal
    scene = Scene(
        _STUDIO.format(
            sheet=printed_sheet("board", wide, high),
            board=placed_sheet("board", (0.0, 0.0, 0.0)),
            fovy=2 * math.degrees(math.atan(HEIGHT / 2 / (_WIDER * focal))),
        ),
        {"board.png": write_png(board.draw(PIXELS))},
    )
    optics = Optics(scene, robot.lens, seed)
    points: list[Array] = []
    seen: list[Array] = []
    for view in range(4 * VIEWS):
        away = focal * wide / (WIDTH * random.uniform(0.45, 0.75))
        beside = random.uniform(-0.25, 0.25, 2) * (WIDTH, HEIGHT) * away / focal
        turn = np.array([*random.uniform(-0.5, 0.5, 2), random.uniform(-0.3, 0.3)])
        angle = float(np.linalg.norm(turn))
        pose = [*beside, -away, math.cos(angle / 2), *(math.sin(angle / 2) * turn / angle)]
        picture = read_picture(optics.take(pose, view))
        found = None if picture is None else board.find(picture)
        if found is not None:
            points.append(found[0])
            seen.append(found[1])
        if len(points) == VIEWS:
            break
    optics.painter.close()
    if len(points) < VIEWS:
        raise ProblemError(
            f"the calibration board was found in {number_of(len(points), 'picture')}; expected {VIEWS} pictures: "
            "check the lighting"
        )
    K, distortion, _ = calibrate_lens(points, seen, WIDTH, HEIGHT)
    return K, distortion


def _still(robot: Robot, seed: int) -> Pixels:
    """Return the mean of ``AVERAGED`` pictures of a robot in its start pose."""
    camera, at_rest = Camera(robot, seed), Body(robot, disturbance=0.0).snapshot
    total = np.zeros((HEIGHT, WIDTH, 3))
    for k in range(AVERAGED):
        picture = read_picture(camera.take(at_rest, k))
        assert picture is not None
        total += picture
    camera.close()
    return np.rint(total / AVERAGED).astype(np.uint8)


def _place_by_tags(picture: Pixels, tags: list[Tag], K: Array, distortion: Array) -> Calibration:
    found = find_tags(picture)
    missing = [tag.number for tag in tags if tag.number not in found]
    if missing:
        raise ProblemError(
            f"the camera does not see the tags {missing}; expected all {number_of(len(tags), 'tag')}: clear the view"
        )
    points, seen = np.concatenate([t.corners for t in tags]), np.concatenate([found[t.number] for t in tags])
    rotation, translation = solve_pose(points, seen, K, distortion)
    off = project(points, rotation, translation, K, distortion) - seen
    return Calibration(K, distortion, rotation, translation, float(np.sqrt(np.square(off).sum() / len(off))))


def _place_by_cubes(picture: Pixels, cubes: list[Cube], guess: Calibration) -> Calibration:
    """Return the pose from a fit of the cubes' centres, followed by a fit of their outlines.

    The second fit contains a common offset of all outlines: a mask ends at a colour threshold and not exactly at the
    edge of a cube, and this must not change the fitted pose.
    """
    outlines = [_outline(picture, cube, guess) for cube in cubes]

    def at(pose: Array) -> Calibration:
        return Calibration(guess.K, guess.distortion, pose[:3], pose[3:6], 0.0)

    def shapes(pose: Array) -> list[Array]:
        camera = at(pose)
        return [convex_hull(camera.see(cube.corners)) for cube in cubes]

    def away(pose: Array) -> Array:
        return np.concatenate([measure_polygon(shape)[1] for shape in shapes(pose)]) - centres

    def misfit(pose: Array) -> Array:
        pairs = zip(outlines, shapes(pose), strict=True)
        return np.concatenate([measure_outside(outline, shape) for outline, shape in pairs]) - pose[6]

    centres = np.concatenate([measure_polygon(convex_hull(outline))[1] for outline in outlines])
    pose = least_squares(away, np.array([*guess.rotation, *guess.translation]))
    pose = least_squares(misfit, np.array([*pose, 0.0]))
    return replace(at(pose), error=float(np.sqrt(np.mean(misfit(pose) ** 2))))


def _outline(picture: Pixels, cube: Cube, guess: Calibration) -> Array:
    """Return the outline nearest to a cube's expected position, among those of its colour and about its size."""
    area, centre = measure_polygon(convex_hull(guess.see(cube.corners)))
    best, nearest = None, math.inf
    for outline in find_outlines(find_colour(picture, cube.colour)):
        if len(outline) < 3:
            continue
        size, place = measure_polygon(outline)
        away = float(np.linalg.norm(place - centre))
        if _SIZES[0] < size / area < _SIZES[1] and away < nearest:
            best, nearest = outline, away
    if best is None:
        raise ProblemError(
            f"the camera does not see the cube at {cube.centre}; expected all cubes: clear the view, or turn on the "
            "light"
        )
    return best


_SIZES = (0.6, 1.6)  # permitted area of a cube in the picture, relative to the area at the pose measured by hand
_WIDER = 0.92  # focal length of the rendered picture relative to the lens, so that it shows a wider view
_STUDIO = """
<mujoco model="studio">
  <visual>
    <quality shadowsize="0" offsamples="4"/>
    <headlight ambient=".5 .5 .5" diffuse=".4 .4 .4" specular="0 0 0"/>
    <global offwidth="640" offheight="480"/>
  </visual>
  <statistic extent="1"/>
  <asset>{sheet}</asset>
  <worldbody>
    <camera name="webcam" pos="0 0 0" xyaxes="1 0 0 0 1 0" fovy="{fovy}"/>
    <body><freejoint/>{board}<geom size=".001" mass="1" rgba="0 0 0 0"/></body>
  </worldbody>
</mujoco>
"""
