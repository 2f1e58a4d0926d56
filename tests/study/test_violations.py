"""Probabilities that limits of states are violated: closed forms, brute force, and errors over seeds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from counts import few
from scipy.linalg import solve_discrete_lyapunov
from scipy.stats import chi2, norm
from systems import make_system
from used import KINDS

import taciturn
from taciturn import Cost, Loop, Network, Plant, ProblemError, close, design
from taciturn.loop import COST
from taciturn.lqg.riccati import regulate
from taciturn.model.disturbance import follow
from taciturn.model.limits import Limits, Violation
from taciturn.model.operating_point import OperatingPoint
from taciturn.model.signals import ExternalDisturbance
from taciturn.program.engine import prepare
from taciturn.study.record import decode, encode
from taciturn_events.policy import EventPolicy
from taciturn_limits.optimal_kind import OptimalPolicy
from taciturn_rare.violations import violations

SURE = 4.0  # standard errors
SLOW, UNIT = Plant([[0.95]], [[1.0]], [[1.0]]), Cost([[1.0]], [[10.0]])
ROW = [[1.0]]


def every_sample() -> tuple[Loop, float]:
    """Return a loop that sends every sample and measures its state, and the deviation of this Gaussian state."""
    L = regulate(SLOW.A, SLOW.B, UNIT.Q, UNIT.R, UNIT.N).L
    pole = float((SLOW.A + SLOW.B @ L)[0, 0])
    return close(SLOW, design.all_time(SLOW, UNIT)), 1 / np.sqrt(1 - pole**2)


def seldom() -> Loop:
    """Return a loop that decides."""
    return close(SLOW, design.lqg(SLOW, UNIT, theta=0.5))


def counted(
    loop: Loop, row: Any, high: float, paths: int, steps: int, stride: int = 1
) -> tuple[float, float, float, float]:
    """Return shares of steps above a bound, and of windows of 1000 steps that contain one, with their errors."""
    program = loop.program().keep({COST}, states={"x"})
    run, rows = prepare(program), [i for i, state in enumerate(program.states) if state.name == "x"]
    states = run(loop.start(program, paths, 77), 1000, None).states
    share, hit = np.zeros(paths), np.zeros(paths, dtype=bool)
    hits = []
    for step in range(steps):
        states = run(states, stride, None).states
        over = (np.asarray(row) @ states[rows])[0] > high
        share, hit = share + over, hit | over
        if step % 1000 == 999:
            hits.append(hit.copy())
            hit[:] = False
    windows = np.mean(hits, axis=0) if hits else np.zeros(paths)
    root = np.sqrt(paths)
    return share.mean() / steps, share.std() / steps / root, windows.mean(), windows.std() / root


def agree(found: Any, value: float, error: float = 0.0) -> None:
    """Check that an estimate agrees with a number within the combined standard error."""
    assert abs(found.value - value) <= SURE * np.hypot(found.standard_error, error), (found, value, error)


@pytest.mark.parametrize("rarity", few((0.05, 1e-2, 1e-4, 1e-6), 2, start=1))
def test_a_gaussian_state_violates_a_limit_as_often_as_the_normal_law_says(rarity: float) -> None:
    """Without decisions, the state is Gaussian with a known variance, also at one step in a million."""
    loop, deviation = every_sample()
    found = violations(loop, Limits(ROW, high=[float(norm.isf(rarity)) * deviation]), accuracy=0.2)
    agree(found.total.per_step, rarity)
    assert found.total.per_step.standard_error <= 0.2 * rarity * 1.5
    assert (found.total.levels > 0) == (rarity < 0.02)
    assert found.each == (found.total,)
    assert found.window == "1000 steps"


@pytest.mark.parametrize("seed", few(range(10), 1))
def test_every_limit_of_a_larger_system_has_its_own_probability(seed: int) -> None:
    """Three limits of a measured state, one- and two-sided: one frequent, two rare, and all together."""
    system = make_system(seed, 3, 2, 3, True, 3)
    plant, cost = system.plant, system.cost
    L = regulate(plant.A, plant.B, cost.Q, cost.R, cost.N).L
    closed = plant.A + plant.B @ L
    covariance = solve_discrete_lyapunov(closed, plant.W)
    rows = np.random.default_rng(seed).standard_normal((3, 3))
    spread = np.sqrt(np.diag(rows @ covariance @ rows.T))
    rare = np.array([0.05, 2e-4, 1e-5])
    high = norm.isf(rare / np.array([1.0, 1.0, 2.0])) * spread
    limits = Limits(rows, [-np.inf, -np.inf, -high[2]], high)
    found = violations(close(plant, design.all_time(plant, cost)), limits, seed=seed, accuracy=0.3)
    for one, value in zip(found.each, rare, strict=True):
        agree(one.per_step, value)
    whole = found.total.per_step
    assert max(rare) - SURE * whole.standard_error <= whole.value <= rare.sum() + SURE * whole.standard_error


@pytest.mark.parametrize(("paths", "steps"), [(1024, 3000), pytest.param(8192, 20_000, marks=pytest.mark.evidence)])
def test_brute_force_agrees_at_one_step_in_ten_thousand(paths: int, steps: int) -> None:
    """Shares of time and of windows of a thousand steps, for a loop whose decisions make the state non-Gaussian."""
    loop = seldom()
    share, error, windows, spread = counted(loop, ROW, 6.2, paths, steps)
    found = violations(loop, Limits(ROW, high=[6.2]), accuracy=0.1 * np.sqrt(3000 / steps))
    assert 5e-5 < share < 2e-4
    assert found.total.levels >= 4
    agree(found.total.per_step, share, error)
    agree(found.total.within, windows, spread)


@pytest.mark.parametrize("seeds", [10, pytest.param(100, marks=pytest.mark.evidence)])
def test_standard_errors_are_those_of_repetitions(seeds: int) -> None:
    """Errors in units of their standard errors have the mean 0 and the variance 1, per step and per window."""
    loop, deviation = every_sample()
    limits = Limits(ROW, high=[float(norm.isf(1e-3)) * deviation])
    found = [violations(loop, limits, seed=seed, steps=400_000).total for seed in range(seeds)]
    scores = np.array([(one.per_step.value - 1e-3) / one.per_step.standard_error for one in found])
    within = np.array([one.within.value for one in found])
    claimed = np.mean([one.within.standard_error**2 for one in found])
    low, high = chi2.ppf([1e-4, 1 - 1e-4], seeds - 1) / (seeds - 1)
    assert abs(scores.mean()) <= SURE / np.sqrt(seeds)
    assert 0.8 * low <= scores.var(ddof=1) <= 1.25 * high  # the standard errors have errors, too
    assert 0.8 * low <= within.var(ddof=1) / claimed <= 1.25 * high


@pytest.mark.parametrize("kind", few([name for name in KINDS if name not in ("integral", "optimal")], 2, start=9))
def test_every_policy_kind_can_be_copied(kind: str) -> None:
    """Paths with all their states continue: counts of a plain simulation agree."""
    problem = KINDS[kind]
    policy = problem.designed()
    assert not isinstance(policy, EventPolicy | OptimalPolicy)
    loop = problem.close(policy)
    row = np.eye(1, loop.problem.plant.states)
    program = loop.program().keep({COST}, states={"x"})
    begun = prepare(program)(loop.start(program, 2048, 5), 600, None).states
    (x,) = row @ begun[[i for i, state in enumerate(program.states) if state.name == "x"]]
    high = float(x.mean() + 2.7 * x.std())
    share, error, *_ = counted(loop, row, high, 2048, 64, stride=24)
    found = violations(loop, Limits(row, high=[high]), accuracy=0.1, steps=3_000_000)
    agree(found.total.per_step, share, error)


def test_the_window_of_a_run_is_its_horizon() -> None:
    """The state of each step of a finite-horizon run is Gaussian, from a known initial state."""
    plant = Plant([[0.95]], [[1.0]], [[1.0]], mean=[2.0], covariance=[[1.0]])
    policy = design.remote_lqg(plant, Cost([[1.0]], [[10.0]], horizon=12), zeta=0.0, controller="actuator")
    loop = close(plant, policy)
    bound = 7.0
    share, error, windows, spread = runs(loop, bound, 200_000)
    found = violations(loop, Limits(ROW, high=[bound]), accuracy=0.1)
    assert found.window == "run"
    assert share < 1e-2
    assert found.total.levels > 0
    agree(found.total.per_step, share, error)
    agree(found.total.within, windows, spread)


def runs(loop: Loop, high: float, paths: int) -> tuple[float, float, float, float]:
    """Return shares of the steps of finite-horizon runs, and of the runs, above a bound, with their errors."""
    program = loop.program().keep({COST}, states={"x"})
    run, states = prepare(program), loop.start(program, paths, 4)
    (row,) = [i for i, state in enumerate(program.states) if state.name == "x"]
    over = []
    for _ in range(12):
        states = run(states, 1, None).states
        over.append(states[row] > high)
    share, any_step, root = np.mean(over, axis=0), np.any(over, axis=0), np.sqrt(paths)
    return share.mean(), share.std() / root, any_step.mean(), any_step.std() / root


def test_a_threshold_that_makes_too_many_copies_is_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The number of paths stays below its limit, and the probability is still unbiased."""
    monkeypatch.setattr("taciturn_rare.splitting.MOST_PATHS", 4000)
    loop, deviation = every_sample()
    found = violations(loop, Limits(ROW, high=[float(norm.isf(1e-4)) * deviation]), accuracy=0.3).total
    assert found.levels < 6
    agree(found.per_step, 1e-4)


