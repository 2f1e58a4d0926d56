"""Cost of silence relative to a base that sends at every q-th step, and holds the last value in between.

Let j = 0, …, q − 1 be the phase of the step, w = (z, h), and F_a and F_s the dynamics of a step with and without a
packet. The value of the base is w'P_j w with P_0 = X_a(P_1), P_j = X_s(P_{j+1}), P_q = P_0, X_f(P) = M_f + F_f'PF_f.
In phase j, silence costs w'[X_s(P_{j+1}) − X_a(P_{j+1})]w more than a packet, if the base follows. Silence
while this is at most δ, in each phase, minimises the cost of the step plus δ per packet. So for the rate a per step,

    J + δ a ≤ J_q + δ/q.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, block_diagonal, symmetrised
from taciturn._display import Displayed
from taciturn.design.base import Base, cycle_value, held_steps
from taciturn.errors import UnstableError


@dataclass(frozen=True, eq=False, repr=False)
class PeriodicAdvantage(Displayed):
    """The cost of silence in each phase of a base that sends periodically.

    Args:
        silence: weights of (z, h) in the cost of silence, one for each phase, (q, n + c, n + c).
        cost: average cost of the base per step.
        settling: time constant of the base in steps.
    """

    silence: Array
    cost: float
    settling: float


def periodic_advantage(base: Base, every: int, remedy: str) -> PeriodicAdvantage:
    """Return the cost of silence for a base that sends at every q-th step.

    Raises:
        UnstableError: the base is unstable with these sends.
    """
    c = len(base.K)
    (send, M_send), (silent, M_silent) = held_steps(base)
    value, slowest = cycle_value([(send, M_send), *[(silent, M_silent)] * (every - 1)])
    if slowest >= 1:
        raise UnstableError(
            f"the loop that sends at every {every}th step is not stable; expected a smaller every: {remedy}"
        )
    noise, cost = block_diagonal(base.noise, np.zeros((c, c))), 0.0
    found: list[Array] = []
    for j in reversed(range(every)):
        cost += float(np.sum(value * noise)) / every
        with_packet, without = (
            symmetrised(stage + step.T @ value @ step) for step, stage in ((send, M_send), (silent, M_silent))
        )
        found.insert(0, without - with_packet)
        value = with_packet if j == 0 else without
    return PeriodicAdvantage(np.array(found), cost, every / (1 - slowest))
