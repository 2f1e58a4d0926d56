"""The value of a query against its definition in sixty digits, and the schedules it leads to."""

from __future__ import annotations

import json
from decimal import Decimal, localcontext

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from taciturn import Cost, Plant, Schedule, UnstableError, design
from taciturn._modes import radius
from taciturn.lqg import queries
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.queries import Predictor, Weights, follow_every_query, query_value, schedule_queries

SEEDS = st.integers(0, 2**32 - 1)


def semidefinite(rng: np.random.Generator, size: int, rank: int | None = None) -> np.ndarray:
    """Return a random covariance without rounding errors: one of less than full rank is so exactly."""
    root = np.round(16 * rng.normal(size=(size, size if rank is None else rank))) / 32
    return root @ root.T


def random_plant(seed: int, kind: str = "output", largest: int = 3) -> Plant:
    """Return a plant whose steady filter forgets within a few dozen ticks; the noises of its outputs are separate."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, largest + 1))
    m, p = int(rng.integers(1, n + 1)), int(rng.integers(1, n + 1))
    A, B, C = rng.normal(size=(n, n)), rng.normal(size=(n, m)), rng.normal(size=(p, n))
    A *= rng.uniform(0.3, 1.2) / radius(A)
    for block in (np.vstack([A, C]), np.hstack([A, B]).T):
        slow = [value for value in np.linalg.eigvals(A) if abs(value) > 0.9]
        M, rest = block[:n], block[n:]
        assume(all(np.linalg.svd(np.vstack([M - s * np.eye(n), rest]))[1][n - 1] > 0.2 for s in slow))
    start = {"mean": rng.normal(size=n), "covariance": semidefinite(rng, n, int(rng.integers(0, n + 1)))}
    if kind == "full state":
        return Plant(A, B, semidefinite(rng, n, int(rng.integers(1, n + 1))), **start)
    W = semidefinite(rng, n, int(rng.integers(0, n)) if kind == "singular W" else None)
    V = np.diag(rng.uniform(0.05, 1, p))
    if kind == "some outputs without noise":
        V = V * (rng.random(p) < 0.5)
    plant = Plant(A, B, W, C, V, **start)
    try:
        found = steady_filter(A, C, W, V)
    except UnstableError:
        assume(False)
    assume(radius(A - A @ found.gain @ C) < (0.75 if kind == "some outputs without noise" else 0.9))
    return plant


def digits(matrix) -> np.ndarray:
    """Return the entries with as many digits as are asked."""
    return np.vectorize(Decimal, otypes=[object])(np.asarray(matrix, dtype=float))


def sixty_digits(plant: Plant, Sigma, P, discount: float = 1.0, terms: int | None = None) -> float:
    """Return Σ_s α^{s+1} tr(P_s (Ric^s(AΣA' + W) − Ric^{s+1}(Σ))), subtracting what was iterated, as it is written.

    Outputs are taken one after the other, which is the same where their noises are separate. Rounding errors of what is
    known exactly grow from tick to tick, so noise-free outputs take more digits.
    """
    size, usual = (60, 300) if (np.diag(plant.V) > 0).all() else (600, 80)
    A, C, W = (digits(getattr(plant, name)) for name in "ACW")
    noise, alpha = digits(np.diag(plant.V)), Decimal(discount)

    def silent(X):
        return A @ X @ A.T + W

    def queried(X):
        for row, variance in zip(C, noise, strict=True):
            seen = X @ row
            spread = row @ seen + variance
            X = X - np.outer(seen, seen) / spread if spread > Decimal(10) ** (-size // 2) else X
        return silent(X)

    with localcontext() as context:
        context.prec = size
        Sigma, total = digits(Sigma), Decimal(0)
        late, early = silent(Sigma), queried(Sigma)
        for s in range((terms or usual) if np.ndim(P) == 2 else len(P)):
            weight = digits(P if np.ndim(P) == 2 else P[s])
            total += alpha ** (s + 1) * np.sum(weight * (late - early))
            late, early = queried(late), queried(early)
        return float(total)


KINDS = ["output", "full state", "singular W", "some outputs without noise"]


@pytest.mark.parametrize("discount", [1.0, 0.7])
@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=8, deadline=None)
@given(seed=SEEDS)
def test_the_value_of_a_query_is_the_sum_of_what_every_later_error_costs_less(kind, discount, seed):
    """Average and discount, errors and weights of any rank, against sixty digits of plain subtraction."""
    plant = random_plant(seed, kind)
    rng, n = np.random.default_rng(seed + 1), plant.states
    Sigma, P = (semidefinite(rng, n, int(rng.integers(1, n + 1))) for _ in range(2))
    found = query_value(Predictor(plant), Sigma, Weights(P, discount))
    assert found == pytest.approx(sixty_digits(plant, Sigma, P, discount), rel=1e-9, abs=1e-13 * np.trace(P))
    assert found >= 0


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=8, deadline=None)
@given(seed=SEEDS)
def test_of_a_mission_only_the_errors_until_its_end_count(kind, seed):
    """At tick k the weights of k + 1 … N − 1 are summed, each with its own error; the last query is worth nothing."""
    plant = random_plant(seed, kind)
    rng, n = np.random.default_rng(seed + 1), plant.states
    Sigma, P = semidefinite(rng, n), np.array([semidefinite(rng, n) for _ in range(9)])
    for tick in (0, 4, 7, 8):
        plain = sixty_digits(plant, Sigma, P[tick + 1 :]) if tick < 8 else 0.0
        assert query_value(Predictor(plant), Sigma, Weights(P), tick) == pytest.approx(plain, rel=1e-9, abs=1e-12)


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


TIMES = [{}, {"discount": 0.8}, {"discount": 0.5}, {"horizon": 1}, {"horizon": 17}]
times = pytest.mark.parametrize("time", TIMES, ids=str)


@times
@settings(max_examples=4, deadline=None)
@given(seed=SEEDS)
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
    """Return the cost of queries at given ticks and a send at each: E of (x, x̂) together, under gains of its own.

    Of an average: the mean over the last cycle; of a discounted sum: of so many ticks.
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
@settings(max_examples=6, deadline=None)
@given(seed=SEEDS)
def test_the_costs_of_remote_sensing_are_those_of_the_propagated_moments(time, seed):
    """J_all and what the exact identity starts from: average, discount and mission, N ≠ 0, a random start."""
    plant = random_plant(seed, largest=4)
    cost = with_cross_term(plant, seed, **time)
    price = float(np.random.default_rng(seed + 3).uniform(0, 2))
    policy = design.remote_lqg(plant, cost, theta=0.1, zeta=price)
    schedule = policy.schedule
    assert schedule is not None
    assert policy.identity is not None
    assume(policy.settling < 30)
    steps = cost.horizon or (600 if cost.discount == 1 else 200)
    assert policy.cost_all_time == pytest.approx(propagated(plant, cost, steps, [True] * steps), rel=1e-10)
    asked, here = [], 0
    for _ in range(steps + (schedule.period or 0)):
        asked.append(bool(schedule.queries[here]))
        here = here + 1 if here + 1 < len(schedule.queries) else schedule.start or 0
    whole = steps if cost.horizon is not None else len(asked)
    found = propagated(plant, cost, whole, asked, schedule.period or 1)
    assert policy.identity.constant == pytest.approx(found, rel=1e-10)


@pytest.mark.parametrize(
    "A", [np.array([[0.99]]), np.diag([0.99, 0.985]), np.array([[0.99, 1.0], [0.0, 0.99]])], ids=str
)
def test_the_tail_of_a_slow_filter_is_summed_at_once(monkeypatch, A):
    """An error that fades by 1 % a tick: the rest of the sum is one Lyapunov equation, and agrees with every term."""
    called = []
    monkeypatch.setattr(queries, "summed", lambda F, W, summed=queries.summed: called.append(1) or summed(F, W))
    n = len(A)
    plant = Plant(A, np.eye(n), 1e-6 * np.eye(n), np.eye(1, n) + np.eye(1, n, n - 1), [[10.0]])
    steady = steady_filter(A, plant.C, plant.W, plant.V)
    assert 0.98 < radius(A - A @ steady.gain @ plant.C) < 1
    value = query_value(Predictor(plant), 1.01 * steady.prior, Weights(np.eye(n)))
    assert value == pytest.approx(sixty_digits(plant, 1.01 * steady.prior, np.eye(n), terms=2500), rel=1e-9)
    assert called


@settings(max_examples=60, deadline=None)
@given(seed=SEEDS, discount=st.sampled_from([1.0, 0.6]))
def test_a_state_that_is_read_exactly_is_worth_the_error_it_ends(seed, discount):
    """C = I and V = 0: h(Σ) = α tr(PAΣA'), whatever the ranks of noise, error and weight."""
    plant, rng = random_plant(seed, "full state", 4), np.random.default_rng(seed + 1)
    n = plant.states
    Sigma, P = (semidefinite(rng, n, int(rng.integers(1, n + 1))) for _ in range(2))
    worth = discount * np.trace(P @ plant.A @ Sigma @ plant.A.T)
    assert query_value(Predictor(plant), Sigma, Weights(P, discount)) == pytest.approx(worth, rel=1e-9, abs=1e-12)


def test_noise_on_the_velocity_alone_leaves_a_schedule() -> None:
    """A double integrator that is measured exactly: its position is known in advance, and still has to be followed."""
    plant = Plant([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]], np.diag([0.0, 0.01]))
    for zeta, rate in ((0.0, 1.0), (0.1, 1 / 3)):
        policy = design.remote_lqg(plant, Cost(np.eye(2), [[1.0]]), theta=0.1, zeta=zeta)
        assert policy.schedule.rate == pytest.approx(rate)
        assert 1 <= policy.settling < 100


def test_a_query_that_tells_nothing_is_worth_nothing() -> None:
    """Where the output shows nothing, where nothing is uncertain, and where no error costs anything."""
    blind = Plant(np.diag([0.5, 0.9]), np.eye(2), np.eye(2), np.zeros((1, 2)), [[1.0]])
    seen = Plant(np.diag([0.5, 1.1]), np.eye(2), np.eye(2), [[1.0, 1.0]], [[1.0]])
    for plant, Sigma, P in (
        (blind, np.eye(2), np.eye(2)),
        (seen, np.zeros((2, 2)), np.eye(2)),
        (seen, np.eye(2), np.zeros((2, 2))),
    ):
        for weights in (Weights(P), Weights(P, 0.5), Weights(np.array([P] * 5))):
            assert query_value(Predictor(plant), Sigma, weights) == 0.0


def follow(plant: Plant, Sigma: np.ndarray, query: bool) -> np.ndarray:
    """Return the next covariance, by the formula."""
    following = plant.A @ Sigma @ plant.A.T + plant.W
    if query:
        cross = plant.A @ Sigma @ plant.C.T
        following = following - cross @ np.linalg.solve(plant.C @ Sigma @ plant.C.T + plant.V, cross.T)
    return (following + following.T) / 2


@pytest.mark.parametrize("time", [{}, {"discount": 0.8}, {"horizon": 30}], ids=str)
@settings(max_examples=6, deadline=None)
@given(seed=SEEDS)
def test_a_schedule_queries_where_it_is_worth_its_price_and_repeats_for_ever(time, seed):
    """Every tick, five more periods included: query iff h(Σ) > ζ, with the covariance that follows from it."""
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
    Sigma, here = schedule.covariance[0], 0
    if time:
        assert np.array_equal(Sigma, plant.covariance)
    for tick in range(len(schedule.queries) + 5 * (schedule.period or 0)):
        value = query_value(predictor, Sigma, weights, tick)
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
    """Half of the ticks at ζ = 1.65, two thirds at 1.5, and two thirds exactly from 1.4755 to 1.5398."""
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
        UnstableError, match=r"with zeta = 1 the sensor is never queried, and the plant is unstable: .*"
    ):
        design.remote_lqg(Plant([[2.0]], [[1.0]], [[0.0]]), WEIGHTS, theta=0.2, zeta=1.0)


def test_what_queries_cannot_settle_is_refused(monkeypatch) -> None:
    """A covariance that overflows before a query is worth its price, and one that drifts for longer than is waited."""
    with pytest.raises(UnstableError, match="overflows before a query is worth its price"):
        Predictor(SCALAR).follow(np.array([[1e155]]), False)
    monkeypatch.setattr(queries, "LONGEST", 40)
    slow = Plant([[1 - 1e-3]], [[1.0]], [[1.0]], [[1.0]], [[1e4]])
    with pytest.raises(
        UnstableError, match=r"with zeta = 1e\+09 the schedule of queries does not repeat within 40 ticks"
    ):
        schedule_queries(slow, Weights(np.eye(1), 0.1), 1e9, np.eye(1))
    with pytest.raises(UnstableError, match="the error covariance has not converged within 40 ticks"):
        follow_every_query(slow, np.eye(1), None)


def test_a_start_of_which_nothing_is_known_leaves_the_same_cycle() -> None:
    """A first covariance of 1e10 is forgotten with the first query: it decides neither the cycle nor its digits."""
    plant, weights = Plant([[1.1]], [[1.0]], [[0.01]], [[1.0]], [[0.02]]), Weights(np.array([[1.0]]), 0.9)
    usual, vague = (schedule_queries(plant, weights, 0.1, np.array([[size]])).repeating() for size in (1.0, 1e10))
    turns = [np.roll(vague.covariance[:, 0, 0], k) for k in range(vague.period)]
    assert usual.period == vague.period > 1
    assert any(turn == pytest.approx(usual.covariance[:, 0, 0], rel=1e-8) for turn in turns)


def test_a_schedule_says_what_it_is(tmp_path) -> None:
    """Its document is JSON, its table has a row per tick, its picture is drawn, and its cycle stands alone."""
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
        assert [axis.get_xlabel() for axis in shown.plot().axes] == ["", "tick"]
    assert shown.repeating().start is shown.period is None
