"""Polygons in a picture: how large they are, where they are, what lies outside."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array


def measure_polygon(corners: Array) -> tuple[float, Array]:
    """Return area and centroid (2,) of a polygon whose corners (corners, 2) are in order around it.

    Example:
        >>> area, centre = measure_polygon(np.array([[0.0, 0], [2, 0], [2, 1], [0, 1]]))
        >>> area, centre.tolist()
        (2.0, [1.0, 0.5])
    """
    origin = corners.mean(axis=0)  # near which differences of products lose nothing
    here = corners - origin
    there = np.roll(here, -1, axis=0)
    cross = here[:, 0] * there[:, 1] - there[:, 0] * here[:, 1]
    area = float(cross.sum()) / 2
    if area == 0.0:
        return 0.0, origin
    return abs(area), origin + ((here + there) * cross[:, None]).sum(axis=0) / (6 * area)


def measure_outside(points: Array, corners: Array) -> Array:
    """Return how far points (points, 2) are outside a convex polygon, (points,); negative: inside.

    The distance is that to the edges' lines: beyond a corner it is less than that to the corner.

    Example:
        >>> square = np.array([[0.0, 0], [2, 0], [2, 2], [0, 2]])
        >>> measure_outside(np.array([[1.0, 3], [1, 1.5]]), square).tolist()
        [1.0, -0.5]
    """
    edges = np.roll(corners, -1, axis=0) - corners
    normals = np.column_stack([edges[:, 1], -edges[:, 0]]) / np.linalg.norm(edges, axis=1, keepdims=True)
    inward = ((corners.mean(axis=0) - corners) * normals).sum(axis=1) > 0
    normals[inward] *= -1
    return (points @ normals.T - (corners * normals).sum(axis=1)).max(axis=1)
