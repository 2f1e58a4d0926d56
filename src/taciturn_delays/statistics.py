"""Statistics of delays and losses: shares, quantiles, reordering, and dependence between consecutive packets.

A quantile at the level q is the smallest delay that at least the share q of the delivered packets do not exceed. It is
unknown if there are fewer than 1/(1 − q) delivered packets.

A delivered packet is reordered if a packet that was sent later was received earlier.

The lag-one correlation is that of the delays of consecutive packets, both delivered. For losses it is that of the
numbers 1 (lost) and 0 (delivered). Losses are bursty if they form fewer runs than by chance. If L of n packets are lost
independently of each other, the number R of runs of consecutive losses has, given L, the hypergeometric distribution

    P(R = r) = C(L−1, r−1) C(n−L+1, r) / C(n, L),

and losses count as bursty if at most the observed number of runs has a probability below 0.001. The test is exact for
any number of losses.

Source: morton2006, wald1940
"""

from __future__ import annotations

import math

import numpy as np

from taciturn.extend import Array, Bits

RARE = 1e-3  # probability of the observed runs of losses, below which losses are bursty
_SLACK = 1e-9  # of cumulated probabilities, and of seconds, for their rounding


def quantile(delays: Array, weights: Array, level: float, packets: int | None) -> float | None:
    """Return a quantile of delays with weights; None if there are too few packets."""
    if packets is not None and packets * (1 - level) < 1 - _SLACK:
        return None
    order = np.argsort(delays, kind="stable")
    below = np.cumsum(weights[order]) / weights.sum()
    return float(delays[order][int(np.argmax(below >= level - _SLACK))])


def reordered(received: Array) -> int:
    """Count the delivered packets that a packet that was sent later has overtaken; entries are in order of sending."""
    if len(received) < 2:
        return 0
    later = np.minimum.accumulate(received[::-1])[::-1]
    return int((np.isfinite(received[:-1]) & (received[:-1] > later[1:] + _SLACK)).sum())


def correlation(values: Array, known: Bits) -> float | None:
    """Return the correlation of consecutive values that are both known; None if it is not defined."""
    both = known[1:] & known[:-1]
    first, second = values[:-1][both], values[1:][both]
    if len(first) < 3:
        return None
    first, second = first - first.mean(), second - second.mean()
    scale = math.sqrt(float(first @ first) * float(second @ second))
    if scale <= 1e-12 * float(np.abs(values[known]).max()) ** 2 * len(first):
        return None
    return float(np.clip(first @ second / scale, -1.0, 1.0))


def runs(lost: Bits) -> int:
    """Count the runs of consecutive dropped packets."""
    return int(lost[0]) + int((lost[1:] & ~lost[:-1]).sum())


def chance_of_runs(packets: int, losses: int, seen: int) -> float:
    """Return the probability of at most ``seen`` runs if losses are independent of each other, given their number."""
    if losses < 2 or losses == packets:
        return 1.0
    logs = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1.0, packets + 2)))])

    def choose(n: int, k: Array) -> Array:
        whole = k.astype(np.int64)
        return logs[n] - logs[whole] - logs[n - whole]

    r = np.arange(1.0, min(seen, losses, packets - losses + 1) + 1)
    terms = choose(losses - 1, r - 1) + choose(packets - losses + 1, r) - choose(packets, np.array([float(losses)]))
    return min(1.0, float(np.exp(terms).sum()))
