"""Exact effect of a time interval on a noisy linear system and on its quadratic cost.

``Ad``, ``Bd``, the weights, the noise and its cost all follow from one extended system ż = Fz + noise of intensity G
with the cost ∫ z'Mz dt. The vector z contains the state and the data that the actuator stores between two decisions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn import _arrays
from taciturn._arrays import Array, symmetrised
from taciturn.errors import ProblemError

DECAYED = 0.5  # norm of a transition matrix below which all modes have decayed


@dataclass(frozen=True, eq=False)
class Sampled:
    """A discrete-time LQ problem whose step is equivalent to an interval of continuous time, or to several steps.

    x⁺ = Ax + Bu + w, with w of covariance W. The mean cost of the interval is x'Qx + u'Ru + 2x'Nu + noise_cost. No
    controller can change ``noise_cost``, but costs of intervals of different length can only be compared with it.
    """

    A: Array
    B: Array
    Q: Array
    R: Array
    N: Array
    W: Array
    noise_cost: float


@dataclass(frozen=True, eq=False)
class Interval:
    """Effect of a time interval on a noisy linear system: transition matrix, noise covariance, and cost.

    ``Phi`` is the transition matrix, ``M`` the weight at the start, and ``G`` the noise covariance at the end.
    """

    Phi: Array
    M: Array
    G: Array
    noise_cost: float


def compose(first: Interval, second: Interval) -> Interval:
    """Return the effect of the interval ``first`` followed by the interval ``second``."""
    return Interval(
        second.Phi @ first.Phi,
        symmetrised(first.M + first.Phi.T @ second.M @ first.Phi),
        symmetrised(second.G + second.Phi @ first.G @ second.Phi.T),
        first.noise_cost + second.noise_cost + float(np.sum(second.M * first.G)),
    )


def repeat(once: Interval, times: int) -> Interval:
    """Return the effect of the same interval repeated ``times`` times, computed by repeated squaring."""
    result: Interval | None = None
    while True:
        if times & 1:
            result = once if result is None else compose(result, once)
        times >>= 1
        if not times:
            assert result is not None
            return result
        once = compose(once, once)


def integrate_interval(F: Array, M: Array, G: Array, period: float, units: Array) -> Interval:
    """Return the effect of a time ``period`` on ż = Fz + noise of intensity G, with the cost ∫ z'Mz dt.

    Φ = e^{Fh}, M_h = ∫ e^{F't}Me^{Ft}dt, G_h = ∫ e^{Ft}Ge^{F't}dt, c = ∫ tr(M G_t)dt. They are computed by
    power series over h/2^k, then by k doublings, which only add semidefinite terms. (Block exponentials with e^{−Fh} in
    one corner are inaccurate if ‖Fh‖ is large.) ``units``, powers of two, are the units of z in which F is best scaled;
    the scaling is exact.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        F, M, G = F / units[:, None] * units, M * units * units[:, None], G / units / units[:, None]
        size = float(np.abs(F).sum(axis=0).max(initial=0.0)) * period
        doublings = max(0, int(np.ceil(np.log2(max(size, 1e-300) / 0.5)))) if np.isfinite(size) else 10**9
        if doublings <= 1000:
            result = _doubled(F, M, G, period / 2.0**doublings, doublings)
            if all(np.isfinite(part).all() for part in (result.Phi, result.M, result.G, result.noise_cost)):
                return _in_units(result, units)
    raise ProblemError(
        f"period is {period:g}, over which the state overflows (‖A‖·period = {size:.3g}); shorten the period"
    )


def _in_units(scaled: Interval, units: Array) -> Interval:
    return Interval(
        scaled.Phi / units * units[:, None],
        scaled.M / units / units[:, None],
        scaled.G * units * units[:, None],
        scaled.noise_cost,
    )


def _doubled(F: Array, M: Array, G: Array, step: float, doublings: int) -> Interval:
    change, M, G, cost = _series(F, M, G, step)
    one, moving = np.eye(len(F)), np.flatnonzero(change.any(axis=1))
    Phi = one + change
    for _ in range(doublings):
        cost = 2 * cost + float(np.sum(M * G))
        M = symmetrised(M + Phi.T @ M @ Phi)
        G = symmetrised(G + Phi @ G @ Phi.T)
        # Each squaring of Φ doubles the relative error of a slow mode; the same step for Φ − I does not, and is as
        # accurate for a fast mode. Once all modes have decayed, Φ itself is more accurate.
        if np.linalg.norm(Phi[np.ix_(moving, moving)], 1) < DECAYED:
            Phi = Phi @ Phi
        else:
            change = 2 * change + change @ change
            Phi = one + change
    return Interval(Phi, M, G, cost)


def _series(F: Array, M: Array, G: Array, step: float) -> tuple[Array, Array, Array, float]:
    """Return Φ − I, M_h, G_h and c over a step with ‖Fh‖ ≤ 1/2, for which 24 terms are accurate to rounding."""
    change, weight, noise, cost = np.zeros_like(F), np.zeros_like(F), np.zeros_like(F), 0.0
    power, m, g = np.eye(len(F)), M * step, G * step
    for k in range(1, 26):
        weight, noise = weight + m, noise + g
        cost += float(np.sum(M * g)) * step / (k + 1)
        power = power @ F * (step / k)
        change = change + power
        m = symmetrised(m @ F) * (2 * step / (k + 1))
        g = symmetrised(F @ g) * (2 * step / (k + 1))
    return change, weight, noise, cost


def split(stretch: Interval, states: int) -> Sampled:
    """Return an interval as an LQ problem: the first ``states`` variables are the state, and the others the input."""
    n = states
    return Sampled(
        A=_arrays.frozen(stretch.Phi[:n, :n]),
        B=_arrays.frozen(stretch.Phi[:n, n:]),
        Q=_arrays.frozen(stretch.M[:n, :n]),
        R=_arrays.frozen(stretch.M[n:, n:]),
        N=_arrays.frozen(stretch.M[:n, n:]),
        W=_arrays.frozen(stretch.G[:n, :n]),
        noise_cost=stretch.noise_cost,
    )
