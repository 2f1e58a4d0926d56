"""Nodes in C over links that delay packets at random: the self-check, and states with packets that are told later."""

from __future__ import annotations

import subprocess
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from counts import few
from export.devices import STRICT, Device, compile_node, needs_compiler
from runtime.late import pendulum

import taciturn
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet, Wire
from taciturn.problem import Problem
from taciturn_export.folder import print_folder, record_loop
from taciturn_export.node import waiting_for

LAWS: dict[str, tuple[int, Problem]] = {
    "0 to 2 steps": (5000, pendulum()),
    "0 to 4 steps, some never": (5000, pendulum({"delta": 0.05}, delay=[0.5, 0.1, 0.1, 0.1, 0.15])),
    "rounded": (3000, pendulum({"delta": 0.05}, payload="float32")),
    "not acknowledged": (3000, pendulum(acknowledged=False)),
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
    "plan": (3000, pendulum({"delta": 0.05, "plan": 3}, acknowledged=False, delay=[0.3, 0.2, 0.2, 0.2])),
}


@pytest.mark.parametrize("name", few([*LAWS], 7))
def test_the_self_check_compares_every_bit_of_a_run_with_delays(name: str, tmp_path: Path) -> None:
    """Nodes that exchange datagrams, which the exchange holds for the delays of the recorded loop."""
    rows, problem = LAWS[name]
    found = print_folder(problem.close(problem.design()), "pendulum", rows=rows)
    delays = {int(one) - 1 for one in np.unique(found.vector.arrived)}
    assert delays == set(range(-1, len(next(law.delay for law in problem.network.links.values() if law.delay).waits)))  # type: ignore[union-attr]
    found.write(tmp_path)
    sources = [str(path) for path in tmp_path.glob("*.c")]
    command = [needs_compiler(), *STRICT, "-O1", f"-I{tmp_path}", "-o", str(tmp_path / "check"), *sources, "-lm"]
    subprocess.run(command, check=True)
    done = subprocess.run([str(tmp_path / "check")], capture_output=True, text=True, check=False)
    assert f"{rows} steps compared, every decision and every bit of the input agrees" in done.stdout


def test_a_delay_of_another_number_of_steps_is_found(tmp_path: Path) -> None:
    """The self-check fails if one packet of its recording comes a step later."""
    problem = pendulum()
    loop = problem.close(problem.design())
    vector = record_loop(loop, 200)
    first = int(np.flatnonzero(vector.arrived == 1.0)[3])
    vector.arrived[first] = 2.0
    with patch("taciturn_export.folder.record_loop", lambda *_: vector):
        print_folder(loop, "pendulum", rows=200).write(tmp_path)
    sources = [str(path) for path in tmp_path.glob("*.c")]
    command = [needs_compiler(), *STRICT, "-O1", f"-I{tmp_path}", "-o", str(tmp_path / "check"), *sources, "-lm"]
    subprocess.run(command, check=True)
    done = subprocess.run([str(tmp_path / "check")], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert f"step {first}: the input of the plant is" in done.stdout


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


def test_the_buffer_of_a_node_holds_the_packets_of_the_longest_delay() -> None:
    """A power of two, so that no two packets that arrive in one step have the same place."""
    for longest, places in {1: 4, 2: 4, 3: 8, 6: 8, 7: 16, 20: 32}.items():
        law = [0.5, *[0.0] * (longest - 1), 0.5]
        assert waiting_for(pendulum(delay=law).network, 0.02, 4) == places
    assert waiting_for(taciturn.load("two-mass-lqg").network, 0.1, 4) == 4
