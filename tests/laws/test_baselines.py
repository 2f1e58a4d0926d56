"""What the sources of the baselines prove of them, and what their rules say tick by tick."""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import pytest
from catalogue import closed, size_of, steep
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from systems import System, make_system, systems

from taciturn import Cost, Plant, Policy, ProblemError, UnstableError, average, close, design, simulate
from taciturn.design.periodic_schedule import necklaces
from taciturn.lqg.discrete import discretise
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.riccati import regulate
from taciturn.program.numpy import run
from taciturn.renewal.chain import Chain
from taciturn.renewal.gaussian import solve_gaussian
from taciturn.simulation.average import plain_average

MANY = settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.too_slow])
SOME = settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def outputs(policy: Policy, seed: int, paths: int = 4, ticks: int = 60) -> dict[str, np.ndarray]:
    """Return what a loop shows, (ticks, paths) of each output."""
    loop = closed(policy)
    program = loop.program()
    return dict(run(program, loop.start(program, paths, seed), ticks).outputs)


def dynamic_sends_are_static_sends(system: System, rho: float, more: float, share: float, sends: list[int]) -> None:
    """Its credit is never negative, so that a send means |e|² > σ²|x̂|²."""
    policy = design.dynamic(system.plant, system.cost, sigma=share * steep(system), rho=rho, gain=more / rho)
    found = outputs(policy, system.seed, ticks=40)
    static, credit = found["option send silent"], found["option send send"]
    rounding = 1e-12 * np.abs(static).max()
    assert (credit >= -rounding).all()
    assert (static[found["sent actuator"] > 0] >= -rounding).all()
    sends.append(int(found["sent actuator"].sum()))


DYNAMIC = {
    "system": systems(states=4),
    "rho": st.floats(0.1, 0.95),
    "more": st.floats(1.0, 10.0),
    "share": st.floats(0.2, 3.0),
}


@pytest.mark.parametrize("examples", [pytest.param(300, marks=pytest.mark.evidence), 30])
def test_the_dynamic_trigger_sends_only_where_the_static_one_would(examples: int) -> None:
    """From the same state never more often; most systems send."""
    sends: list[int] = []
    law = given(**DYNAMIC, sends=st.just(sends))(dynamic_sends_are_static_sends)
    settings(MANY, max_examples=examples)(law)()
    assert np.mean(np.array(sends) > 0) > 0.5


@SOME
@given(system=systems(states=4), rho=st.floats(0.3, 0.9), gain=st.floats(3.5, 10.0))
def test_the_first_send_of_the_dynamic_trigger_is_no_earlier(system: System, rho: float, gain: float) -> None:
    """From the same state on the same draws; with many sends to follow, it sends less often."""
    sigma = steep(system)
    shown = [
        outputs(policy, system.seed, paths=16)["sent actuator"] > 0
        for policy in (
            design.dynamic(system.plant, system.cost, sigma=sigma, rho=rho, gain=gain),
            design.relative(system.plant, system.cost, sigma=sigma),
        )
    ]
    first = [np.where(sent.any(axis=0), sent.argmax(axis=0), len(sent)) for sent in shown]
    assert (first[0] >= first[1]).all()


def test_the_dynamic_trigger_sends_less_often() -> None:
    """On a double integrator at the same σ, beyond four standard errors, and ever less as the gain falls to 1/ρ."""
    plant = Plant([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]], 0.01 * np.eye(2))
    cost = Cost(np.eye(2), [[1.0]])
    rates = [average(close(plant, design.relative(plant, cost, sigma=0.3)), steps=2_000_000).rates["actuator"]]
    for gain in (10.0, 2.5, 1.25):
        policy = design.dynamic(plant, cost, sigma=0.3, rho=0.8, gain=gain)
        rates.append(average(close(plant, policy), steps=2_000_000).rates["actuator"])
    for more, less in pairwise(rates):
        assert more.value - less.value > 4 * np.hypot(more.standard_error, less.standard_error)


