"""LQG gains and costs-to-go for a finite horizon, for a discounted cost, or for links that drop packets.

**Totals.** For a finite horizon of N steps or a cost with the discount α, gain L, cost-to-go K and the weight
H = R + αB'KB of an input error depend on the step, or not (``price_control``). With the covariances Σ_k of the
estimation error and P = L'HL, applying L x̂ in every step costs

    average:    tr(KW) + mean of tr(PΣ_k)
    horizon:    E[x_0'K_0x_0] + Σ tr(K_{k+1}W) + Σ tr(P_kΣ_k)
    discount:   E[x_0'Kx_0] + α/(1−α) tr(KW) + Σ α^k tr(PΣ_k).

**Dropouts.** A dropout acts as silence: the receiver uses its own value h, the last input or 0. With the estimate x̂ of
the state, (x̂, h)'P(x̂, h) is the value and p the loss probability (``gains_for_losses``):

    Y = S + [A B; M]'P[A B; M],    L = −Y_hh⁻¹Y_hx,    P = p Y + (1 − p)[I 0; L 0]'Y[I 0; L 0].

The acknowledgements separate estimation from control, as without losses.

Source: khashooei2017, schenato2009
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from taciturn._arrays import Array, symmetrised
from taciturn._display import Displayed
from taciturn.base.filter import by_clock
from taciturn.base.value import Attempts, Base, advantage, repeated_value
from taciturn.errors import UnstableError
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.riccati import refuse_uncertain, regulate_finite
from taciturn.model.trigger import Matrix

STEPS, CONVERGED, LARGEST = 1000, 1e-13, 1e100
HALVINGS = 10  # of the interval that contains the critical loss
IMPROVEMENTS = 50
SETTLED = 1e-12  # change of a gain relative to the gain


@dataclass(frozen=True, eq=False, repr=False)
class Prices(Displayed):
    """Optimal gains L, costs-to-go K and weights H of input errors: constant, or one of each per step of the
    horizon.
    """

    problem: Discrete  # the discrete-time problem
    K: Array  # matrix of the cost-to-go, (n, n), or (N + 1, n, n)
    L: Array  # feedback gain, (m, n), or (N, m, n)
    H: Array  # weight of the difference of the input from Lx̂, (m, m), or (N, m, m)
    error: Array  # bound on the error of K, (n, n); 0 for a finite horizon, whose recursion is exact up to rounding

    @property
    def P(self) -> Array:
        """Weight L'HL of the estimation error in the cost, (n, n); for a horizon of N steps, one per step, (N,
        n, n).
        """
        return np.swapaxes(self.L, -1, -2) @ self.H @ self.L

    @property
    def average(self) -> bool:
        """True if the cost is a long-run average, and False if it is a total over a horizon or a discounted sum."""
        return not self.problem.cost.mission

    def square(self) -> Matrix:
        """Return the weight H of an error of the input, in the user's units of the cost."""
        return by_clock(self.H / self.problem.unit)

    def total(self, covariance: Array, start: int | None) -> float:
        """Return the cost of applying the input Lx̂ at every step: per step if the cost is an average, otherwise in
        total.
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
    """Compute the optimal gains, the costs-to-go and the weights of input errors of a discrete-time problem."""
    plant, cost = problem.plant, problem.cost
    if cost.horizon is None:
        best = problem.regulator()
        return Prices(problem, best.K, best.L, best.H, best.error)
    assert problem.terminal is not None
    transport = None if problem.source is None else problem.source.transport
    late = () if transport is None else tuple(int(wait) for wait in transport.periods(problem.tick)[0])
    finite = regulate_finite(*problem.quadratic, problem.terminal, cost.horizon, late)
    return Prices(problem, finite.K, finite.L, finite.H, np.zeros_like(plant.A))


def gains_for_losses(problem: Discrete, loss: float, zero: bool, key: str = "loss") -> Array:
    """Compute the gain L, (m, n), with the least cost if a packet is sent at every step over a link that drops some."""
    plant = problem.plant
    n, m = plant.B.shape
    stage = np.block([[problem.Q, problem.N], [problem.N.T, problem.R]])
    held = np.hstack([np.zeros((m, n)), np.zeros((m, m)) if zero else np.eye(m)])
    base = Base(plant.A, plant.B, stage, np.zeros((m, n)), plant.W, held)
    L = _iterated(base, loss, problem.cost.discount)
    if L is None:
        low, high = 0.0, loss
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            low, high = (middle, high) if _iterated(base, middle, problem.cost.discount) is not None else (low, middle)
        raise UnstableError(
            f"{key} gives an average loss probability of {loss:.4g}, so the mean square of the state grows without "
            f"limit for every gain; expected a loss probability below {low:.3g}"
        )
    attempts = Attempts(losses=np.full(1, loss), discount=problem.cost.discount)
    for _ in range(IMPROVEMENTS):
        found = advantage(replace(base, K=L), "expected a smaller loss", attempts)
        change: Array = np.asarray(np.linalg.pinv(found.H[0, 0], hermitian=True), dtype=np.float64) @ found.slope[0, 0]
        L = np.asarray(L - change, dtype=np.float64)
        if np.abs(change).max(initial=0.0) <= SETTLED * np.abs(L).max(initial=0.0):
            break
    return L


def _iterated(base: Base, loss: float, discount: float) -> Array | None:
    """Return the gain after some steps of the value, or None if its own value is infinite."""
    n, silent = len(base.Phi), base.silent
    P, L = np.zeros_like(base.stage), base.K
    for _ in range(STEPS):
        Y = symmetrised(base.stage + discount * silent.T @ P @ silent)
        L = np.asarray(-np.linalg.pinv(Y[n:, n:], hermitian=True) @ Y[n:, :n], dtype=np.float64)
        closed = np.vstack([np.eye(n), L])
        after = loss * Y
        after[:n, :n] += (1 - loss) * symmetrised(closed.T @ Y @ closed)
        size, change = np.abs(after).max(), np.abs(after - P).max()
        P = after
        if not size <= LARGEST:
            return None
        if change <= CONVERGED * size:
            break
    attempts = Attempts(losses=np.full(1, loss), discount=discount)
    return None if repeated_value(replace(base, K=L), attempts) is None else L
