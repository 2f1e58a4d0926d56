"""Will it settle, whatever the spring? A trigger designed for one spring, proved for softer and stiffer ones.

The theorem of the design holds for the plant of the design alone. Matrix inequalities prove decay and cost of the loop
that is really closed; where they prove nothing, it says so.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import taciturn

# a cart of 1 kg on a spring of 4 N/m and a damper, pushed by a force; ten looks per second at position and velocity
COST = taciturn.Cost(Q=[[1.0, 0.0], [0.0, 0.1]], R=[[0.1]])
NOISE = [[0.0, 0.0], [0.0, 0.02]]


def cart(spring: float) -> taciturn.ContinuousPlant:
    """Return the cart on a spring."""
    return taciturn.ContinuousPlant(A=[[0.0, 1.0], [-spring, -0.2]], B=[[0.0], [1.0]], W=NOISE)


problem = taciturn.Problem(cart(4.0), COST, taciturn.Network(), "relative", {"sigma": 0.15, "period": 0.1})
limits: list[float | None] = []
for spring in (8.0, 4.0, 1.0, -1.0, -16.0):  # below zero it pushes away
    changed = replace(problem, actual=cart(spring))
    try:
        found = taciturn.certify(changed)
    except taciturn.ProblemError:
        print(f"{spring:g} N/m: nothing is proved")
        continue
    limits.append(found.limit)
    assert found.decay is not None
    halves = 0.1 * np.log(0.5) / np.log(found.decay)
    print(f"{spring:g} N/m: halves every {halves:.2f} s, gain {found.gain:.3f}, costs at most {found.cost_bound:.4f}")

assert limits == [0.0] * len(limits)  # without noise it comes to rest, wherever anything is proved
