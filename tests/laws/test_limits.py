"""Limits of the inputs and of their changes: whoever computes a step honours them, and no filter winds up."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from catalogue import POLICIES, closed
from counts import few
from drawn import law
from export.test_folders import AGREES, compile_check, run_check, write
from hypothesis import strategies as st
from runtime.loops import column, differing_ticks, record
from runtime.test_nodes import KEEPING, TANKS
from systems import System, systems

import taciturn
from taciturn import ContinuousPlant, Cost, Network, Plant, ProblemError, Reference, close, design
from taciturn.design.at_fixed_steps import sending_always
from taciturn.errors import TaciturnError
from taciturn.lqg.kalman import steady_filter
from taciturn.model.disturbance import follow
from taciturn.model.packets import fingerprint
from taciturn.model.signals import ExternalDisturbance, Timetable
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn.nodes.together import Nodes
from taciturn.program.ops import Entry
from taciturn_export.folder import print_folder

SEEDS = st.integers(0, 2**32 - 1)
MOVED = ("send-on-delta", "lossy udp")  # whose measurements or losses tell the filter something else
PLANT = Plant([[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]], 1e-3 * np.eye(2), [[1.0, 0.0]], [[1e-2]])
COST = Cost(np.diag([1.0, 0.1]), [[0.02]])
BOTH: dict[str, Any] = {"input_limit": [[-0.5, 1.0]], "input_rate": [0.4]}


def limited(plant: Plant, **limits: Any) -> Plant:
    """Return a plant with limits."""
    C, V = (None, None) if plant.full_state else (plant.C, plant.V)
    return Plant(plant.A, plant.B, plant.W, C, V, plant.dt, plant.mean, plant.covariance, **limits)


def errors(policy: taciturn.Policy, seed: int, ticks: int = 30) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of the estimate, and the inputs that are applied, on a given noise."""
    records, _ = record(closed(policy), ticks, seed)
    return column(records, "x") - column(records, "estimate"), column(records, "applied")


@law(4, 60, system=systems(), name=st.sampled_from(sorted(POLICIES)), seed=SEEDS, rated=st.booleans())
def test_the_error_of_a_filter_does_not_depend_on_limits(system: System, name: str, seed: int, rated: bool) -> None:
    """Every policy of the catalogue, unstable plants and cross terms: the filter is told the input that is applied."""
    try:
        free, applied = errors(POLICIES[name](system), seed)
        size = max(float(np.quantile(np.abs(applied), 0.6)), 1e-2)
        sides: dict[str, Any] = {"input_limit": [[-size, 2 * size]] * system.plant.inputs}
        limits = {**sides, "input_rate": [size] * system.plant.inputs} if rated else sides
        policy = POLICIES[name](replace(system, plant=limited(system.plant, **limits)))
    except TaciturnError:
        return
    loop = closed(policy)
    records, draws = record(loop, 30, seed)
    error, applied = column(records, "x") - column(records, "estimate"), column(records, "applied")
    assert applied.min() >= -size
    assert applied.max() <= 2 * size
    assert not rated or np.abs(np.diff(applied, axis=0, prepend=0.0)).max() <= size * (1 + 1e-12)
    assert differing_ticks(loop, records, draws)[0] == []
    if not name.startswith(MOVED):
        assert error == pytest.approx(free, abs=1e-9 * (np.abs(column(records, "x")).max() + 1))


def test_the_covariance_of_the_error_is_that_of_the_kalman_filter() -> None:
    """Under a limit that binds half of the time; without anti-windup the error is many times larger."""
    plant = limited(PLANT, input_limit=[[-0.15, 0.1]])
    expected = steady_filter(PLANT.A, PLANT.C, PLANT.W, PLANT.V).posterior
    found = dict[str, np.ndarray]()
    for name, designed in {"told": plant, "wound up": PLANT}.items():
        loop = close(plant, design.excess(designed, COST, delta=1e-3))
        outputs, _ = record(loop, 400, 3, 100)
        x, estimate = (np.array([outputs[Entry(signal, i)] for i in range(2)]) for signal in ("x", "estimate"))
        difference = x - estimate
        found[name] = np.einsum("itp,jtp->pij", difference[:, 100:], difference[:, 100:]) / 300
    mean, spread = found["told"].mean(axis=0), found["told"].std(axis=0, ddof=1) / 10
    assert (np.abs(mean - expected) <= 4.5 * spread).all()
    assert np.trace(found["wound up"].mean(axis=0)) > 3 * np.trace(expected)


