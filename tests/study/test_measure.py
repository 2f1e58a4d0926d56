"""The method that is predicted to take the least work is taken, and a time limit is kept."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

import taciturn
from taciturn import _progress
from taciturn.errors import ProblemError
from taciturn.problem import Problem
from taciturn.simulation.average import Averaging, average
from taciturn.simulation.sampling import Averages
from taciturn.study.measure import SPEED, Candidate, rank


def candidate(name: str, least: float, work: float, gradual: bool = True) -> Candidate:
    """Return a method of known work that is never run."""

    def run(_: object) -> Averages:
        raise AssertionError

    return Candidate(name, least * SPEED, lambda _: work * SPEED, run, gradual)


def test_the_least_predicted_work_comes_first_and_the_sentence_names_all() -> None:
    """A method whose least work is more than another's is not looked at more closely."""
    ordered, reason = rank([candidate("slow", 5.0, 1e9), candidate("quick", 0.1, 0.5), candidate("mid", 0.2, 2.0)])
    assert [one.name for one in ordered] == ["quick", "mid", "slow"]
    assert reason == "quick 0.5 s estimated, mid 2 s, slow at least 5 s"


def test_what_answers_at_its_end_alone_comes_last_where_it_would_be_late(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of the limit is what it may be predicted to take."""
    monkeypatch.setattr(_progress, "clock", lambda: 0.0)
    both = [candidate("all or nothing", 0.0, 3.0, gradual=False), candidate("gradual", 0.0, 50.0)]
    for seconds, first in ((10.0, "all or nothing"), (5.0, "gradual"), (None, "all or nothing")):
        with _progress.answered_within(seconds):
            assert rank(both)[0][0].name == first


def test_a_limit_that_passes_before_any_answer_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    """A prediction that runs out of time is not asked again, and the simulation that it began does not continue."""
    seconds = itertools.count(0.0, 0.5)
    monkeypatch.setattr(_progress, "clock", lambda: next(seconds))
    with pytest.raises(ProblemError, match=r"time_limit is 0\.1, but no result was available within"):
        taciturn.evaluate(taciturn.load("two-mass-lqg"), standard_error=1e-9, time_limit=0.1)
    loop = taciturn.load("two-mass-lqg").close(taciturn.load("two-mass-lqg").design())
    begun = Averaging(loop)
    with _progress.answered_within(0.1, early=True):
        for _ in range(2):
            with pytest.raises(_progress.OutOfTime):
                begun.predict(1e-9)
        with pytest.raises(_progress.OutOfTime):
            begun.finish()


def test_no_error_below_rounding_is_claimed_or_taken() -> None:
    """A quadrature's error holds the rounding of its answer; what no double tells apart is refused."""
    problem = taciturn.Problem(
        taciturn.Plant([[0.9]], [[1.0]], [[0.1]]), taciturn.Cost([[1.0]], [[0.3]]), taciturn.Network(), "excess",
        {"theta": 0.01, "actuation": "model"},
    )  # fmt: skip
    found = taciturn.evaluate(problem, method="exact", confidence=None)
    assert 2.0**-52 * found.cost.value < found.cost.error < 1e-9
    with pytest.raises(
        ProblemError, match=r"standard_error is 1e-17, but double precision resolves a cost of .* to 1\.\d?e-16"
    ):
        taciturn.evaluate(problem, standard_error=1e-17)


def integrators(states: int) -> Problem:
    """Return a chain of integrators under Wiener noise, looked at every half second."""
    plant = taciturn.ContinuousPlant(np.eye(states, k=1), np.eye(states)[:, -1:], np.eye(states))
    cost = taciturn.Cost(np.eye(states), np.eye(1))
    return taciturn.Problem(plant, cost, taciturn.Network(), "consistent", {"period": 0.5})


def test_a_quadrature_works_to_the_asked_error_and_no_further() -> None:
    """Where a rough answer is asked for, its nodes are few; it is within the errors of the fine one."""
    rough, fine = (taciturn.evaluate(integrators(2), standard_error=error, method="exact") for error in (0.05, 1e-5))
    assert rough.method == fine.method == "quadrature"
    assert fine.cost.error < rough.cost.error <= 0.05
    assert abs(rough.cost.value - fine.cost.value) <= rough.cost.error + fine.cost.error


def test_every_method_is_asked_by_the_name_that_the_answer_gives_it() -> None:
    """All of them agree within their errors, and a method that does not apply is refused by its name."""
    names = ("exact", "conditional sampling", "simulation")
    found = [taciturn.evaluate(integrators(2), method=name, standard_error=0.05) for name in names]
    assert [one.method for one in found] == ["quadrature", *names[1:]]
    for one in found[1:]:
        spread = one.cost.standard_error + found[0].cost.error
        assert abs(one.cost.value - found[0].cost.value) <= 5 * spread
    with pytest.raises(ProblemError, match="method is 'conditional sampling', but"):
        taciturn.evaluate(taciturn.load("remote-scalar"), method="conditional sampling")
    with pytest.raises(ProblemError, match="expected method 'auto'"):
        taciturn.evaluate(integrators(2), method="conditional sampling", steps=10_000)


def test_a_simulation_continues_from_the_windows_that_predicted_its_work() -> None:
    """Numbers and steps are those of a run without prediction, so nothing was simulated twice."""
    problem = taciturn.load("two-mass-lqg")
    loop = problem.close(problem.design())
    looked_at = Averaging(loop, standard_error=1e-3)
    left = looked_at.predict(1e-3)
    assert 0 < left < np.inf
    assert looked_at.predict(1e-3) == left
    assert looked_at.finish() == average(loop, standard_error=1e-3)


def test_a_prediction_that_runs_out_of_time_leaves_the_answer_of_another_method() -> None:
    """The method that was stopped counts as out of reach."""

    def late(_: float) -> float:
        raise _progress.OutOfTime

    slow = replace(candidate("slow", 0.1, 0.0), predict=late)
    assert [one.name for one in rank([slow, candidate("other", 0.2, 5.0)])[0]] == ["other", "slow"]


def test_a_run_out_of_time_answers_with_what_it_has(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that jumps by a second at every check: the asked error is out of reach, and the answer says so."""
    ticks = itertools.count()
    monkeypatch.setattr(_progress, "clock", lambda: float(next(ticks)))
    found = taciturn.evaluate(taciturn.load("two-mass-lqg"), standard_error=1e-9, time_limit=50.0)
    assert not found.reached
    assert found.method == "simulation"
    assert found.cost.standard_error > 1e-9
    assert next(ticks) < 200


@pytest.mark.parametrize("limit", [0.0, -1.0, float("nan")])
def test_a_time_limit_is_positive(limit: float) -> None:
    """In one sentence."""
    with pytest.raises(ProblemError, match="time_limit"):
        taciturn.evaluate(taciturn.load("two-mass-lqg"), time_limit=limit)
