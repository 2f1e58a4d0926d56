"""Closed form of many steps of the Kalman filter's Riccati recursion, relative to the steady covariance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array, is_definite, symmetrised
from taciturn._modes import summed
from taciturn.errors import UnstableError
from taciturn.lqg.kalman import steady_filter
from taciturn.model.plant import Plant

ROUNDING = 1e-17  # relative size of a term below which it does not change a sum
FORGOTTEN = 1e-12  # remaining fraction of an error that is negligible, as its square is below rounding
MOST, NUMBERS = 100_000, 20_000_000  # most steps, and most entries of all their matrices
DENSE, NODES = 64, 24  # most steps of a block that are all summed, and steps of a longer block
EXACT = 1e-13  # relative error of a block
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

    def thinned(self, P: Array, discount: float, covariances: Array) -> tuple[Array, Array]:
        """Return weights and O_s of fewer steps, with which a sum over all steps is accurate.

        Over a block of many steps, the terms of a slow filter are smooth. So the sum over a block is that over a few of
        its steps, with the weights for which sums of polynomials are exact. It replaces the block if it agrees with the
        sum over all steps of the block, for terms with each of the ``covariances``; otherwise the block is halved.

        Args:
            P: weight, (n, n).
            discount: α.
            covariances: some that are to be expected, (any, n, n).
        """
        weighed = self.weighed(P, discount)
        steps, unit = len(weighed), np.diag(self.unit)
        terms = np.zeros((len(covariances), steps))
        if steps > DENSE:
            for found, covariance in zip(terms, covariances, strict=True):
                left = self.faded(covariance, unit, self.observed)
                found[:] = (weighed @ left * left).sum(axis=(1, 2))
        least = EXACT * np.abs(terms).sum(axis=1)
        kept, factors = list[npt.NDArray[np.int64]](), list[Array]()
        open_blocks = [(0, steps - 1)]  # the last one is the sum over all later steps
        while open_blocks:
            begin, end = open_blocks.pop()
            places, shares = np.arange(begin, end, dtype=np.int64), np.ones(end - begin)
            if end - begin > DENSE:
                some, weights = _few_places(end - begin)
                off = np.abs(terms[:, begin + some] @ weights - terms[:, begin:end].sum(axis=1))
                if not (off <= least).all():
                    middle = begin + (end - begin) // 2 if begin else max(DENSE, end // 2)
                    open_blocks += [(begin, middle), (middle, end)]
                    continue
                places, shares = begin + some, weights
            kept.append(places)
            factors.append(shares)
        places = np.append(np.concatenate(kept), steps - 1)
        shares = np.append(np.concatenate(factors), 1.0)
        return weighed[places] * shares[:, None, None], self.observed[places]

    def faded(self, covariance: Array, parts: Array, observed: Array) -> Array:
        """Return (I + (X − Σ̄)O_s)^{-1}·parts of the closed form for a covariance X and the O_s of some steps."""
        off = np.eye(len(self.unit)) + (covariance - self.steady) @ observed
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
    relative, most = unit[:, None] * unit, horizon or min(MOST, NUMBERS // len(F) ** 2)
    powers, observed = np.eye(len(F))[None], np.stack([np.zeros_like(F), symmetrised(seen)])
    while True:  # F̄^s and O_{s+1} of twice as many steps, by F̄^{r+s} = F̄^s F̄^r and O_{r+s} = O_r + F̄'^r O_s F̄^r
        steps = np.arange(len(powers))
        left = np.power(discount, steps / 2) * np.abs(powers @ F / unit[:, None] * unit).max(axis=(1, 2))
        added = np.abs(powers.swapaxes(1, 2) @ seen @ powers * relative).max(axis=(1, 2))
        enough = left <= FORGOTTEN
        if horizon is None:
            enough |= added <= ROUNDING * np.abs(observed[1:] * relative).max(axis=(1, 2))
        if enough.any() or len(powers) == most:
            break
        further = powers[-1] @ F
        more = min(len(powers), most - len(powers))
        powers = np.concatenate([powers, powers[:more] @ further])
        following = observed[-1] + symmetrised(further.T @ observed[1 : more + 1] @ further)
        observed = np.concatenate([observed, following])
    if horizon is None and not enough.any():
        return None
    last = int(np.argmax(enough)) + 1 if enough.any() else len(powers)
    return Flow(steady.prior, unit, F, powers[:last], observed[: last + 1])


@cache
def _few_places(steps: int) -> tuple[npt.NDArray[np.int64], Array]:
    """Return some of the steps of a block, near those of Gauss and Legendre, whose sums of polynomials are exact."""
    legendre = np.polynomial.legendre
    nodes = np.asarray(legendre.leggauss(NODES)[0], dtype=np.float64)
    places = np.unique(np.rint((nodes + 1) / 2 * (steps - 1)).astype(np.int64))
    values = np.asarray(legendre.legvander(np.linspace(-1, 1, steps), len(places) - 1), dtype=np.float64)
    return places, np.asarray(np.linalg.solve(values[places].T, values.sum(axis=0)), dtype=np.float64)
