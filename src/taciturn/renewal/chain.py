"""An error that a send resets: what exact analysis is given, and what it finds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, ArrayLike, count, number
from taciturn.errors import ProblemError
from taciturn.model.plant import JumpNoise


class NoQuadratureError(ProblemError):
    """A chain that no quadrature of this library serves: the sentence says why, and after a semicolon what to do."""

    @property
    def reason(self) -> str:
        """Why, without what is expected or to be done."""
        return str(self).split("; ", 1)[0]


@dataclass(frozen=True, eq=False)
class Chain:
    """An error that is looked at once per check.

    Before a check e⁺ = F e + w. If e⁺'Ψe⁺ > δ it is sent, and the error is 0 after the check; else it is kept, and
    costs e⁺'Γe⁺. The first check comes one step after an error of 0.

    Args:
        F: (n, n).
        noise: covariance of w ~ N(0, ·), (n, n), semidefinite; or jumps.
        Psi: Ψ, (n, n), semidefinite.
        delta: δ > 0.
        Gamma: Γ, (n, n), semidefinite.
    """

    F: Array
    noise: Array | JumpNoise
    Psi: Array
    delta: float
    Gamma: Array


@dataclass(frozen=True, eq=False)
class Intervals:
    """The distribution of the number of checks from one send to the next.

    Args:
        survival: P(interval > k) for k = 0, 1, …, from 1 down, (checks,).
        decay: factor per check of the survival after the last one, in [0, 1).
    """

    survival: Array
    decay: float

    @property
    def mean(self) -> float:
        """Mean interval in checks: the sum of the survival."""
        return float(self.survival.sum() + self.survival[-1] * self.decay / (1 - self.decay))

    def probability(self, checks: int) -> Array:
        """Return P(interval = k) for k = 1, …, checks.

        Raises:
            ProblemError: no whole number of at least 1.
        """
        count("checks", checks)
        ticks = np.arange(checks + 1)
        return -np.diff(self.beyond(ticks.astype(np.float64)))

    def beyond(self, checks: ArrayLike) -> Array:
        """Return P(interval > k) for whole numbers k ≥ 0, in the shape that they come in.

        Raises:
            ProblemError: what is no number of checks.
        """
        given = np.asarray(checks)
        checks = np.asarray(given, dtype=np.float64) if given.dtype.kind in "iuf" else np.array(np.nan)
        if not (np.isfinite(checks) & (checks >= 0) & (checks == np.floor(checks))).all():
            raise ProblemError("checks holds what is no whole number of at least 0; expected numbers of checks")
        last = len(self.survival) - 1
        inside = np.minimum(checks, last).astype(int)
        return self.survival[inside] * np.power(self.decay, np.maximum(checks - last, 0))

    def quantile(self, share: float) -> int:
        """Return the least k with P(interval ≤ k) ≥ share.

        Raises:
            ProblemError: a share outside (0, 1).
        """
        left = 1 - number("share", share, 0.0, 1.0)
        found = np.flatnonzero(self.survival <= left)
        if found.size:
            return max(int(found[0]), 1)
        last = len(self.survival) - 1
        if self.decay == 0:
            return last + 1
        return last + int(np.ceil(np.log(left / self.survival[-1]) / np.log(self.decay)))


@dataclass(frozen=True, eq=False)
class Renewal:
    """Rate and cost of a chain, with the errors that its quadrature claims.

    Args:
        rate: sends per check.
        excess: mean of what a check costs, E[(1−σ) e'Γe].
        rate_error: claimed absolute error of the rate.
        excess_error: claimed absolute error of the excess.
        intervals: between sends.
        nodes: of the quadrature.
    """

    rate: float
    excess: float
    rate_error: float
    excess_error: float
    intervals: Intervals
    nodes: int
