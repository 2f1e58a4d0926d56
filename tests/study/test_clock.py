"""The fair periodic control: exact, the best of what is tried, and never worse than what it contains."""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from counts import few
from drawn import law
from hypothesis import assume
from hypothesis import strategies as st
from systems import System, systems

import taciturn
from taciturn import ContinuousPlant, Cost, Network, Plant, Problem, design
from taciturn.lqg.periodic import Held
from taciturn.model.disturbance import follow
from taciturn.model.signals import ExternalDisturbance
from taciturn.study.periodic import Clock, ClockPoint, Either, Ticked, beside, clock_of, lower_hull, sampling_clock

TANK = ContinuousPlant(
    [[-0.016, 0, 0.042, 0], [0, -0.011, 0, 0.033], [0, 0, -0.042, 0], [0, 0, 0, -0.033]],
    [[0.083, 0], [0, 0.063], [0, 0.048], [0.031, 0]],
    0.05 * np.eye(4),
    C=[[0.5, 0, 0, 0], [0, 0.5, 0, 0]],
    V=0.01 * np.eye(2),
)
WEIGHTS = Cost(np.diag([1, 1, 0.1, 0.1]), 0.1 * np.eye(2))


def fair(problem: Problem) -> Clock:
    """Return the clock of a problem, which has one."""
    clock = clock_of(problem, problem.designed())
    assert clock is not None
    return clock


def of_plant(system: System, actuation: str) -> Problem:
    """Return a problem of a random plant."""
    return Problem(system.plant, system.cost, Network(), "excess", {"theta": 0.2, "actuation": actuation})


def test_the_clocks_of_the_two_masses_are_those_of_their_policies() -> None:
    """With a model the chord of neighbours, 4.7 % above all-time control at a quarter of the sends; hold by cycles."""
    problem = taciturn.load("two-mass-lqg")
    model, hold = (fair(problem.changed({"actuation": actuation})) for actuation in ("model", "hold"))
    base = problem.design().cost_all_time
    quarter = model.at(0.25)
    assert quarter is not None
    assert quarter.cost == pytest.approx(1.047 * base, rel=5e-4)
    assert [point.cycle for point in quarter.points] == [(4,)]
    (three, four), middle = (model.at(1 / every) for every in (3, 4)), model.at(7 / 24)
    assert three is not None
    assert four is not None
    assert middle is not None
    assert middle.cost == pytest.approx((three.cost + four.cost) / 2, rel=1e-12)
    assert middle.shares == pytest.approx((0.5, 0.5))
    for rate, cycle in ((2 / 7, (4, 3)), (3 / 11, (4, 4, 3))):
        found = hold.at(rate)
        exact = design.periodic(problem.plant, problem.cost, every=cycle).theory.closed_form
        assert found is not None
        assert exact is not None
        assert found.cost <= exact.cost * (1 + 1e-9)


@pytest.mark.parametrize("actuation", ["hold", "model"])
def test_a_cycle_of_a_sampled_plant_costs_what_its_policy_costs(actuation: str) -> None:
    """With the noise between samples counted once; periods in between, which may cost less, are not asked here."""
    found = fair(Problem(TANK, WEIGHTS, Network(), "excess", {"theta": 0.2, "period": 10.0, "actuation": actuation}))
    assert isinstance(found, Either)
    for every in (1, 2, 4):
        around, policy = found.ticked.around(1 / (10 * every)), design.periodic
        closed = policy(TANK, WEIGHTS, every=every, period=10.0, actuation=actuation).theory.closed_form
        assert around is not None
        assert closed is not None
        assert around[0].cycle == (every,)
        assert around[0].cost == pytest.approx(closed.cost, rel=1e-9)


def test_unequal_intervals_are_found_under_a_disturbance_too() -> None:
    """The search weights the state at the end of a cycle; a bias and a set-point, which last, must not add to this."""
    plant = Plant([[1.0, 0.1], [0.0, 0.8]], [[0.0], [0.3]], 1e-3 * np.eye(2), [[1.0, 0.0]], [[4e-3]])
    plant = follow(plant, [[1.0, 0.0]], [1.0], [ExternalDisturbance([0.0, 0.3], 1e-4)])
    problem = Problem(plant, Cost(np.diag([1.0, 0.0]), [[0.3]]), Network(), "excess", {"theta": 0.2})
    clock = fair(problem)
    for cycle in ((3, 2, 2), (3, 2), (4, 3, 3)):
        closed, found = (
            design.periodic(plant, problem.cost, every=cycle).theory.closed_form,
            clock.at(len(cycle) / sum(cycle)),
        )
        assert closed is not None
        assert found is not None
        assert found.cost <= closed.cost * (1 + 1e-8)
    assert [point.cycle for point in found.points] == [(4, 3, 3)]


