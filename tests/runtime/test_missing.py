"""Missing and late samples: nodes predict or hold them, in Python, in C and over a network; laws in simulations."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import nan
from typing import Any

import numpy as np
import pytest
from runtime.loops import differing_ticks, record

import taciturn
from taciturn import Cost, Network, Plant, close, design
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.losses import Burst
from taciturn.model.operating_point import OperatingPoint
from taciturn.model.packets import inputs_at, outputs_at, roles
from taciturn.model.steps import Apply, Assign, assigned
from taciturn.model.theory import Theory
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet, Wire
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn.nodes.together import Nodes
from taciturn.problem import Problem, parse
from taciturn.program.gap import response_to
from taciturn.simulation.trajectory import simulate
from taciturn_udp.nodes import BLIND, NodeServer
from taciturn_worlds.devices import DeviceNode, compile_devices

PLANT = {"A": [[1.1, 0.2], [0.0, 0.9]], "B": [[0.0], [1.0]], "C": [[1.0, 0.0]], "W": [[0.1, 0.0], [0.0, 0.1]]}
COST = {"Q": [[1.0, 0.0], [0.0, 1.0]], "R": [[1.0]]}
PID = {"pid": {"kp": 0.5, "ki": 0.05, "kd": 0.4, "filter": 2.0}, "disturbance": "none"}
SLOW = {"A": [[0.95]], "B": [[0.1]], "C": [[1.0]], "W": [[0.01]], "V": [[0.01]], "dt": 1.0}
GAP = range(20, 23)


def problem(policy: Mapping[str, object], **tables: Any) -> Problem:
    """Return a problem with these tables."""
    plant = {**PLANT, "V": [[0.1]], "dt": 1.0}
    return parse({"plant": plant, "cost": COST, "policy": dict(policy), **tables}, "a problem")


def with_pid(policy: Mapping[str, object], **tables: Any) -> Problem:
    """Return a problem with a PID controller."""
    cost = {"Q": [[1.0]], "R": [[0.1]]}
    return problem(policy, **{"plant": SLOW, "cost": cost, "controller": PID, **tables})


WIRED = {"sensor": {"measures": True, "site": "plc"}, "plc": {"controls": True}, "pump": {"applies": True}}
BRIDGED = {
    "periodic": lambda: with_pid({"kind": "periodic", "every": 1}),
    "every second step": lambda: with_pid({"kind": "periodic", "every": 2}),
    "all-time": lambda: with_pid({"kind": "all-time"}),
    "wired sensor": lambda: with_pid({"kind": "distributed", "theta": 1e-9}, nodes=WIRED),
    "dead band of the actuator": lambda: with_pid({"kind": "send-on-delta", "delta": 1e-9}, nodes=WIRED),
}
PROBLEMS = {
    "periodic": BRIDGED["periodic"],
    "lqg": lambda: problem({"kind": "lqg", "theta": 0.3}),
    "pid": lambda: with_pid({"kind": "excess", "theta": 0.1}),
    "dead band": lambda: with_pid({"kind": "event-pid", "delta": 0.1}),
    "distributed": lambda: taciturn.load("quadruple-tank"),
}


def together(one: Problem, nodes: Mapping[str, Node], ticks: int, seed: int) -> list[list[float]]:
    """Run nodes on the measurements of a plant with a gap, and all of them as one function; return the inputs."""
    policy = one.design()
    plant, whole = SimulatedPlant(one.close(policy), seed), Nodes(one)
    boxes: dict[str, list[Packet]] = {role: [] for role in nodes}
    inputs = list[list[float]]()
    for tick in range(ticks):
        y = [None] * policy.model.sensed if tick in GAP else list(plant.measurement)
        u = np.zeros(policy.model.inputs)
        for role, node in nodes.items():
            box, boxes[role] = boxes[role], []
            mine = [y[i] for i in outputs_at(policy, role)]
            if isinstance(node, DeviceNode):
                for packet in box:
                    assert node.receive(node.wire.encode(packet)) == "waiting"
                box = []
            packets, given = node.step(tick, mine if node.measures else None, box)
            u[inputs_at(policy, role)] = () if given is None else given
            for packet in packets:
                boxes[next(name for name, other in nodes.items() if packet.link in other.program.hears)].append(packet)
        assert whole.step(y).tobytes() == u.tobytes(), tick
        inputs.append(u.tolist())
        plant.move(u.tolist())
    return inputs


@pytest.mark.parametrize("name", PROBLEMS)
def test_separate_nodes_and_all_nodes_in_one_agree_over_a_gap(name: str) -> None:
    """Three samples are missing: the same bits, counted as missing and not as missed, and no jump afterwards."""
    one = PROBLEMS[name]()
    policy = one.design()
    nodes = {role: Node(policy, role, network=one.network) for role in roles(policy)}
    inputs = np.array(together(one, nodes, 40, 1))
    for node in nodes.values():
        assert node.counters["missing"] == node.reasons["missing"] == (len(GAP) if node.measures else 0)
        assert node.counters["missed"] == node.reasons["missed"] == 0
        assert node.degraded == node.measures
    steps = np.abs(np.diff(inputs, axis=0)).max(axis=1)
    assert steps[GAP.start - 1 : GAP.stop + 3].max() <= 1.5 * np.delete(steps, range(19, 26)).max()


@pytest.mark.evidence
def test_a_node_in_c_takes_missing_samples_as_one_in_python() -> None:
    """Bit for bit, with the same counters; without a measurement all outputs are missing."""
    if shutil.which("cc") is None:
        pytest.skip("NOT SHOWN: a node in C needs a compiler, and there is no `cc`")
    one = taciturn.load("two-mass-lqg")
    policy = one.design()
    devices = {
        role: make(policy, role, network=one.network, epoch=0, seed=0, watchdog=None, safe="hold")
        for role, make in compile_devices(one.close(policy)).items()
    }
    together(one, devices, 40, 3)
    device, host = devices["controller"], Node(policy, "controller")
    assert (device.counters["missing"], device.counters["missed"], device.degraded) == (len(GAP), 0, True)
    for tick, y in enumerate(([0.3, None], None, [None, -0.2], [1.0, 1.0]), 40):
        host.step(tick, y)
        device.step(tick, y)
    assert device.counters["missing"] == len(GAP) + host.counters["missing"] == len(GAP) + 3


@pytest.mark.parametrize("point", [False, True], ids=["at zero", "at an operating point"])
@pytest.mark.parametrize("kind", ["excess", "all_time"])
@pytest.mark.parametrize("gap", [(0, 1, 2), (5, 6, 7)])
def test_a_measured_state_is_predicted_by_the_model(kind: str, point: bool, gap: Sequence[int]) -> None:
    """Without noise, the inputs are those without the gap: no jump, in one program and in a node of its own."""
    A, B, x0, u0 = np.array([[1, 0.2], [-0.1, 0.95]]), np.array([[0.0], [0.3]]), np.array([2.0, 1.0]), np.array([0.5])
    rest = OperatingPoint(x0, u0) if point else None
    drift = x0 - A @ x0 - B @ u0 if point else np.zeros(2)
    plant = Plant(A, B, 1e-2 * np.eye(2), dt=1.0, mean=[3.0, -1.0], operating_point=rest)
    given = {"theta": 0.2} if kind == "excess" else {}
    policy, paths = getattr(design, kind)(plant, Cost(np.eye(2), [[0.1]]), **given), list[list[float]]()
    for missing in ((), gap):
        nodes, alone, x = Nodes(policy), Node(policy, "controller"), np.array([3.0, -1.0])
        paths.append([])
        for k in range(14):
            y = [None, None] if k in missing else x.tolist()
            u = nodes.step(y)
            alone.step(k, y)
            assert alone.memory["last y"] == pytest.approx(x.tolist(), abs=1e-12)
            paths[-1].append(float(u[0]))
            x = A @ x + B @ u + drift
    np.testing.assert_allclose(paths[1], paths[0], atol=1e-12)


def test_the_filter_predicts_a_missing_sample_against_numpy() -> None:
    """Its innovation is zero; with a packet in every step, the input is the gain times the estimate."""
    one = problem({"kind": "excess", "theta": 0.0})
    policy, nodes, draws = one.design(), Nodes(one), np.random.default_rng(4)
    A, B, C = (np.array(PLANT[name]) for name in "ABC")
    G, L, prior = filter_and_gain(policy.model.V)
    for _ in range(30):
        y = draws.standard_normal(1)
        missing = draws.random() < 0.4
        estimate = prior + (0.0 if missing else G @ (y - C @ prior))
        u = nodes.step([None] if missing else y)
        assert np.allclose(u, L @ estimate, rtol=1e-9, atol=1e-12)
        prior = A @ estimate + B @ u


def filter_and_gain(V: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the gain of the filter, that of the regulator, and the first prediction, by iterating both equations."""
    A, B, C, W = (np.array(PLANT[name]) for name in "ABCW")
    P, K, Q, R = W.copy(), np.eye(2), np.array(COST["Q"]), np.array(COST["R"])
    for _ in range(2000):
        G = P @ C.T @ np.linalg.inv(C @ P @ C.T + V)
        P = A @ (np.eye(2) - G @ C) @ P @ A.T + W
        L = -np.linalg.solve(R + B.T @ K @ B, B.T @ K @ A)
        K = Q + A.T @ K @ A + A.T @ K @ B @ L
    return P @ C.T @ np.linalg.inv(C @ P @ C.T + V), L, np.zeros(2)


