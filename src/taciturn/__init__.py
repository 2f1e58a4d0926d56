"""Event-triggered control for linear systems, with guarantees on performance and transmission rate."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from taciturn._version import __version__

# Module of each public name; it is imported at the first access, so that `taciturn --help` starts quickly.
_HOME = {
    "Burst": "model.losses",
    "ContinuousPlant": "model.plant",
    "Controller": "model.controller",
    "Cost": "model.cost",
    "Disturbance": "model.disturbance",
    "Estimate": "model.estimate",
    "Guarantee": "model.theory",
    "Jumps": "model.plant",
    "Loop": "loop",
    "Network": "model.network",
    "Nodes": "nodes.together",
    "PID": "model.controller",
    "Plant": "model.plant",
    "Policy": "model.policy",
    "Problem": "problem",
    "ProblemError": "errors",
    "Reference": "model.disturbance",
    "TaciturnError": "errors",
    "Theory": "model.theory",
    "Trigger": "model.trigger",
    "UnstableError": "errors",
    "average": "simulation.average",
    "close": "loop",
    "controller_from": "model.controller",
    "difference": "simulation.average",
    "evaluate": "study.evaluate",
    "integrate": "model.dynamics",
    "linearise": "model.dynamics",
    "load": "problem",
    "plant_from": "model.state_space",
    "simulate": "simulation.trajectory",
    "style": "_style",
}
_ADDED = "taciturn.functions"  # entry points of functions that packages beside this one add, such as taciturn.sweep
_BESIDE = (
    "certify",
    "compare",
    "explore",
    "export_c",
    "export_fmu",
    "from_control",
    "run_network",
    "share_channel",
    "sweep",
    "to_control",
    "tradeoff",
    "tune",
)
__all__ = ["__version__", "design", *_BESIDE, *_HOME]  # noqa: F822  # pyright: ignore[reportUnsupportedDunderAll]  # all of them are imported when asked for


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