@SOME
@given(system=systems(states=4), every=st.integers(2, 3))
def test_the_bound_of_rollout_is_periodic_control_at_its_rate(system: System, every: int) -> None:
    """The number of the guarantee is the exact cost of the periodic controller."""
    try:
        policy = design.rollout(system.plant, system.cost, horizon=2 * every, every=every)
    except UnstableError:
        return
    periodic = design.periodic(system.plant, system.cost, every=every)
    assert policy.guarantee is not None
    assert periodic.closed_form is not None
    assert policy.guarantee.cost == pytest.approx(periodic.closed_form.cost, rel=1e-9)


def test_rollout_beats_periodic_control_at_its_rate() -> None:
    """On a double integrator, beyond four standard errors, whatever the window; its rate is 1/every."""
    plant = Plant([[1.0, 0.5], [0.0, 1.0]], [[0.125], [0.5]], np.diag([0.0, 0.2]))
    cost = Cost(np.eye(2), [[0.1]])
    for horizon in (2, 4):
        policy = design.rollout(plant, cost, horizon=horizon, every=2)
        found = average(close(plant, policy), steps=4_000_000)
        assert policy.guarantee is not None
        assert found.cost.value < policy.guarantee.cost - 4 * found.cost.standard_error
        assert abs(found.rates["actuator"].value - 0.5) <= 5 * found.rates["actuator"].standard_error


def test_the_sends_of_rollout_are_as_many_in_every_window() -> None:
    """Windows of six ticks hold three sends each."""
    system = make_system(3, 3, 1, 2, False)
    policy = design.rollout(system.plant, system.cost, horizon=6, every=2)
    sent = outputs(policy, 1, ticks=120)["sent actuator"]
    assert (sent.reshape(20, 6, -1).sum(axis=1) == 3).all()
    assert len({tuple(window) for window in sent[:, 0].reshape(20, 6)}) > 3


@SOME
@given(system=systems(states=3, inputs=2), ticks=st.integers(2, 5), beta=st.floats(1.0, 2.0))
def test_the_sleep_of_self_triggered_control_is_what_its_inequality_says(
    system: System, ticks: int, beta: float
) -> None:
    """By brute force: the mean cost of holding the best constant input, followed by β times the cost-to-go."""
    policy = design.self_triggered(system.plant, system.cost, beta=beta, max_interval=ticks)
    p, c = system.plant, system.cost
    found, seen = regulate(p.A, p.B, c.Q, c.R, c.N), steady_filter(p.A, p.C, p.W, p.V)
    fresh = seen.prior - seen.posterior
    all_time = policy.cost_all_time
    estimate = np.random.default_rng(system.seed).standard_normal(p.states)

    def expected(u: np.ndarray) -> float:
        mean, spread, total = estimate, np.zeros_like(p.A), 0.0
        for _ in range(ticks):
            total += mean @ c.Q @ mean + u @ c.R @ u + 2 * mean @ c.N @ u + np.trace(c.Q @ (spread + seen.posterior))
            mean, spread = p.A @ mean + p.B @ u, p.A @ spread @ p.A.T + fresh
        return float(total + beta * (mean @ found.K @ mean + np.trace(found.K @ spread)))

    base, unit = expected(np.zeros(p.inputs)), np.eye(p.inputs)
    slopes = np.array([(expected(e) - expected(-e)) / 2 for e in unit])
    curve = np.array([[expected(a + b) - expected(a) - expected(b) + base for a in unit] for b in unit])
    least = base - 0.5 * slopes @ np.linalg.solve(curve, slopes)
    allowed = beta * estimate @ found.K @ estimate + beta * ticks * all_time
    form = policy.decisions[f"sleep {ticks}"].options["allowed"]
    assert isinstance(form.Psi, np.ndarray)
    assert isinstance(form.constant, float)
    assert estimate @ form.Psi @ estimate + form.constant == pytest.approx(
        least - allowed, rel=1e-7, abs=1e-7 * allowed
    )


