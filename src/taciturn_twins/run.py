"""Run a robot's twin under a policy, and compare it with the policy that sends every sample."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, cast

from taciturn.errors import ProblemError
from taciturn.extend import Progress, Size, StyleName, number_of, percent
from taciturn.model.estimate import Estimate
from taciturn.model.policy import Policy
from taciturn.model.result import SPLICED, VERDICT, Field, Result
from taciturn.problem import load, parse
from taciturn.study.record import origin
from taciturn.study.sentences import compared_text, share_text
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


def _always(run: TwinRun) -> float | None:
    """Return the mean cost of sending every sample."""
    return None if run.always is None else float(run.always.totals.mean())


def _compared(run: TwinRun) -> str:
    always = _always(run)
    if always is None:
        return ""
    return f"{always:.6g}   (this policy: {percent(run.cost.value / always - 1, 1, signed=True)})"


def _driven(run: TwinRun) -> str:
    robot, (runs, steps) = run.prepared.robot, run.trial.costs.shape
    return f"{robot.name}, {runs} x {number_of(steps, 'step')} of {robot.tick:g} s in {run.seconds:.1f} s"


def _modelled(run: TwinRun) -> list[tuple[str, str]]:
    return model_lines(run.prepared.model, run.prepared.robot)


def _sent(run: TwinRun) -> list[tuple[str, str]]:
    """Return what happened to the datagrams of each link."""
    return [
        (f"link, {link}", listed(cast("Mapping[str, Any]", counted)))
        if isinstance(counted, Mapping)
        else (link.replace("_", " "), str(counted))
        for link, counted in run.trial.datagrams.items()
    ]


def _seen(run: TwinRun) -> list[tuple[str, str]]:
    """Return how far the camera was off in each state."""
    return [
        (f"camera, {state}", listed(cast("Mapping[str, Any]", off)) if isinstance(off, Mapping) else str(off))
        for state, off in vision(run.trial.vision, run.prepared.robot).items()
    ]


@dataclass(frozen=True, eq=False, repr=False)
class TwinRun(Result):
    """Results of a robot's twin under a policy and, if requested, under a policy that sends every sample.

    Args:
        prepared: the robot, its camera and its model.
        policy: the policy.
        trial: runs of the policy.
        always: runs of the policy that sends every sample, with the same seeds, or None. ``run_twin`` runs them without
            faults, the live page with the same faults and pushes.
        setup: configuration of the runs.
        seconds: duration in real time, including calibration and identification.
    """

    FIELDS: ClassVar[tuple[Field[TwinRun], ...]] = (
        VERDICT,
        Field("robot", "prepared.robot.name", say="robot", text=lambda run: _driven(run), part="method"),
        Field("policy", "policy.kind", say="policy"),
        Field("runs", lambda run: len(run.trial.totals)),
        Field("rates", json=lambda rates: {link: measured(rate) for link, rate in rates.items()}),
        Field("cost", json=measured, say="cost", text="{} per mission"),
        Field("cost_all_time", _always, say="every-sample cost", text=lambda run: _compared(run)),
        Field("cost_all_time_model", "policy.cost_all_time"),
        Field("cost_bound", say="guarantee", text="at most {:.6g}, for the identified model"),
        Field("rate", "rates", key="", say="rate, {}", text="{} per step"),
        Field("all_time", "always", json=summary_of),
        Field("vision", lambda run: vision(run.trial.vision, run.prepared.robot), say="", text=lambda run: _seen(run)),
        Field("datagrams", lambda run: dict(run.trial.datagrams), say="", text=lambda run: _sent(run), after="rate"),
        Field("seed", "setup.seed"),
        Field("seed_of_preparation", "prepared.seed"),
        Field("seconds", json=lambda seconds: round(seconds, 3)),
        Field("ticks", lambda run: run.trial.costs.shape[1]),
        Field("calibration", "prepared.calibration", say="camera", part="method",
              text="{.error:.2f} pixels reprojection error of the landmarks"),
        Field("model", "prepared.model", say="", text=lambda run: _modelled(run), part="method"),
        Field("thesis", key="", say="thesis", text=lambda run: THESIS[run.prepared.robot.name], part="method"),
        Field("faults", lambda run: [str(fault) for fault in run.setup.faults]),
        Field("processes", lambda run: {name: dict(report) for name, report in run.trial.reports.items()}),
        Field("notes", "trial.notes", say="note"),
        Field("origin", lambda run: run.origin(), key=SPLICED),
    )  # fmt: skip

    prepared: Prepared
    policy: Policy
    trial: Trial
    always: Trial | None
    setup: Setup
    seconds: float

    @property
    def cost(self) -> Estimate:
        """Total cost of a mission, averaged over the runs."""
        return mean(self.trial.totals)

    @property
    def rates(self) -> Mapping[str, Estimate]:
        """Fraction of steps with a request to the camera or a packet to the robot, by link, averaged over the runs."""
        return {link: mean(sent.mean(axis=1)) for link, sent in self.trial.sent.items()}

    @property
    def cost_bound(self) -> float | None:
        """Guaranteed cost for the identified model; None if there are faults, which the theory does not cover."""
        return None if self.setup.faults or self.policy.guarantee is None else self.policy.guarantee.cost

    def plot(self, ax: Any = None, figsize: Size | None = None, style: StyleName = "light") -> Figure:
        """Plot the first run under each policy."""
        trials = {"event-triggered": self.trial} | ({} if self.always is None else {"every sample": self.always})
        return figure_of(self.prepared.robot, trials, ax=ax, figsize=figsize, style=style)

    def to_dataset(self) -> xarray.Dataset:
        """Convert all results to a labelled data set, which also contains the results as a JSON document."""
        robot = self.prepared.robot
        trials = {"event-triggered": self.trial} | ({} if self.always is None else {"all-time": self.always})
        attributes = {"title": f"twin of the {robot.name}", "document": json.dumps(self.document())}
        return to_dataset(robot, trials, {**attributes, **self.origin()})

    def origin(self) -> dict[str, Any]:
        """Return the data that reproduce the results: version, seed, method, and the digest of the problem."""
        return origin(self.trial.problem, self.setup.seed, "simulation")

    def summary(self) -> Mapping[str, object]:
        """Return the robot, the policy, the cost and the rates, by name."""
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

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentences about the packets on each link, the cost compared with sending every sample, and the guarantee."""
        sent = [f"{share_text(rate)} of the {link} packets" for link, rate in self.rates.items()]
        always = _always(self)
        cost = f"cost {self.cost} per mission" if always is None else compared_text(self.cost, always)
        bound = self.cost_bound
        proven = "no guarantee" if bound is None else f"at most {bound:.6g} proven for the identified model"
        return (", ".join([*sent, cost, proven]),)


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
    """Run a robot's twin as processes on this machine: robot, camera, controller, actuator, and links.

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
            f"parameters ({', '.join(parameters)}) are given with the file {file}, which sets the parameters of the "
            "policy; expected either parameters or a file"
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


def check_run(robot: Robot, setup: Setup, parameters: Mapping[str, float], steps: int | None = None) -> None:
    """Raise an error, before the robot is prepared, if it cannot run the given setup.

    Args:
        robot: the robot.
        setup: the setup.
        parameters: policy parameters.
        steps: steps of the mission; default: those of the thesis.

    Raises:
        ProblemError: a parameter or wheel model is unknown, or a fault is not possible in this run.
    """
    check_parameters(robot, parameters)
    setup.check(robot, steps or MISSIONS[robot.name].ticks)


def scaled(progress: Progress | None, low: float, high: float) -> Progress | None:
    """Return a progress callback for a part of a computation; it converts 0 to 1 to the given range."""
    return None if progress is None else lambda fraction: progress(low + (high - low) * fraction)
