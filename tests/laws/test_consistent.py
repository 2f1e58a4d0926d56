"""Consistency: no worse than periodic control at its own rate, and silent without disturbances."""

from __future__ import annotations

import numpy as np
import pytest
from counts import few, scaled
from drawn import over
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from measured import average
from systems import continuous_system, price_of

from taciturn import ContinuousPlant, Cost, Jumps, Plant, ProblemError, close, design, simulate
from taciturn.model.policy import Policy
from taciturn.simulation.average import completed_squares, plain_average

SEEDS = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=3, deadline=None, suppress_health_check=[HealthCheck.too_slow])
DRAWN = {"seed": SEEDS, "share": st.sampled_from([0.3, 1.0])}
LAWS = ["wiener", "normal", "uniform", "two-point"]


def it_beats_periodic_control(seed: int, law: str, share: float, steps: int = 150_000) -> None:
    """V_p(r_p) ≤ V ≤ V_p(r), and V + δr ≤ V_p(r_p) + δr_p, as simulated."""
    plant, cost, period = continuous_system(seed, law)
    price = price_of(plant, cost)
    delta = share * price.slope_in_rate(period)
    assume(delta > 0)
    policy = design.consistent(plant, cost, period=period, delta=delta)
    found = average(close(plant, policy), seed=seed, steps=steps)
    rate, error = found.rates["sensor"], 4 * found.cost.standard_error
    assume(found.reached and rate.value > 0)
    least = rate.value - 4 * rate.standard_error  # periodic control is dearest at the lowest rate
    assume(least > 0)
    base, rounding = price.periodic(period), 1e-9 * price.periodic(period)
    assert found.cost.value + error >= base - rounding
    assert found.cost.value - error <= price.periodic(1 / least) + rounding
    assert policy.guarantee is not None
    assert found.cost.value - error <= policy.guarantee.at_rate(least * period) + rounding


@pytest.mark.parametrize("law", few(LAWS))
def test_a_consistent_policy_beats_periodic_control_at_its_own_rate(law: str) -> None:
    """A random plant for each law of the noise, thresholds up to the largest consistent one."""
    over(lambda seed, share: it_beats_periodic_control(seed, law, share, 100_000), 1, **DRAWN)


@pytest.mark.evidence
@pytest.mark.parametrize("law", LAWS)
def test_a_consistent_policy_beats_periodic_control_over_many_systems(law: str) -> None:
    """Three hundred random plants under Wiener noise, more than a hundred under jumps."""
    systems = 300 if law == "wiener" else scaled(40, 8)
    over(lambda seed, share: it_beats_periodic_control(seed, law, share), systems, **DRAWN)


@pytest.mark.evidence
@FEW
@given(seed=SEEDS)
def test_without_disturbances_nothing_is_sent(seed: int) -> None:
    """From a state that both ends know the prediction is exact, but for rounding that an unstable plant lets grow."""
    noisy, cost, period = continuous_system(seed, "wiener")
    start = np.random.default_rng(seed).normal(size=noisy.states)
    quiet = ContinuousPlant(noisy.A, noisy.B, np.zeros_like(noisy.A), mean=start)
    delta = price_of(noisy, cost).slope_in_rate(period)
    assume(delta > 0)
    growth = max(0.0, float(np.linalg.eigvals(noisy.A).real.max())) * period  # of rounding errors, per step
    ticks = int(min(200, 14 / max(growth, 1e-9)))
    path = simulate(close(quiet, design.consistent(quiet, cost, period=period, delta=delta)), ticks)
    assert not path.sends["sensor"].any()


@pytest.mark.parametrize("examples", [2, pytest.param(6, marks=pytest.mark.evidence)])
def test_the_exact_cost_is_the_average_of_the_stage_cost(examples: int) -> None:
    """Random plants under any law of the noise."""
    steps = 500_000 if examples > 2 else 100_000
    over(lambda seed, law: exact_is_average(seed, law, steps), examples, seed=SEEDS, law=st.sampled_from(LAWS))


def exact_is_average(seed: int, law: str, steps: int) -> None:
    """V = V_p + E[(1−σ)e'Γe]/τ against the plant's own cost, inter-sample noise included."""
    plant, cost, period = continuous_system(seed, law)
    assume(price_of(plant, cost).slope_in_rate(period) > 0)
    loop = close(plant, design.consistent(plant, cost, period=period))
    assume(loop.policy.theory.settling < 100)
    exact = average(loop, completed_squares(loop), seed=seed, steps=steps)
    plain = average(loop, plain_average(loop), seed=seed + 1, steps=2 * steps)
    assume(exact.reached and plain.reached)
    spread = np.hypot(exact.cost.standard_error, plain.cost.standard_error)
    assert abs(exact.cost.value - plain.cost.value) <= 4.5 * spread


@pytest.mark.evidence
def test_many_small_jumps_come_near_wiener_noise() -> None:
    """At a fixed intensity the rate of sending rises to that of Wiener noise with the rate of the jumps."""
    intensity = np.diag([0.0, 2.5])
    cost, A, B = Cost(np.eye(2), [[10.0]]), [[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]]
    found = []
    for rate in (5.0, 20.0, 80.0, None):
        jumps = None if rate is None else Jumps(rate, intensity / rate)
        plant = ContinuousPlant(A, B, intensity if jumps is None else None, jumps)
        loop = close(plant, design.consistent(plant, cost, period=0.1))
        found.append(average(loop, seed=1, steps=2_000_000).rates["sensor"])
    gaps = [found[-1].value - one.value for one in found[:-1]]
    error = 4 * np.hypot(found[-1].standard_error, found[-2].standard_error)
    assert gaps[0] - error > 2 * gaps[1] > 4 * gaps[2] - error
    assert abs(gaps[2]) <= 0.04 * found[-1].value


