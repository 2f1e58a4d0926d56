"""What is known of a camera, and how it becomes known: by a board in the hand and landmarks at known places."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, array, number
from taciturn._cv2 import project, rotation_matrix, unproject
from taciturn.errors import ProblemError


@dataclass(frozen=True)
class Calibration:
    """A camera as it was measured.

    Args:
        K: camera matrix, (3, 3), in pixels.
        distortion: k1, k2, p1, p2 of Brown and Conrady, (4,).
        rotation: vector of the rotation from the world to the camera, (3,), in radians.
        translation: the world's origin as the camera sees it, (3,), in metres.
        error: root mean square of what separates the landmarks from where they should be, in pixels.

    Raises:
        ProblemError: a wrong shape, or a number that is not finite.
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
        """Where the camera is, (3,) in metres."""
        return -rotation_matrix(self.rotation).T @ self.translation

    def see(self, points: Array) -> Array:
        """Return where points (points, 3) are in the picture, (points, 2) in pixels."""
        return project(points, self.rotation, self.translation, self.K, self.distortion)

    def meet(self, seen: Array, height: float) -> Array:
        """Return where the rays of pixels (points, 2) meet the plane at a height above the floor, (points, 2)."""
        rays = unproject(seen, self.K, self.distortion) @ rotation_matrix(self.rotation)
        place = self.place
        return (place + rays * ((height - place[2]) / rays[:, 2])[:, None])[:, :2]

    def document(self) -> dict[str, object]:
        """Return it as JSON takes it."""
        return {name: getattr(self, name).tolist() for name in _SHAPES} | {"error": self.error}

    @classmethod
    def from_document(cls, document: Mapping[str, object]) -> Calibration:
        """Return what `document` has written.

        Raises:
            ProblemError: something is missing, or malformed.
        """
        missing = [name for name in (*_SHAPES, "error") if name not in document]
        if missing:
            raise ProblemError(f"the calibration lacks {', '.join(missing)}; expected what Calibration.document gives")
        return cls(**{name: document[name] for name in (*_SHAPES, "error")})  # type: ignore[arg-type]


_SHAPES = {"K": (3, 3), "distortion": (4,), "rotation": (3,), "translation": (3,)}
