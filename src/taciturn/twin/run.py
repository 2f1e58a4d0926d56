"""Runs a robot's twin: a policy meets the world, beside the one that always sends."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from taciturn._arrays import Array
from taciturn._progress import Progress
from taciturn.errors import ProblemError
from taciturn.model.estimate import Estimate
from taciturn.model.policy import Policy
from taciturn.problem import load, parse
from taciturn.twin.catalogue import find_robot
from taciturn.twin.figures import figure_of
from taciturn.twin.mission import MISSIONS, all_time, check_mission, check_parameters
from taciturn.twin.outcome import Trial
from taciturn.twin.prepared import Prepared, prepare
from taciturn.twin.robot import Robot
from taciturn.twin.trial import Setup, run_trial

if TYPE_CHECKING:
    import xarray
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class TwinRun:
    """What a policy did with a robot's twin, beside the one that sends at every step.

    Args:
        prepared: the robot, its camera and its model.
        policy: that was run.
        trial: its runs.
        always: those of the policy that always sends, with the same seeds; None where they were not asked for.
        setup: how they were run.
        seconds: wall time, calibration and identification included.
    """

    prepared: Prepared
    policy: Policy
    trial: Trial
    always: Trial | None
    setup: Setup
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
        return None if self.setup.faults or self.policy.guarantee is None else self.policy.guarantee.cost

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
    robot: str | Prepared,
    setup: Setup | None = None,
    *,
    file: str | None = None,
    parameters: Mapping[str, float] | None = None,
    compare: bool = True,
    progress: Progress | None = None,
) -> TwinRun:
    """Run a robot's twin as processes of this machine: rigid bodies, a camera, a control unit, a robot, and links.

    Args:
        robot: ``"rover"`` or ``"omni"``, or one that has been prepared.
        setup: how it runs; omitted: one mission in virtual time.
        file: a problem file with the policy to run; omitted: that of the thesis, for the model that is identified here.
        parameters: of the policy, instead of those of the thesis.
        compare: also run the policy that always sends, without faults.
        progress: called with the fraction done.

    Returns:
        What was done, and what it cost.

    Raises:
        ProblemError: data that do not fit, an extra, a driver or a right that is missing, a process that has ended.
    """
    began, setup = time.monotonic(), setup or Setup()
    if file is not None and parameters:
        raise ProblemError(f"{', '.join(parameters)} is given with {file}, which has its own; expected one of them")
    chosen = find_robot(robot) if isinstance(robot, str) else robot.robot
    given = None if file is None else load(file)
    policy = None if given is None else check_mission(chosen, given, str(file))
    check_run(chosen, setup, parameters or {}, None if given is None else given.cost.horizon)
    found = prepare(robot, setup.seed) if isinstance(robot, str) else robot
    problem = given or parse(found.tables(parameters or {}), "the mission")
    policy = policy or check_mission(chosen, problem, "the mission")
    share = 0.5 if compare else 1.0
    trial = run_trial(found, setup, problem, scaled(progress, 0.0, share))
    always = None
    if compare:
        always = run_trial(found, replace(setup, faults=()), all_time(problem), scaled(progress, share, 1.0))
    return TwinRun(found, policy, trial, always, setup, time.monotonic() - began)


def check_run(robot: Robot, setup: Setup, parameters: Mapping[str, float], ticks: int | None = None) -> None:
    """Refuse what a robot cannot run, before it is prepared.

    Args:
        robot: which one.
        setup: how it is to run.
        parameters: of the policy.
        ticks: of the mission; omitted: those of the thesis.

    Raises:
        ProblemError: the policy has no such parameter, the robot no such wheels, or a fault does not fit.
    """
    check_parameters(robot, parameters)
    setup.check(robot, ticks or MISSIONS[robot.name].ticks)


def mean(values: Array) -> Estimate:
    """Return the mean of independent runs, with its standard error where there are two or more."""
    error = float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0
    return Estimate(float(values.mean()), error, "simulation" if len(values) > 1 else "exact")


def scaled(progress: Progress | None, low: float, high: float) -> Progress | None:
    """Return what tells a part of a whole how far it has come."""
    return None if progress is None else lambda fraction: progress(low + (high - low) * fraction)
