"""The value of a base for every pattern of attempts, link and cost: two computations, identity and bound."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from catalogue import outputs
from laws.test_given_controllers import random_loop
from laws.test_lossy_controllers import forward_cost, random_network

import taciturn
from taciturn import ContinuousPlant, Controller, Cost, Disturbance, Network, Plant, ProblemError, UnstableError, design
from taciturn.base.certainty import design_certainty
from taciturn.base.gains import price_control
from taciturn.base.route import actuator_base, predicting_actuator, predicting_controller, sensor_base
from taciturn.base.value import Attempts, Base, advantage, cost_of_one_packet, critical_scale
from taciturn.design.at_fixed_steps import sending_always
from taciturn.design.prediction import predict_continuously
from taciturn.lqg.discrete import discretise
from taciturn.lqg.kalman import steady_filter
from taciturn.model.operating_point import OperatingPoint
from taciturn.program.ops import Sent
from taciturn.simulation.average import average

ACTUATIONS = ("hold", "model", "zero")


def bases(seed: int) -> tuple[Base, ...]:
    """Return the bases of a random loop, for both links: receivers that hold, predict or apply 0."""
    plant, cost, kept = random_loop(seed)
    problem, steady = discretise(plant, cost, None), steady_filter(plant.A, plant.C, plant.W, plant.V)
    held = actuator_base(problem, kept)
    zero = replace(held, candidate=np.zeros((len(held.K), len(held.silent))))
    return held, zero, predicting_actuator(problem, held, steady), sensor_base(problem, kept), (
        predicting_controller(problem, kept, steady)
    )  # fmt: skip


@pytest.mark.parametrize("seeds", [range(1), pytest.param(range(60), marks=pytest.mark.evidence)])
def test_weights_backwards_and_moments_forwards_agree(seeds: range) -> None:
    """With periodic attempts, losses, bursts, and both; without losses, a receiver that predicts changes nothing."""
    tried = 0
    for seed in seeds:
        held, _, predicting, heard, controller = found = bases(seed)
        assert advantage(predicting, "").cost == pytest.approx(advantage(held, "").cost, rel=1e-8)
        assert advantage(controller, "").cost == pytest.approx(advantage(heard, "").cost, rel=1e-8)
        chain = random_network(seed, "actuator").chain("actuator")
        for number, base in enumerate(found):
            pattern = tuple(k == 0 for k in range(1 + (seed + number) % 3))
            attempts = Attempts(pattern, *chain)
            size = len(base.silent)
            if size * size * len(pattern) * len(chain[1]) > 1000:
                continue
            scale = critical_scale(base, attempts)
            if scale < 1.2:
                attempts = attempts.scaled(scale / 1.2)
            if not attempts.losses.any():
                continue
            cost = advantage(base, "", attempts).cost
            off = 1e-9 * max(1.0, cost / advantage(base, "").cost)  # rounding grows with the value
            assert cost == pytest.approx(forward_cost(base, attempts), rel=off)
            tried += 1
    assert tried >= len(seeds)


@pytest.mark.parametrize("seed", range(4))
def test_the_value_of_a_total_is_that_of_its_moments(seed: int) -> None:
    """Over a horizon with a weight of the final state, and with a discount, for attempts at every second step."""
    plant, cost, kept = random_loop(seed)
    base = actuator_base(discretise(plant, cost, None), kept)
    n, c = base.Gamma.shape
    silent, R = base.silent, base.replaced
    last, noise = 2.0 * np.eye(n), np.pad(base.noise, (0, c))
    begin = np.pad(0.5 * np.eye(n), (0, c))
    for attempts, steps in (
        (Attempts((True, False) * 6, terminal=last), 12),
        (Attempts((True, False), discount=0.5), 60),
    ):
        found, X, total = advantage(base, "", attempts), begin, 0.0
        for k in range(steps):
            used = R if k % 2 == 0 else np.eye(n + c)
            total += attempts.discount**k * float(np.sum(base.stage * (used @ X @ used.T)))
            X = silent @ used @ X @ used.T @ silent.T + noise
        if attempts.terminal is not None:
            total += float(np.sum(last * X[:n, :n]))
        assert found.cost + 0.5 * np.trace(found.P[:n, :n]) == pytest.approx(total, rel=1e-9)


def moments_of_a_held_measurement(every: int, loss: float, discount: float, steps: int, terminal: float) -> float:
    """Return the cost of u = −h/2 with the last measurement h that arrived, by the second moments of (x, h)."""
    M, total, heard = np.outer([5.0, 5.0], [5.0, 5.0]), 0.0, np.array([[1.0, 0.0], [1.0, 0.0]])
    M[0, 0] += 0.3  # the receiver begins with the mean
    for k in range(steps):
        if k % every == 0:
            M = loss * M + (1 - loss) * (heard @ M @ heard.T + np.diag([0.0, 0.01]))
        total += discount**k * float(M[0, 0] + 0.1 * 0.25 * M[1, 1])
        moved = np.array([[0.9, -0.5], [0.0, 1.0]])
        M = moved @ M @ moved.T + np.diag([0.01, 0.0])
    return total + terminal * float(M[0, 0])


@pytest.mark.parametrize("every", [1, 2])
@pytest.mark.parametrize("total", [{"horizon": 5, "terminal": [[2.0]]}, {"discount": 0.8}])
def test_a_total_cost_includes_what_the_receiver_uses_before_the_first_packet(
    total: dict[str, object], every: int
) -> None:
    """Where the first packet may be lost, the controller uses the mean with which it starts, and not zero."""
    kept = Controller(
        np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[-0.5]], disturbance=Disturbance(deviation=0)
    )
    plant = Plant([[0.9]], [[1.0]], [[0.01]], [[1.0]], [[0.01]], mean=[5.0], covariance=[[0.3]])
    cost, network = Cost([[1.0]], [[0.1]], **total), Network("tcp", sensor_loss=0.4)
    policy = design.excess(plant, cost, delta=0.0, controller=kept, link="sensor", network=network, every=every)
    steps, terminal = (5, 2.0) if "horizon" in total else (200, 0.0)
    exact = moments_of_a_held_measurement(every, 0.4, float(cost.discount), steps, terminal)
    assert policy.theory.identity is not None
    assert policy.theory.identity.constant == pytest.approx(exact, rel=1e-9)
    assert policy.guarantee is not None
    assert policy.guarantee.cost == pytest.approx(exact, rel=1e-9)
    plain = replace(policy, theory=replace(policy.theory, identity=None))
    squares, other = (
        average(taciturn.close(plant, one, cost=cost), steps=100_000, seed=number).cost
        for number, one in enumerate((policy, plain))
    )
    error = np.hypot(squares.standard_error, other.standard_error)
    assert squares.value == pytest.approx(other.value, abs=4.5 * error)


WAYS = (
    {"link": "sensor"}, {"link": "sensor", "actuation": "model"}, {"actuation": "zero"}, {"every": 2},
    {"every": 2, "link": "sensor"}, {"network": Network("tcp", actuator_loss=0.1)},
    {"network": Network("tcp", sensor_loss=0.2), "link": "sensor"},
)  # fmt: skip


@pytest.mark.parametrize("way", WAYS)
def test_lqg_over_any_link_begins_with_the_mean_of_the_initial_state(way: dict[str, object]) -> None:
    """By moments of state and estimate with the steady gain; about an operating point too; and in a simulation."""
    free = Plant([[0.9]], [[1.0]], [[0.01]], [[1.0]], [[0.01]], mean=[5.0], covariance=[[0.5]])
    cost = Cost([[1.0]], [[0.1]], discount=0.9)
    policy, best = design.excess(free, cost, delta=0.1, **way), design.excess(free, cost, delta=0.1).cost_all_time
    assert policy.initial["next register"] == pytest.approx([5.0])
    if "network" not in way:
        G, L = steady_filter(free.A, free.C, free.W, free.V).gain.item(), price_control(discretise(free, cost, None)).L
        both = np.array([[1.0, 0.0], [G, 1 - G]])  # from (x, prior) to (x, estimate), plus G v
        M, exact = np.full((2, 2), 25.0) + np.diag([0.5, 0.0]), 0.0
        for k in range(300):
            M = both @ M @ both.T + np.diag([0.0, 0.01 * G**2])
            exact += 0.9**k * (M[0, 0] + 0.1 * L.item() ** 2 * M[1, 1])
            moved = np.array([[0.9, L.item()], [0.0, 0.9 + L.item()]])
            M = moved @ M @ moved.T + np.diag([0.01, 0.0])
        assert policy.cost_all_time == pytest.approx(exact, rel=1e-9)
        assert best < exact < 1.01 * best  # that of the gains of a filter from the start
    point = OperatingPoint([2.0], [0.2])
    moved = Plant(free.A, free.B, free.W, free.C, free.V, mean=[7.0], covariance=[[0.5]], operating_point=point)
    assert design.excess(moved, cost, delta=0.1, **way).cost_all_time == pytest.approx(policy.cost_all_time, rel=1e-9)
    plain = replace(policy, theory=replace(policy.theory, identity=None))
    squares, other = (
        average(taciturn.close(free, one, cost=cost), steps=100_000, seed=number).cost
        for number, one in enumerate((policy, plain))
    )
    assert squares.value == pytest.approx(other.value, abs=4.5 * np.hypot(squares.standard_error, other.standard_error))


def combination(seed: int) -> tuple[Plant, Cost, dict[str, Any]]:
    """Return a random loop with a far start, and options: actuation, losses or bursts, attempts, controller or LQG."""
    plant, cost, kept = random_loop(seed)
    n = plant.states
    plant = Plant(plant.A, plant.B, plant.W, plant.C, plant.V, mean=3 * np.ones(n), covariance=0.5 * np.eye(n))
    total = ({}, {"horizon": 20, "terminal": 3 * np.eye(n)}, {}, {"discount": 0.9})[seed % 4]
    cost, every = Cost(cost.Q, cost.R, cost.N, **total), 1 + seed // 4 % 2
    actuation = ("hold", "zero")[seed % 2] if total else ACTUATIONS[seed // 2 % 3]
    link = "actuator" if actuation == "zero" else ("actuator", "sensor")[seed // 8 % 2]
    network = random_network(seed, link) if seed // 2 % 2 else Network()
    controller = None if total.get("horizon") is None and seed % 3 == 0 else kept
    options = {"link": link, "actuation": actuation, "every": every, "network": network, "controller": controller}
    return plant, cost, options


@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(96), marks=pytest.mark.evidence)])
def test_identity_and_bound_hold_for_every_combination(seeds: range) -> None:
    """Actuation, losses or bursts, periodic attempts, horizon and discount; the plain average is the other estimate."""
    off = []
    for seed in seeds:
        plant, cost, options = combination(seed)
        try:
            policy = design.excess(plant, cost, theta=0.3, **options)
        except UnstableError:  # with so few packets, or such losses
            continue
        if policy.theory.fourth is not None and policy.theory.fourth > 0.9:  # no error of the mean
            continue
        if policy.guarantee.cost > 20 * policy.cost_all_time:  # a base that is nearly unstable
            continue
        plain = replace(policy, theory=replace(policy.theory, identity=None))
        squares, other = (
            average(taciturn.close(plant, one), steps=400_000, seed=number).cost
            for number, one in enumerate((policy, plain))
        )
        off.append((squares.value - other.value) / np.hypot(squares.standard_error, other.standard_error))
        assert squares.value < policy.guarantee.cost + 4 * squares.standard_error
    assert len(off) > len(seeds) / 3
    assert np.abs(off).max() < 4.5
    assert np.mean(np.square(off)) < 1.2 + 6 / np.sqrt(len(off))


@pytest.mark.parametrize("seeds", [(2, 3, 7), pytest.param(range(96), marks=pytest.mark.evidence)])
def test_the_cost_of_every_sample_is_that_of_a_simulation_that_always_sends(seeds: Sequence[int]) -> None:
    """Over the same link, with the same fates; LQG for rarer packets has the gains of LQG for every sample there."""
    off = []
    for seed in seeds:
        plant, cost, options = combination(seed)
        try:
            policy = design.excess(plant, cost, theta=0.3, **options)
            if options["controller"] is None:
                always = sending_always(design.excess(plant, cost, theta=0.3, **{**options, "every": 1}))
            else:
                always = sending_always(policy)
        except UnstableError:  # with so few packets, or such losses
            continue
        if policy.theory.fourth is not None and policy.theory.fourth > 0.8:  # no error of the mean
            continue
        always = replace(always, theory=replace(always.theory, identity=None))
        found = average(taciturn.close(plant, always, options["network"]), steps=400_000, seed=seed).cost
        off.append((found.value - policy.cost_all_time) / found.standard_error)
    assert len(off) > len(seeds) / 3
    assert np.abs(off).max() < 4.5
    assert np.mean(np.square(off)) < 1.2 + 6 / np.sqrt(len(off))


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.evidence) for seed in range(1, 20))])
def test_gains_for_dropouts(seed: int) -> None:
    """With zero input and the measured state, they are those of ``lossy-lqg``, as is the rule; others cost more."""
    plant, cost, _ = random_loop(seed)
    measured, weights = Plant(plant.A, plant.B, plant.W), Cost(cost.Q, cost.R)
    network = Network("tcp", actuator_loss=0.15)
    own = design.lossy_lqg(measured, weights, price=0.5, network=network)
    zero = {"actuation": "zero", "gains": "loss-optimal", "network": network}
    kept = design.excess(measured, weights, delta=0.5, **zero)
    assert kept.cost_all_time == pytest.approx(own.cost_all_time, rel=1e-9)
    sent = [outputs(policy, seed)[Sent("actuator")] for policy in (own, kept)]
    assert np.array_equal(*sent)
    for actuation in ("hold", "zero"):
        options = {"theta": 0.1, "actuation": actuation, "network": network}
        best = design.excess(plant, cost, gains="loss-optimal", **options).cost_all_time
        try:
            usual = design.excess(plant, cost, **options).cost_all_time
        except UnstableError:
            continue
        assert best <= usual * (1 + 1e-9)


@pytest.mark.evidence
def test_no_gain_is_stable_above_the_critical_loss() -> None:
    """Of a scalar plant with zero input: 1/a²; the message states the limit, and with an ideal link there is none."""
    plant, cost = Plant([[1.5]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
    zero = {"theta": 0.1, "actuation": "zero", "gains": "loss-optimal"}
    with pytest.raises(
        UnstableError, match=r"grows without limit for every gain; expected a loss probability below 0\.44"
    ):
        design.excess(plant, cost, network=Network("tcp", actuator_loss=0.46), **zero)
    assert design.excess(plant, cost, network=Network("tcp", actuator_loss=0.43), **zero).cost_all_time > 0
    with pytest.raises(
        ProblemError, match="gains = 'loss-optimal' does not apply here; expected an actuator link that drops packets"
    ):
        design.excess(plant, cost, **zero)


@pytest.mark.parametrize("seed", range(3))
def test_the_kinds_are_instances_of_a_base(seed: int) -> None:
    """LQG: slope 0 and the weight of its square; periodic control and ``consistent``: the same values and costs."""
    plant, cost, _ = random_loop(seed)
    problem = discretise(plant, cost, None)
    certainty = design_certainty("excess", problem)
    stage = np.block([[cost.Q, cost.N], [cost.N.T, cost.R]])
    base = Base(plant.A, plant.B, stage, certainty.regulator.L, certainty.corrections, unseen=certainty.estimation_cost)
    found = advantage(base, "")
    assert found.cost == pytest.approx(certainty.cost_all_time, rel=1e-8)
    assert found.H[0, 0] == pytest.approx(certainty.regulator.H, rel=1e-8)
    assert np.abs(found.slope).max() < 1e-8 * np.abs(found.P).max()
    periodic = certainty.held.solve((3,))
    found = advantage(replace(base, K=periodic.gains[0]), "", Attempts((True, False, False)))
    assert found.cost == pytest.approx(periodic.cost + certainty.estimation_cost, rel=1e-8)
    assert (
        pytest.approx(periodic.values[0], rel=1e-6, abs=1e-8 * np.abs(found.P).max())
        == found.P[: len(base.Phi), : len(base.Phi)]
    )
    draws = np.random.default_rng(seed)
    driven = ContinuousPlant(draws.normal(size=(2, 2)), draws.normal(size=(2, 1)), np.eye(2))
    predicted = predict_continuously("consistent", driven, Cost(np.eye(2), [[1.0]]), 0.4)
    p = predicted.problem
    stage = np.block([[p.Q, p.N], [p.N.T, p.R]])
    found = advantage(Base(p.plant.A, p.plant.B, stage, np.eye(2), p.plant.W), "")
    assert p.per_unit(found.cost) == pytest.approx(predicted.cost_all_time, rel=1e-7)
    assert found.H[0, 0] == pytest.approx(predicted.Gamma, rel=1e-7)
    assert np.abs(found.slope).max() < 1e-8 * np.abs(found.P).max()


@pytest.mark.parametrize("seed", range(6))
def test_one_packet_in_many_steps_costs_what_the_pattern_says(seed: int) -> None:
    """Step by step for a few, and at once for millions, which no list of steps could hold."""
    for base in bases(seed):
        for steps in (1, 2, 3, 6, 7):
            known = cost_of_one_packet(base, steps)
            try:
                expected = advantage(base, "", Attempts(tuple(k == 0 for k in range(steps)))).cost
            except UnstableError:
                assert known is None
            else:
                assert known == pytest.approx(expected, rel=1e-8)
        many = cost_of_one_packet(base, 10_000_000)
        assert many is None or many > 0
