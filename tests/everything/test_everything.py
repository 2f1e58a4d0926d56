"""Problems in which features meet: a few fixed ones in the quick suite, and a hundred of the day in each shortened run.

``python tests/everything/run.py`` examines more of them, with any seed; ``features`` tells how problems are drawn.
"""

from __future__ import annotations

import json
from dataclasses import replace
from math import isfinite
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from counts import RUN, few
from everything import checks, lower, mutated, plain, routes, run
from everything.delays import RANDOM_INPUTS
from everything.draft import write
from everything.features import FEATURES, build
from everything.fingerprints import differing
from everything.late_paths import same_queues
from everything.search import Outcome, Tally, features_of, file_of, pairs, shrunk, tried
from everything.toml import text_of

from taciturn import evaluate, load
from taciturn.errors import ProblemError
from taciturn.problem import Problem
from taciturn.program.late import Ring
from taciturn.study.evaluation import Evaluation

SECONDS = 180.0  # of the problems of a day
FIXED = (
    ("operating point", "cross terms", "kind excess"),
    ("continuous", "normal jumps", "kind all-time"),
    ("two outputs", "one sensor by name", "lossy probes", "kind distributed"),
    ("linear controller", "kind excess"),
    ("feedthrough", "operating point", "another plant", "another feedthrough", "acknowledged losses", "kind excess"),
    ("two inputs", "two outputs", "four nodes", "linear controller", "kind distributed", "threshold of silence"),
    ("correlated noise", "operating point", "kind distributed", "model", "predicted probes", "every path"),
    ("timetable", "PID", "no drift", "kind distributed", "threshold of silence"),
    ("load", "cross terms", "kind excess"),
    ("descriptor", "kind excess", "violations", "named signals", "noise at inputs and outputs"),
    ("late samples", "late inputs", "operating point", "feedthrough", "load", "kind distributed"),
    ("continuous", "two outputs", "two sensors", "probes late by a part", "correlated noise", "kind distributed"),
    ("two inputs", "two actuators", "valves of different delays", "every path", "kind distributed"),
    ("inputs at random times", "kind excess"),
    ("continuous", "inputs at random parts", "kind distributed"),
    ("continuous", "inputs by a histogram", "acknowledged losses", "kind all-time"),
    ("inputs late in bursts", "kind periodic"),
    ("continuous", "inputs late by more", "stated drift", "linear controller", "another plant", "kind excess"),
)
OF_PATHS = {"kept on every path", "certified"}  # checks of bounds that hold on every path


