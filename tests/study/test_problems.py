"""Studies are given problems, and say so where they are given something else."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import taciturn
from taciturn.study.describe import describe
from taciturn_studies.tune import tune_period
from taciturn_udp.relay import Fate

NAME: Any = "two-mass-lqg"


@pytest.mark.parametrize(
    "study",
    [
        taciturn.evaluate,
        taciturn.certify,
        describe,
        lambda name: taciturn.tune(name, rate=0.3),
        lambda name: tune_period(name, rate=0.3, least=0.1),
        lambda name: taciturn.tradeoff(name, {"theta": [0.1, 1.0]}),
        lambda name: taciturn.sweep(name, {"theta": [0.1, 1.0]}),
        lambda name: taciturn.export_c(name, "c"),
        lambda name: taciturn.export_fmu(name, "a.fmu"),
        lambda name: taciturn.compare({"a": name, "b": name}, 0.3),
        lambda name: taciturn.share_channel({"a": name}, copies=2, capacity=1),
    ],
)
def test_a_name_is_no_problem(study: Callable[[Any], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is read by ``load`` first."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        taciturn.ProblemError, match=r"is 'two-mass-lqg'; expected a Problem \(taciturn\.load reads one"
    ):
        study(NAME)


@pytest.mark.parametrize(
    "study",
    [
        lambda problems: taciturn.compare(problems, 0.3),
        lambda problems: taciturn.share_channel(problems, copies=2, capacity=1),
    ],
)
def test_problems_have_names(study: Callable[[Any], object]) -> None:
    """Where several are given, each has one."""
    with pytest.raises(taciturn.ProblemError, match=r"problems is .*; expected a Mapping"):
        study([taciturn.load(NAME)])


def test_files_are_read_by_their_name() -> None:
    """What is no problem and no name of one is refused by name, and a problem is not still to be read."""
    given: Any = taciturn.load(NAME)
    with pytest.raises(taciturn.ProblemError, match=r"^file is 5; expected a Problem"):
        taciturn.run_network(5)  # type: ignore[arg-type]
    with pytest.raises(taciturn.ProblemError, match=r"^path is Problem.*; expected a str or a Path"):
        taciturn.load(given)


@pytest.mark.parametrize(
    ("fates", "told"),
    [
        ({"motor": Fate()}, "fates names the link 'motor'; expected links of the policy lqg: actuator"),
        ({"sensor": Fate(loss=0.2)}, "fates names the link 'sensor'; expected links of the policy lqg: actuator"),
        ({"actuator": 0.2}, r"fates\['actuator'\] is 0.2; expected a Fate"),
        ([Fate()], "fates is .*; expected a Mapping"),
    ],
)
def test_fates_are_those_of_the_links(fates: Any, told: str) -> None:
    """A link that the policy does not have, and a number in place of a fate."""
    with pytest.raises(taciturn.ProblemError, match=told):
        taciturn.run_network(NAME, steps=5, fates=fates)
