"""What is kept of a twin's run: all numbers as NetCDF, and what the camera saw as a moving picture."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from taciturn._cv2 import write_animation
from taciturn._figure import check_format
from taciturn._files import write_whole
from taciturn.twin.camera import Camera
from taciturn.twin.outcome import Trial
from taciturn.twin.vision import Eye

if TYPE_CHECKING:
    import xarray

    from taciturn.twin.run import TwinRun

RECORDS, VIDEOS = (".nc",), (".webp",)


def check_record(path: Path) -> None:
    """Refuse a name that no record can have.

    Raises:
        ProblemError: another ending than .nc, or no folder that can be written to.
    """
    check_format(path, RECORDS, "record")


def check_video(path: Path) -> None:
    """Refuse a name that no video can have.

    Raises:
        ProblemError: another ending than .webp, or no folder that can be written to.
    """
    check_format(path, VIDEOS, "video")


def to_dataset(run: TwinRun) -> xarray.Dataset:
    """Return all that happened as a labelled data set, the JSON document of the run in its attributes.

    Dimensions: ``policy`` (``event-triggered``, ``all-time``), ``run``, ``tick``, ``instant`` (one more than ticks),
    ``state``, ``input``, ``link``, ``form`` (of the trigger: the smaller one decides), ``coordinate`` (of the bodies).
    """
    import xarray

    trials = {"event-triggered": run.trial} | ({} if run.always is None else {"all-time": run.always})
    links = list(run.trial.sent)
    variables: dict[str, tuple[tuple[str, ...], Callable[[Trial], object]]] = {
        "pose": (("run", "instant", "state"), lambda trial: trial.poses),
        "estimate": (("run", "tick", "state"), lambda trial: trial.estimates),
        "seen": (("run", "tick", "state"), lambda trial: trial.seen),
        "given": (("run", "tick", "input"), lambda trial: trial.inputs),
        "trigger": (("run", "tick", "form"), lambda trial: trial.values),
        "cost": (("run", "tick"), lambda trial: trial.costs),
        "total": (("run",), lambda trial: trial.totals),
        "sent": (("link", "run", "tick"), lambda trial: np.array([trial.sent[link] for link in links])),
        "arrived": (("link", "run", "tick"), lambda trial: np.array([trial.arrived[link] for link in links])),
        "light": (("run", "instant", "coordinate"), lambda trial: trial.lights),
    }
    robot = run.prepared.robot
    return xarray.Dataset(
        {
            name: (("policy", *dims), np.array([read(trial) for trial in trials.values()]))
            for name, (dims, read) in variables.items()
        },
        coords={
            "policy": list(trials),
            "link": links,
            "state": list(robot.states),
            "input": list(robot.inputs),
            "form": ["silent", "send"],
            "time": ("instant", robot.tick * np.arange(run.trial.poses.shape[1])),
        },
        attrs={"title": f"twin of the {robot.name}", "document": json.dumps(run.document())},
    )


def write_record(run: TwinRun, path: Path) -> None:
    """Write all that happened as NetCDF.

    Raises:
        ProblemError: another ending than .nc, or no folder that can be written to.
    """
    check_record(path)
    whole: Any = to_dataset(run)
    write_whole(path, bytes(whole.to_netcdf(None, engine="h5netcdf")))


def write_video(run: TwinRun, path: Path) -> None:
    """Write what the camera would have seen of the first robot, with what it did see drawn in where it was asked.

    Raises:
        ProblemError: another ending than .webp, or no folder that can be written to.
    """
    check_video(path)
    prepared, trial = run.prepared, run.trial
    eye, camera = Eye(prepared.robot, prepared.calibration), Camera(prepared.robot, prepared.seed)
    try:
        pictures = [
            eye.draw(picture) if asked else picture
            for asked, picture in (
                (asked, camera.take(tuple(light.tolist()), tick))
                for tick, (asked, light) in enumerate(zip(trial.arrived["sensor"][0], trial.lights[0], strict=False))
            )
        ]
    finally:
        camera.close()
    write_whole(path, write_animation(pictures, round(1000 * prepared.robot.tick)))