def test_rates_at_which_sampling_loses_a_mode_are_passed_over() -> None:
    """Every five steps is half a period of the undamped spring: an input that is held so long moves it by rounding."""
    held = design.periodic(taciturn.load("two-mass-lqg").plant, taciturn.load("two-mass-lqg").cost, every=5)
    assert held.theory.closed_form is not None
    assert held.theory.closed_form.cost > 1e12
    curve = fair(taciturn.load("two-mass-lqg")).curve(1.0, 1 / 8)
    assert (5,) not in [point.cycle for point in curve]
    assert curve[0].rate == 1
    assert curve[-1].rate <= 1 / 8


@law(3, 60, system=systems(states=4, inputs=2), rate=st.floats(0.12, 1.0))
def test_no_cycle_is_below_the_fair_clock_and_the_clock_is_a_cycle_or_two(system: System, rate: float) -> None:
    """Any cycle of the intervals around the mean one; convex in the rate, never below all-time control."""
    clock = fair(of_plant(system, "hold"))
    found = clock.at(rate)
    assume(found is not None)
    assert found is not None
    problem = of_plant(system, "hold")
    for point in found.points:
        policy = design.periodic(problem.plant, problem.cost, every=point.cycle)
        assert policy.theory.closed_form is not None
        assert point.cost == pytest.approx(policy.theory.closed_form.cost, rel=1e-9)
    sent = sum(share * point.rate for share, point in zip(found.shares, found.points, strict=True))
    assert sent <= rate * (1 + 1e-9)
    assert found.cost >= problem.design().cost_all_time * (1 - 1e-9)
    mean = int(1 / rate)
    for cycle in itertools.product(range(max(1, mean - 1), mean + 3), repeat=3):
        if 3 / sum(cycle) <= rate:
            try:
                policy = design.periodic(problem.plant, problem.cost, every=cycle)
            except taciturn.UnstableError:
                continue
            assert policy.theory.closed_form is not None
            assert found.cost <= policy.theory.closed_form.cost * (1 + 1e-6)


ROTATION = Problem(  # a turn of a quarter in each step: every second interval loses a mode
    Plant([[0, -1.05], [1.05, 0]], [[1.0], [0]], 0.1 * np.eye(2), [[1.0, 0]], [[0.1]]),
    Cost(np.eye(2), [[0.1]]),
    Network(),
    "excess",
    {"theta": 0.2},
)


def cheapest_at_its_own_rate(problem: Problem, cycle: tuple[int, ...]) -> None:
    """Check that the clock at the rate of a cycle costs no more than the cycle."""
    try:
        policy = design.periodic(problem.plant, problem.cost, every=cycle)
    except taciturn.UnstableError:
        return
    found = fair(problem).at(len(cycle) / sum(cycle))
    assert found is not None
    assert policy.theory.closed_form is not None
    assert found.cost <= policy.theory.closed_form.cost * (1 + 1e-9)


@law(3, 60, system=systems(states=4, inputs=2), cycle=st.lists(st.integers(1, 12), min_size=1, max_size=2))
def test_no_cycle_is_below_the_fair_clock_at_its_own_rate(system: System, cycle: list[int]) -> None:
    """Whose corners may be cycles of the same rate, but for rounding; where sampling loses modes, too."""
    near = (cycle[0], min(cycle[-1], cycle[0] + 1)) if len(cycle) > 1 else (cycle[0],)
    cheapest_at_its_own_rate(of_plant(system, "hold"), near)


@pytest.mark.parametrize("every", range(1, 10))
def test_intervals_that_lose_a_mode_hide_no_others(every: int) -> None:
    """Their Riccati equations have no solution, and are solved in one stack with those that have one."""
    cheapest_at_its_own_rate(ROTATION, (every,))


