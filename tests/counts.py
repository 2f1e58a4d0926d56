"""How much a run runs: a few cases, a share of the remaining ones, or the full counts.

The quick suite runs a few cases of each list. ``-m evidence`` runs the others with their full counts. With
``--shortened``, as ``.ci/run`` uses it, the others run with reduced counts, and those that the change does not reach
take turns by the day (``selection``).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import date
from typing import Any, TypeVar

import pytest

T = TypeVar("T")


@dataclass
class Run:
    """What the options of a run ask for; ``conftest`` sets it before tests are collected."""

    day: date
    shortened: bool = False


RUN = Run(date(2026, 1, 1))


def scaled(full: T, shortened: T) -> T:
    """Return how much a test runs (steps, systems, cases): the full count, or that of a shortened run."""
    return shortened if RUN.shortened else full


def few(values: Iterable[Any], quick: int = 2, start: int = 0) -> list[Any]:
    """Return all values as parameters, of which ``quick``, spread evenly from ``start`` on, run in the quick suite."""
    cases: Sequence[Any] = list(values)
    chosen = {(start + i * len(cases) // max(quick, 1)) % len(cases) for i in range(quick)} if cases else set()
    return [case if i in chosen else pytest.param(case, marks=pytest.mark.evidence) for i, case in enumerate(cases)]
