"""The one door to MuJoCo, with types: rigid bodies that move, and pictures of them. It is an extra."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array
from taciturn.errors import ProblemError

Pixels = npt.NDArray[np.uint8]
"""A picture, (height, width, 3)."""

FREE = 7  # coordinates of a body that is free to move: position, and quaternion w, x, y, z


class Scene:
    """A compiled model.

    Args:
        xml: its text, in MuJoCo's format.
        files: the contents of the files that the text names.

    Raises:
        ProblemError: MuJoCo is missing.
    """

    def __init__(self, xml: str, files: Mapping[str, bytes] | None = None) -> None:
        """Compile it."""
        self.mujoco = _mujoco()
        self.model: Any = self.mujoco.MjModel.from_xml_string(xml, dict(files or {}))
        self.step = float(self.model.opt.timestep)

    def addresses(self, joints: Sequence[str]) -> list[int]:
        """Return where the coordinates of hinges and slides stand in `Motion.position`."""
        return [int(self.model.joint(name).qposadr[0]) for name in joints]


class Motion:
    """A scene in motion; its arrays are MuJoCo's own, and writing into them changes it.

    `position` (qpos) and `speed` (qvel) hold a free body's coordinates first; `command` (ctrl) drives the motors.
    """

    def __init__(self, scene: Scene) -> None:
        """Put it at rest where the model says."""
        self._mujoco, self._model = scene.mujoco, scene.model
        self._data: Any = self._mujoco.MjData(self._model)
        self.position: Array = self._data.qpos
        self.speed: Array = self._data.qvel
        self.command: Array = self._data.ctrl
        self.settle()

    def step(self) -> None:
        """Move on by one step of the scene."""
        self._mujoco.mj_step(self._model, self._data)

    def check(self) -> None:
        """Refuse to go on where the bodies have left the range of numbers.

        Raises:
            ProblemError: they have.
        """
        if any(warning.number for warning in self._data.warning) or not np.isfinite(self._data.qpos).all():
            raise ProblemError(
                "the rigid bodies have left the range of numbers; expected smaller forces: is a push too strong?"
            )

    def settle(self) -> None:
        """Work out where everything is, from `position`."""
        self._mujoco.mj_kinematics(self._model, self._data)

    def site(self, name: str) -> Array:
        """Return where a site was when `settle` was last called, (3,) in metres."""
        return np.array(self._data.site(name).xpos)

    def force(self, body: str) -> Array:
        """Return what pushes a body from outside, to be written into: force and torque, (6,) in N and N·m."""
        return self._data.body(body).xfrc_applied


class Painter:
    """Draws what a camera of a scene sees. A painter belongs to the thread that made it.

    Args:
        scene: what is seen.
        camera: its name there.
        width: of the pictures, in pixels.
        height: of the pictures, in pixels.

    Raises:
        ProblemError: there is nothing to draw with.
    """

    def __init__(self, scene: Scene, camera: str, width: int, height: int) -> None:
        """Prepare to draw, without shadows and mirrors, which take longer than all the rest."""
        mujoco, self._model, self._camera = scene.mujoco, scene.model, camera
        self._mujoco = mujoco
        self._data: Any = mujoco.MjData(self._model)
        self._head = np.array([self._model.vis.headlight.ambient, self._model.vis.headlight.diffuse])
        self._lights = np.array(self._model.light_diffuse)
        half = math.radians(float(self._model.camera(camera).fovy[0])) / 2
        self.focal = height / 2 / math.tan(half)  # in pixels
        try:
            self._renderer: Any = mujoco.Renderer(self._model, height, width)
        except Exception as error:  # each platform of OpenGL fails in its own way
            raise _blind(error) from None
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._renderer.scene.flags[flag] = False

    def paint(self, position: Sequence[float] | Array) -> Pixels:
        """Return the picture of a scene whose coordinates are ``position``: red, green, blue."""
        self._data.qpos[:] = position
        self._mujoco.mj_kinematics(self._model, self._data)
        self._mujoco.mj_camlight(self._model, self._data)
        self._renderer.update_scene(self._data, camera=self._camera)
        return self._renderer.render()

    def light(self, share: float) -> None:
        """Turn all lights to a share of what the scene says."""
        self._model.vis.headlight.ambient[:] = share * self._head[0]
        self._model.vis.headlight.diffuse[:] = share * self._head[1]
        self._model.light_diffuse[:] = share * self._lights

    def show(self, shape: str, shown: bool) -> None:
        """Show a shape (geom), or hide it."""
        self._model.geom(shape).rgba[3] = float(shown)

    def close(self) -> None:
        """Free what it holds of the graphics."""
        self._renderer.close()


def _keep_quiet(warning: str) -> None:
    """Warnings are counted, and asked for by ``Motion.check``; MuJoCo's own way is to write them into a file."""


@cache
def _mujoco() -> Any:
    os.environ.setdefault("MUJOCO_GL", "egl")  # which needs no screen
    try:
        mujoco = import_module("mujoco")
        mujoco.set_mju_user_warning(_keep_quiet)
        return mujoco
    except ImportError:
        raise ProblemError(
            "MuJoCo is not installed; expected it for the digital twins: pip install 'taciturn[twin]'"
        ) from None
    except Exception as error:  # what MUJOCO_GL names is loaded already here
        raise _blind(error) from None


def _blind(error: Exception) -> ProblemError:
    reason = " ".join(str(error).split()).rstrip(".") or type(error).__name__
    return ProblemError(
        f"MuJoCo cannot draw by OpenGL with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')} ({reason}); expected a "
        "graphics library, in software or not: apt install libegl1 libgl1-mesa-dri, and MUJOCO_GL=egl"
    )
