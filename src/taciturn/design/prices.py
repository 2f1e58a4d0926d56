"""What inputs and estimation errors cost over the time that a cost looks at: an average, a discount, a horizon."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array
from taciturn.design.certainty import CLOCK
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.riccati import refuse_uncertain, regulate_discounted, regulate_finite
from taciturn.model.trigger import Matrix, Scheduled


@dataclass(frozen=True, eq=False)
class Prices:
    """The optimal gain and what departing from it costs: at each tick of a finite horizon, or always the same.

    Args:
        problem: the problem from tick to tick.
        K: cost-to-go, (n, n), or (N + 1, n, n).
        L: gain, (m, n), or (N, m, n).
        H: price of another input than Lx̂, (m, m), or (N, m, m).
        error: bound on the error of K, (n, n); 0 of a finite horizon, whose recursion is exact to rounding.
    """

    problem: Discrete
    K: Array
    L: Array
    H: Array
    error: Array

    @property
    def P(self) -> Array:
        """Price L'HL of an estimation error, (n, n), or (N, n, n)."""
        return np.swapaxes(self.L, -1, -2) @ self.H @ self.L

    @property
    def average(self) -> bool:
        """Whether the cost is an average, and not the total of a mission."""
        return not self.problem.cost.mission

    @property
    def ticks(self) -> float:
        """Ticks that the cost counts, each with its weight: 1 of an average, N, or 1/(1−α)."""
        cost = self.problem.cost
        if cost.horizon is not None:
            return float(cost.horizon)
        return 1.0 if self.average else 1 / (1 - cost.discount)

    def in_units(self, cost: float) -> float:
        """Return a cost per tick, or a total, with the inter-sample noise cost, in the units of the cost."""
        return self.problem.per_unit(cost) if self.average else cost + self.problem.noise_cost * self.ticks

    def square(self) -> Matrix:
        """Return the weight of the completed square, H, in the units of the cost."""
        return by_clock(self.H / self.problem.tick if self.average else self.H)

    def total(self, covariance: Array, start: int | None) -> float:
        """Return the cost of applying Lx̂ at every tick: per tick, or the total.

        tr(KW) + mean tr(PΣ_k) of an average; E[x_0'K_0x_0] + Σ tr(K_{k+1}W) + Σ tr(P_kΣ_k) of a horizon; discounted
        E[x_0'Kx_0] + α/(1−α) tr(KW) + Σ α^k tr(PΣ_k).

        Args:
            covariance: Σ_k of the estimate, (ticks, n, n).
            start: tick from which it repeats, or None with a horizon.

        Raises:
            UnstableError: rounding makes the cost uncertain.

        Source: khashooei2017
        """
        cost = self._summed(self.K, self.P, covariance, start)
        A, alpha = self.problem.plant.A, self.problem.cost.discount
        refuse_uncertain(
            cost,
            0.0
            if self.problem.cost.horizon is not None
            else self._summed(self.error, self.error + alpha * A.T @ self.error @ A, covariance, start),
        )
        return cost

    def _summed(self, K: Array, P: Array, covariance: Array, start: int | None) -> float:
        plant, alpha = self.problem.plant, self.problem.cost.discount
        errors = (P * covariance).sum(axis=(1, 2))
        if self.average:
            return float(np.sum(K * plant.W) + errors[start:].mean())
        first = K if start is not None else K[0]
        begin = plant.mean @ first @ plant.mean + np.sum(first * plant.covariance)
        if start is None:
            return float(begin + np.sum(K[1:] * plant.W) + errors.sum())
        weights = alpha ** np.arange(len(errors))
        weights[start:] /= 1 - alpha ** (len(errors) - start)  # every later turn of the cycle counts so much less
        return float(begin + alpha / (1 - alpha) * np.sum(K * plant.W) + weights @ errors)


def price_control(problem: Discrete) -> Prices:
    """Return the optimal gain and the prices of a problem.

    Raises:
        UnstableError: no stabilising gain, or a cost that overflows over the horizon.

    Source: khashooei2017
    """
    plant, cost = problem.plant, problem.cost
    data = (plant.A, plant.B, problem.Q, problem.R, problem.N)
    if cost.horizon is None:
        best = regulate_discounted(*data, cost.discount)
        return Prices(problem, best.K, best.L, best.H, best.error)
    assert cost.terminal is not None
    finite = regulate_finite(*data, cost.terminal, cost.horizon)
    return Prices(problem, finite.K, finite.L, finite.H, np.zeros_like(plant.A))


def by_clock(values: Array) -> Matrix:
    """Return one matrix for ever, or one for each tick of the clock."""
    return values if values.ndim == 2 else Scheduled(CLOCK, values)
