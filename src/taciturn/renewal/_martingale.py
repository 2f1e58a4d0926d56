"""The martingale of a lower bound by duality: φ = min(0, U) of a fitted schedule, less its conditional mean."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array, symmetrised
from taciturn._modes import root
from taciturn.renewal.fitted import Fitted, squares

BLOCK = 2**17  # numbers worked on at once: more leave the cache, and memory is asked for anew each time


class Martingale:
    """The error, and the schedule that the martingale is made of: φ = min(0, U), and a bell near it.

    The bell has the height and the curvature of φ at 0, and Gaussian noise turns it into another bell. So its
    conditional mean is exact, and only that of φ less the bell is taken over noises.

    Args:
        F: (n, n).
        noise: covariance of w, (n, n).
        Gamma: Γ, (n, n).
        fitted: the schedule.
    """

    def __init__(self, F: Array, noise: Array, Gamma: Array, fitted: Fitted) -> None:
        """Find the bell and what noise makes of it."""
        self.F, self.half, self.Gamma, self.fitted = F, root(noise), Gamma, fitted
        self.depth = fitted.gain + fitted.height  # of φ at 0
        bent = (2 * Gamma + fitted.height * fitted.Pi) / self.depth
        spread = np.eye(len(F)) + noise @ bent
        self.blurred = symmetrised(bent @ np.linalg.inv(spread))
        self.less = float(np.linalg.det(spread)) ** -0.5

    def after(self, error: Array, w: Array) -> Array:
        """Return the means over the noises of φ less the bell after a check, (batches, paths).

        Args:
            error: (batches, paths, n).
            w: (batches, noises, n).
        """
        rows = max(1, BLOCK // (error.shape[1] * w.shape[1]))
        return np.concatenate([self._after(error[k : k + rows], w[k : k + rows]) for k in range(0, len(w), rows)])

    def _after(self, error: Array, w: Array) -> Array:
        mean, turned = error @ self.F.T, np.swapaxes(w, 1, 2)

        def spread(weight: Array) -> Array:
            crossed = 2 * (mean @ weight) @ turned
            crossed += squares(mean, weight)[:, :, None]
            crossed += squares(w, weight)[:, None]
            return crossed

        return self._off(spread(self.Gamma), spread(self.fitted.Pi)).mean(axis=2)

    def bell_after(self, error: Array) -> Array:
        """Return the conditional mean of the bell after a check."""
        return -self.depth * self.less * np.exp(-0.5 * squares(error @ self.F.T, self.blurred))

    def now(self, error: Array) -> tuple[Array, Array]:
        """Return the bell at each error, and φ less the bell."""
        cost, power = squares(error, self.Gamma), squares(error, self.fitted.Pi)
        bell = -self.depth * np.exp(-(cost + (0.5 * self.fitted.height) * power) / self.depth)
        return bell, self._off(cost, power)

    def _off(self, cost: Array, power: Array) -> Array:
        """Return φ less the bell, written over what it is given: most of the time of a bound goes here."""
        power *= 0.5
        bell = power * (self.fitted.height / -self.depth)
        bell -= cost / self.depth
        np.exp(bell, out=bell)
        bell *= self.depth
        kept = np.exp(np.negative(power, out=power), out=power)
        kept *= self.fitted.height
        cost -= self.fitted.gain
        cost -= kept
        np.minimum(cost, 0.0, out=cost)
        cost += bell
        return cost