NETWORKS = {
    **{f"kept: {name}": ("pid-tank", change) for name, change in KEEPING.items()},
    **{name: ("quadruple-tank", change) for name, change in TANKS.items()},
}
SIDES = {
    "pid-tank": {"plant.input_limit": [[-0.1, 0.25]], "plant.input_rate": [0.2]},
    "quadruple-tank": {"plant.input_limit": [[-0.2, 0.3], 0.25], "plant.input_rate": [0.1, 1.0]},
}


@pytest.mark.parametrize("name", few(NETWORKS, 3))
def test_nodes_of_given_controllers_and_of_several_links_honour_limits(name: str) -> None:
    """One-sided limits and limited changes, which bind, in nodes that run apart."""
    base, change = NETWORKS[name]
    loop = (problem := taciturn.load(base).changed({**change, **SIDES[base]})).close(problem.design())
    records, draws = record(loop, 150, 1)
    applied = column(records, "applied")
    limits = loop.problem.plant.saturation
    assert limits is not None
    assert (applied >= limits.low).all()
    assert (applied <= limits.high).all()
    assert ((applied == limits.low) | (applied == limits.high)).any()
    assert differing_ticks(loop, records, draws)[0] == []


@pytest.mark.parametrize("name", few(["excess", "model", "kept", "distributed", "lossy", "sets"], 1))
def test_nodes_in_c_honour_limits(name: str, tmp_path: Path) -> None:
    """Every bit of the input is that of the loop."""
    base, change = {
        "kept": ("pid-tank", {"controller.pid.setpoint": 2.0, "controller.pid.tracking_time": 2.0}),
        "distributed": ("quadruple-tank", {}),
        "sets": ("quadruple-tank", TANKS["tank, sets of links"]),
    }.get(name, ("", {}))
    if base:
        sides = {**SIDES[base], "plant.input_limit": [[-0.1, 0.8]]} if name == "kept" else SIDES[base]
        loop = (problem := taciturn.load(base).changed({**change, **sides})).close(problem.design())
    elif name == "lossy":
        plant = Plant(PLANT.A, PLANT.B, PLANT.W, **BOTH)
        network = Network("tcp", 0.3, 0.2)
        loop = closed(design.lossy_lqg(plant, Cost(COST.Q, COST.R), price=1e-3, network=network))
    else:
        actuation = "model" if name == "model" else "hold"
        loop = closed(design.excess(limited(PLANT, **BOTH), COST, delta=1e-3, actuation=actuation))
    check = compile_check(write(tmp_path, print_folder(loop, "limited", rows=200)))
    assert run_check(check) == (0, f"limited: 200 {AGREES}")


@pytest.mark.parametrize("actuation", ["hold", "model"])
def test_a_symmetric_limit_is_the_pair_of_its_numbers(actuation: str) -> None:
    """The same fingerprint, packets and bits."""
    found = list[tuple[int, bytes]]()
    for limit in ([0.2], [[-0.2, 0.2]]):
        policy = design.lqg(limited(PLANT, input_limit=limit), COST, theta=0.1, actuation=actuation)
        path = taciturn.simulate(closed(policy), 200, seed=2)
        found.append((fingerprint(policy, policy.network), path.input.tobytes() + path.state.tobytes()))
    assert found[0] == found[1]
    other = design.lqg(limited(PLANT, input_limit=[[-0.2, np.inf]]), COST, theta=0.1, actuation=actuation)
    slow = design.lqg(limited(PLANT, input_limit=[0.2], input_rate=[0.2]), COST, theta=0.1, actuation=actuation)
    assert len({fingerprint(policy, policy.network) for policy in (other, slow)} | {found[0][0]}) == 3


