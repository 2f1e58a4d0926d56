"""Play-out in real time: a node uses each packet the buffer of its link after it was sent, whenever it arrives."""

from __future__ import annotations

import numpy as np
import pytest
from runtime.late import pendulum

import taciturn
from taciturn import ProblemError
from taciturn.nodes.clock import Phase
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet, Wire
from taciturn_udp.nodes import NodeServer
from taciturn_worlds.virtual import VirtualClock, VirtualNetwork, VirtualPort, VirtualProcess, VirtualTime

PERIOD, STEPS = 0.02, 400
SECONDS, ODDS = [0.004, 0.013, 0.031, 0.055, 0.09], [0.3, 0.3, 0.2, 0.15, 0.05]
DELAYS = {"seconds": SECONDS, "probability": ODDS}
BUFFER = 0.06  # three periods; the largest delay is beyond it


@pytest.mark.parametrize("play_out", [True, False])
def test_inputs_change_the_buffer_after_their_packets_were_sent(play_out: bool) -> None:
    """Of packets that arrive up to two periods late, all are used, in their order; without play-out some are not."""
    problem = pendulum(delay=DELAYS, buffer={"seconds": BUFFER}, loss=None, acknowledged=False)
    policy, network = problem.design(), problem.network
    wire, time, draws = Wire(policy, network), VirtualTime(), np.random.default_rng(1)
    found = VirtualNetwork(time, lambda sender, to, datagram: [(0.0, datagram)])
    port, plant, clock = VirtualPort(found, ("actuator", 0)), VirtualPort(found, ("plant", 0)), VirtualClock(time)
    shown = dict[float, float]()  # the time at which an input reaches the plant first

    def take() -> None:
        for packet in map(wire.decode, plant.receive()):
            assert isinstance(packet, Packet)
            shown.setdefault(packet.values[0], time.now)

    plant.arrived = take
    node = Node(policy, "actuator", network=network)
    server = NodeServer([node], wire, port, plant=plant.address, tick=PERIOD, clock=clock, play_out=play_out)
    VirtualProcess(port, clock, server.turns(lambda: False))
    late = draws.choice(SECONDS, STEPS, p=ODDS)
    late[0] = SECONDS[0]
    for k in range(STEPS):
        datagram = wire.encode(Packet("data", "actuator", k, k, (1.0 + k,)))
        time.at(1.0 + k * PERIOD + late[k], lambda datagram=datagram: port.deliver(datagram, ("controller", 0)))
    time.run(1.0 + (STEPS + 10) * PERIOD)
    used = {k: shown[1.0 + k] - 1.0 - k * PERIOD for k in range(STEPS) if 1.0 + k in shown}
    if play_out:
        assert set(used) == {k for k in range(STEPS) if late[k] <= BUFFER}
        assert max(abs(one - BUFFER) for one in used.values()) < 0.02 * PERIOD  # what the clocks may drift apart
        assert node.counters["late"] == (late > BUFFER).sum() > 5
    else:
        assert len(used) < 0.9 * (late <= BUFFER).sum()
        assert np.ptp([*used.values()]) > 0.3 * PERIOD


def test_packets_within_the_spread_of_their_delays_do_not_move_the_phase() -> None:
    """Without a spread, several late packets in turn show that the phase was too early."""
    for spread, moved in ((0.0, 0.7), (1.0, 0.0)):
        phase = Phase(1.0, spread)
        phase.hear(0, 5.0)
        for k in range(1, 9):
            phase.hear(k, 5.0 + k + 0.7)
        assert abs(phase.zero - 5.0 - moved) < 0.01


def test_nodes_that_cannot_play_out_refuse_it() -> None:
    """In virtual time, with a sensor, or without a buffer."""
    problem = pendulum(delay=DELAYS, buffer={"seconds": BUFFER}, loss=None, acknowledged=False)
    other = taciturn.load("inverted-pendulum")
    for one, role, tick, why in (
        (problem, "actuator", None, "runs in virtual time"),
        (problem, "controller", PERIOD, "begins a step with its own sample"),
        (other, "actuator", PERIOD, "has no link with a buffer"),
    ):
        policy, time = one.design(), VirtualTime()
        port = VirtualPort(VirtualNetwork(time, lambda *_: []), (role, 0))
        peers = None if role == "actuator" else port.address
        with pytest.raises(ProblemError, match=why):
            NodeServer(
                [Node(policy, role, network=one.network)], Wire(policy, one.network), port, peer=peers,
                plant=port.address, tick=tick, clock=VirtualClock(time), play_out=True,
            )  # fmt: skip
