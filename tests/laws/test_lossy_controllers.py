"""Event-triggered control over links that drop packets and acknowledge them: value, identity, bound, critical loss."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from laws.test_given_controllers import random_loop
from runtime.loops import differing_ticks, record

import taciturn
from taciturn import PID, Burst, Controller, Cost, Disturbance, Network, Plant, ProblemError, UnstableError, design
from taciturn.base.given_controller import lqg_observer
from taciturn.base.route import actuator_base, sensor_base
from taciturn.base.value import Attempts, Base, advantage, critical_scale
from taciturn.design.at_fixed_steps import sending_always
from taciturn.design.silence import ChannelBelief
from taciturn.lqg.discrete import discretise
from taciturn.lqg.kalman import steady_filter
from taciturn.model.steps import Received
from taciturn.program.engine import prepare
from taciturn.program.numpy import run
from taciturn.program.ops import Sent
from taciturn.simulation.average import average

PLANT = Plant([[1.02, 0.1], [0, 0.98]], [[0.005], [0.1]], np.diag([0.001, 0.01]), [[1, 0]], [[0.05]])
WEIGHTS = Cost(np.diag([1.0, 0.1]), [[0.1]])
INDEPENDENT = Network("tcp", actuator_loss=0.3)
BURSTS = Network("tcp", actuator_burst=Burst(0.05, 0.3, 0.02, 0.8))
TABLE = [(INDEPENDENT, 0.576, 1.0109, 0.0004, 1.0424), (BURSTS, 0.551, 1.0121, 0.0005, 1.0449)]


def random_network(seed: int, link: str) -> Network:
    """Return independent losses, or bursts, of one link."""
    draws = np.random.default_rng([seed, 7])
    if draws.integers(2):
        return Network("tcp", **{f"{link}_loss": float(draws.uniform(0.02, 0.3))})
    burst = Burst(*draws.uniform(0.05, 0.3, 2), draws.uniform(0, 0.1), draws.uniform(0.3, 0.9))
    return Network("tcp", **{f"{link}_burst": burst})


def forward_cost(base: Base, attempts: Attempts) -> float:
    """Return the stationary cost by the second moments of (z, h) in each phase and channel state, one linear system."""
    silent, heard, stage = base.silent, base.silent @ base.replaced, base.stage
    sent, s, q, size = base.replaced.T @ stage @ base.replaced, len(attempts.losses), len(attempts.pattern), len(stage)
    noise = np.zeros((size, size))
    noise[: len(base.noise), : len(base.noise)] = base.noise
    step, added, weights = np.zeros((q * s * size**2,) * 2), np.zeros((q, s, size**2)), []
    for j, attempt in enumerate(attempts.pattern):
        for m, p in enumerate(attempts.losses):
            p, later = p if attempt else 1.0, (j + 1) % q
            moved = p * np.kron(silent, silent) + (1 - p) * np.kron(heard, heard)
            weights.append(p * stage + (1 - p) * sent)
            for other in range(s):
                to, here = (np.arange(size**2) + (k * s + o) * size**2 for k, o in ((later, other), (j, m)))
                step[np.ix_(to, here)] = attempts.turns[m, other] * moved
                added[later, other] += attempts.start[m] * attempts.turns[m, other] * noise.ravel()
    moments = np.linalg.solve(np.eye(len(step)) - step, added.ravel()).reshape(q * s, size, size)
    return float(sum(np.sum(S * M) for S, M in zip(moments, weights, strict=True))) / q + base.unseen


@pytest.mark.parametrize(("network", "attempts", "cost", "error", "bound"), TABLE)
def test_losses_are_those_of_the_reference(
    network: Network, attempts: float, cost: float, error: float, bound: float
) -> None:
    """LQG gains with a held input, θ = 0.1; the same controller may be given."""
    policy = design.excess(PLANT, WEIGHTS, theta=0.1, network=network)
    kept = lqg_observer("excess", discretise(PLANT, WEIGHTS, None))
    assert design.excess(PLANT, WEIGHTS, theta=0.1, network=network, controller=kept).cost_all_time == pytest.approx(
        policy.cost_all_time, rel=1e-12
    )
    found = taciturn.evaluate(policy, standard_error=1e-4 * policy.cost_all_time)
    assert found.rates["actuator"].value == pytest.approx(attempts, abs=0.002)
    assert found.cost.value / policy.cost_all_time == pytest.approx(cost, abs=4 * (error + 1e-4))
    assert found.cost_bound_at_rate / policy.cost_all_time == pytest.approx(bound, abs=2e-4)
    assert found.cost.value < found.cost_bound_at_rate


@pytest.mark.parametrize("seeds", [range(4), pytest.param(range(100), marks=pytest.mark.evidence)])
def test_two_computations_of_the_value_agree(seeds: range) -> None:
    """Weights backwards, and second moments forwards."""
    for seed in seeds:
        plant, cost, kept = random_loop(seed)
        for link, choose in (("actuator", actuator_base), ("sensor", sensor_base)):
            base, chain = choose(discretise(plant, cost, None), kept), random_network(seed, link).chain(link)
            scale = critical_scale(base, Attempts((True,), *chain))
            if scale < 1.2:
                chain = chain[0], chain[1] * scale / 1.2
            if len(base.Phi) < 9:
                attempts = Attempts((True,), *chain)
                assert advantage(base, "", attempts).cost == pytest.approx(forward_cost(base, attempts), rel=1e-9)


def assert_finite_time(plant: Plant, cost: Cost, kept: Controller, link: str, network: Network, seed: int) -> None:
    """Check J_T ≤ J_all + δ(1 − rate) + E z'P z/T from a start far from rest, with the prior of the filter."""
    covariance = steady_filter(plant.A, plant.C, plant.W, plant.V).prior
    mean = 5 * np.sqrt(np.diag(covariance))
    far = Plant(plant.A, plant.B, plant.W, plant.C, plant.V, mean=mean, covariance=covariance)
    policy, paths, steps = design.excess(far, cost, theta=0.2, controller=kept, link=link, network=network), 2000, 12
    loop = taciturn.close(far, policy)
    choose = actuator_base if link == "actuator" else sensor_base
    P = advantage(choose(discretise(plant, cost, None), kept), "", Attempts((True,), *network.chain(link))).P
    n, k, p = plant.states, len(kept.A), plant.outputs
    seen = np.zeros((len(P), n))  # of the state, in (state, controller, measurement, value of the receiver)
    seen[:n], seen[n + k : n + k + p] = np.eye(n), plant.C
    first = seen @ mean
    first[n + k + p :] = plant.C @ mean if link == "sensor" else 0.0  # the value with which the receiver begins
    moment = seen @ covariance @ seen.T + np.outer(first, first)
    moment[n + k : n + k + p, n + k : n + k + p] += plant.V
    sums = prepare(loop.program())(loop.start(loop.program(), paths, seed), steps, None).sums
    silent = policy.guarantee.per_silence * (1 - sums[Sent(link)] / steps)
    room = np.sum(P * moment) / steps + policy.cost_all_time + silent - sums["cost"] / steps
    assert room.mean() > -4.5 * room.std(ddof=1) / np.sqrt(paths)
    assert room.mean() < np.sum(P * moment) / steps  # without the start, the bound would be broken


