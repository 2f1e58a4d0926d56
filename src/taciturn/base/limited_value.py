"""The cost of silence if inputs have limits: both choices, followed for some steps on the mean path.

An input c + d in place of the choice c = K z of the base costs f(z, d) = d'Hd + 2d'(slope)z more, now and later
(``value``). With limits, a packet carries sat(c), and the limits cut later commands too. If every later sample is sent,
then on the mean path silence costs

    Σ_k f(z_k, d_k) − Σ_k f(z'_k, d'_k),    z_{k+1} = F z_k + Γ d_k,    d_k = sat(K z_k) − K z_k for k ≥ 1,

with F = Φ + ΓK. The first sum starts with the input û of silence, d_0 = û − K z_0, and the second with that of a
packet, d'_0 = sat(K z_0) − K z_0. The sums contain the present and the next ``AHEAD`` − 1 steps; limits that bind later
do not count. Without limits, the difference is f(z_0, d_0). If a packet changes no input, it is exactly 0. It compares
two choices by one deterministic forecast, so it is an estimate, and no bound follows.

The sums need no states: K z_k and (slope) z_k are responses to z_0 and to the d_j of the steps before.

Source: antunes2014rollout
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn.base.filter import HELD
from taciturn.model.saturation import Saturation
from taciturn.model.steps import Apply

AHEAD = 10  # steps that are followed; docs/constraints.md compares 1, 3, 10 and 30
COST = "cost of silence"


@dataclass(frozen=True, eq=False, repr=False)
class LimitedSilence(Displayed):
    """Computes the cost of silence from the state of the base, and the inputs without and with a packet."""

    free: Array  # the response of K z_k, and of 2(slope) z_k below it, to z_0, (steps, m or 2m, n)
    caused: Array  # to an input d_0 that differs from the choice, k + 1 steps later, (steps − 1, m or 2m, m)
    H: Array  # weight of d, (m, m)
    limits: Saturation

    @staticmethod
    def of(F: Array, Gamma: Array, K: Array, H: Array, slope: Array, limits: Saturation) -> LimitedSilence:
        """Follow the base with the dynamics z⁺ = F z + Γ d."""
        free = [np.vstack([K, 2 * slope]) if slope.any() else K]  # the slope of LQG is 0
        for _ in range(1, AHEAD):
            free.append(free[-1] @ F)
        return LimitedSilence(np.array(free), np.array([one @ Gamma for one in free[:-1]]), H, limits)

    def step(self, at: str, state: Sequence[str], silent: str, sent: str) -> Apply:
        """Return the policy step by which a node computes the cost from these signals."""
        return Apply(at, {COST: 1}, self, (*state, silent, sent, *((HELD,) if self.limits.moves else ())))

    def __call__(self, *known: Any) -> Any:
        """Return the cost of silence."""
        *state, silent, sent = known[:-1] if self.limits.moves else known
        before = known[-1] if self.limits.moves else None
        z = np.concatenate(state)
        free = [matrix @ z for matrix in self.free]
        return np.stack([self._cost(free, silent, before) - self._cost(free, sent, before)])

    def _cost(self, free: Sequence[Any], wanted: Any, before: Any) -> Any:
        """Return Σ_k f(z_k, d_k) if an actuator has the command ``wanted`` now, and then each command of the base."""
        m, total, apart = len(self.H), 0.0, list[Any]()
        for k, response in enumerate(free):
            for j, one in enumerate(apart):
                response = response + self.caused[k - 1 - j] @ one
            u = self.limits(wanted if k == 0 else response[:m], before)
            d, before = u - response[:m], u
            weighed = self.H @ d
            total = total + sum(d[i] * (weighed[i] + response[m + i] if len(response) > m else weighed[i])
                                for i in range(m))  # fmt: skip
            apart.append(d)
        return total
