"""The record of a twin's run: all numbers as a NetCDF file, and the camera pictures as an animation."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from taciturn.extend import check_format, write_whole
from taciturn_twins._cv2 import write_animation
from taciturn_twins.camera import Camera
from taciturn_twins.outcome import Trial
from taciturn_twins.vision import Eye

if TYPE_CHECKING:
    import xarray

    from taciturn_twins.run import TwinRun

RECORDS, VIDEOS = (".nc",), (".webp",)


def check_record(path: Path) -> None:
    """Reject an invalid file name for a record.

    Raises:
        ProblemError: the extension is not .nc, or the folder is not writable.
    """
    check_format(path, RECORDS, "record")


def check_video(path: Path) -> None:
    """Reject an invalid file name for a video.

    Raises:
        ProblemError: the extension is not .webp, or the folder is not writable.
    """
    check_format(path, VIDEOS, "video")


def to_dataset(run: TwinRun) -> xarray.Dataset:
    """Return all results as a labelled data set, with the JSON document of the run in its attributes.

    The dimensions are ``policy`` (``event-triggered``, ``all-time``), ``run``, ``tick`` (steps), ``instant`` (one more
    than ``tick``), ``state``, ``input``, ``link``, ``form`` (trigger values of not sending and of sending), and
    ``coordinate`` (of the bodies).
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
        attrs={"title": f"twin of the {robot.name}", "document": json.dumps(run.document()), **run.origin()},
    )


def write_record(run: TwinRun, path: Path) -> None:
    """Write all results to a NetCDF file.

    Raises:
        ProblemError: the extension is not .nc, or the folder is not writable.
    """
    check_record(path)
    whole: Any = to_dataset(run)
    write_whole(path, bytes(whole.to_netcdf(None, engine="h5netcdf")))


def write_video(run: TwinRun, path: Path) -> None:
    """Write the camera pictures of the first robot as an animation; requested pictures show the detected marker.

    Raises:
        ProblemError: the extension is not .webp, or the folder is not writable.
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
