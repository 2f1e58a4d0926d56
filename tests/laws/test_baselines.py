"""What the sources of the baselines prove of them, and what their rules say step by step."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from catalogue import closed, outputs, size_of, steep
from drawn import over
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from measured import average
from systems import System, make_system, systems

from taciturn import Cost, Plant, ProblemError, UnstableError, close, design, load, simulate
from taciturn.lqg.discrete import discretise
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.riccati import regulate
from taciturn.program.ops import Entry, Option, Sent
from taciturn.simulation.average import completed_squares, plain_average

SOME = settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def dynamic_sends_are_static_sends(system: System, rho: float, more: float, share: float, sends: list[int]) -> None:
    """Its credit is never negative, so that a send means |e|² > σ²|x̂|²."""
    policy = design.dynamic(system.plant, system.cost, sigma=share * steep(system), rho=rho, gain=more / rho)
    found = outputs(policy, system.seed, ticks=40)
    static, credit = found[Option("send", "silent")], found[Option("send", "send")]
    rounding = 1e-12 * np.abs(static).max()
    assert (credit >= -rounding).all()
    assert (static[found[Sent("actuator")] > 0] >= -rounding).all()
    sends.append(int(found[Sent("actuator")].sum()))


DYNAMIC = {
    "system": systems(states=4),
    "rho": st.floats(0.1, 0.95),
    "more": st.floats(1.0, 10.0),
    "share": st.floats(0.2, 3.0),
}


@pytest.mark.parametrize("examples", [pytest.param(300, marks=pytest.mark.evidence), 8])
def test_the_dynamic_trigger_sends_only_where_the_static_one_would(examples: int) -> None:
    """From the same state never more often; most systems send."""
    sends: list[int] = []
    over(dynamic_sends_are_static_sends, examples, **DYNAMIC, sends=st.just(sends))
    assert np.mean(np.array(sends) > 0) > 0.5


@pytest.mark.evidence
@SOME
@given(system=systems(states=4), rho=st.floats(0.3, 0.9), gain=st.floats(3.5, 10.0))
def test_the_first_send_of_the_dynamic_trigger_is_no_earlier(system: System, rho: float, gain: float) -> None:
    """From the same state on the same draws; with many sends to follow, it sends less often."""
    sigma = steep(system)
    shown = [
        outputs(policy, system.seed, paths=16)[Sent("actuator")] > 0
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
    rates = [average(close(plant, design.relative(plant, cost, sigma=0.3)), steps=500_000).rates["actuator"]]
    for gain in (10.0, 2.5, 1.25):
        policy = design.dynamic(plant, cost, sigma=0.3, rho=0.8, gain=gain)
        rates.append(average(close(plant, policy), steps=500_000).rates["actuator"])
    for more, less in pairwise(rates):
        assert more.value - less.value > 4 * np.hypot(more.standard_error, less.standard_error)


def silence_is_a_determinant(system: System, share: float) -> None:
    """P(silent for j steps) = det(I + cov(e_1 … e_j)(I ⊗ sW))^{-½} sums up to the rate."""
    scale = share / size_of(system) ** 2
    policy = design.stochastic(system.plant, system.cost, scale=scale, actuation="model")
    assert policy.theory.closed_form is not None
    rate, n = policy.theory.closed_form.rates["actuator"], system.plant.states
    assume(rate > 0.3)  # so that a few steps tell all
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


@pytest.mark.parametrize("examples", [pytest.param(300, marks=pytest.mark.evidence), 8])
def test_silence_of_the_stochastic_trigger_is_a_determinant(examples: int) -> None:
    """Its renewal formula against the joint law of the errors."""
    over(silence_is_a_determinant, examples, system=systems(states=3), share=st.floats(0.1, 5.0))


@pytest.mark.evidence
@SOME
@given(system=systems(states=4), share=st.floats(0.1, 1.0))
def test_send_on_delta_sends_where_an_output_has_moved(system: System, share: float) -> None:
    """Recomputed from the measurements alone."""
    delta = share * size_of(system)
    found = outputs(design.send_on_delta(system.plant, system.cost, delta=delta), system.seed, paths=1, ticks=80)
    y = np.array([found[Entry("y", i)][:, 0] for i in range(system.plant.outputs)]).T
    last = np.zeros(system.plant.outputs)
    for now, sent in zip(y, found[Sent("sensor")][:, 0], strict=True):
        assert bool(sent) == bool((np.abs(now - last) > delta).any())
        last = now if sent else last


def test_send_on_delta_with_a_vanishing_delta_is_all_time_control() -> None:
    """Cost and rate."""
    system = make_system(5, 2, 1, 1, False)
    found = average(closed(design.send_on_delta(system.plant, system.cost, delta=1e-6)), steps=500_000)
    assert found.rates["sensor"].value > 0.999
    assert (
        abs(found.cost.value - design.all_time(system.plant, system.cost).cost_all_time)
        <= 4 * found.cost.standard_error
    )


@SOME
@given(system=systems(states=3), fast=st.integers(1, 3), more=st.integers(0, 3), share=st.floats(0.05, 0.5))
def test_downsampled_intervals_are_fast_and_slow_looks(system: System, fast: int, more: int, share: float) -> None:
    """From a send to the next: fast + k·slow steps."""
    slow, threshold = fast + more, share * size_of(system)
    policy = design.downsampled(system.plant, system.cost, fast=fast, slow=slow, threshold=threshold)
    sends = np.flatnonzero(outputs(policy, system.seed, paths=1, ticks=100)[Sent("actuator")][:, 0])
    assert ((np.diff(sends) - fast) % slow == 0).all()


def test_rules_that_are_one_rule_send_at_the_same_ticks() -> None:
    """Downsampled at every step is absolute on the state; mixed is relative without threshold, absolute without σ."""
    system = make_system(8, 3, 2, 2, False)
    p, c = system.plant, system.cost
    pairs = [
        (design.downsampled(p, c, fast=1, slow=1, threshold=0.4), design.absolute(p, c, threshold=0.4, error="state")),
        (design.mixed(p, c, sigma=0.3, threshold=0.0), design.relative(p, c, sigma=0.3)),
        (design.mixed(p, c, sigma=0.0, threshold=0.4), design.absolute(p, c, threshold=0.4, error="state")),
    ]
    for one, other in pairs:
        sent = [outputs(policy, 4, ticks=100)[Sent("actuator")] for policy in (one, other)]
        assert (sent[0] == sent[1]).all()
        assert 0 < sent[0].mean() < 1


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


def test_silence_that_costs_without_end_is_refused() -> None:
    """A weight that does not see the unstable mode: rare long silences whose mean cost is infinite, or is not."""
    A, B, noise = [[1.1, 0.3], [0.0, 0.9]], [[0.0], [1.0]], [[0.1, 0.02], [0.02, 0.2]]
    plant, cost = Plant(A, B, noise, [[1.0, 0.0]], [[0.1]]), Cost([[1.0, 0.0], [0.0, 0.5]], [[0.3]])
    blind = [[0.0, 0.0], [0.0, 1.0]]
    with pytest.raises(UnstableError, match="mean cost is infinite"):
        design.stochastic(plant, cost, weight=blind, actuation="model")
    policy = design.stochastic(plant, cost, weight=blind, scale=100.0, actuation="model")  # ends silence soon enough
    assert policy.theory.closed_form is not None
    found = average(close(plant, policy), completed_squares(close(plant, policy)), steps=1_000_000)
    assert abs(found.cost.value - policy.theory.closed_form.cost) <= 5 * found.cost.standard_error


@pytest.mark.parametrize("scale", [0.5, 4.0])
def test_the_bound_of_the_stochastic_trigger_is_its_statement(scale: float) -> None:
    """J_all + 2μ/(e s), μ the least with L'HL ⪯ μW: a generalised eigenvalue of the weight as it was given."""
    system = make_system(21, 3, 2, 2, False)
    plant, cost, W = system.plant, system.cost, np.diag([1.0, 2.0, 3.0])
    found = design.stochastic(plant, cost, weight=W, scale=scale).guarantee
    assert found is not None
    assert found.statement.startswith("J ≤ J_all + 2μ/(e s), μ the least with L'HL ⪯ μW")
    best = regulate(plant.A, plant.B, cost.Q, cost.R, cost.N)
    mu = np.linalg.eigvals(np.linalg.solve(W, best.L.T @ best.H @ best.L)).real.max()
    everything = design.all_time(plant, cost).cost_all_time
    assert found.cost == pytest.approx(everything + 2 * mu / (np.e * scale), rel=1e-9)


