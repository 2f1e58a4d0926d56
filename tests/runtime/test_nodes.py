"""Nodes decide as the closed loop does, bit for bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from catalogue import KEEPING, POLICIES, closed
from counts import few, scaled
from hypothesis import given, settings
from hypothesis import strategies as st
from parity.loops import every_feature, with_functions
from runtime.loops import differing_ticks, record
from systems import System, make_system, systems

import taciturn
from taciturn import ContinuousPlant, Cost, Network, Plant, design
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.packets import roles
from taciturn.model.steps import Decide
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet

TWO_STATES = ContinuousPlant([[0.0, 1.0], [0.5, -0.2]], [[0.0], [1.0]], [[0.1, 0.0], [0.0, 1.0]])
NOISY = ContinuousPlant([[0.0, 1.0], [0.5, -0.2]], [[0.0], [1.0]], np.eye(2), C=[[1.0, 0.0]], V=[[0.1]])
SOME = ("lqg joint model", "remote", "lossy tcp, delayed", "stochastic", "rollout")
WEIGHTS = Cost(np.eye(2), [[0.1]])
CONTINUOUS = {
    "consistent": lambda: design.consistent(TWO_STATES, WEIGHTS, period=0.1),
    "integral": lambda: design.integral(TWO_STATES, WEIGHTS, period=0.1, slope=0.8),
    "periodic, predicted": lambda: design.periodic(TWO_STATES, WEIGHTS, period=0.3, actuation="model"),
    "near-optimal, predicted": lambda: design.near_optimal(TWO_STATES, WEIGHTS, price=0.2, period=0.1),
    "lqg, sampled": lambda: design.lqg(NOISY, WEIGHTS, theta=0.2, period=0.1, actuation="model"),
}
CROSSED = (("measures", "level-1", 1), ("measures", "level-2", 0), ("applies", "pump-1", 1), ("applies", "pump-2", 0))
ACKNOWLEDGED = {"loss": 0.2, "acknowledged": True}
TANKS = {
    "tank, model": {},
    "tank, hold, sets of inputs": {"joint": True, "prediction": "hold", "actuation": "hold"},
    "tank, losses": {
        f"links.{link}.{key}": value for link in ("level-1", "pump-1", "pump-2") for key, value in ACKNOWLEDGED.items()
    },
    "tank, losses of sets": {
        **{f"links.pump-{i}.{key}": value for i in (1, 2) for key, value in ACKNOWLEDGED.items()},
        **{"joint": True, "actuation": "hold"},
    },
    "tank, rounded": {"links.level-2.payload": "float32", "nodes.pump-1.site": "plc"},
    "tank, dead bands": {
        **{"kind": "send-on-delta", "theta": None, "prediction": None, "actuation": None, "delta": 0.4},
        "shares": {"level-1": 2.0},
    },
    "tank, sets of links": {
        **{"kind": "excess", "prediction": None, "actuation": "hold"},
        **{f"nodes.level-{i}.site": "plc" for i in (1, 2)},
        **{f"links.level-{i}": None for i in (1, 2)},
    },
    "tank, variances": {
        **{"kind": "variance", "theta": None, "prediction": None, "actuation": None, "threshold": 0.12},
        **{"nodes.pump-1.site": "plc", "nodes.pump-2.site": "plc"},
    },
    "tank, limits of intervals": {
        **{f"links.{link}.max_interval": 4 for link in ("level-1", "level-2", "pump-1")},
        **{f"links.{link}.min_interval": 2 for link in ("level-1", "pump-2")},
    },
    "tank, crossed": {f"nodes.{n}.{does}": [i] for does, n, i in CROSSED},
}
STRING = "vehicle-string"
PARTICULAR = (*CONTINUOUS, *KEEPING, *TANKS, STRING)
COMPLETE = (
    "kept over bursts", "tank, hold, sets of inputs", "rollout", "stochastic", "send-on-delta", "tank, rounded",
    "tank, limits of intervals", "lossy udp, delayed, 30 steps",
)  # fmt: skip
"""Policies that hold every operation and every form of a step: a shortened run runs these alone for long."""


def long(name: str) -> int:
    """Return the number of steps of a long run."""
    return 100_000 if name in COMPLETE else scaled(100_000, 2_000)


def held(loop: Loop) -> set[object]:
    """Return the operations of a loop's program, and the forms of its steps: their class, condition and trigger."""
    found: set[object] = {operation.name for operation in loop.program().ops}
    for step in loop.policy.steps:
        found.add((type(step), type(getattr(step, "on", None)), bool(getattr(step, "labels", ()))))
        if isinstance(step, Decide):
            found.add((step.trigger.limit is None, bool(step.trigger.excluded), min(len(step.trigger.options), 4)))
    return found


