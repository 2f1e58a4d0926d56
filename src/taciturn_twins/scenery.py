"""Printed sheets in a scene: pictures on flat rectangles, as elements of a MuJoCo model and as PNG files."""

from __future__ import annotations

import numpy as np

from taciturn_twins._cv2 import Pixels, draw_tag, write_png

CELL = 16  # size of a cell of a tag in pixels


def printed_sheet(name: str, width: float, height: float) -> str:
    """Return the MuJoCo elements of a sheet: a mesh and a material, both called ``name``, and a texture ``name``.png.

    The renderer draws only one side of a mesh, so the back of the sheet is a flat pyramid.

    Args:
        name: name of mesh and material.
        width: size along x, in metres.
        height: size along y, in metres.
    """
    x, y = width / 2, height / 2
    return f"""
    <texture name="{name}" type="2d" file="{name}.png"/>
    <material name="{name}" texture="{name}" specular="0" shininess="0"/>
    <mesh name="{name}" vertex="{-x} {-y} 0 {x} {-y} 0 {x} {y} 0 {-x} {y} 0 0 0 -.001"
          face="0 1 2 0 2 3 1 0 4 3 4 0 2 1 4 3 2 4" texcoord="0 1 1 1 1 0 0 0 .5 .5"/>"""


def placed_sheet(name: str, place: tuple[float, float, float]) -> str:
    """Return the MuJoCo element that places a sheet at a position in metres; other bodies pass through the sheet."""
    x, y, z = place
    return f'<geom type="mesh" mesh="{name}" material="{name}" pos="{x} {y} {z}" mass="0" contype="0" conaffinity="0"/>'


def tag_picture(number: int) -> bytes:
    """Return an ArUco tag with a white border as PNG; the picture is 8/6 as wide as the tag's black square."""
    rimmed: Pixels = np.pad(draw_tag(number, 6 * CELL), CELL, constant_values=255)
    return write_png(rimmed)
