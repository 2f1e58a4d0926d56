"""How much of a list of cases the quick suite runs; the rest is evidence."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import pytest


def few(values: Iterable[Any], quick: int = 2, start: int = 0) -> list[Any]:
    """Return all values as parameters, of which ``quick``, spread evenly from ``start`` on, run in the quick suite."""
    cases: Sequence[Any] = list(values)
    chosen = {(start + i * len(cases) // max(quick, 1)) % len(cases) for i in range(quick)} if cases else set()
    return [case if i in chosen else pytest.param(case, marks=pytest.mark.evidence) for i, case in enumerate(cases)]
