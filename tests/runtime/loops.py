"""Runs a closed loop and its nodes side by side, on the same draws."""

from __future__ import annotations

from collections.abc import Mapping
from unittest.mock import patch

import numpy as np

import taciturn
from taciturn.loop import Loop
from taciturn.model.packets import inputs_at, outputs_at, roles
from taciturn.model.steps import Received
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn.problem import Problem
from taciturn.program import numpy as interpreter
from taciturn.program.draws import NORMAL
from taciturn.program.ir import Program
from taciturn.program.machine import Kernel
from taciturn.program.missing import SAMPLED
from taciturn.program.ops import Sent, is_entry
from taciturn_export.folder import drawn_by_the_policy
from taciturn_udp.relay import losses

Records = Mapping[str, np.ndarray]


def open_program(loop: Loop) -> Program:
    """Return the loop with its draws as inputs."""
    with patch("taciturn.loop.with_draws", lambda program, uniforms: program):
        whole = loop.program()
    return whole.keep(outputs=set(whole.outputs))


def record(loop: Loop, ticks: int, seed: int, paths: int = 1, fast: bool = True) -> tuple[Records, np.ndarray]:
    """Return what a loop shows, (steps, paths) by name, and the draws of its policy, (steps, draws, paths)."""
    loop = loop.in_units
    program = open_program(loop)
    draws = np.random.default_rng(seed)
    normal = [is_entry(name, NORMAL) for name in program.inputs]
    shape = (ticks, len(program.inputs), paths)
    inputs = np.where(np.array(normal, dtype=bool)[:, None], draws.standard_normal(shape), draws.random(shape))
    run = Kernel(program, "parity").run if fast else lambda *rest: interpreter.run(*rest)
    outputs = run(program, loop.start(program, paths, seed), ticks, inputs).outputs
    own = [program.inputs.index(name) for name in drawn_by_the_policy(loop.open_program())]
    return outputs, inputs[:, own, :]


def column(records: Records, name: str, path: int = 0) -> np.ndarray:
    """Return the entries of a signal, (steps, entries)."""
    return np.array([values[:, path] for key, values in records.items() if is_entry(key, name)]).T


def differing_ticks(loop: Loop, records: Records, draws: np.ndarray, path: int = 0) -> tuple[list[int], int]:
    """Run the nodes on what a loop measured and lost; return the steps in which a bit differs, and the packets sent."""
    policy = loop.policy
    nodes = {role: Node(policy, role, network=loop.network) for role in roles(policy)}
    y, applied = column(records, "y", path), column(records, "applied", path)
    known = column(records, SAMPLED, path) if loop.network.missing else np.ones(y.shape)
    arrived = {name.link: values[:, path] for name, values in records.items() if isinstance(name, Received)}
    sent = {name.link: values[:, path] for name, values in records.items() if isinstance(name, Sent)}
    boxes: dict[str, list[Packet]] = {role: [] for role in nodes}
    wrong, packets = [], 0
    for tick in range(len(y)):
        flags: dict[str, float] = dict.fromkeys(sent, 0.0)
        for role, node in nodes.items():
            mine = draws[tick, :, path] if node.program.draws is not None else None
            box, boxes[role] = boxes[role], []
            sample = [y[tick, i] if known[tick, i] else None for i in outputs_at(policy, role)]
            out, given = node.step(tick, sample, box, mine)
            expected = applied[tick, inputs_at(policy, role)]
            if given is not None and np.array(given).tobytes() != expected.tobytes():
                wrong.append(tick)
            for packet in out:
                if packet.kind == "acknowledgement":
                    boxes[next(r for r, n in nodes.items() if packet.link in n.program.sends)].append(packet)
                    continue
                packets += 1
                flags[packet.link] = 1.0
                if arrived[packet.link][tick]:
                    boxes[next(r for r, n in nodes.items() if packet.link in n.program.hears)].append(packet)
        wrong += [tick for link, flag in flags.items() if flag != sent[link][tick]]
    assert not any(node.degraded for node in nodes.values() if not node.counters["missing"])
    return wrong, packets


def by_hand(file: str | Problem, ticks: int, seed: int) -> np.ndarray:
    """Return the costs of a problem's nodes and plant in this process, over links that lose what relays would lose."""
    return in_this_process(file, ticks, seed)[0]


def in_this_process(file: str | Problem, ticks: int, seed: int) -> tuple[np.ndarray, Mapping[str, Node]]:
    """Return the same costs, and the nodes after the last step."""
    problem = taciturn.load(file) if isinstance(file, str) else file
    policy = problem.design()
    fates = losses(problem.network, seed, period=policy.tick)
    nodes = {role: Node(policy, role, network=problem.network, seed=seed) for role in roles(policy)}
    plant, boxes = SimulatedPlant(problem.close(policy), seed), {role: list[Packet]() for role in nodes}
    u, costs = np.zeros((plant.pieces, policy.model.inputs)), np.empty(ticks)
    flying: list[tuple[int, Packet]] = []  # packets on links with random delays, with the step of their arrival
    for tick in range(ticks):
        for role, node in nodes.items():
            box, boxes[role] = boxes[role], []
            box += [packet for due, packet in flying if due == tick and packet.link in node.program.hears]
            y = [plant.measurement[i] for i in outputs_at(policy, role)]
            packets, given = node.step(tick, y if node.measures else None, box)
            if given is not None:
                u[:, inputs_at(policy, role)] = np.reshape(given, (node.pieces, -1))
            for packet in packets:
                ends = {name: node.program.hears for name, node in nodes.items()}
                if packet.kind == "acknowledgement":
                    ends = {name: node.program.sends for name, node in nodes.items()}
                elif (fate := fates[packet.link]).lost(packet.sequence, tick):  # type: ignore[index]
                    continue
                elif fate.late is not None:
                    late = fate.late_by(packet.sequence, tick)
                    due = -1 if late is None else tick + late // fate.late.pieces
                    packet = packet._replace(late=late or 0)
                    if due != tick:
                        flying.append((due, packet))
                        continue
                boxes[next(name for name, links in ends.items() if packet.link in links)].append(packet)
        costs[tick] = plant.move(u.ravel().tolist())
    return costs, nodes
