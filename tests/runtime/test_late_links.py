"""Links in virtual time that delay packets at random: their law, and runs of processes with the bits of nodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from counts import few
from runtime.attacks import KEY
from runtime.late import ACTUATOR, STATES, WITHIN, late_sensor, pendulum
from runtime.loops import by_hand

import taciturn
from taciturn import Nodes, ProblemError
from taciturn.model.delay import delay_from
from taciturn.model.network import Network
from taciturn.model.wire import HEADER_SIZE
from taciturn.nodes.description import describe_wire
from taciturn.nodes.packet import Packet, Wire
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn.problem import Problem
from taciturn_udp.late import STAMP_SIZE, Lateness, read_lateness, stamped, unstamped
from taciturn_udp.relay import EmulatedLink, Fate, losses
from taciturn_udp.run import run_network

TICKS = 300
BURST = {"to_bad": 0.1, "to_good": 0.3, "loss_good": 0.0, "loss_bad": 0.4}


def cases() -> dict[str, Problem]:
    """Return problems whose links differ in the form of their law."""
    states = {"states": [{"seconds": [0.0, 0.013], "probability": [0.7, 0.3]}, {"seconds": 0.031}]}
    return {
        "steps": pendulum(),
        "within periods": pendulum({"delta": 0.05}, delay=WITHIN),
        "predicted": pendulum({"delta": 0.05, "actuation": "model"}, acknowledged=False),
        "predicted within periods": pendulum({"delta": 0.05, "actuation": "model"}, delay=WITHIN, acknowledged=False),
        "plan": pendulum({"delta": 0.05, "plan": 3}, delay=[0.4, 0.2, 0.3], acknowledged=False),
        "bursts": pendulum({"delta": 0.05}, delay=states, loss=None, burst=BURST, acknowledged=False),
    }


@pytest.mark.parametrize("name", few(cases(), 3))
def test_nodes_in_memory_have_the_bits_of_all_nodes_with_the_delays_of_the_links(name: str) -> None:
    """Of the loop of plant, nodes and emulated links; so the run is that of the simulation with these numbers."""
    problem = cases()[name]
    loop, fate = problem.close(problem.design()), losses(problem.network, 2, period=problem.design().tick)["actuator"]
    assert fate.late is not None
    plant, nodes, costs, sent = SimulatedPlant(loop, 2), Nodes(loop, seed=99), list[float](), 0
    per_step = fate.late.pieces
    for k in range(TICKS):
        late = None if fate.lost(sent, k) else fate.late_by(sent, k)
        wait = late is not None and late // per_step + (0.0, *nodes.cuts[1:])[late % per_step]
        u = nodes.step(list(plant.measurement), fates={"actuator": wait})
        sent += nodes.sent["actuator"]
        costs.append(plant.move(u.ravel().tolist()))
    assert by_hand(problem, TICKS, 2).tobytes() == np.array(costs).tobytes()
    assert sent > 20


@pytest.mark.evidence
@pytest.mark.parametrize("name", cases())
def test_processes_have_the_bits_of_nodes_in_memory(name: str) -> None:
    """With keys; every datagram is accounted for, and no packet comes after the step that it is for."""
    problem = cases()[name]
    found = run_network(problem, steps=TICKS, seed=2, key=KEY)
    assert found.costs.tobytes() == by_hand(problem, TICKS, 2).tobytes()
    counted, actuator = found.datagrams["actuator"], found.reports["actuator"]["counters"]
    assert counted["delivered"] + counted["lost"] + counted.get("pending", 0) == counted["sent"] + counted.get(
        "again", 0
    )
    assert actuator.get("late", 0) == 0 < actuator["used"]
    assert found.reports["actuator"]["degraded"] == found.reports["controller"]["degraded"] == {}


@pytest.mark.evidence
@pytest.mark.parametrize("changes", [{}, STATES], ids=["fused", "states"])
def test_processes_fuse_late_measurements_with_the_bits_of_nodes_in_memory(changes: dict[str, Any]) -> None:
    """All packets that arrive are used, also those that newer ones have overtaken; of a measured state, the newest."""
    problem = late_sensor(**changes)
    found = run_network(problem, steps=TICKS // 2, seed=2, key=KEY)
    assert found.costs.tobytes() == by_hand(problem, TICKS // 2, 2).tobytes()
    counted = found.reports["controller"]["counters"]
    assert counted.get("late", 0) == 0 < counted["used"]
    assert (counted.get("superseded", 0) > 0) == bool(changes)
    assert found.reports["controller"]["degraded"] == {}


@pytest.mark.parametrize("law", [[0.5, 0.3], WITHIN, {"states": [[0.5, 0.5], [0.0, 0.2, 0.6]]}])
def test_links_draw_the_delays_of_the_law(law: Any) -> None:
    """The share of each delay and of lost packets, within four standard errors."""
    burst = {"burst": taciturn.Burst(0.2, 0.2, 0.0, 0.0)} if isinstance(law, dict) and "states" in law else {}
    network, count = Network().changed({"actuator": {"delay": delay_from("delay", law), **burst}}), 20_000
    fate = losses(network, 5, period=0.02)["actuator"]
    assert fate.late is not None
    assert read_lateness("--late", fate.late.text()) == fate.late
    found = [fate.late_by(k, k) for k in range(count)]
    mean = np.array(fate.late.odds).mean(axis=0)
    for delay, chance in zip((*fate.late.delays, None), (*mean, 1 - mean.sum()), strict=True):
        assert abs(found.count(delay) / count - chance) <= 4 * np.sqrt(chance * (1 - chance) / count) * (
            3 if burst else 1
        )


def test_links_replay_pieces_of_a_trace() -> None:
    """Each packet but those at the beginning of a piece follows the one before it in the trace."""
    law = Lateness((0, 1, 2, 3, 4, 5, 6), ((1 / 7,) * 7,), sequence=tuple(range(8)), block=20.0)
    fate = Fate(seed=3, late=law)
    found = [fate.late_by(0, k) for k in range(10_000)]
    assert found == [fate.late_by(9, k) for k in range(10_000)]
    found = [7 if late is None else late for late in found]
    begun = sum(after != (before + 1) % 8 for before, after in pairwise(found)) / len(found)
    assert abs(begun - 7 / 8 / 20) < 4 * np.sqrt(1 / 20 / len(found))


def test_a_link_holds_a_packet_until_the_mark_of_the_step_in_which_it_arrives() -> None:
    """Behind a stamp with its delay; a packet of a wire never looks like a stamp."""
    problem = pendulum()
    wire = Wire(problem.design(), problem.network)
    link = EmulatedLink(Fate(late=Lateness((3,), ((1.0,),), pieces=2)))
    data, marks = wire.encode(Packet("data", "actuator", 4, 0, (1.0,))), [
        wire.encode(Packet("mark", "actuator", k, k)) for k in (4, 5)
    ]  # fmt: skip
    assert link.take(data, 0.0) == []
    assert link.take(marks[0], 0.0) == [marks[0]]
    assert link.pending == 1
    assert link.take(marks[1], 0.0) == [stamped(data, 3), marks[1]]
    assert unstamped(stamped(data, 3)) == (data, 3)
    assert len(stamped(data, 3)) == len(data) + STAMP_SIZE
    first = wire.encode(Packet("data", "actuator", 4, int.from_bytes(b"late", "big"), (1.0,)))
    assert unstamped(first) == (first, 0)
    assert unstamped(b"late") == (b"late", 0)
    assert HEADER_SIZE > STAMP_SIZE


@pytest.mark.parametrize(
    "text", ["", "{}", "3", '{"delays": [0], "odds": [[0.5, 0.5]]}', '{"delays": [-1], "odds": [[1]]}']
)
def test_laws_of_links_are_checked(text: str) -> None:
    """The text of the option."""
    with pytest.raises(ProblemError, match="--late is"):
        read_lateness("--late", text)


def test_what_does_not_carry_out_random_delays_refuses_them(tmp_path: Path) -> None:
    """By name: network namespaces, descriptions, and C with delays beyond its buffer."""
    problem = pendulum()
    policy = problem.design()
    with pytest.raises(ProblemError, match=r"a delay that varies on a link .* which only relays emulate"):
        run_network(problem, steps=2, namespaces=True)
    with pytest.raises(ProblemError, match="a delay that varies on a link"):
        describe_wire(policy, problem.network)
    late = pendulum({"kind": "periodic", "delta": None, "every": 1}, delay=[0.5] + [0.0] * 70 + [0.5])
    with pytest.raises(ProblemError, match="delays are up to 71 steps, which exported C code does not carry out"):
        taciturn.export_c(late, tmp_path / "c")


def test_traces_that_are_too_long_for_an_argument_are_refused() -> None:
    """Of running links; simulations replay them."""
    law = replace(delay_from("delay", [0.5, 0.5]), sequence=(0, 1) * 15_000)
    network: Network = Network().changed({"actuator": {**_without(ACTUATOR, "delay"), "delay": law}})
    with pytest.raises(ProblemError, match="trace of 30000 packets"):
        losses(network, 0, period=0.02)


def _without(given: Mapping[str, Any], key: str) -> dict[str, Any]:
    return {name: value for name, value in given.items() if name != key}
