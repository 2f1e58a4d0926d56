"""Step function of ``omni-heading``: a robot on omnidirectional wheels with velocities relative to its heading."""

from __future__ import annotations

from typing import Any

import numpy as np

from taciturn.model.dynamics import integrate

SECONDS = 0.1  # seconds per step


def roll(x: Any, u: Any) -> Any:
    """Return dx/dt of position and heading ψ for given velocities ahead and to the left and a given angular velocity.

    ẋ = cos ψ · ahead − sin ψ · left,   ẏ = sin ψ · ahead + cos ψ · left,   ψ̇ = turning
    """
    ahead, left, turning = u
    sine, cosine = np.sin(x[2]), np.cos(x[2])
    return np.array([cosine * ahead - sine * left, sine * ahead + cosine * left, turning])


step = integrate(roll, SECONDS)
