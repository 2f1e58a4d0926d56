"""Nodes in a loop of one's own: outputs that are not measured, packets of a real network, and how a loop starts."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from catalogue import POLICIES, closed
from counts import few
from scipy.linalg import solve_discrete_are
from systems import make_system

import taciturn
from taciturn import PID, ContinuousPlant, Cost, Loop, Network, Nodes, Plant, ProblemError, close, design
from taciturn.base.certainty import design_certainty
from taciturn.lqg.discrete import discretise
from taciturn.model.disturbance import follow
from taciturn.model.signals import ExternalDisturbance
from taciturn.model.steps import Received
from taciturn.nodes.node import Node
from taciturn.problem import parse
from taciturn.program.numpy import run
from taciturn.program.ops import Entry

SYSTEM = make_system(7, 3, 2, 2, False)
TICKS = 120


def recorded(loop: Loop, seed: int, ticks: int = TICKS) -> tuple[np.ndarray, np.ndarray, list[dict[str, bool]]]:
    """Return measurements, inputs and arrivals of a simulated loop, by step, with the bits of NumPy."""
    program = loop.program()
    ticks = min(ticks, loop.horizon or ticks)
    found = run(program, loop.start(program, 1, seed), ticks).outputs
    y, u = (
        np.array(
            [values[:, 0] for name, values in found.items() if isinstance(name, Entry) and name.signal == signal]
        ).T
        for signal in ("y", "applied")
    )
    arrived = {name.link: values[:, 0] > 0 for name, values in found.items() if isinstance(name, Received)}
    return y, u, [{link: bool(flags[k]) for link, flags in arrived.items()} for k in range(ticks)]


@pytest.mark.parametrize("delta", [0.0, 0.5])
def test_an_output_that_is_not_measured_is_predicted(delta: float) -> None:
    """Against a filter in NumPy whose innovation of a missing output is zero, with held inputs."""
    plant, draws = SYSTEM.plant, np.random.default_rng(1)
    found = design_certainty("excess", discretise(plant, SYSTEM.cost, None))
    L, H, gain = found.regulator.L, found.regulator.H, found.filter.gain
    nodes = Nodes(design.excess(plant, SYSTEM.cost, delta=delta))
    prior, held, sends = np.zeros(3), np.zeros(2), 0
    for k in range(TICKS):
        y = draws.standard_normal(2)
        missing = draws.random(2) < 0.4
        given = None if missing.all() else [None if absent else value for absent, value in zip(missing, y, strict=True)]
        u = nodes.step(given if k % 3 else (given and tuple(given)))
        estimate = prior + gain @ np.where(missing, 0.0, y - plant.C @ prior)
        error = held - L @ estimate
        held = L @ estimate if error @ H @ error > delta else held
        prior = plant.A @ estimate + plant.B @ held
        assert np.abs(u - held).max() <= 1e-9 * max(1.0, np.abs(held).max())
        sends += nodes.sent["actuator"]
    assert 0 < sends <= TICKS


def test_sensors_without_the_filter_hold_their_last_measurement() -> None:
    """Sensors that send contributions to the estimate do not know the prediction: the bits of the held samples."""
    policy = taciturn.load("quadruple-tank").changed({"theta": 0.0}).design()
    some, whole, held, draws = Nodes(policy), Nodes(policy), np.zeros(2), np.random.default_rng(2)
    for _ in range(40):
        y, missing = draws.standard_normal(2), draws.random(2) < 0.5
        held = np.where(missing, held, y)
        u = some.step([None if absent else value for absent, value in zip(missing, y, strict=True)])
        assert np.array_equal(u, whole.step(held))


@pytest.mark.parametrize("name", few([*POLICIES], 8, 3))
def test_fates_repeat_a_recorded_trajectory_bit_for_bit(name: str) -> None:
    """Whatever the losses of the nodes themselves are; policies with draws of their own repeat those of their seed."""
    loop = closed(POLICIES[name](make_system(11, 3, 2, 2, "lossy" in name)))
    y, applied, arrived = recorded(loop, 3)
    if name.startswith("stochastic"):  # its thresholds are drawn
        return
    lossy = loop.network.links["actuator"].ideal
    nodes = Nodes(loop.policy, loop.network if lossy else loop.network.with_laws({"loss": 0.9}), seed=8)
    for measured, fates, u in zip(y, arrived, applied, strict=True):
        assert np.array_equal(nodes.step(measured, fates=fates), u)
        assert nodes.arrived == fates


def test_packets_of_a_link_that_is_assumed_ideal_may_be_dropped() -> None:
    """The bits of the same policy over a network that drops packets; links without a fate are drawn."""
    policy = design.distributed(SYSTEM.plant, SYSTEM.cost, theta=0.3)
    y, applied, arrived = recorded(close(SYSTEM.plant, policy, Network("udp", 0.4, 0.2)), 5)
    nodes = Nodes(policy)
    for measured, fates, u in zip(y, arrived, applied, strict=True):
        assert np.array_equal(nodes.step(measured, fates=fates), u)
    assert not all(flag for fates in arrived for flag in fates.values())
    alike, drawn = (Nodes(policy, Network("udp", 0.4, 0.2), seed=2) for _ in range(2))
    for measured in y:
        drawn.step(measured)
        alike.step(measured, fates={"sensor": drawn.arrived["sensor"]})
        assert alike.arrived == drawn.arrived


@pytest.mark.parametrize("mean", [[0.0, 0.0, 0.0], [0.5, -1.0, 2.0]])
def test_an_initial_estimate_is_that_of_a_design_with_this_mean(mean: list[float]) -> None:
    """Bit for bit, for a problem with and without another mean; a reset returns to it."""
    p, estimate = SYSTEM.plant, [1.0, 2.0, -3.0]
    first, other = (
        design.excess(Plant(p.A, p.B, p.W, p.C, p.V, mean=at), SYSTEM.cost, delta=0.5) for at in (mean, estimate)
    )
    nodes, expected, draws = Nodes(first, estimate=estimate), Nodes(other), np.random.default_rng(0)
    y = draws.standard_normal((50, 2))
    rows = [nodes.step(one) for one in y]
    assert np.array_equal(rows, [expected.step(one) for one in y])
    assert not np.array_equal(rows[0], Nodes(first).step(y[0]))
    nodes.reset()
    assert (nodes.tick, nodes.sent, nodes.arrived) == (0, {}, {})
    assert np.array_equal(rows, [nodes.step(one) for one in y])


def test_a_reset_repeats_losses_and_draws() -> None:
    """As if the nodes had just been made."""
    policy = design.lossy_lqg(Plant(SYSTEM.plant.A, SYSTEM.plant.B, SYSTEM.plant.W), Cost(np.eye(3), np.eye(2)),
                              price=0.1, network=Network("udp", 0.1, 0.1))  # fmt: skip
    nodes, y = Nodes(policy, seed=4), np.random.default_rng(1).standard_normal((30, 3))
    rows = [(*nodes.step(one), *nodes.arrived.values()) for one in y]
    nodes.reset()
    assert rows == [(*nodes.step(one), *nodes.arrived.values()) for one in y]


def steady_tanks(**more: Any) -> taciturn.Policy:
    """Return the policy of the four tanks with a constant disturbance at each pump and set-points."""
    problem = taciturn.load("quadruple-tank")
    B = problem.plant.B
    leaks = [ExternalDisturbance(B[:, i], wander=1e-4) for i in range(2)]
    plant = follow(problem.plant, [[1.0, 0, 0, 0], [0, 1.0, 0, 0]], [0.3, -0.2], leaks)
    changed = replace(problem.changed(more), plant=plant)
    policy = changed.design()
    assert isinstance(policy, taciturn.Policy)
    return policy


@pytest.mark.parametrize("actuation", ["hold", "model"])
def test_a_loop_takes_over_from_an_input_without_a_jump(actuation: str) -> None:
    """The estimates of the constant disturbances are those for which the first command is the input so far."""
    u, x = [1.5, -0.7], [0.2, 0.1, -0.3, 0.4]
    policy = steady_tanks(actuation=actuation)
    n = policy.model.states
    estimate = np.concatenate([x, policy.model.mean[4:]])
    nodes = Nodes(policy, estimate=estimate, start_input=u)
    assert nodes.notes == ()
    assert np.allclose(nodes.step([None, None]), u, rtol=1e-9)
    assert n > 4
    without = Nodes(policy, estimate=estimate)
    assert not np.allclose(without.step([None, None]), u, rtol=1e-2)


def test_without_a_constant_disturbance_only_the_held_input_starts() -> None:
    """A note states the first command; the held input is the one before, until a packet is worth its cost."""
    policy = design.excess(SYSTEM.plant, SYSTEM.cost, delta=1e6)
    nodes = Nodes(policy, start_input=[0.5, -0.5])
    assert nodes.step([0.0, 0.0]).tolist() == [0.5, -0.5]
    assert "no constant disturbances that account for start_input, so the first command is [0.0, 0.0]" in nodes.notes[0]
    measured = design.excess(Plant(SYSTEM.plant.A, SYSTEM.plant.B, SYSTEM.plant.W), SYSTEM.cost, delta=1e6)
    nodes = Nodes(measured, start_input=[0.5, -0.5])
    assert nodes.step([0.0, 0.0, 0.0]).tolist() == [0.5, -0.5]
    assert "first command depends on the first measurement" in nodes.notes[0]


def test_what_nodes_cannot_do_is_refused_in_one_sentence() -> None:
    """By the name of the kind, the link, the key or the size."""
    policy = design.excess(SYSTEM.plant, SYSTEM.cost, delta=0.5)
    nodes = Nodes(policy)
    exact = Plant(SYSTEM.plant.A, SYSTEM.plant.B, SYSTEM.plant.W)
    for measurement, expected in (
        ([1.0], r"measurement has shape \(1,\); expected the shape \(2,\)"),
        ([None, None, None], r"measurement has shape \(3,\)"),
        (
            [None, float("nan")],
            r"measurement contains the number nan at index \(1,\); expected an array of finite numbers",
        ),
        ([None, "high"], "measurement"),
    ):
        with pytest.raises(ProblemError, match=expected):
            nodes.step(measurement)  # type: ignore[arg-type]
    with pytest.raises(
        ProblemError, match=r"'fates' names the link 'sensor'; expected links on which .* sends: actuator$"
    ):
        nodes.step([0.0, 0.0], fates={"sensor": True})
    with pytest.raises(ProblemError, match=r"fates\['actuator'\] is 1; expected true or false"):
        nodes.step([0.0, 0.0], fates={"actuator": 1})  # type: ignore[dict-item]
    assert nodes.tick == 0
    with pytest.raises(ProblemError, match="this excess policy does not compute its commands from a filter's estimate"):
        Nodes(design.excess(exact, SYSTEM.cost, delta=0.5), estimate=[0.0, 0.0, 0.0])
    tank = taciturn.load("pid-tank").design()
    with pytest.raises(ProblemError, match="this excess policy does not compute its commands from a filter's estimate"):
        Nodes(tank, estimate=np.zeros(tank.model.states))
    with pytest.raises(ProblemError, match=r"estimate has shape \(2,\); expected the shape \(3,\)"):
        Nodes(policy, estimate=[0.0, 0.0])
    with pytest.raises(ProblemError, match=r"start_input has shape \(1,\); expected the shape \(2,\)"):
        Nodes(policy, start_input=[0.0])
    with pytest.raises(ProblemError, match="start_input is given, but this excess policy uses a given controller"):
        Nodes(taciturn.load("pid-tank").design(), start_input=[0.1])
    p = SYSTEM.plant
    clipped = design.excess(Plant(p.A, p.B, p.W, p.C, p.V, input_limit=[1.0, 1.0]), SYSTEM.cost, delta=0.5)
    with pytest.raises(ProblemError, match="beyond the input_limit"):
        Nodes(clipped, start_input=[2.0, 0.0])


TANK = {
    "plant": {
        "A": [[1.0, 0.1], [0.0, 0.9]], "B": [[0.0], [0.1]], "C": [[1.0, 0.0]],
        "W": [[1e-4, 0.0], [0.0, 4e-4]], "V": [[1e-3]], "dt": 0.1,
    },
    "cost": {"Q": [[1.0, 0.0], [0.0, 0.0]], "R": [[0.05]]},
    "reference": {"value": [3.0], "steps": {"rate": 0.01, "covariance": [[4.0]]}},
    "nodes": {"probe": {"measures": True, "site": "box"}, "box": {"controls": True}, "valve": {"applies": True}},
    "policy": {"kind": "distributed", "theta": 0.5},
}  # fmt: skip


def test_the_filter_uses_the_input_that_was_applied_also_with_changing_set_points() -> None:
    """The predictions are those of a Kalman filter in NumPy; the entry of the set-point is no memory of the nodes."""
    policy, draws = parse(TANK, "tank").design(), np.random.default_rng(7)
    A, B, C = (np.array(TANK["plant"][name]) for name in ("A", "B", "C"))  # type: ignore[index]
    W, V = (np.array(TANK["plant"][name]) for name in ("W", "V"))  # type: ignore[index]
    P = solve_discrete_are(A.T, C.T, W, V)
    K = P @ C.T / (C @ P @ C.T + V)
    nodes, expected, u, given = Nodes(policy), np.zeros(2), np.zeros(1), np.zeros(1)
    places = [nodes.turns.states.index(f"prior[{i}]") for i in range(2)]
    assert "prior[2]" not in nodes.turns.states
    for tick in range(60):
        told = tick > 0 and tick % 3 != 1
        expected = expected + B @ (given - u if told else np.zeros(1))
        y = draws.normal(size=1)
        u = nodes.step(y, reference=draws.normal(size=1) if tick % 5 == 0 else None, applied=given if told else None)
        expected = A @ (expected + K @ (y - C @ expected)) + B @ u
        assert [nodes._memory[i] for i in places] == pytest.approx(expected, abs=1e-9)
        given = draws.normal(size=1)


@pytest.mark.parametrize("kind", ["distributed", "excess"])
def test_an_applied_input_that_is_the_returned_one_changes_no_bit(kind: str) -> None:
    """With several nodes and with three."""
    tables = TANK if kind == "distributed" else {k: v for k, v in TANK.items() if k != "nodes"}
    policy = parse({**tables, "policy": {"kind": kind, "theta": 0.5}}, "tank").design()
    told, alone, u = Nodes(policy), Nodes(policy), None
    for y in np.random.default_rng(1).normal(size=(50, 1)):
        u, expected = told.step(y, applied=u), alone.step(y)
        assert u.tobytes() == expected.tobytes()
        assert told._memory == alone._memory


def test_nodes_are_pickled_with_their_state() -> None:
    """All nodes in one object, and a single one; copies go on alike."""
    policy, draws = parse(TANK, "tank").design(), np.random.default_rng(2)
    nodes, node = Nodes(policy, seed=3), Node(policy, "box")
    for tick in range(20):
        y = draws.normal(size=1)
        nodes.step(y)
        node.step(tick, y)
    again, other = pickle.loads(pickle.dumps(nodes)), pickle.loads(pickle.dumps(node))
    for tick in range(20, 40):
        y = draws.normal(size=1)
        assert again.step(y).tobytes() == nodes.step(y).tobytes()
        assert other.step(tick, y) == node.step(tick, y)
    assert (again.tick, again.sent) == (nodes.tick, nodes.sent)


@pytest.mark.parametrize("D", [None, [[0.5]]])
def test_policies_of_sampled_plants_with_a_given_controller_are_pickled(D: list[list[float]] | None) -> None:
    """The design keeps its problem to any precision."""
    plant = ContinuousPlant([[0, 1], [0, -1]], [[0], [1]], 0.1 * np.eye(2), C=[[1, 0]], V=[[0.01]], D=D)
    policy = design.excess(plant, Cost(np.eye(2), [[1.0]]), period=0.1, theta=0.2, controller=PID(1.0, 0.2))
    nodes, again = Nodes(policy), Nodes(pickle.loads(pickle.dumps(policy)))
    for y in np.random.default_rng(1).normal(size=(20, 1)):
        assert nodes.step(y).tobytes() == again.step(y).tobytes()


def test_results_that_are_too_large_are_refused_and_leave_the_nodes_as_they_were() -> None:
    """And a number that no packet carries does not enter."""
    policy = design.excess(Plant([[1.2]], [[1e-3]], [[1.0]], [[1.0]], [[0.1]]), Cost([[1.0]], [[1e-9]]), delta=0.1)
    nodes, alone = Nodes(policy), Nodes(policy)
    for tick in range(10):
        for y in ([1.7e308], [float("nan")]):
            with pytest.raises(ProblemError, match="expected"):
                nodes.step(y)
        if tick == 5:
            with pytest.raises(ProblemError, match="hold the last input, or reset the nodes"):
                nodes.step([3.4e38])
        assert nodes.step([1.0]).tobytes() == alone.step([1.0]).tobytes()


def test_nodes_of_a_problem_have_its_network() -> None:
    """Rounded payloads of the file, which the design of the policy does not know; so has a loop, and not a policy."""
    for name in ("two-mass-lqg", "pid-tank"):
        problem = taciturn.load(name).changed({"network.payload": "int16", "network.actuator_range": 10.0})
        loop = problem.close(problem.design())
        path = taciturn.simulate(loop, TICKS, seed=3)
        for one in (problem, loop):
            nodes = Nodes(one, seed=3)
            assert nodes.network.payload == "int16"
            assert np.array_equal([nodes.step(y) for y in path.measurement], path.input)
        if name == "pid-tank":  # excess is designed for numbers that are not rounded
            alone = Nodes(problem.design(), seed=3)
            assert alone.network.payload == "float64"
            assert not np.array_equal([alone.step(y) for y in path.measurement], path.input)
        with pytest.raises(ProblemError, match="is given with a problem or a loop, which has its own network"):
            Nodes(problem, Network())
    with pytest.raises(ProblemError, match="policy is 'lqg'; expected a Policy"):
        Nodes("lqg")  # type: ignore[arg-type]