def build(name: str) -> Loop:
    """Return the loop of a policy of the catalogue on a random plant, or of one for a particular plant."""
    if name in (*TANKS, STRING):
        problem = taciturn.load("quadruple-tank").changed(TANKS[name]) if name in TANKS else taciturn.load(name)
        return problem.close(problem.design())
    if name in KEEPING:
        problem = taciturn.load("pid-tank").changed(dict(KEEPING[name]))
        return problem.close(problem.design())
    if name in CONTINUOUS:
        policy = CONTINUOUS[name]()
        return taciturn.close(NOISY if "lqg" in name else TWO_STATES, policy)
    return closed(POLICIES[name](make_system(11, 3, 2, 2, "lossy" in name)))


def assert_same(loop: Loop, ticks: int, seed: int, fast: bool) -> None:
    """Check that nodes and loop agree in every bit of input and every decision, and that something was sent."""
    ticks = min(ticks, loop.horizon or ticks)
    records, draws = record(loop, ticks, seed, fast=fast)
    wrong, packets = differing_ticks(loop, records, draws)
    assert wrong == []
    assert packets > 0


@pytest.mark.parametrize("name", few([*POLICIES, *PARTICULAR], 5))
def test_nodes_decide_as_the_numpy_program(name: str) -> None:
    """Every policy with a step: 200 steps against NumPy itself."""
    assert_same(build(name), 200, 3, fast=False)


@pytest.mark.evidence
@pytest.mark.parametrize("name", [*POLICIES, *PARTICULAR])
def test_nodes_decide_as_the_program_for_100_000_ticks(name: str) -> None:
    """Every policy with a step: 100,000 steps in a row, against the build that has the bits of NumPy."""
    assert_same(build(name), long(name), 4, fast=True)


@pytest.mark.evidence
def test_the_policies_that_run_for_long_hold_every_operation_and_every_form_of_a_step() -> None:
    """A new operation or form needs a policy among them."""
    every = set[object]().union(*(held(build(name)) for name in [*POLICIES, *PARTICULAR]))
    assert set[object]().union(*(held(build(name)) for name in COMPLETE)) == every


@pytest.mark.parametrize("name", few([*TANKS, STRING], 4))
def test_two_sensors_and_two_pumps_decide_as_the_loop(name: str) -> None:
    """Each with its own outputs and inputs, over links of their own."""
    assert_same(build(name), 200, 3, fast=False)


@given(systems(states=4), st.integers(0, 2**32 - 1), st.sampled_from(["float64", "float32", "int16"]))
@settings(max_examples=6, deadline=None)
def test_every_feature_of_a_policy_runs_in_nodes(system: System, seed: int, payload: str) -> None:
    """Losses, acknowledgements, clocks, locations, memories, draws, bells and rounded payloads, all at once."""
    loop = every_feature(system, seed)
    network = loop.network
    ranges = {"actuator_range": 3.0, "sensor_range": 20.0} if payload == "int16" else {}
    rounded = Network(network.protocol, network.loss("actuator"), network.loss("sensor"), payload=payload, **ranges)
    assert_same(taciturn.close(system.plant, loop.policy, rounded, loop.problem.cost), 120, seed % 1000, fast=True)


@given(systems(states=3), st.integers(0, 2**32 - 1), st.booleans())
@settings(max_examples=3, deadline=None)
def test_steps_that_are_functions_run_in_nodes(system: System, seed: int, fast: bool) -> None:
    """An extended Kalman filter at the sensor, and an input that is bent at the actuator."""
    assert_same(with_functions(system, seed), 120, seed % 1000, fast)


def test_rounding_is_within_half_a_step() -> None:
    """What a receiver reads of 16 bits is off by half a step at most, and clipped at the range."""
    from taciturn.model.wire import Encoding

    values = np.random.default_rng(0).uniform(-3, 3, 1000)
    read = np.array([Encoding("int16", (2.0,)).rounded([value])[0] for value in values])
    inside = np.abs(values) <= 2.0
    assert np.abs(read - values)[inside].max() <= 0.5 * 2.0 / 32767 * (1 + 1e-9)
    assert set(np.abs(read[~inside])) == {2.0}