@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(100), marks=pytest.mark.evidence)])
def test_the_identity_holds_and_the_bound_is_never_broken(seeds: range) -> None:
    """Plain average and completed squares of the same loop; errors from loops whose fourth moments exist."""
    off = []
    for seed in seeds:
        plant, cost, kept = random_loop(seed)
        link = ("actuator", "sensor")[seed % 2]
        network = random_network(seed, link)
        choose = actuator_base if link == "actuator" else sensor_base
        if critical_scale(choose(discretise(plant, cost, None), kept), Attempts((True,), *network.chain(link))) < 2:
            continue
        theta = (0.0, 0.2, 1.0)[seed % 3]
        policy = design.excess(plant, cost, theta=theta, controller=kept, link=link, network=network)
        loop, paths = taciturn.close(plant, policy), 200
        assert loop.nominal
        if policy.guarantee is None:
            continue
        assert_finite_time(plant, cost, kept, link, network, seed)
        program = loop.program()
        prepared = prepare(program)
        states = prepared(loop.start(program, paths, seed), 2000, None).states
        sums = prepared(states, 1000, None).sums
        plain, squares = sums["cost"] / 1000, policy.cost_all_time + sums["excess"] / 1000
        error = (plain - squares).std(ddof=1) / np.sqrt(paths)
        off.append(float((plain - squares).mean() / error))
        rate = float(sums[Sent(link)].mean()) / 1000
        assert plain.mean() < policy.guarantee.at_rate(rate) + 4 * plain.std(ddof=1) / np.sqrt(paths)
    assert off
    assert np.abs(off).max() < 4.5
    assert np.mean(np.square(off)) < 1 + 6 / np.sqrt(len(off))


