"""The eye: where the robot is in a picture, or that this cannot be told."""

from __future__ import annotations

import math

import numpy as np

from taciturn._arrays import Array
from taciturn._cv2 import (
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
from taciturn.twin.calibration import Calibration
from taciturn.twin.polygons import measure_polygon
from taciturn.twin.robot import HEIGHT, WIDTH, Disc, Robot, Tag

AREA = (0.6, 1.5)  # of a disc in the picture, as a share of what it should be
EXTENT = (0.7, 1.4)  # of its width and of its height, alike
SIDES = 0.12  # by which the sides and diagonals of a tag may be off, as a share
GREEN, YELLOW = (0, 255, 0), (0, 220, 255)


class Eye:
    """Measures where a robot is, by what a calibration knows of the camera.

    A marker must have the size and the shape that it has at the place where it seems to be, and there may be only one:
    otherwise nothing is measured.

    Args:
        robot: whose marker is looked for.
        calibration: of the camera that took the pictures.
    """

    def __init__(self, robot: Robot, calibration: Calibration) -> None:
        """Keep both."""
        self.robot, self._calibration = robot, calibration

    def see(self, picture: bytes) -> Array | None:
        """Return what a picture (JPEG) shows of the robot.

        Returns:
            (n,) in metres, and a heading in (-π, π]; None where there is no marker or it is not to be trusted. Of a
            JPEG with single bits turned a decoder makes a picture: the datagram's checksum is what tells.
        """
        pixels = _pixels(picture)
        found = None if pixels is None else self._find(pixels)
        return None if found is None else found[0]

    def draw(self, picture: bytes) -> bytes:
        """Return the picture with what is seen drawn into it, as JPEG; of a damaged one, a grey one that says so."""
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
        """Return the measurement and the outline of the marker."""
        marker = self.robot.marker
        return self._find_disc(pixels, marker) if isinstance(marker, Disc) else self._find_tag(pixels, marker)

    def _find_disc(self, pixels: Pixels, disc: Disc) -> tuple[Array, Array] | None:
        found: list[tuple[Array, Array]] = []
        for outline in find_outlines(find_colour(pixels, disc.colour)):
            if len(outline) < 3:
                continue
            hull = convex_hull(outline)  # a highlight or a hole does not pull its centre
            area, centre = measure_polygon(hull)
            if area <= 0.0:
                continue
            x, y = self._calibration.meet(centre[None], disc.height)[0]
            circle = self._circle(x, y, disc)
            extent = (np.ptp(hull, axis=0) + 1) / np.ptp(circle, axis=0)  # the outline runs inside its pixels
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
