"""Martingale for a duality lower bound on the cost of every schedule, from the value function of a fitted schedule.

Its increments are φ = min(0, U) of the fitted schedule minus the conditional mean of φ.
"""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array
from taciturn._modes import root
from taciturn.renewal.fitted import Fitted

BLOCK = 2**17  # numbers per block: larger blocks do not fit the cache, and their memory is allocated anew each time


class Martingale:
    """Martingale built from the function φ = min(0, U), where U is the cost of silence minus the cost of a send.

    The Gaussian function (called bell) has the height and the curvature of φ at 0. Its conditional mean under Gaussian
    noise has a closed form, so that only the conditional mean of the rest, φ minus the bell, is sampled.

    Args:
        F: map of the error from one check to the next, (n, n).
        noise: covariance of w, (n, n).
        Gamma: Γ, weight of the cost of silence, (n, n).
        fitted: the schedule.
    """

    def __init__(self, F: Array, noise: Array, Gamma: Array, fitted: Fitted) -> None:
        """Compute the bell and its mean under the noise."""
        self.F, self.half, self.fitted = F, root(noise), fitted
        # M is a martingale only if every form is computed from the same factors: Π may have entries of 1e10, of which
        # the forms of correlated errors leave numbers of about 1
        self.cost, self.power = root(Gamma).T, root(fitted.Pi).T
        self.depth = fitted.gain + fitted.height  # of φ at 0
        bent = np.concatenate([2**0.5 * self.cost, fitted.height**0.5 * self.power]) / self.depth**0.5
        spread = bent @ self.half
        values, vectors = np.linalg.eigh(spread @ spread.T)
        widths = 1 + np.maximum(values, 0.0)
        self.blurred = (vectors / np.sqrt(widths)).T @ bent @ F
        self.less = float(np.prod(widths)) ** -0.5

    def after(self, error: Array, w: Array) -> Array:
        """Return the mean, over given noises, of the function φ minus its Gaussian part at the next check.

        Args:
            error: errors before the check, (batches, paths, n).
            w: noises, (batches, noises, n).

        Returns:
            The means, (batches, paths).
        """
        rows = max(1, BLOCK // (error.shape[1] * w.shape[1]))
        return np.concatenate([self._after(error[k : k + rows], w[k : k + rows]) for k in range(0, len(w), rows)])

    def _after(self, error: Array, w: Array) -> Array:
        mean = error @ self.F.T

        def spread(factor: Array) -> Array:
            before, added = mean @ factor.T, w @ factor.T
            found = 2 * before @ np.swapaxes(added, 1, 2)
            found += lengths(before)[:, :, None]
            found += lengths(added)[:, None]
            return found

        return self._off(spread(self.cost), spread(self.power)).mean(axis=2)

    def bell_after(self, error: Array) -> Array:
        """Return the mean of the Gaussian part of the function φ at the next check, given the error before it."""
        return -self.depth * self.less * np.exp(-0.5 * lengths(error @ self.blurred.T))

    def now(self, error: Array) -> tuple[Array, Array]:
        """Return the Gaussian part of the function φ at each error, and the remaining part of φ."""
        cost, power = lengths(error @ self.cost.T), lengths(error @ self.power.T)
        bell = -self.depth * np.exp(-(cost + (0.5 * self.fitted.height) * power) / self.depth)
        return bell, self._off(cost, power)

    def _off(self, cost: Array, power: Array) -> Array:
        """Return φ minus the bell, and overwrite both arguments; most of the time of a bound is spent here."""
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


def lengths(vectors: Array) -> Array:
    """Return the squared length of each vector, (…, n) to (…,)."""
    return np.einsum("...i,...i->...", vectors, vectors)
