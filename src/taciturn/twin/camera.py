"""A webcam: what it takes of a scene is bent by a lens, noisy, and a JPEG."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from taciturn._arrays import array, count, number
from taciturn._cv2 import Bend, add_noise, unproject, write_jpeg
from taciturn._mujoco import Painter, Scene
from taciturn.errors import ProblemError
from taciturn.twin.robot import HEIGHT, WIDTH, Lens, Robot

LARGEST = 60_000  # bytes of a picture: what one packet holds
_ROOM = 64  # pixels by which the noise may be moved


class Optics:
    """A lens and a sensor before a scene: `Camera` is one before a robot's.

    The noise of a picture is a piece of one field of normal draws, which is drawn once: its place is drawn.

    Args:
        scene: what is seen, with a camera ``webcam`` whose field of view is wider than the lens's.
        lens: its optics.
        seed: of the noise.
    """

    def __init__(self, scene: Scene, lens: Lens, seed: int = 0) -> None:
        """Prepare to draw."""
        self._lens, self._seed = lens, count("seed", seed, 0)
        self.painter = Painter(scene, "webcam", WIDTH, HEIGHT)
        u, v = np.meshgrid(np.arange(WIDTH, dtype=np.float64), np.arange(HEIGHT, dtype=np.float64))
        seen = unproject(np.stack([u.ravel(), v.ravel()], axis=1), lens.K, np.array(lens.distortion))[:, :2]
        middle = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
        self._bend = Bend((middle + self.painter.focal * seen).reshape(HEIGHT, WIDTH, 2))
        field = np.random.default_rng(self._seed).normal(0.0, lens.noise, (HEIGHT + _ROOM, WIDTH + _ROOM, 3))
        self._noise = np.rint(field).astype(np.int16)

    def take(self, position: Sequence[float], number: int) -> bytes:
        """Return the picture of a scene whose coordinates are ``position``, as JPEG of at most ``LARGEST`` bytes."""
        y, x = np.random.default_rng((self._seed, number)).integers(_ROOM, size=2)
        bent = self._bend.apply(self.painter.paint(position)[..., ::-1])  # which has red first
        noisy = add_noise(bent, self._noise[y : y + HEIGHT, x : x + WIDTH])
        for quality in range(self._lens.quality, 0, -10):
            coded = write_jpeg(noisy, quality)
            if len(coded) <= LARGEST:
                return coded
        raise ProblemError(f"the picture takes more than {LARGEST} bytes; expected less: lower the noise of the lens")


class Camera:
    """The camera of a robot's scene. A camera belongs to the thread that made it.

    Args:
        robot: at whom it looks.
        seed: of the sensor's noise.

    Raises:
        ProblemError: MuJoCo or OpenCV is missing, or there is nothing to draw with.

    Example:
        >>> from taciturn.twin.body import Body
        >>> from taciturn.twin.catalogue import ROBOTS
        >>> camera = Camera(ROBOTS["rover"])
        >>> camera.take(Body(ROBOTS["rover"]).snapshot)[:3] == bytes([0xFF, 0xD8, 0xFF])
        True
        >>> camera.close()
    """

    def __init__(self, robot: Robot, seed: int = 0) -> None:
        """Set it up."""
        self._seen = robot.seen
        self._optics = Optics(robot.build(robot.variants[0]), robot.lens, seed)
        self._lighting, self._covered = 1.0, False

    def take(self, snapshot: Sequence[float], number: int = 0) -> bytes:
        """Take a picture.

        Args:
            snapshot: of a `Body`, `Robot.seen` coordinates.
            number: of the picture, at least 0: with the seed it decides on the noise, whatever was taken before.

        Returns:
            A JPEG of 640×480 pixels in colour, at most 60 000 bytes.

        Raises:
            ProblemError: not so many finite coordinates, or a negative number.
        """
        placed = array("snapshot", snapshot, (self._seen,), "coordinates")
        return self._optics.take(placed.tolist(), count("number", number, 0))

    @property
    def lighting(self) -> float:
        """How bright all lights are, as a multiple of how they usually are, in [0, 10]."""
        return self._lighting

    @lighting.setter
    def lighting(self, share: float) -> None:
        """Turn the lights down or up."""
        self._lighting = number("lighting", share, 0.0, 10.0, closed=True)
        self._optics.painter.light(self._lighting)

    @property
    def covered(self) -> bool:
        """Whether something lies over the marker."""
        return self._covered

    @covered.setter
    def covered(self, covered: bool) -> None:
        """Lay something over the marker, or take it away."""
        self._covered = covered
        self._optics.painter.show("cover", covered)

    def close(self) -> None:
        """Free the graphics."""
        self._optics.painter.close()
