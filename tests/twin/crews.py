"""Robots that are ready to run, and short missions for them."""

from __future__ import annotations

import os
import pickle
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from twin.looks import true_calibration

from taciturn.errors import ProblemError
from taciturn_twins.body import Body
from taciturn_twins.camera import Camera
from taciturn_twins.catalogue import ROBOTS
from taciturn_twins.identification import Identification
from taciturn_twins.mission import write_toml
from taciturn_twins.prepared import Prepared, prepare
from taciturn_twins.robot import Robot


@cache
def blind() -> str:
    """Return why nothing can be drawn here, or nothing."""
    try:
        camera = Camera(ROBOTS["rover"])
        camera.take(Body(ROBOTS["rover"]).snapshot)
        camera.close()
    except ProblemError as error:
        return f"NOT SHOWN: what cameras of robots see; {error}"
    return ""


@cache
def crew(name: str) -> Prepared:
    """Return a robot whose camera is calibrated and whose model is identified, or skip where nothing can be drawn.

    The workers of a run share it: what a robot is does not depend on who asks.
    """
    if blind():
        pytest.skip(blind())
    kept = Path(os.environ["XDG_CACHE_HOME"], f"{name}.pickle")
    if kept.exists():
        return pickle.loads(kept.read_bytes())
    prepared = prepare(name)
    kept.parent.mkdir(parents=True, exist_ok=True)
    own = kept.with_suffix(f".{os.getpid()}")
    own.write_bytes(pickle.dumps(prepared))
    own.replace(kept)
    return prepared


@cache
def stand_in(name: str) -> Prepared:
    """Return a robot with the camera that the simulator knows and a model nearly that of its data sheet.

    Nothing is drawn for it: what calibration and identification find is tested where they are.
    """
    if blind():
        pytest.skip(blind())
    robot = ROBOTS[name]
    return Prepared(robot, true_calibration(robot), model(robot), 0)


def model(robot: Robot) -> Identification:
    """Return a model as an experiment might have found it."""
    n, m = len(robot.states), len(robot.inputs)
    B = robot.B * (1 - 0.07 * np.eye(n, m)) + 1e-4 * np.ones((n, m))
    return Identification(
        robot.name, 100, B, 0.01 * abs(B), robot.B, np.eye(n), np.zeros((n, n)), 1e-4 * np.eye(n), 1e-7 * np.eye(n),
        np.full(n, 0.01),
    )  # fmt: skip


def short_mission(name: str, ticks: int, folder: Path, **policy: float) -> str:
    """Return a problem file with the first steps of a robot's mission."""
    tables: dict[str, Any] = stand_in(name).tables(policy)
    tables["cost"] = {**tables["cost"], "horizon": ticks}
    if "reference" in tables:
        whole = tables["reference"]
        tables["reference"] = {"states": whole["states"][: ticks + 1], "inputs": whole["inputs"][:ticks]}
    path = folder / f"{name}-{ticks}-{policy.get('price', policy.get('theta', ''))}.toml"
    path.write_text(write_toml(tables))
    return str(path)
