"""Geometry of polygons in a picture: area, centroid, and distances from points to a polygon."""

from __future__ import annotations

import numpy as np

from taciturn.extend import Array


def measure_polygon(corners: Array) -> tuple[float, Array]:
    """Return the area and the centroid (2,) of a polygon from its corners in order, (corners, 2).

    Example:
        >>> area, centre = measure_polygon(np.array([[0.0, 0], [2, 0], [2, 1], [0, 1]]))
        >>> area, centre.tolist()
        (2.0, [1.0, 0.5])
    """
    origin = corners.mean(axis=0)  # an origin near the polygon avoids cancellation
    here = corners - origin
    there = np.roll(here, -1, axis=0)
    cross = here[:, 0] * there[:, 1] - there[:, 0] * here[:, 1]
    area = float(cross.sum()) / 2
    if area == 0.0:
        return 0.0, origin
    return abs(area), origin + ((here + there) * cross[:, None]).sum(axis=0) / (6 * area)


def measure_outside(points: Array, corners: Array) -> Array:
    """Return the signed distance of each point (points, 2) from a convex polygon, (points,); it is negative inside.

    Distances are measured to the lines through the edges, so beyond a corner they are smaller than the distance to the
    corner.

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