def test_self_triggered_control_sleeps_as_long_as_it_said() -> None:
    """From a send to the next: the largest interval that was allowed at the send."""
    system = make_system(13, 2, 1, 2, True)
    policy = design.self_triggered(system.plant, system.cost, beta=1.1, max_interval=5)
    found = outputs(policy, 2, paths=1, ticks=400)
    sends = np.flatnonzero(found["sent actuator"][:, 0])
    allowed = np.array([found[f"option sleep {m} allowed"][:, 0] < 0 for m in range(2, 6)])
    said = np.array(
        [max([m for m, yes in zip(range(2, 6), allowed[:, k], strict=True) if yes], default=1) for k in sends]
    )
    assert (np.diff(sends) == said[:-1]).all()
    assert len(set(said)) > 2


def silence_is_a_determinant(system: System, share: float) -> None:
    """P(silent for j ticks) = det(I + cov(e_1 … e_j)(I ⊗ sW))^{-½} sums up to the rate."""
    scale = share / size_of(system) ** 2
    policy = design.stochastic(system.plant, system.cost, scale=scale, actuation="model")
    assert policy.closed_form is not None
    rate, n = policy.closed_form.rates["actuator"], system.plant.states
    assume(rate > 0.3)  # so that a few ticks tell all
    seen = steady_filter(system.plant.A, system.plant.C, system.plant.W, system.plant.V)
    step, lengths = np.linalg.cholesky(seen.prior - seen.posterior + 1e-13 * np.eye(n)), []
    ticks = 36
    map_ = np.zeros((0, 0))
    for j in range(ticks):
        powers = [np.linalg.matrix_power(system.plant.A, j - i) @ step for i in range(j + 1)]
        map_ = np.block([[map_, np.zeros((len(map_), n))], [np.hstack(powers)]]) if j else step
        lengths.append(np.exp(-0.5 * np.linalg.slogdet(np.eye(len(map_)) + scale * map_ @ map_.T)[1]))
    tail = lengths[-1] * (lengths[-1] / lengths[-2]) / (1 - lengths[-1] / lengths[-2])
    assert 1 / (1 + sum(lengths) + tail) == pytest.approx(rate, rel=1e-6)


@pytest.mark.parametrize("examples", [pytest.param(300, marks=pytest.mark.evidence), 30])
def test_silence_of_the_stochastic_trigger_is_a_determinant(examples: int) -> None:
    """Its renewal formula against the joint law of the errors."""
    law = given(system=systems(states=3), share=st.floats(0.1, 5.0))(silence_is_a_determinant)
    settings(MANY, max_examples=examples)(law)()


@SOME
@given(system=systems(states=3, inputs=2), length=st.integers(2, 6), sends=st.integers(1, 6))
def test_the_pattern_is_the_best_of_all(system: System, length: int, sends: int) -> None:
    """By brute force over all places of the sends: value iteration of the periodic Riccati equation, tick by tick."""
    assume(sends <= length)
    p, c = system.plant, system.cost
    seen = steady_filter(p.A, p.C, p.W, p.V)
    fresh, n, m = seen.prior - seen.posterior, p.states, p.inputs
    F = np.block([[p.A, p.B], [np.zeros((m, n)), np.eye(m)]])
    stage = np.block([[c.Q, c.N], [c.N.T, c.R]])

    def cost_of(places: tuple[int, ...]) -> float:
        V = np.zeros((n + m, n + m))
        average = np.inf
        for _ in range(400):
            total, before = 0.0, average
            for tick in reversed(range(length)):
                total += float(np.trace(V[:n, :n] @ fresh))
                V = stage + F.T @ V @ F
                if tick in places:
                    best = V[:n, :n] - V[:n, n:] @ np.linalg.solve(V[n:, n:], V[n:, :n])
                    V = np.pad(best, ((0, m), (0, m)))
            average = np.trace(c.Q @ seen.posterior) + total / length
            if abs(average - before) <= 1e-12 * abs(average):
                return float(average)
        return np.inf  # or slow to converge

    costs = [cost_of((0, *others)) for others in combinations(range(1, length), sends - 1)]
    assume(np.isfinite(costs).all())
    policy = design.periodic_schedule(p, c, length=length, sends=sends)
    assert policy.closed_form is not None
    assert policy.closed_form.cost == pytest.approx(min(costs), rel=1e-8)


