"""The linear equations of a chain with jumps, and what follows from them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from taciturn._arrays import Array
from taciturn.renewal.chain import Intervals

GONE = 1e-10  # survival after which a single decay stands for all later checks
MOST = 20_000  # checks of a survival function
STEADY = 1e-12  # change of the decay per check, relative, that counts as none


@dataclass(frozen=True, eq=False)
class Sums:
    """Integrals over what jumps add, for errors at nodes and, in the last row, for the error 0 after a send.

    After a jump an error e is kept for j checks without one with weight e^{−λτj} while e, Fe, …, F^j e ∈ E. Any
    expectation after a jump, v, then satisfies v = Σ_j ∫ p (a + v)(F^j e), with a = 1 for a count of checks and e'Γe
    for costs; jumps have made it smooth, and it is a sum of few polynomials.

    Args:
        basis: values of the polynomials at the nodes, (nodes, nodes).
        steps: for each j, the integral of each polynomial at F^j e, (checks, nodes + 1, nodes).
        ones: of 1, (checks, nodes + 1).
        costs: of the cost, (checks, nodes + 1).
        quiet: e^{−λτ}, the probability of no jump in a period.
        far: of a high power of the distance, relative to where the set is cut, (checks, nodes + 1).
    """

    basis: Array
    steps: Array
    ones: Array
    costs: Array
    quiet: float
    far: Array

    @cached_property
    def _last(self) -> Array:
        """Weights of the checks; the last stands for all later ones too."""
        weights = np.ones(len(self.steps))
        weights[-1] = 1 / (1 - self.quiet)
        return weights

    @cached_property
    def _whole(self) -> tuple[Array, Array]:
        """Return the sums over j."""
        sides = np.stack([self._last @ part for part in (self.ones, self.costs, self.far)], -1)
        return np.tensordot(self._last, self.steps, 1), sides

    @cached_property
    def _cycle(self) -> Array:
        steps, sides = self._whole
        after = np.linalg.solve(self.basis - steps[:-1], sides[:-1])
        return (steps[-1] @ after + sides[-1] + np.array([1.0, 0.0, 0.0])) / (1 - self.quiet)

    def cycle(self) -> tuple[float, float]:
        """Return the mean number of checks between two sends, and the mean cost of one such cycle."""
        return float(self._cycle[0]), float(self._cycle[1])

    def outskirts(self) -> float:
        """Return a bound on how much of the visits falls beyond where the set is cut."""
        return float(abs(self._cycle[2] / self._cycle[0]))

    def intervals(self, mean: float) -> Intervals:
        """Return the distribution of the checks between sends, whose mean is known."""
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
