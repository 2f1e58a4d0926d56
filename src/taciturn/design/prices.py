"""Cost weights of input errors and estimation errors, for average, discounted and finite-horizon costs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn.design.estimation import by_clock
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.riccati import refuse_uncertain, regulate_finite
from taciturn.model.trigger import Matrix


@dataclass(frozen=True, eq=False, repr=False)
class Prices(Displayed):
    """Optimal gains, costs-to-go and weights of input errors: constant, or for each step of a finite horizon.

    Args:
        problem: the discrete-time problem.
        K: matrix of the cost-to-go, (n, n), or (N + 1, n, n).
        L: feedback gain, (m, n), or (N, m, n).
        H: weight of the difference of the input from Lx̂, (m, m), or (N, m, m).
        error: bound on the error of K, (n, n); 0 for a finite horizon, whose recursion is exact up to rounding.
    """

    problem: Discrete
    K: Array
    L: Array
    H: Array
    error: Array

    @property
    def P(self) -> Array:
        """Weight L'HL of the estimation error in the cost, (n, n), or for each step, (N, n, n)."""
        return np.swapaxes(self.L, -1, -2) @ self.H @ self.L

    @property
    def average(self) -> bool:
        """Whether the cost is a long-run average, and not a finite-horizon or discounted total."""
        return not self.problem.cost.mission

    def square(self) -> Matrix:
        """Return the weight H of the completed square in the user's units of the cost."""
        return by_clock(self.H / self.problem.unit)

    def total(self, covariance: Array, start: int | None) -> float:
        """Return the cost of applying the input Lx̂ at every step: per step for an average cost, otherwise in total.

        The cost is tr(KW) + mean tr(PΣ_k) for an average, E[x_0'K_0x_0] + Σ tr(K_{k+1}W) + Σ tr(P_kΣ_k) for a horizon,
        and E[x_0'Kx_0] + α/(1−α) tr(KW) + Σ α^k tr(PΣ_k) for a discounted sum.

        Args:
            covariance: error covariances Σ_k of the estimate, (steps, n, n).
            start: step from which the covariances repeat, or None with a horizon.

        Raises:
            UnstableError: if rounding makes the cost uncertain.

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
        weights[start:] /= 1 - alpha ** (len(errors) - start)  # geometric sum over the discounted repetitions
        return float(begin + alpha / (1 - alpha) * np.sum(K * plant.W) + weights @ errors)


def price_control(problem: Discrete) -> Prices:
    """Return the optimal gains and the weights of input and estimation errors for a discrete-time control problem.

    Raises:
        UnstableError: if no stabilising gain exists, or the cost overflows over the horizon.

    Source: khashooei2017
    """
    plant, cost = problem.plant, problem.cost
    if cost.horizon is None:
        best = problem.regulator()
        return Prices(problem, best.K, best.L, best.H, best.error)
    assert problem.terminal is not None
    finite = regulate_finite(*problem.quadratic, problem.terminal, cost.horizon)
    return Prices(problem, finite.K, finite.L, finite.H, np.zeros_like(plant.A))