def test_necklaces_are_all_patterns_up_to_rotation() -> None:
    """Counted by hand and by force."""
    for length in range(1, 9):
        for sends in range(1, length + 1):
            listed = list(necklaces(length, sends))
            turned = {
                tuple(sorted([pattern[i:] + pattern[:i] for i in range(sends)])[-1]) for pattern in _sums(length, sends)
            }
            assert sorted(listed) == sorted(turned)


def _sums(length: int, sends: int) -> list[tuple[int, ...]]:
    marks = combinations(range(1, length), sends - 1)
    return [tuple(np.diff((0, *inner, length)).tolist()) for inner in marks]


@SOME
@given(system=systems(states=4), share=st.floats(0.1, 1.0))
def test_send_on_delta_sends_where_an_output_has_moved(system: System, share: float) -> None:
    """Recomputed from the measurements alone."""
    delta = share * size_of(system)
    found = outputs(design.send_on_delta(system.plant, system.cost, delta=delta), system.seed, paths=1, ticks=80)
    y = np.array([found[f"y {i}"][:, 0] for i in range(system.plant.outputs)]).T
    last = np.zeros(system.plant.outputs)
    for now, sent in zip(y, found["sent sensor"][:, 0], strict=True):
        assert bool(sent) == bool((np.abs(now - last) > delta).any())
        last = now if sent else last


def test_send_on_delta_with_a_vanishing_delta_is_all_time_control() -> None:
    """Cost and rate."""
    system = make_system(5, 2, 1, 1, False)
    found = average(closed(design.send_on_delta(system.plant, system.cost, delta=1e-6)), steps=4_000_000)
    assert found.rates["sensor"].value > 0.999
    assert (
        abs(found.cost.value - design.all_time(system.plant, system.cost).cost_all_time)
        <= 4 * found.cost.standard_error
    )


@SOME
@given(system=systems(states=3), fast=st.integers(1, 3), more=st.integers(0, 3), share=st.floats(0.05, 0.5))
def test_downsampled_intervals_are_fast_and_slow_looks(system: System, fast: int, more: int, share: float) -> None:
    """From a send to the next: fast + k·slow ticks."""
    slow, threshold = fast + more, share * size_of(system)
    policy = design.downsampled(system.plant, system.cost, fast=fast, slow=slow, threshold=threshold)
    sends = np.flatnonzero(outputs(policy, system.seed, paths=1, ticks=200)["sent actuator"][:, 0])
    assert ((np.diff(sends) - fast) % slow == 0).all()


def test_rules_that_are_one_rule_send_at_the_same_ticks() -> None:
    """Downsampled at every tick is absolute on the state; mixed is relative without threshold, absolute without σ."""
    system = make_system(8, 3, 2, 2, False)
    p, c = system.plant, system.cost
    pairs = [
        (design.downsampled(p, c, fast=1, slow=1, threshold=0.4), design.absolute(p, c, threshold=0.4, error="state")),
        (design.mixed(p, c, sigma=0.3, threshold=0.0), design.relative(p, c, sigma=0.3)),
        (design.mixed(p, c, sigma=0.0, threshold=0.4), design.absolute(p, c, threshold=0.4, error="state")),
    ]
    for one, other in pairs:
        sent = [outputs(policy, 4, ticks=300)["sent actuator"] for policy in (one, other)]
        assert (sent[0] == sent[1]).all()
        assert 0 < sent[0].mean() < 1


