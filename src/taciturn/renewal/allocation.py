"""Errors that a clock resets: what every interval costs, and the best rates of many that share one channel, exactly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array
from taciturn._modes import radius, stationary

LONGEST = 1 << 17  # checks between two sends; what would wait longer is never sent
FIRST = 64  # intervals that are computed at once; then twice as many
SETTLED = 1e-15  # relative change of a cost per check, from which on it is the limit
HALVINGS = 200


class Clocked:
    """An error e⁺ = F e (1−σ) + w that is sent after every k checks, and costs e'Γe while it is kept.

    Between two sends w_j = tr(Γ P_j) at the check j, P_j = F P_{j−1} F' + W from P_0 = 0: an interval of k checks costs
    S(k) = w_1 + … + w_{k−1}. A rate 1/k < r < 1/(k−1) takes turns of both intervals, so that S is linear in between.

    Args:
        F: (n, n).
        noise: W, covariance of w, (n, n).
        Gamma: Γ, (n, n), semidefinite.
    """

    def __init__(self, F: Array, noise: Array, Gamma: Array) -> None:
        """Compute the first intervals."""
        self.F, self.noise, self.Gamma = F, noise, Gamma
        self.growth = radius(F)
        self.forever = float(np.sum(Gamma * stationary(F, noise))) if self.growth < 1 else np.inf
        self._spread = noise
        self._weights = np.zeros(0)
        self._extend(FIRST)
        if not self._weights.any():  # no noise reaches what silence costs
            self.forever = 0.0

    def cost(self, rate: float) -> float:
        """Return what checks cost on average, at a rate in [0, 1] of sends per check."""
        if rate * LONGEST < 1:
            return self.forever
        interval = max(1 / rate, 1.0)
        whole = int(interval)
        self._extend(whole + 1)
        below, above = self._sums[whole - 1], self._sums[whole]
        return float(rate * (below + (interval - whole) * (above - below))) if np.isfinite(above) else np.inf

    def interval(self, price: float) -> float:
        """Return the best checks between sends at a price per send: the k of the least (S(k) + price)/k, or infinity.

        It is the first with k w_k − S(k) ≥ price, which grows with k as w does.
        """
        while True:
            count = np.arange(1, len(self._weights) + 1)
            with np.errstate(over="ignore", invalid="ignore"):  # what is beyond all numbers is sorted last
                gains = count * self._weights - self._sums[: len(count)]
            found = int(np.searchsorted(gains, price))
            if found < len(gains):
                return float(found + 1)
            if len(gains) >= LONGEST or self._is_settled():
                return np.inf
            self._extend(2 * len(gains))

    def least_rate(self, cost: float) -> float:
        """Return the rate, one of 1/k, below which checks cost more than so much on average."""
        while self._sums[-1] < cost * len(self._sums) and len(self._sums) < LONGEST and not self._is_settled():
            self._extend(2 * len(self._weights))
        count = np.arange(1, len(self._sums) + 1)
        return 1.0 / int(np.searchsorted(self._sums / count, cost, side="right").clip(1))

    def _is_settled(self) -> bool:
        last = self._weights[-1]
        return bool(np.isfinite(self.forever) and self.forever - last <= SETTLED * self.forever)

    def _extend(self, checks: int) -> None:
        """Compute w_k for so many checks, at most the longest interval; numbers that overflow are infinite."""
        more: list[float] = []
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(len(self._weights), min(checks, LONGEST)):
                weight = float(np.sum(self.Gamma * self._spread))
                more.append(weight if np.isfinite(weight) else np.inf)
                self._spread = self.F @ self._spread @ self.F.T + self.noise
        if more:
            self._weights = np.maximum.accumulate(np.concatenate([self._weights, more]))
            with np.errstate(over="ignore"):
                self._sums = np.concatenate([[0.0], np.cumsum(self._weights)])  # S(1), S(2), …


@dataclass(frozen=True, eq=False)
class Sharer:
    """Errors of one kind on a channel.

    Args:
        error: what intervals cost.
        count: how many there are.
        every: ticks of the channel between two checks.
    """

    error: Clocked
    count: int
    every: int = 1


@dataclass(frozen=True, eq=False)
class Allocation:
    """The best rates on a clock.

    Args:
        rates: sends per check of each kind, (kinds,).
        price: of a send, at which each kind would choose its rate itself; 0 where all can always send.
        costs: of one error of each kind per tick, (kinds,).
    """

    rates: Array
    price: float
    costs: Array


def allocate(sharers: Sequence[Sharer], capacity: float) -> Allocation:
    """Return the rates that minimise the sum of costs per tick, the sends per tick at most the capacity.

    The cost of a check is convex in the rate, so that one price μ per send splits the problem: every kind takes its
    best interval, and at the price where the load crosses the capacity the time is shared between both sides of it.
    No periodic schedule, whatever its order, costs less than that.

    Args:
        sharers: the kinds.
        capacity: sends per tick, positive.

    Source: everett1963
    """
    counts = np.array([sharer.count / sharer.every for sharer in sharers])
    if counts.sum() <= capacity:
        return Allocation(np.ones(len(sharers)), 0.0, np.zeros(len(sharers)))

    def rates(price: float) -> Array:
        return np.array([1 / sharer.error.interval(price) for sharer in sharers])

    def load(price: float) -> float:
        return float(counts @ rates(price))

    high = 1.0
    while load(high) > capacity:
        high *= 2
    low = high / 2
    while low > 0 and load(low) < capacity:
        low /= 2
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        if not low < middle < high:
            break
        low, high = (middle, high) if load(middle) >= capacity else (low, middle)
    often, rarely = rates(low), rates(high)
    loads = counts @ often, counts @ rarely
    share = 1.0 if loads[0] <= capacity else (capacity - loads[1]) / (loads[0] - loads[1])
    chosen = share * often + (1 - share) * rarely
    costs = [sharer.error.cost(rate) / sharer.every for sharer, rate in zip(sharers, chosen.tolist(), strict=True)]
    return Allocation(chosen, high, np.array(costs))