@law(3, 60, system=systems(states=4, inputs=2), rate=st.floats(0.05, 1.0))
def test_a_model_never_costs_a_clock_more_than_holding(system: System, rate: float) -> None:
    """At the same rate: what is held could have been predicted."""
    held, predicted = (fair(of_plant(system, actuation)).at(rate) for actuation in ("hold", "model"))
    assert predicted is not None
    if held is not None:
        assert predicted.cost <= held.cost * (1 + 1e-9)


@pytest.mark.evidence
def test_the_weaker_clock_measures_only_when_it_sends() -> None:
    """Of outputs with noise it costs more than the fair one at every rate, of an exact full state the same."""
    problem = Problem(TANK, WEIGHTS, Network(), "excess", {"theta": 0.1, "period": 1.0})
    clock, weaker = fair(problem), sampling_clock(problem)
    for rate in (0.6, 0.8667, 0.95):  # where a real period comes nearer to the rate than whole steps
        one, other = clock.at(rate), weaker.at(rate)
        assert one is not None
        assert other is not None
        assert one.cost <= other.cost * (1 + 1e-9)
    assert [point.cycle for point in one.points] == [None]
    for rate in (0.1, 0.25, 0.5, 1.0):
        one, other = clock.at(rate), weaker.at(rate)
        assert one is not None
        assert other is not None
        assert one.cost <= other.cost * (1 + 1e-9)
        assert (one.cost < other.cost * 0.999) == (rate < 1.0)
    state = ContinuousPlant(TANK.A, TANK.B, TANK.W)
    full = Problem(state, WEIGHTS, Network(), "excess", {"theta": 0.1, "period": 1.0})
    same = fair(full).at(0.25)
    cycle = design.periodic(state, WEIGHTS, period=1.0, every=4).theory.closed_form
    assert same is not None
    assert cycle is not None
    assert same.cost == pytest.approx(cycle.cost, rel=1e-9)


def test_a_sensor_that_is_scheduled_has_a_clock_of_queries() -> None:
    """Where the variance asks every k steps it is that clock itself; a trigger on the outputs is compared with it."""
    plant = Plant([[1.2]], [[1.0]], [[1.0]], [[1.0]], [[0.1]])
    cost = Cost([[1.0]], [[1.0]])
    problem = Problem(plant, cost, Network(), "variance", {"threshold": 3.0})
    policy = problem.design()
    assert policy.theory.closed_form is not None
    found = fair(problem).at(policy.theory.closed_form.rates["sensor"])
    assert found is not None
    assert found.words == "queries"
    assert found.cost == pytest.approx(policy.theory.closed_form.cost, rel=1e-9)
    outputs = taciturn.evaluate(Problem(plant, cost, Network(), "send-on-delta", {"delta": 2.0}), steps=200_000)
    assert outputs.clock is not None
    assert outputs.clock.words == "queries"


@pytest.mark.parametrize(
    "problem",
    [
        taciturn.load("rover"),
        taciturn.load("lossy-double-integrator"),
        taciturn.load("two-mass-lqg").changed({"plant.input_limit": [1.0]}),
    ],
    ids=["mission", "loss", "clipped"],
)
def test_what_has_no_fair_clock_has_none(problem: Problem) -> None:
    """A finite-horizon run, links that lose, inputs that are clipped: their costs are not those of the design."""
    assert clock_of(problem, problem.designed()) is None


def test_an_answer_does_not_depend_on_earlier_ones() -> None:
    """Points of a trade-off share the results of a plant, and threads ask for them in any order."""
    masses = taciturn.load("two-mass-lqg")

    def fresh() -> Clock:
        held = Held(masses.plant.A, masses.plant.B, masses.cost.Q, masses.cost.R, np.zeros((4, 1)), masses.plant.W)
        return Ticked("hold", 1.0, lambda cycle: held.solve(cycle).cost, held.screen)

    histories = [  # with the exact costs of their corners, other cycles than before were on the lower hull
        (0.5881538391113281, 0.6925728776403365, 0.10189409983575998),
        (0.24402923583984376, 0.22028481460922378, 0.1405708275893658),
    ]
    for rate, another, slowest in histories:
        alone, shared = fresh().at(rate), fresh()
        shared.at(another)
        shared.curve(1.0, slowest)
        with ThreadPoolExecutor(4) as pool:
            found = list(pool.map(shared.at, [rate, another, rate, 0.41, rate]))
        assert alone is not None
        assert [found[0], found[2], found[4]] == [alone] * 3