def test_a_rounded_loop_has_no_guarantee() -> None:
    """The theory knows no rounding: the loop says so."""
    problem = taciturn.load("two-mass-lqg").changed({"network.payload": "int16", "network.actuator_range": 5.0})
    found = taciturn.evaluate(problem, steps=200_000)
    assert found.cost_bound is None
    assert any("int16" in note for note in found.notes)


def masses(role: str, **options: object) -> Node:
    """Return a node of the two masses, whose theory takes every packet to arrive."""
    return Node(taciturn.load("two-mass-lqg").design(), role, **options)  # type: ignore[arg-type]


def data(tick: int, sequence: int, value: float = 1.0, epoch: int = 0, link: str = "actuator", loop: int = 0) -> Packet:
    """Return a packet to the actuator."""
    return Packet("data", link, tick, sequence, (value,), epoch, loop)


def test_each_packet_is_counted_once() -> None:
    """Duplicates, replays, misdirected, late, early and superseded packets: received is the sum of the rest."""
    node = masses("actuator")
    node.step(0, packets=[data(0, 0), data(0, 0), data(0, 0, link="sensor"), data(0, 1, loop=3)])
    node.step(1, packets=[data(3, 1, 3.0), data(3, 2, 4.0), data(1, 3), data(900, 4)])
    node.step(2, packets=[data(1, 5, 9.0), data(0, 0), Packet("mark", "actuator", 2, 0)])
    node.step(3, packets=[data(3, 6, 5.0, epoch=1), data(3, 7, epoch=0)])
    counted = {name: n for name, n in node.counters.items() if not name.startswith("sent")}
    received = counted.pop("received")
    assert received == sum(counted.values()) + node.inbox.waiting
    assert counted == {
        "used": 3, "duplicate": 2, "misdirected": 2, "superseded": 2, "ahead": 1, "late": 1, "marks": 1, "replayed": 1,
    }  # fmt: skip


def test_the_newest_packet_of_a_tick_wins() -> None:
    """Of two packets for one step the later sequence is used, in whichever order they come."""
    for order in ((0, 1), (1, 0)):
        node = masses("actuator")
        both = [data(0, 0, 1.0), data(0, 1, 2.0)]
        assert node.step(0, packets=[both[i] for i in order]).input == (2.0,)


def test_a_late_packet_is_used_where_none_may_be_lost_and_lost_where_some_are() -> None:
    """On an ideal network the newest late packet counts and the node is degraded; on a lossy one it is lost."""
    node = masses("actuator")
    node.step(0)
    assert node.step(1, packets=[data(0, 0, 7.0)]).input == (7.0,)
    assert node.degraded
    assert node.reasons == {"late": 1}
    lossy = Node(taciturn.load("lossy-double-integrator").design(), "actuator")
    lossy.step(0)
    assert lossy.step(1, packets=[data(0, 0, 7.0)]).input == (0.0,)
    assert not lossy.degraded
    assert lossy.counters["late"] == 1


def test_the_newest_command_wins() -> None:
    """A late packet never replaces a newer one that a step has read, and of two late packets the newer one is used."""
    node = masses("actuator")
    node.step(0, packets=[data(0, 0, 1.0)])
    node.step(2, packets=[data(2, 2, 3.0)])
    assert node.step(3).input == (3.0,)
    assert node.step(4, packets=[data(1, 1, 2.0)]).input == (3.0,)
    assert node.counters["late"] == 1
    assert node.step(6).input == (3.0,)
    saved = node.save()
    assert node.step(7, packets=[data(4, 4, 5.0), data(3, 3, 4.0)]).input == (5.0,)
    node.restore(saved)
    assert node.step(7, packets=[data(1, 5, 2.0)]).input == (3.0,)


def test_an_early_packet_is_dropped_when_its_sender_starts_again() -> None:
    """It is older than all that the sender sends since; C code is compared with this node elsewhere."""
    node = masses("actuator")
    node.step(0, packets=[data(0, 0, 1.0), data(2, 1, 9.0)])
    node.step(1, packets=[data(1, 0, 2.0, epoch=1)])
    assert node.counters["superseded"] == 1
    assert node.step(2).input == (2.0,)


def test_a_lost_packet_degrades_where_none_may_be_lost_until_it_is_forgotten() -> None:
    """A gap in the sequence is seen at the next packet; after seven time constants the node is whole again."""
    node = masses("actuator")
    node.step(0, packets=[data(0, 0)])
    node.step(1, packets=[data(1, 2)])
    assert node.degraded
    assert node.reasons == {"lost": 1}
    last = int(np.ceil(7 * node.policy.theory.settling)) + 2
    for tick in range(2, last + 1):
        node.step(tick)
    assert not node.degraded


