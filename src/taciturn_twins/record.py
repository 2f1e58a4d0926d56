"""The record of a twin's run: all numbers as a NetCDF file, and the camera pictures as an animation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from taciturn.extend import check_format, write_whole
from taciturn_twins._cv2 import write_animation
from taciturn_twins.camera import Camera
from taciturn_twins.run import TwinRun
from taciturn_twins.vision import Eye

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


def write_record(run: TwinRun, path: Path) -> None:
    """Write all results to a NetCDF file.

    Raises:
        ProblemError: the extension is not .nc, or the folder is not writable.
    """
    check_record(path)
    whole: Any = run.to_dataset()
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