def gain_for(chances: Sequence[float], moves: np.ndarray) -> np.ndarray:
    """Return the gain that minimises the error after a sample, if samples are missing by a Markov chain, in NumPy."""
    A, C, W, V = (np.array(one) for one in (PLANT["A"], PLANT["C"], PLANT["W"], [[0.1]]))
    shares, rest = np.linalg.matrix_power(moves, 5000)[0], np.eye(2)
    P, G = [share * W for share in shares], np.zeros((2, 1))
    for _ in range(3000):
        seen = [(1 - lost) * at for lost, at in zip(chances, P, strict=True)]
        weight = sum((1 - lost) * share for lost, share in zip(chances, shares, strict=True))
        G = sum(seen) @ C.T @ np.linalg.inv(C @ sum(seen) @ C.T + weight * V)
        left = [
            (1 - lost) * ((rest - G @ C) @ at @ (rest - G @ C).T + share * G @ V @ G.T) + lost * at
            for lost, share, at in zip(chances, shares, P, strict=True)
        ]
        moved = [A @ one @ A.T + share * W for one, share in zip(left, shares, strict=True)]
        P = [sum(moves[i, j] * moved[i] for i in range(len(P))) for j in range(len(P))]
    return G


def second_moments(chances: Sequence[float], moves: np.ndarray, G: np.ndarray) -> float:
    """Return the cost of sending every sample if samples are missing by a Markov chain, by second moments in NumPy."""
    A, B, C, W = (np.array(PLANT[name]) for name in "ABCW")
    V, (_, L, _) = np.array([[0.1]]), filter_and_gain(np.array([[0.1]]))
    maps = []  # of (state, prior), known or missing: estimate = prior + g(Cx + v - C prior)
    for gain in (G, 0.0 * G):
        E = np.hstack([gain @ C, np.eye(2) - gain @ C])
        F = np.block([[A + B @ L @ E[:, :2], B @ L @ E[:, 2:]], [(A + B @ L) @ E[:, :2], (A + B @ L) @ E[:, 2:]]])
        N = np.vstack([B @ L @ gain, (A + B @ L) @ gain])
        maps.append((F, N @ V @ N.T + np.kron(np.diag([1.0, 0.0]), W), E, L @ gain))
    chain = np.linalg.matrix_power(moves, 5000)[0]
    P = [share * np.eye(4) for share in chain]
    for _ in range(3000):
        cost, after = 0.0, []
        for share, at, lost in zip(chain, P, chances, strict=True):
            found = np.zeros((4, 4))
            for chance, (F, noise, E, noisy) in zip((1 - lost, lost), maps, strict=True):
                found += chance * (F @ at @ F.T + share * noise)
                u = L @ E @ at @ E.T @ L.T + share * noisy @ V @ noisy.T
                cost += chance * (np.trace(at[:2, :2]) + np.trace(u))
            after.append(found)
        P = [sum(moves[i, j] * after[i] for i in range(len(P))) for j in range(len(P))]
    return float(cost)


