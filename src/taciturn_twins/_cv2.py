"""Typed interface to OpenCV, an optional dependency: colours, outlines, tags, lenses and image files."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
import numpy.typing as npt

from taciturn.errors import ProblemError
from taciturn.extend import Array

Pixels = npt.NDArray[np.uint8]
"""A picture (height, width, 3) in blue, green, red; a mask is (height, width)."""
Colour = tuple[tuple[int, int, int], tuple[int, int, int]]
"""Lower and upper limit of hue in [0, 180), saturation and value in [0, 255]."""


def write_jpeg(picture: Pixels, quality: int) -> bytes:
    """Encode a picture as JPEG with a given quality from 1 to 100."""
    cv2 = _cv2()
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def write_png(picture: Pixels) -> bytes:
    """Return a picture as PNG."""
    return _cv2().imencode(".png", picture)[1].tobytes()


def read_picture(coded: bytes) -> Pixels | None:
    """Decode the picture in a JPEG or PNG file; return None if the bytes are not a picture."""
    cv2 = _cv2()
    try:
        return cv2.imdecode(np.frombuffer(coded, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:  # for example, for empty input
        return None


def write_animation(pictures: Sequence[bytes], milliseconds: int) -> bytes:
    """Encode pictures as an animated WebP that shows each picture for the given time."""
    cv2 = _cv2()
    animation = cv2.Animation()
    animation.frames = [read_picture(one) for one in pictures]
    animation.durations = [milliseconds] * len(pictures)
    _, coded = cv2.imencodeanimation(".webp", animation, [cv2.IMWRITE_WEBP_QUALITY, 60])
    return bytes(coded)


def find_colour(picture: Pixels, colour: Colour) -> Pixels:
    """Return which pixels have a given colour, as a mask without isolated pixels."""
    cv2 = _cv2()
    mask = cv2.inRange(cv2.cvtColor(picture, cv2.COLOR_BGR2HSV), *colour)
    return cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))


def find_outlines(mask: Pixels) -> list[Array]:
    """Return the outlines of the regions in a mask; each outline lists all pixels on the border, shape (points, 2)."""
    cv2 = _cv2()
    found, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return [np.asarray(one, dtype=np.float64).reshape(-1, 2) for one in found]


def convex_hull(points: Array) -> Array:
    """Return the corners of the convex hull of points (points, 2), in order around the hull."""
    around = _cv2().convexHull(points.astype(np.float32), returnPoints=False)  # it supports single precision only
    return points[np.asarray(around).ravel()]


def draw_tag(number: int, size: int) -> Pixels:
    """Draw the ArUco tag (4×4) with a number from 0 to 49 and a black border, as a picture of shape (size, size)."""
    return _cv2().aruco.generateImageMarker(_dictionary(), number, size)


def find_tags(picture: Pixels) -> dict[int, Array]:
    """Find the tags in a picture; return each tag's corners (4, 2), clockwise from the tag's upper left corner."""
    cv2 = _cv2()
    corners, numbers, _ = _tag_detector().detectMarkers(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
    if numbers is None:
        return {}
    return {
        int(k): np.asarray(c, dtype=np.float64).reshape(4, 2) for k, c in zip(numbers.ravel(), corners, strict=True)
    }


class Board:
    """A ChArUco calibration board: a chessboard of 7×5 squares with a tag in each white square.

    Args:
        square: side of a square, in metres.
    """

    SHAPE = (7, 5)

    def __init__(self, square: float) -> None:
        """Create the board and its detector."""
        aruco = _cv2().aruco
        self._board: Any = aruco.CharucoBoard(self.SHAPE, square, 0.75 * square, _dictionary())
        self._detector: Any = aruco.CharucoDetector(self._board)

    def draw(self, square: int) -> Pixels:
        """Draw the board as a picture in which each square has sides of ``square`` pixels."""
        return self._board.generateImage((self.SHAPE[0] * square, self.SHAPE[1] * square), None, 0, 1)

    def find(self, picture: Pixels) -> tuple[Array, Array] | None:
        """Find corners of the board; return their positions on the board (corners, 3) and their pixels (corners, 2).

        The result is None if fewer than 8 corners are found.
        """
        corners, numbers, _, _ = self._detector.detectBoard(picture)
        if numbers is None or len(numbers) < 8:
            return None
        points, seen = self._board.matchImagePoints(corners, numbers)
        return np.asarray(points, np.float64).reshape(-1, 3), np.asarray(seen, np.float64).reshape(-1, 2)


def calibrate_lens(
    points: Sequence[Array], seen: Sequence[Array], width: int, height: int
) -> tuple[Array, Array, float]:
    """Compute camera matrix (3, 3), distortion (k1, k2, p1, p2) and rms error in pixels from pictures of a board.

    Args:
        points: corners on the board in each view, (corners, 3) in metres.
        seen: the same corners in each picture, (corners, 2) in pixels.
        width: width of the pictures in pixels.
        height: height of the pictures in pixels.
    """
    cv2 = _cv2()
    rms, K, distortion, _, _ = cv2.calibrateCamera(
        [one.astype(np.float32) for one in points],
        [one.astype(np.float32) for one in seen],
        (width, height),
        None,
        None,
        flags=cv2.CALIB_FIX_K3,
    )
    return np.asarray(K, np.float64), np.asarray(distortion, np.float64).ravel()[:4], float(rms)


def solve_pose(points: Array, seen: Array, K: Array, distortion: Array) -> tuple[Array, Array]:
    """Compute a camera's rotation vector and translation (world to camera) from points in space and their pixels."""
    _, rotation, translation = _cv2().solvePnP(points, seen, K, distortion)
    return np.asarray(rotation, np.float64).ravel(), np.asarray(translation, np.float64).ravel()


