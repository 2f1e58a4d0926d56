"""Linear renewal equations of an error with jumps, and the distribution of the intervals between sends."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from taciturn._arrays import Array
from taciturn.renewal.chain import Intervals

GONE = 1e-10  # survival probability below which a single decay factor is used for all later checks
MOST = 20_000  # checks at which a survival function is computed
STEADY = 1e-12  # relative change of the decay factor per check below which the factor counts as constant


@dataclass(frozen=True, eq=False)
class Sums:
    """Renewal equations of an error with jumps, as integrals over the error increment in a period with a jump.

    Each row starts at one node, the last row at the error 0.

    Let v(x) be the expected sum over the checks from the next jump on, times the probability that a jump occurs in the
    next period. The error e after a jump is still unsent after j checks without a jump if e, Fe, …, F^j e ∈ E; no jump
    occurs in these checks with probability e^{−λτj}. So v = Σ_j ∫ p (a + v)(F^j e), with the density p of e, and a = 1
    to count checks or a = e'Γe for costs. The density of the jumps makes v smooth: few polynomials represent it.

    Args:
        basis: values of the basis polynomials at the nodes, (nodes, nodes).
        steps: for each j, the integrals of the polynomials at F^j e, (checks, nodes + 1, nodes).
        ones: for each j, the integrals of 1, (checks, nodes + 1).
        costs: for each j, the integrals of the cost, (checks, nodes + 1).
        quiet: e^{−λτ}, the probability of no jump in a period.
        far: for each j, the integrals of a high power of the distance, relative to the distance at which the set is
            truncated, (checks, nodes + 1).
    """

    basis: Array
    steps: Array
    ones: Array
    costs: Array
    quiet: float
    far: Array

    @cached_property
    def _last(self) -> Array:
        """Weight of each j; the last weight includes all larger j, as a geometric series."""
        weights = np.ones(len(self.steps))
        weights[-1] = 1 / (1 - self.quiet)
        return weights

    @cached_property
    def _whole(self) -> tuple[Array, Array]:
        """Return the integrals, summed over j."""
        sides = np.stack([self._last @ part for part in (self.ones, self.costs, self.far)], -1)
        return np.tensordot(self._last, self.steps, 1), sides

    @cached_property
    def _cycle(self) -> Array:
        # v at the nodes, then at the error 0; without a jump this error stays 0, which gives the factor 1/(1 − quiet)
        steps, sides = self._whole
        after = np.linalg.solve(self.basis - steps[:-1], sides[:-1])
        return (steps[-1] @ after + sides[-1] + np.array([1.0, 0.0, 0.0])) / (1 - self.quiet)

    def cycle(self) -> tuple[float, float]:
        """Return the mean number of checks between two sends, and the mean cost between two sends."""
        return float(self._cycle[0]), float(self._cycle[1])

    def outskirts(self) -> float:
        """Return a bound on the fraction of checks at which an unsent error is outside the set that the nodes cover."""
        return float(abs(self._cycle[2] / self._cycle[0]))

    def intervals(self, mean: float) -> Intervals:
        """Return the distribution of the number of checks between sends, given the mean of this number."""
        # past[k]: P(no send at the next k + 1 checks, and a jump in the next period), as coefficients of the basis;
        # origin[k]: the same from the error 0
        inverse = np.linalg.inv(self.basis)
        steps, ones = inverse @ self.steps[:, :-1], self.ones[:, :-1] @ inverse.T
        count = len(self.steps)
        past, origin, survival = [ones[0]], [self.ones[0, -1]], [1.0]
        weights = np.power(self.quiet, np.arange(count))
        decay = before = 0.0
        while survival[-1] > GONE and len(survival) < MOST:
            k = len(past)
            recent = np.array(past[: -count - 1 : -1])
            stood = np.array(origin[: -count - 1 : -1])
            survival.append(float(weights[: len(stood)] @ stood) + self.quiet**k)
            decay, before = survival[-1] / survival[-2], decay
            if k > count and abs(decay - before) < STEADY * (1 - decay):
                break
            here = steps[: len(recent)]
            fresh = np.einsum("jab,jb->a", here, recent)
            raised = float(np.einsum("jb,jb->", self.steps[: len(recent), -1], recent))
            past.append(fresh + (ones[k] if k < count else 0.0))
            origin.append(raised + (self.ones[k, -1] if k < count else 0.0))
        rest = max(mean - sum(survival), 0.0)
        return Intervals(np.array(survival), rest / (survival[-1] + rest))
