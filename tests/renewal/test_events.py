"""Cycles of an error under jumps: known numbers, identities, laws of the jumps, and what a run depends on."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest
import scipy.linalg
from counts import few
from renewal.crossings import jumps
from scipy import stats

import taciturn_events.cycles as cycles_module
from taciturn._arrays import Array
from taciturn.errors import ProblemError, TaciturnError, UnstableError
from taciturn.model.estimate import Estimate
from taciturn.model.plant import Jumps
from taciturn.program import machine
from taciturn.program import numpy as interpreter
from taciturn.program.engine import prepare
from taciturn.program.machine import Kernel
from taciturn_events.cycles import CycleEstimate, estimate_cycles, sample_cycles, sweep_thresholds
from taciturn_events.events import (
    CycleTrigger,
    IntegralTrigger,
    JumpProcess,
    LevelTrigger,
    TaylorMotion,
    cycle_program,
    start_cycles,
)

K = np.array([[-0.316228, -0.855836]])
DOUBLE = JumpProcess(np.array([[0.0, 1.0], [0.0, 0.0]]), Jumps(5.0, np.diag([0.0, 0.5])), 10 * K.T @ K)
JUMP_COST = 21.395904  # tr(PλW) of the double integrator
# C: fixed point α* of α = E[θ], and J = tr(PλW) + g there; three and two digits after the point
FIXED_POINTS = {
    1: (0.330, 21.723), 2: (0.463, 22.296), 3: (0.640, 23.179), 4: (0.839, 24.308), 5: (1.020, 25.511),
    6: (1.168, 26.681), 7: (1.286, 27.783), 8: (1.380, 28.817), 9: (1.457, 29.79),
}  # fmt: skip
WALK = JumpProcess(np.zeros((1, 1)), Jumps(4.0, np.eye(1), "two-point"), np.eye(1))
LAWS = ("normal", "uniform", "two-point")


def near(found: Estimate, value: float, rounded: float = 0.0) -> bool:
    """Tell whether a value lies within four standard errors, and the error of its own rounding."""
    return abs(found.value - value) <= 4 * found.standard_error + rounded


def counterexample() -> JumpProcess:
    """Return the process where thresholds on the norm of the error cost more than sending periodically."""
    A, weight = np.array([[1.0, 0.01], [0.0, 1.0]]), np.diag([10.0, 0.001])
    L = gain(A, weight)
    return JumpProcess(A, Jumps(50.0, np.diag([0.001, 0.4])), L.T @ weight @ L)


def gain(A: Array, weight: Array) -> Array:
    """Return R^{-1}P with B = I and Q = R."""
    return np.asarray(np.linalg.solve(weight, scipy.linalg.solve_continuous_are(A, np.eye(2), weight, weight)))


@pytest.mark.parametrize("C", few(FIXED_POINTS, quick=2, start=1))
def test_the_fixed_points_of_the_double_integrator_are_the_known_ones(C: int) -> None:
    """The mean interval at c = Cα* is α*, and the cost is that of the table."""
    alpha, cost = FIXED_POINTS[C]
    found = sweep_thresholds(DOUBLE, [C * alpha], trigger=IntegralTrigger(1.0, h_max=2.0), cycles=300_000)[0]
    assert near(found.interval, alpha, 0.001)
    assert near(found.cost, cost - JUMP_COST, 0.001 * (1 + C))


@pytest.mark.parametrize("law", few(LAWS, quick=1, start=1))
@pytest.mark.parametrize(
    "trigger",
    [IntegralTrigger(5.0, h_max=0.3), IntegralTrigger(9.0, 0.2, 0.1), LevelTrigger(np.eye(2), 0.4, h_max=0.2)],
    ids=["linear", "saturating", "level"],
)
def test_no_cycle_ends_before_something_has_jumped(law: str, trigger: CycleTrigger) -> None:
    """The second property of consistency, in every one of 200,000 cycles, many of which end at h_max."""
    process = JumpProcess(DOUBLE.A, Jumps(5.0, np.diag([0.0, 0.5]), law), DOUBLE.S)
    assert estimate_cycles(process, trigger, cycles=200_000).undisturbed == 0


def test_a_cycle_that_ends_without_a_jump_is_counted() -> None:
    """An error that starts far out, which no jump has brought there."""
    program = cycle_program(DOUBLE, IntegralTrigger(5.0, h_max=2.0))
    states = start_cycles(DOUBLE, program, 500, 0)
    for row, state in zip(states, program.states, strict=True):
        if state.name == "error":
            row[:] = 30.0
    sums = prepare(program)(states, 400, None).sums
    ended = -np.expm1(-5 * 0.001)  # chance of a jump before the integral gets there, at the most
    assert sums["undisturbed"].sum() == pytest.approx(500 * (1 - ended), abs=10)


@pytest.mark.parametrize("count", [1_000_000, pytest.param(40_000_000, marks=pytest.mark.evidence)])
def test_the_double_integrator_at_its_steepest_threshold(count: int) -> None:
    """E[θ] and g at the fixed point of C = 9.1557, and E[θ] where α is not one."""
    found = estimate_cycles(DOUBLE, IntegralTrigger(9.1557 * 1.46812, h_max=2.0), cycles=count)
    assert near(found.interval, 1.46812, 4 * 0.00014)
    assert near(found.cost, 8.5418, 4 * 0.0007)
    other = estimate_cycles(DOUBLE, IntegralTrigger(9.1557 * 1.5, h_max=2.0), cycles=count)
    assert near(other.interval, 1.47742, 4 * 0.00014)


def test_the_counterexample_costs_what_is_known() -> None:
    """The integral trigger has g = c almost, the threshold on the norm costs twice the periodic one."""
    process = counterexample()
    integral = estimate_cycles(process, IntegralTrigger(1.2, h_max=10.0), cycles=100_000)
    assert near(integral.interval, 0.971, 0.001)
    assert near(integral.cost, 1.2, 0.001)
    level = estimate_cycles(process, LevelTrigger(np.eye(2), 4.0, h_max=10.0), cycles=200_000)
    assert near(level.interval, 0.256, 0.001)
    assert near(level.cost, 0.858, 0.001)


@pytest.mark.parametrize("c", [0.3, 5.0, 40.0])
@pytest.mark.parametrize("law", few(LAWS, quick=1, start=2))
def test_a_linear_threshold_without_end_costs_its_slope(c: float, law: str) -> None:
    """Every cycle ends where its cost is cβ, so that g = c to rounding."""
    jumps = Jumps(5.0, np.array([[0.3, 0.1], [0.1, 0.5]]), law)  # type: ignore[arg-type]
    for A in (DOUBLE.A, np.array([[0.1, 2.0], [-2.0, 0.1]])):
        found = estimate_cycles(JumpProcess(A, jumps, np.eye(2)), IntegralTrigger(c), cycles=20_000)
        assert abs(found.cost.value - c) < 1e-9 * c
        assert found.cost.standard_error < 1e-9 * c


@pytest.mark.parametrize("h", few([0.3, 1.0, 2.5], quick=1, start=1))
def test_a_trigger_that_never_fires_sends_periodically(h: float) -> None:
    """All intervals are h_max, and the cost is the cubic of the periodic design."""
    for trigger in (LevelTrigger(np.eye(2), 1e12, h), IntegralTrigger(1e12, h_max=h)):
        found = estimate_cycles(DOUBLE, trigger, cycles=300_000)
        assert found.interval.value == pytest.approx(h, rel=1e-12)
        assert near(found.cost, 0.208333 * h**3 + 2.255326 * h**2 + 9.155694 * h, 1e-5)


def test_a_growing_error_costs_what_the_exponential_says() -> None:
    """A scalar with ė = ae: the mean cost of a period is λW∫∫e^{2ar}."""
    a, h = 0.7, 1.5
    process = JumpProcess(np.array([[a]]), Jumps(3.0, np.eye(1), "uniform"), np.eye(1))
    found = estimate_cycles(process, LevelTrigger(np.eye(1), 1e12, h), cycles=500_000)
    assert near(found.cost, 3.0 * (np.expm1(2 * a * h) / (2 * a) - h) / (2 * a) / h)


def test_no_bias_is_left_of_the_last_cycle() -> None:
    """A walk of steps ±1 that is sent at ±2: four jumps per cycle, two of the waits at distance one."""
    totals = np.zeros(3)
    for seed in range(6):
        found = estimate_cycles(WALK, LevelTrigger(np.eye(1), 4.0), cycles=30_000, seed=seed)
        totals += found.cycles * found.interval.value * np.array([1.0, found.cost.value, 1 / found.interval.value])
    duration, cost, cycles = totals
    assert abs(duration / cycles - 1.0) < 4 * np.sqrt(0.75 / cycles)  # the variance of θ is 12/λ²
    assert abs(cost / cycles - 0.5) < 4 * np.sqrt(0.5 / cycles)


def test_standard_errors_are_honest() -> None:
    """Estimates of many seeds scatter as they say."""
    found = [estimate_cycles(WALK, LevelTrigger(np.eye(1), 4.0), cycles=3000, seed=seed) for seed in range(100)]
    for value, pick in ((1.0, lambda one: one.interval), (0.5, lambda one: one.cost)):
        estimates = [pick(one) for one in found]
        scores = [(one.value - value) / one.standard_error for one in estimates]
        assert stats.chi2(len(scores)).cdf(float(np.square(scores).sum())) == pytest.approx(0.5, abs=0.4999)


def test_a_standard_error_is_met() -> None:
    """The precision that is asked for is reached, and not far beyond."""
    found = estimate_cycles(DOUBLE, IntegralTrigger(5.0, h_max=2.0), standard_error=0.002)
    assert found.interval.standard_error < 0.0021
    finer = estimate_cycles(DOUBLE, IntegralTrigger(5.0, h_max=2.0), standard_error=0.0005)
    assert 0.0003 < finer.interval.standard_error < 0.00052


@pytest.mark.parametrize(
    "A", few([DOUBLE.A, np.array([[0.1, 2.0], [-2.0, -0.3]])], quick=1, start=1), ids=["integrators", "spiral"]
)
@pytest.mark.parametrize(
    ("law", "trigger"),
    [
        ("normal", IntegralTrigger(4.0, h_max=2.0)),
        ("uniform", IntegralTrigger(4.0, saturation=0.5, h_min=0.1, h_max=2.0)),
        ("two-point", LevelTrigger(np.array([[2.0, 0.5], [0.5, 1.0]]), 1.5)),
    ],
    ids=LAWS,
)
def test_the_parity_build_has_the_bits_of_numpy(A: Array, law: str, trigger: CycleTrigger) -> None:
    """And the fast build decides alike, but for rare roundings."""
    process = JumpProcess(A, Jumps(5.0, np.array([[0.2, 0.1], [0.1, 0.5]]), law), np.eye(2))  # type: ignore[arg-type]
    program, paths = cycle_program(process, trigger), 21
    states = start_cycles(process, program, paths, 3)
    expected = interpreter.run(program, states, 150)
    parity, fast = [Kernel(program, build).run(program, states, 150) for build in ("parity", "fast")]
    for name, value in expected.outputs.items():
        assert value.tobytes() == np.ascontiguousarray(parity.outputs[name]).tobytes()
    assert expected.states.tobytes() == parity.states.tobytes()
    near = np.isclose(fast.outputs["duration"], expected.outputs["duration"], rtol=0, atol=1e-10).all(axis=0)
    assert near.sum() >= paths - 2


def test_without_llvm_the_estimates_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    """NumPy runs the same program on the same draws."""
    trigger = IntegralTrigger(4.0, h_max=2.0)
    expected = estimate_cycles(DOUBLE, trigger, cycles=2000)
    monkeypatch.setattr(machine, "available", lambda: False)
    found = estimate_cycles(DOUBLE, trigger, cycles=2000)
    assert found.interval.value == pytest.approx(expected.interval.value, rel=1e-9)
    assert found.cost.value == pytest.approx(expected.cost.value, rel=1e-9)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(
    "W", few([np.array([[2.0, 0.6], [0.6, 0.5]]), np.diag([0.0, 0.5])], quick=1, start=1), ids=["full", "singular"]
)
def test_jumps_have_their_covariance_and_their_law(law: str, W: Array) -> None:
    """Whitened, each entry has the fourth moment of its law; waits are exponential; nothing is correlated in time."""
    process = JumpProcess(np.zeros((2, 2)), Jumps(5.0, W, law), np.eye(2))  # type: ignore[arg-type]
    waits, sizes = jumps(process, 8000, 20, seed=11)
    drawn = sizes.transpose(1, 0, 2).reshape(2, -1)
    count = drawn.shape[1]
    assert np.abs(drawn.mean(axis=1)).max() < 4 * np.sqrt(W.max() / count)
    assert np.abs(drawn @ drawn.T / count - W).max() < 4 * np.sqrt(3 * W.max() ** 2 / count)
    if law != "normal" and W[0, 0] == 0:
        last = drawn[1] / np.sqrt(W[1, 1])
        assert np.abs(last).max() <= (1.0 if law == "two-point" else np.sqrt(3)) + 1e-12
    fourth = {"normal": 3.0, "uniform": 1.8, "two-point": 1.0}[law]
    last = drawn[1] / np.sqrt(W[1, 1])
    if W[0, 0] == 0:
        assert abs((last**4).mean() - fourth) < 4 * np.sqrt(96 / count)
    assert stats.kstest(5.0 * waits.ravel(), "expon").pvalue > 1e-4
    assert abs(np.corrcoef(sizes[:-1, 1].ravel(), sizes[1:, 1].ravel())[0, 1]) < 4 / np.sqrt(count)
    assert abs(np.corrcoef(waits[1:].ravel(), sizes[:, 1].ravel())[0, 1]) < 4 / np.sqrt(count)


def test_the_jumps_are_the_same_whatever_the_trigger() -> None:
    """Neighbouring values of c differ by much less than their standard errors say."""
    one, other = sweep_thresholds(DOUBLE, [9.0, 9.001], trigger=IntegralTrigger(1.0, h_max=2.0), cycles=100_000)
    change = other.interval.value - one.interval.value
    assert 0 < change < 0.2 * one.interval.standard_error


def test_seeds_repeat_and_threads_change_nothing() -> None:
    """The seed alone decides."""
    trigger = IntegralTrigger(5.0, h_max=2.0)

    def run(seed: int, threads: int | None = None) -> CycleEstimate:
        return estimate_cycles(DOUBLE, trigger, cycles=20_000, seed=seed, threads=threads)

    assert run(1) == run(1) == run(1, threads=1) == run(1, threads=3)
    assert run(1) != run(2)
    few = sample_cycles(DOUBLE, trigger, cycles=80, paths=8)
    more = sample_cycles(DOUBLE, trigger, cycles=240, paths=24, threads=3)
    np.testing.assert_array_equal(few.durations, more.durations[:80])


def test_a_sample_has_the_mean_of_the_estimate() -> None:
    """Cycle by cycle or in sums; a share of the cycles lasts to h_max."""
    trigger = IntegralTrigger(5.0, h_max=2.0)
    sample, found = sample_cycles(DOUBLE, trigger, cycles=100_000, seed=3), estimate_cycles(DOUBLE, trigger)
    error = sample.durations.std() / np.sqrt(len(sample.durations))
    assert abs(sample.durations.mean() - found.interval.value) < 4 * np.hypot(error, found.interval.standard_error)
    assert sample.durations.max() == 2.0
    assert 0 < (sample.durations == 2.0).mean() < 1
    sent = sample.durations < 2.0
    np.testing.assert_allclose(sample.costs[sent], 5.0 * sample.durations[sent], rtol=1e-9)
    assert (sample.costs[~sent] <= 10.0).all()


def test_the_shortest_interval_is_kept() -> None:
    """No interval is shorter than h_min, and many are as short."""
    sample = sample_cycles(DOUBLE, IntegralTrigger(5.0, h_min=0.4, h_max=2.0), cycles=20_000)
    assert sample.durations.min() == pytest.approx(0.4, rel=1e-15)
    assert (sample.durations < 0.4 + 1e-12).mean() > 0.05


def test_units_of_time_and_error_decide_nothing() -> None:
    """Seconds or years, metres or nanometres: the same cycles."""
    s, m = 3e7, 1e-9
    W, units = m**2 * np.diag([0.0, 0.5 / s**2]), np.array([1.0, s]) / m
    scaled = JumpProcess(DOUBLE.A, Jumps(5.0 / s, W), DOUBLE.S * np.outer(units, units) / s)
    plain = sample_cycles(DOUBLE, IntegralTrigger(5.0, h_max=2.0), cycles=5000)
    other = sample_cycles(scaled, IntegralTrigger(5.0 / s, h_max=2.0 * s), cycles=5000)
    np.testing.assert_allclose(other.durations / s, plain.durations, rtol=1e-9)


def test_pieces_end_where_the_series_is_exact_to_rounding() -> None:
    """Integrators in any order need no short pieces; the rest is cut to a quarter of its time constant."""
    assert TaylorMotion(np.array([[0.0, 0.0], [1e3, 0.0]]), 1.0, 64.0).longest == 64.0
    assert TaylorMotion(np.array([[0.0, 1e6], [0.0, -1.0]]), 1.0, 64.0).longest > 1e-4
    assert TaylorMotion(-50 * np.eye(2), 1.0, 64.0).longest == pytest.approx(0.25 / 50)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: IntegralTrigger(0.0), "c is 0; expected 0 < c"),
        (lambda: IntegralTrigger(-1.0), "c is -1"),
        (lambda: IntegralTrigger(inf), "expected a finite number"),
        (lambda: IntegralTrigger(1.0, saturation=0.0), "saturation is 0"),
        (lambda: IntegralTrigger(1.0, h_min=-0.1), "h_min is -0.1"),
        (lambda: IntegralTrigger(1.0, h_min=2.0, h_max=2.0), "h_max is 2; expected 2 < h_max"),
        (lambda: IntegralTrigger(1.0, h_max=float("nan")), "h_max is nan"),
        (lambda: LevelTrigger(np.eye(2), 0.0), "level is 0"),
        (lambda: LevelTrigger(-np.eye(2), 1.0), "Psi has the eigenvalue -1"),
        (lambda: LevelTrigger(np.eye(2), 1.0, h_max=0.0), "h_max is 0"),
        (lambda: JumpProcess(np.eye(2), Jumps(1.0, np.eye(3)), np.eye(2)), "jumps.covariance has shape"),
        (lambda: JumpProcess(np.eye(2), Jumps(1.0, np.eye(2)), np.eye(3)), "S has shape"),
        (lambda: JumpProcess(np.eye(2), 5, np.eye(2)), "jumps is 5; expected a Jumps"),
        (lambda: estimate_cycles(DOUBLE, LevelTrigger(np.eye(3), 1.0)), "Psi has shape"),
        (lambda: estimate_cycles(DOUBLE, 3.0), "trigger is a float"),
        (lambda: estimate_cycles(DOUBLE, IntegralTrigger(1.0), cycles=0), "cycles is 0"),
        (lambda: estimate_cycles(DOUBLE, IntegralTrigger(1.0), cycles=9, standard_error=1.0), "both given"),
        (lambda: estimate_cycles(DOUBLE, IntegralTrigger(1.0), standard_error=0.0), "standard_error is 0"),
        (lambda: estimate_cycles(DOUBLE, IntegralTrigger(1.0), seed=-1), "seed is -1"),
        (lambda: sample_cycles(DOUBLE, IntegralTrigger(1.0), cycles=0), "cycles is 0"),
    ],
)
def test_what_means_nothing_is_refused_in_a_sentence(make, said: str) -> None:  # type: ignore[no-untyped-def]
    """What was got and what was expected."""
    with pytest.raises(ProblemError) as caught:
        make()
    assert said in str(caught.value)


def test_a_cycle_that_never_ends_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """A decaying error, and a threshold that it cannot reach; an error that grows where no one looks."""
    monkeypatch.setattr(cycles_module, "ENDLESS", 2000)
    decaying = JumpProcess(-np.eye(1), Jumps(5.0, np.eye(1), "two-point"), np.eye(1))
    for trigger in (IntegralTrigger(1e6), LevelTrigger(np.eye(1), 1e9)):
        with pytest.raises(UnstableError, match="finite h_max"):
            estimate_cycles(decaying, trigger, cycles=100)
        with pytest.raises(UnstableError, match="finite h_max"):
            sample_cycles(decaying, trigger, cycles=10)
    unseen = JumpProcess(np.diag([5.0, 0.0]), Jumps(5.0, np.eye(2)), np.eye(2))
    with pytest.raises(TaciturnError):
        estimate_cycles(unseen, LevelTrigger(np.diag([0.0, 1.0]), 1e7), cycles=100)


def test_a_sweep_over_no_list_is_refused() -> None:
    """A text, a matrix, or nothing."""
    for wrong in ("1", [[1.0]], None):
        with pytest.raises(ProblemError, match="cs "):
            sweep_thresholds(DOUBLE, wrong)