def test_a_limit_that_is_never_reached_has_an_honest_error() -> None:
    """Far out, the standard error is the share of time above the last threshold; 1e-15 is below it."""
    loop, deviation = every_sample()
    found = violations(loop, Limits(ROW, high=[8 * deviation]), steps=20_000).total
    assert found.per_step.value <= 1e-12
    assert 1e-12 < found.per_step.standard_error < 1e-6


WALK = Plant([[0.9, 0.0], [0.0, 1.0]], [[1.0], [0.0]], np.eye(2))


@pytest.mark.parametrize(
    ("loop", "words"),
    [
        (
            lambda: close(Plant([[0.9]], [[1.0]], [[0.0]]), design.lqg(SLOW, UNIT, theta=0.5)),
            "nothing in the loop is random, so its states have no distribution; expected noise W or V, or a horizon",
        ),
        (
            lambda: close(Plant([[1.2]], [[1.0]], [[1.0]], input_limit=[3.0]), design.lqg(SLOW, UNIT, theta=0.5)),
            "the plant is unstable and its inputs are limited, so its states have no stationary distribution",
        ),
        (
            lambda: close(WALK, design.lqg(WALK, Cost(np.diag([1.0, 0.0]), [[1.0]]), theta=0.5)),
            "has no stationary distribution: it follows a disturbance that wanders without limit",
        ),
        (
            lambda: close(
                SLOW, design.remote_lqg(SLOW, Cost([[1.0]], [[1.0]], discount=0.9), theta=0.1, controller="sensor")
            ),
            "limits are given with cost.discount",
        ),
    ],
)
def test_a_loop_without_a_stationary_distribution_is_refused_in_one_sentence(loop: Any, words: str) -> None:
    """The reason is stated, and no number."""
    closed = loop()
    with pytest.raises(ProblemError) as caught:
        violations(closed, Limits(np.eye(closed.problem.plant.states)[[-1]], high=[1.0]))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.evidence
