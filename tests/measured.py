"""Averages of the laws: a claim that fails on the systems of a day is measured again, with 16 times the steps.

A law compares simulated averages with what is proved, within some standard errors. Over enough days, an average of a
right program is further off by chance. Within ``longer``, the same functions take another seed and 16 times the steps:
a bias of b standard errors becomes one of 4b, while chance exceeds 4.5 standard errors twice in 1e11 cases.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np

from taciturn import Loop
from taciturn.simulation import average as simulated
from taciturn.simulation.sampling import Averages, Estimator

TIMES = 16
SHIFT = 7_654_321  # of the seed
_longer: ContextVar[bool] = ContextVar("longer", default=False)


@contextmanager
def longer() -> Iterator[None]:
    """Take other draws and 16 times the steps."""
    token = _longer.set(True)
    try:
        yield
    finally:
        _longer.reset(token)


def times() -> int:
    """Return by how much a simulation of a test's own is longer: 1, or within ``longer`` 16."""
    return TIMES if _longer.get() else 1


def average(loop: Loop, estimator: Estimator | None = None, *, seed: int = 0, **options: Any) -> Averages:
    """Return ``taciturn.average``; within ``longer`` that of other draws over 16 times the steps."""
    if _longer.get():
        seed += SHIFT
        if "steps" in options:
            options["steps"] *= TIMES
    return simulated.average(loop, estimator, seed=seed, **options)


def agree_together(differences: Sequence[float]) -> bool:
    """Tell whether differences over their standard errors, one of each system, have mean 0 and variance 1.

    A bias of a tenth of a standard error, which no system shows, is one standard error of the mean of 100 systems: many
    short runs together see as much as one long run.
    """
    z, count = np.array(differences), len(differences)
    return bool(abs(z.sum()) < 5 * np.sqrt(count) and (z**2).sum() - count < 6 * np.sqrt(2 * count))