def test_a_limit_that_never_binds_changes_no_input() -> None:
    """Over every policy that is told so, to rounding."""
    for actuation in ("hold", "model"):
        paths = [
            taciturn.simulate(closed(design.excess(plant, COST, delta=1e-3, actuation=actuation)), 200, seed=1)
            for plant in (PLANT, limited(PLANT, input_limit=[1e3], input_rate=[1e3]))
        ]
        assert paths[0].input == pytest.approx(paths[1].input, abs=1e-9)
        assert (paths[0].sends["actuator"] == paths[1].sends["actuator"]).all()


def test_nothing_is_sent_that_would_change_no_input() -> None:
    """At its limit, an actuator needs no packet that tells it to go further."""
    pushed = Plant(PLANT.A, PLANT.B, 1e-9 * PLANT.W, PLANT.C, [[1e-9]], mean=[50.0, 0.0], input_limit=[1.0])
    path = taciturn.simulate(closed(design.excess(pushed, COST, delta=1e-6)), 40, seed=1)
    assert (path.input == -1.0).all()
    assert path.sends["actuator"].sum() == 1


def test_inputs_start_within_limits_that_exclude_zero() -> None:
    """The input before the start is the limit next to 0; what applies 0 in silence is refused."""
    plant = limited(PLANT, input_limit=[[0.5, 2.0]], input_rate=[0.1])
    path = taciturn.simulate(closed(design.excess(plant, COST, delta=10.0)), 20, seed=1)
    assert (path.input == 0.5).all()
    full = Plant(PLANT.A, PLANT.B, PLANT.W, input_limit=[[0.5, 2.0]])
    words = (
        r"lossy-lqg applies 0 if no packet arrives, but input_limit is \[\[0.5, 2.0\]\]; expected limits that contain 0"
    )
    with pytest.raises(ProblemError, match=words):
        design.lossy_lqg(full, Cost(COST.Q, COST.R), price=1.0)
    slow = Plant(PLANT.A, PLANT.B, PLANT.W, input_rate=[1.0])
    with pytest.raises(
        ProblemError, match=r"plant.input_rate is given, but network.actuator_loss is 0.3, and no packet is"
    ):
        design.lossy_lqg(slow, Cost(COST.Q, COST.R), price=1.0, network=Network("udp", 0.3))


@pytest.mark.parametrize("protocol", ["udp", "tcp"])
def test_a_reference_leaves_the_filter_exact_under_limits(protocol: Any) -> None:
    """The feedforward is a part of the input that is limited; no packet of the actuator is dropped."""
    A, B, ticks = PLANT.A, PLANT.B, 25
    states, inputs = np.zeros((ticks + 1, 2)), 0.4 * np.ones((ticks, 1))
    for k in range(ticks):
        states[k + 1] = A @ states[k] + B @ inputs[k]
    cost, network = Cost(COST.Q, COST.R, horizon=ticks), Network(protocol, 0.0, 0.4)
    found = list[np.ndarray]()
    for limits in ({}, {"input_limit": [[-0.3, 0.5]]}):
        plant = Plant(A, B, 30 * PLANT.W, **limits)
        policy = design.lossy_lqg(plant, cost, price=1e-4, network=network, reference=Reference(states, inputs))
        loop = closed(policy)
        records, draws = record(loop, ticks, 2)
        assert differing_ticks(loop, records, draws)[0] == []
        found.append(column(records, "x") - column(records, "estimate"))
    assert (column(records, "applied") == 0.5).any()
    assert found[0] == pytest.approx(found[1], abs=1e-12)