@pytest.mark.parametrize(
    ("law", "chances", "moves"),
    [
        (0.2, [0.2], [[1.0]]),
        ({"to_bad": 0.1, "to_good": 0.4, "loss_good": 0.0, "loss_bad": 0.9}, [0.0, 0.9], [[0.9, 0.1], [0.4, 0.6]]),
    ],
    ids=["independent", "in bursts"],
)
def test_the_cost_of_a_law_is_that_of_second_moments(
    law: object, chances: list[float], moves: list[list[float]]
) -> None:
    """Of the loop that sends every sample, with the gain for the law; no guarantee is claimed. The gain costs less than
    the one for samples that are never missing, and other gains cost more.
    """
    one = problem({"kind": "excess", "theta": 0.0}, links={"sensor": {"missing": law}})
    found = taciturn.evaluate(one, steps=400_000, seed=2)
    assert found.withdrawn == ("samples are missing at random",)
    assert found.cost_bound is None
    G = gain_for(chances, np.array(moves))
    exact = second_moments(chances, np.array(moves), G)
    assert abs(found.cost.value - exact) < 4.5 * found.cost.standard_error
    assert found.cost.standard_error < 0.02 * exact
    assert found.cost_every_sample is not None
    assert found.cost_every_sample.value == pytest.approx(exact, rel=1e-9)
    assert found.cost_every_sample.standard_error == 0
    assert exact < second_moments(chances, np.array(moves), filter_and_gain(np.array([[0.1]]))[0])


