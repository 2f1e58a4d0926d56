"""Policies, loops and plants as systems of python-control: the bits of the nodes, and pure functions."""

from __future__ import annotations

import sys
from dataclasses import replace

import control
import numpy as np
import pytest
import scipy.signal
from catalogue import POLICIES, closed
from counts import few
from hypothesis import given, settings
from hypothesis import strategies as st
from parity.loops import every_feature, same, with_functions
from runtime.loops import drawn_by_the_policy, open_program
from systems import System, continuous_system, make_system, systems

import taciturn
from taciturn import (
    Burst,
    ContinuousPlant,
    Cost,
    Loop,
    Network,
    Nodes,
    Plant,
    ProblemError,
    design,
    from_control,
    to_control,
)
from taciturn._modes import factor
from taciturn.errors import InformationError
from taciturn.model.packets import roles
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet
from taciturn.nodes.together import StepFunction
from taciturn.program import numpy as interpreter
from taciturn.program.draws import NORMAL
from taciturn.program.ops import Entry, Sent, is_entry

NAMES = (
    "lqg joint model", "lqg separate hold", "excess model", "dynamic", "stochastic", "stochastic model", "rollout",
    "self-triggered", "downsampled", "send-on-delta", "pattern", "variance", "near-optimal", "remote",
    "remote, at the sensor", "lossy udp", "lossy tcp", "lossy udp, delayed", "lossy tcp, delayed",
    "lossy tcp, delayed, 30 steps",
)  # fmt: skip
BURST = Burst(to_bad=0.3, to_good=0.4, loss_good=0.1, loss_bad=0.9)
TWO = Plant([[1.1, 0.2], [0.0, 0.9]], [[0.0], [1.0]], np.diag([0.1, 0.2]), [[1.0, 0.0]], [[0.3]])
WEIGHTS = Cost(np.eye(2), [[0.1]])


def build(name: str) -> Loop:
    """Return the loop of a policy of the catalogue on a random plant."""
    return closed(POLICIES[name](make_system(11, 3, 2, 2, "lossy" in name)))


def respond(system: control.NonlinearIOSystem, inputs: np.ndarray, start: object = 0) -> np.ndarray:
    """Return what a system answers, (steps, outputs), given its inputs, (steps, inputs)."""
    times = np.arange(len(inputs)) * system.dt
    found = control.input_output_response(system, times, inputs.T, start, squeeze=False)
    return found.outputs.T


def nodes_apart(loop: Loop, y: np.ndarray, seed: int) -> np.ndarray:
    """Return what nodes that exchange packets apply and send, (steps, outputs), on the draws of a seed."""
    policy = loop.policy
    apart = {role: Node(policy, role, network=loop.network) for role in roles(policy)}
    together = Nodes(policy, loop.network, seed)
    own = [name.index for name in drawn_by_the_policy(loop.open_program())]
    boxes: dict[str, list[Packet]] = {role: [] for role in apart}
    rows = []
    for tick, measured in enumerate(y):
        together.step(measured)  # it tells what arrives
        drawn = together.turns.drawn(tick)
        sent, applied = set(), None
        for role, node in apart.items():
            draws = [drawn[i] for i in own] if node.program.draws is not None else None
            box, boxes[role] = boxes[role], []
            packets, u = node.step(tick, measured if node.measures else None, box, draws)
            applied = applied if u is None else u
            for packet in packets:
                if packet.kind == "acknowledgement":
                    boxes[next(r for r, n in apart.items() if packet.link in n.program.sends)].append(packet)
                    continue
                sent.add(packet.link)
                if together.arrived[packet.link]:
                    boxes[next(r for r, n in apart.items() if packet.link in n.program.hears)].append(packet)
        assert applied is not None
        assert {link for link, flag in together.sent.items() if flag} == sent
        rows.append([*applied, *(float(link in sent) for link in policy.scheduled)])
    return np.array(rows)


def assert_same(loop: Loop, seed: int, ticks: int = 60) -> np.ndarray:
    """Check that the system of a policy has the bits of its nodes, and return what they apply and send."""
    y = np.random.default_rng(seed).standard_normal((ticks, loop.policy.model.outputs))
    system = to_control(loop.policy, network=loop.network, seed=seed)
    expected = nodes_apart(loop, y, seed)
    assert same(respond(system, y), expected)
    assert system.dt == to_control(loop.policy.model).dt
    return expected


@pytest.mark.parametrize("name", few(NAMES, 10, 1))
def test_the_system_of_a_policy_has_the_bits_of_its_nodes(name: str) -> None:
    """Inputs and decisions: clocks, draws, losses, acknowledgements and delays."""
    assert assert_same(build(name), seed=5)[:, -1].any()


