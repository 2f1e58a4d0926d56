"""Bounds on send rate and cost of the optimal schedule for decaying errors that hardly ever need a send."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn._modes import radius, root
from taciturn.errors import UnstableError
from taciturn.lqg.lyapunov import stationary

SHARES = 1 - 2.0 ** -np.arange(0.25, 10.0, 0.25)  # exponents to try, relative to the largest with a finite moment


@dataclass(frozen=True, repr=False)
class Rarity(Displayed):
    """Bounds on the send rate and the cost of the optimal schedule for a given price per send.

    Args:
        rate: upper bound on its sends per check.
        gain: lower bound on its mean cost per check, including the price of the sends.
    """

    rate: float
    gain: float


def decayed(F: Array, W: Array) -> Array | None:
    """Return Σ_k F^k W F'^k, or None if F does not decay, or so slowly that rounding decides whether the sum is finite.

    A mode on the unit circle, such as the position of a rigid body, may be computed as slightly inside of it.
    """
    if radius(F) >= 1:
        return None
    try:
        return stationary(F, W)
    except UnstableError:
        return None


def bound_rare_sends(F: Array, noise: Array, Gamma: Array, price: float) -> Rarity:
    """Return bounds on send rate and cost of the optimal schedule for e⁺ = F e (1−σ) + w, where σ is 1 at a send.

    Silence (σ = 0) costs e'Γe, and a send (σ = 1) costs λ.

    Let S = Γ + F'SF. A send at the error e saves at most e'Se, so that the optimal schedule never sends if e'Se < λ.
    Let f = tr(ΓP) be the cost without sends, and ē ~ N(0, P) the error without sends. Every even schedule satisfies

        g = f − E σ(e'Se − λ) ≥ f − E max(ē'Sē − λ, 0),

    because ē − e is symmetric given e. The tail of ē'Sē bounds the rate too. Both bounds use exponential moments
    (``bound_tail``). For an error that does not decay, the bounds are 1 and 0.

    Args:
        F: map of the error from one check to the next, (n, n).
        noise: covariance of w, (n, n).
        Gamma: Γ, weight of the cost of silence, (n, n), semidefinite.
        price: λ > 0, the price of a send.

    Example:
        >>> unit = np.eye(1)
        >>> found = bound_rare_sends(0.2 * unit, unit, unit, 100.0)
        >>> found.rate < 1e-9, abs(found.gain - 1 / 0.96) < 1e-9
        (True, True)
    """
    covariance, value = decayed(F, noise), decayed(F.T, Gamma)
    if covariance is None or value is None:
        return Rarity(1.0, 0.0)
    weights = _weights(covariance, value)
    if not weights.any():  # no noise, or none in the directions that Γ weighs
        return Rarity(0.0, 0.0)
    tail, beyond = bound_tail(weights, price)
    forever = float(np.sum(Gamma * covariance))
    return Rarity(min(1.0, tail), max(forever - beyond, 0.0))


def bound_rare_rate(F: Array, noise: Array, Gamma: Array, threshold: float) -> float:
    """Return an upper bound on the send rate of the rule "send the error e if e'Γe > threshold".

    The bound is P(e'Γe > threshold) for the error without sends.

    An error that was not sent so far is closer to 0 than one without this condition (Gaussian correlation inequality).

    Args:
        F: map of the error from one check to the next, (n, n).
        noise: covariance of w, (n, n).
        Gamma: Γ, weight of the trigger, (n, n), semidefinite.
        threshold: threshold of the trigger, positive.

    Source: royen2014

    Example:
        >>> unit = np.eye(1)
        >>> [bound_rare_rate(F * unit, unit, unit, 100.0) < 1e-9 for F in (0.2, 1.0)]
        [True, False]
    """
    covariance = decayed(F, noise)
    if covariance is None:
        return 1.0
    weights = _weights(covariance, Gamma)
    return min(1.0, bound_tail(weights, threshold)[0]) if weights.any() else 0.0


def bound_tail(weights: Array, limit: float) -> tuple[float, float]:
    """Return Chernoff bounds on P(q > x) and E max(q − x, 0) for q = Σ w_i z_i² with standard normal z_i.

    For every 0 < s < 1/(2 max w): 1{q > x} ≤ exp(s(q − x)) and max(q − x, 0) ≤ exp(s(q − x) − 1)/s, with
    E exp(sq) = Π (1 − 2 s w_i)^{-1/2}. The bounds are minimised over several values of s.

    Args:
        weights: w_i ≥ 0, not all 0.
        limit: x, the value that q exceeds.
    """
    s = SHARES / (2 * weights.max())
    logs = -0.5 * np.log1p(-2 * s[:, None] * weights).sum(axis=1) - s * limit
    return float(np.exp(logs.min())), float(np.exp((logs - 1 - np.log(s)).min()))


def _weights(covariance: Array, square: Array) -> Array:
    """Return the weights w_i with x'Mx = Σ w_i z_i² for x ~ N(0, P) and standard normal z_i."""
    half = root(covariance)
    return np.maximum(np.linalg.eigvalsh(half.T @ square @ half), 0.0)