def test_the_watchdog_makes_the_input_safe_and_lets_it_go() -> None:
    """After so many silent steps the input is the safe one; a mark ends the silence."""
    for safe, expected in (("hold", (2.0,)), ("zero", (0.0,)), ((-1.5,), (-1.5,))):
        node = masses("actuator", watchdog=3, safe=safe)
        node.step(0, packets=[data(0, 0, 2.0)])
        assert [node.step(tick).input for tick in (1, 2)] == [(2.0,)] * 2
        assert not node.silent
        assert node.step(3).input == expected
        assert node.silent
        assert node.degraded
        assert node.step(4).input == expected
        assert node.reasons["silent actuator"] == 1
        assert node.step(5, packets=[Packet("mark", "actuator", 5, 0)]).input == (2.0,)


def test_a_watchdog_without_a_safe_input_degrades_the_node_alone() -> None:
    """A controller and an actuator that continue with the policy's input report that they receive nothing."""
    model = taciturn.load("two-mass").design()
    for watchdog in (None, 3):
        actuator = Node(model, "actuator", watchdog=watchdog, safe=None)
        controller = Node(model, "controller")
        first = controller.step(0, [1.0, 0.5]).packets
        inputs = [actuator.step(0, packets=first).input, *(actuator.step(tick).input for tick in range(1, 8))]
        assert len(set(inputs)) == 8
        assert actuator.silent == actuator.degraded == (watchdog is not None)


def test_marks_are_sent_only_after_so_many_steps_without_a_packet() -> None:
    """Every third step without data, never next to data; without a number, after every step."""
    node = masses("controller")
    marks = []
    for tick in range(12):
        packets, _ = node.step(tick, [0.0, 0.0] if tick != 4 else [100.0, 0.0])
        marks.append((len(packets), len(node.mark(3))))
    sent = [tick for tick, (data_sent, _) in enumerate(marks) if data_sent]
    quiet = [tick for tick, (_, marked) in enumerate(marks) if marked]
    assert 4 in sent
    assert not set(sent) & set(quiet)
    events = sorted(sent + quiet)
    assert max(np.diff(events)) <= 3
    assert all(tick - max([at for at in events if at < tick], default=-3) >= 3 for tick in quiet)
    assert [len(node.mark()), len(node.mark())] == [1, 1]


def test_a_tick_is_gone_through_once() -> None:
    """A clock that goes back changes nothing."""
    node = masses("controller")
    first = node.step(5, measurement=[1.0, 0.0])
    before = node.save()
    assert node.step(5, measurement=[9.0, 0.0]).packets == ()
    assert node.step(2, measurement=[9.0, 0.0]).packets == ()
    after = node.save()
    assert first.packets
    apart = {"counters", "digest"}
    assert {k: v for k, v in after.items() if k not in apart} == {k: v for k, v in before.items() if k not in apart}
    assert after["counters"]["repeated"] == 2


@pytest.mark.parametrize("name", SOME)
def test_a_node_that_slept_makes_up_for_what_it_missed(name: str) -> None:
    """A node without a sensor that is called late ends where one ends that was called in time and heard nothing."""
    policy = build(name).policy
    role = roles(policy)[-1]
    prompt, slow = Node(policy, role), Node(policy, role)
    for tick in range(40):
        prompt.step(tick)
    slow.step(0)
    slow.step(39)
    assert slow.save()["memory"] == prompt.save()["memory"]
    assert slow.counters["missed"] == 38
    assert slow.degraded
    assert not prompt.degraded


@pytest.mark.parametrize(
    "name", ["lqg joint model", "remote", "lossy tcp, delayed", "stochastic", "rollout", "pattern"]
)
def test_a_saved_node_goes_on_as_if_nothing_had_happened(name: str) -> None:
    """State is saved as JSON and restored in a new node: the same packets and inputs follow."""
    import json

    loop = build(name)
    policy = loop.policy
    for role in roles(policy):
        node, draws = Node(policy, role, seed=3), np.random.default_rng(1)
        y = draws.standard_normal((60, policy.model.outputs))
        for tick in range(30):
            node.step(tick, y[tick] if node.measures else None)
        other = Node(policy, role, seed=99)
        other.restore(json.loads(json.dumps(node.save())))
        for tick in range(30, 60):
            measured = y[tick] if node.measures else None
            assert node.step(tick, measured) == other.step(tick, measured)


