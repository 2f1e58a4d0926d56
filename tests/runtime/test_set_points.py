"""Set-points that a controller is given while it runs: over UDP as packets, in C, and in a loop of one's own."""

from __future__ import annotations

from pathlib import Path

import control
import numpy as np
import pytest
from counts import few

from taciturn import Cost, Network, Nodes, Plant, Policy, Problem, ProblemError, close, design, run_network, to_control
from taciturn.model.disturbance import follow
from taciturn.model.packets import plant_links
from taciturn.model.signals import ExternalDisturbance, RandomSteps
from taciturn.model.wire import SETPOINT
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet, Wire
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn_export.export import export_c
from taciturn_worlds.devices import DeviceCode, DeviceNode

A, B = [[0.9, 0.2], [0.0, 0.8]], [[0.1, 0.0], [0.0, 0.5]]
COST = Cost(np.eye(2), 0.1 * np.eye(2))
FIRST = (1.0, -2.0)


def plant() -> Plant:
    """Return a plant whose two outputs follow set-points with steps at random times, in spite of a disturbance."""
    found = Plant(A, B, 0.02 * np.eye(2), np.eye(2), 0.05 * np.eye(2))
    push = ExternalDisturbance([0.0, 0.3], wander=1e-3)
    return follow(found, None, FIRST, [push], RandomSteps(0.1, [[1.0, 0.2], [0.2, 2.0]]))


def excess() -> Policy:
    """Return a policy of one controller and one actuator."""
    return design.excess(plant(), COST, delta=0.05)


def point(tick: int, sequence: int, *values: float) -> Packet:
    """Return a packet with set-points."""
    return Packet("measurement", SETPOINT, tick, sequence, values, 1)


def test_nodes_and_loop_agree_in_every_bit() -> None:
    """Separate nodes, which get the set-points as packets, and all nodes in one process."""
    policy = excess()
    assert plant_links(policy)[SETPOINT].outputs == (2, 3)
    simulated, nodes = SimulatedPlant(close(plant(), policy), 3), Nodes(policy)
    controller, actuator = Node(policy, "controller"), Node(policy, "actuator")
    changes = 0
    for tick in range(200):
        y, r = simulated.measurement[:2], simulated.measurement[2:]
        changes += tick > 0 and r != tuple(nodes.reference)
        packets = controller.step(tick, y, [point(tick, tick, *r)]).packets
        given = actuator.step(tick, packets=packets).input
        assert given is not None
        assert given == tuple(nodes.step(y, reference=r))
        simulated.move(given)
    assert changes > 5


def test_set_points_remain_until_others_arrive() -> None:
    """A packet for a later step waits, a late one takes effect in the next step, and an older one has no effect."""
    controller, nodes = Node(excess(), "controller"), Nodes(excess())
    sent = {2: point(2, 0, 5.0, 5.0), 3: point(6, 1, 7.0, 7.0), 8: point(5, 2, 9.0, 9.0), 9: point(7, 3, 8.0, 8.0)}
    effect = {0: FIRST, 2: (5.0, 5.0), 6: (7.0, 7.0), 9: (8.0, 8.0)}
    for tick in range(12):
        nodes.step([0.1, 0.2], reference=effect.get(tick))
        controller.step(tick, [0.1, 0.2], [sent[tick]] if tick in sent else [])
        expected = effect[max(step for step in effect if step <= tick)]
        assert controller.memory["prior"][-2:] == pytest.approx(expected)
        assert nodes.reference == list(expected)
    assert controller.reasons["late"] == 0


@pytest.mark.parametrize("seed", few(range(3), 1))
def test_the_core_in_c_handles_packets_with_set_points_alike(seed: int) -> None:
    """Early, late, repeated and missing ones; every packet and every counter of the controller."""
    policy, rng = excess(), np.random.default_rng(seed)
    wire = Wire(policy)
    device = DeviceNode(
        DeviceCode(policy, "controller", policy.network), policy, "controller",
        network=policy.network, epoch=1, seed=0, watchdog=None, safe="hold",
    )  # fmt: skip
    node = Node(policy, "controller", epoch=1)
    for tick in range(150):
        for _ in range(int(rng.integers(0, 3))):
            step, sequence = tick + int(rng.integers(-3, 3)), int(rng.integers(max(0, tick - 20), tick + 2))
            packet = point(max(0, step), sequence, *rng.normal(size=2))
            node.sort_in(packet)
            device.receive(wire.encode(packet))
        y = rng.normal(size=2).tolist()
        assert node.step(tick, y).packets == device.step(tick, y).packets
    for name in ("used", "late", "duplicate", "replayed", "received"):
        assert node.counters[name] == device.counters[name]


def test_a_program_in_c_sets_the_set_points(tmp_path: Path) -> None:
    """The function is part of the exported core, and the README of the folder describes it."""
    export_c(Problem(plant(), COST, Network(), "excess", {"delta": 0.05}), tmp_path)
    assert "bool tac_setpoint(tac_node *node, const tac_real *values);" in (tmp_path / "taciturn.h").read_text()
    assert "tac_setpoint" in (tmp_path / "README.md").read_text()


@pytest.mark.evidence
@pytest.mark.parametrize("kind", ["excess", "distributed"])
def test_processes_over_udp_follow_the_same_set_points(kind: str) -> None:
    """The costs of all steps are those of nodes in one process."""
    parameters = {"delta": 0.05} if kind == "excess" else {"theta": 0.5, "prediction": "model", "actuation": "model"}
    problem = Problem(plant(), COST, Network(), kind, parameters)
    policy = problem.design()
    simulated, nodes, costs = SimulatedPlant(problem.close(policy), 4), Nodes(policy), list[float]()
    for _ in range(200):
        y = simulated.measurement
        costs.append(simulated.move(tuple(nodes.step(y[:2], reference=y[2:]))))
    assert np.array_equal(run_network(problem, steps=200, seed=4).costs, costs)


def test_set_points_are_inputs_of_a_policy_in_python_control() -> None:
    """They are outputs of a loop, and the policy in it commands the same inputs."""
    policy = excess()
    loop, alone = to_control(close(plant(), policy)), to_control(policy)
    assert alone.input_labels == ["y[0]", "y[1]", "setpoint[0]", "setpoint[1]"]
    time, rng = np.arange(30.0), np.random.default_rng(2)
    noise = np.vstack([0.1 * rng.normal(size=(7, 30)), np.zeros((2, 30))])
    found = control.input_output_response(loop, time, noise, [0.0, 0.0, 0.0, *FIRST, 0.0])
    assert loop.output_labels[:6] == [*alone.input_labels, "u[0]", "u[1]"]
    assert np.ptp(found.outputs[2:4], axis=1).min() > 0.1
    again = control.input_output_response(alone, time, found.outputs[:4], 0.0)
    np.testing.assert_array_equal(again.outputs[:2], found.outputs[4:6])


def test_constant_set_points_cannot_be_changed() -> None:
    """Because the policy does not expect it; the message names the keys."""
    constant = follow(Plant(A, B, 0.02 * np.eye(2), np.eye(2), 0.05 * np.eye(2)), None, FIRST)
    with pytest.raises(ProblemError, match="set-points of this excess policy are constant"):
        Nodes(design.excess(constant, COST, delta=0.05)).step([0.0, 0.0], reference=[1.0, 1.0])
    with pytest.raises(ProblemError, match="reference has shape"):
        Nodes(excess()).step([0.0, 0.0], reference=[1.0])
