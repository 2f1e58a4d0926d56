"""Other rules for a given controller: periodic packets, send-on-delta, and a base that sends periodically."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from laws.test_given_controllers import ALL_TIME, KEPT, NO_DISTURBANCE, STEP, TANK, WEIGHTS, random_loop

import taciturn
from taciturn import Controller, Cost, Network, Plant, ProblemError, UnstableError, design
from taciturn.base.certainty import design_certainty
from taciturn.base.given_controller import lqg_observer
from taciturn.lqg.discrete import discretise
from taciturn.model.steps import Decide, Location
from taciturn.model.theory import Theory
from taciturn.model.trigger import Form, Scheduled, Trigger
from taciturn.program.engine import prepare
from taciturn.program.ops import Sent
from taciturn.simulation.average import average


@pytest.mark.evidence
def test_the_same_controller_at_a_slower_clock_is_the_comparison() -> None:
    """Every second, fourth and eighth step, exactly; and as simulated with a packet every fourth step."""
    for link, silence in (("actuator", "hold"), ("actuator", "model"), ("sensor", "hold"), ("sensor", "model")):
        policy = design.excess(TANK, WEIGHTS, theta=0.5, controller=KEPT, link=link, actuation=silence)
        exact, steps = policy.theory.periodic.at_its_step(4), tuple(policy.steps)
        if (link, silence) == ("actuator", "hold"):
            found = [policy.theory.periodic.at_its_step(q) / ALL_TIME for q in (1, 2, 4, 8)]
            assert found == pytest.approx([1.0, 1.1977, 1.6746, 3.0450], abs=5e-5)
        turns = Scheduled("turn", np.array([-1.0, 1.0, 1.0, 1.0]))
        timed = Trigger({"silent": Form(), "send": Form(constant=turns)})
        steps = tuple(replace(one, trigger=timed) if isinstance(one, Decide) and one.decision == "send" else one
                      for one in steps)  # fmt: skip
        clocked = replace(policy, steps=steps, locations=(Location("turn", np.array([1, 2, 3, 0])),), theory=Theory(
            cost=policy.theory.cost, settling=policy.theory.settling, cost_all_time=policy.cost_all_time))  # fmt: skip
        simulated = average(taciturn.close(TANK, clocked, cost=WEIGHTS), standard_error=2e-6)
        assert simulated.rates[link].value == pytest.approx(0.25, abs=1e-6)
        assert simulated.cost.value == pytest.approx(exact, abs=4 * simulated.cost.standard_error)
    slow, draws, x = KEPT.at(4 * STEP, 1, 1), np.random.default_rng(3), np.zeros((2, 4000))
    z, total = np.zeros((len(slow.A), 4000)), np.zeros(4000)
    for step in range(2400):
        if step % 4 == 0:
            y = TANK.C @ x + np.sqrt(TANK.V) @ draws.standard_normal((1, 4000))
            u, z = slow.C @ z + slow.D @ y, slow.A @ z + slow.B @ y
        if step >= 400:
            total += np.einsum("ip,ij,jp->p", x, WEIGHTS.Q, x) + WEIGHTS.R.item() * u[0] ** 2
        x = TANK.A @ x + TANK.B @ u + np.sqrt(TANK.W) @ draws.standard_normal((2, 4000))
    error = total.std(ddof=1) / 2000 / np.sqrt(4000)
    assert policy.theory.periodic.discretised(4) == pytest.approx(total.mean() / 2000, abs=4 * error)


@pytest.mark.parametrize(
    ("link", "delta", "packets", "cost"),
    [
        pytest.param(*row, marks=() if row[1] in (0.15, 0.04) else pytest.mark.evidence)
        for row in (
            ("actuator", 0.1, 0.523, 1.026), ("actuator", 0.15, 0.343, 1.088), ("actuator", 0.2, 0.217, 1.227),
            ("sensor", 0.02, 0.665, 1.001), ("sensor", 0.04, 0.392, 1.026), ("sensor", 0.06, 0.215, 1.098),
            ("sensor", 0.1, 0.080, 1.491),
        )
    ],
)  # fmt: skip
def test_send_on_delta_keeps_a_controller(link: str, delta: float, packets: float, cost: float) -> None:
    """Of its command or of the measurement; the excess trigger costs less at the same rate."""
    policy = design.send_on_delta(TANK, WEIGHTS, delta=delta, controller=KEPT, link=link)
    assert policy.guarantee is not None
    assert policy.cost_all_time == pytest.approx(ALL_TIME, rel=1e-8)
    found = taciturn.evaluate(policy, standard_error=3e-6)
    assert found.rates[link].value == pytest.approx(packets, abs=0.002)
    assert found.cost.value / ALL_TIME == pytest.approx(cost, abs=0.008)  # 4 standard errors of the reference
    assert found.cost.value < policy.guarantee.cost


@pytest.mark.parametrize("seeds", [range(3), pytest.param(range(60), marks=pytest.mark.evidence)])
def test_a_base_that_sends_periodically(seeds: range) -> None:
    """Its cost by two computations, the identity, and J + δ·rate ≤ J_q + δ/q, for given controllers and for LQG."""
    off = []
    for seed in seeds:
        plant, cost, kept = random_loop(seed)
        every, link = 2 + seed % 3, ("actuator", "sensor")[seed // 2 % 2]
        controller = kept if seed % 4 else None
        try:
            policy = design.excess(plant, cost, theta=0.3, controller=controller, every=every, link=link)
        except UnstableError:  # with so few packets
            continue
        found = policy.guarantee.base + policy.guarantee.per_silence * (1 - 1 / every)
        assert policy.theory.periodic.at_its_step(every) == pytest.approx(found, rel=1e-9)
        loop, paths = taciturn.close(plant, policy), 400
        program = loop.program()
        prepared = prepare(program)
        states = prepared(loop.start(program, paths, seed), 2000 // every * every, None).states
        sums = prepared(states, 4000 // every * every, None).sums
        steps = 4000 // every * every
        plain, squares = sums["cost"] / steps, found + sums["excess"] / steps
        off.append(float((plain - squares).mean() / ((plain - squares).std(ddof=1) / np.sqrt(paths))))
        rate = float(sums[Sent(link)].mean()) / steps
        assert plain.mean() < policy.guarantee.at_rate(rate) + 4 * plain.std(ddof=1) / np.sqrt(paths)
    assert off
    assert np.abs(off).max() < 4.5
    assert np.mean(np.square(off)) < 1 + 6 / np.sqrt(len(off))


def test_the_base_of_lqg_with_few_packets_is_lqg() -> None:
    """J_all is the cost of LQG with every sample, a model applies its input, and no sentence speaks of a controller."""
    for actuation in ("hold", "model"):
        always = design.excess(TANK, WEIGHTS, theta=0.2, actuation=actuation)  # type: ignore[arg-type]
        policy = design.excess(TANK, WEIGHTS, theta=0.2, every=4, actuation=actuation)  # type: ignore[arg-type]
        assert policy.cost_all_time == pytest.approx(always.cost_all_time, rel=1e-9)
        assert policy.guarantee is not None
        assert policy.guarantee.cost > policy.cost_all_time
        assert "the cost of LQG with a packet at every 4th step" in policy.guarantee.statement
        assert not any("controller" in note for note in policy.notes)
    # between packets the model applies the input of LQG, but for the corrections by measurements since the last packet
    known, power, missed, costs = (
        design_certainty("lqg", discretise(TANK, WEIGHTS, None)),
        np.eye(2),
        np.zeros((2, 2)),
        [],
    )
    for _ in range(4):
        costs.append(float(np.sum(known.square * missed)))
        missed += power @ known.corrections @ power.T
        power = TANK.A @ power
    found = policy.guarantee.base + policy.guarantee.per_silence * (1 - 1 / 4)
    assert found == pytest.approx(known.cost_all_time + np.mean(costs), rel=1e-7)


@pytest.mark.parametrize("seeds", [range(4), pytest.param(range(60), marks=pytest.mark.evidence)])
def test_every_sample_over_a_lossy_link_costs_the_same_whatever_the_base(seeds: range) -> None:
    """J_all is that of an attempt in every step, for a given controller and LQG; the bound refers to the base, J_q."""
    apart = []
    for seed in seeds:
        plant, cost, kept = random_loop(seed)
        link, total = ("actuator", "sensor")[seed % 2], ({}, {"horizon": 12}, {"discount": 0.9})[seed % 3]
        plant = Plant(plant.A, plant.B, plant.W, plant.C, plant.V, mean=2 * np.ones(plant.states))
        cost = Cost(cost.Q, cost.R, cost.N, **total)
        network = Network("tcp", **{f"{link}_loss": 0.05})
        for controller in (kept, None):
            for actuation in ("hold",) if total or len(kept.A) + plant.states > 4 else ("hold", "model"):
                options = {"theta": 0.1, "link": link, "controller": controller, "network": network}
                try:
                    rare = design.excess(plant, cost, every=2, actuation=actuation, **options)
                except (UnstableError, ProblemError):  # with so few packets, or without gains over a horizon
                    continue
                always = design.excess(plant, cost, actuation=actuation, **options)
                assert rare.cost_all_time == pytest.approx(always.cost_all_time, rel=1e-9)
                if rare.guarantee is not None and not total:
                    bound = rare.guarantee.base + 0.5 * rare.guarantee.per_silence
                    assert bound == pytest.approx(rare.theory.identity.constant, rel=1e-9)
                apart.append(abs(rare.theory.identity.constant / rare.cost_all_time - 1))
    assert len(apart) > len(seeds) / 2
    assert np.median(apart) > 0.01


def test_growing_fourth_moments_are_named_as_those_of_the_base() -> None:
    """Of one attempt in three steps, which grow, while those of an attempt in every step do not."""
    kept = Controller(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[-0.5]], disturbance=NO_DISTURBANCE)
    plant, cost = Plant([[1.1]], [[1.0]], [[0.01]], [[1.0]], [[0.01]]), Cost([[1.0]], [[0.1]])
    options = {"delta": 0.0, "controller": kept, "network": Network("tcp", actuator_loss=0.1)}
    rare, always = (design.excess(plant, cost, every=every, **options) for every in (3, 1))
    assert always.theory.fourth < 1 < rare.theory.fourth
    assert (
        "with an attempt to send at every 2nd step"
        in design.excess(plant, cost, every=2, **options).guarantee.statement
    )
    found = taciturn.evaluate(rare, steps=20_000)
    assert "grows by a factor of 1.276 per step if a packet is sent once in 3 steps" in str(found.notes)
    assert found.cost_all_time == pytest.approx(always.cost_all_time, rel=1e-9)
    with pytest.raises(UnstableError, match="attempts to send once in 3 steps; expected a loss probability be"):
        design.excess(plant, cost, every=3, **{**options, "network": Network("tcp", actuator_loss=0.3)})


def test_at_its_own_rate_a_periodic_base_is_improved() -> None:
    """For LQG with optimal gains and a held input, relative to ``periodic`` itself."""
    policy = design.excess(TANK, WEIGHTS, theta=0.2, every=3)
    clocked = design.periodic(TANK, WEIGHTS, every=3).theory.closed_form.cost
    bound = policy.guarantee
    assert bound.base + bound.per_silence * (1 - 1 / 3) == pytest.approx(clocked, rel=1e-9)
    total = Cost(WEIGHTS.Q, WEIGHTS.R, discount=0.9)
    with pytest.raises(
        ProblemError, match="actuation is 'model', every is 3, and the cost has a horizon or a discount; expected"
    ):
        design.excess(TANK, total, theta=0.2, every=3, actuation="model")


@pytest.mark.parametrize("discount", [1.0, 0.8])
@pytest.mark.parametrize("actuation", ["hold", "zero"])
def test_no_other_gain_costs_less_with_the_same_packets(actuation: str, discount: float) -> None:
    """Of LQG with a packet at every third step, whatever the actuator applies between them; with total costs too."""
    plant = Plant([[1.25, 0.3], [0.0, 0.9]], [[0.2], [1.0]], 0.1 * np.eye(2), dt=1.0)
    cost = Cost(np.eye(2), [[0.2]], [[0.1], [0.0]], discount=discount)

    def base(controller: Controller | None) -> float:
        policy = design.excess(plant, cost, delta=0.0, every=3, actuation=actuation, controller=controller)  # type: ignore[arg-type]
        assert policy.theory.identity is not None
        return policy.theory.identity.constant

    best, L = base(None), lqg_observer("excess", discretise(plant, cost, None), 3, zero=actuation == "zero").D
    for change in 0.02 * np.array([[[1, 0]], [[-1, 0]], [[0, 1]], [[0, -1]]]):
        other = Controller(
            np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((1, 0)), L + change, dt=1.0, disturbance=NO_DISTURBANCE
        )
        assert best < base(other) < 1.1 * best


def test_a_plant_that_held_inputs_cannot_stabilise_is_controlled_by_inputs_that_end() -> None:
    """The square of a scalar, with one input in three steps: the optimum of a Riccati equation, by hand."""
    policy = design.excess(
        Plant([[2.0]], [[1.0]], [[0.1]]), Cost([[1.0]], [[0.1]]), delta=0.0, every=3, actuation="zero"
    )
    assert policy.theory.identity is not None
    a, b, q, n, r = (
        8.0,
        4.0,
        1 + 4 + 16,
        2 + 8,
        0.1 + 1 + 4,
    )  # three steps as one: x⁺ = 8x + 4u and the sums of the costs
    k = q
    for _ in range(60):
        k = q + a * a * k - (a * b * k + n) ** 2 / (r + b * b * k)
    assert policy.theory.identity.constant == pytest.approx((k * 0.1 * 21 + 0.1 * (1 + 5)) / 3, rel=1e-9)
