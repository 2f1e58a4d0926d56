"""A standard error means what it says, and an estimate depends on its seed alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import taciturn
from taciturn import ContinuousPlant, Cost, Network, Plant, ProblemError, close, design
from taciturn.loop import Loop
from taciturn.model.estimate import Estimate
from taciturn.simulation import sampling as module
from taciturn.simulation.average import average, completed_squares, difference, plain_average
from taciturn.simulation.trajectory import course

PLANT = Plant([[1.1, 0.3], [0.0, 0.8]], [[0.0], [1.0]], [[0.1, 0.0], [0.0, 0.2]], [[1.0, 0.0]], [[0.1]])
COST = Cost([[1.0, 0.0], [0.0, 0.5]], [[0.3]])


SEEDS = [60, pytest.param(400, marks=pytest.mark.evidence)]


def coverage(estimates: list[tuple[float, float]], truth: float) -> float:
    """Return the share of 95 % intervals that hold the truth."""
    return float(np.mean([abs(value - truth) <= 1.959964 * error for value, error in estimates]))


def covers(share: float, seeds: int) -> bool:
    """Tell whether a share of intervals is 95 %, to 2.75 binomial standard deviations: 92 to 98 % of 400 seeds."""
    return abs(share - 0.95) <= 2.75 * np.sqrt(0.95 * 0.05 / seeds)


@pytest.mark.parametrize("seeds", SEEDS)
def test_95_percent_intervals_of_the_plain_average_cover_the_exact_cost(seeds: int) -> None:
    """Over many seeds the exact cost of a periodic policy lies inside as often as it should."""
    policy = design.periodic(PLANT, COST, every=2)
    loop = close(PLANT, policy, cost=COST)
    found = [average(loop, plain_average(loop), seed=seed, steps=60_000).cost for seed in range(seeds)]
    assert policy.theory.closed_form is not None
    assert covers(coverage([(e.value, e.standard_error) for e in found], policy.theory.closed_form.cost), seeds)


@pytest.mark.parametrize("seeds", SEEDS)
def test_95_percent_intervals_of_completed_squares_cover_a_long_run(seeds: int) -> None:
    """Over many seeds the value of a run hundreds of times as long lies inside as it should."""
    policy = design.lqg(PLANT, COST, theta=0.5)
    loop = close(PLANT, policy, cost=COST)
    estimator = completed_squares(loop)
    truth = average(loop, estimator, seed=1000, steps=50_000 * seeds * 6).cost.value
    found = [average(loop, estimator, seed=seed, steps=60_000).cost for seed in range(seeds)]
    assert covers(coverage([(e.value, e.standard_error) for e in found], truth), seeds)


def test_completed_squares_have_far_less_variance_than_the_plain_average() -> None:
    """On the two masses the ratio of variances at equal steps is above a thousand."""
    problem = taciturn.load("two-mass-lqg")
    loop = problem.close(problem.design())
    squares = average(loop, completed_squares(loop), steps=1_000_000).cost.standard_error
    plain = average(loop, plain_average(loop), steps=1_000_000).cost.standard_error
    assert (plain / squares) ** 2 > 1000


@pytest.mark.parametrize("call", [average, difference, course, taciturn.simulate])
def test_what_is_no_loop_is_refused(call: Callable[..., object]) -> None:
    """In one sentence."""
    arguments = {average: (), difference: (None,)}.get(call, (3,))
    with pytest.raises(ProblemError, match="expected a Loop"):
        call(None, *arguments)


def test_a_discounted_cost_is_a_discounted_sum() -> None:
    """Linear feedback of the full state: tr(X Θ) + α/(1−α) tr(X W), X of the discounted closed loop."""
    discount = 0.9
    plant = Plant(PLANT.A, PLANT.B, PLANT.W, mean=[1.0, -2.0], covariance=[[0.2, 0.0], [0.0, 0.1]])
    policy = design.all_time(plant, COST)
    (L,) = (step.branches[0]["estimate"] for step in policy.steps if getattr(step, "signal", "") == "command")
    closed = np.sqrt(discount) * (plant.A + plant.B @ L)
    stage = COST.Q + L.T @ COST.R @ L
    X = np.linalg.solve(np.eye(4) - np.kron(closed.T, closed.T), stage.ravel()).reshape(2, 2)
    exact = np.trace(X @ (plant.covariance + np.outer(plant.mean, plant.mean)))
    exact += discount / (1 - discount) * np.trace(X @ plant.W)
    loop = close(plant, policy, cost=Cost(COST.Q, COST.R, discount=discount))
    found = average(loop, seed=8, standard_error=2e-3 * exact)
    assert found.reached
    assert abs(found.cost.value - exact) <= 4 * found.cost.standard_error


PENDULUM = ContinuousPlant([[0.0, 1.0], [9.8, -0.1]], [[0.0], [1.0]], np.diag([0.0, 0.2]), C=[[1.0, 0.0]], V=[[1e-3]])
UNUSUAL = {
    "an exact measurement of some states": (Plant(PLANT.A, PLANT.B, PLANT.W, [[1.0, 0.0]]), None),
    "one exact output and one that is not": (Plant(PLANT.A, PLANT.B, PLANT.W, np.eye(2), np.diag([0.0, 0.3])), None),
    "noise on one state": (Plant(PLANT.A, PLANT.B, np.diag([0.0, 0.4]), [[1.0, 0.0]], [[0.1]]), None),
    "a sampled pendulum": (PENDULUM, 0.05),
}


@pytest.mark.parametrize("name", UNUSUAL)
def test_the_exact_identity_holds_for_unusual_noise_and_for_sampled_plants(name: str) -> None:
    """Completed squares and the plain average with its plant, on draws of their own, agree within their errors."""
    plant, period = UNUSUAL[name]
    cost = Cost(np.diag([1.0, 0.2]), [[0.1]], [[0.05], [0.02]])
    loop = close(plant, design.lqg(plant, cost, theta=0.4, period=period))
    exact, plain = (
        average(loop, make(loop), seed=s, steps=2_000_000) for s, make in ((1, completed_squares), (2, plain_average))
    )
    spread = np.hypot(exact.cost.standard_error, plain.cost.standard_error)
    assert abs(exact.cost.value - plain.cost.value) <= 4 * spread
    assert spread < 0.02 * exact.cost.value
    assert exact.cost.value > 1.02 * loop.policy.cost_all_time
    assert exact.rates["actuator"].value * loop.policy.tick < 0.95


WRONG: dict[str, Callable[[], object]] = {
    "plant is None; expected a Plant or a ContinuousPlant": lambda: design.lqg(None, COST, theta=0.1),
    "cost is 7; expected a Cost": lambda: design.remote_lqg(PLANT, 7, theta=0.1, zeta=0.1),
    "plant is [[1.0]]; expected a Plant or a ContinuousPlant": lambda: design.lossy_lqg([[1.0]], COST, price=1),
    "network is 'udp'; expected a Network": lambda: design.lossy_lqg(PLANT, COST, price=1, network="udp"),
    "network is 'tcp'; expected a Network": lambda: close(PLANT, design.all_time(PLANT, COST), "tcp"),
    "policy is 'lqg'; expected a Policy": lambda: close(PLANT, "lqg"),
    "reference is [[0.0]]; expected a Reference": lambda: design.lossy_lqg(PLANT, COST, price=1, reference=[[0.0]]),
    "network.sensor_burst is 0.1; expected a LossLaw": lambda: Network("udp", sensor_burst=0.1),
}


@pytest.mark.parametrize("sentence", WRONG)
def test_what_is_no_plant_no_cost_and_no_network_is_told(sentence: str) -> None:
    """One sentence for a value of another type."""
    with pytest.raises(taciturn.ProblemError) as told:
        WRONG[sentence]()
    assert str(told.value) == sentence


def test_threads_change_nothing() -> None:
    """The same bits on one thread and on three."""
    loop = close(PLANT, design.lqg(PLANT, COST, theta=0.5), cost=COST)
    assert average(loop, steps=200_000, threads=1) == average(loop, steps=200_000, threads=3)


def test_a_burn_in_that_is_too_short_is_prolonged() -> None:
    """A plant that needs thousands of steps to settle is not averaged while it rises."""
    slow = Plant([[0.9995]], [[1e-3]], [[1.0]])
    cost = Cost([[1.0]], [[1e6]])
    policy = design.periodic(slow, cost, every=1)
    loop = close(slow, policy, cost=cost)
    found = average(loop, plain_average(loop), seed=3, steps=20_000_000)
    assert found.burn_in > module.SHORTEST_BURN_IN
    assert policy.theory.closed_form is not None
    assert abs(found.cost.value - policy.theory.closed_form.cost) <= 4 * found.cost.standard_error


def test_an_unreachable_precision_reports_what_was_reached(monkeypatch: pytest.MonkeyPatch) -> None:
    """The budget ends the run, and the result says so."""
    monkeypatch.setattr(module, "MOST_OPERATIONS", 3_000_000)
    loop = close(PLANT, design.lqg(PLANT, COST, theta=0.5), cost=COST)
    found = average(loop, standard_error=1e-9)
    assert not found.reached
    assert found.steps <= 3_000_000
    assert 1e-9 < found.cost.standard_error < 1e-2


def test_an_unstable_loop_is_an_error() -> None:
    """A policy on a plant it cannot hold says that the loop diverges."""
    policy = design.lqg(PLANT, COST, theta=0.5)
    wrong = Plant([[1.1, 0.3], [0.0, 0.8]], [[0.0], [-1.0]], PLANT.W, PLANT.C, PLANT.V)
    with pytest.raises(taciturn.UnstableError, match="diverges"):
        average(close(wrong, policy, cost=COST), steps=40_000_000)


def test_another_plant_or_a_limit_or_losses_end_the_theory() -> None:
    """Then the loop is not nominal, and completion of squares is refused."""
    policy = design.lqg(PLANT, COST, theta=0.5)
    limited = Plant(PLANT.A, PLANT.B, PLANT.W, PLANT.C, PLANT.V, input_limit=[0.5])
    other = Plant(PLANT.A * 1.01, PLANT.B, PLANT.W, PLANT.C, PLANT.V)
    lossy = close(PLANT, policy, Network("tcp", actuator_loss=0.1), COST)
    for loop in (close(limited, policy, cost=COST), close(other, policy, cost=COST), lossy):
        assert not loop.nominal
        with pytest.raises(taciturn.ProblemError, match="completion of squares"):
            completed_squares(loop)


def test_a_limit_clips_what_the_plant_receives() -> None:
    """No input beyond ±0.5 reaches the plant, and clipping costs."""
    policy = design.lqg(PLANT, COST, theta=0.5)
    limited = Plant([[0.9, 0.3], [0.0, 0.8]], PLANT.B, PLANT.W, PLANT.C, PLANT.V, input_limit=[0.5])
    path = taciturn.simulate(close(limited, policy, cost=COST), 2000, seed=1)
    assert np.abs(path.input).max() == 0.5
    assert (np.abs(path.input) == 0.5).mean() > 0.01


def test_one_packet_carries_a_command_within_the_limits_and_the_input_moves_towards_it_step_by_step() -> None:
    """Of an integrator far from its place: the largest input, at most 0.5 more in each step, also in silence."""
    plant = Plant([[1.0]], [[1.0]], [[0.0]], dt=1.0, mean=[10.0], input_limit=[2.0], input_rate=[0.5])
    path = taciturn.simulate(close(plant, design.lqg(plant, Cost([[1.0]], [[0.01]]), theta=0.5)), 6)
    assert path.sends["actuator"].tolist() == [True, False, False, False, False, False]
    assert path.input[:, 0].tolist() == [-0.5, -1.0, -1.5, -2.0, -2.0, -2.0]


@pytest.mark.parametrize("pole", [0.999, pytest.param(0.9999, marks=pytest.mark.evidence)])
def test_a_slow_mode_is_waited_for_even_at_low_precision(pole: float) -> None:
    """A mode that no input moves needs thousands of steps; asked for 5 %, the estimate is still unbiased."""
    plant = Plant([[pole, 0.0], [0.0, 0.5]], [[0.0], [1.0]], np.eye(2))
    policy = design.all_time(plant, Cost(np.eye(2), [[1.0]]))
    assert policy.theory.closed_form is not None
    exact = policy.theory.closed_form.cost
    loop = close(plant, policy)
    found = average(loop, plain_average(loop), seed=1, standard_error=0.05 * exact)
    assert found.reached
    assert abs(found.cost.value - exact) <= 4 * found.cost.standard_error


@pytest.mark.parametrize(
    ("theta", "low", "high", "steps"),
    [(1.1, 0.02, 0.04, 10_000_000), pytest.param(1.3, 1e-3, 5e-3, 500_000_000, marks=pytest.mark.evidence)],
)
def test_rare_sends_are_waited_for(theta: float, low: float, high: float, steps: int) -> None:
    """Where a send is rare, as many of them are dropped and kept as it takes, whatever precision is asked."""
    plant, cost = Plant([[0.6]], [[1.0]], [[0.01]], [[1.0]], [[0.03]]), Cost([[1.0]], [[0.05]])
    loop = close(plant, design.lqg(plant, cost, theta=theta, trigger="separate"))
    quick, long = average(loop, seed=1, standard_error=1e-4), average(loop, seed=2, steps=steps)
    assert low < long.rates["actuator"].value < high
    assert quick.burn_in > 8 / long.rates["actuator"].value
    assert abs(quick.cost.value - long.cost.value) <= 4 * np.hypot(quick.cost.standard_error, long.cost.standard_error)
    both = (quick.rates["actuator"], long.rates["actuator"])
    assert abs(both[0].value - both[1].value) <= 4 * np.hypot(both[0].standard_error, both[1].standard_error)


def test_too_few_steps_to_settle_are_told() -> None:
    """A budget that ends before the loop has forgotten its start is not called reached."""
    plant = Plant([[0.9999]], [[1e-4]], [[1.0]])
    policy = design.all_time(plant, Cost([[1.0]], [[1e6]]))
    loop = close(plant, policy)
    assert not average(loop, plain_average(loop), steps=20_000).reached


def test_another_cost_than_the_design_s_is_measured_as_it_is() -> None:
    """The completed square belongs to the cost of the design; another cost is averaged plainly, without guarantee."""
    policy = design.lqg(PLANT, COST, theta=0.5)
    tenfold = Cost(10 * COST.Q, 10 * COST.R)
    loop = close(PLANT, policy, cost=tenfold)
    assert not loop.nominal
    same, more = average(close(PLANT, policy), standard_error=2e-3), average(loop, standard_error=2e-2)
    error = np.hypot(10 * same.cost.standard_error, more.cost.standard_error)
    assert abs(10 * same.cost.value - more.cost.value) <= 4 * error


def two(theta: float, other: float) -> list[Loop]:
    """Return two loops of the same plant."""
    return [close(PLANT, design.lqg(PLANT, COST, theta=value)) for value in (theta, other)]


def test_a_loop_does_not_differ_from_itself() -> None:
    """Path by path, so without any error."""
    (loop,) = two(0.5, 0.5)[:1]
    found = difference(loop, loop, steps=200_000)
    assert found.cost == Estimate(0.0, 0.0, "simulation")
    assert found.rates["actuator"].value == 0


@pytest.mark.evidence
@pytest.mark.parametrize("seeds", SEEDS)
def test_95_percent_intervals_of_differences_cover_a_long_run(seeds: int) -> None:
    """Over many seeds, and the long run is what two separate long runs say."""
    loops = two(0.5, 0.45)
    truth = difference(*loops, seed=1000, steps=150_000 * seeds).cost
    apart = [average(loop, seed=2000 + k, steps=100_000 * seeds).cost for k, loop in enumerate(loops)]
    spread = np.hypot(apart[0].standard_error, apart[1].standard_error)
    assert abs(apart[0].value - apart[1].value - truth.value) <= 4 * np.hypot(spread, truth.standard_error)
    found = [difference(*loops, seed=seed, steps=80_000).cost for seed in range(seeds)]
    assert covers(coverage([(e.value, e.standard_error) for e in found], truth.value), seeds)


@pytest.mark.evidence
def test_differences_of_loops_that_are_nearly_one_are_honest() -> None:
    """Long runs, where a mean is fitted to control variates: the few paths that differ decide, and are not fitted."""
    problem = taciturn.load("two-mass-lqg")
    change = 3e-6
    loops = [problem.close(problem.changed({"theta": theta}).design()) for theta in (0.1 + change, 0.1)]
    truth = 0.1236 * change  # its slope, from changes a thousand times as large
    found = [difference(*loops, seed=seed, steps=25_000_000).cost for seed in range(12)]
    mean = np.mean([e.value for e in found])
    spread = np.std([e.value for e in found], ddof=1) / np.sqrt(len(found))
    assert abs(mean - truth) < 4 * spread
    assert np.mean([e.standard_error for e in found]) == pytest.approx(spread * np.sqrt(len(found)), rel=0.8)


def test_loops_that_have_not_yet_differed_have_told_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A standard error of 0 is not precise where the loops are not the same."""
    monkeypatch.setattr(module, "MOST_OPERATIONS", 5_000_000)
    first, second = (close(PLANT, design.lqg(PLANT, COST, theta=theta), cost=COST) for theta in (0.5, 0.5 + 1e-13))
    found = difference(first, second, standard_error=1e-3)
    assert found.cost.standard_error == 0
    assert not found.reached
    assert difference(first, first, standard_error=1e-3).reached


