"""Results that are written as text are restored as they were."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import pytest
from counts import few

import taciturn
from taciturn import Estimate
from taciturn.model.result import Field, Result, Tabular
from taciturn.simulation.trajectory import course
from taciturn.study.record import decode, encode

CHANGES: dict[str, Mapping[str, object]] = {
    "limited inputs": {"plant.input_limit": [0.5]},
    "limits of states": {"limits.high": [0.3]},
    "a default disturbance": {"controller.disturbance": None},
}


@pytest.mark.parametrize("name", few(CHANGES, 2, start=2))
def test_an_evaluation_is_restored_with_all_its_parts(name: str) -> None:
    """Each part of an answer is a class that the reader of records knows."""
    found = taciturn.evaluate(taciturn.load("pid-tank").changed(CHANGES[name]), steps=20_000)
    again = decode(encode(found))
    assert again == found
    parts = {type(value).__name__ for value in vars(found).values() if dataclasses.is_dataclass(value)}
    assert parts == {type(value).__name__ for value in vars(again).values() if dataclasses.is_dataclass(value)}
    if name == "limited inputs":
        assert "WithoutLimits" in parts


@dataclasses.dataclass(frozen=True, repr=False)
class Pace(Result):
    """A part of a result."""

    rate: Estimate


@dataclasses.dataclass(frozen=True, repr=False)
class Trial(Tabular):
    """A result with a bound, a part and rows, each number of which is in one list."""

    FIELDS: ClassVar[tuple[Field[Any], ...]] = (
        Field("bound", say="guarantee", up=1),
        Field("pace", say="rate", text="{of.pace.rate} per {of.unit}", after=""),
        Field("none", "nothing.more", optional=True),
        Field("paces", lambda found: found.row_documents()),
    )

    bound: float
    pace: Pace
    paces: tuple[Pace, ...]
    unit: str = "step"
    nothing: Pace | None = None

    def table_rows(self) -> tuple[Pace, ...]:
        """Return the parts."""
        return self.paces

    def row_fields(self) -> tuple[Field[Any], ...]:
        """Return the rate."""
        return (Field("rate", column="rate", say="sends"),)


def test_a_number_that_is_listed_once_is_in_document_table_text_and_record() -> None:
    """No class of results is known to the code that writes and reads them."""
    pace = Pace(Estimate(0.25, 0.01, "simulation"))
    found = Trial(1.23456789, pace, (pace, pace))
    rate = {"value": 0.25, "standard_error": 0.01}
    assert found.document() == {"bound": 1.23456789, "pace": {"rate": rate}, "paces": [{"rate": rate}] * 2}
    assert found.records() == [{"rate": pace.rate}] * 2
    lines = [line.split() for line in str(found).splitlines()]
    assert lines[-2:] == [["rate", "0.250", "±", "0.010", "per", "step"], ["guarantee", "1.23457"]]
    assert lines[0] == ["sends"]
    assert decode(encode(found)) == found


@pytest.mark.evidence
def test_results_other_than_evaluations_are_restored() -> None:
    """A course with its arrays, and certificates; a tuned problem has functions, which its file states."""
    problem = taciturn.load("two-mass-lqg")
    for found in (course(problem.close(problem.design()), 20, paths=4), taciturn.certify(problem)):
        again = decode(encode(found))
        assert again.document() == found.document()
        assert str(again) == str(found)
    with pytest.raises(ValueError, match=r"^Problem is not a class of result data$"):
        decode(encode(taciturn.tune(problem, rate=0.3, standard_error=1e-2)))