def test_the_lower_hull_ends_at_the_cheapest_point() -> None:
    """Points above a chord, and those that send more for more, are left out."""
    given = [(0.2, 5.0), (0.4, 4.9), (0.5, 2.0), (0.7, 2.5), (0.8, 1.0), (1.0, 1.2), (0.5, 3.0)]
    hull = lower_hull(ClockPoint(rate, cost) for rate, cost in given)
    assert [(point.rate, point.cost) for point in hull] == [(0.2, 5.0), (0.5, 2.0), (0.8, 1.0)]
    assert lower_hull([]) == []


def test_a_real_period_measures_as_often_as_the_policy_does() -> None:
    """Between its sends it samples at equal spacing, no faster than the policy: cheaper than samples at sends alone."""
    plant = taciturn.ContinuousPlant(
        [[0.0, 1.0], [2.0, -0.3]], [[0.0], [1.0]], np.diag([0.0, 0.5]), C=[[1.0, 0.0]], V=[[0.001]]
    )
    cost = taciturn.Cost(np.diag([3.0, 0.5]), [[0.2]], [[0.1], [0.05]])
    parameters = {"theta": 0.3, "period": 0.08, "actuation": "hold"}
    problem = taciturn.Problem(plant, cost, taciturn.Network(), "excess", parameters)
    clock = clock_of(problem, problem.designed())
    assert clock is not None
    for rate, samples in ((5.194, 2), (3.702, 3)):
        found = clock.at(rate)
        assert found is not None
        spaced = taciturn.design.periodic(plant, cost, period=1 / rate / samples, every=samples)
        alone = taciturn.design.periodic(plant, cost, period=1 / rate)
        assert found.cost <= spaced.theory.closed_form.cost * (1 + 1e-12)
        assert spaced.theory.closed_form.cost < 0.99 * alone.theory.closed_form.cost


def test_a_model_runs_between_the_sends_of_a_real_period_of_a_known_state_too() -> None:
    """Three sends per second, between those of three and four steps: the input follows the model meanwhile."""
    problem = taciturn.load("wiener-double-integrator").changed({"actuation": "model"})
    found = fair(problem).at(3.0)
    spaced = design.periodic(problem.plant, problem.cost, period=1 / 9, every=3, actuation="model").theory.closed_form
    assert found is not None
    assert spaced is not None
    assert found.cost <= spaced.cost * (1 + 1e-9)


@pytest.mark.parametrize("seed", few([0, 45, 53, 52, 40], 2))
def test_intervals_far_from_the_mean_are_found_where_they_cost_less(seed: int) -> None:
    """All pairs of intervals up to 8 steps, exactly: two sends in a row and a pause may cost half as much."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(3, 3))
    A *= rng.uniform(0.7, 1.1) / np.abs(np.linalg.eigvals(A)).max()
    plant = Plant(A, rng.normal(size=(3, 1)), 0.1 * np.eye(3), rng.normal(size=(1, 3)), [[0.1]])
    plant = follow(plant, disturbances=ExternalDisturbance(rng.normal(size=3), wander=0.01))
    cost = Cost(np.eye(3), [[0.1]])
    points = list[ClockPoint]()
    for cycle in itertools.combinations_with_replacement(range(8, 0, -1), 2):
        try:
            form = design.periodic(plant, cost, every=cycle).theory.closed_form
        except taciturn.UnstableError:
            continue
        assert form is not None
        points.append(ClockPoint(2 / sum(cycle), form.cost, cycle))
    clock = fair(Problem(plant, cost, Network(), "excess", {"theta": 0.2}))
    for rate in (0.45, 0.37, 0.28, 0.22):
        low, high = beside(lower_hull(points), rate)
        chord = low.cost + (high.cost - low.cost) * (rate - low.rate) / max(high.rate - low.rate, 1e-12)
        found = clock.at(rate)
        assert found is not None
        assert found.cost <= chord * (1 + 1e-6)
