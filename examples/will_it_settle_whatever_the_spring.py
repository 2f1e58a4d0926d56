"""Does a cart on a spring settle, whatever the spring? A trigger for one spring, certified for softer and stiffer ones.

The theorem of the design holds only for the plant of the design. Matrix inequalities certify decay and cost of the
closed loop with each spring. If they certify nothing, the example prints that there is no certificate.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import taciturn

# a cart of 1 kg on a spring of 4 N/m and a damper, pushed by a force; position and velocity checked 10 times a second
COST = taciturn.Cost(Q=[[1.0, 0.0], [0.0, 0.1]], R=[[0.1]])
NOISE = [[0.0, 0.0], [0.0, 0.02]]


def cart(spring: float) -> taciturn.ContinuousPlant:
    """Return the cart on a spring."""
    return taciturn.ContinuousPlant(A=[[0.0, 1.0], [-spring, -0.2]], B=[[0.0], [1.0]], W=NOISE)


problem = taciturn.Problem(cart(4.0), COST, taciturn.Network(), "relative", {"sigma": 0.15, "period": 0.1})
limits: list[float | None] = []
for spring in (8.0, 4.0, 1.0, -1.0, -16.0):  # a negative spring pushes the cart away
    changed = replace(problem, actual=cart(spring))
    try:
        found = taciturn.certify(changed)
    except taciturn.ProblemError:
        print(f"{spring:g} N/m: no certificate")
        continue
    limits.append(found.limit)
    assert found.decay is not None
    halves = 0.1 * np.log(0.5) / np.log(found.decay)
    print(f"{spring:g} N/m: halves every {halves:.2f} s, gain {found.gain:.3f}, costs at most {found.cost_bound:.4f}")

assert limits == [0.0] * len(limits)  # without noise, every certified loop converges to zero
