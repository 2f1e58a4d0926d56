"""Manual operation: the inputs of an operator in place of the controller's, and the return without a jump."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from catalogue import KEEPING
from counts import few
from export.devices import Device, compile_node, needs_compiler
from runtime.test_missing import PLANT, filter_and_gain, problem
from runtime.test_operator import SECRET, Tapped, running, tank
from typer.testing import CliRunner

import taciturn
from taciturn import Nodes, Problem, ProblemError
from taciturn.cli import app
from taciturn.model.packets import inputs_at, outputs_at, packet_shapes, roles
from taciturn.nodes.keys import Keys
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet, Wire
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn.problem import parse
from taciturn_udp.operator import Operator
from taciturn_worlds.devices import DeviceCode, DeviceNode

BY_HAND = {**dict.fromkeys(range(8, 14), 0.5), **dict.fromkeys(range(14, 17), -1.5), 25: 0.25}  # by step
KP, KI, KD, FILTER = 0.5, 0.05, 0.4, 2.0
SLOW: dict[str, Any] = {
    "plant": {"A": [[0.95]], "B": [[0.1]], "C": [[1.0]], "W": [[0.01]], "V": [[0.01]], "dt": 1.0},
    "cost": {"Q": [[1.0]], "R": [[0.1]]},
    "controller": {"pid": {"kp": KP, "ki": KI, "kd": KD, "filter": FILTER}, "disturbance": "none"},
    "policy": {"kind": "all-time"},
}


def kept(name: str) -> Problem:
    """Return a problem of the catalogue with a given controller."""
    changes = {(key if "." in key else f"policy.{key}"): value for key, value in KEEPING[name].items()}
    return taciturn.load("pid-tank").changed(changes)


PROBLEMS: Mapping[str, Callable[[], Problem]] = {
    "lqg, limits": lambda: taciturn.load("two-mass-lqg").changed(
        {"plant.input_limit": [1.0], "plant.input_rate": [0.4]}
    ),
    "pid": lambda: kept("kept"),
    "pid, losses": lambda: kept("kept over bursts"),
    "pid, limits": lambda: kept("kept, limited at a set-point"),
    "pid, send-on-delta": lambda: kept("kept by send-on-delta"),
    "pid, sensor": lambda: kept("symmetric-send-on-delta"),
    "distributed": lambda: taciturn.load("quadruple-tank").changed({"policy.actuation": "hold"}),
    "lossy": lambda: taciturn.load("lossy-double-integrator"),
}


def together(one: Problem, nodes: Mapping[str, Node], ticks: int = 40) -> list[tuple[list[float], Mapping[str, bool]]]:
    """Run nodes, and all of them as one function, through manual phases; return the inputs and which links sent."""
    loop = one.close(one.design())
    policy = loop.policy
    plant, whole = SimulatedPlant(loop, 1), Nodes(loop, seed=2)
    boxes: dict[str, list[Packet]] = {role: [] for role in nodes}
    found = list[tuple[list[float], Mapping[str, bool]]]()
    for tick in range(ticks):
        y, hand = list(plant.measurement), BY_HAND.get(tick)
        manual = None if hand is None else [hand * (1 + i) for i in range(policy.model.inputs)]
        nodes[policy.network.controller].manual = manual
        expected = whole.step(y, manual=manual)
        u = np.zeros(policy.model.inputs)
        for role, node in nodes.items():
            box, boxes[role] = boxes[role], []
            if isinstance(node, DeviceNode):
                for packet in box:
                    assert node.receive(node.wire.encode(packet)) == "waiting"
                box = []
            mine = [y[i] for i in outputs_at(policy, role)]
            packets, given = node.step(tick, mine if node.measures else None, box)
            u[inputs_at(policy, role)] = () if given is None else given
            for packet in packets:
                hears = [r for r, n in nodes.items() if packet.link in n.program.hears]
                told = [r for r, n in nodes.items() if packet.link in n.program.acknowledged]
                if packet.kind == "acknowledgement":
                    boxes[told[0]].append(packet)
                elif whole.arrived[packet.link]:
                    boxes[hears[0]].append(packet)
        assert expected.tobytes() == u.tobytes(), tick
        found.append((u.tolist(), whole.sent))
        plant.move(u.tolist())
    return found


@pytest.mark.parametrize("name", few(PROBLEMS, 4))
def test_separate_nodes_and_all_nodes_in_one_agree_through_manual_phases(name: str) -> None:
    """Bit for bit; the controller is degraded for each manual step, and sends only what changes."""
    one = PROBLEMS[name]()
    loop = one.close(one.design())
    nodes = {role: Node(loop.policy, role, network=loop.network) for role in roles(loop.policy)}
    found = together(one, nodes)
    controller = nodes[loop.policy.network.controller]
    assert controller.reasons["manual"] == len(BY_HAND)
    assert controller.degraded
    if not any(loop.network.loss(link) or loop.network.burst(link) for link in loop.network.links):
        inputs = loop.policy.model.inputs
        if "limits" not in name:
            assert found[10][0] == [0.5 * (1 + i) for i in range(inputs)]
        acts = [link for link in found[0][1] if loop.network.nodes[loop.network.receiver(link)].applies]
        for phase in (range(8, 14), range(14, 17)):
            sent = [any(found[tick][1][link] for link in acts) for tick in phase]
            assert sum(sent) <= 1 or (name == "lossy" and all(sent))  # whose actuator applies 0 in silence


@pytest.mark.parametrize("name", few(["pid, losses", "pid, limits"], 1))
def test_nodes_in_c_are_operated_by_hand_as_those_in_python(name: str) -> None:
    """Bit for bit; the mode is in the saved state."""
    if shutil.which("cc") is None:
        pytest.skip("NOT SHOWN: a node in C needs a compiler, and there is no `cc`")
    one = PROBLEMS[name]()
    loop = one.close(one.design())
    nodes: dict[str, Node] = {role: Node(loop.policy, role, network=loop.network) for role in roles(loop.policy)}
    device = DeviceNode(
        DeviceCode(loop.policy, "controller", loop.network), loop.policy, "controller",
        network=loop.network, epoch=0, seed=0, watchdog=None, safe="hold",
    )  # fmt: skip
    nodes["controller"] = device
    together(one, nodes)
    assert device.degraded
    device.manual = [0.25] * loop.policy.model.inputs
    saved, device.manual = device.save(), None
    assert device.manual is None
    device.restore(saved)
    assert device.manual == (0.25,) * loop.policy.model.inputs
    with pytest.raises(ProblemError, match="manual"):
        device.manual = [1e39] * loop.policy.model.inputs


def test_a_node_in_c_hears_an_operator(tmp_path: Path) -> None:
    """It reads each kind of packet of a policy with an operator; packets by hand counted as malformed."""
    policy = tank().design()
    needs_compiler()
    device, wire = Device(compile_node(policy, "controller", policy.network, tmp_path)), Wire(policy)
    shapes = packet_shapes(policy, policy.network)
    assert {kind for kind, _ in shapes} >= {"setpoint", "report", "manual", "mode"}
    for (kind, link), (_, entries) in shapes.items():
        packet = Packet(kind, link, 3, 1, (0.5,) * entries, 2, 0)
        assert device.decode(wire.encode(packet)) == packet


@pytest.mark.parametrize("limit", [None, 0.4])
def test_a_pid_controller_returns_without_a_jump_against_numpy(limit: float | None) -> None:
    """Its integral follows the applied input, also of an input beyond the limit, which the controller clips."""
    changes = {} if limit is None else {"plant": {**SLOW["plant"], "input_limit": [limit]}}
    one = parse({**SLOW, **changes}, "a problem")
    nodes, rng, node = Nodes(one), np.random.default_rng(3), Node(one.design(), "controller")
    area = slow = u = y = 0.0
    for tick in range(60):
        by_hand = 0.3 + 0.02 * tick if 10 <= tick < 30 or 45 <= tick < 50 else None
        y = 0.2 * rng.normal() if by_hand is None and tick not in (30, 50) else y
        own = -(KP * y + KI * area + KD * (y - slow) / FILTER)
        before, u = u, np.clip(own if by_hand is None else by_hand, -(limit or np.inf), limit or np.inf)
        area, slow = area + y, slow + (y - slow) / FILTER
        if by_hand is not None:
            area = -(u + KP * y + KD * (y - slow) / FILTER) / KI
        elif tick in (30, 50):
            assert u == pytest.approx(before, abs=1e-12)
        node.manual = None if by_hand is None else [by_hand]
        (packet,) = node.step(tick, [y]).packets or (None,)
        found = nodes.step([y], manual=None if by_hand is None else [by_hand])
        assert found == pytest.approx([u], abs=1e-9), tick
        assert packet is None or packet.values == tuple(found)


def test_the_filter_follows_manual_inputs_against_numpy() -> None:
    """LQG returns with the command for its estimate, which the manual inputs have moved."""
    one = problem({"kind": "all-time"})
    policy, nodes, draws = one.design(), Nodes(one), np.random.default_rng(4)
    A, B, C = (np.array(PLANT[name]) for name in "ABC")
    G, L, prior = filter_and_gain(policy.model.V)
    for tick in range(30):
        y = draws.standard_normal(1)
        by_hand = [1.5] if 10 <= tick < 20 else None
        estimate = prior + G @ (y - C @ prior)
        u = nodes.step(y, manual=by_hand)
        assert np.allclose(u, L @ estimate if by_hand is None else by_hand, rtol=1e-9, atol=1e-12)
        prior = A @ estimate + B @ u


def test_every_integral_of_several_loops_follows_and_in_the_units_of_the_plant() -> None:
    """Two PID controllers at an operating point, whose actuators have a link each and whose links round."""
    A, B = np.array([[0.9, 0.05], [0.02, 0.95]]), np.array([[0.1, 0.02], [0.0, 0.2]])
    pid = {"kp": 0.5, "ki": 0.05, "kd": 0.4, "filter": 2.0}
    tables = {
        "plant": {
            "A": A.tolist(), "B": B.tolist(), "C": np.eye(2).tolist(),
            "W": [[0.01, 0.0], [0.0, 0.01]], "V": [[0.01, 0.0], [0.0, 0.01]], "dt": 1.0,
            "operating_point": {"x": [1.0, 1.0], "u": np.linalg.solve(B, (np.eye(2) - A) @ np.ones(2)).tolist()},
        },
        "cost": {"Q": np.eye(2).tolist(), "R": np.eye(2).tolist()},
        "controller": {"pid": [{**pid, "output": i, "input": i} for i in (1, 2)], "disturbance": "none"},
        "nodes": {"probe": {"measures": True}, "plc": {"controls": True}, "p": {"applies": [0]}, "q": {"applies": [1]}},
        "links": {"p": {"payload": "float32"}},
        "policy": {"kind": "send-on-delta", "delta": 1e-9},
    }  # fmt: skip
    nodes, draws, y = Nodes(parse(tables, "two loops")), np.random.default_rng(1), np.zeros(2)
    for tick in range(20):
        y = draws.normal(size=2) + 1.0 if tick < 12 else y
        u = nodes.step(y, manual=[1.5, -0.7] if 5 <= tick < 15 else None)
        if 5 <= tick <= 15:
            assert u == pytest.approx([1.5, -0.7], abs=1e-6), tick


def test_a_saved_state_continues_by_hand() -> None:
    """The mode and the inputs are part of the state; numbers that are no inputs are refused."""
    policy = parse(SLOW, "a problem").design()
    node, again = Node(policy, "controller"), Node(policy, "controller")
    node.manual = [0.5]
    node.step(0, [0.1])
    again.restore(node.save())
    assert again.manual == (0.5,)
    assert again.step(1, [0.2]) == node.step(1, [0.2])
    for wrong in ([1.0, 2.0], [np.inf], [1e39]):
        with pytest.raises(ProblemError, match="manual"):
            node.manual = wrong
    with pytest.raises(ProblemError, match="expected the node of the controller, controller"):
        Node(policy, "actuator").manual = [0.5]


@pytest.mark.parametrize(
    "build",
    [lambda: kept("event-pid"), lambda: taciturn.load("two-mass-lqg").changed({"policy.actuation": "model"})],
    ids=["function", "model"],
)
def test_policies_whose_inputs_are_no_commands_are_refused(build: Callable[[], Problem]) -> None:
    """In one sentence."""
    policy = build().design()
    with pytest.raises(ProblemError, match="expected a policy whose actuators apply the command"):
        Nodes(policy).step([0.0] * policy.model.sensed, manual=[0.0])
    node = Node(policy, "controller")
    node.manual = None
    with pytest.raises(ProblemError, match="expected a policy whose actuators apply the command"):
        node.manual = [0.0]


def test_a_link_waits_for_its_interval_by_hand_too() -> None:
    """A manual input is sent when the link may send, and a packet that the link must send is sent."""
    links = {"actuator": {"min_interval": 3, "max_interval": 5}}
    nodes = Nodes(parse({**SLOW, "policy": {"kind": "excess", "theta": 0.1}, "links": links}, "a problem"))
    sent = list[bool]()
    for tick in range(30):
        nodes.step([0.0], manual=[0.5 if tick < 10 else tick])
        sent.append(nodes.sent["actuator"])
    times = np.flatnonzero(sent)
    assert set(np.diff(times[times < 10])) == {5}
    assert set(np.diff(times[times > 12])) == {3}


@pytest.mark.parametrize("keys", [None, SECRET], ids=["plain", "keyed"])
def test_an_operator_gives_manual_inputs_to_a_running_loop(keys: Keys | None) -> None:
    """Each packet takes effect, the report tells the mode, and recorded packets do not change it."""
    problem = tank()
    loop = problem.close(problem.design())
    with running(loop, keys) as (server, controller), closing(Tapped()) as tap, closing(Tapped()) as other:
        operator, node = Operator(tap, controller, keys), server.nodes[0]
        assert operator.ask().manual is None
        found = operator.operate([0.25])
        assert found.manual == node.manual == (0.25,)
        assert found.sentence().startswith("manual input 0.25, set-point 0 in effect from step")
        assert operator.give([0.125]).manual == (0.25,)
        later = Operator(other, controller, keys)
        assert later.operate(None).manual is None
        for datagram in tap.recorded:
            other.send(datagram, controller)
        with pytest.raises(ProblemError, match="expected 1 finite number, one for each input"):
            later.operate([1.0, 2.0])
        assert later.ask().manual is None
        assert later.operate([0.5]).manual == (0.5,)
    assert node.reasons["manual"] > 0
    assert server.report()["manual"] == [[0.5]]


def test_the_command_sets_the_mode() -> None:
    """By an option, and by lines; the state of a controller that has no commands is refused."""
    problem, runner = tank(), CliRunner()
    with running(problem.close(problem.design()), None) as (server, (host, port)):
        to = ["setpoint", f"{host}:{port}"]
        shown = runner.invoke(app, [*to, "--manual", "0.25"])
        both = runner.invoke(app, [*to, "--manual", "0.25", "--automatic"])
        lines = runner.invoke(app, [*to, "--json"], input="manual 0.5\nmanual\nautomatic\n0.125\n")
        assert runner.invoke(app, [*to, "--automatic"]).stdout.startswith("set-point 0.125 in effect")
    assert shown.stdout.startswith("manual input 0.25, set-point 0 in effect from step")
    assert both.exit_code != 0
    assert [json.loads(line)["manual"] for line in lines.stdout.splitlines()] == [[0.25], [0.5], None, None]
    assert "the line is ''; expected numbers" in lines.stderr
    assert server.nodes[0].manual is None
