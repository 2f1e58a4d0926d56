"""Closed form of many steps of the Kalman filter's Riccati recursion, relative to the steady covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, is_definite, symmetrised
from taciturn._modes import summed
from taciturn.errors import UnstableError
from taciturn.lqg.kalman import steady_filter
from taciturn.model.plant import Plant

ROUNDING = 1e-17  # relative size of a term below which it does not change a sum
FORGOTTEN = 1e-12  # remaining fraction of an error that is negligible, as its square is below rounding
MOST, NUMBERS = 100_000, 20_000_000  # most steps, and most entries of all their matrices
CONDITION = 1e6  # largest condition number of the inverted matrix, for nine accurate digits


@dataclass(frozen=True, eq=False)
class Flow:
    """Filter Riccati recursion Ric^s over s = 0, 1, … steps in closed form, relative to the steady covariance Σ̄.

    With F̄ = A − ḠC and O_s = Σ_{j<s} F̄'^j C'(CΣ̄C' + V)^{-1}C F̄^j, any two covariances X and Y satisfy

        Ric^s(X) − Ric^s(Y) = F̄^s (I + (X − Σ̄)O_s)^{-1} (X − Y) (I + O_s(Y − Σ̄))^{-1} F̄'^s.

    Args:
        steady: Σ̄, the steady covariance, (n, n).
        unit: standard deviation of each state, (n,).
        step: F̄, (n, n).
        powers: F̄^s, (steps, n, n).
        observed: O_s, (steps + 1, n, n); without a horizon, the last one is valid for all later steps.

    Source: anderson1990optimal
    """

    steady: Array
    unit: Array
    step: Array
    powers: Array
    observed: Array

    def attracts(self, covariances: Array) -> bool:
        """Return whether given covariances converge to the steady covariance, so that the closed form is accurate."""
        off = (covariances - self.steady) @ self.observed[-1]
        return bool((np.linalg.cond(np.eye(len(self.unit)) + off / self.unit[:, None] * self.unit) < CONDITION).all())

    def weighed(self, P: Array, discount: float) -> Array:
        """Return the discounted weights α^{s+1} F̄'^s P F̄^s for every step s, and then their sum over all later steps.

        Args:
            P: weight, (n, n), or one for each remaining step, (remaining steps, n, n); then there is no sum at the end.
            discount: α.
        """
        powers = self.powers if P.ndim == 2 else self.powers[: len(P)]
        factors: Array = np.power(discount, np.arange(1.0, len(powers) + 2))[:, None, None]
        each: Array = factors[:-1] * (powers.swapaxes(-1, -2) @ (P if P.ndim == 2 else P[: len(powers)]) @ powers)
        if P.ndim == 3:
            return each
        last = powers[-1] @ self.step
        rest = summed(np.sqrt(discount) * self.step.T, symmetrised(last.T @ P @ last))
        return np.concatenate([each, factors[-1:] * rest])

    def faded(self, covariance: Array, parts: Array, ticks: slice) -> Array:
        """Return (I + (X − Σ̄)O_s)^{-1}·parts of the closed form for a covariance X and a range of steps s."""
        off = np.eye(len(self.unit)) + (covariance - self.steady) @ self.observed[ticks]
        return np.asarray(np.linalg.solve(off, np.broadcast_to(parts, (len(off), *parts.shape))), dtype=np.float64)


def riccati_flow(plant: Plant, discount: float, horizon: int | None) -> Flow | None:
    """Return the closed form of the filter Riccati recursion, up to the step after which its terms are negligible.

    Args:
        plant: plant with A, C, W and V.
        discount: α, weight of each further step.
        horizon: last step, or None.

    Returns:
        The map, or None if V is singular, no steady filter exists, or its errors decay too slowly.

    Source: anderson1990optimal
    """
    if not is_definite(plant.V):
        return None
    try:
        steady = steady_filter(plant.A, plant.C, plant.W, plant.V)
    except UnstableError:
        return None
    F = plant.A - plant.A @ steady.gain @ plant.C
    seen = symmetrised(plant.C.T @ np.linalg.solve(steady.innovation, plant.C))
    unit = np.sqrt(np.where(np.diag(steady.prior) > 0, np.diag(steady.prior), 1.0))
    relative, power = unit[:, None] * unit, np.eye(len(F))
    powers, observed = list[Array](), [np.zeros_like(F)]
    for s in range(horizon or min(MOST, NUMBERS // len(F) ** 2)):
        powers.append(power)
        added = symmetrised(power.T @ seen @ power)
        observed.append(observed[-1] + added)
        power = power @ F
        left = discount ** (s / 2) * np.abs(power / unit[:, None] * unit).max()
        constant = np.abs(added * relative).max() <= ROUNDING * np.abs(observed[-1] * relative).max()
        if left <= FORGOTTEN or (constant and horizon is None):
            break
    else:
        if horizon is None:
            return None
    return Flow(steady.prior, unit, F, np.array(powers), np.array(observed))