def test_a_law_that_is_removed_leaves_nothing_behind() -> None:
    """A node at the site of the controller has no link, so an empty table of its link would be refused."""
    nodes = {"probe": {"measures": [0], "site": "plc"}, "plc": {"controls": True}, "valve": {"applies": [0]}}
    one = problem({"kind": "excess", "theta": 0.1}, nodes=nodes, links={"probe": {"missing": 0.3}})
    assert one.network.missing == {"probe": 0.3}
    assert not one.changed({"links.probe.missing": None}).network.missing


def test_what_is_no_law_and_no_number_is_refused() -> None:
    """In a sentence."""
    with pytest.raises(ProblemError, match=r"missing is 0\.3; expected a Mapping"):
        Network(missing=0.3)  # type: ignore[arg-type]
    node = Node(problem({"kind": "excess", "theta": 0.1}).design(), "controller")
    with pytest.raises(ProblemError, match="expected 1 finite numbers"):
        node.step(0, ["1"])  # type: ignore[list-item]


def test_a_sensor_that_sends_every_sample_sends_nothing_without_one() -> None:
    """A missing sample is then a lost packet, which the filter of `lossy-lqg` expects: the same distribution."""
    plant = Plant(PLANT["A"], PLANT["B"], PLANT["W"], dt=1.0)
    policy = design.lossy_lqg(plant, Cost(**COST), price=0.3, network=Network("udp", 0.1, 0.2))
    costs = [
        taciturn.average(close(plant, policy, network), steps=200_000, seed=3).cost
        for network in (Network("udp", 0.1, 0.2), Network("udp", 0.1, 0.0, missing={"sensor": 0.2}))
    ]
    assert abs(costs[0].value - costs[1].value) < 4.5 * np.hypot(costs[0].standard_error, costs[1].standard_error)


@pytest.mark.parametrize("name", PROBLEMS)
def test_simulations_and_nodes_agree_in_every_bit_if_samples_are_missing(name: str) -> None:
    """Whatever the node does without a sample; the path tells which are missing."""
    one = PROBLEMS[name]()
    policy, law = one.design(), Burst(0.2, 0.4, 0.1, 0.8)
    sensor = policy.network.sensors[0]
    loop = close(one.plant, policy, Network(nodes=one.network.nodes, links=one.network.links, missing={sensor: law}))
    wrong, _ = differing_ticks(loop, *record(loop, 80, 3))
    assert not wrong
    path = simulate(loop, 80)
    shown = np.array([[value is None for value in row] for row in path.document()["measurement"]])
    assert shown.any()
    assert np.array_equal(shown, path.missing)


def test_a_simulated_plant_says_which_samples_are_missing() -> None:
    """In the first step too; in the share that the law states."""
    one = problem({"kind": "excess", "theta": 0.0}, links={"sensor": {"missing": 0.3}})
    loop = one.close(one.design())
    first = [SimulatedPlant(loop, seed).measurement == (None,) for seed in range(300)]
    plant, later = SimulatedPlant(loop, 1), list[bool]()
    for _ in range(1000):
        plant.move([0.0] if abs(plant.state[0]) < 1e6 else [-1.0])
        later.append(plant.measurement == (None,))
        if abs(plant.state[0]) > 1e6:
            plant.restart()
    for found in (first, later):
        assert abs(np.mean(found) - 0.3) < 4.5 * np.sqrt(0.21 / len(found))


