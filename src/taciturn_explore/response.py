"""Simulated paths of the loop at a setting and under periodic control, with the same noise and the same events.

Periodic control is the same policy whose links send at fixed intervals, those nearest to the measured rates: the nodes,
the gains and the noise are equal, so only the instants of the packets differ.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from taciturn.errors import TaciturnError
from taciturn.extend import Array
from taciturn.model.names import Names, unit_of
from taciturn.model.network import Network
from taciturn.problem import Problem
from taciturn_explore.disturbed import Path, run_path
from taciturn_explore.plane import Designed, designed
from taciturn_explore.setting import Event, EventKind, Setting

STEP = 3.0  # suggested step of a set-point, in deviations of the outputs
DIGITS = 5  # of the signals of a path
FEW = 20  # steps before the first event, from which on they give the size of an event


def response(setting: Setting, given: Designed, shares: Mapping[str, float]) -> dict[str, Any]:
    """Simulate one path of the loop at a setting, and one path under periodic control."""
    path = run_path(given.loop, setting.steps, setting.seed, setting.events)
    intervals = {link: max(1, round(1 / share)) if share > 0 else setting.steps for link, share in shares.items()}
    try:
        timed = designed(periodically(given.problem, intervals))
        other, reason = run_path(timed.loop, setting.steps, setting.seed, setting.events), ""
    except TaciturnError as error:
        other, reason = None, str(error)
    inputs = input_names(given.problem, path.inputs.shape[1])
    limits = (given.problem.actual or given.problem.plant).input_limit
    return {
        "time": path.time.tolist(),
        "unit": path.unit,
        "outputs": output_names(given.problem, path.outputs.shape[1]),
        "inputs": inputs,
        "limits": None
        if limits is None
        else [[end if math.isfinite(end) else None for end in pair] for pair in limits.tolist()],
        "policy": _drawn(path),
        "periodic": None if other is None else _drawn(other),
        "intervals": intervals,
        "reason": reason,
        "loads": [] if given.policy.prediction is not None else [unit_of(name) for name in inputs],
        "set_points": given.loop.problem.plant.set_points,
        "sizes": {
            "load": _sizes("load", path.inputs, path.inputs, setting.events),
            "step": _sizes("step", path.references, STEP * path.outputs, setting.events),
        },
        "events": [
            {"kind": one.kind, "step": one.step, "where": one.where, "size": one.size} for one in setting.events
        ],
    }


def periodically(problem: Problem, intervals: Mapping[str, int]) -> Problem:
    """Return a copy of the problem in which links send at fixed intervals."""
    network = problem.network
    links = {
        link: replace(law, min_interval=intervals[link], max_interval=intervals[link]) if link in intervals else law
        for link, law in network.links.items()
    }
    timed = Network(nodes=network.nodes, links=links, stated=network.stated, missing=network.missing)
    object.__setattr__(timed, "delay", network.delay)
    return replace(problem, network=timed)


def output_names(problem: Problem, many: int) -> list[str]:
    """Return the names of the outputs: from the problem file, or from nodes with one output each, or numbers."""
    return (problem.names or Names()).labels("outputs", _names(problem, "measures", "y", many))


def input_names(problem: Problem, many: int) -> list[str]:
    """Return the names of the inputs: from the problem file, or from nodes that apply one input each, or numbers."""
    return (problem.names or Names()).labels("inputs", _names(problem, "applies", "u", many))


def _names(problem: Problem, role: Any, letter: str, many: int) -> list[str]:
    found = {0: letter} if many == 1 else {i: f"{letter}{i + 1}" for i in range(many)}
    for node, one in problem.network.nodes.items():
        entries = one.entries(role, many) if problem.network.own_nodes else ()
        found |= {entries[0]: node} if len(entries) == 1 else {}
    return [found[i] for i in range(many)]


def _sizes(kind: EventKind, signals: Array, scale: Array, events: Sequence[Event]) -> list[float]:
    """Return a size for the next event of each signal: that of the last one.

    Without one, it has one digit, and is about the largest deviation of a signal on the path before all events.
    """
    first = min((one.step for one in events), default=0)
    before = scale[: first if first >= FEW else None]
    spread = float(np.abs(before - before.mean(axis=0)).max(initial=0.0)) or 1.0
    last = {int(one.where): one.size for one in events if one.kind == kind}
    return [last.get(i, float(f"{spread:.1g}")) for i in range(signals.shape[1])]


def _drawn(path: Path) -> dict[str, Any]:
    return {
        "outputs": [_short(row) for row in path.outputs.T],
        "references": [_short(row) for row in path.references.T],
        "inputs": [_short(row) for row in path.inputs.T],
        "sent": {link: np.flatnonzero(sent).tolist() for link, sent in path.sent.items()},
        "dropped": {link: np.flatnonzero(sent & ~path.arrived[link]).tolist() for link, sent in path.sent.items()},
        "ratios": {link: _short(ratio) for link, ratio in path.ratios.items()},
    }


def short(value: float, digits: int = DIGITS) -> float:
    """Round a number to the given number of significant digits."""
    return float(f"{value:.{digits}g}")


def _short(values: Array | Sequence[float]) -> list[float]:
    return [short(value) for value in values]