def test_a_state_that_follows_a_wandering_disturbance_is_refused_and_an_output_at_its_set_point_is_not() -> None:
    """The first state compensates the disturbance of the second, whose set-point is kept."""
    base = Plant([[0.9, 0.0], [0.2, 0.8]], [[1.0], [0.0]], 0.01 * np.eye(2), [[0.0, 1.0]], [[0.01]])
    plant = follow(base, [[0.0, 1.0]], [0.5], [ExternalDisturbance([0.0, 0.1], wander=1e-3)])
    loop = close(plant, design.excess(plant, Cost(np.diag([0.0, 1.0]), [[0.1]]), theta=0.3))
    found = violations(loop, Limits([[0.0, 1.0]], high=[1.0]), steps=200_000)
    assert 0 < found.total.per_step.value < 0.2
    with pytest.raises(ProblemError, match="follows a disturbance that wanders without limit"):
        violations(loop, Limits([[1.0, 0.0]], high=[1.0]), steps=200_000)


@pytest.mark.evidence
def test_limits_are_in_the_units_of_a_plant_with_an_operating_point() -> None:
    """The same draws at another place give the same probabilities."""
    found: list[Violation] = []
    for place in (0.0, 20.0):
        point = OperatingPoint([place], [-0.05 * place])
        plant = Plant(SLOW.A, SLOW.B, SLOW.W, operating_point=point)
        loop = close(plant, design.lqg(plant, UNIT, theta=0.5))
        found.append(violations(loop, Limits(ROW, high=[place + 5.0]), accuracy=0.3).total)
    assert found[0].per_step.value > 0
    assert found[1].per_step.value == pytest.approx(found[0].per_step.value, rel=1e-6)