class _Port:
    """A socket without a network."""

    received = 1
    counted: Mapping[str, int | None] = {}
    address = ("127.0.0.1", 1)

    def __init__(self) -> None:
        """Start without datagrams."""
        self.senders: list[tuple[str, int]] = []
        self.sent: list[bytes] = []

    def send(self, datagram: bytes, to: object) -> None:
        """Keep a datagram."""
        self.sent.append(datagram)


class _Served:
    """The server of a controller with a sensor, in a time that the test sets."""

    def __init__(self, tick: float | None = 1.0) -> None:
        """Start the server."""
        self.policy = taciturn.load("two-mass-lqg").design()
        self.wire, self.port, self.now = Wire(self.policy), _Port(), 0.0
        node = Node(self.policy, "controller")
        self.server = NodeServer(
            [node],
            self.wire,
            self.port,
            peer=("127.0.0.1", 2),
            plant=("127.0.0.1", 3),
            tick=tick,
            clock=lambda: self.now,
        )  # type: ignore[arg-type]
        self.node, self.turns = node, self.server.turns(lambda: False)
        self.until = next(self.turns)

    def measure(self, at: float, tick: int, y: tuple[float, ...] = (0.5, -0.5)) -> None:
        """Let time pass as a socket does, and a measurement arrive."""
        self.wait(at)
        self.port.senders = [("127.0.0.1", 3)]
        datagram = self.wire.encode(Packet("measurement", "plant", tick, tick, y, 1))
        self.until = self.turns.send([datagram])

    def wait(self, at: float) -> None:
        """Let time pass, and wake the server whenever it asks for it."""
        while self.until < at:
            self.now, self.port.senders = self.until, []
            self.until = self.turns.send([])
        self.now = at


def test_in_real_time_a_late_measurement_is_missing_and_dropped() -> None:
    """The node goes on at its deadline; the measurement that comes after it is late, and the next one is used."""
    served = _Served()
    for tick in range(5):
        served.measure(float(tick), tick)
    served.wait(5.2)
    assert served.node.tick == 4
    served.wait(5.3)
    assert served.node.tick == 5
    served.measure(5.6, 5)
    served.measure(6.0, 6)
    assert served.node.tick == 6
    assert (served.node.counters["missing"], served.node.counters["missed"]) == (1, 0)
    assert served.server.refused == {"late": 1}


def test_a_node_stops_if_the_plant_is_silent_for_long() -> None:
    """So that the watchdogs of its receivers expire; then it goes on with the present step."""
    served = _Served()
    for tick in range(3):
        served.measure(float(tick), tick)
    served.wait(30.0)
    assert served.node.tick == 2 + BLIND
    served.measure(30.0, 30)
    assert served.node.tick == 30
    assert (served.node.counters["missing"], served.node.counters["missed"]) == (BLIND, 30 - 3 - BLIND)


@pytest.mark.parametrize("tick", [None, 1.0], ids=["virtual time", "real time"])
def test_a_plant_says_that_a_sample_is_missing(tick: float | None) -> None:
    """NaN in its packet: the node goes on at once, as without this output; a set-point or a payload is never NaN."""
    served = _Served(tick)
    served.measure(0.0, 0)
    served.measure(1.0, 1, (nan, -0.5))
    served.measure(2.0, 2, (nan, nan))
    assert (served.node.tick, served.node.counters["missing"]) == (2, 2)
    other = Node(served.policy, "controller")
    for k, y in enumerate(([0.5, -0.5], [None, -0.5], None)):
        other.step(k, y)
    assert served.node.memory == other.memory
    with pytest.raises(ProblemError, match="finite numbers"):
        served.wire.encode(Packet("data", "actuator", 0, 0, (nan,)))


@pytest.mark.parametrize(
    ("links", "expected"),
    [
        ({"sensor": {"missing": 1.2}}, r"links\.sensor\.missing is 1\.2; expected 0 ≤ links\.sensor\.missing ≤ 1"),
        ({"actuator": {"missing": 0.1}}, "'actuator' is no node that measures; expected one of the nodes sensor"),
        ({"sensor": {"missing": {"to_bad": 0.1}}}, r"links\.sensor\.missing\.to_good is missing"),
    ],
)
def test_laws_that_state_no_missing_samples_are_refused(links: Mapping[str, Any], expected: str) -> None:
    """By the key, and with what is expected."""
    with pytest.raises(ProblemError, match=expected):
        problem({"kind": "excess", "theta": 0.3}, links=links)