def test_a_rate_of_change_of_a_continuous_plant_is_per_second() -> None:
    """A policy that samples twice as often may move the input by half as much per step."""
    plant = ContinuousPlant([[0.0]], [[1.0]], [[0.1]], C=[[1.0]], V=[[1e-3]], mean=[9.0], input_rate=[2.0])
    for period in (0.1, 0.05):
        path = taciturn.simulate(
            close(plant, design.excess(plant, Cost([[1.0]], [[0.1]]), delta=1e-3, period=period)), 20, seed=1
        )
        assert np.abs(np.diff(path.input[:, 0], prepend=0.0)).max() == pytest.approx(2.0 * period)
    with pytest.raises(
        ProblemError, match=r"input_rate is \[2.0\], but the input of this policy changes between steps"
    ):
        design.periodic(
            ContinuousPlant([[0.0]], [[1.0]], [[0.1]], input_rate=[2.0]), Cost([[1.0]], [[0.1]]), period=0.1,
            actuation="model",
        )  # fmt: skip


@pytest.mark.parametrize("name", few(["excess", "model", "distributed", "remote", "kept", "kept at a set-point"], 4))
def test_a_filter_that_is_told_what_was_applied_is_that_of_a_plant_with_this_limit(name: str) -> None:
    """Nodes of an unlimited design, told the clipped inputs, estimate as nodes that know the limit."""
    limit, ticks = 0.1, 40
    pid = taciturn.PID(1.2, 0.15, 1.0, 0.5, setpoint=0.5 if "set-point" in name else 0.0, tracking_time=1.0)
    build: dict[str, Any] = {
        "excess": lambda plant: design.excess(plant, COST, delta=0.0),
        "model": lambda plant: design.excess(plant, COST, delta=0.0, actuation="model"),
        "distributed": lambda plant: design.distributed(plant, COST, theta=0.0),
        "remote": lambda plant: design.remote_lqg(plant, COST, theta=0.0, zeta=0.0),
    }
    make = build.get(name, lambda plant: sending_always(design.excess(plant, COST, delta=0.0, controller=pid)))
    plant = Plant(PLANT.A, PLANT.B, PLANT.W, PLANT.C, PLANT.V, dt=0.1)
    knows, told = (Nodes(make(one)) for one in (limited(plant, input_limit=[limit]), plant))
    draws, applied = np.random.default_rng(2).normal(0.0, 0.5, (ticks, 1)), None
    inputs = []
    for y in draws:
        expected = knows.step(y)
        applied = np.clip(told.step(y, applied=applied), -limit, limit)
        inputs.append((expected[0], applied[0]))
    assert np.array(inputs)[:, 1] == pytest.approx(np.array(inputs)[:, 0], abs=1e-9)
    assert 0.1 < (np.abs(np.array(inputs)[:, 0]) == limit).mean() < 1


def test_an_applied_input_that_nobody_uses_is_refused() -> None:
    """In the first step, of a wrong size, and for nodes without a copy."""
    nodes = Nodes(design.excess(PLANT, COST, delta=0.1))
    with pytest.raises(
        ProblemError, match="the argument 'applied' is given, in the first step; expected no such argument"
    ):
        nodes.step([0.0], applied=[0.0])
    nodes.step([0.0])
    with pytest.raises(ProblemError, match=r"applied has shape \(2,\); expected the shape \(1,\) = \(inputs,\)"):
        nodes.step([0.0], applied=[0.0, 1.0])
    full = Nodes(design.excess(Plant(PLANT.A, PLANT.B, PLANT.W), COST, delta=0.1))
    full.step([0.0, 0.0])
    with pytest.raises(
        ProblemError, match="the argument 'applied' is given, and no filter of excess has a copy of the input"
    ):
        full.step([0.0, 0.0], applied=[0.0])


