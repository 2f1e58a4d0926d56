"""Event-triggered control for linear systems, with guarantees on performance and on the transmission rate."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from taciturn._version import __version__

if TYPE_CHECKING:
    from taciturn import design as design
    from taciturn.analyse.limits import LowerBound as LowerBound
    from taciturn.analyse.limits import bound_below as bound_below
    from taciturn.analyse.limits import solve_optimum as solve_optimum
    from taciturn.analyse.renewal import bound_rate as bound_rate
    from taciturn.analyse.renewal import bound_sends as bound_sends
    from taciturn.analyse.renewal import solve_renewal as solve_renewal
    from taciturn.errors import InformationError as InformationError
    from taciturn.errors import ProblemError as ProblemError
    from taciturn.errors import TaciturnError as TaciturnError
    from taciturn.errors import UnstableError as UnstableError
    from taciturn.loop import Loop as Loop
    from taciturn.loop import close as close
    from taciturn.model.cost import Cost as Cost
    from taciturn.model.dynamics import integrate as integrate
    from taciturn.model.dynamics import linearise as linearise
    from taciturn.model.estimate import Estimate as Estimate
    from taciturn.model.network import Burst as Burst
    from taciturn.model.network import Network as Network
    from taciturn.model.plant import ContinuousPlant as ContinuousPlant
    from taciturn.model.plant import Jumps as Jumps
    from taciturn.model.plant import Plant as Plant
    from taciturn.model.plant import plant_from as plant_from
    from taciturn.model.policy import Guarantee as Guarantee
    from taciturn.model.policy import Policy as Policy
    from taciturn.model.reference import Reference as Reference
    from taciturn.model.schedule import Schedule as Schedule
    from taciturn.model.trigger import Bell as Bell
    from taciturn.model.trigger import Form as Form
    from taciturn.model.trigger import Scheduled as Scheduled
    from taciturn.model.trigger import Trigger as Trigger
    from taciturn.problem import Problem as Problem
    from taciturn.problem import load as load
    from taciturn.renewal.optimal import Optimum as Optimum
    from taciturn.runtime.control import from_control as from_control
    from taciturn.runtime.control import to_control as to_control
    from taciturn.runtime.node import Node as Node
    from taciturn.runtime.nodes import Nodes as Nodes
    from taciturn.simulation.average import average as average
    from taciturn.simulation.average import difference as difference
    from taciturn.simulation.bank import Bank as Bank
    from taciturn.simulation.course import Course as Course
    from taciturn.simulation.course import course as course
    from taciturn.simulation.statistics import batch_means as batch_means
    from taciturn.simulation.statistics import regenerative as regenerative
    from taciturn.simulation.trajectory import Trajectory as Trajectory
    from taciturn.simulation.trajectory import simulate as simulate
    from taciturn.study.certify import Certificates as Certificates
    from taciturn.study.certify import certify as certify
    from taciturn.study.channel import Sharing as Sharing
    from taciturn.study.channel import share_channel as share_channel
    from taciturn.study.compare import Comparison as Comparison
    from taciturn.study.compare import compare as compare
    from taciturn.study.evaluate import Evaluation as Evaluation
    from taciturn.study.evaluate import evaluate as evaluate
    from taciturn.study.export import export_c as export_c
    from taciturn.study.export import export_fmu as export_fmu
    from taciturn.study.losses import find_losses as find_losses
    from taciturn.study.network import NetworkRun as NetworkRun
    from taciturn.study.network import run_network as run_network
    from taciturn.study.periods import TunedPeriod as TunedPeriod
    from taciturn.study.periods import tune_period as tune_period
    from taciturn.study.reproduce import reproduce as reproduce
    from taciturn.study.sweep import sweep as sweep
    from taciturn.study.tradeoff import Tradeoff as Tradeoff
    from taciturn.study.tradeoff import tradeoff as tradeoff
    from taciturn.study.tune import Tuned as Tuned
    from taciturn.study.tune import tune as tune

# Where each public name lives; it is imported when it is first asked for, so that `taciturn --help` is quick.
_HOME = {
    "Bank": "simulation.bank",
    "Bell": "model.trigger",
    "Burst": "model.network",
    "Certificates": "study.certify",
    "Comparison": "study.compare",
    "ContinuousPlant": "model.plant",
    "Cost": "model.cost",
    "Course": "simulation.course",
    "Estimate": "model.estimate",
    "Evaluation": "study.evaluate",
    "Form": "model.trigger",
    "Guarantee": "model.policy",
    "InformationError": "errors",
    "Jumps": "model.plant",
    "Loop": "loop",
    "Network": "model.network",
    "NetworkRun": "study.network",
    "Node": "runtime.node",
    "Nodes": "runtime.nodes",
    "Plant": "model.plant",
    "Policy": "model.policy",
    "Problem": "problem",
    "ProblemError": "errors",
    "Reference": "model.reference",
    "Schedule": "model.schedule",
    "Scheduled": "model.trigger",
    "Sharing": "study.channel",
    "TaciturnError": "errors",
    "TunedPeriod": "study.periods",
    "Tradeoff": "study.tradeoff",
    "Trajectory": "simulation.trajectory",
    "Trigger": "model.trigger",
    "Tuned": "study.tune",
    "UnstableError": "errors",
    "LowerBound": "analyse.limits",
    "Optimum": "renewal.optimal",
    "average": "simulation.average",
    "bound_below": "analyse.limits",
    "bound_rate": "analyse.renewal",
    "bound_sends": "analyse.renewal",
    "batch_means": "simulation.statistics",
    "certify": "study.certify",
    "close": "loop",
    "compare": "study.compare",
    "course": "simulation.course",
    "difference": "simulation.average",
    "evaluate": "study.evaluate",
    "export_c": "study.export",
    "export_fmu": "study.export",
    "find_losses": "study.losses",
    "from_control": "runtime.control",
    "integrate": "model.dynamics",
    "linearise": "model.dynamics",
    "load": "problem",
    "plant_from": "model.plant",
    "regenerative": "simulation.statistics",
    "reproduce": "study.reproduce",
    "run_network": "study.network",
    "share_channel": "study.channel",
    "simulate": "simulation.trajectory",
    "solve_optimum": "analyse.limits",
    "solve_renewal": "analyse.renewal",
    "sweep": "study.sweep",
    "to_control": "runtime.control",
    "tradeoff": "study.tradeoff",
    "tune": "study.tune",
    "tune_period": "study.periods",
}
__all__ = ["__version__", "design", *_HOME]  # pyright: ignore[reportUnsupportedDunderAll]  # the names above, kept in one place


def __getattr__(name: str) -> object:
    if name == "design":  # the policies, by name: taciturn.design.lqg(…)
        return import_module("taciturn.design")
    if name not in _HOME:
        raise AttributeError(f"module 'taciturn' has no attribute {name!r}")
    value: object = getattr(import_module(f"taciturn.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
