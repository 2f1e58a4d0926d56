"""Averages begin when the loop of the policy has settled, which may take much longer than if it always sent."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
from counts import few

import taciturn
from taciturn.problem import Problem, parse
from taciturn.program.ops import Sent
from taciturn.simulation.average import average, plain_average
from taciturn.simulation.reliability import drifts_of
from taciturn.simulation.sampling import History, Part, Sampling, Snapshots, paths_of
from taciturn_rare.violations import violations

TANK = """
[plant]
A = [[1, 0.1], [0, 0.9]]
B = [[0], [0.1]]
C = [[1.0, 0]]
W = [[0.0001, 0], [0, 0.0004]]
V = [[0.001]]
dt = 0.1
{limit}
[cost]
Q = [[1.0, 0], [0, 0]]
R = [[0.05]]
[controller]
pid = {{kp = 1.2, ki = 0.15, kd = 1.0, filter = 0.5, setpoint = {setpoint}}}
disturbance = "none"
[limits]
outputs = [[1.0, 0.0]]
high = [{high}]
[policy]
kind = "excess"
theta = {theta}
"""
SELDOM = """
[plant]
A = [[0.99, 0.05], [0.0, 0.9]]
B = [[0.0], [0.1]]
C = [[1.0, 0.0]]
W = [[0.0001, 0], [0, 0.0001]]
V = [[0.001]]
dt = 0.1
[cost]
Q = [[0.05, 0], [0, 0]]
R = [[1.0]]
[policy]
kind = "excess"
theta = 0.5
"""
FOLLOWED = """
[plant]
A = [[0.9]]
B = [[1.0]]
C = [[1.0]]
W = [[0.1]]
V = [[0.1]]
dt = 1.0
[cost]
Q = [[1.0]]
R = [[1.0]]
[nodes.s]
measures = true
[nodes.c]
controls = true
[nodes.a]
applies = true
[reference]
value = [0.0]
steps = {rate = 0.05, covariance = [[1.0]]}
[policy]
kind = "distributed"
theta = 0.4
"""
UNREGULATED = """
[plant]
A = [[0.9, 0.0], [0.0, 0.8]]
B = [[1.0], [0.0]]
C = [[1.0, 0.0], [0.0, 1.0]]
W = [[0.1, 0], [0, 0.1]]
V = [[0.1, 0], [0, 0.1]]
dt = 1.0
[cost]
Q = [[1.0, 0], [0, 0.0]]
R = [[0.1]]
[nodes.s0]
measures = [0]
[nodes.s1]
measures = [1]
[nodes.c]
controls = true
applies = true
[[disturbance]]
enters = [0.3, 0.5]
wander = 0.01
[reference]
outputs = [[1.0, 0.0]]
[policy]
kind = "distributed"
theta = 0.5
"""
SURE = 4.0  # standard errors


def tank(setpoint: float, theta: float = 0.5, limit: str = "") -> Problem:
    """Return a level under a PID controller: while the policy is silent, its integrator forgets 8 times as slowly."""
    text = TANK.format(setpoint=setpoint, high=setpoint + 0.13, theta=theta, limit=limit)
    return parse(tomllib.loads(text), "tank")


@pytest.mark.parametrize("setpoint", [2.0, 200.0])
def test_paths_in_stationary_operation_have_forgotten_the_step_to_the_set_point(setpoint: float) -> None:
    """All states are deviations from the set-point, whose means are zero by symmetry."""
    problem = tank(setpoint)
    loop = problem.close(problem.design())
    part = Part(loop, plain_average(loop))
    (states,), _, settled = Sampling([part], 3, None, None).settle(1024, 10**9)
    named = [i for i, state in enumerate(part.estimator.program.states) if state.name in ("x", "next register")]
    assert settled
    assert len(named) == 4
    means, errors = states[named].mean(axis=1), states[named].std(axis=1) / np.sqrt(states.shape[1])
    assert (np.abs(means) <= SURE * errors).all()


@pytest.mark.parametrize("setpoint", few((0.0, 200.0, 2.0, -200.0), 1, start=1))
def test_the_probability_of_a_violation_does_not_depend_on_the_set_point(setpoint: float) -> None:
    """The number is that of 100 independent paths in NumPy over a million steps, after 20,000 steps."""
    problem = tank(setpoint)
    assert problem.limits is not None
    found = violations(problem.close(problem.design()), problem.limits, seed=5).total.per_step
    assert abs(found.value - 0.000675) <= SURE * np.hypot(found.standard_error, 0.00001)


@pytest.mark.evidence
def test_few_steps_for_a_violation_are_no_reason_to_deny_a_stationary_distribution() -> None:
    """The spread over few paths varies by itself, so only a growth beyond that is one."""
    problem = tank(0.0)
    assert problem.limits is not None
    loop = problem.close(problem.design())
    for seed in (3, 13):  # the spread over 64 paths grows by a factor of 1.5 and of 1.43
        found = violations(loop, problem.limits, seed=seed, steps=100_000).total.per_step
        assert abs(found.value - 0.000675) <= 6 * found.standard_error  # which few violations know roughly


@pytest.mark.parametrize("seeds", [1, pytest.param(8, marks=pytest.mark.evidence)])
def test_rates_of_a_loop_that_seldom_sends_are_those_after_a_long_warm_up(seeds: int) -> None:
    """From an input of zero, pairs of commands get their distribution in the long run after hundreds of packets.

    The number is that of 16,384 paths from step 28,000 to step 64,000, in which it does not change. Windows that begin
    after 3,000 steps are eight standard errors below it for some seeds.
    """
    problem = parse(tomllib.loads(SELDOM), "seldom")
    loop = problem.close(problem.design())
    found = [average(loop, seed=seed) for seed in range(seeds)]
    assert all(one.burn_in > 12_000 for one in found)
    rate = np.mean([one.rates["actuator"].value for one in found])
    error = found[0].rates["actuator"].standard_error / np.sqrt(seeds)
    assert abs(rate - 0.006350) <= SURE * np.hypot(error, 0.000003)


@pytest.mark.evidence
def test_a_loop_that_settles_within_the_steps_is_not_refused() -> None:
    """A step of a clipped input takes 2,000 steps, so there are fewer paths than at first, and the loop has settled."""
    problem = tank(2.0, 0.3, "input_limit = [[-0.35, 0.6]]")
    loop = problem.close(problem.design())
    short, long = average(loop, steps=6_000_000), average(loop, steps=60_000_000)
    assert short.settled
    assert not any("settled" in note for note in short.notes)
    error = np.hypot(short.cost.standard_error, long.cost.standard_error)
    assert abs(short.cost.value - long.cost.value) <= SURE * error


WANDERING = [(FOLLOWED, "s", ["a"]), (UNREGULATED, "s1", ["s0"])]


@pytest.mark.parametrize(("text", "link", "others"), WANDERING)
def test_a_rate_that_depends_on_the_size_of_what_wanders_is_no_average(text: str, link: str, others: list[str]) -> None:
    """An output that follows a set-point or a disturbance makes its sensor send more and more; the others are free."""
    problem = parse(tomllib.loads(text), "wandering")
    loop = problem.close(problem.design())
    assert drifts_of(loop) == (link,)
    found = average(loop, seed=2)
    assert not found.settled
    assert not found.reached
    assert any(f"the decision on {link} depends on the size" in note for note in found.notes)
    assert set(found.rates) == {link, *others}
    assert average(loop, seed=2, steps=100_000).settled is False


@pytest.mark.parametrize(("text", "link", "_"), WANDERING)
@pytest.mark.parametrize("prediction", ["hold", "model"])
def test_a_rate_without_average_rises(text: str, link: str, _: list[str], prediction: str) -> None:
    """On the same paths, ten thousand steps later, and by many standard errors; not if both ends predict the output."""
    problem = parse(tomllib.loads(text), "wandering").changed({"prediction": prediction})
    loop = problem.close(problem.design())
    assert drifts_of(loop) == ((link,) if prediction == "hold" else ())
    part = Part(loop, plain_average(loop))
    sampling, row = Sampling([part], 1, None, None), part.names.index(Sent(link))
    states = [loop.start(part.estimator.program, 256, 1)]
    sums = list[np.ndarray]()
    for _ in range(3):
        found, states = sampling._advance(states, 10_000)  # pyright: ignore[reportPrivateUsage]
        sums.append(found[row] / 10_000)
    change = sums[2] - sums[0]
    assert (change.mean() > SURE * change.std() / np.sqrt(256)) == (prediction == "hold")


def test_rates_of_links_that_measure_deviations_are_averages() -> None:
    """Constant set-points do not wander, and a held input that follows a random walk changes by its last step alone."""
    problem = parse(tomllib.loads(FOLLOWED), "constant").changed({"reference": {"value": [3.0]}})
    assert drifts_of(problem.close(problem.design())) == ()
    held = parse(tomllib.loads(UNREGULATED), "held")
    held = held.changed({"nodes": {"s": {"measures": True}, "c": {"controls": True}, "a": {"applies": True}}})
    held = held.changed({"nodes.s.site": "c"})
    assert drifts_of(held.close(held.design())) == ()


@pytest.mark.parametrize("seeds", [1, pytest.param(24, marks=pytest.mark.evidence)])
def test_the_standard_error_of_a_rate_includes_what_is_left_of_the_transient(seeds: int) -> None:
    """Rates of seeds differ by their standard errors, also for a seed whose early windows agree by chance."""
    problem = parse(tomllib.loads(SELDOM), "seldom")
    loop = problem.close(problem.design())
    found = [average(loop, seed=seed, standard_error=2.8e-8).rates["actuator"] for seed in range(14, 14 + seeds)]
    assert all(abs(one.value - 0.006350) <= 5 * np.hypot(one.standard_error, 0.000003) for one in found)


def test_a_long_burn_in_has_fewer_paths() -> None:
    """So that it takes no more steps of all paths together; over lossy links, many paths show heavy tails."""
    problem = tank(2.0, 0.3)
    loop = problem.close(problem.design())
    assert [paths_of(loop, steps) for steps in (512, 12_000, 10**6)] == [4096, 696, 512]
    found = average(loop)
    assert 0 < found.burn_in * paths_of(loop, found.burn_in) <= 2**23
    assert found.reached
    lossy = taciturn.load("lossy-double-integrator")
    assert paths_of(lossy.close(lossy.design()), 12_000) == 4096


def test_ordinary_loops_settle_within_the_time_constants_of_their_design() -> None:
    """Distributions are compared without more steps where they have settled, also at the phases of a schedule."""
    for name, least in (("two-mass-lqg", 512), ("quadruple-tank", 512), ("remote-scalar", 512)):
        problem = taciturn.load(name)
        assert average(problem.close(problem.design()), steps=4_000_000).burn_in == least


def test_distributions_that_change_at_equal_deviations_are_seen_and_growing_ones_are_not() -> None:
    """A mixture becomes normal; a random walk has no distribution, and a decayed state none either."""
    draws = np.random.default_rng(2)
    normal = draws.standard_normal((1, 4096))
    mixed = np.sign(draws.standard_normal((1, 4096))) * 0.99 + 0.141 * draws.standard_normal((1, 4096))
    for first, second, changed in (
        (mixed, normal, True),
        (draws.standard_normal((1, 4096)), normal, False),
        (normal / np.sqrt(2), normal + draws.standard_normal((1, 4096)) / np.sqrt(2), False),
        (normal + 0.2, draws.standard_normal((1, 4096)), True),
    ):
        snapshots = Snapshots()
        assert snapshots.changed(first)
        assert snapshots.changed(second) == changed
    snapshots = Snapshots()
    assert [snapshots.changed(size * normal) for size in (1.0, 1e-3, 1e-7, 1e-11)] == [True, True, False, False]


def decaying(amplitude: float, constant: float, paths: int, lengths: list[int]) -> History:
    """Return windows of noise with the deviation 1 per step, around a mean that decays from the amplitude to 0."""
    history, draws, begin = History(np.array([False])), np.random.default_rng(8), 0
    for length in lengths:
        steps = np.arange(begin, begin + length)
        total = amplitude * np.exp(-steps / constant).sum()
        history.add(length, total + np.sqrt(length) * draws.standard_normal((1, paths)))
        begin += length
    return history


def test_windows_are_kept_where_a_transient_is_far_below_the_standard_error() -> None:
    """The windows double, the transient is anything, and what is kept is a tenth of a standard error off at most."""
    lengths = [128, 128, *(256 << i for i in range(10))]
    for amplitude in (0.0, 0.1, 1.0, 100.0):
        for constant in (10, 100, 1000, 3000):
            history = decaying(amplitude, constant, 4096, lengths)
            kept = history.kept(512)
            length = sum(steps for steps, _ in kept)
            begin = history.steps - length
            assert kept, (amplitude, constant)
            bias = amplitude * np.exp(-np.arange(begin, history.steps) / constant).sum() / length
            assert bias <= 0.1 / np.sqrt(4096 * length), (amplitude, constant)


def test_windows_that_differ_by_the_last_send_of_paths_in_phase_are_the_same() -> None:
    """Every path sends at the same steps, at every third one: a window of 128 steps has 42 or 43 sends."""
    sends = np.arange(512) % 3 == 0
    history = History(np.array([True]))
    for begin, length in ((0, 128), (128, 128), (256, 256)):
        history.add(length, np.full((1, 64), float(sends[begin : begin + length].sum())))
    assert history.kept(0)


def test_a_window_before_its_last_send_is_no_excuse_where_paths_send_at_random() -> None:
    """A rate that rises by 4 % is seen if the paths are many, although it is less than one send in each window."""
    draws, history = np.random.default_rng(1), History(np.array([True]))
    for length, rate in ((256, 0.0060), (256, 0.0060), (512, 0.00625)):
        history.add(length, draws.poisson(length * rate, (1, 1 << 16)).astype(float))
    assert not history.kept(0)
