"""The consistent dynamic trigger: consistent over random plants, the same by nodes as by cycles, and refusals."""

from __future__ import annotations

import json
from importlib import import_module

import numpy as np
import pytest
from counts import few, scaled
from drawn import over, rows
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from measured import average
from systems import continuous_system, price_of

import taciturn
from taciturn import ContinuousPlant, Cost, Jumps, ProblemError, close, design, simulate
from taciturn.lqg.prediction import PredictionCost
from taciturn.problem import parse
from taciturn.simulation.average import plain_average
from taciturn_events.cycles import estimate_cycles, sweep_thresholds
from taciturn_events.events import IntegralTrigger, JumpProcess
from taciturn_events.losing_thresholds import find_losses
from taciturn_events.policy import EventPolicy

SEEDS = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@pytest.fixture(autouse=True)
def fewer_cycles(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Search fixed points with a hundredth of the usual cycles, in the full counts with a fortieth."""
    cycles = 20_000 if request.node.get_closest_marker("evidence") is None else 50_000
    monkeypatch.setattr(import_module("taciturn_events.integral"), "CYCLES", cycles)


DOUBLE = ContinuousPlant([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], jumps=Jumps(5.0, np.diag([0.0, 0.5])))
WIENER = ContinuousPlant(DOUBLE.A, DOUBLE.B, DOUBLE.W)
COST = Cost(np.eye(2), [[10.0]])


def admissible(seed: int, law: str) -> tuple[ContinuousPlant, Cost, PredictionCost, float, float]:
    """Return a random plant under jumps, its cost, the price of its intervals, the longest, and the largest slope."""
    plant, cost, _ = continuous_system(seed, law)
    price = price_of(plant, cost)
    h_max = 5.0 / max(1.0, float(np.abs(np.linalg.eigvals(plant.A)).max()))
    limit = price.least_ratio(0.0, h_max)[0]
    assume(limit > 1e-3 * price.growth(h_max) / h_max)
    return plant, cost, price, h_max, limit


def it_beats_periodic_control(seed: int, law: str, cycles: int = 25_000) -> None:
    """J ≤ tr(PW) + c min(1, ε/E[θ]) ≤ J_per(E[θ]) at the fixed point of an admissible slope."""
    plant, cost, price, h_max, limit = admissible(seed, law)
    assert plant.jumps is not None
    policy = design.integral(plant, cost, slope=0.9 * limit, h_max=h_max)
    assert isinstance(policy, EventPolicy)
    found = estimate_cycles(policy.process, policy.trigger, cycles=cycles, seed=seed)
    assert found.undisturbed == 0
    mean, cost_of = found.interval.value, policy.cost_all_time + found.cost.value
    assert abs(mean - policy.alpha.value) <= 5 * np.hypot(found.interval.standard_error, policy.alpha.standard_error)
    error = 4 * found.cost.standard_error + 1e-9 * cost_of
    assert cost_of - error <= policy.bound(mean)
    assert cost_of - error <= price.periodic(mean + 4 * found.interval.standard_error)


@pytest.mark.evidence
def test_the_bound_of_the_dynamic_trigger_is_its_statement() -> None:
    """tr(PW) + c min(1, ε/E[θ]), c = αC: with P = W = 1, C = 0.4, α = 0.8, ε = 0.5 that is 1 + 0.32 · 0.5/2 at 2 s."""
    plant = ContinuousPlant([[0.0]], [[1.0]], jumps=Jumps(2.0, [[0.5]]))
    policy = design.integral(plant, Cost([[1.0]], [[1.0]]), slope=0.4, alpha=0.8, saturation=0.5, h_max=5.0)
    assert isinstance(policy, EventPolicy)
    assert policy.statement is not None
    assert policy.statement.startswith("J ≤ tr(PW) + alpha·slope·min(1, saturation/mean interval), ")
    assert (policy.bound(), policy.bound(2.0)) == (pytest.approx(1.32, rel=1e-12), pytest.approx(1.08, rel=1e-12))


@pytest.mark.evidence
def test_the_dynamic_trigger_beats_periodic_control_at_its_own_interval() -> None:
    """A random plant under jumps of normal size."""
    over(lambda seed: it_beats_periodic_control(seed, "normal", 20_000), 1, seed=SEEDS)


@pytest.mark.evidence
@pytest.mark.parametrize("law", ["normal", "uniform", "two-point"])
def test_the_dynamic_trigger_beats_periodic_control_over_many_plants(law: str) -> None:
    """Twenty random plants for each law of the jumps."""
    over(lambda seed: it_beats_periodic_control(seed, law), scaled(20, 4), seed=SEEDS)


@pytest.mark.parametrize("law", ["normal", "two-point"])
@settings(FEW, max_examples=2)
@given(seed=SEEDS)
@pytest.mark.evidence
def test_the_mean_interval_rises_with_alpha_from_above_it_to_below(law: str, seed: int) -> None:
    """Lemma 4.2: L(ε) > ε for a small ε, L(h_max) < h_max, and L never falls."""
    plant, _, price, h_max, slope = admissible(seed, law)
    assert plant.jumps is not None
    process = JumpProcess(plant.A, plant.jumps, price.S)
    alphas = h_max * np.array([0.001, 0.03, 0.1, 0.3, 0.6, 1.0])
    found = sweep_thresholds(
        process, slope * alphas, trigger=IntegralTrigger(1.0, h_max=h_max), cycles=10_000, seed=seed
    )
    means, errors = np.array([(one.interval.value, one.interval.standard_error) for one in found]).T
    assert means[0] - 4 * errors[0] > alphas[0]
    assert means[-1] + 4 * errors[-1] < h_max
    assert (np.diff(means) >= -4 * np.hypot(errors[1:], errors[:-1])).all()


LIMITS = [{}, {"h_max": 1.0}, {"saturation": 0.4}, {"h_min": 0.3, "h_max": 1.5}]


@pytest.mark.evidence
@pytest.mark.parametrize(
    "case", few([("jumps", limits) for limits in LIMITS] + [("Wiener", limits) for limits in LIMITS], quick=1)
)
def test_nodes_do_what_cycles_tell(case: tuple[str, dict]) -> None:
    """Rate and cost by the loop with its plant, by its exact identity, and by the cycles of the error alone."""
    plant, limits = DOUBLE if case[0] == "jumps" else WIENER, case[1]
    from taciturn_events.integral import sampled_error

    policy = design.integral(plant, COST, slope=8.0, alpha=0.15, period=0.05, **limits)
    loop = close(plant, policy)
    exact, plain = average(loop, seed=1, steps=500_000), average(loop, plain_average(loop), seed=2, steps=500_000)
    process = sampled_error(plant, price_of(plant, COST), 0.05)
    cycles = estimate_cycles(process, IntegralTrigger(1.2, **limits), cycles=30_000, seed=3)
    rate = exact.rates["sensor"]
    allowed = 4 * np.hypot(rate.standard_error, cycles.interval.standard_error / cycles.interval.value**2)
    assert abs(rate.value - 1 / cycles.interval.value) <= allowed
    told = price_of(plant, COST).base + cycles.cost.value
    assert abs(exact.cost.value - told) <= 4 * np.hypot(exact.cost.standard_error, cycles.cost.standard_error) + 1e-9
    assert abs(plain.cost.value - told) <= 4 * np.hypot(plain.cost.standard_error, cycles.cost.standard_error)
    path = simulate(loop, 4000, seed=4)
    ticks = np.flatnonzero(path.sends["sensor"])
    gaps = 0.05 * np.diff(ticks)
    assert gaps.min() >= limits.get("h_min", 0.0) - 1e-9
    assert gaps.max() <= limits.get("h_max", np.inf) + 1e-9
    if "h_min" in limits:
        assert policy.guarantee is None
    else:
        assert policy.guarantee is not None
        assert exact.cost.value - 4 * exact.cost.standard_error <= policy.guarantee.cost


@pytest.mark.evidence
def test_without_disturbances_nothing_is_sent() -> None:
    """The second property of consistency, by nodes and by an error that no jump has moved."""
    policy = design.integral(DOUBLE, COST, slope=4.0, alpha=0.3, period=0.05)
    quiet = ContinuousPlant(DOUBLE.A, DOUBLE.B, np.zeros((2, 2)), mean=[1.0, -2.0])
    started = design.integral(
        ContinuousPlant(DOUBLE.A, DOUBLE.B, jumps=DOUBLE.jumps, mean=[1.0, -2.0]),
        COST,
        slope=4.0,
        alpha=0.3,
        period=0.05,
    )
    assert not simulate(close(quiet, started), 2000).sends["sensor"].any()
    assert simulate(close(quiet, policy), 2000).sends["sensor"].any()  # a start that the other end does not know
    rare = ContinuousPlant(DOUBLE.A, DOUBLE.B, jumps=Jumps(1e-3, np.diag([0.0, 0.5])))
    endless = design.integral(rare, COST, slope=1e-3, alpha=1.0)
    found = estimate_cycles(endless.process, endless.trigger, cycles=2000)
    assert found.interval.value > 900  # every send waits for a jump


@pytest.mark.evidence
def test_looking_more_often_comes_to_every_instant() -> None:
    """The mean interval and the cost under jumps, looked at every 2 ms and watched between jumps."""
    watched = design.integral(DOUBLE, COST, slope=5.0, alpha=0.6, h_max=2.0)
    exact = estimate_cycles(watched.process, watched.trigger, cycles=100_000, seed=1)
    from taciturn_events.integral import sampled_error

    seen = sampled_error(DOUBLE, price_of(DOUBLE, COST), 0.002)
    found = estimate_cycles(seen, watched.trigger, cycles=20_000, seed=2)
    for one, other in ((exact.interval, found.interval), (exact.cost, found.cost)):
        allowed = 4 * np.hypot(one.standard_error, other.standard_error) + 0.004 * one.value
        assert abs(one.value - other.value) <= allowed


@pytest.mark.evidence
def test_wiener_noise_is_looked_at_and_the_resolution_is_told() -> None:
    """Without a period one is chosen; the note says what a finer one would change."""
    policy = design.integral(WIENER, COST, slope=8.0, h_max=2.0)
    fixed, note = policy.notes
    assert fixed.startswith("alpha = ")
    assert note.startswith("the error is checked every 0.0")
    assert "twice as often changes the mean interval by " in note
    assert policy.tick < 0.02


STABLE = ContinuousPlant([[-1.0]], [[1.0]], jumps=Jumps(2.0, [[0.5]]))
REFUSED = [
    ({"slope": 0.0}, "slope is 0; expected 0 < slope"),
    (
        {"slope": 10.0},
        "slope is 10, but the threshold f is below the cost of periodic control only up to a slope of 9.15569;",
    ),
    ({"slope": 9.0, "alpha": 3.0}, "alpha is 3, but the resulting mean interval L(alpha) is "),
    ({"slope": 5.0, "h_min": 3.0}, "h_max is 2; expected 3 < h_max"),
    ({"slope": 5.0, "h_min": -1.0}, "h_min is -1; expected 0 ≤ h_min"),
    ({"slope": 5.0, "saturation": 0.0}, "saturation is 0; expected 0 < saturation"),
    ({"slope": 5.0, "alpha": 0.0}, "alpha is 0; expected 0 < alpha"),
    ({"slope": 5.0, "alpha": 0.3, "period": -1.0}, "period is -1; expected 0 < period"),
    ({"slope": 1.0, "alpha": 0.3, "period": 0.5}, "period is 0.5, and the noise alone adds a cost of "),
    ({"slope": 5.0, "alpha": 0.3, "period": 3.0}, "period is 3 and h_max is 2; expected period ≤ h_max"),
    (
        {"slope": 5.0, "alpha": 0.3, "period": 0.01, "h_max": 1e4},
        "h_min, h_max or the saturation is 1000000 periods of 0.01 s",
    ),
    (
        {"slope": 0.1, "plant": STABLE, "cost": Cost([[1.0]], [[1.0]]), "h_max": np.inf},
        "no slope is admissible: the threshold f increases",
    ),
    (
        {"slope": 5.0, "cost": Cost(np.eye(2), [[10.0]], horizon=3)},
        "cost.horizon is 3, which the policy kind integral does not use",
    ),
    ({"slope": 5.0, "plant": ContinuousPlant(DOUBLE.A, DOUBLE.B, np.zeros((2, 2)))}, "the noise causes no error "),
]


@pytest.mark.parametrize(
    ("change", "sentence"), rows(REFUSED, quick=5), ids=lambda value: value[:30] if isinstance(value, str) else ""
)
def test_what_is_not_consistent_is_refused(change: dict, sentence: str) -> None:
    """With the admissible interval where there is one."""
    with pytest.raises(ProblemError) as told:
        design.integral(**{"plant": DOUBLE, "cost": COST, "h_max": 2.0, **change})
    assert str(told.value).startswith(sentence)


@pytest.mark.evidence
def test_a_policy_without_ticks_is_evaluated_and_has_no_loop() -> None:
    """Cost, rate, interval and both bounds in JSON; a loop of nodes wants a period."""
    tables = {
        "plant": {"A": [[0, 1], [0, 0]], "B": [[0], [1]], "jumps": {"rate": 5, "covariance": [[0, 0], [0, 0.5]]}},
        "cost": {"Q": [[1, 0], [0, 1]], "R": [[10]]},
        "policy": {"kind": "integral", "slope": 5.0, "alpha": 0.9, "h_max": 2.0},
    }
    problem = parse(tables, "here")
    found = taciturn.evaluate(problem, standard_error=0.01)
    document = json.loads(json.dumps(found.document(), allow_nan=False))
    assert document["base_rate"] is None
    assert document["reached"]
    assert document["cost"]["standard_error"] <= 0.01
    assert document["cost"]["value"] < document["cost_bound_at_rate"] <= document["cost_bound"]
    assert document["mean_interval"]["value"] * document["rates"]["sensor"]["value"] == pytest.approx(1)
    clipped = parse({**tables, "plant": {**tables["plant"], "input_limit": [1.0]}}, "here")
    with pytest.raises(
        ProblemError, match=r"plant.input_limit is given, which the policy integral without a period does not use"
    ):
        taciturn.evaluate(clipped)
    for refused in (problem.design, lambda: taciturn.evaluate(problem, method="exact")):
        with pytest.raises(ProblemError, match=r"expected policy.period|expected 'auto' or 'simulation'"):
            refused()


@pytest.mark.evidence
def test_a_weight_that_the_cost_does_not_know_can_lose_and_is_found_to() -> None:
    """Wiener noise by quadrature: the Euclidean norm loses where the weight of the cost does not."""
    skewed = ContinuousPlant([[1.0, 0.01], [0.0, 1.0]], np.eye(2), 50 * np.diag([0.001, 0.4]))
    weights = Cost(np.diag([10.0, 0.001]), np.diag([10.0, 0.001]))
    levels = [2.0, 4.0]
    euclidean = find_losses(skewed, weights, levels=levels, period=0.1)
    assert [point.cost.method for point in euclidean.points] == ["quadrature"] * 2
    assert all(point.loses for point in euclidean.points)
    ((low, high),) = euclidean.rates
    assert low < high
    own = find_losses(skewed, weights, price_of(skewed, weights).weight(0.1), levels=[0.02, 0.05], period=0.1)
    assert own.rates == ()
    assert json.loads(json.dumps(euclidean.document(), allow_nan=False))["points"][0]["loses"]
    assert euclidean.plot().axes[0].get_title().startswith("costs more at the rates")
    for wrong, sentence in (
        ({}, "period is missing; expected the seconds between checks"),
        ({"period": 0.1, "h_max": 1.0}, "h_max is given with Wiener noise"),
        (
            {"period": 0.1, "weight": np.zeros((2, 2))},
            "weight = 0 for every error that the noise causes",
        ),
    ):
        with pytest.raises(ProblemError, match=sentence):
            find_losses(skewed, weights, levels=levels, **wrong)
