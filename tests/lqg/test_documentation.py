"""The examples in the docstrings of this floor."""

from __future__ import annotations

import doctest
import importlib

import pytest


@pytest.mark.parametrize("name", ["modes", "riccati", "kalman", "sampling", "periodic"])
def test_every_documented_example_holds(name: str) -> None:
    """The examples run and print what the docstrings say."""
    result = doctest.testmod(importlib.import_module(f"taciturn.lqg.{name}"))
    assert result.attempted > 0
    assert result.failed == 0