@pytest.mark.parametrize("scale", [1e25, 1e99])
def test_a_stochastic_trigger_that_is_never_silent_is_all_time_control(scale: float) -> None:
    """The factor of rate and cost exists for every scale, also if I is lost in the rounding of the sum."""
    masses = load("two-mass-lqg")
    policy = design.stochastic(masses.plant, masses.cost, scale=scale, actuation="model")
    assert policy.theory.closed_form is not None
    assert policy.theory.closed_form.rates["actuator"] == 1
    assert policy.theory.closed_form.cost == pytest.approx(policy.cost_all_time, rel=1e-12)


def test_notes_say_why_there_is_no_bound() -> None:
    """A σ that is too large, and weights that do not see what costs."""
    system = make_system(21, 3, 2, 2, False)
    p, c = system.plant, system.cost
    for policy, word in (
        (design.relative(p, c, sigma=0.99), "the proof requires sigma < "),
        (design.absolute(p, c, threshold=1.0, weight=np.diag([1.0, 0.0])), "weight is zero for some errors"),
        (design.stochastic(p, c, weight=np.diag([1.0, 0.0, 0.0])), "weight is zero for some errors"),
    ):
        assert policy.guarantee is None
        assert word in policy.notes[0]


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda p, c: design.absolute(p, c, threshold=-1.0), "threshold is -1"),
        (lambda p, c: design.absolute(p, c, threshold=1.0, weight=[[0.0]]), "all entries of weight are 0"),
        (lambda p, c: design.absolute(p, c, threshold=1.0, weight=np.eye(2)), "weight has shape (2, 2)"),
        (lambda p, c: design.absolute(p, c, threshold=1.0, error="output"), "error is 'output'"),
        (lambda p, c: design.dynamic(p, c, sigma=0.1, rho=0.5, gain=1.0), "expected a gain of at least 1/rho = 2"),
        (lambda p, c: design.dynamic(p, c, sigma=0.1, rho=1.0, gain=2.0), "rho is 1"),
        (lambda p, c: design.downsampled(p, c, fast=3, slow=2, threshold=1.0), "expected slow ≥ fast"),
        (lambda p, c: design.self_triggered(p, c, beta=0.9, max_interval=3), "beta is 0.9"),
        (lambda p, c: design.self_triggered(p, c, beta=1.1, max_interval=101), "expected at most 100 steps"),
        (lambda p, c: design.rollout(p, c, horizon=20, every=2), "more than 256 schedules"),
        (lambda p, c: design.rollout(p, c, horizon=4, every=1), "every is 1"),
        (lambda p, c: design.periodic_schedule(p, c, length=3, sends=4), "at most as many sends as steps"),
        (lambda p, c: design.periodic_schedule(p, c, length=40, sends=20), "expected at most 2000"),
        (lambda p, c: design.stochastic(p, c, weight=[[0.0]]), "all entries of weight are 0"),
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