@pytest.mark.evidence
def test_above_the_critical_loss_the_mean_square_grows() -> None:
    """In a simulation of attempts at every step, and not below; the design refuses the first with the limit."""
    plant, cost = Plant([[1.3]], [[1.0]], [[1.0]], [[1.0]], [[0.1]]), Cost([[1.0]], [[0.1]])
    base = actuator_base(discretise(plant, cost, None), lqg_observer("excess", discretise(plant, cost, None)))
    critical = 0.1 * critical_scale(base, Attempts(losses=np.array([0.1])))
    usual = sending_always(design.excess(plant, cost, theta=0.1, network=Network("tcp", actuator_loss=0.01)))
    growth = {}
    for factor in (0.8, 1.25):
        loop = taciturn.close(plant, usual, Network("tcp", actuator_loss=factor * critical))
        program = loop.program()
        prepared = prepare(program)
        early = prepared(loop.start(program, 60_000, 1), 20, None)
        late = prepared(prepared(early.states, 20, None).states, 20, None)
        growth[factor] = late.sums["cost"].mean() / early.sums["cost"].mean()
    assert growth[0.8] < 1.6
    assert growth[1.25] > 4
    with pytest.raises(UnstableError, match=f"expected a loss probability below {critical:.4g}"):
        design.excess(plant, cost, theta=0.1, network=Network("tcp", actuator_loss=1.01 * critical))


def test_the_refusal_of_losses_names_the_first_critical_loss_although_more_losses_would_do() -> None:
    """Kronecker products over the states of a bursty link: the growth crosses 1, and again above the stated losses."""
    plant = Plant(
        [[-0.0142, -0.3564, -1.3022], [-0.1074, -0.2382, 0.944], [0.7669, 0.3285, 1.293]],
        [[1.5396, 0.4733], [-2.0879, -0.9474], [0.0851, -1.2168]],
        [[0.143, -0.0247, -0.0275], [-0.0247, 0.1097, -0.0101], [-0.0275, -0.0101, 0.0905]],
        [[1.019, -0.3098, 0.1015], [-0.6566, 1.6158, -0.8068]],
        [[0.0536, -0.0291], [-0.0291, 0.0669]],
    )
    weights = [[0.9304, 0.5693, -0.231], [0.5693, 0.8247, 0.1365], [-0.231, 0.1365, 2.0541]]
    cost = Cost(weights, [[1.1088, 0.2931], [0.2931, 1.6347]], [[0.1805, -0.105], [0.284, 0.3367], [0.883, 0.2465]])
    network = Network("tcp", actuator_burst=Burst(0.08, 0.3, 0.02, 0.7))
    with pytest.raises(UnstableError, match=r"expected a loss probability below 0\.7335 times as much"):
        design.excess(plant, cost, theta=0.2, network=network)
    problem = discretise(plant, cost, None)
    base = actuator_base(problem, lqg_observer("excess", problem))
    silent, arrives = base.silent, base.silent @ base.replaced

    def growth(factor: float) -> float:
        turns, losses = np.array([[0.92, 0.08], [0.3, 0.7]]), (0.02 * factor, 0.7 * factor)
        each = [p * np.kron(silent, silent) + (1 - p) * np.kron(arrives, arrives) for p in losses]
        blocks = [[turns[m, after] * each[m] for m in range(2)] for after in range(2)]
        return float(np.abs(np.linalg.eigvals(np.block(blocks))).max())

    assert max(growth(factor) for factor in np.linspace(0.0, 0.733, 40)) < 1
    assert growth(0.7334) < 1 < growth(0.7336)
    assert growth(1.0) > 1 > growth(1.3)


