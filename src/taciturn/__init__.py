"""Event-triggered control for linear systems, with guarantees on performance and transmission rate."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from taciturn._version import __version__

if TYPE_CHECKING:
    from taciturn import design as design
    from taciturn.errors import ProblemError as ProblemError
    from taciturn.errors import TaciturnError as TaciturnError
    from taciturn.errors import UnstableError as UnstableError
    from taciturn.loop import Loop as Loop
    from taciturn.loop import close as close
    from taciturn.model.bursts.gilbert_elliott import Burst as Burst
    from taciturn.model.controller import Controller as Controller
    from taciturn.model.cost import Cost as Cost
    from taciturn.model.disturbance import Disturbance as Disturbance
    from taciturn.model.dynamics import integrate as integrate
    from taciturn.model.dynamics import linearise as linearise
    from taciturn.model.estimate import Estimate as Estimate
    from taciturn.model.kept import controller_from as controller_from
    from taciturn.model.network import Network as Network
    from taciturn.model.pid import PID as PID
    from taciturn.model.plant import ContinuousPlant as ContinuousPlant
    from taciturn.model.plant import Jumps as Jumps
    from taciturn.model.plant import Plant as Plant
    from taciturn.model.policy import Policy as Policy
    from taciturn.model.reference import Reference as Reference
    from taciturn.model.state_space import plant_from as plant_from
    from taciturn.model.theory import Guarantee as Guarantee
    from taciturn.model.theory import Theory as Theory
    from taciturn.model.trigger import Trigger as Trigger
    from taciturn.problem import Problem as Problem
    from taciturn.problem import load as load
    from taciturn.runtime.control import from_control as from_control
    from taciturn.runtime.control import to_control as to_control
    from taciturn.runtime.nodes import Nodes as Nodes
    from taciturn.simulation.average import average as average
    from taciturn.simulation.average import difference as difference
    from taciturn.simulation.trajectory import simulate as simulate
    from taciturn.study.certify import certify as certify
    from taciturn.study.channel.share import share_channel as share_channel
    from taciturn.study.compare import compare as compare
    from taciturn.study.evaluate import evaluate as evaluate
    from taciturn.study.export import export_c as export_c
    from taciturn.study.export import export_fmu as export_fmu
    from taciturn.study.sweeping.sweep import sweep as sweep
    from taciturn.study.testbed.network import run_network as run_network
    from taciturn.study.tradeoff import tradeoff as tradeoff
    from taciturn.study.tuning.tune import tune as tune

# Module of each public name; it is imported at the first access, so that `taciturn --help` starts quickly.
_HOME = {
    "Burst": "model.bursts.gilbert_elliott",
    "ContinuousPlant": "model.plant",
    "Controller": "model.controller",
    "Cost": "model.cost",
    "Disturbance": "model.disturbance",
    "Estimate": "model.estimate",
    "Guarantee": "model.theory",
    "Jumps": "model.plant",
    "Loop": "loop",
    "Network": "model.network",
    "Nodes": "runtime.nodes",
    "PID": "model.pid",
    "Plant": "model.plant",
    "Policy": "model.policy",
    "Problem": "problem",
    "ProblemError": "errors",
    "Reference": "model.reference",
    "TaciturnError": "errors",
    "Theory": "model.theory",
    "Trigger": "model.trigger",
    "UnstableError": "errors",
    "average": "simulation.average",
    "certify": "study.certify",
    "close": "loop",
    "controller_from": "model.kept",
    "compare": "study.compare",
    "difference": "simulation.average",
    "evaluate": "study.evaluate",
    "export_c": "study.export",
    "export_fmu": "study.export",
    "from_control": "runtime.control",
    "integrate": "model.dynamics",
    "linearise": "model.dynamics",
    "load": "problem",
    "plant_from": "model.state_space",
    "run_network": "study.testbed.network",
    "share_channel": "study.channel.share",
    "simulate": "simulation.trajectory",
    "sweep": "study.sweeping.sweep",
    "to_control": "runtime.control",
    "tradeoff": "study.tradeoff",
    "tune": "study.tuning.tune",
}
_ADDED = "taciturn.functions"  # entry points of functions that other packages add, such as taciturn.reproduce
__all__ = ["__version__", "design", *_HOME]  # pyright: ignore[reportUnsupportedDunderAll]  # the names above


def __getattr__(name: str) -> Any:
    if name == "design":  # the policies, by name: taciturn.design.lqg(…)
        return import_module("taciturn.design")
    if name in _HOME:
        value: Any = getattr(import_module(f"taciturn.{_HOME[name]}"), name)
    elif not name.startswith("_") and name in (plugins := import_module("taciturn._plugins")).find_plugins(_ADDED):
        value = plugins.load_plugin(_ADDED, name, f"taciturn.{name}")
    else:
        raise AttributeError(f"module 'taciturn' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, *import_module("taciturn._plugins").find_plugins(_ADDED)])
