"""What tests of processes in continuous time share, of which computations see looks that come ever faster."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import scipy.integrate


def assert_tends_to(published: float, found: list[float]) -> None:
    """Compare a limit by thresholds of twice as many looks' noise each, whose error falls with the square.

    It may be as far off as the last doubling moved it.
    """
    first, second = ((4 * fine - coarse) / 3 for coarse, fine in pairwise(found))
    assert second == pytest.approx(published, abs=abs(second - first))
    assert abs(second - first) < 1e-3 * published


def waiting(a: float, level: float) -> float:
    """Return the mean time in which dx = ax dt + dv comes from 0 to ±level: T'' + 2axT' = −2, T(±level) = 0."""

    def slope(x: float) -> float:
        return float(scipy.integrate.quad(lambda r: np.exp(a * (r * r - x * x)), 0, x)[0])

    return 2 * float(scipy.integrate.quad(slope, 0, level)[0])
