"""Errors that decay and are hardly worth a send: how rarely the best schedule sends, and how little it saves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array
from taciturn._modes import radius, root, stationary


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

    since e is ē less an error that is symmetric given e. With w the largest eigenvalue of P^½ S P^½ the tail of ē'Sē
    beyond x is at most 2^{n/2} exp(−x/(4w)) (Chernoff), which bounds the rate too. An error that does not decay has the
    bounds 1 and 0.

    Args:
        F: (n, n).
        noise: covariance of w, (n, n).
        Gamma: Γ, (n, n), semidefinite.
        price: λ > 0.

    Example:
        >>> unit = np.eye(1)
        >>> found = bound_rare_sends(0.2 * unit, unit, unit, 100.0)
        >>> found.rate < 1e-9, 0 <= 1 / 0.96 - found.gain < 1e-9
        (True, True)
    """
    if radius(F) >= 1:
        return Rarity(1.0, 0.0)
    covariance, value = stationary(F, noise), stationary(F.T, Gamma)
    half = root(covariance)
    largest = float(np.linalg.eigvalsh(half.T @ value @ half).max(initial=0.0))
    if largest <= 0:  # no noise, or none that silence costs
        return Rarity(0.0, 0.0)
    tail = 2 ** (len(F) / 2) * np.exp(-price / (4 * largest))
    forever = float(np.sum(Gamma * covariance))
    return Rarity(min(1.0, float(tail)), max(forever - 4 * largest * float(tail), 0.0))
