"""Image processing that measures the robot's pose in a picture, or rejects the picture if the pose is uncertain."""

from __future__ import annotations

import math

import numpy as np

from taciturn.extend import Array
from taciturn_twins._cv2 import (
    Pixels,
    convex_hull,
    draw_lines,
    draw_text,
    find_colour,
    find_outlines,
    find_tags,
    read_picture,
    write_jpeg,
)
from taciturn_twins.calibration import Calibration
from taciturn_twins.polygons import measure_polygon
from taciturn_twins.robot import HEIGHT, WIDTH, Disc, Robot, Tag

AREA = (0.6, 1.5)  # permitted area of a disc in the picture, relative to the expected area
EXTENT = (0.7, 1.4)  # permitted width and height of a disc, relative to the expected values
SIDES = 0.12  # permitted relative error of the sides and diagonals of a tag
GREEN, YELLOW = (0, 255, 0), (0, 220, 255)


class Eye:
    """An image processor that measures the pose of a robot with a calibrated camera.

    A picture gives a measurement only if it shows exactly one marker with the size and shape expected at its position.

    Args:
        robot: robot with the marker.
        calibration: calibration of the camera.
    """

    def __init__(self, robot: Robot, calibration: Calibration) -> None:
        """Store both."""
        self.robot, self._calibration = robot, calibration

    def see(self, picture: bytes) -> Array | None:
        """Measure the pose of the robot in a picture (JPEG).

        Returns:
            Pose (n,) in metres, with a heading in (-π, π], or None without a reliable marker. Note that a JPEG decoder
            accepts a picture with single bit errors; only the checksum of the datagram detects them.
        """
        pixels = _pixels(picture)
        found = None if pixels is None else self._find(pixels)
        return None if found is None else found[0]

    def draw(self, picture: bytes) -> bytes:
        """Draw the detected marker into a picture, and return it as JPEG; a text replaces a damaged picture."""
        pixels = _pixels(picture)
        if pixels is None:
            pixels = np.full((HEIGHT, WIDTH, 3), 96, np.uint8)
            draw_text(pixels, "no picture", (12, 28), YELLOW)
            return write_jpeg(pixels, 85)
        found = self._find(pixels)
        if found is None:
            draw_text(pixels, "no marker", (12, 28), YELLOW)
        else:
            measured, outline = found
            draw_lines(pixels, outline, GREEN)
            shown = zip(self.robot.states, measured, strict=True)
            draw_text(pixels, ", ".join(f"{name.split()[0]} = {value:.3f}" for name, value in shown), (12, 28), GREEN)
        return write_jpeg(pixels, 85)

    def _find(self, pixels: Pixels) -> tuple[Array, Array] | None:
        """Return the measurement and the outline of the marker, or None."""
        marker = self.robot.marker
        return self._find_disc(pixels, marker) if isinstance(marker, Disc) else self._find_tag(pixels, marker)

    def _find_disc(self, pixels: Pixels, disc: Disc) -> tuple[Array, Array] | None:
        found: list[tuple[Array, Array]] = []
        for outline in find_outlines(find_colour(pixels, disc.colour)):
            if len(outline) < 3:
                continue
            hull = convex_hull(outline)  # so that a highlight or a hole does not shift the centre
            area, centre = measure_polygon(hull)
            if area <= 0.0:
                continue
            x, y = self._calibration.meet(centre[None], disc.height)[0]
            circle = self._circle(x, y, disc)
            extent = (np.ptp(hull, axis=0) + 1) / np.ptp(circle, axis=0)  # the outline passes through pixel centres
            fits = AREA[0] < area / measure_polygon(circle)[0] < AREA[1]
            fits = fits and EXTENT[0] < extent.min() and extent.max() < EXTENT[1]
            if fits and disc.strip[0] < y < disc.strip[1]:
                found.append((np.array([x]), outline))
        return found[0] if len(found) == 1 else None

    def _circle(self, x: float, y: float, disc: Disc) -> Array:
        turn = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
        rim = np.column_stack([x + disc.radius * np.cos(turn), y + disc.radius * np.sin(turn)])
        return self._calibration.see(np.column_stack([rim, np.full(len(rim), disc.height)]))

    def _find_tag(self, pixels: Pixels, tag: Tag) -> tuple[Array, Array] | None:
        outline = find_tags(pixels).get(tag.number)
        if outline is None:
            return None
        corners = self._calibration.meet(outline, tag.centre[2])
        sides = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
        across = np.linalg.norm(corners[:2] - corners[2:], axis=1) / math.sqrt(2)
        if np.abs(np.concatenate([sides, across]) / tag.side - 1).max() > SIDES:
            return None
        ahead = corners[1] - corners[0] + corners[2] - corners[3]
        return np.array([*corners.mean(axis=0), math.atan2(ahead[1], ahead[0])]), outline


def _pixels(picture: bytes) -> Pixels | None:
    found = read_picture(picture)
    return found if found is not None and found.shape == (HEIGHT, WIDTH, 3) else None
