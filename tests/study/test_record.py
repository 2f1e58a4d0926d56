"""Results that are written as text are restored as they were."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import pytest

import taciturn
from taciturn.study.record import decode, encode

CHANGES: dict[str, Mapping[str, object]] = {
    "limited inputs": {"plant.input_limit": [0.5]},
    "limits of states": {"limits.high": [0.3]},
    "a default disturbance": {"controller.disturbance": None},
}


@pytest.mark.parametrize("name", CHANGES)
def test_an_evaluation_is_restored_with_all_its_parts(name: str) -> None:
    """Each part of an answer is a class that the reader of records knows."""
    found = taciturn.evaluate(taciturn.load("pid-tank").changed(CHANGES[name]), steps=20_000)
    again = decode(encode(found))
    assert again == found
    parts = {type(value).__name__ for value in vars(found).values() if dataclasses.is_dataclass(value)}
    assert parts == {type(value).__name__ for value in vars(again).values() if dataclasses.is_dataclass(value)}
    if name == "limited inputs":
        assert "WithoutLimits" in parts