def test_impulse_control_by_events_has_a_third_of_the_variance_of_periodic_control() -> None:
    """An integrator under Wiener noise that impulses reset: 3 at equal rate, as the threshold passes many looks.

    With looks every tick the ratio is 3 + O(σ²/Y²): exactly, by quadrature; and as the policy simulates it.
    """
    plant, cost = Plant([[1.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1e-9]])  # free inputs: L = −1
    ratios = {}
    for threshold in (10.0, 20.0, 40.0):
        found = solve_gaussian(Chain(np.eye(1), np.eye(1), np.eye(1), threshold**2, np.eye(1)))
        ratios[threshold] = (1 / found.rate - 1) / 2 / found.excess  # of periodic control, W(N − 1)/2 every N ticks
        policy = design.absolute(plant, cost, threshold=threshold, error="state", actuation="model")
        loop = close(plant, policy)
        simulated = average(loop, steps=8_000_000)
        assert abs(simulated.rates["actuator"].value - found.rate) <= 4 * simulated.rates["actuator"].standard_error
        excess = simulated.cost.value - policy.cost_all_time
        assert abs(excess - found.excess) <= 4 * simulated.cost.standard_error + 1e-6 * found.excess
        every = round(1 / found.rate)
        clock = design.periodic(plant, cost, every=every, actuation="model").closed_form
        assert clock is not None
        assert clock.cost - policy.cost_all_time == pytest.approx((every - 1) / 2, rel=1e-6)
    limit = (4 * ratios[40.0] - ratios[20.0]) / 3  # the error falls with the square
    assert limit == pytest.approx(3, abs=2e-4)
    assert ratios[10.0] > ratios[20.0] > ratios[40.0] > 3


def test_variance_triggering_of_a_random_walk_is_counting() -> None:
    """Its variance grows by W a tick: the first k with kW > threshold."""
    plant, cost = Plant([[1.0]], [[1.0]], [[0.5]]), Cost([[1.0]], [[1.0]])
    for threshold, ticks in ((0.4, 1), (0.5, 2), (1.2, 3), (4.9, 10)):
        policy = design.variance(plant, cost, threshold=threshold)
        assert policy.closed_form is not None
        assert policy.closed_form.rates == {"sensor": pytest.approx(1 / ticks)}
        H = regulate(plant.A, plant.B, cost.Q, cost.R, cost.N)
        error = np.mean([0.5 * k for k in range(ticks)])
        expected = float(H.K[0, 0]) * 0.5 + float((H.L.T @ H.H @ H.L)[0, 0]) * error
        assert policy.closed_form.cost == pytest.approx(expected)


def test_a_vanishing_threshold_is_all_time_control() -> None:
    """Each rule, at the end of its parameter where it always sends."""
    system = make_system(21, 3, 1, 2, False)
    p, c = system.plant, system.cost
    for policy in (
        design.absolute(p, c, threshold=0.0),
        design.relative(p, c, sigma=0.0),
        design.mixed(p, c, sigma=0.0, threshold=0.0),
        design.dynamic(p, c, sigma=0.0, rho=0.5, gain=2.0),
        design.stochastic(p, c, scale=1e9),
        design.downsampled(p, c, fast=1, slow=1, threshold=0.0),
        design.self_triggered(p, c, beta=1.0, max_interval=1),
    ):
        found = average(closed(policy), steps=200_000)
        assert found.rates["actuator"].value > 0.999, policy.kind
        assert found.cost.value == pytest.approx(policy.cost_all_time, rel=1e-6), policy.kind