def few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let checks of a problem take a fraction of a second."""
    monkeypatch.setattr(checks, "STEPS", 20_000)
    monkeypatch.setattr(checks, "PATHS", 100)
    monkeypatch.setattr(checks, "OWN_STEPS", 200)


@pytest.mark.parametrize("names", few(FIXED, 4), ids=" + ".join)
def test_features_that_meet_are_simulated_alike(names: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """Every cheap check is made, and none finds a fault."""
    if "valves of different delays" not in names:  # whose banks take long to fill
        few_steps(monkeypatch)
    report = tried(names, 1, ())
    assert report is not None
    assert report.refused is None
    assert not report.faults, "\n".join(f"{one.check}: {one.text}" for one in report.faults) + file_of(names, 1)
    assert "simulated" in report.compared
    bounded = "kind distributed" in names and ("every path" in names or "controller" in build(names, 1).tables)
    late = {"show --wire"} if {*RANDOM_INPUTS} & {*names} else {"queues"}
    assert set(report.skipped) == late | (set() if bounded else OF_PATHS)


def test_a_packet_that_wins_over_a_newer_one_is_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """If receivers used the oldest packet of a step, and if packets came later than their law says."""
    drawn = build(("continuous", "inputs at random parts", "kind excess"), 1)
    write(drawn, tmp_path, text_of(drawn.tables))
    problem = load(tmp_path / "problem.toml")
    answer = evaluate(problem, steps=2000)
    assert same_queues(problem, answer, 1, tmp_path) is None

    def oldest(ring: Ring, values: list[list[int]], otherwise: list[int], piece: int) -> list[int]:
        """Return the value of the oldest packet."""
        found = otherwise
        for age in (0, *ring.ages):
            here = ring.acted(age, piece)
            found = [ring.tick.builder.choose(here, *one) for one in zip(values[age], found, strict=True)]
        return found

    with monkeypatch.context() as patch:
        patch.setattr(Ring, "newest", oldest)
        assert "acts, and not" in str(same_queues(problem, answer, 1, tmp_path))
    monkeypatch.setattr(Ring, "_drawn", lambda ring: ring.tick.builder.constant(ring.codes[-1]))
    assert "shares of the delays on actuator" in str(same_queues(problem, answer, 1, tmp_path))


def test_without_delays_a_model_with_queues_is_the_model(tmp_path: Path) -> None:
    """A part of almost nothing changes little: the integrals over the pieces of a period are those of the period."""
    drawn = build(("continuous", "cross terms", "load", "set-point", "kind excess"), 3)
    tables = {**drawn.tables, "links": {}}
    model = plain.model_of(tables, tmp_path)
    links = {"sensor": {"delay": {"seconds": 1e-7}}}
    late = plain.model_of({**tables, "links": links}, tmp_path)
    n, kept = model.n, np.delete(np.arange(len(late.A)), model.n)
    assert late.n == n + 1
    assert np.allclose(late.A[np.ix_(kept, kept)], model.A, atol=1e-5)
    assert np.allclose(late.B[kept], model.B, atol=1e-5)
    assert np.allclose(late.stage[np.ix_([*kept, -1], [*kept, -1])], model.stage, atol=1e-5)
    assert late.loads is not None
    assert model.loads is not None
    assert np.allclose(np.delete(late.loads.joint, n, axis=0), model.loads.joint, atol=1e-5)
    assert np.allclose(late.loads.alone, model.loads.alone)


@pytest.mark.evidence
def test_a_wrong_number_is_a_fault_of_the_smallest_problem(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A number of the file that only one of the two reads is found."""
    few_steps(monkeypatch)
    monkeypatch.setattr(checks, "LONGER", 1)
    names = ("kind excess", "cross terms", "half a second")
    drawn = build(names, 1)
    write(drawn, tmp_path, text_of(drawn.tables))
    assert not checks.examine(drawn.tables, tmp_path, 1).faults
    drawn.tables["cost"]["N"][0][0] += 0.2  # the plain simulation reads another weight than the library
    found = checks.examine(drawn.tables, tmp_path, 1)
    assert {one.check for one in found.faults} >= {"simulated: cost"}
    assert shrunk(names, lambda fewer: "cross terms" in fewer) == ("cross terms",)


def test_every_pair_of_features_has_a_number_of_its_own() -> None:
    """So a run that is long enough examines them all, and can be resumed and repeated."""
    listed = pairs(3)
    groups = {one.name: one.group for one in FEATURES}
    assert len(set(map(frozenset, listed))) == len(listed) == len(set(listed))
    assert all(groups[a] != groups[b] for a, b in listed)
    numbers = np.linspace(0, len(listed) - 1, 50).astype(int)
    assert all(set(listed[number]) <= set(features_of(3, int(number))) for number in numbers)
    assert features_of(3, len(listed) + 5) == features_of(3, len(listed) + 5)


def test_the_table_of_pairs_tells_what_became_of_each_and_why() -> None:
    """A pair that was accepted once has no reason any more; the text of a resumed run is the same."""
    tally = Tally()
    refusal = "/somewhere/problem.toml: a pair is given; expected another"
    for number, (names, drawn, refused) in enumerate([
        (("start", "ramp"), True, refusal), (("start", "delay"), True, refusal), (("start", "ramp"), True, None),
        (("ramp", "delay"), False, None),
    ]):  # fmt: skip
        tally.add(Outcome(number, names, drawn, checks.Report(refused)))
    assert tally.fates() == (["ramp + start"], ["delay + start"], ["delay + ramp"])
    lines = tally.table().splitlines()
    assert "       1  delay + start: a pair is given; expected another" in lines
    assert "       1        1        0  ramp + start" in lines
    assert tally.unhashed == [2]
    again = Tally.of(json.loads(json.dumps(tally.document())))
    assert again == tally


@pytest.mark.evidence
def test_what_depends_on_the_order_of_a_hash_is_a_fault(tmp_path: Path) -> None:
    """A problem whose function reads a hash is found among others, and named."""
    right, wrong = tmp_path / "right", tmp_path / "wrong"
    files = []
    for place in (right, wrong):
        place.mkdir()
        drawn = build(("linear function", "kind excess"), 1)
        if place == wrong:
            text = drawn.files["plant.py"]
            drawn.files["plant.py"] = text.replace(
                "    moved = ", "    bent += 1e-9 * (hash('a') % 97) * x[0]\n    moved = "
            )
        files.append(write(drawn, place, text_of(drawn.tables)))
    found = differing(files)
    assert list(found) == [1]
    assert found[1].startswith("depends on the seed of hashes: ")