@pytest.mark.evidence
def test_a_guarantee_needs_finite_fourth_moments() -> None:
    """Near the critical loss the variance of the cost is infinite: identity and simulation remain, with a warning."""
    plant, cost = Plant([[1.3]], [[1.0]], [[1.0]], [[1.0]], [[0.1]]), Cost([[1.0]], [[0.1]])
    for loss, finite in ((0.05, True), (0.2, False)):
        policy = design.excess(plant, cost, theta=0.1, network=Network("tcp", actuator_loss=loss))
        found = taciturn.evaluate(policy, standard_error=0.05 * policy.cost_all_time)
        assert (policy.theory.fourth < 1) == finite == found.trusted == (policy.guarantee is not None)
        assert ("the variance of the cost is infinite" in str(found.notes)) != finite
    base = actuator_base(discretise(plant, cost, None), lqg_observer("excess", discretise(plant, cost, None)))
    arrives, silent = base.silent @ base.replaced, base.silent
    whole = 0.8 * np.kron(np.kron(arrives, arrives), np.kron(arrives, arrives))
    whole += 0.2 * np.kron(np.kron(silent, silent), np.kron(silent, silent))
    radius = float(np.abs(np.linalg.eigvals(whole)).max())
    assert policy.theory.fourth == pytest.approx(radius, rel=1e-6)


def test_with_a_discount_the_fourth_moments_count_with_its_square() -> None:
    """By Kronecker products; where they grow, no guarantee is stated, and the discounted average warns."""
    plant = Plant([[0.9]], [[1.0]], [[0.01]], [[1.0]], [[0.01]], mean=[5.0])
    for loss, finite in ((0.1, True), (0.5, False)):
        network, cost = Network("tcp", actuator_loss=loss), Cost([[1.0]], [[0.1]], discount=0.9)
        policy = design.excess(plant, cost, delta=0.1, network=network)
        base = actuator_base(discretise(plant, cost, None), lqg_observer("excess", discretise(plant, cost, None)))
        arrives, silent = (np.kron(F, F) for F in (base.silent @ base.replaced, base.silent))
        whole = (1 - loss) * np.kron(arrives, arrives) + loss * np.kron(silent, silent)
        radius = float(np.abs(np.linalg.eigvals(whole)).max())
        assert policy.theory.fourth == pytest.approx(0.81 * radius, rel=1e-6)
        found = taciturn.evaluate(policy, steps=100_000)
        assert (0.81 * radius < 1) == finite == (policy.guarantee is not None)
        assert finite == ("the discounted squared cost grows by a factor of 1.228 per step" not in str(found.notes))
        assert finite or not found.trusted


@pytest.mark.evidence
def test_a_pid_keeps_its_bound_over_a_lossy_link() -> None:
    """With the slow disturbance of its integrator, whose slow mode the cost hardly sees."""
    tank = Plant([[1, 0.1], [0, 0.9]], [[0], [0.1]], np.diag([1e-4, 4e-4]), [[1, 0]], [[1e-3]], dt=0.1)
    pid, weights = PID(1.2, 0.15, 1.0, 0.5, Disturbance(20.0, 0.1)), Cost(np.diag([1.0, 0.0]), [[0.05]])
    policy = design.excess(tank, weights, theta=0.5, controller=pid, network=Network("tcp", actuator_loss=0.2))
    found = taciturn.evaluate(policy, standard_error=1e-3 * policy.cost_all_time)
    assert found.rates["actuator"].value < 0.5
    assert found.cost.value < found.cost_bound_at_rate


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"link": "sensor", "actuation": "zero"},
            "actuation is 'zero', but the policy sends its packets on the sensor link",
        ),
        (
            {"network": Network("tcp", delay=1)},
            "network.delay is 1; expected a delay of 0 steps with the policy kind excess",
        ),
        ({"network": Network("tcp", actuator_loss=1.0)}, "expected a loss probability below 0.69"),
        ({"network": Network("tcp", actuator_burst=Burst(0.1, 0.1, 0.8, 0.99))}, "times as much"),
    ],
)
def test_what_has_no_theory_is_refused(change: dict[str, object], words: str) -> None:
    """In one sentence."""
    with pytest.raises((ProblemError, UnstableError)) as told:
        design.excess(PLANT, WEIGHTS, theta=0.1, **change)
    assert words in str(told.value)


