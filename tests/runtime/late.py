"""Loops whose packets arrive late, with the delay of each packet, and their nodes on the same delays."""

from __future__ import annotations

import tomllib
from typing import Any

import numpy as np
from runtime.loops import Records, column

import taciturn
from taciturn.loop import Loop
from taciturn.model.delay import WHOLE
from taciturn.model.packets import inputs_at, outputs_at, roles
from taciturn.model.steps import Received
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet
from taciturn.problem import Problem, parse
from taciturn.program import numpy as interpreter
from taciturn.program.all_nodes import ACTING
from taciturn.program.draws import NORMAL
from taciturn.program.late import NEVER, pieces_of_links
from taciturn.program.machine import Kernel
from taciturn.program.ops import Arrived, Name, Sent, is_entry, named
from taciturn.program.translation import TimeStep

ACTUATOR = {"loss": 0.1, "acknowledged": True, "delay": [0.7, 0.2, 0.1]}
EXCESS = {"kind": "excess", "theta": None, "delta": 0.5}
WITHIN = {"seconds": [0.004, 0.013, 0.02, 0.047], "probability": [0.4, 0.3, 0.2, 0.05]}  # periods are 0.02 s


def pendulum(policy: dict[str, Any] | None = None, **link: Any) -> Problem:
    """Return the inverted pendulum over a link to the actuator that delays packets at random."""
    links = {f"links.actuator.{key}": value for key, value in {**ACTUATOR, **link}.items()}
    return taciturn.load("inverted-pendulum").changed({**EXCESS, **(policy or {}), **links})


SETS = """
[plant]
dt = 1.0
A = [[0.98, 0.1], [0.05, 0.9]]
B = [[1.0, 0.2], [0.1, 0.8]]
W = [[0.1, 0.0], [0.0, 0.1]]
C = [[1.0, 0.0], [0.0, 1.0]]
V = [[0.01, 0.0], [0.0, 0.01]]
[cost]
Q = [[1.0, 0.0], [0.0, 1.0]]
R = [[5.0, 0.0], [0.0, 5.0]]
[nodes]
board = {controls = true}
top = {measures = [1], site = "board"}
bottom = {measures = [0], site = "board"}
valve = {applies = [0]}
pump = {applies = [1]}
[links]
valve = {delay = [0.5, 0.3, 0.2], acknowledged = true}
pump = {loss = 0.1, acknowledged = true, price = 2.0}
[policy]
kind = "excess"
theta = 0.1
"""
GAINS = """
[controller]
A = [[0.5]]
B = [[0.3, 0.1]]
C = [[0.1], [0.1]]
D = [[0.3, 0.05], [0.1, 0.28]]
"""


def sets(**changes: Any) -> Problem:
    """Return a plant with two actuators, to which packets may be late or lost, on which the controller decides."""
    return parse(tomllib.loads(SETS), "sets").changed(changes)


def told_late(**changes: Any) -> Problem:
    """Return the same plant with a given controller, and acknowledgements that come one step late."""
    late = {f"links.{link}.acknowledgement_delay": 1 for link in ("valve", "pump")}
    return parse(tomllib.loads(SETS + GAINS), "sets").changed({**late, **changes})


LATE_SENSOR = """
[plant]
dt = 0.1
A = [[1.1, 0.2], [0.0, 0.7]]
B = [[0.3], [1.0]]
W = [[0.1, 0.0], [0.0, 0.2]]
C = [[1.0, 0.0]]
V = [[0.1]]
[cost]
Q = [[1.0, 0.0], [0.0, 1.0]]
R = [[0.2]]
[network]
protocol = "tcp"
actuator_loss = 0.1
sensor_loss = 0.1
sensor_delay = [0.3, 0.3, 0.2, 0.2]
[policy]
kind = "lossy-lqg"
price = 0.1
"""
STATES: dict[str, Any] = {"plant.C": None, "plant.V": None}


def late_sensor(**changes: Any) -> Problem:
    """Return a plant whose measurements come late, in any order, or not at all."""
    return parse(tomllib.loads(LATE_SENSOR), "late").changed(changes)


class Shown(TimeStep):
    """A time step that also shows the delay of each packet, and the inputs of the pieces of a period."""

    def packets(self) -> dict[Name, int]:
        """Return the flags of packets, the delays of those that are sent in this step, and the inputs."""
        return super().packets() | self.delays() | named(ACTING, self.signals.get(ACTING, ()))


