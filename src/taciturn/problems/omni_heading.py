"""A robot on omni-directional wheels, whose velocities are along and across its heading: for ``omni-heading``."""

from __future__ import annotations

from typing import Any

import numpy as np

from taciturn.model.dynamics import integrate

SECONDS = 0.1  # of a tick


def roll(x: Any, u: Any) -> Any:
    """Return dx/dt of position and heading ψ, given the velocities ahead, to the left, and of turning.

    ẋ = cos ψ · ahead − sin ψ · left,   ẏ = sin ψ · ahead + cos ψ · left,   ψ̇ = turning
    """
    ahead, left, turning = u
    sine, cosine = np.sin(x[2]), np.cos(x[2])
    return np.array([cosine * ahead - sine * left, sine * ahead + cosine * left, turning])


step = integrate(roll, SECONDS)
