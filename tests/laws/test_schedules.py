"""Rules that arrange their sends beforehand: rollout, self-triggered control, patterns, variances."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from catalogue import outputs
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from systems import System, make_system, systems

from taciturn import Cost, Plant, UnstableError, average, close, design
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.periodic import necklaces
from taciturn.lqg.riccati import regulate
from taciturn.model.disturbance import follow
from taciturn.model.signals import ExternalDisturbance
from taciturn.program.ops import Option, Sent

SOME = settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])


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
    assert periodic.theory.closed_form is not None
    assert policy.guarantee.cost == pytest.approx(periodic.theory.closed_form.cost, rel=1e-9)


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


@pytest.mark.parametrize("frequency", [0.2, 0.3, 0.31, 0.5, 1.0, 2.4])
def test_a_held_input_does_not_follow_a_sinusoid(frequency: float) -> None:
    """Whether its rounded cosines decay or grow; a constant disturbance is followed, and so is one that decays."""
    system = make_system(2, 2, 1, 1, False)
    wave = ExternalDisturbance(system.plant.B[:, 0], 0.1, "sinusoid", frequency=frequency)
    plant = follow(system.plant, disturbances=wave)
    for every in (2, (3, 1), 1000):
        with pytest.raises(UnstableError, match="the cost grows without limit and has no average"):
            design.periodic(plant, system.cost, every=every)
    with pytest.raises(UnstableError, match="the cost grows without limit and has no average"):
        design.periodic_schedule(plant, system.cost, length=4, sends=2)
    assert design.periodic(plant, system.cost, every=1).theory.closed_form is not None
    steady = follow(system.plant, disturbances=ExternalDisturbance(system.plant.B[:, 0], 0.1))
    assert design.periodic(steady, system.cost, every=2).theory.closed_form is not None


def test_the_sends_of_rollout_are_as_many_in_every_window() -> None:
    """Windows of six steps hold three sends each."""
    system = make_system(3, 3, 1, 2, False)
    policy = design.rollout(system.plant, system.cost, horizon=6, every=2)
    sent = outputs(policy, 1, ticks=120)[Sent("actuator")]
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
    sends = np.flatnonzero(found[Sent("actuator")][:, 0])
    allowed = np.array([found[Option(f"sleep {m}", "allowed")][:, 0] < 0 for m in range(2, 6)])
    said = np.array(
        [max([m for m, yes in zip(range(2, 6), allowed[:, k], strict=True) if yes], default=1) for k in sends]
    )
    assert (np.diff(sends) == said[:-1]).all()
    assert len(set(said)) > 2


@SOME
@given(system=systems(states=3, inputs=2), length=st.integers(2, 6), sends=st.integers(1, 6))
def test_the_pattern_is_the_best_of_all(system: System, length: int, sends: int) -> None:
    """By brute force over all places of the sends: value iteration of the periodic Riccati equation, step by step."""
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
    assert policy.theory.closed_form is not None
    assert policy.theory.closed_form.cost == pytest.approx(min(costs), rel=1e-8)


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


def test_variance_triggering_of_a_random_walk_is_counting() -> None:
    """Its variance grows by W a step: the first k with kW > threshold."""
    plant, cost = Plant([[1.0]], [[1.0]], [[0.5]]), Cost([[1.0]], [[1.0]])
    for threshold, ticks in ((0.4, 1), (0.5, 2), (1.2, 3), (4.9, 10)):
        policy = design.variance(plant, cost, threshold=threshold)
        assert policy.theory.closed_form is not None
        assert policy.theory.closed_form.rates == {"sensor": pytest.approx(1 / ticks)}
        H = regulate(plant.A, plant.B, cost.Q, cost.R, cost.N)
        error = np.mean([0.5 * k for k in range(ticks)])
        expected = float(H.K[0, 0]) * 0.5 + float((H.L.T @ H.H @ H.L)[0, 0]) * error
        assert policy.theory.closed_form.cost == pytest.approx(expected)


def test_an_unstable_plant_that_is_never_measured_is_refused() -> None:
    """Variance triggering with a threshold that the noise never reaches."""
    plant, cost = Plant([[1.2]], [[1.0]], [[0.0]]), Cost([[1.0]], [[1.0]])
    with pytest.raises(UnstableError, match="never queried"):
        design.variance(plant, cost, threshold=1.0)