def test_what_is_no_state_of_this_node_is_refused() -> None:
    """The state of another role, of another policy, and what is none."""
    saved = masses("controller").save()
    with pytest.raises(ProblemError, match=r"role of the saved state is 'controller'; expected 'actuator'"):
        masses("actuator").restore(saved)
    with pytest.raises(ProblemError, match="fingerprint"):
        Node(taciturn.load("two-mass-lqg").changed({"theta": 0.2}).design(), "controller").restore(saved)
    with pytest.raises(ProblemError, match="not a saved state"):
        masses("controller").restore({**saved, "memory": []})


def test_bad_nodes_are_refused() -> None:
    """Roles that share a place, watchdogs without food, safe inputs of another size, measurements that are none."""
    with pytest.raises(ProblemError, match="site of the controller"):
        masses("sensor")
    with pytest.raises(ProblemError, match="not a role"):
        masses("pilot")
    with pytest.raises(ProblemError, match="receives no packets"):
        masses("controller", watchdog=3)
    with pytest.raises(ProblemError, match="1 finite numbers"):
        masses("actuator", safe=(1.0, 2.0))
    for measurement in ([1.0], [float("nan"), 0.0], [None, float("nan")]):
        with pytest.raises(ProblemError, match="2 finite numbers of at most"):
            masses("controller").step(0, measurement)
    with pytest.raises(ProblemError, match="nodes cannot evaluate"):
        taciturn.load("wiener-double-integrator").changed({"kind": "optimal", "theta": None, "price": 0.1}).design()


def test_nodes_that_cannot_be_separated_are_refused() -> None:
    """A link within one place, a signal that changes behind its packet."""
    from dataclasses import replace

    from taciturn.model.steps import Assign, Send

    policy = taciturn.load("lossy-double-integrator").design()
    together = replace(policy, sites=(frozenset({"controller", "actuator"}),))
    with pytest.raises(ProblemError, match="begins and ends at the same site"):
        Node(together, "controller")
    sent = next(i for i, step in enumerate(policy.steps) if isinstance(step, Send) and step.link == "actuator")
    changed = Assign("controller", "command", {"command": [[2.0]]})
    behind = replace(policy, steps=(*policy.steps[: sent + 1], changed, *policy.steps[sent + 1 :]))
    with pytest.raises(ProblemError, match="command changes between its Send"):
        Node(behind, "actuator")


def test_a_packet_that_is_read_before_it_is_sent_is_that_of_the_tick_before() -> None:
    """A delay as an order of steps: the loop and its nodes agree on it."""
    from taciturn import Policy, Trigger
    from taciturn.model.steps import Assign, Decide, Received, Send
    from taciturn.model.trigger import Form

    one = np.eye(1)
    steps = (
        Assign("actuator", "input", ({"input": 0.9 * one}, {"command": one}), Received("actuator")),
        Assign("controller", "command", {"y": -0.4 * one}),
        Decide("controller", "send", Trigger({"silent": Form(("command",), one), "send": Form(constant=0.01)})),
        Send("controller", "actuator", ("command",), "send"),
    )
    plant = Plant([[1.05]], [[1.0]], [[0.1]])
    policy = Policy("late", steps, plant, sites=(frozenset({"sensor", "controller"}),))
    assert_same(taciturn.close(plant, policy, Network("udp", 0.2), Cost(one, one)), 500, 1, fast=False)


def test_places_that_wait_for_each_other_are_refused() -> None:
    """A sensor and a pump in one process: its packet decides that of the controller, on which its input depends."""
    tank = taciturn.load("quadruple-tank").changed({"nodes.pump-1.site": "level-1"})
    policy = tank.design()
    assert Node(policy, "pump-1").actuates
    together = replace(policy, sites=policy.network.sites)
    with pytest.raises(ProblemError, match=r"within a step, .* and plc .* wait for packets of each other"):
        Node(together, "plc")


@pytest.mark.parametrize("name", few(["two-mass", "quadruple-tank", "pid-tank", "pendulum-by-encoders"], 1))
def test_nodes_compute_the_inputs_of_a_simulated_path_bit_for_bit(name: str) -> None:
    """From the recorded measurements: the record is that of the bit-exact build."""
    problem = taciturn.load(name)
    policy = problem.design()
    path, nodes = taciturn.simulate(problem.close(policy), 40, seed=1), taciturn.Nodes(policy, problem.network)
    applied = np.array([nodes.step(y) for y in path.measurement])
    assert applied.tobytes() == path.input.tobytes()
