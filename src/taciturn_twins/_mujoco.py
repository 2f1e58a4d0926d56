"""Typed interface to MuJoCo, an optional dependency: simulation and rendering of rigid bodies."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
import numpy.typing as npt

from taciturn.errors import ProblemError
from taciturn.extend import Array

Pixels = npt.NDArray[np.uint8]
"""A picture, (height, width, 3)."""

FREE = 7  # coordinates of a body that is free to move: position, and quaternion w, x, y, z


class Scene:
    """A compiled MuJoCo model.

    Args:
        xml: text of the model in MuJoCo's format.
        files: contents of the files that the text names.

    Raises:
        ProblemError: MuJoCo is missing.
    """

    def __init__(self, xml: str, files: Mapping[str, bytes] | None = None) -> None:
        """Compile the model."""
        self.mujoco = _mujoco()
        self.model: Any = self.mujoco.MjModel.from_xml_string(xml, dict(files or {}))
        self.step = float(self.model.opt.timestep)

    def addresses(self, joints: Sequence[str]) -> list[int]:
        """Return the indices of hinge and slide joints in `Motion.position`."""
        return [int(self.model.joint(name).qposadr[0]) for name in joints]


class Motion:
    """The simulated state of a scene; its arrays belong to MuJoCo, so a caller that writes to them changes the state.

    `position` (qpos) and `speed` (qvel) contain the coordinates of a free body first; `command` (ctrl) drives the
    motors.
    """

    def __init__(self, scene: Scene) -> None:
        """Start at rest at the initial position of the model."""
        self._mujoco, self._model = scene.mujoco, scene.model
        self._data: Any = self._mujoco.MjData(self._model)
        self.position: Array = self._data.qpos
        self.speed: Array = self._data.qvel
        self.command: Array = self._data.ctrl
        self.settle()

    def step(self) -> None:
        """Advance the simulation by one time step of the scene."""
        self._mujoco.mj_step(self._model, self._data)

    def check(self) -> None:
        """Raise an error if a coordinate of any body is not finite.

        Raises:
            ProblemError: a coordinate is not finite, or MuJoCo has issued a warning.
        """
        if any(warning.number for warning in self._data.warning) or not np.isfinite(self._data.qpos).all():
            raise ProblemError(
                "the coordinates of the rigid bodies are out of range; expected smaller forces: use weaker pushes"
            )

    def settle(self) -> None:
        """Compute the positions of all bodies and sites from the coordinates in `position`."""
        self._mujoco.mj_kinematics(self._model, self._data)

    def site(self, name: str) -> Array:
        """Return the position in metres of a site (a marked point), (3,), as of the last call of `settle`."""
        return np.array(self._data.site(name).xpos)

    def force(self, body: str) -> Array:
        """Return the array of the external force and torque on a body, (6,), in N and N·m; callers may write to it."""
        return self._data.body(body).xfrc_applied


class Painter:
    """A renderer for a scene's camera; only the thread that created it may use it.

    Args:
        scene: scene to render.
        camera: name of the camera in the scene.
        width: width of the pictures in pixels.
        height: height of the pictures in pixels.

    Raises:
        ProblemError: no OpenGL renderer is available.
    """

    def __init__(self, scene: Scene, camera: str, width: int, height: int) -> None:
        """Prepare rendering without shadows and reflections, which would dominate the computing time."""
        mujoco, self._model, self._camera = scene.mujoco, scene.model, camera
        self._mujoco = mujoco
        self._data: Any = mujoco.MjData(self._model)
        self._head = np.array([self._model.vis.headlight.ambient, self._model.vis.headlight.diffuse])
        self._lights = np.array(self._model.light_diffuse)
        half = math.radians(float(self._model.camera(camera).fovy[0])) / 2
        self.focal = height / 2 / math.tan(half)  # in pixels
        try:
            self._renderer: Any = mujoco.Renderer(self._model, height, width)
        except Exception as error:  # each OpenGL platform raises other exceptions
            raise _blind(error) from None
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._renderer.scene.flags[flag] = False

    def paint(self, position: Sequence[float] | Array) -> Pixels:
        """Render the scene with the coordinates ``position``, and return a picture in red, green and blue."""
        self._data.qpos[:] = position
        self._mujoco.mj_kinematics(self._model, self._data)
        self._mujoco.mj_camlight(self._model, self._data)
        self._renderer.update_scene(self._data, camera=self._camera)
        return self._renderer.render()

    def light(self, share: float) -> None:
        """Set the brightness of all lights, as a fraction of their brightness in the scene's file."""
        self._model.vis.headlight.ambient[:] = share * self._head[0]
        self._model.vis.headlight.diffuse[:] = share * self._head[1]
        self._model.light_diffuse[:] = share * self._lights

    def show(self, shape: str, shown: bool) -> None:
        """Show or hide a geometric shape (``geom``) of the scene."""
        self._model.geom(shape).rgba[3] = float(shown)

    def close(self) -> None:
        """Release the graphics resources."""
        self._renderer.close()


def _keep_quiet(warning: str) -> None:
    """Ignore a warning, which MuJoCo would write to a file; ``Motion.check`` reads the counters of warnings."""


@cache
def _mujoco() -> Any:
    os.environ.setdefault("MUJOCO_GL", "egl")  # needs no display
    try:
        mujoco = import_module("mujoco")
        mujoco.set_mju_user_warning(_keep_quiet)
        return mujoco
    except ImportError:
        raise ProblemError(
            "MuJoCo is not installed, but the digital twins require it: pip install 'taciturn[twin]'"
        ) from None
    except Exception as error:  # the import already loads the platform that MUJOCO_GL names
        raise _blind(error) from None


def _blind(error: Exception) -> ProblemError:
    reason = " ".join(str(error).split()).rstrip(".") or type(error).__name__
    return ProblemError(
        f"MuJoCo cannot render with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')} ({reason}); expected an OpenGL "
        "library, possibly in software: apt install libegl1 libgl1-mesa-dri, and set MUJOCO_GL=egl"
    )
