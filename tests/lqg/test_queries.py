"""Schedules of queries: what they cost, when they query, how they repeat, and what is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest
from drawn import law
from hypothesis import assume
from watched import SEEDS, TIMES, follow, random_plant, semidefinite, sixty_digits

from taciturn import Cost, Plant, UnstableError, design
from taciturn.lqg import queries
from taciturn.lqg.queries import Predictor, QueryValue, Weights, follow_every_query, schedule_queries
from taciturn.lqg.riccati import regulate
from taciturn.model.schedule import Schedule


def with_cross_term(plant: Plant, seed: int, **time) -> Cost:
    """Return a random cost with N ≠ 0."""
    rng, n, m = np.random.default_rng(seed + 2), plant.states, plant.inputs
    joint = semidefinite(rng, n + m) + 0.1 * np.eye(n + m)
    return Cost(joint[:n, :n], joint[n:, n:], joint[:n, n:], **time)


def optimal(plant: Plant, cost: Cost, steps: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return L_k and P_k of so many steps, by the Riccati recursion written out; the first are those of an average."""
    A, B, alpha = plant.A, plant.B, cost.discount
    K = cost.Q if cost.terminal is None else cost.terminal
    gains, prices = [], []
    for _ in range(steps):
        H, cross = cost.R + alpha * B.T @ K @ B, alpha * B.T @ K @ A + cost.N.T
        gains, prices = [-np.linalg.solve(H, cross), *gains], [cross.T @ np.linalg.solve(H, cross), *prices]
        K = cost.Q + alpha * A.T @ K @ A - prices[0]
        K = (K + K.T) / 2
    return gains, prices


times = pytest.mark.parametrize("time", TIMES, ids=str)


@times
@law(2, 4, seed=SEEDS)
def test_a_policy_prices_an_error_as_its_regulator_does(time, seed):
    """P = (αA'KB + N)(R + αB'KB)^{-1}(αB'KA + N'), of the step where the horizon is finite."""
    plant = random_plant(seed)
    cost = with_cross_term(plant, seed, **time)
    schedule = design.remote_lqg(plant, cost, theta=0.1, zeta=0.5).schedule
    assert schedule is not None
    prices = optimal(plant, cost, cost.horizon or 400)[1]
    for tick in range(min(4, len(schedule.queries))):
        P = prices[0] if cost.horizon is None else prices[tick + 1 :]
        plain = sixty_digits(plant, schedule.covariance[tick], P, cost.discount)
        assert schedule.value[tick] == pytest.approx(plain, rel=1e-7, abs=1e-11 * np.trace(prices[0]))


def propagated(plant: Plant, cost: Cost, steps: int, asked: list[bool], cycle: int = 1) -> float:
    """Return the cost of queries at given steps and a send at each: E of (x, x̂) together, under gains of its own.

    Of an average: the mean over the last cycle; of a discounted sum: of so many steps.
    """
    A, B, C, n, alpha = plant.A, plant.B, plant.C, plant.states, cost.discount
    gains = optimal(plant, cost, steps)[0]
    Sigma, new, costs = plant.covariance, np.zeros((2 * n, 2 * n)), []
    moment = np.outer(np.tile(plant.mean, 2), np.tile(plant.mean, 2))
    moment[:n, :n] += Sigma
    for tick in range(steps):
        L = gains[0 if cost.horizon is None else tick]
        both = np.block([[np.eye(n), np.zeros((n, n))], [np.zeros((len(L), n)), L]])
        costs.append(np.trace(both.T @ np.block([[cost.Q, cost.N], [cost.N.T, cost.R]]) @ both @ moment))
        gain = asked[tick] * np.linalg.solve(C @ Sigma @ C.T + plant.V, C @ Sigma @ A.T).T
        F = np.block([[A, B @ L], [gain @ C, A - gain @ C + B @ L]])
        new[:n, :n], new[n:, n:] = plant.W, gain @ plant.V @ gain.T
        moment = F @ moment @ F.T + new
        Sigma = (A - gain @ C) @ Sigma @ (A - gain @ C).T + gain @ plant.V @ gain.T + plant.W
    if cost.terminal is not None:
        return sum(costs) + float(np.trace(cost.terminal @ moment[:n, :n]))
    return float(np.mean(costs[-cycle:])) if alpha == 1 else float(alpha ** np.arange(steps) @ costs)


