"""A shortened run: every test has its turn, changes find the tests that reach them, and chance turns no run red."""

from __future__ import annotations

from datetime import date, timedelta
from pathlib import Path

import numpy as np
import pytest
from counts import RUN, scaled
from drawn import DATED, FIXED, over
from hypothesis import strategies as st
from imports import ROOT, distances, imported
from measured import TIMES, agree_together, average, longer
from planted import DEFECTS
from selection import TURNS, in_turn, order, reach

from taciturn import Plant, close, design
from taciturn.model.cost import Cost

DAY = date(2026, 11, 28)
SEEDS = st.integers(0, 2**32 - 1)


@pytest.fixture
def shortened(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let this test see a shortened run of a certain day."""
    monkeypatch.setattr(RUN, "shortened", True)
    monkeypatch.setattr(RUN, "day", DAY)


def test_every_test_has_its_turn_within_four_days() -> None:
    """Once in each four days in a row, and about a quarter of all tests on each."""
    names = [f"tests/test_one.py::test_{k}" for k in range(400)]
    turns = np.array([[in_turn(name, DAY + timedelta(days)) for name in names] for days in range(TURNS)])
    assert (turns.sum(axis=0) == 1).all()
    assert (abs(turns.sum(axis=1) - 100) < 5 * np.sqrt(75)).all()


@pytest.mark.evidence
def test_a_change_is_reached_by_what_imports_it() -> None:
    """At the first import, by way of others, by the names of the package, by the catalogue, and beside its data."""
    at = {
        name: ROOT / "tests" / name for name in ("laws/test_excess.py", "lqg/test_riccati.py", "model/test_bursts.py")
    }
    core, tests = ROOT / "src" / "taciturn", tuple(at.values())
    assert at["lqg/test_riccati.py"] in reach(tests, [core / "lqg" / "equation.py"])
    assert at["lqg/test_riccati.py"] not in reach(tests, [core / "cli" / "new.py"])
    assert reach(tests, [at["laws/test_excess.py"]]) == {at["laws/test_excess.py"]: 0}
    assert core / "study" / "evaluate.py" in imported(ROOT / "examples" / "which_theta_halves_the_traffic.py")
    assert distances([core / "design" / "kinds" / "excess.py"])[core / "problem" / "parameters.py"] <= 2
    in_c = ROOT / "tests" / "export" / "test_core.py"
    assert in_c in reach([in_c, *tests], [core / "export" / "core" / "taciturn_node.c"])
    assert set(reach(tests, [ROOT / "tests" / "conftest.py"])) == set(tests)


@pytest.mark.evidence
def test_turns_come_first_then_what_is_near_a_change() -> None:
    """Without a known commit, everything is near."""
    tests = [*sorted((ROOT / "tests" / "lqg").glob("test_*.py")), ROOT / "tests" / "cli" / "test_usage.py"]
    named = [(f"{path.name}::{k}", path) for path in tests for k in range(8)]
    nothing, everything = order(named, DAY, []), order(named, DAY, None)
    assert nothing == [position for position, (name, _) in enumerate(named) if in_turn(name, DAY)]
    assert sorted(everything) == list(range(len(named)))
    assert everything[: len(nothing)] == nothing
    near = order(named, DAY, [ROOT / "tests" / "cli" / "test_usage.py"])
    assert {named[position][1].name for position in near[len(nothing) :]} == {"test_usage.py"}
    absent = next(position for position in range(len(named)) if position not in nothing)
    assert order(named, DAY, [], {named[absent][0]}) == [absent, *nothing]


@pytest.mark.usefixtures("shortened")
def test_a_shortened_law_draws_fixed_examples_and_those_of_the_day(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same fixed ones on each day, the same ones again on the same day, and others on another."""
    seen, drawn = list[list[int]](), list[int]()
    for day in (DAY, DAY, DAY + timedelta(1)):
        monkeypatch.setattr(RUN, "day", day)
        over(lambda seed: drawn.append(seed), 300, seed=SEEDS)
        seen.append(list(drawn))
        drawn.clear()
    assert [len(drawn) for drawn in seen] == [FIXED + DATED] * 3
    assert seen[0] == seen[1] != seen[2]
    assert seen[0][:FIXED] == seen[2][:FIXED]
    assert len(set(seen[0][FIXED:]) & set(seen[2][FIXED:])) < 10  # simple ones, such as 0, are drawn on every day
    assert scaled(100, 7) == 7


@pytest.mark.usefixtures("shortened")
def test_a_dated_example_that_fails_by_chance_is_measured_again_and_passes() -> None:
    """With a warning, while one that fails again fails the test, and names the day."""
    looks: list[int] = []

    def fails_once(seed: int) -> None:
        looks.append(seed)
        assert len(looks) not in (FIXED + 3, FIXED + 20)

    with pytest.warns(pytest.PytestWarning, match=f"by chance, with --day {DAY}"):
        over(fails_once, 300, seed=SEEDS)
    assert len(looks) == FIXED + DATED + 2

    count = iter(range(10**6))
    with pytest.raises(AssertionError) as found:
        over(lambda seed: check(next(count) < FIXED), 300, seed=SEEDS)
    assert f"--day {DAY}" in "".join(found.value.__notes__)
    with pytest.raises(AssertionError):  # a fixed one fails at once
        over(lambda seed: check(False), 300, seed=SEEDS)


def check(holds: bool) -> None:
    """Fail unless this holds."""
    assert holds


def test_longer_averages_are_others_and_sixteen_times_as_long() -> None:
    """Of the same loop: the standard error is a quarter."""
    plant = Plant([[0.9]], [[1.0]], [[0.1]])
    loop = close(plant, design.excess(plant, Cost([[1.0]], [[1.0]]), theta=0.5))
    short = average(loop, seed=1, steps=20_000)
    with longer():
        long = average(loop, seed=1, steps=20_000)
    assert long.steps == pytest.approx(TIMES * short.steps, rel=0.1)
    assert long.cost.value != short.cost.value
    assert abs(long.cost.value - short.cost.value) < 5 * short.cost.standard_error


def test_a_bias_that_no_system_shows_is_seen_in_many() -> None:
    """Half a standard error in each of 300; and spreads that are wrong."""
    z = np.random.default_rng(1).normal(size=300)
    assert agree_together(z)
    assert not agree_together(z + 0.5)
    assert not agree_together(2 * z)
    assert (abs(z + 0.5) < 4.5).all()


def test_the_commit_whose_full_counts_ran_is_named() -> None:
    """As git writes it, in the file that ``.ci/full`` writes."""
    assert len(Path(ROOT / ".ci" / "fully-checked").read_text(encoding="utf-8").split()[0]) == 40


@pytest.mark.parametrize("name", DEFECTS)
def test_defects_can_be_planted(name: str) -> None:
    """The line that a defect changes is there once (``planted`` plants it and looks which test finds it)."""
    defect = DEFECTS[name]
    text = (ROOT / "src" / "taciturn" / defect.file).read_text(encoding="utf-8")
    assert text.count(defect.right) == 1
    assert defect.wrong not in text
