"""Record of a twin's run: all numbers in a NetCDF file, and the pictures of the camera in an animation."""

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
    """Raise an error if the name of a file for a run's results is invalid.

    Raises:
        ProblemError: the extension is not .nc, or the folder is not writable.
    """
    check_format(path, RECORDS, "record")


def check_video(path: Path) -> None:
    """Raise an error if the name of a file for a run's pictures is invalid.

    Raises:
        ProblemError: the extension is not .webp, or the folder is not writable.
    """
    check_format(path, VIDEOS, "video")


def write_record(run: TwinRun, path: Path) -> None:
    """Write all results of a run to a NetCDF file.

    Raises:
        ProblemError: the extension is not .nc, or the folder is not writable.
    """
    check_record(path)
    whole: Any = run.to_dataset()
    write_whole(path, bytes(whole.to_netcdf(None, engine="h5netcdf")))


def write_video(run: TwinRun, path: Path) -> None:
    """Write the first robot's camera pictures as an animation; in requested pictures, the detected marker is drawn.

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
