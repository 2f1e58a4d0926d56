"""Runs a robot's twin: calibrates, identifies, and lets the policy meet the world, beside the one that always sends."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from taciturn._arrays import Array, count
from taciturn.errors import ProblemError
from taciturn.model.estimate import Estimate
from taciturn.model.policy import Policy
from taciturn.problem import load
from taciturn.simulation.sampling import Progress
from taciturn.twin.calibration import Calibration, calibrate
from taciturn.twin.catalogue import find_robot
from taciturn.twin.faults import Fault
from taciturn.twin.figures import figure_of
from taciturn.twin.identification import Identification, identify
from taciturn.twin.mission import all_time, check_mission, tables_of, write_toml
from taciturn.twin.outcome import Trial
from taciturn.twin.robot import Robot
from taciturn.twin.trial import Setup, Watcher, run_trial

if TYPE_CHECKING:
    import xarray
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Prepared:
    """A robot whose camera is calibrated and whose model is identified.

    Args:
        robot: which one.
        calibration: of its camera.
        model: what the experiment has found.
        seed: of both.
    """

    robot: Robot
    calibration: Calibration
    model: Identification
    seed: int

    def problem(self, parameters: Mapping[str, float]) -> dict[str, Any]:
        """Return the tables of its problem file, with parameters of the policy."""
        return tables_of(self.robot, self.model, parameters)


def prepare(name: str, seed: int = 0) -> Prepared:
    """Calibrate the camera of a robot by what is known of its scene, then identify a model with it.

    Args:
        name: ``"rover"`` or ``"omni"``.
        seed: of the camera's noise and of what disturbs the robot.

    Raises:
        ProblemError: no such robot, or an extra or a driver is missing.
    """
    robot = find_robot(name)
    calibration = calibrate(robot, count("seed", seed, 0))
    return Prepared(robot, calibration, identify(robot, calibration, seed), seed)


@dataclass(frozen=True, eq=False)
class TwinRun:
    """What a policy did with a robot's twin, beside the one that sends at every step.

    Args:
        prepared: the robot, its camera and its model.
        policy: that was run.
        trial: its runs.
        always: those of the policy that always sends, with the same seeds; None where they were not asked for.
        faults: what went wrong in ``trial``.
        seconds: wall time, calibration and identification included.
    """

    prepared: Prepared
    policy: Policy
    trial: Trial
    always: Trial | None
    faults: tuple[Fault, ...]
    seconds: float

    @property
    def cost(self) -> Estimate:
        """Mean of the missions' costs."""
        return mean(self.trial.totals)

    @property
    def rates(self) -> Mapping[str, Estimate]:
        """Mean fraction of the steps with a question to the camera, and with a send to the robot."""
        return {link: mean(sent.mean(axis=1)) for link, sent in self.trial.sent.items()}

    @property
    def cost_bound(self) -> float | None:
        """What theory says of the identified model; None where something goes wrong that it does not know."""
        return None if self.faults or self.policy.guarantee is None else self.policy.guarantee.cost

    def plot(self) -> Figure:
        """Return a figure of the first run, beside that of the policy that always sends."""
        trials = {"event-triggered": self.trial} | ({} if self.always is None else {"all-time": self.always})
        return figure_of(self.prepared.robot, trials)

    def to_dataset(self) -> xarray.Dataset:
        """Return all that happened, labelled: see ``taciturn.twin.record.to_dataset``."""
        from taciturn.twin.record import to_dataset

        return to_dataset(self)

    def document(self) -> dict[str, Any]:
        """Return the JSON document of ``taciturn twin --json``."""
        from taciturn.twin.report import document_of

        return document_of(self)


def run_twin(
    name: str,
    *,
    file: str | None = None,
    seed: int = 0,
    runs: int = 1,
    parameters: Mapping[str, float] | None = None,
    tick: float | None = None,
    namespaces: bool = False,
    faults: Sequence[Fault] = (),
    variant: str | None = None,
    key: bytes | None = None,
    compare: bool = True,
    prepared: Prepared | None = None,
    progress: Progress | None = None,
    watcher: Watcher | None = None,
) -> TwinRun:
    """Run a robot's twin as processes of this machine: rigid bodies, a camera, a control unit, a robot, and links.

    Args:
        name: ``"rover"`` or ``"omni"``.
        file: a problem file with the policy to run; omitted: that of the thesis, for the model that is identified here.
        seed: of all draws; run i has the seed ``seed`` + i of what disturbs its robot.
        runs: missions, which are run at once.
        parameters: of the policy, instead of those of the thesis.
        tick: real seconds per tick; omitted: virtual time, in which the same seed gives the same run.
        namespaces: in network namespaces, where the kernel loses packets.
        faults: what goes wrong.
        variant: how the wheels are modelled.
        key: that authenticates the packets; omitted: none.
        compare: also run the policy that always sends, without faults.
        prepared: a robot that has been prepared; omitted: it is done here.
        progress: called with the fraction done.
        watcher: who looks on.

    Returns:
        What was done, and what it cost.

    Raises:
        ProblemError: data that do not fit, an extra, a driver or a right that is missing, a process that has ended.
    """
    began = time.monotonic()
    count("runs", runs)
    if file is not None and parameters:
        raise ProblemError(f"{', '.join(parameters)} is given with {file}, which has its own; expected one of them")
    found = prepare(name, seed) if prepared is None else prepared
    robot = found.robot
    if variant is not None and variant not in robot.variants:
        raise ProblemError(f"the variant is {variant!r}; expected one of {', '.join(robot.variants)}")
    setup = Setup(robot, found.calibration, runs, seed, tick, namespaces, tuple(faults), key, variant)
    report = progress or (lambda fraction: None)
    with tempfile.TemporaryDirectory(prefix="taciturn-") as folder:
        chosen = Path(folder) / f"{robot.name}.toml"
        if file is None:
            chosen.write_text(write_toml(found.problem(parameters or {})), encoding="utf-8")
            problem = load(chosen)
        else:
            problem = load(file)
            tables = problem.source
            assert tables is not None
            chosen.write_text(write_toml(tables), encoding="utf-8")
        policy = check_mission(robot, problem, file or "the mission")
        share = 0.5 if compare else 1.0
        trial = run_trial(setup, chosen, scaled(report, 0.0, share), watcher)
        always = None
        if compare:
            other = Path(folder) / "all-time.toml"
            tables = all_time(problem).source
            assert tables is not None
            other.write_text(write_toml(tables), encoding="utf-8")
            always = run_trial(replace(setup, faults=()), other, scaled(report, share, 1.0))
    return TwinRun(found, policy, trial, always, tuple(faults), time.monotonic() - began)


def mean(values: Array) -> Estimate:
    """Return the mean of independent runs, with its standard error where there are two or more."""
    error = float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0
    return Estimate(float(values.mean()), error, "simulation" if len(values) > 1 else "exact")


def scaled(progress: Progress, low: float, high: float) -> Progress:
    """Return what tells a part of a whole how far it has come."""
    return lambda fraction: progress(low + (high - low) * fraction)