@given(systems(states=3), st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_the_system_of_a_policy_with_every_feature_has_the_bits_of_its_nodes(system: System, seed: int) -> None:
    """Locations that do not start at 0, memories, bells, draws and losses, all at once."""
    assert_same(every_feature(system, seed), seed % 1000, ticks=40)


def test_the_system_of_a_policy_with_functions_has_the_bits_of_its_nodes() -> None:
    """An extended Kalman filter at the sensor, and an input that is bent at the actuator."""
    assert assert_same(with_functions(make_system(5, 3, 2, 2, False), 1), seed=5, ticks=100)[:, -1].any()


def test_bursts_and_clipped_inputs_are_those_of_the_nodes() -> None:
    """A link that is now good, now bad, and an input at its limit."""
    plant = Plant(TWO.A, TWO.B, TWO.W, input_limit=[0.5])
    policy = design.lossy_lqg(plant, WEIGHTS, price=0.2, network=Network("udp", 0.2, 0.2))
    loop = taciturn.close(plant, policy, Network("udp", actuator_burst=BURST, sensor_burst=BURST))
    for seed in range(4):  # some start with a bad link
        assert_same(loop, seed)
    assert to_control(loop).state_labels[:2] == ["x[0]", "x[1]"]
    y = np.random.default_rng(0).standard_normal((60, 2))
    assert np.abs(respond(to_control(policy), y)[:, 0]).max() == 0.5


def test_a_policy_for_a_continuous_plant_has_the_bits_of_its_nodes() -> None:
    """An actuator that predicts between steps; its system has the seconds of a step."""
    plant = ContinuousPlant([[0.0, 1.0], [0.5, -0.2]], [[0.0], [1.0]], np.eye(2))
    loop = taciturn.close(plant, design.consistent(plant, WEIGHTS, period=0.1))
    assert assert_same(loop, seed=2)[:, -1].any()
    assert to_control(loop.policy).dt == to_control(loop).dt == 0.1


def test_nodes_step_as_the_system_does() -> None:
    """One sample at a time in a notebook gives what the diagram gives."""
    policy = build("lossy tcp, delayed").policy
    y, nodes = np.random.default_rng(3).standard_normal((50, 3)), Nodes(policy, seed=7)
    rows = [np.array([*nodes.step(measured), nodes.sent["actuator"]]) for measured in y]
    assert nodes.tick == 50
    assert same(np.array(rows), respond(to_control(policy, seed=7), y))
    assert not same(np.array(rows), respond(to_control(policy, seed=8), y))


def test_links_lose_as_much_as_the_network_says() -> None:
    """The share of packets that arrive, within five standard errors."""
    policy = design.lossy_lqg(Plant(TWO.A, TWO.B, TWO.W), WEIGHTS, price=0.0, network=Network("udp", 0.2, 0.4))
    nodes, ticks = Nodes(policy, seed=1), 4000
    arrived = {"actuator": 0, "sensor": 0}
    sent = dict(arrived)
    for measured in np.random.default_rng(4).standard_normal((ticks, 2)):
        nodes.step(measured)
        for link in arrived:
            arrived[link] += nodes.arrived[link]
            sent[link] += nodes.sent[link]
    for link, loss in (("actuator", 0.2), ("sensor", 0.4)):
        share, error = 1 - arrived[link] / sent[link], np.sqrt(loss * (1 - loss) / sent[link])
        assert abs(share - loss) < 5 * error


@pytest.mark.parametrize("name", ["lossy tcp, delayed", "stochastic", "rollout"])
def test_a_system_is_a_pure_function(name: str) -> None:
    """Its functions give the same when they are called again, in another order, and by others in between."""
    policy = build(name).policy
    system = to_control(policy, seed=2)
    x, visited = np.zeros(system.nstates), []
    for y in np.random.default_rng(6).standard_normal((30, system.ninputs)):
        follows, output = system.dynamics(0.0, x, y), system.output(0.0, x, y)
        visited.append((x, y, follows, output))
        x = follows
    for x, y, follows, output in [*reversed(visited), *visited]:
        assert same(system.output(1.0, x, y), output)
        system.dynamics(2.0, x, -y)
        assert same(system.dynamics(3.0, x, y), follows)


@pytest.mark.parametrize("lossy", [False, True])
def test_a_loop_in_python_control_has_the_bits_of_the_loop(lossy: bool) -> None:
    """The noise that the loop draws is supplied; without coupling a noise is one product, which has one rounding."""
    if lossy:
        plant = Plant(TWO.A, TWO.B, TWO.W, mean=[1.0, -2.0], input_limit=[0.8])
        policy = design.lossy_lqg(plant, WEIGHTS, price=0.2, network=Network("tcp", 0.2, 0.2, delay=1))
    else:
        plant, policy = TWO, design.stochastic(TWO, WEIGHTS, scale=0.5)
    loop, ticks, seed = taciturn.close(plant, policy), 80, 4
    program, turns = (
        open_program(loop),
        StepFunction(loop.open_program(), {"w": plant.states, "v": plant.outputs}, loop.network, seed),
    )
    normal = [name for name in program.inputs if is_entry(name, NORMAL)]
    z = np.random.default_rng(seed).standard_normal((ticks, len(normal)))
    supplied = np.empty((ticks, len(program.inputs), 1))
    for place, name in enumerate(program.inputs):
        is_normal, drawn = name in normal, range(ticks)
        column = z[:, normal.index(name)] if is_normal else [turns.drawn(tick)[name.index] for tick in drawn]
        supplied[:, place, 0] = column
    found = interpreter.run(program, loop.start(program, 1, seed), ticks, supplied).outputs
    shown = [*(Entry("y", i) for i in range(plant.outputs)), Entry("applied", 0), Sent("actuator")]
    p = factor(plant.V).shape[1]  # the measurement's noise is drawn first
    w, v = z[:, p:] @ factor(plant.W).T, z[:, :p] @ factor(plant.V).T
    system = to_control(loop, seed=seed)
    answer = respond(system, np.hstack([w, v]), [plant.mean, 0])
    assert same(answer, np.array([found[name][:, 0] for name in shown]).T)
    assert 0 < answer[:, -1].mean() < 1


def test_a_diagram_of_plant_and_policy_is_the_loop() -> None:
    """What is drawn for a policy is the same in a user's own diagram and in the loop; the plant's sums may round."""
    loop = build("lossy tcp, delayed")
    plant = loop.problem.plant
    policy = to_control(loop.policy, seed=9)
    labels = [f"{policy.name}.{label}" for label in policy.output_labels]
    diagram = control.interconnect([to_control(plant), policy], inplist=[], outlist=labels)
    start = np.ones(plant.states)
    times = np.arange(60) * policy.dt
    drawn = control.input_output_response(diagram, times, X0=[start, 0]).outputs.T
    whole = to_control(loop, seed=9)
    quiet = np.zeros((60, whole.ninputs))
    closed_loop = respond(whole, quiet, [start, 0])[:, plant.outputs :]
    np.testing.assert_allclose(drawn, closed_loop, atol=1e-9)
    assert 0 < drawn[:, -1].mean() < 1


def test_a_policy_closes_a_feedback_without_what_is_sent() -> None:
    """The gain carries the sign, so the feedback is positive."""
    policy = design.lqg(TWO, WEIGHTS, theta=0.3)
    whole = control.feedback(to_control(TWO), to_control(policy, sent=False), sign=1)
    settled = control.input_output_response(whole, np.arange(80.0), np.zeros(80), [1.0, 1.0, 0.0])
    assert abs(settled.outputs[-1]) < 0.05 * abs(settled.outputs).max()


def test_a_loop_in_single_precision_is_computed_in_double() -> None:
    """Nodes compute in double precision."""
    loop = taciturn.close(TWO, design.lqg(TWO, WEIGHTS, theta=0.3))
    noise = np.random.default_rng(0).standard_normal((20, 3))
    assert same(respond(to_control(loop), noise), respond(to_control(replace(loop, precision="float32")), noise))


@given(systems(), st.sampled_from([None, 0.1]))
@settings(max_examples=25, deadline=None)
def test_a_discrete_plant_comes_back_as_it_was(system: System, dt: float | None) -> None:
    """Matrices and time base go through python-control; the noise is given again."""
    p = system.plant
    plant = Plant(p.A, p.B, p.W, p.C, p.V, dt)
    there = to_control(plant)
    back = from_control(there, plant.W, plant.V)
    assert isinstance(back, Plant)
    assert back.same_as(plant)
    assert (back.dt, back.full_state) == (plant.dt, plant.full_state)
    assert there.dt == (True if dt is None else dt)
    assert there.input_labels == [f"u[{i}]" for i in range(plant.inputs)]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_a_continuous_plant_comes_back_as_it_was(seed: int) -> None:
    """Its time base is 0."""
    plant, _, _ = continuous_system(seed, "wiener")
    there = to_control(plant)
    back = from_control(there, plant.W)
    assert there.dt == 0
    assert isinstance(back, ContinuousPlant)
    assert all(np.array_equal(getattr(back, key), getattr(plant, key)) for key in ("A", "B", "C", "W", "V"))


def test_a_transfer_function_is_realised() -> None:
    """What comes back to python-control has its frequency response."""
    given = control.tf([1.0, 2.0], [1.0, 0.3, 0.5], dt=True)
    plant = from_control(given, W=np.eye(2), V=[[0.1]])
    assert isinstance(plant, Plant)
    assert plant.dt is None
    points = np.exp(1j * np.array([0.1, 1.0, 2.0]))
    np.testing.assert_allclose(to_control(plant)(points), given(points), rtol=1e-9)


def test_a_feedthrough_goes_to_python_control_and_back() -> None:
    """A discrete plant takes its inputs one step late, so its system has the response C(zI − A)⁻¹B + D/z."""
    given = control.ss([[0.5, 0.2], [0.0, 0.4]], [[1.0], [2.0]], [[1.0, 0.0]], [[0.7]], dt=0.5)
    plant = from_control(given, np.eye(2))
    points = np.exp(1j * np.array([0.1, 1.0, 2.0]))
    found = to_control(plant)
    assert not found.D.any()
    late = (given(points) - 0.7) + 0.7 / points
    np.testing.assert_allclose(found(points), late, rtol=1e-9)
    moving = control.ss(-np.eye(1), np.eye(1), np.eye(1), [[0.7]], dt=0)
    np.testing.assert_array_equal(to_control(from_control(moving, np.eye(1))).D, [[0.7]])


def test_what_is_no_linear_system_is_refused() -> None:
    """Systems of scipy, nonlinear ones, tables of frequencies, and linear ones that no plant is."""
    crooked = control.nlsys(lambda t, x, u, params: -(x**3) + u, None, inputs=1, states=1)
    table = control.frd([1.0], [1.0])
    for system in (scipy.signal.dlti([1.0], [1.0, 0.5]), crooked, table, TWO, None):
        with pytest.raises(ProblemError, match=f"system is a {type(system).__name__}; expected a control.StateSpace"):
            from_control(system, [[1.0]])
    with pytest.raises(ProblemError, match="so it is unspecified"):
        from_control(control.StateSpace(0.5, 1, 1, 0, None), [[1.0]])


def test_what_is_no_plant_policy_or_loop_is_refused() -> None:
    """And a network that is given for what has its own, or over which the policy cannot run."""
    policy = build("lossy tcp").policy
    loop = taciturn.close(policy.model, policy)
    with pytest.raises(ProblemError, match=r"thing is Problem\(.*; expected a Plant or a Cont"):
        to_control(taciturn.load("two-mass-lqg"))
    for thing in (loop, policy.model):
        with pytest.raises(
            ProblemError, match=f"network is given for a {type(thing).__name__}; expected this argument only for a Po"
        ):
            to_control(thing, network=Network())
    with pytest.raises(InformationError):
        to_control(policy, network=Network("udp"))
    with pytest.raises(ProblemError, match="expected the delay of the design"):
        to_control(policy, network=Network("tcp", delay=1))
    with pytest.raises(ProblemError, match="seed is -1; expected a whole number"):
        to_control(policy, seed=-1)


def test_bad_measurements_are_refused() -> None:
    """Of another size, and not finite; and what is no policy."""
    nodes = Nodes(design.lqg(TWO, WEIGHTS, theta=0.3))
    for measured, sentence in (
        ([1.0, 2.0], "measurement has shape"),
        ([np.nan], "expected an array of finite numbers"),
    ):
        with pytest.raises(ProblemError, match=sentence):
            nodes.step(measured)
    assert nodes.tick == 0
    with pytest.raises(ProblemError, match=r"policy is Plant\(.*; expected a Policy"):
        Nodes(TWO)  # type: ignore[arg-type]


def test_without_python_control_one_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both ways, whatever is given; a policy still steps."""
    monkeypatch.setitem(sys.modules, "control", None)
    policy = design.lqg(TWO, WEIGHTS, theta=0.3)
    for call in (lambda: to_control(TWO), lambda: to_control(policy), lambda: from_control(None, [[1.0]])):
        with pytest.raises(ProblemError) as found:
            call()
        assert str(found.value) == (
            "python-control is not installed, but to_control and from_control require it: "
            "pip install 'taciturn[control]'"
        )
    assert Nodes(policy).step([1.0]).shape == (1,)