def record(loop: Loop, ticks: int, seed: int, fast: bool = True) -> Records:
    """Return what a loop shows, with the delays of its packets, (steps, 1) by name."""
    program = loop.in_units.whole_program(begin=Shown)
    program, draws = program.keep(outputs=set(program.outputs)), np.random.default_rng(seed)
    normal = np.array([is_entry(name, NORMAL) for name in program.inputs], dtype=bool)
    shape = ticks, len(program.inputs), 1
    inputs = np.where(normal[:, None], draws.standard_normal(shape), draws.random(shape))
    run = Kernel(program, "parity").run if fast else lambda *rest: interpreter.run(*rest)
    return run(program, loop.start(program, 1, seed), ticks, inputs).outputs


def delays(loop: Loop, records: Records) -> dict[str, np.ndarray]:
    """Return the delay of the packet of each step in pieces of a period, by link; those of other links are 0."""
    cuts, pieces = loop.network.cuts(loop.policy.tick) or (0.0,), loop.problem.pieces
    finer = (0.0,) if pieces is None else pieces.cuts  # which constant delays cut too

    def of_nodes(codes: np.ndarray) -> np.ndarray:
        whole, piece = np.divmod(codes, len(finer))
        place = np.searchsorted(np.array(cuts), np.array(finer)[piece.astype(int)] + WHOLE) - 1
        return np.where(codes < NEVER, whole * len(cuts) + place, NEVER)

    found = {n.link: np.where(values[:, 0] > 0, 0.0, NEVER) for n, values in records.items() if isinstance(n, Received)}
    return found | {n.link: of_nodes(values[:, 0]) for n, values in records.items() if isinstance(n, Arrived)}


def inputs_of(loop: Loop, records: Records) -> np.ndarray:
    """Return the inputs that act from each part of a period on at which packets may arrive, (steps, parts, m)."""
    pieces, cuts = loop.problem.pieces, loop.network.cuts(loop.policy.tick)
    if pieces is None:
        return column(records, "applied")[:, None, :]
    found = column(records, ACTING).reshape(-1, len(pieces.cuts), loop.problem.plant.inputs)
    return found[:, [int(np.abs(np.array(pieces.cuts) - cut).argmin()) for cut in cuts]]


def nodes_of(loop: Loop) -> dict[str, Node]:
    """Return the nodes of a loop."""
    return {role: Node(loop.policy, role, network=loop.network) for role in roles(loop.policy)}


def differing_steps(loop: Loop, records: Records, kept: int = 0) -> tuple[list[int], dict[str, Node]]:
    """Run nodes on the measurements and delays of a loop; return the steps in which a bit differs, and the nodes.

    After ``kept`` steps, other nodes go on from their saved states.
    """
    policy, y, given, after = loop.policy, column(records, "y"), inputs_of(loop, records), delays(loop, records)
    sent = {name.link: values[:, 0] for name, values in records.items() if isinstance(name, Sent)}
    pieces = pieces_of_links(loop.network, policy.tick)
    q = {link: len(loop.network.cuts(policy.tick) or (0.0,)) // count for link, count in pieces.items()}
    nodes = nodes_of(loop)
    boxes: dict[str, list[tuple[int, Packet]]] = {role: [] for role in nodes}
    wrong = list[int]()
    for step in range(len(y)):
        if kept and step == kept:
            states = {role: node.save() for role, node in nodes.items()}
            nodes = nodes_of(loop)
            for role, node in nodes.items():
                node.restore(states[role])
        flags = dict.fromkeys(sent, 0.0)
        for role, node in nodes.items():
            come = [packet for due, packet in boxes[role] if due <= step]
            boxes[role] = [(due, packet) for due, packet in boxes[role] if due > step]
            packets, applied = node.step(step, [y[step, i] for i in outputs_at(policy, role)], come)
            if applied is not None:
                rows = given[step][-node.pieces :, inputs_at(policy, role)]
                wrong += [step] if np.array(applied).tobytes() != rows.tobytes() else []
            for packet in packets:
                back = packet.kind == "acknowledgement"
                to = next(r for r, n in nodes.items() if packet.link in (n.program.sends if back else n.program.hears))
                if back:
                    boxes[to].append((0, packet))
                    continue
                flags[packet.link] = 1.0
                code, n = int(after[packet.link][step]) // q.get(packet.link, 1), pieces.get(packet.link, 1)
                if code < NEVER / 2:
                    boxes[to].append((step + code // n, packet._replace(late=code)))
        wrong += [step for link, flag in flags.items() if flag != sent[link][step]]
    return wrong, nodes
