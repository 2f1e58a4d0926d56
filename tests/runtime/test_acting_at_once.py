"""Real time with random delays: an actuator acts when a packet arrives, and the run is that of the law, bit for bit."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from counts import few
from runtime.late import WITHIN, pendulum
from runtime.loops import by_hand
from runtime.test_late_packets import loops
from runtime.virtual import run_virtually

import taciturn
from taciturn import Nodes, ProblemError
from taciturn.loop import Loop
from taciturn.model.delay import delay_from
from taciturn.model.network import Network
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn_udp.late import Counted
from taciturn_udp.relay import losses
from taciturn_udp.run import late_acknowledgements
from taciturn_worlds.world import World, run_world_with_devices

STEPS, PERIOD = 200, 0.02
# whose controller waits for sensors that may be silent, so that it sends at various times within a step
WAITING = {"one of two actuators", "one random and one constant delay", "two actuators that predict"}


def law_of(loop: Loop, seed: int) -> list[float]:
    """Return the costs of the steps of a loop whose packets are delayed by the draws of running links."""
    fates = losses(loop.network, seed, None, loop.policy.tick, 1.0)
    plant, nodes, costs, sent = SimulatedPlant(loop, seed), Nodes(loop, seed=seed), list[float](), dict[str, int]()
    for k in range(STEPS):
        waits = {link: fates[link].late_by(sent.get(link, 0), k) for link in nodes.links}
        # a link without random delays delivers at once: worlds leave losses to their faults
        told = {link: False if wait is None else wait if fates[link].late else True for link, wait in waits.items()}
        u = nodes.step(list(plant.measurement), fates=told)
        sent |= {link: sent.get(link, 0) + went for link, went in nodes.sent.items()}
        costs.append(plant.move(u.ravel().tolist()))
    return costs


@pytest.mark.parametrize("name", few(sorted(loops().keys() - WAITING), 6))
def test_a_world_without_faults_is_the_loop_of_all_nodes_with_the_same_delays(name: str) -> None:
    """Of inputs and outputs, within periods and in whole steps; the first packet must not be one that is delayed."""
    loop = loops()[name]()
    for seed in range(50):
        first = losses(loop.network, seed, None, loop.policy.tick, 1.0)
        if all(fate.late is None or fate.late_by(0, 0) == fate.late.delays[0] for fate in first.values()):
            break
    world = World(loop, seed, (), {}, keyed=False)
    assert world.run_for(STEPS + 1) is None
    assert world.plant.costs[0][:STEPS] == law_of(loop, seed)


@pytest.mark.parametrize("law", [[0.7, 0.2, 0.1], WITHIN], ids=["whole steps", "within periods"])
def test_servers_in_real_time_have_the_bits_of_virtual_time(law: Any, tmp_path: Path) -> None:
    """And the record has the delay of each packet in seconds, with the time that a datagram takes."""
    problem = pendulum({"delta": 0.05}, delay=law)
    tick = problem.design().tick
    fates = losses(problem.network, 1, period=tick, tick=PERIOD)
    ran = run_virtually(problem, tmp_path, STEPS, fates, tick=PERIOD)
    assert np.array(ran.plant.costs[0]).tobytes() == by_hand(problem, STEPS, 1).tobytes()
    assert fates["actuator"].late is not None
    found = {float(row[4]) for row in ran.packets[1:] if row[3] in ("delivered", "late")}
    near = {min(fates["actuator"].late.delays, key=lambda one: abs(one - delay)) for delay in found}
    assert all(min(abs(one - delay) for one in near) < 5e-4 for delay in found)
    assert len(near) > 1
    assert ran.nodes["controller"].report()["degraded"].keys() <= {"missing"}  # after the plant has ended


@pytest.mark.parametrize("tick", [None, PERIOD], ids=["virtual time", "real time"])
def test_the_delays_of_a_record_are_those_of_the_law(tick: float | None, tmp_path: Path) -> None:
    """As ``taciturn delays`` evaluates them: in virtual time exactly those drawn, also within periods."""
    problem = pendulum({"kind": "periodic", "delta": None, "every": 1}, delay=WITHIN, loss=None, acknowledged=None)
    fates = losses(problem.network, 1, period=problem.design().tick, tick=tick)
    rows = run_virtually(problem, tmp_path, STEPS, fates, tick).packets[1:]
    timed = losses(problem.network, 1, period=problem.design().tick, tick=PERIOD)["actuator"]
    drawn = {k: wait for k in range(STEPS - 5) if (wait := timed.late_by(k, k)) is not None}
    found = {int(row[1]): float(row[4]) for row in rows if row[3] in ("delivered", "late") and int(row[1]) < STEPS - 5}
    assert found == pytest.approx(drawn, abs=1e-9 if tick is None else 5e-4)
    assert sorted(set(drawn.values())) == pytest.approx(WITHIN["seconds"])
    measured = taciturn.read_delays(tmp_path / "record" / "packets.csv").delay
    assert np.isin(list(found.values()), measured).all()


def test_a_node_acts_with_the_packets_that_have_arrived_and_ends_the_step_with_all() -> None:
    """Its acknowledgement is sent once, when the packet acts; the step has the same input and no acknowledgement."""
    problem = pendulum(delay=WITHIN)
    node, data = (
        Node(problem.design(), "actuator", network=problem.network),
        Packet("data", "actuator", 0, 0, (1.0,)),
    )
    assert node.so_far(0).input == (0.0,) * 4
    node.sort_in(data._replace(late=1))
    packets, given = node.so_far(0)
    assert [(one.kind, one.tick, one.values) for one in packets] == [("acknowledgement", 0, (1.0,))]
    assert given == (0.0, 1.0, 1.0, 1.0)
    assert node.so_far(0) == ((), given)
    assert node.step(0) == ((), given)
    assert node.so_far(1) == ((), (1.0,) * 4)


def test_measured_delays_count_in_the_nearest_piece() -> None:
    """Of a period at an actuator; a node that works once per step counts the nearest delay of the law, rounded up."""
    network = pendulum(delay=WITHIN).network
    counted = Counted(network, ["actuator"], PERIOD, PERIOD)
    cuts = (0.0, 0.2, 0.35, 0.65)
    for late in np.linspace(0.0, 3.0, 301).tolist():
        code = counted.pieces("actuator", late * PERIOD)
        nearest = min((abs(late - k - cut), 4 * k + i) for k in range(5) for i, cut in enumerate(cuts))
        assert abs(abs(late - code // 4 - cuts[code % 4]) - nearest[0]) < 1e-9
    assert (counted.least, counted.spread) == pytest.approx((0.004, 0.043))
    sensed = Network().changed({"sensor": {"delay": delay_from("delay", WITHIN)}})
    counted = Counted(sensed, ["sensor"], PERIOD, PERIOD)
    assert [counted.pieces("sensor", late * PERIOD) for late in (0.0, 0.4, 0.9, 1.6, 1.7, 9.0)] == [1, 1, 1, 1, 3, 3]


def test_acknowledgements_that_come_too_late_withdraw_the_claim() -> None:
    """The sender counts them, and the run names them."""
    problem = pendulum()
    controller = Node(problem.design(), "controller", network=problem.network)
    for k in range(8):
        controller.step(k, [0.3, 0.3][: controller.measured])
    controller.sort_in(Packet("acknowledgement", "actuator", 0, 0, (0.0,)))
    assert controller.reasons == {"late acknowledgement": 1}
    reports = {"controller": {"degraded": dict(controller.reasons)}, "plant": {}}
    assert late_acknowledgements(reports) == ("1 acknowledgement came to the controller after its next step had begun",)


def test_a_node_that_does_more_than_apply_packets_is_refused() -> None:
    """It cannot say at the arrival of a packet what its step will do."""
    problem = pendulum()
    with pytest.raises(ProblemError, match="the controller of this excess policy does more than to apply packets"):
        Node(problem.design(), "controller", network=problem.network).so_far(0)


@pytest.mark.parametrize("seed", few(range(60), quick=1))
@pytest.mark.parametrize("told", [True, False], ids=["acknowledged", "not acknowledged"])
def test_no_invariant_breaks_in_worlds_with_random_delays(seed: int, told: bool) -> None:
    """Under the faults of a seed, nodes on the host and in C recover, and the newest packets are used."""
    found = run_world_with_devices(pendulum({"delta": 0.05}, delay=WITHIN, loss=None, acknowledged=told), seed)
    assert found.broken is None, f"world {seed}: {found.broken}"


def test_several_inputs_of_a_step_reach_the_plant_in_order() -> None:
    """The plant takes the last one of a step, and each has a number of its own."""
    loop = pendulum({"delta": 0.05}, delay=WITHIN).close(pendulum({"delta": 0.05}, delay=WITHIN).design())
    world, seen = World(loop, 1, (), {}, keyed=False), list[Packet]()
    sort = world.plant._sort
    world.plant._sort = lambda packet: (seen.append(packet), sort(packet))[1]  # type: ignore[method-assign]
    assert world.run_for(60) is None
    assert [packet.sequence for packet in seen] == list(range(1, len(seen) + 1))
    again = [(a, b) for a, b in pairwise(seen) if a.tick == b.tick]
    assert again
    assert all(a.values[0] == b.values[0] or a.values[-1] != b.values[-1] for a, b in again)
    assert world.plant.refused == {}
