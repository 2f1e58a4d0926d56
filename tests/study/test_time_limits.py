"""A time limit covers everything that a command does: designs, searches, comparisons and bounds."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import typer

import taciturn
from taciturn import ProblemError, UnstableError, _progress, load
from taciturn._progress import NoTimeLeft, OutOfTime, answered_within, check_time, part_of_time, seconds_left
from taciturn.cli.frame import app
from taciturn.problem import parse

SLOW = {  # a disturbance that a held input does not follow, so that no period is stable: a search tries them all
    "plant": {
        "A": [[1.0, 0.0], [0.1, 0.9]], "B": [[0.05], [0.0]], "C": [[0.0, 1.0]], "W": [[1e-4, 0], [0, 1e-4]],
        "V": [[1e-3]], "dt": 1.0,
    },
    "disturbance": [{"enters": [0.05, 0.0], "kind": "sinusoid", "frequency": 0.2, "wander": 1e-6, "measured": [0.1]}],
    "reference": {"value": [3.0]}, "cost": {"Q": [[0, 0], [0, 1.0]], "R": [[0.05]]},
    "policy": {"kind": "excess", "delta": 0.002},
}  # fmt: skip
STEADY = [{"enters": [0.05, 0.0], "wander": 1e-6, "measured": [0.1]}]
Clock = Callable[[float], Iterator[float]]


@pytest.fixture
def ticking(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Return a function after which each check of the time finds it advanced by some seconds."""

    def tick(seconds: float) -> Iterator[float]:
        times = itertools.count(0.0, seconds)
        monkeypatch.setattr(_progress, "clock", lambda: next(times))
        return times

    return tick


def test_the_search_for_periodic_control_ends_with_a_note(ticking: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of hundreds of cycles a few are tried, and cost and bounds are there."""
    tried: list[object] = []

    def unstable(_: object, cycle: object) -> float:
        tried.append(cycle)
        raise UnstableError("no gain stabilises the plant")

    monkeypatch.setattr("taciturn.lqg.periodic.Held.solve", unstable)
    times = ticking(0.005)
    found = taciturn.evaluate(parse(SLOW | {"disturbance": STEADY}, "slow"), steps=2048, time_limit=1.0)
    assert next(times) < 1.1
    assert 10 < len(tried) < 200
    assert found.clock is None
    assert found.no_clock == "the time limit of 1 s passed"
    assert "periodic       none at this rate: the time limit of 1 s passed" in str(found)
    assert found.cost_bound is not None
    assert "as written" not in str(found)  # nothing was added, so nothing is missing


def test_without_a_comparison_nothing_is_said_to_be_consistent(ticking: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    """An unstable periodic control has an infinite cost, and one that was not found has none that is known."""
    problem = load("double-integrator")
    assert taciturn.evaluate(problem, steps=50_000).consistency is not None

    def late(*_: object) -> object:
        raise OutOfTime

    monkeypatch.setattr("taciturn.study.periodic.fair_clock", late)
    ticking(0.0)
    found = taciturn.evaluate(problem, steps=50_000, time_limit=1.0)
    assert found.no_clock == "the time limit of 1 s passed"
    assert found.consistency == (None if found.cost_bound is None else "guaranteed")


@pytest.mark.parametrize("kind", ["all-time", "periodic", "lqg"])
def test_a_design_is_within_the_limit(ticking: Clock, kind: str) -> None:
    """Also of a policy whose cost is known without a simulation."""
    parameters = {"all-time": {}, "periodic": {"every": 3}, "lqg": {"theta": 0.1}}[kind]
    problem = load("two-mass-lqg").changed({"theta": None, "kind": kind, **parameters})
    ticking(10.0)
    with pytest.raises(ProblemError, match="time_limit is 1, but no result was available within 1 s; expected a"):
        taciturn.evaluate(problem, time_limit=1.0)


COMMANDS = {
    "evaluate": ["two-mass"],
    "show": ["two-mass"],
    "simulate": ["two-mass"],
    "certify": ["two-mass-lqg"],
    "tune": ["two-mass", "--rate", "0.3"],
    "tradeoff": ["two-mass", "--over", "theta=0.1,1"],
    "sweep": ["two-mass", "--over", "theta=0.1,1", "--store", "STORE"],
    "compare": ["two-mass", "two-mass-lqg", "--rate", "0.3"],
    "channel": ["two-mass", "--copies", "3", "--capacity", "1"],
}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_that_computes_ends_in_time_with_a_sentence(
    command: str, ticking: Clock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The clock advances by ten seconds at each check; nothing is printed or stored as if it were an answer."""
    words = [str(tmp_path / "cells") if word == "STORE" else word for word in COMMANDS[command]]
    times = ticking(10.0)
    monkeypatch.setattr("sys.argv", ["taciturn", command, *words, "--time", "1"])
    with pytest.raises(SystemExit) as ended:
        taciturn.cli.main()
    out, err = capsys.readouterr()
    assert (ended.value.code, out) == (2, "")
    assert err == "taciturn: --time is 1, but no result was available within 1 s; expected a longer time limit\n"
    assert next(times) < 500
    assert not list(tmp_path.glob("cells/cells/*/*"))


def test_the_list_of_commands_is_complete() -> None:
    """All that design or simulate, but not those that run nodes or write files."""
    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    timed = {name for name, one in commands.items() if any(param.name == "time" for param in one.params)}
    assert timed == set(COMMANDS)


def test_a_cell_that_was_answered_early_is_not_stored(ticking: Clock, tmp_path: Path) -> None:
    """The same sweep without a limit computes it."""
    ticking(0.5)
    grid: dict[str, list[object]] = {"theta": [0.1]}
    with pytest.raises(ProblemError, match="no result was available within 40 s"):
        taciturn.sweep(load("two-mass-lqg"), grid, store=tmp_path, standard_error=1e-9, time_limit=40.0)
    assert not list(tmp_path.glob("cells/*/*"))
    assert bool(taciturn.sweep(load("two-mass-lqg"), grid, store=tmp_path, steps=4096).cost.notnull().all())


def test_limits_are_nested(monkeypatch: pytest.MonkeyPatch) -> None:
    """The earlier end holds; the limit that passed is the one that is named."""
    now = [0.0]
    monkeypatch.setattr(_progress, "clock", lambda: now[0])

    def within(limit: float, then: float) -> None:
        with answered_within(limit, early=True):
            now[0] = then
            check_time()

    assert seconds_left() == float("inf")
    with answered_within(10.0):
        with part_of_time(0.5):
            assert seconds_left() == 10.0  # an early answer would be of no use
        with answered_within(8.0, early=True), part_of_time(0.5), answered_within(6.0):
            assert seconds_left() == 4.0
        assert seconds_left() == 10.0
        with pytest.raises(ProblemError, match="time_limit is 3"):
            within(3.0, 4.0)
        check_time()
        with pytest.raises(NoTimeLeft):
            within(20.0, 11.0)
    check_time()
    with answered_within(1.0, early=True):
        now[0] = 13.0
        with pytest.raises(OutOfTime):
            check_time()