def test_notes_say_why_there_is_no_bound() -> None:
    """A σ that is too large, and weights that do not see what costs."""
    system = make_system(21, 3, 2, 2, False)
    p, c = system.plant, system.cost
    for policy, word in (
        (design.relative(p, c, sigma=0.99), "its proof ends at"),
        (design.absolute(p, c, threshold=1.0, weight=np.diag([1.0, 0.0])), "does not see"),
        (design.stochastic(p, c, weight=np.diag([1.0, 0.0, 0.0])), "does not see"),
    ):
        assert policy.guarantee is None
        assert word in policy.notes[0]


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda p, c: design.absolute(p, c, threshold=-1.0), "threshold is -1"),
        (lambda p, c: design.absolute(p, c, threshold=1.0, weight=[[0.0]]), "weight is zero"),
        (lambda p, c: design.absolute(p, c, threshold=1.0, weight=np.eye(2)), "weight has shape (2, 2)"),
        (lambda p, c: design.absolute(p, c, threshold=1.0, error="output"), "error is 'output'"),
        (lambda p, c: design.dynamic(p, c, sigma=0.1, rho=0.5, gain=1.0), "expected a gain of at least 1/rho = 2"),
        (lambda p, c: design.dynamic(p, c, sigma=0.1, rho=1.0, gain=2.0), "rho is 1"),
        (lambda p, c: design.downsampled(p, c, fast=3, slow=2, threshold=1.0), "expected slow ≥ fast"),
        (lambda p, c: design.self_triggered(p, c, beta=0.9, max_interval=3), "beta is 0.9"),
        (lambda p, c: design.self_triggered(p, c, beta=1.1, max_interval=101), "expected at most 100 ticks"),
        (lambda p, c: design.rollout(p, c, horizon=20, every=2), "184756 schedules"),
        (lambda p, c: design.rollout(p, c, horizon=4, every=1), "every is 1"),
        (lambda p, c: design.periodic_schedule(p, c, length=3, sends=4), "at most as many sends as ticks"),
        (lambda p, c: design.periodic_schedule(p, c, length=40, sends=20), "expected at most 2000"),
        (lambda p, c: design.stochastic(p, c, weight=[[0.0]]), "weight is zero"),
        (lambda p, c: design.stochastic(p, c, scale=0.0), "scale is 0"),
        (lambda p, c: design.variance(p, c, threshold=-1.0), "threshold is -1"),
        (lambda p, c: design.send_on_delta(p, c, delta=-1.0), "delta is -1"),
        (lambda p, c: design.relative(p, Cost(c.Q, c.R, horizon=5), sigma=0.1), "cost.horizon is 5"),
    ],
)
def test_bad_parameters_are_one_sentence(build, words: str) -> None:
    """What, got, expected."""
    plant, cost = Plant([[1.1]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
    with pytest.raises(ProblemError) as caught:
        build(plant, cost)
    assert words in str(caught.value)


def test_an_unstable_plant_that_is_never_measured_is_refused() -> None:
    """Variance triggering with a threshold that the noise never reaches."""
    plant, cost = Plant([[1.2]], [[1.0]], [[0.0]]), Cost([[1.0]], [[1.0]])
    with pytest.raises(UnstableError, match="never queried"):
        design.variance(plant, cost, threshold=1.0)


def test_plans_of_the_plain_estimator_agree_with_what_is_shown() -> None:
    """A trajectory shows the sends that the average counts."""
    system = make_system(14, 2, 1, 1, False)
    policy = design.downsampled(system.plant, system.cost, fast=1, slow=3, threshold=0.5)
    loop = close(system.plant, policy, cost=system.cost)
    found = average(loop, plain_average(loop), steps=2_000_000).rates["actuator"]
    sent = simulate(loop, 40_000).sends["actuator"].astype(float)
    spread = sent.reshape(100, -1).mean(axis=1).std(ddof=1) / 10
    assert abs(sent.mean() - found.value) <= 5 * np.hypot(spread, found.standard_error)
    assert discretise(system.plant, system.cost, None).tick == policy.tick
