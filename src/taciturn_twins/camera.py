"""A simulated webcam: pictures of a scene with lens distortion, noise and JPEG compression."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import array, count, number
from taciturn_twins._cv2 import Bend, add_noise, unproject, write_jpeg
from taciturn_twins._mujoco import Painter, Scene
from taciturn_twins.robot import HEIGHT, WIDTH, Lens, Robot

LARGEST = 60_000  # largest picture in bytes that fits into one packet
_ROOM = 64  # largest shift of the noise field in pixels


class Optics:
    """A lens and an image sensor that look at a scene; `Camera` uses them for the scene of a robot.

    A field of normally distributed numbers is drawn once. The noise of a picture is a window of this field at a random
    position.

    Args:
        scene: scene with a camera ``webcam`` whose field of view is wider than that of the lens.
        lens: parameters of lens and sensor.
        seed: seed of the noise.
    """

    def __init__(self, scene: Scene, lens: Lens, seed: int = 0) -> None:
        """Prepare the renderer, the lens distortion and the noise."""
        self._lens, self._seed = lens, count("seed", seed, 0)
        self.painter = Painter(scene, "webcam", WIDTH, HEIGHT)
        u, v = np.meshgrid(np.arange(WIDTH, dtype=np.float64), np.arange(HEIGHT, dtype=np.float64))
        seen = unproject(np.stack([u.ravel(), v.ravel()], axis=1), lens.K, np.array(lens.distortion))[:, :2]
        middle = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
        self._bend = Bend((middle + self.painter.focal * seen).reshape(HEIGHT, WIDTH, 2))
        field = np.random.default_rng(self._seed).normal(0.0, lens.noise, (HEIGHT + _ROOM, WIDTH + _ROOM, 3))
        self._noise = np.rint(field).astype(np.int16)

    def take(self, position: Sequence[float], number: int) -> bytes:
        """Render the scene with coordinates ``position``, and return a JPEG picture of at most ``LARGEST`` bytes."""
        y, x = np.random.default_rng((self._seed, number)).integers(_ROOM, size=2)
        bent = self._bend.apply(self.painter.paint(position)[..., ::-1])  # convert RGB to BGR
        noisy = add_noise(bent, self._noise[y : y + HEIGHT, x : x + WIDTH])
        for quality in range(self._lens.quality, 0, -10):
            coded = write_jpeg(noisy, quality)
            if len(coded) <= LARGEST:
                return coded
        raise ProblemError(
            f"the picture has more than {LARGEST} bytes at every quality tried; expected at most {LARGEST} bytes: "
            "reduce the sensor noise (Lens.noise)"
        )


class Camera:
    """The simulated camera in a robot's scene; only the thread that creates a camera may use it.

    Args:
        robot: robot in the scene.
        seed: seed of the sensor noise.

    Raises:
        ProblemError: MuJoCo, OpenCV or a graphics driver is missing.

    Example:
        >>> from taciturn_twins.body import Body
        >>> from taciturn_twins.catalogue import ROBOTS
        >>> camera = Camera(ROBOTS["rover"])
        >>> camera.take(Body(ROBOTS["rover"]).snapshot)[:3] == bytes([0xFF, 0xD8, 0xFF])
        True
        >>> camera.close()
    """

    def __init__(self, robot: Robot, seed: int = 0) -> None:
        """Build the scene and its renderer."""
        self._seen = robot.seen
        self._optics = Optics(robot.build(robot.variants[0]), robot.lens, seed)
        self._lighting, self._covered = 1.0, False

    def take(self, snapshot: Sequence[float], number: int = 0) -> bytes:
        """Take a picture.

        Args:
            snapshot: coordinates of a `Body`, (`Robot.seen`,).
            number: number of the picture, at least 0. Only seed and number determine the noise.

        Returns:
            A colour JPEG of 640×480 pixels and at most 60 000 bytes.

        Raises:
            ProblemError: the number of coordinates is wrong, a coordinate is not finite, or ``number`` is negative.
        """
        placed = array("snapshot", snapshot, (self._seen,), "coordinates")
        return self._optics.take(placed.tolist(), count("number", number, 0))

    @property
    def lighting(self) -> float:
        """Brightness of all lights as a factor from 0 to 10; 1 is the normal brightness."""
        return self._lighting

    @lighting.setter
    def lighting(self, share: float) -> None:
        """Set the brightness of all lights."""
        self._lighting = number("lighting", share, 0.0, 10.0, closed=True)
        self._optics.painter.light(self._lighting)

    @property
    def covered(self) -> bool:
        """Whether the robot's marker is covered, so that the camera cannot see it."""
        return self._covered

    @covered.setter
    def covered(self, covered: bool) -> None:
        """Cover or uncover the marker."""
        self._covered = covered
        self._optics.painter.show("cover", covered)

    def close(self) -> None:
        """Release the graphics resources."""
        self._optics.painter.close()
