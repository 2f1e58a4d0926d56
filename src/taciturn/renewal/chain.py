"""Data of an error that each send resets to 0, and the results of its renewal analysis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, ArrayLike, count, number
from taciturn._display import Displayed
from taciturn.errors import ProblemError
from taciturn.model.plant import JumpNoise


class NoQuadratureError(ProblemError):
    """Raised for an error process (chain) that the quadratures do not support; the message gives reason and remedy."""

    @property
    def reason(self) -> str:
        """First part of the error message, which contains the reason but neither expected value nor remedy."""
        return str(self).split("; ", 1)[0]


@dataclass(frozen=True, eq=False, repr=False)
class Chain(Displayed):
    """An estimation error in discrete time that is compared with a threshold at each check, and reset to 0 by a send.

    Before a check the error is e⁺ = F e + w. If e⁺'Ψe⁺ > δ, it is sent, and the error is 0 after the check. Otherwise
    it is not sent, and costs e⁺'Γe⁺. The first check is one step after an error of 0.

    Args:
        F: map of the error from one check to the next, (n, n).
        noise: covariance of w ~ N(0, ·), (n, n), semidefinite; or jumps.
        Psi: Ψ, weight of the trigger, (n, n), semidefinite.
        delta: δ > 0, threshold of the trigger.
        Gamma: Γ, weight of the cost of an unsent error, (n, n), semidefinite.
    """

    F: Array
    noise: Array | JumpNoise
    Psi: Array
    delta: float
    Gamma: Array


@dataclass(frozen=True, eq=False, repr=False)
class Intervals(Displayed):
    """The distribution of the number of checks from one send to the next.

    Args:
        survival: P(interval > k) for k = 0, 1, …, which begins with 1, (checks,).
        decay: factor per check of the survival after these checks, in [0, 1).
    """

    survival: Array
    decay: float

    @property
    def mean(self) -> float:
        """Mean number of checks between sends: the sum over k of P(interval > k)."""
        return float(self.survival.sum() + self.survival[-1] * self.decay / (1 - self.decay))

    def probability(self, checks: int) -> Array:
        """Return the probabilities P(interval = k) that two sends are k checks apart, for k = 1, …, checks.

        Raises:
            ProblemError: checks is not an integer of at least 1.
        """
        count("checks", checks)
        ticks = np.arange(checks + 1)
        return -np.diff(self.beyond(ticks.astype(np.float64)))

    def beyond(self, checks: ArrayLike) -> Array:
        """Return P(interval > k), the probability of more than k checks between sends, for an array of integers k ≥ 0.

        Raises:
            ProblemError: an entry is not an integer of at least 0.
        """
        given = np.asarray(checks)
        checks = np.asarray(given, dtype=np.float64) if given.dtype.kind in "iuf" else np.array(np.nan)
        if not (np.isfinite(checks) & (checks >= 0) & (checks == np.floor(checks))).all():
            raise ProblemError("checks has an entry that is not a non-negative integer; expected numbers of checks")
        last = len(self.survival) - 1
        inside = np.minimum(checks, last).astype(int)
        return self.survival[inside] * np.power(self.decay, np.maximum(checks - last, 0))

    def quantile(self, share: float) -> int:
        """Return a quantile of the number of checks between sends: the least k with P(interval ≤ k) ≥ share.

        Raises:
            ProblemError: share is outside (0, 1).
        """
        left = 1 - number("share", share, 0.0, 1.0)
        found = np.flatnonzero(self.survival <= left)
        if found.size:
            return max(int(found[0]), 1)
        last = len(self.survival) - 1
        if self.decay == 0:
            return last + 1
        return last + int(np.ceil(np.log(left / self.survival[-1]) / np.log(self.decay)))


@dataclass(frozen=True, eq=False, repr=False)
class Renewal(Displayed):
    """Send rate and excess cost of an error process (chain), with the error estimates of the quadrature.

    Args:
        rate: sends per check.
        excess: mean cost per check, E[(1−σ) e'Γe].
        rate_error: claimed absolute error of the rate.
        excess_error: claimed absolute error of the excess.
        intervals: distribution of the intervals between sends.
        nodes: number of nodes of the quadrature.
    """

    rate: float
    excess: float
    rate_error: float
    excess_error: float
    intervals: Intervals
    nodes: int