def test_a_threshold_above_its_largest_consistent_value_is_allowed_and_told() -> None:
    """No guarantee is shown; the largest value itself has one."""
    plant, cost = (
        ContinuousPlant([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], np.diag([0.0, 2.5])),
        Cost(np.eye(2), [[10.0]]),
    )
    largest = price_of(plant, cost).slope_in_rate(0.5)
    assert largest == pytest.approx(2.891818, abs=5e-7)
    for delta in (None, 0.0, largest):
        policy = design.consistent(plant, cost, period=0.5, delta=delta)
        assert policy.guarantee is not None
        assert policy.notes == ()
    above = design.consistent(plant, cost, period=0.5, delta=1.01 * largest)
    assert above.guarantee is None
    assert above.notes == ("delta = 2.92074 is above its largest consistent value 2.89182: consistency not guaranteed",)


SEEN = ([[0.0]], [[1.0]], [[1.0]], None, [[1.0]], [[0.1]])
Q, R = np.eye(2), [[1.0]]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"period": 0.0}, "period is 0; expected 0 < period"),
        ({"delta": -1.0}, "delta is -1; expected 0 ≤ delta"),
        ({"cost": Cost(Q, R, horizon=9)}, "cost.horizon is 9, which the policy kind consistent does not use"),
        ({"cost": Cost(Q, R, discount=0.9)}, "cost.discount is 0.9, which the policy kind consistent does not use"),
        (
            {"plant": Plant(Q, Q, Q)},
            "the plant is discrete in time, but the policy kind consistent predicts in continuous time; ",
        ),
        (
            {"plant": ContinuousPlant(*SEEN)},
            "C or V is given, but the policy kind consistent measures the full state; expected neither",
        ),
    ],
)
def test_what_does_not_fit_is_refused(change: dict, sentence: str) -> None:
    """One sentence each."""
    plant = ContinuousPlant([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], np.eye(2))
    with pytest.raises(ProblemError) as told:
        design.consistent(**{"plant": plant, "cost": Cost(Q, R), "period": 0.5, **change})
    assert str(told.value).startswith(sentence)


def extrapolated(a: float, gain: float, period: float, delta: float) -> tuple[np.ndarray, np.ndarray]:
    """Return cost and rate per second of a plant dx = (ax + u)dt + dw under u = −gain·x̂, on a fine grid, by path."""
    rng, paths, looks, parts = np.random.default_rng(0), 1000, 150, 25
    h = period / parts
    flow, push, spread = np.exp(a * h), np.expm1(a * h) / a, np.sqrt(np.expm1(2 * a * h) / (2 * a))
    x, seen, costs, sends = np.zeros((4, paths))
    for look in range(looks + 30):
        sent = gain**2 * 100 * period * (x - seen) ** 2 > delta
        seen = np.where(sent, x, seen)
        for k in range(parts):
            u = -gain * seen * np.exp(-gain * (k + 0.5) * h)  # the model of the design: closed loop −gain
            after = flow * x + push * u + spread * rng.standard_normal(paths)
            if look >= 30:
                costs += ((x * x + after * after) / 2 + 100 * u * u) * h
            x = after
        seen = seen * np.exp(-gain * period)
        if look >= 30:
            sends += sent
    return costs / looks / period, sends / looks / period


def test_the_actuator_predicts_with_the_model_of_the_design() -> None:
    """Where the plant in the loop is another one: an integrator is expected, an unstable plant is there."""
    cost, period = Cost([[1.0]], [[100.0]]), 4.0
    policy = design.consistent(ContinuousPlant([[0.0]], [[1.0]], [[1.0]]), cost, period=period)
    found = average(close(ContinuousPlant([[0.05]], [[1.0]], [[1.0]]), policy), standard_error=0.1)
    # Γ(τ) = τ L'RL to scale: the plant of the design has A = 0, so δ* = L'RL τ²/2
    costs, sends = extrapolated(0.05, 0.1, period, 0.1**2 * 100 * period**2 / 2)
    for value, error, seen in (
        (found.cost.value, found.cost.standard_error, costs),
        (found.rates["sensor"].value, found.rates["sensor"].standard_error, sends),
    ):
        assert abs(seen.mean() - value) <= 4 * np.hypot(error, seen.std() / np.sqrt(len(seen))) + 4e-3 * value


@pytest.mark.parametrize("kind", ["consistent", "integral"])
def test_a_clipped_input_that_changes_between_looks_is_refused(kind: str) -> None:
    """In the design, and where the plant in the loop has a limit."""
    free = ContinuousPlant([[0.0]], [[1.0]], [[1.0]])
    clipped = ContinuousPlant([[0.0]], [[1.0]], [[1.0]], input_limit=[2.0])
    cost = Cost([[1.0]], [[1.0]])

    def designed(plant: ContinuousPlant) -> Policy:
        if kind == "consistent":
            return design.consistent(plant, cost, period=0.1)
        policy = design.integral(plant, cost, slope=0.3, alpha=0.1, h_max=5.0, period=0.02)
        assert isinstance(policy, Policy)
        return policy

    with pytest.raises(
        ProblemError, match=r"input_limit is \[2.0\], but the input of this policy changes between steps"
    ):
        close(clipped, designed(free))
    with pytest.raises(
        ProblemError, match=r"input_limit is \[2.0\], but the input of this policy changes between steps"
    ):
        designed(clipped)
