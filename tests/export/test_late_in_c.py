"""Nodes in C over links that delay packets at random: the self-check, and states with packets that are told later."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import cast
from unittest.mock import patch

import numpy as np
import pytest
from counts import few
from export.devices import STRICT, Device, compile_node, needs_compiler
from runtime.late import STATES, WITHIN, late_sensor, pendulum, sets, told_late
from runtime.test_late_packets import DEAD_BANDS

import taciturn
from taciturn.loop import Loop
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet, Wire
from taciturn.problem import Problem
from taciturn_export.folder import print_folder, record_loop
from taciturn_export.node import waiting_for
from taciturn_udp.relay import losses

LAWS: dict[str, tuple[int, Problem]] = {
    "0 to 2 steps": (5000, pendulum()),
    "0 to 4 steps, some never": (5000, pendulum({"delta": 0.05}, delay=[0.5, 0.1, 0.1, 0.1, 0.15])),
    "rounded": (3000, pendulum({"delta": 0.05}, payload="float32")),
    "not acknowledged": (3000, pendulum(acknowledged=False)),
    "sets of actuators": (3000, sets()),
    "sets, told late": (3000, told_late()),
    "predicted": (3000, pendulum({"delta": 0.05, "actuation": "model"}, acknowledged=False)),
    "predicted by a controller": (
        3000,
        taciturn.load("inverted-pendulum").changed(
            {
                "kind": "excess",
                "link": "sensor",
                "actuation": "model",
                "theta": 0.3,
                "network.sensor_delay": [0.3, 0.1, 0.5],
                "network.protocol": "udp",
            }
        ),
    ),
    "contributions of sensors": (
        1000,
        taciturn.load("quadruple-tank").changed(
            {"links.level-1.delay": [0.4, 0.2, 0.1, 0.2], "links.level-2.delay": [0.3, 0.6]}
        ),
    ),
    "late states": (2000, late_sensor(**STATES)),
    "fused": (2000, late_sensor()),
    "fused, rounded": (2000, late_sensor(**{"network.payload": "float32"})),
    "plan": (3000, pendulum({"delta": 0.05, "plan": 3}, acknowledged=False, delay=[0.3, 0.2, 0.2, 0.2])),
    "up to 63 steps": (1000, pendulum(delay=[0.9, *[0.0] * 62, 0.1], acknowledged=False)),
    "within periods": (3000, pendulum({"delta": 0.05}, delay=WITHIN)),
    "plan, within periods": (2000, pendulum({"delta": 0.05, "plan": 1}, acknowledged=False, delay=WITHIN)),
    "within periods, rounded": (2000, pendulum({"delta": 0.05}, delay=WITHIN, payload="float32")),
}


@pytest.mark.parametrize("name", few([*LAWS], 2))
def test_the_self_check_compares_every_bit_of_a_run_with_delays(name: str, tmp_path: Path) -> None:
    """Nodes that exchange datagrams, which the exchange holds for the delays of the recorded loop."""
    rows, problem = LAWS[name]
    found = print_folder(problem.close(problem.design()), "pendulum", rows=rows)
    told = losses(problem.network, 0, period=problem.design().tick).values()
    laws = [one.late for one in told if one.late is not None]
    assert {int(one) - 1 for one in np.unique(found.vector.arrived)} == {-1, *(d for law in laws for d in law.delays)}
    found.write(tmp_path)
    sources = [str(path) for path in tmp_path.glob("*.c")]
    command = [needs_compiler(), *STRICT, "-O1", f"-I{tmp_path}", "-o", str(tmp_path / "check"), *sources, "-lm"]
    subprocess.run(command, check=True)
    done = subprocess.run([str(tmp_path / "check")], capture_output=True, text=True, check=False)
    assert f"{rows} steps compared, every decision and every bit of the input agrees" in done.stdout


@pytest.mark.evidence
def test_a_delay_of_another_number_of_steps_is_found(tmp_path: Path) -> None:
    """The self-check fails if one packet of its recording comes a step later."""
    problem = pendulum()
    loop = problem.close(problem.design())
    vector = record_loop(loop, 200)
    first = int(np.flatnonzero(vector.arrived == 1.0)[3])
    vector.arrived[first] = 2.0  # in pieces of a period, of which there is one
    with patch("taciturn_export.folder.record_loop", lambda *_: vector):
        print_folder(loop, "pendulum", rows=200).write(tmp_path)
    sources = [str(path) for path in tmp_path.glob("*.c")]
    command = [needs_compiler(), *STRICT, "-O1", f"-I{tmp_path}", "-o", str(tmp_path / "check"), *sources, "-lm"]
    subprocess.run(command, check=True)
    done = subprocess.run([str(tmp_path / "check")], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert f"step {first}: the input of the plant is" in done.stdout


@pytest.mark.evidence
def test_a_saved_state_has_the_packets_that_are_to_be_acknowledged(tmp_path: Path) -> None:
    """Of one step that has heard two packets: the acknowledgements of the node that goes on are those of the host."""
    problem = pendulum()
    policy, network = problem.design(), problem.network
    library, wire = compile_node(policy, "actuator", network, tmp_path), Wire(policy, network)
    host, device, other = Node(policy, "actuator", network=network), Device(library), Device(library)
    data = [Packet("data", "actuator", k, k, (float(k),)) for k in range(2)]
    for node in (host, device):
        node.step(0)
    for packet in data:
        device.receive(wire.encode(packet))
    device.step(1)
    told = host.step(1, packets=data).packets
    assert other.restore(device.save())
    assert device.save() == other.save()
    sent = [wire.decode(datagram) for datagram in other.send()]
    assert sorted((one.tick, *one.values) for one in sent if isinstance(one, Packet)) == [(0, 1.0), (1, 0.0)]
    assert len(told) == 2
    assert other.input == host.step(1).input == (1.0,)


def several() -> Loop:
    """Return a loop of two sensors and two actuators, of which one hears packets within periods."""
    problem, random = (
        taciturn.load("quadruple-tank").changed(DEAD_BANDS),
        {"seconds": [0.3, 2.5], "probability": [0.5, 0.4]},
    )
    laws = {"level-1": {"delay": [0.5, 0.5]}, "pump-1": {"delay": random}, "pump-2": {"loss": 0.1}}
    return taciturn.close(problem.plant, problem.design(), problem.network.changed(laws))


@pytest.mark.evidence
def test_the_self_check_compares_several_nodes_of_which_one_acts_within_periods(tmp_path: Path) -> None:
    """The inputs of an actuator without random delays are compared once per step, and those of the other per piece."""
    found = print_folder(several(), "tanks", rows=1000)
    assert len(found.vector.order[1]) == 3 + 1  # pieces of one, and one
    found.write(tmp_path)
    sources = [str(path) for path in tmp_path.glob("*.c")]
    command = [needs_compiler(), *STRICT, "-O1", f"-I{tmp_path}", "-o", str(tmp_path / "check"), *sources, "-lm"]
    subprocess.run(command, check=True)
    done = subprocess.run([str(tmp_path / "check")], capture_output=True, text=True, check=False)
    assert "1000 steps compared, every decision and every bit of the input agrees" in done.stdout, done.stdout


@pytest.mark.parametrize("kept", [0, 60], ids=["one node", "another node goes on"])
def test_an_actuator_in_c_acts_when_packets_arrive_as_one_in_python_does(kept: int, tmp_path: Path) -> None:
    """Bits of the inputs after each packet, acknowledgements, and the ends of steps, for random delays and losses."""
    problem = pendulum({"delta": 0.05}, delay=WITHIN)
    policy, network = problem.design(), problem.network
    library, wire = compile_node(policy, "actuator", network, tmp_path), Wire(policy, network)
    m = Node(policy, "actuator", network=network).pieces
    host, device, draws = Node(policy, "actuator", network=network), Device(library), np.random.default_rng(5)

    def applied() -> tuple[float, ...]:
        return tuple((library.number * m).from_address(device.code.tac_input(device.node)))

    def told(packets: Iterable[Packet]) -> list[tuple[int, tuple[float, ...]]]:
        return sorted((one.tick, one.values) for one in packets if one.kind == "acknowledgement")

    flying, changes = dict[int, list[tuple[int, Packet]]](), 0
    for k in range(150):
        if kept and k == kept:
            state, saved = device.save(), host.save()
            device, host = Device(library), Node(policy, "actuator", network=network)
            assert device.restore(state)
            host.restore(saved)
        if draws.random() < 0.6:
            late = int(draws.integers(0, 3 * m))
            packet = Packet("data", "actuator", k, k, (float(draws.standard_normal()),), late=late)
            flying.setdefault(k + late // m, []).append((late % m, packet))
        assert device.act()
        assert host.so_far(k).input == applied()
        for piece, packet in sorted(flying.pop(k, [])):
            device.receive(wire.encode(packet), piece)
            host.sort_in(packet)
            before = applied()
            assert device.act()
            packets, given = host.so_far(k)
            assert given == applied()
            assert told(packets) == told(cast("list[Packet]", [wire.decode(one) for one in device.send()]))
            changes += before != given
        packets, given = host.step(k)
        assert device.step(k)
        assert packets == ()
        assert device.send() == []
        assert given == applied()
    assert changes > 40
    assert device.counters["used"] == host.counters["used"]
    assert device.counters["superseded"] == host.counters["superseded"]


def test_a_node_in_c_that_does_more_than_apply_packets_acts_only_when_a_step_begins(tmp_path: Path) -> None:
    """A controller, as in Python."""
    problem = pendulum()
    device = Device(compile_node(problem.design(), "controller", problem.network, tmp_path))
    assert not device.act()


def test_the_header_states_the_pieces_of_a_step(tmp_path: Path) -> None:
    """And the parts of a period at which they begin; a node that acts once per step has no such constants."""
    problem = pendulum(delay=WITHIN)
    found = print_folder(problem.close(problem.design()), "pendulum", rows=10).files
    assert "#define PENDULUM_ACTUATOR_PIECES 4u" in found["pendulum_actuator.h"]
    cuts = re.findall(r"PENDULUM_ACTUATOR_CUTS \{(.*)\}", found["pendulum_actuator.h"])[0]
    assert [float(one) for one in cuts.split(", ")] == pytest.approx([0.0, 0.2, 0.35, 0.65])
    assert "PIECES" not in found["pendulum_controller.h"]


def test_the_buffer_of_a_node_holds_the_packets_of_the_longest_delay() -> None:
    """A power of two, so that no two packets that arrive in one step have the same place."""
    for longest, places in {1: 4, 2: 4, 3: 8, 6: 8, 7: 16, 20: 32}.items():
        law = [0.5, *[0.0] * (longest - 1), 0.5]
        assert waiting_for(pendulum(delay=law).network, 0.02, 4) == places
    assert waiting_for(taciturn.load("two-mass-lqg").network, 0.1, 4) == 4
