"""The servers of a problem's nodes and plant in virtual time, with emulated links, logs and a record."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import taciturn
from taciturn.model.packets import peers_of, receiver_of, roles, sender_of
from taciturn.model.steps import Send
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Wire
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn.problem import Problem
from taciturn_udp.endpoint import Address
from taciturn_udp.logs import Logs, logged
from taciturn_udp.nodes import NodeServer
from taciturn_udp.plant import PlantServer
from taciturn_udp.record import Record
from taciturn_udp.relay import EmulatedLink, Fate
from taciturn_udp.run import drawn_delays
from taciturn_udp.service import usual_wait
from taciturn_worlds.virtual import VirtualClock, VirtualNetwork, VirtualPort, VirtualProcess, VirtualTime

LATENCY = 1e-4  # seconds that a datagram takes besides the emulated delay


@dataclass
class Ran:
    """What ran."""

    logs: Logs
    plant: PlantServer
    nodes: Mapping[str, NodeServer]
    links: Mapping[str, EmulatedLink]
    packets: list[list[str]]
    signals: list[list[str]]


def run_virtually(
    problem: str | Problem, folder: Path, steps: int, fates: Mapping[str, Fate], tick: float | None = None
) -> Ran:
    """Run nodes and plant in real time (``tick``) or in lockstep, as ``run_network`` runs their processes."""
    problem = taciturn.load(problem) if isinstance(problem, str) else problem
    policy = problem.design()
    loop, wire = problem.close(policy), Wire(policy, problem.network)
    names = [step.link for step in policy.steps if isinstance(step, Send)]
    links = {link: EmulatedLink(fates.get(link, Fate())) for link in names}
    paths = {(sender_of(policy, link), receiver_of(policy, link)): link for link in names}
    now = VirtualTime()

    def carry(sender: Address, to: Address, datagram: bytes) -> list[tuple[float, bytes]]:
        link = links.get(paths.get((sender[0], to[0]), ""))
        if link is None:
            return [(LATENCY, datagram)]
        out = [(LATENCY, one) for one in link.take(datagram, now.now)]
        while (due := link.due) is not None:
            out += [(LATENCY + due - now.now, one) for one in link.release(due)]
        return out

    network = VirtualNetwork(now, carry)
    clock = VirtualClock(now)
    drawn = {} if tick is not None else drawn_delays(problem.network, policy, fates)
    record = Record(folder / "record", loop, wire, tick, {link: one.fate.lost for link, one in links.items()}, drawn)
    plant_port = VirtualPort(network, ("plant", 0))
    measuring = {link: (ends.measures, 0) for link, ends in wire.plant.items() if ends.measures is not None}
    plant = PlantServer(
        [record.watch(SimulatedPlant(loop, 1), clock)], wire, plant_port, measuring, tick=tick, clock=clock, epoch=1
    )
    processes = SimpleNamespace(
        folder=folder, roles=roles(policy), links=names,
        sender=lambda link: sender_of(policy, link), receiver=lambda link: receiver_of(policy, link),
    )  # fmt: skip
    logs = Logs(cast("Any", processes), plant.begins, tick, record)
    servers = dict[str, NodeServer]()
    with ExitStack() as stack:
        for role in roles(policy):
            told = stack.enter_context(logged(str(folder / f"{role}.jsonl"), 4000))
            port, node = VirtualPort(network, (role, 0)), Node(policy, role, network=problem.network)
            servers[role] = NodeServer(
                [node], wire, port, peer={link: (peer, 0) for link, peer in peers_of(policy, role).items()},
                plant=("plant", 0) if node.measures or node.actuates else None, tick=tick,
                wait=usual_wait(policy, role), told=told, clock=clock,
            )  # fmt: skip
            VirtualProcess(port, clock, servers[role].turns(lambda: False))
        with logs.followed():
            VirtualProcess(plant_port, clock, plant.turns(steps, lambda: False))
            while len(plant.costs[0]) < steps:
                now.run(now.now + 0.01)
            now.run(now.now + 10 * (tick or 0.0))
    assert record.finish({}) == ()
    record.close()
    packets, signals = (
        (folder / "record" / name).read_text(encoding="utf-8").splitlines() for name in ("packets.csv", "signals.csv")
    )
    return Ran(logs, plant, servers, links, [one.split(",") for one in packets], [one.split(",") for one in signals])