def test_a_law_for_a_sensor_beside_the_controller_needs_no_link() -> None:
    """The key stands in the table of the node's link, although it has none; other keys are refused there."""
    nodes = {
        "level": {"measures": True, "site": "plc"},
        "plc": {"controls": True},
        "pump": {"applies": True},
    }
    one = problem({"kind": "excess", "theta": 0.3}, nodes=nodes, links={"level": {"missing": 0.1}})
    assert (one.network.missing, list(one.network.links)) == ({"level": 0.1}, ["pump"])
    assert "10 % of the samples of level are missing" in one.network.short()
    with pytest.raises(ProblemError, match="at the controller's site"):
        problem({"kind": "excess", "theta": 0.3}, nodes=nodes, links={"level": {"missing": 0.1, "loss": 0.1}})


def test_loops_without_the_law_keep_their_programs() -> None:
    """No operation is added to a simulation in which no sample is missing."""
    loop: Loop = taciturn.load("two-mass-lqg").close(taciturn.load("two-mass-lqg").design())
    assert not any("last y" in state.name or "sampled" in state.name for state in loop.program().states)


@pytest.mark.parametrize("name", BRIDGED)
def test_after_a_gap_on_a_line_a_controller_goes_on_as_without_it(name: str) -> None:
    """In all nodes as one and in one of its own: the inputs and memories are those without the gap, to rounding."""
    one = BRIDGED[name]()
    policy, samples = one.design(), 0.3 + 0.07 * np.arange(30)
    role = next(role for role in roles(policy) if policy.network.controller in role.split("+"))
    inputs, memories = list[np.ndarray](), list[Mapping[str, list[float]]]()
    for gap in (range(0), range(9, 16)):
        nodes, alone = Nodes(one), Node(policy, role, network=one.network)
        inputs.append(np.zeros(len(samples)))
        for k, y in enumerate(samples):
            given = [None if k in gap else y]
            inputs[-1][k] = nodes.step(given)[0]
            alone.step(k, given)
            if k == 15:
                assert max(alone.memory["response to a line of y"]) == pytest.approx(28.0 if gap else 0.0)
        memories.append(alone.memory)
    assert abs(inputs[1][9:16] - inputs[0][9:16]).max() > 0.05
    np.testing.assert_allclose(inputs[1][17:], inputs[0][17:], atol=1e-12)
    for signal, values in memories[0].items():
        assert memories[1][signal] == pytest.approx(values, abs=1e-12)


@pytest.mark.evidence
def test_a_node_in_c_goes_on_after_gaps_as_one_in_python() -> None:
    """Bit for bit with random gaps, also one that is saved within a gap and restored."""
    if shutil.which("cc") is None:
        pytest.skip("NOT SHOWN: a node in C needs a compiler, and there is no `cc`")
    one = BRIDGED["periodic"]()
    policy, draws = one.design(), np.random.default_rng(7)
    make = compile_devices(one.close(policy))["controller"]
    device = make(policy, "controller", network=one.network, epoch=0, seed=0, watchdog=None, safe="hold")
    host, bridged = Node(policy, "controller"), 0
    for tick in range(60):
        given = [None] if draws.random() < 0.5 else list(draws.standard_normal(1))
        bridged += given != [None] and host.memory["missing samples of y"] != [0.0]
        assert [p.values for p in device.step(tick, given)[0]] == [p.values for p in host.step(tick, given)[0]]
        assert device.memory == host.memory
        if tick % 5 == 0:
            again, saved = Node(policy, "controller"), device.save()
            again.restore(host.save())
            device.step(tick + 1, [9.0])
            device.restore(saved)
            host = again
    assert bridged > 10


def interpolated(samples: Sequence[Sequence[float | None]], first: np.ndarray) -> np.ndarray:
    """Return what a controller should have read up to now: lines over gaps, and the last sample within one."""
    found = np.array([[nan if value is None else value for value in row] for row in samples])
    for column, begun in zip(found.T, first, strict=True):
        known = np.flatnonzero(~np.isnan(column))
        places = np.concatenate([[-1], known])
        column[:] = np.interp(np.arange(len(column)), places, np.concatenate([[begun], column[known]]))
    return found


