"""Runs of a robot's twin under a policy, compared with a policy that sends every sample."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

from taciturn.errors import ProblemError
from taciturn.extend import Displayed, Progress, Size, percent
from taciturn.model.estimate import Estimate
from taciturn.model.policy import Policy
from taciturn.problem import load, parse
from taciturn.study.record import origin
from taciturn_twins.catalogue import find_robot
from taciturn_twins.dataset import to_dataset
from taciturn_twins.figures import figure_of
from taciturn_twins.mission import MISSIONS, THESIS, all_time, check_mission, check_parameters
from taciturn_twins.outcome import Trial, mean
from taciturn_twins.prepared import Prepared, prepare
from taciturn_twins.report import listed, model_lines, summary_of, vision
from taciturn_twins.robot import Robot
from taciturn_twins.trial import Setup, run_trial
from taciturn_udp.averages import measured

if TYPE_CHECKING:
    import xarray
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False, repr=False)
class TwinRun(Displayed):
    """The results of a robot's twin under a policy, and optionally under a policy that sends every sample.

    Args:
        prepared: the robot, its camera and its model.
        policy: the policy.
        trial: runs of the policy.
        always: runs of the policy that sends every sample, with the same seeds, or None. ``run_twin`` runs them without
            faults, the live page with the same faults and pushes.
        setup: configuration of the runs.
        seconds: duration in real time, including calibration and identification.
    """

    prepared: Prepared
    policy: Policy
    trial: Trial
    always: Trial | None
    setup: Setup
    seconds: float

    @property
    def cost(self) -> Estimate:
        """Mean total cost of a mission."""
        return mean(self.trial.totals)

    @property
    def rates(self) -> Mapping[str, Estimate]:
        """Mean fraction of steps with a request to the camera and with a packet to the robot, by link."""
        return {link: mean(sent.mean(axis=1)) for link, sent in self.trial.sent.items()}

    @property
    def cost_bound(self) -> float | None:
        """Guaranteed cost for the identified model, or None with faults, which the theory excludes."""
        return None if self.setup.faults or self.policy.guarantee is None else self.policy.guarantee.cost

    def plot(self, ax: Any = None, figsize: Size | None = None) -> Figure:
        """Return a figure of the first run of each policy."""
        trials = {"event-triggered": self.trial} | ({} if self.always is None else {"every sample": self.always})
        return figure_of(self.prepared.robot, trials, ax=ax, figsize=figsize)

    def to_dataset(self) -> xarray.Dataset:
        """Return all results as a labelled data set (``taciturn_twins.dataset``), with the JSON document."""
        robot = self.prepared.robot
        trials = {"event-triggered": self.trial} | ({} if self.always is None else {"all-time": self.always})
        attributes = {"title": f"twin of the {robot.name}", "document": json.dumps(self.document())}
        return to_dataset(robot, trials, {**attributes, **self.origin()})

    def origin(self) -> dict[str, Any]:
        """Return the data needed to reproduce the results: version, seed, method, and the digest of the problem."""
        return origin(self.trial.problem, self.setup.seed, "simulation")

    def summary(self) -> Mapping[str, object]:
        """Return the robot, the policy, the cost and the rates."""
        return {
            "robot": self.prepared.robot.name,
            "policy": self.policy.short(),
            "cost": self.cost,
            "guarantee": self.cost_bound,
            **{f"rate, {link}": rate for link, rate in self.rates.items()},
            "runs": len(self.trial.totals),
            "seed": self.setup.seed,
            "notes": self.trial.notes,
        }

    def document(self) -> dict[str, Any]:
        """Return the JSON document of ``taciturn twin --json``."""
        trial, robot = self.trial, self.prepared.robot
        return {
            "robot": robot.name,
            "policy": self.policy.kind,
            "runs": len(trial.totals),
            "rates": {link: measured(rate) for link, rate in self.rates.items()},
            "cost": measured(self.cost),
            "cost_all_time": None if self.always is None else float(self.always.totals.mean()),
            "cost_all_time_model": self.policy.cost_all_time,
            "cost_bound": self.cost_bound,
            "all_time": None if self.always is None else summary_of(self.always),
            "vision": vision(trial.vision, robot),
            "datagrams": dict(trial.datagrams),
            "seed": self.setup.seed,
            "seed_of_preparation": self.prepared.seed,
            "seconds": round(self.seconds, 3),
            "ticks": trial.costs.shape[1],
            "calibration": self.prepared.calibration.document(),
            "model": self.prepared.model.document(),
            "faults": [str(fault) for fault in self.setup.faults],
            "processes": {name: dict(report) for name, report in trial.reports.items()},
            "notes": list(trial.notes),
            **self.origin(),
        }

    def lines(self) -> list[tuple[str, str]]:
        """Return the printed lines of a run as pairs of name and value."""
        robot, trial, model = self.prepared.robot, self.trial, self.prepared.model
        runs, ticks = trial.costs.shape
        lines = [
            ("robot", f"{robot.name}, {runs} x {ticks} steps of {robot.tick:g} s in {self.seconds:.1f} s"),
            ("camera", f"{self.prepared.calibration.error:.2f} pixels reprojection error of the landmarks"),
        ]
        lines += [*model_lines(model, robot), ("policy", self.policy.kind), ("cost", f"{self.cost} per mission")]
        if self.always is not None:
            always = float(self.always.totals.mean())
            above = percent(self.cost.value / always - 1, 1, signed=True)
            lines.append(("every-sample cost", f"{always:.6g}   (this policy: {above})"))
        if self.cost_bound is not None:
            lines.append(("guaranteed", f"at most {self.cost_bound:.6g}, for the identified model"))
        lines += [(f"rate, {link}", f"{rate} per step") for link, rate in self.rates.items()]
        for link, counted in trial.datagrams.items():
            if isinstance(counted, Mapping):
                lines.append((f"link, {link}", listed(cast("Mapping[str, Any]", counted))))
            else:
                lines.append((link.replace("_", " "), str(counted)))
        for state, off in vision(trial.vision, robot).items():
            text = listed(cast("Mapping[str, Any]", off)) if isinstance(off, Mapping) else str(off)
            lines.append((f"camera, {state}", text))
        lines += [("thesis", text) for text in THESIS[robot.name]]
        return [*lines, *(("note", note) for note in trial.notes)]


def run_twin(
    robot: str | Prepared,
    setup: Setup | None = None,
    *,
    file: str | None = None,
    functions: bool = True,
    parameters: Mapping[str, float] | None = None,
    compare: bool = True,
    progress: Progress | None = None,
) -> TwinRun:
    """Run a robot's twin as processes on this machine: world, camera, control unit, actuator, and links.

    Args:
        robot: ``"rover"``, ``"omni"``, or a prepared robot.
        setup: configuration of the run; default: one mission in virtual time.
        file: problem file with the policy; default: the policy of the thesis, for the identified model.
        functions: whether the file may name functions, which are executed.
        parameters: policy parameters that replace those of the thesis.
        compare: whether to run the policy that sends every sample too, without faults.
        progress: function called with the completed fraction.

    Returns:
        The runs and their costs.

    Raises:
        ProblemError: an argument is not valid for the robot, an optional package, a driver or a permission is missing,
            or a process has ended.
    """
    began, setup = time.monotonic(), setup or Setup()
    if file is not None and parameters:
        raise ProblemError(
            f"{', '.join(parameters)} is given with {file}, which sets the parameters of the policy; expected only "
            "one of the two"
        )
    chosen = find_robot(robot) if isinstance(robot, str) else robot.robot
    given = None if file is None else load(file, functions=functions)
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
    """Reject a setup that a robot cannot run, before the robot is prepared.

    Args:
        robot: the robot.
        setup: the setup.
        parameters: policy parameters.
        ticks: steps of the mission; default: those of the thesis.

    Raises:
        ProblemError: a parameter or wheel model is unknown, or a fault is not possible in this run.
    """
    check_parameters(robot, parameters)
    setup.check(robot, ticks or MISSIONS[robot.name].ticks)


def scaled(progress: Progress | None, low: float, high: float) -> Progress | None:
    """Return the progress callback for the part of a computation between two completed fractions."""
    return None if progress is None else lambda fraction: progress(low + (high - low) * fraction)
