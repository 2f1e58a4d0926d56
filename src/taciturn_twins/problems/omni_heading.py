"""Right-hand side of the plant ``omni-heading``: a robot on omni-directional wheels that drives in body coordinates."""

from __future__ import annotations

from typing import Any

import numpy as np

from taciturn.model.dynamics import integrate

SECONDS = 0.1  # seconds per step


def roll(x: Any, u: Any) -> Any:
    """Return dx/dt of position and heading ψ, for velocities forward and to the left and an angular velocity.

    ẋ = cos ψ · ahead − sin ψ · left,   ẏ = sin ψ · ahead + cos ψ · left,   ψ̇ = turning
    """
    ahead, left, turning = u
    sine, cosine = np.sin(x[2]), np.cos(x[2])
    return np.array([cosine * ahead - sine * left, sine * ahead + cosine * left, turning])


step = integrate(roll, SECONDS)
