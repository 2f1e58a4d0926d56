"""Errors that decay and are hardly worth a send: how rarely the best schedule sends, and how little it saves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array
from taciturn._modes import radius, root, stationary

SHARES = 1 - 2.0 ** -np.arange(0.25, 10.0, 0.25)  # of the largest exponent that has a moment


@dataclass(frozen=True)
class Rarity:
    """What bounds the best schedule at a price.

    Args:
        rate: it sends no more often per check.
        gain: its mean cost per check, sends at their price included, is no less.
    """

    rate: float
    gain: float


def bound_rare_sends(F: Array, noise: Array, Gamma: Array, price: float) -> Rarity:
    """Return bounds of the best schedule of e⁺ = F e (1−σ) + w, which costs e'Γe in silence and λ per send.

    With S = Γ + F'SF a send at e saves at most e'Se of all that silence costs, so that none is made where that is
    below λ; and along any even schedule, with f = tr(ΓP) the cost of never sending and ē ~ N(0, P) its error,

        g = f − E σ(e'Se − λ) ≥ f − E max(ē'Sē − λ, 0),

    since e is ē less an error that is symmetric given e. The tail of ē'Sē bounds the rate too, and both are bounded by
    its exponential moments (``bound_tail``). An error that does not decay has the bounds 1 and 0.

    Args:
        F: (n, n).
        noise: covariance of w, (n, n).
        Gamma: Γ, (n, n), semidefinite.
        price: λ > 0.

    Example:
        >>> unit = np.eye(1)
        >>> found = bound_rare_sends(0.2 * unit, unit, unit, 100.0)
        >>> found.rate < 1e-9, abs(found.gain - 1 / 0.96) < 1e-9
        (True, True)
    """
    if radius(F) >= 1:
        return Rarity(1.0, 0.0)
    covariance, value = stationary(F, noise), stationary(F.T, Gamma)
    weights = _weights(covariance, value)
    if not weights.any():  # no noise, or none that silence costs
        return Rarity(0.0, 0.0)
    tail, beyond = bound_tail(weights, price)
    forever = float(np.sum(Gamma * covariance))
    return Rarity(min(1.0, tail), max(forever - beyond, 0.0))


def bound_rate(F: Array, noise: Array, Gamma: Array, threshold: float) -> float:
    """Return what the rate of "send iff e'Γe > threshold" is at most: the chance that an error never sent is beyond it.

    An error that was kept so far is nearer to 0 than one that nobody looked at (Gaussian correlation inequality).

    Args:
        F: (n, n).
        noise: covariance of w, (n, n).
        Gamma: Γ, (n, n), semidefinite.
        threshold: positive.

    Source: royen2014

    Example:
        >>> unit = np.eye(1)
        >>> bound_rate(0.2 * unit, unit, unit, 100.0) < 1e-9, bound_rate(unit, unit, unit, 100.0)
        (True, 1.0)
    """
    if radius(F) >= 1:
        return 1.0
    weights = _weights(stationary(F, noise), Gamma)
    return min(1.0, bound_tail(weights, threshold)[0]) if weights.any() else 0.0


def bound_tail(weights: Array, limit: float) -> tuple[float, float]:
    """Return upper bounds of P(q > x) and E max(q − x, 0) for q = Σ w_i z_i² of standard normals (Chernoff).

    For every 0 < s < 1/(2 max w): 1{q > x} ≤ exp(s(q − x)) and max(q − x, 0) ≤ exp(s(q − x) − 1)/s, with
    E exp(sq) = Π (1 − 2 s w_i)^{-1/2}; the best of some s is taken.

    Args:
        weights: w_i ≥ 0, not all 0.
        limit: x.
    """
    s = SHARES / (2 * weights.max())
    logs = -0.5 * np.log1p(-2 * s[:, None] * weights).sum(axis=1) - s * limit
    return float(np.exp(logs.min())), float(np.exp((logs - 1 - np.log(s)).min()))


def _weights(covariance: Array, square: Array) -> Array:
    """Return the weights of x'Mx, x ~ N(0, P), as a sum of squares."""
    half = root(covariance)
    return np.maximum(np.linalg.eigvalsh(half.T @ square @ half), 0.0)