def limited(**parameters: Any) -> taciturn.Problem:
    """Return a problem with a limit."""
    return taciturn.Problem(SLOW, UNIT, Network(), "lqg", {"theta": 0.5, **parameters}, limits=Limits(ROW, high=[3.5]))


def test_an_evaluation_shows_stores_and_exports_the_probabilities() -> None:
    """Text, JSON, table and the stored form contain the same numbers."""
    found = taciturn.evaluate(limited(), steps=100_000)
    seen = found.violations
    assert seen is not None
    assert "x1 ≤ 3.5" in str(found)
    assert "within 1000 steps" in " ".join(str(found).split())
    document = found.document()["violation"]
    assert document["per_step"]["value"] == seen.total.per_step.value
    assert document["window"] == "1000 steps"
    assert document["limits"][0]["limit"] == "x1 ≤ 3.5"
    assert found.records()[0]["violation"] == seen.total.per_step
    assert decode(encode(found)).violations.total == seen.total


@pytest.mark.evidence
def test_tradeoff_compare_and_sweep_have_columns_of_the_probabilities() -> None:
    """A larger threshold violates the limit more often."""
    rows = taciturn.tradeoff(limited(), {"theta": [0.1, 2.0]}, standard_error=0.02)
    first, second = (row["violation"] for row in rows.records())
    assert isinstance(first, taciturn.Estimate)
    assert isinstance(second, taciturn.Estimate)
    assert first.value < second.value
    assert "violation" in str(rows)
    swept = taciturn.sweep(limited(), {"theta": [0.1, 2.0]}, steps=20_000)
    assert float(swept.violation[0]) < float(swept.violation[1])
    assert swept.violation_within.attrs["units"] == "per 1000 steps"
    problems = {"hold": limited(), "model": limited(actuation="model")}
    ranked = taciturn.compare(problems, 0.4, standard_error=0.02)
    assert all(one.violation is not None for one in ranking_of(ranked))
    assert "violation" in str(ranked)


def ranking_of(found: taciturn.Comparison) -> tuple[Any, ...]:
    """Return the compared policies."""
    return found.ranking


@pytest.mark.evidence
def test_tune_finds_the_largest_threshold_within_a_budget_of_violations() -> None:
    """The answer keeps the budget, and a threshold a quarter larger does not."""
    found = taciturn.tune(limited(), violation=0.02, standard_error=0.02)
    seen = found.goal.of(found.evaluation)
    assert seen.value + 2 * seen.standard_error <= 0.02
    assert seen.value > 0.01
    larger = found.problem.changed({"theta": 1.25 * float(found.parameter.value)})
    more = violations(larger.close(larger.design()), Limits(ROW, high=[3.5]), seed=3).total.per_step
    assert more.value + 2 * more.standard_error > 0.02
    assert "violation at most 0.02 of the steps, met" in str(found)