@times
@law(2, 6, seed=SEEDS)
def test_the_costs_of_remote_sensing_are_those_of_the_propagated_moments(time, seed):
    """J_all and what the exact identity starts from: average, discount and finite horizon, N ≠ 0, a random start."""
    plant = random_plant(seed, largest=4)
    cost = with_cross_term(plant, seed, **time)
    price = float(np.random.default_rng(seed + 3).uniform(0, 2))
    policy = design.remote_lqg(plant, cost, theta=0.1, zeta=price)
    schedule = policy.schedule
    assert schedule is not None
    assert policy.theory.identity is not None
    assume(policy.theory.settling < 30)
    steps = cost.horizon or (600 if cost.discount == 1 else 200)
    assert policy.cost_all_time == pytest.approx(propagated(plant, cost, steps, [True] * steps), rel=1e-10)
    asked, here = [], 0
    for _ in range(steps + (schedule.period or 0)):
        asked.append(bool(schedule.queries[here]))
        here = here + 1 if here + 1 < len(schedule.queries) else schedule.start or 0
    whole = steps if cost.horizon is not None else len(asked)
    found = propagated(plant, cost, whole, asked, schedule.period or 1)
    assert policy.theory.identity.constant == pytest.approx(found, rel=1e-10)


@law(2, 10, seed=SEEDS)
def test_the_four_choices_of_a_step_are_two_comparisons(seed):
    """Query or not, send or not, then always both, what was sent counting 1 + θ: h − ζ decides one, Γ the other."""
    plant = random_plant(seed)
    cost = with_cross_term(plant, seed, discount=0.8)
    rng, alpha, theta, zeta = np.random.default_rng(seed + 4), 0.8, 0.6, 0.3
    A, B, (gains, prices) = plant.A, plant.B, optimal(plant, cost, 400)
    L, P, Q, R, N = gains[0], prices[0], cost.Q, cost.R, cost.N
    turned, weight = (A + B @ L).T, Q + L.T @ R @ L + N @ L + L.T @ N.T
    K = np.linalg.solve(np.eye(A.size) - alpha * np.kron(turned, turned), weight.ravel()).reshape(A.shape)
    Sigma = semidefinite(rng, plant.states) + 0.1 * np.eye(plant.states)
    x, held = 3 * rng.normal(size=plant.states), 3 * rng.normal(size=plant.inputs)

    def always(Sigma: np.ndarray) -> float:
        total, factor = np.trace(K @ Sigma) + alpha / (1 - alpha) * np.trace(K @ plant.W), 1.0
        for _ in range(150):
            total, factor, Sigma = total + factor * np.trace(P @ Sigma), alpha * factor, follow(plant, Sigma, True)
        return total

    def total(query: bool, send: bool) -> float:
        u = L @ x if send else held
        ahead, after = A @ x + B @ u, follow(plant, Sigma, query)
        moment = np.outer(ahead, ahead) + A @ Sigma @ A.T + plant.W - after  # of the next estimate
        now = x @ Q @ x + np.trace(Q @ Sigma) + u @ R @ u + 2 * x @ N @ u
        later = (1 + theta) * (np.trace(K @ moment) + always(after))
        return (1 + theta * send) * now + (1 + theta) * zeta * query + alpha * later

    worth = QueryValue(Predictor(plant), Weights(P, alpha))(Sigma)
    cross = N + alpha * (1 + theta) * A.T @ K @ B
    Gamma = np.block([[(1 + theta) * P - theta * Q, cross], [cross.T, R + alpha * (1 + theta) * B.T @ K @ B]])
    eta, size = np.concatenate([x, held]), 1e-9 * total(True, False)
    for other in (False, True):
        assert total(False, other) - total(True, other) == pytest.approx((1 + theta) * (worth - zeta), abs=size)
        saved = eta @ Gamma @ eta - theta * np.trace(Q @ Sigma)
        assert total(other, False) - total(other, True) == pytest.approx(saved, abs=size)


def test_noise_on_the_velocity_alone_leaves_a_schedule() -> None:
    """A double integrator that is measured exactly: its position is known in advance, and still has to be followed."""
    plant = Plant([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]], np.diag([0.0, 0.01]))
    for zeta, rate in ((0.0, 1.0), (0.1, 1 / 3)):
        policy = design.remote_lqg(plant, Cost(np.eye(2), [[1.0]]), theta=0.1, zeta=zeta)
        assert policy.schedule.rate == pytest.approx(rate)
        assert 1 <= policy.theory.settling < 100