def test_a_lower_bound_that_is_too_high_is_a_fault(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """It is compared with the cost at other rates too, and repeated before it is one."""
    monkeypatch.setattr(checks, "STEPS", 20_000)
    monkeypatch.setattr(lower, "LONGER", 1)
    drawn = build(("model", "one state", "kind excess"), 1)
    problem = load(write(drawn, tmp_path, text_of(drawn.tables)))
    assert lower.bounded_below(problem, 1, checks.evaluated) is None

    def higher(problem: Problem, seed: int, longer: int = 1, confidence: float | None = None) -> Evaluation:
        found = checks.evaluated(problem, seed, longer, confidence)
        bound = found.lower_bound
        return replace(found, lower_bound=None if bound is None else replace(bound, cost=1.1 * bound.cost))

    text = lower.bounded_below(problem, 1, higher)
    assert text is not None
    assert "no schedule costs less than" in text


@pytest.mark.evidence
def test_a_number_that_only_python_accepts_is_a_fault(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Nodes in C and in Python read mutated packets alike; 1.7e308 is no number of a packet."""
    drawn = build(("linear controller", "sensor decides", "kind excess"), 1)
    problem = load(write(drawn, tmp_path, text_of(drawn.tables)))
    assert mutated.like_python(problem, 3, tmp_path) is None
    monkeypatch.setattr("taciturn.nodes.packet.fits", lambda values: all(map(isfinite, values)))
    monkeypatch.setattr("taciturn.nodes.inbox.fits", lambda values: all(map(isfinite, values)))
    assert mutated.like_python(problem, 3, tmp_path) is not None


def test_what_is_refused_is_refused_by_every_route(tmp_path: Path) -> None:
    """A route that computes with it, or says something else, is a fault."""
    drawn = build(("kind excess",), 1)
    drawn.tables["policy"]["theta"] = -1.0
    write(drawn, tmp_path, text_of(drawn.tables))
    report = checks.examine(drawn.tables, tmp_path, 1)
    assert not report.faults
    assert report.refused is not None
    for answer, check in ((None, "accepted by nodes"), ("another", "nodes of a refused problem: another sentence")):
        with patch.dict(checks.ROUTES, {"nodes": lambda folder, seed, answer=answer: answer}):
            assert [one.check for one in checks.examine(drawn.tables, tmp_path, 1).faults] == [check]


def test_a_loop_that_diverges_is_refused_by_its_study_alone(tmp_path: Path) -> None:
    """For a reason that is stated; without it, each route that computes with the problem is a fault."""
    drawn = build(("kind excess",), 1)
    write(drawn, tmp_path, text_of(drawn.tables))

    def diverges(*_: object) -> None:
        raise ProblemError("the loop of excess diverges: its cost grows; expected a stable loop")

    quick = {name: route for name, route in routes.ROUTES.items() if name != "export --fmu"}
    with patch.object(checks, "evaluated", diverges), patch.dict(checks.ROUTES, quick, clear=True):
        assert not checks.examine(drawn.tables, tmp_path, 1).faults
        with patch.object(routes, "ALONE", ()):
            faults = checks.examine(drawn.tables, tmp_path, 1).faults
    assert {one.check for one in faults} == {f"accepted by {route}" for route in quick if route != "evaluate"}


@pytest.mark.daily
@pytest.mark.evidence
def test_the_problems_of_the_day_are_right() -> None:
    """A hundred problems, as many as the time allows; a fault is printed with its smallest file."""
    seed, tally = run.seed_of(str(RUN.day)), Tally()
    run.search(seed, list(range(100)), tally, SECONDS, 2, None)
    left = 100 - len(tally.done)
    print(f"seed {RUN.day}: {tally.summary()}; {left} of 100 problems left out by the limit of {SECONDS:g} s")
    print("\n".join(tally.checks()))
    shown = [f"== {key} (problem {one['number']})\n{one['text']}\n{one['file']}" for key, one in tally.faults.items()]
    repeat = f"python tests/everything/run.py --seed {RUN.day} --only "
    smallest = min(tally.faults.values(), key=lambda one: len(one["file"]), default={"number": ""})
    assert not tally.faults, "\n".join(shown) + f"\n{repeat}{smallest['number']}"
    assert tally.done, f"no problem ended within {SECONDS:g} s"