@pytest.mark.evidence
def test_an_evaluation_shows_the_loop_without_limits() -> None:
    """Its cost and bound are those of the problem without the key; the share at the limit is that of a path."""
    problem = taciturn.load("pid-tank").changed({"plant.input_limit": [[-0.08, 0.05]]})
    found, free = (taciturn.evaluate(one, steps=400_000) for one in (problem, taciturn.load("pid-tank")))
    beside = found.without_limits
    assert free.without_limits is None
    assert beside is not None
    assert found.cost_bound is None
    assert beside.cost == free.cost
    assert beside.cost_bound == free.cost_bound
    assert beside.rates == free.rates
    path = taciturn.simulate(problem.close(problem.design()), 20_000, seed=1)
    at = ((path.input[:, 0] <= -0.08) | (path.input[:, 0] >= 0.05)).astype(float)
    parts = at.reshape(20, 1000).mean(axis=1)
    assert abs(parts.mean() - beside.share.value) <= 5 * (parts.std() / np.sqrt(20) + beside.share.standard_error)
    told = found.document()
    assert told["share_at_limit"]["value"] == beside.share.value
    assert told["without_limits"]["cost_bound"] == free.cost_bound
    assert "a limit binds in" in str(found)
    bare = taciturn.evaluate(design.excess(limited(PLANT, input_rate=[0.1]), COST, delta=1e-3), steps=100_000)
    assert bare.without_limits is not None
    assert bare.without_limits.cost is None
    assert 0 < bare.without_limits.share.value < 1


def test_no_share_of_the_steps_at_a_limit_is_shown_if_disturbances_wander_beyond_it() -> None:
    """The first steps seldom reach a limit, and in the end all do: neither is an average."""
    push = ExternalDisturbance([0.5], 1e-4, "ramp")
    plant = follow(Plant([[0.9]], [[0.5]], [[0.01]], [[1.0]], [[0.01]], 1.0, input_limit=[50.0]), disturbances=push)
    found = taciturn.evaluate(design.excess(plant, Cost([[1.0]], [[0.2]]), delta=0.1), steps=20_000)
    assert found.without_limits is not None
    assert found.without_limits.share is None
    assert found.document()["share_at_limit"] is None
    assert "the share of the steps in which a limit binds has no average" in " ".join(str(found).split())


def test_the_share_of_the_steps_at_a_limit_is_that_of_all_parts_of_a_timetable() -> None:
    """One level of two needs nearly all of the input; each lasts longer than the steps that are counted."""
    levels = Timetable([0, 1000, 2000], [[0.0], [1.0], [0.0]])
    plant = Plant(
        [[0.9, 0.0], [0.1, 0.9]], [[0.2], [0.0]], 1e-3 * np.eye(2), [[0.0, 1.0]], [[4e-3]], input_limit=[[-0.45, 0.55]]
    )
    policy = design.excess(follow(plant, changes=levels), Cost(np.diag([0.0, 1.0]), [[0.2]]), delta=0.004)
    found = taciturn.evaluate(policy, steps=20_000).without_limits
    assert found is not None
    assert found.share is not None
    path = taciturn.simulate(policy, 20_000, seed=1).input[:, 0]
    at = ((path <= -0.45) | (path >= 0.55)).reshape(10, 2000).mean(axis=1)
    error = np.hypot(at.std(ddof=1) / np.sqrt(10), found.share.standard_error)
    assert at.mean() > 0.1
    assert abs(found.share.value - at.mean()) < 4 * error


@pytest.mark.evidence
def test_nodes_over_udp_and_their_plant_honour_limits() -> None:
    """The costs of a run of processes are those of the nodes in memory."""
    run = taciturn.run_network(taciturn.load("pid-tank").changed(SIDES["pid-tank"]), steps=60, seed=1)
    plant, nodes = SimulatedPlant(run.loop, seed=1), Nodes(run.loop.policy)
    assert [plant.move(nodes.step(plant.measurement)) for _ in range(60)] == list(run.costs)


def test_certificates_refuse_limits_by_name() -> None:
    """The limit is named, not the function that computes it."""
    for limits, words in (
        ({"input_limit": [1.0]}, r"inputs are clipped \(input_limit\), which certificates do not support"),
        ({"input_rate": [1.0]}, r"the changes of the inputs are limited \(input_rate\), which certificates do not"),
    ):
        with pytest.raises(ProblemError, match=words):
            taciturn.certify(design.excess(limited(PLANT, **limits), COST, delta=0.1))