@pytest.mark.parametrize(
    ("problem", "budget", "words"),
    [
        (replace(limited(), limits=None), 0.1, "violation is given for a problem without state limits"),
        (limited(), 1.5, "violation is 1.5; expected 0 < violation < 1"),
    ],
)
def test_a_budget_that_cannot_be_met_is_one_sentence(problem: taciturn.Problem, budget: float, words: str) -> None:
    """The sentence tells why."""
    with pytest.raises(ProblemError) as caught:
        taciturn.tune(problem, violation=budget)
    assert words in str(caught.value)


@pytest.mark.evidence
def test_an_evaluation_without_probabilities_tells_why() -> None:
    """Cost and rate are there, with a note: for a state that wanders, and for a policy without steps."""
    wandering = taciturn.Problem(
        WALK, Cost(np.diag([1.0, 0.0]), [[1.0]]), Network(), "lqg", {"theta": 0.5}, limits=Limits([[0.0, 1.0]], [0.0])
    )
    found = taciturn.evaluate(wandering, steps=100_000)
    assert found.violations is None
    assert any(note.startswith("no probability of violation: the state in the limit 0 ≤ x2") for note in found.notes)

    timeless = replace(KINDS["integral"], limits=Limits(ROW, high=[1.0]))
    found = taciturn.evaluate(timeless, steps=20_000)
    assert found.violations is None
    assert (
        "the policy integral works in continuous time without sampling steps, so violations cannot be simulated"
        in found.notes[-1]
    )


TEXT = """
[plant]
A = [[0.9, 0.1], [0.0, 0.8]]
B = [[0.0], [1.0]]
C = [[1.0, 0.0]]
W = [[0.1, 0.0], [0.0, 0.1]]
V = [[0.1]]
dt = 0.5
[cost]
Q = [[1.0, 0.0], [0.0, 1.0]]
R = [[1.0]]
[policy]
kind = "lqg"
theta = 0.3
"""


def test_a_file_states_limits_of_its_outputs_or_of_combinations(tmp_path: Any) -> None:
    """The measured outputs are the default; a window is an hour of steps."""
    path = tmp_path / "limited.toml"
    path.write_text(f"{TEXT}[limits]\nhigh = [2.0]\n")
    problem = taciturn.load(path)
    assert problem.limits is not None
    assert problem.limits.names == ("x1 ≤ 2",)
    other = problem.changed({"limits.outputs": [[1.0, -1.0]], "limits.low": [-3.0]})
    assert other.limits is not None
    assert other.limits.names == ("-3 ≤ x1 − x2 ≤ 2",)
    assert other.plant is problem.plant
    found = taciturn.evaluate(problem, steps=50_000).violations
    assert found is not None
    assert found.window == "hour"


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("hihg = [1.0]", "limits.hihg is not a known key; expected one of outputs, low, high. Did you mean 'high'?"),
        ("outputs = [[1.0]]\nhigh = [1.0]", "limits.outputs has 1 column; expected 2 columns, one for each state"),
        ("high = [1.0, 2.0]", "limits.high has shape (2,); expected the shape (1,)"),
        ("high = '1'", "limits.high is '1'; expected a list"),
    ],
)
def test_a_wrong_table_of_limits_is_one_sentence(tmp_path: Any, table: str, words: str) -> None:
    """The sentence names the file and the key."""
    path = tmp_path / "limited.toml"
    path.write_text(f"{TEXT}[limits]\n{table}\n")
    with pytest.raises(ProblemError) as caught:
        taciturn.load(path)
    assert words in str(caught.value)
    assert "limited.toml" in str(caught.value)


def test_progress_reaches_its_end_and_a_time_limit_leaves_a_note() -> None:
    """The fractions never fall; without time for the violations, cost and rate are still there."""
    told: list[float] = []
    taciturn.evaluate(limited(), steps=50_000, progress=told.append)
    assert told == sorted(told)
    assert told[-1] <= 1.0


def test_a_violation_has_the_name_of_its_method() -> None:
    """Plain simulation, or the number of levels."""
    found = taciturn.Estimate(0.1, 0.01, "simulation")
    assert Violation(found, found, 0).method == "simulation"
    assert Violation(found, found, 3).method == "importance splitting, 3 levels"