def test_the_same_draws_make_a_difference_sharp() -> None:
    """The variance is less than a third of that of two separate runs of as many steps."""
    loops = two(0.5, 0.49)
    together = difference(*loops, steps=1_000_000)
    apart = [average(loop, steps=500_000, seed=k) for k, loop in enumerate(loops)]
    spread = np.hypot(*(one.cost.standard_error for one in apart))
    assert together.cost.standard_error**2 < spread**2 / 3
    assert together.rates["actuator"].value < 0 < together.cost.value


def test_differences_of_missions_and_of_loops_without_an_identity_are_those_of_their_means() -> None:
    """A finite-horizon run in the plain average, and a plant that is not the one of the design."""
    mission = Cost(COST.Q, COST.R, horizon=40)
    loops = [close(PLANT, design.lqg(PLANT, COST, theta=theta), cost=mission) for theta in (1.0, 0.2)]
    other = Plant(1.01 * PLANT.A, PLANT.B, PLANT.W, PLANT.C, PLANT.V)
    changed = [close(other, design.lqg(PLANT, COST, theta=theta)) for theta in (1.0, 0.2)]
    for pair in (loops, changed):
        found = difference(*pair, steps=500_000)
        apart = [average(loop, seed=k + 1, steps=500_000) for k, loop in enumerate(pair)]
        spread = np.hypot(*(one.cost.standard_error for one in apart))
        gap = apart[0].cost.value - apart[1].cost.value
        assert abs(found.cost.value - gap) <= 4.5 * np.hypot(found.cost.standard_error, spread)
        rates = [one.rates["actuator"] for one in apart]
        error = 4.5 * np.hypot(found.rates["actuator"].standard_error, np.hypot(*(r.standard_error for r in rates)))
        assert abs(found.rates["actuator"].value - rates[0].value + rates[1].value) <= error


def test_loops_with_other_ticks_or_horizons_are_not_compared() -> None:
    """A sentence says which."""
    plant = ContinuousPlant([[0.0]], [[1.0]], [[1.0]])
    cost = Cost([[1.0]], [[1.0]])
    slow, fast = (close(plant, design.lqg(plant, cost, theta=0.5, period=period)) for period in (0.1, 0.2))
    with pytest.raises(ProblemError, match=r"period is 0.1 in one loop and 0.2 in the other; expected equal values"):
        difference(slow, fast)