def test_losses_without_acknowledgement_are_simulated_without_a_claim() -> None:
    """The same policy as for ideal links."""
    policy = design.excess(PLANT, WEIGHTS, theta=0.1, network=Network("udp", actuator_loss=0.3))
    loop = taciturn.close(PLANT, policy, Network("udp", actuator_loss=0.3))
    assert not loop.nominal
    for network in (INDEPENDENT, BURSTS):
        lossy = design.excess(PLANT, WEIGHTS, theta=0.1, network=network)
        assert taciturn.close(PLANT, lossy, network).nominal
        assert not taciturn.close(PLANT, lossy, network.without_bursts() if network is BURSTS else BURSTS).nominal


@pytest.mark.parametrize(("network", "link"), [(INDEPENDENT, "actuator"), (BURSTS, "actuator"), (BURSTS, "sensor")])
def test_nodes_apart_carry_the_bits_of_the_loop(network: Network, link: str) -> None:
    """With lost packets, acknowledgements, and the belief about the channel."""
    if link == "sensor":
        network = Network("tcp", sensor_burst=network.burst("actuator"))
    loop = taciturn.close(PLANT, design.excess(PLANT, WEIGHTS, theta=0.1, network=network, link=link))
    records, draws = record(loop, 200, 1)
    wrong, packets = differing_ticks(loop, records, draws)
    assert wrong == []
    assert 20 < packets < 180


@pytest.mark.parametrize("network", [INDEPENDENT, BURSTS])
def test_a_dropout_may_be_followed_by_another_attempt(network: Network) -> None:
    """Always, if ``retry`` is true; the bound and the identity hold, and nodes apart decide alike."""
    policy = design.excess(PLANT, WEIGHTS, theta=0.5, network=network, retry=True)
    loop = taciturn.close(PLANT, policy)
    records, draws = record(loop, 300, 1)
    assert differing_ticks(loop, records, draws)[0] == []
    program = loop.program()
    found = run(program, loop.start(program, 50, 3), 300).outputs
    failed = (found[Sent("actuator")] == 1) & (found[Received("actuator")] == 0)
    assert failed.sum() > 100
    assert found[Sent("actuator")][1:][failed[:-1]].all()
    plain = replace(policy, theory=replace(policy.theory, identity=None))
    costs = [average(taciturn.close(PLANT, one), steps=400_000, seed=k).cost for k, one in enumerate((policy, plain))]
    error = np.hypot(*(cost.standard_error for cost in costs))
    assert costs[0].value == pytest.approx(costs[1].value, abs=4 * error)
    assert costs[0].value < policy.guarantee.cost
    with pytest.raises(ProblemError, match="retry = true, but no packet is acknowledged and dropped"):
        design.excess(PLANT, WEIGHTS, theta=0.5, retry=True)


def test_a_belief_about_the_channel_survives_what_its_law_excludes() -> None:
    """A fault may lose an acknowledgement that the law never loses: the belief must not end at no state at all."""
    turns, losses = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.5, 0.5, 0.0]]), np.array([0.8, 0.0, 0.1])
    start = np.array([0.2, 0.4, 0.4])
    belief = ChannelBelief(turns, losses, start)
    certain = np.array([0.0, 1.0, 0.0])  # that nothing is lost
    assert np.allclose(belief(certain, [1.0], [1.0]), [0.0, 0.0, 1.0])
    assert np.allclose(belief(certain, [1.0], [0.0]), turns.T @ start)


@pytest.mark.parametrize(
    "options",
    [
        {"network": INDEPENDENT}, {"network": BURSTS, "actuation": "zero"}, {"link": "sensor"}, {"every": 3},
        {"actuation": "zero"},
    ],
)  # fmt: skip
def test_gains_that_change_with_a_horizon_name_what_they_exclude(options: dict[str, object]) -> None:
    """Losses, the sensor link, every or zero: the message names each, so that the reader knows which to omit."""
    words = r"horizon is 30, .* actuator link that drops no packets \(no loss, no burst\), with actuation .* every = 1"
    cost = Cost(WEIGHTS.Q, WEIGHTS.R, horizon=30)
    assert design.excess(PLANT, cost, theta=0.1).guarantee is not None
    with pytest.raises(ProblemError, match=words):
        design.excess(PLANT, cost, theta=0.1, **options)  # type: ignore[arg-type]
