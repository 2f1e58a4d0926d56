"""Loops whose nodes add up what their silence costs, and what a simulation of them measures, loses and adds up."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from runtime.loops import column, open_program

import taciturn
from taciturn import Problem
from taciturn.loop import Loop
from taciturn.model.packets import inputs_at, outputs_at, roles
from taciturn.model.wire import SETPOINT
from taciturn.nodes.node import Node, Stepped
from taciturn.nodes.packet import Packet
from taciturn.program import numpy as interpreter
from taciturn.program.draws import NORMAL
from taciturn.program.ops import Precision, Received, Sent, is_entry
from taciturn_udp.logs import log_line

Links = tuple[str, ...]
SHOWN = "estimate"  # a signal that programs of loops show
LOST = {"loss": 0.3, "acknowledged": True}
TANK: dict[str, Any] = {
    "kind": "distributed", "theta": 0.5,
    "nodes.gauge.measures": [0], "nodes.plc.controls": True, "nodes.valve.applies": [0],
}  # fmt: skip
ROUNDED = {f"links.{link}.payload": "int16" for link in ("gauge", "valve")}
FOUR: dict[str, Any] = {"guarantee": "every path", "theta": 1.0}
CASES: dict[str, tuple[str, Mapping[str, Any]]] = {
    "held": ("pid-tank", TANK),
    "one sensor": ("pid-tank", {**TANK, "nodes.valve.site": "plc"}),
    "losses": ("pid-tank", {**TANK, **{f"links.{at}.{key}": LOST[key] for at in ("gauge", "valve") for key in LOST}}),
    "relative": ("pid-tank", {**TANK, "rule": "relative"}),
    "threshold": ("pid-tank", {**TANK, "rule": "threshold"}),
    "predicted": ("pid-tank", {**TANK, "prediction": "model", "actuation": "model"}),
    "set-points": ("pid-tank", {**TANK, "reference.steps": {"rate": 0.05, "covariance": [[1.0]]}}),
    "operating point": ("pid-tank", {**TANK, "plant.operating_point": {"x": [2.0, 0.0], "u": [0.0]}}),
    "longest intervals": ("pid-tank", {**TANK, "links.gauge.max_interval": 4, "links.valve.max_interval": 6}),
    "rounded": (
        "pid-tank", {**TANK, **ROUNDED, "links.gauge.range": [2.0], "links.valve.range": [4.0]},
    ),
    "two valves": ("quadruple-tank", {**FOUR, "actuation": "hold"}),
    "four nodes that predict, losses": (
        "quadruple-tank",
        {**FOUR, **{f"links.{at}.{key}": LOST[key] for at in ("level-1", "pump-1", "pump-2") for key in LOST}},
    ),
}  # fmt: skip


def problem_of(name: str) -> Problem:
    """Return a problem."""
    file, changes = CASES[name]
    return taciturn.load(file).changed(dict(changes))


@cache
def build(name: str) -> Loop:
    """Return the loop of a problem, designed once."""
    problem = problem_of(name)
    return problem.close(problem.design())


@dataclass(frozen=True, eq=False)
class Simulated:
    """What a simulation measured and applied, and what its nodes added up, (steps, …)."""

    y: np.ndarray
    points: np.ndarray  # the set-points
    applied: np.ndarray
    sent: Mapping[str, np.ndarray]
    arrived: Mapping[str, np.ndarray]
    total: Mapping[Links, np.ndarray]
    lasted: Mapping[Links, np.ndarray]


def simulate(loop: Loop, ticks: int, seed: int = 0, precision: Precision = "float64") -> Simulated:
    """Return a path of a loop, by the NumPy program."""
    silence = loop.policy.theory.silence
    names = [name for one in silence.values() for name in (one.total, one.lasted)]
    rows = {name: np.eye(len(names))[:, [i]] for i, name in enumerate(names)}
    loop = replace(loop, precision=precision).in_units
    loop = replace(loop, policy=replace(loop.policy, theory=replace(loop.policy.theory, sums={SHOWN: rows})))
    program = open_program(loop)
    draws = np.random.default_rng(seed)
    normal = np.array([is_entry(name, NORMAL) for name in program.inputs], dtype=bool)
    shape = (ticks, len(program.inputs), 1)
    inputs = np.where(normal[:, None], draws.standard_normal(shape), draws.random(shape))
    found = interpreter.run(program, loop.start(program, 1, seed), ticks, inputs).outputs
    added = column(found, SHOWN)
    points = column(found, "reference") if any(is_entry(name, "reference") for name in found) else np.zeros((ticks, 0))
    return Simulated(
        column(found, "y"),
        points,
        column(found, "applied"),
        {name.link: values[:, 0] > 0 for name, values in found.items() if isinstance(name, Sent)},
        {name.link: values[:, 0] > 0 for name, values in found.items() if isinstance(name, Received)},
        {links: added[:, 2 * i] for i, links in enumerate(silence)},
        {links: added[:, 2 * i + 1] for i, links in enumerate(silence)},
    )


class Walk:
    """Separate nodes on a path that was simulated: its measurements, set-points and losses.

    Args:
        loop: the loop.
        path: its path.
        nodes: the nodes by role; default: new ones.
    """

    def __init__(self, loop: Loop, path: Simulated, nodes: dict[str, Node] | None = None) -> None:
        """Stand before the first step."""
        self.loop, self.path = loop, path
        self.nodes = nodes or {role: Node(loop.policy, role, network=loop.network) for role in roles(loop.policy)}
        self.boxes: dict[str, list[Packet]] = {role: [] for role in self.nodes}
        self.given = np.zeros(loop.policy.model.inputs)

    def steps(self, ticks: Iterable[int]) -> Iterator[tuple[int, str, list[Packet], Sequence[float] | None, Stepped]]:
        """Go through steps; tell of each node what it was given and what it did."""
        policy = self.loop.policy
        for tick in ticks:
            for role in self.nodes:
                node, (box, self.boxes[role]) = self.nodes[role], (self.boxes[role], [])
                if any(one.link == SETPOINT for one in node._layout.arrivals):
                    box.append(Packet("measurement", SETPOINT, tick, tick, tuple(self.path.points[tick]), 1))
                y = self.path.y[tick, outputs_at(policy, role)].tolist() if node.measures else None
                stepped = node.step(tick, y, box)
                if stepped.input is not None:
                    self.given[inputs_at(policy, role)] = stepped.input
                for packet in stepped.packets:
                    back = packet.kind == "acknowledgement"
                    sure = back or self.loop.network.loss(packet.link) == 0
                    if sure or self.path.arrived[packet.link][tick]:
                        ends = {r: n.program.sends if back else n.program.hears for r, n in self.nodes.items()}
                        self.boxes[next(r for r, links in ends.items() if packet.link in links)].append(packet)
                yield tick, role, box, y, stepped


def concluded(node: Node, tick: int) -> int:
    """Return the last step whose silence a node has added up: with acknowledgements, that before the present one."""
    return tick - (len(node.program.parts) > 1)


def write_logs(loop: Loop, path: Simulated, folder: Path, ticks: int | None = None) -> list[Path]:
    """Write the logs of all nodes on a path, as processes write them, and return their files."""
    walk = Walk(loop, path)
    files = {role: folder / f"{role}.jsonl" for role in walk.nodes}
    lines: dict[str, list[str]] = {role: [] for role in files}
    for _, role, box, y, done in walk.steps(range(len(path.y) if ticks is None else ticks)):
        measured, arrived = None if y is None else tuple(y), dict[str, list[int]]()
        for packet in box:
            if packet.kind == "data":
                arrived.setdefault(packet.link, []).append(packet.sequence)
        told = log_line(walk.nodes[role], measured, done.packets, done.input, arrived, None)
        lines[role].append(json.dumps(told))
    for role, file in files.items():
        file.write_text("\n".join([*lines[role], ""]), encoding="utf-8")
    return list(files.values())