@pytest.mark.parametrize("time", [{}, {"discount": 0.8}, {"horizon": 30}], ids=str)
@law(2, 6, seed=SEEDS)
def test_a_schedule_queries_where_it_is_worth_its_price_and_repeats_for_ever(time, seed):
    """Every step, five more periods included: query iff h(Σ) > ζ, with the covariance that follows from it."""
    plant = random_plant(seed)
    cost = with_cross_term(plant, seed, **time)
    price = float(np.exp(np.random.default_rng(seed + 3).uniform(-3, 1)))
    policy = design.remote_lqg(plant, cost, theta=0.1, zeta=price)
    schedule, predictor = policy.schedule, Predictor(plant)
    assert schedule is not None
    assert np.array_equal(schedule.queries, schedule.value > price)
    assert schedule.price == price
    prices = optimal(plant, cost, cost.horizon or 400)[1]
    weights = Weights(prices[0], cost.discount) if cost.horizon is None else Weights(np.array(prices))
    worth = QueryValue(predictor, weights)
    Sigma, here = schedule.covariance[0], 0
    if time:
        assert np.array_equal(Sigma, plant.covariance)
    for tick in range(len(schedule.queries) + 5 * (schedule.period or 0)):
        value = worth(Sigma, tick)
        assert schedule.value[here] == pytest.approx(value, rel=1e-6, abs=1e-9)
        assert schedule.covariance[here] == pytest.approx(Sigma, rel=1e-8, abs=1e-9 * np.abs(Sigma).max())
        assert schedule.queries[here] == (value > price) or abs(value - price) < 1e-7 * price
        Sigma = follow(plant, Sigma, bool(schedule.queries[here]))
        here = here + 1 if here + 1 < len(schedule.queries) else schedule.start or 0


SCALAR = Plant([[2.0]], [[1.0]], [[0.01]], [[3.0]], [[0.02]])
WEIGHTS = Cost([[1.0]], [[2.0]])


def rate(zeta: float) -> float:
    """Return the query rate of the scalar example of chapter 3."""
    return design.remote_lqg(SCALAR, WEIGHTS, theta=0.2, zeta=zeta).schedule.rate


def test_the_scalar_example_queries_as_the_thesis_prints() -> None:
    """Half of the steps at ζ = 1.65, two thirds at 1.5, and two thirds exactly from 1.4755 to 1.5398."""
    assert rate(1.65) == 0.5
    assert rate(1.5) == pytest.approx(2 / 3, abs=1e-15)
    for outside, inside, printed in ((1.4, 1.5, 1.4755), (1.6, 1.5, 1.5398)):
        while abs(outside - inside) > 1e-6:
            middle = (outside + inside) / 2
            if rate(middle) == pytest.approx(2 / 3, abs=1e-15):
                inside = middle
            else:
                outside = middle
        assert inside == pytest.approx(printed, abs=5e-5)


def test_the_robot_of_chapter_six_is_queried_at_the_printed_ticks() -> None:
    """Eleven queries in sixty steps from a known start."""
    plant = Plant([[1.0]], [[0.00069]], [[1e-4]], [[1.0]], [[1e-6]], mean=[0.6322])
    cost = Cost([[10.0]], [[0.003]], horizon=60, terminal=[[200.0]])
    schedule = design.remote_lqg(plant, cost, theta=0.5, zeta=0.004).schedule
    assert schedule is not None
    assert schedule.ticks == [*range(5, 50, 5), 51, 58]
    assert schedule.period is None
    assert schedule.rate == pytest.approx(11 / 60)


def test_a_free_sensor_is_always_queried_and_a_dear_one_only_where_it_must_be() -> None:
    """ζ = 0: always; ζ huge: never on a stable plant, rarely but for ever on an unstable one."""
    assert rate(0.0) == 1.0
    stable = Plant([[0.8]], [[1.0]], [[0.01]], [[3.0]], [[0.02]])
    never = design.remote_lqg(stable, WEIGHTS, theta=0.2, zeta=1e6)
    assert never.schedule.rate == 0
    assert never.schedule.covariance[-1] == pytest.approx(0.01 / (1 - 0.64), rel=1e-9)
    assert 0 < rate(1e6) < 0.1 < rate(1e3) < rate(1.0)


def test_an_unstable_plant_that_is_never_queried_is_refused() -> None:
    """Without noise nothing is worth a query, and nothing would tell where rounding drives the state."""
    with pytest.raises(
        UnstableError, match=r"at the price or threshold 1 the sensor is never queried, and the plant is unstable, .*"
    ):
        design.remote_lqg(Plant([[2.0]], [[1.0]], [[0.0]]), WEIGHTS, theta=0.2, zeta=1.0)


def test_what_queries_cannot_settle_is_refused(monkeypatch) -> None:
    """A covariance that overflows before the sensor is queried, and one that drifts for longer than is waited."""
    with pytest.raises(UnstableError, match="overflows before the sensor is queried"):
        Predictor(SCALAR).follow(np.array([[1e155]]), False)
    monkeypatch.setattr(queries, "LONGEST", 40)
    slow = Plant([[1 - 1e-3]], [[1.0]], [[1.0]], [[1.0]], [[1e4]])
    with pytest.raises(
        UnstableError, match=r"with zeta = 1e\+09 the schedule of queries does not repeat within 40 steps"
    ):
        schedule_queries(slow, Weights(np.eye(1), 0.1), 1e9, np.eye(1))
    with pytest.raises(UnstableError, match="the error covariance has not converged within 40 steps"):
        follow_every_query(slow, np.eye(1), None)