def project(points: Array, rotation: Array, translation: Array, K: Array, distortion: Array) -> Array:
    """Project points in space, (points, 3), to the pixels, (points, 2), at which a camera shows them."""
    found, _ = _cv2().projectPoints(np.ascontiguousarray(points), rotation, translation, K, distortion)
    return np.asarray(found, np.float64).reshape(-1, 2)


def unproject(seen: Array, K: Array, distortion: Array) -> Array:
    """Return the directions (points, 3), with depth 1, in which a camera sees pixels (points, 2)."""
    flat = _cv2().undistortPoints(np.ascontiguousarray(seen).reshape(-1, 1, 2), K, distortion).reshape(-1, 2)
    return np.column_stack([flat, np.ones(len(flat))])


def rotation_matrix(rotation: Array) -> Array:
    """Convert a rotation vector (3,) to a rotation matrix (3, 3)."""
    return np.asarray(_cv2().Rodrigues(rotation)[0], np.float64)


def rotation_vector(matrix: Array) -> Array:
    """Convert a matrix (3, 3) to the rotation vector (3,) of the nearest rotation."""
    return np.asarray(_cv2().Rodrigues(matrix)[0], np.float64).ravel()


class Bend:
    """Distortion of a lens as a table: for each pixel of the distorted picture, its position in the original picture.

    Args:
        source: x and y of each pixel in the original picture, (height, width, 2).
    """

    def __init__(self, source: Array) -> None:
        """Prepare the lookup tables."""
        cv2 = self._cv2 = _cv2()
        self._maps = cv2.convertMaps(source.astype(np.float32), None, cv2.CV_16SC2)

    def apply(self, picture: Pixels) -> Pixels:
        """Return the picture with the distortion of the lens."""
        cv2 = self._cv2
        return cv2.remap(picture, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def add_noise(picture: Pixels, noise: npt.NDArray[np.int16]) -> Pixels:
    """Add noise to a picture, and limit the pixel values to the range from 0 to 255."""
    return _cv2().add(picture, noise, dtype=_cv2().CV_8U)


def draw_lines(picture: Pixels, points: Array, colour: tuple[int, int, int]) -> None:
    """Draw a closed polygon through points (points, 2) into a picture."""
    cv2 = _cv2()
    cv2.polylines(picture, [np.rint(points).astype(np.int32).reshape(-1, 1, 2)], True, colour, 1, cv2.LINE_AA)


def draw_text(picture: Pixels, text: str, place: tuple[int, int], colour: tuple[int, int, int]) -> None:
    """Write a line of ASCII text into a picture; ``position`` is that of the text's lower left corner."""
    cv2 = _cv2()
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, 2, cv2.LINE_AA)


@cache
def _cv2() -> Any:
    try:
        cv2 = import_module("cv2")
    except ImportError:
        raise ProblemError(
            "OpenCV is not installed, but the cameras of the digital twins require it: pip install 'taciturn[twin]'"
        ) from None
    cv2.setNumThreads(1)  # more threads are not faster at this size, and would slow the other nodes
    return cv2


@cache
def _dictionary() -> Any:
    aruco = _cv2().aruco
    return aruco.getPredefinedDictionary(aruco.DICT_4X4_50)


@cache
def _tag_detector() -> Any:
    aruco = _cv2().aruco
    wanted = aruco.DetectorParameters()
    wanted.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
    wanted.relativeCornerRefinmentWinSize = 0.6  # share of a cell; with the default of 1 pixel, noise dominates
    return aruco.ArucoDetector(_dictionary(), wanted)
