"""Riccati's map of many ticks in closed form: how a difference of two covariances fades under measurements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, is_definite, symmetrised
from taciturn._modes import summed
from taciturn.errors import UnstableError
from taciturn.lqg.kalman import steady_filter
from taciturn.model.plant import Plant

ROUNDING = 1e-17  # share of a sum below which a term is lost in it
FORGOTTEN = 1e-12  # of an error, after which what is left of it counts no more: its square is below rounding
MOST, NUMBERS = 100_000, 20_000_000  # ticks, and what their matrices hold together
CONDITION = 1e6  # of the matrix that is inverted: then the result has nine digits


@dataclass(frozen=True, eq=False)
class Flow:
    """The map of s ticks about the steady covariance Σ̄, s = 0, 1, ….

    With F̄ = A − ḠC, O_s = Σ_{j<s} F̄'^j C'(CΣ̄C' + V)^{-1}C F̄^j, and X, Y any two covariances,

        Ric^s(X) − Ric^s(Y) = F̄^s (I + (X − Σ̄)O_s)^{-1} (X − Y) (I + O_s(Y − Σ̄))^{-1} F̄'^s.

    Args:
        steady: Σ̄, (n, n).
        unit: of each state, its spread, (n,).
        step: F̄, (n, n).
        powers: F̄^s, (ticks, n, n).
        observed: O_s, (ticks + 1, n, n); the last one stands for all later ones too, unless the ticks end.

    Source: anderson1990optimal
    """

    steady: Array
    unit: Array
    step: Array
    powers: Array
    observed: Array

    def attracts(self, covariances: Array) -> bool:
        """Say whether covariances (…, n, n) come near the steady one: then the closed form has its digits."""
        off = (covariances - self.steady) @ self.observed[-1]
        return bool((np.linalg.cond(np.eye(len(self.unit)) + off / self.unit[:, None] * self.unit) < CONDITION).all())

    def weighed(self, P: Array, discount: float) -> Array:
        """Return α^{s+1} F̄'^s P F̄^s for every s, and what all later ones sum to, (ticks + 1, n, n).

        Args:
            P: (n, n), or one for each tick to come, (ticks to come, n, n); then nothing follows the last.
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
        """Return (I + (X − Σ̄)O_s)^{-1} parts for some s, (ticks, n, columns)."""
        off = np.eye(len(self.unit)) + (covariance - self.steady) @ self.observed[ticks]
        return np.asarray(np.linalg.solve(off, np.broadcast_to(parts, (len(off), *parts.shape))), dtype=np.float64)


def flow(plant: Plant, discount: float, horizon: int | None) -> Flow | None:
    """Return the map of as many ticks as matter.

    Args:
        plant: A, C, W and V.
        discount: α of a later tick.
        horizon: after which no tick matters, or None.

    Returns:
        The map, or None where V is singular, no steady filter exists, or its errors fade too slowly.

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