def test_a_start_of_which_nothing_is_known_leaves_the_same_cycle() -> None:
    """A first covariance of 1e10 is forgotten with the first query: it decides neither the cycle nor its digits."""
    plant, weights = Plant([[1.1]], [[1.0]], [[0.01]], [[1.0]], [[0.02]]), Weights(np.array([[1.0]]), 0.9)
    usual, vague = (schedule_queries(plant, weights, 0.1, np.array([[size]])).repeating() for size in (1.0, 1e10))
    turns = [np.roll(vague.covariance[:, 0, 0], k) for k in range(vague.period)]
    assert usual.period == vague.period > 1
    assert any(turn == pytest.approx(usual.covariance[:, 0, 0], rel=1e-8) for turn in turns)


@pytest.mark.evidence
def test_a_schedule_says_what_it_is(tmp_path) -> None:
    """Its document is JSON, its table has a row per step, its picture is drawn, and its cycle stands alone."""
    weights, start = Weights(np.array([[0.5]])), np.array([[0.3]])
    schedule = schedule_queries(SCALAR, weights, 0.25, start)
    document = json.loads(json.dumps(schedule.document()))
    first, length = schedule.start, len(schedule.queries)
    assert first is not None
    assert first > 0
    assert document["queries"] == [k for k in range(length) if schedule.queries[k]] == schedule.ticks
    assert (document["length"], document["repeats_from"], document["period"]) == (length, first, length - first)
    assert document["price"] == 0.25
    assert document["value"] == schedule.value.tolist()
    assert document["rate"] == schedule.rate == schedule.queries[first:].mean()
    cycle = schedule.repeating()
    assert (cycle.start, cycle.period, cycle.rate) == (0, schedule.period, schedule.rate)
    assert np.array_equal(cycle.covariance, schedule.covariance[first:])
    table = schedule.to_pandas()
    assert (list(table.columns), table.index.name, len(table)) == (["value", "query", "variance1"], "tick", length)
    assert table["variance1"].to_numpy() == pytest.approx(schedule.covariance[:, 0, 0])
    for shown in (schedule, Schedule(schedule.queries, schedule.value, schedule.covariance, 0.25, None)):
        shown.plot().savefig(tmp_path / "schedule.svg")
        assert (tmp_path / "schedule.svg").stat().st_size > 1000
        assert [axis.get_xlabel() for axis in shown.plot().axes] == ["", "step"]
    assert shown.repeating().start is shown.period is None


def test_with_a_discount_a_covariance_need_not_converge() -> None:
    """Nothing moves a constant: its variance 1/(k + 1) after k measurements tends to 0 for ever, at a finite cost."""
    constant = Plant([[1.0]], [[1.0]], [[0.0]], [[1.0]], [[1.0]], covariance=[[1.0]])
    covariance, start = follow_every_query(constant, np.eye(1), None, 0.9)
    assert start == len(covariance) - 1 < 2000
    assert covariance[:, 0, 0] == pytest.approx(1 / (1 + np.arange(len(covariance))), rel=1e-9)
    policy = design.remote_lqg(constant, Cost([[1.0]], [[1.0]], discount=0.9), theta=0.1, controller="sensor")
    found = regulate([[1.0]], [[1.0]], [[1.0]], [[1.0]], [[0.0]], 0.9)
    k = np.arange(1000)
    sums = float(found.K[0, 0] + np.sum(0.9**k / (k + 1)) * (found.L[0, 0] ** 2 * found.H[0, 0]))
    assert policy.cost_all_time == pytest.approx(sums, rel=1e-12)


def test_noise_of_rank_one_and_exact_outputs_leave_no_negative_variance() -> None:
    """After a few measurements only the noise of the last step is unknown; its rounding is divided by nothing."""
    A = np.array([[1, 0, 0, 0], [0, 0, 0, 0], [0, 0, -0.664, 165.0], [-1.06, 0.053, -0.00282, -0.664]])
    C = np.array([[-3.47e-3, -1.2e-4, -2.88e-6, -2.25e-3], [-1.53, -0.067, -1.04e-3, -0.0988]])
    spread = np.array([0.494, -15.9, 103.0, 1.92])
    plant = Plant(A, np.ones((4, 1)), np.outer(spread, spread), C, np.zeros((2, 2)))
    found, _ = follow_every_query(plant, np.diag([12.4, 1845.0, 1.36e5, 40.5]), 60)
    assert (np.diagonal(found, axis1=1, axis2=2) > 0).all()
    assert found[-1] == pytest.approx(plant.W, rel=1e-6)