def test_a_controller_after_gaps_is_that_of_interpolated_samples_against_numpy() -> None:
    """Two outputs with gaps of their own, a register among the states, and feedback of the inputs that were applied."""
    draws = np.random.default_rng(11)
    given = {
        "A": [[0.7, 0.1, 0.0], [-0.2, 0.9, 0.3], [0.0, 0.0, 0.0]],
        "B": [[0.3, 0.0], [0.0, -0.2], [0.0, 1.0]],
        "C": [[0.2, -0.1, 0.05], [0.0, 0.1, 0.1]],
        "D": [[-0.1, 0.0], [0.05, -0.2]],
        "E": [[0.1, 0.0], [0.0, 0.2], [0.0, 0.0]],
    }
    plant = {"A": [[0.8, 0.1], [0.0, 0.7]], "B": np.eye(2).tolist(), "C": np.eye(2).tolist(), "dt": 1.0}
    noise = {"W": (0.1 * np.eye(2)).tolist(), "V": (0.1 * np.eye(2)).tolist(), "initial": {"mean": [0.4, -0.3]}}
    cost = {"Q": np.eye(2).tolist(), "R": np.eye(2).tolist()}
    controller = {**given, "sign": "positive", "disturbance": "none"}
    one = problem({"kind": "periodic", "every": 1}, plant={**plant, **noise}, cost=cost, controller=controller)
    A, B, C, D, E = (np.array(given[name]) for name in "ABCDE")
    nodes, samples, inputs = Nodes(one), list[list[float | None]](), list[np.ndarray]()
    for _ in range(50):
        samples.append([None if draws.random() < 0.6 else float(draws.standard_normal()) for _ in range(2)])
        z, read = np.zeros(3), interpolated(samples, np.array([0.4, -0.3]))
        for y, u in zip(read, inputs, strict=False):
            z = A @ z + B @ y + E @ u
        inputs.append(nodes.step(samples[-1]))
        np.testing.assert_allclose(inputs[-1], C @ z + D @ read[-1], atol=1e-12)


def test_manual_inputs_within_a_gap_end_without_a_jump() -> None:
    """The sample comes back in manual operation; the first automatic command is the last manual input."""
    nodes = Nodes(BRIDGED["periodic"]())
    for k in range(40):
        y = None if 5 <= k < 20 else [0.2 * min(k, 20)]
        u = nodes.step(y, manual=[-0.7] if 8 <= k < 35 else None)
        if k == 35:
            assert u[0] == pytest.approx(-0.7, abs=1e-12)


@pytest.mark.parametrize(
    "make",
    [
        lambda: with_pid({"kind": "excess", "theta": 0.1}),
        lambda: with_pid({"kind": "event-pid", "delta": 0.1}),
        lambda: with_pid({"kind": "send-on-delta", "delta": 0.1}),
        lambda: with_pid({"kind": "symmetric-send-on-delta", "delta": 0.1}, controller={"pid": {"kp": 0.5, "ki": 0.1}}),
        lambda: taciturn.load("quadruple-tank"),
    ],
    ids=["filter", "event-pid", "dead band", "levels", "local filters"],
)
def test_nodes_that_predict_or_only_send_have_no_memory_of_gaps(make: Callable[[], Problem]) -> None:
    """Nor has a controller that hears of a sensor by packets."""
    one = make()
    policy = one.design()
    for role in roles(policy):
        assert not any("line" in name or "missing" in name for name in Node(policy, role, network=one.network).memory)


def test_a_memory_that_does_not_respond_linearly_keeps_its_value() -> None:
    """A function in the step of the controller's state, and all that reads it; the same step as a sum is corrected."""
    policy = BRIDGED["periodic"]().design()
    assert [len(found.E) for found in response_to(policy, "y")] == [2]
    update = next(step for step in policy.steps if "next register" in assigned(step))
    assert isinstance(update, Assign)
    curved = Apply(update.at, {"next register": 2}, lambda z, y: np.tanh(z) + y[0], ("register", "measured"))
    after = Assign(update.at, "after", {"next register": [[1.0, 0.0]], "after": [[0.5]], "measured": [[1.0]]})
    behind = Assign(update.at, "behind", {"register": [[1.0, 0.0]], "behind": [[0.5]], "measured": [[1.0]]})
    counted = Assign(update.at, "count", {"count": [[0.5]], "y": [[2.0]]})
    steps = tuple(curved if step is update else step for step in policy.steps)
    assert response_to(replace(policy, steps=steps, theory=Theory()), "y") == ()
    (found,) = response_to(replace(policy, steps=(*steps, after, behind, counted), theory=Theory()), "y")
    assert (found.memories, found.F.tolist(), found.E.tolist()) == ((("count", 0),), [[0.5]], [2.0])
