"""Renewal equations for a scalar error with Poisson jumps, by quadrature over the interval of unsent errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev

from taciturn._arrays import Array
from taciturn.renewal._jump_density import jump_reach, legendre_nodes
from taciturn.renewal._jump_sums import Sums
from taciturn.renewal.chain import NoQuadratureError

MOST_NODES = 1000
FADED = 9.0  # frequency times the smallest standard deviation at which the characteristic function is negligible


@dataclass(frozen=True)
class Line:
    """A scalar error with Poisson jumps, which is sent if its absolute value exceeds a threshold.

    Args:
        a: dynamics between jumps, ė = a e, per second.
        jump: standard deviation of a jump.
        rate: λ, jumps per second.
        period: τ, seconds between two checks.
        F: factor of the error from one check to the next, without jumps.
        bound: an error e is sent if |e| is above it.
        Gamma: Γ, weight of the cost of an unsent error.
    """

    a: float
    jump: float
    rate: float
    period: float
    F: float
    bound: float
    Gamma: float

    def sums(self, fineness: float, checks: int) -> Sums:
        """Return the renewal equations of this error, discretised on a number of nodes proportional to ``fineness``.

        Given the times of the jumps, the increment of a period is normal. The narrowest of these normal densities sets
        the scale of all nodes.

        Raises:
            NoQuadratureError: too many nodes.
        """
        # a jump grows by e^{a·left} in the time ``left`` from the jump to the check
        left, weights = legendre_nodes(60, 0.0, self.period)
        sizes = self.jump * np.exp(self.a * left)
        narrow, distance = float(sizes.min()), jump_reach(float(sizes.max()), self.rate * self.period)
        count = 2 * int(fineness * (6 + 1.5 * min(self.bound, self.bound * abs(self.F) + distance) / narrow))
        if max(count, fineness * distance / narrow) > MOST_NODES:
            raise NoQuadratureError(
                f"between sends, the error spreads over {self.bound / narrow:.3g} standard deviations of the smallest "
                "jump, more than this quadrature supports; check less often, or simulate"
            )
        # Fourier series on [−distance, distance] of the density of at least one jump: its characteristic function is
        # e^{−λτ} (exp(λ ∫ e^{−(wave·size)²/2} dt) − 1)
        waves = np.pi / distance * np.arange(1, int(FADED * distance / narrow / np.pi) + 2)
        logs = self.rate * np.exp(-np.outer(waves**2 / 2, sizes**2)) @ weights
        quiet = float(np.exp(-self.rate * self.period))
        spectrum = quiet * np.concatenate([[np.expm1(self.rate * self.period) / 2], np.expm1(logs)]) / distance
        # all expectations are even functions of the error: half of the nodes and the even polynomials suffice
        nodes = np.cos(np.pi * (np.arange(count) + 0.5) / count) * self.bound
        starts = np.append(nodes[: count // 2] * self.F, 0.0)
        basis = chebyshev.chebvander(nodes[: count // 2] / self.bound, count - 2)[:, ::2]
        # the density is replaced by a polynomial, as it is evaluated at far more points than there are waves
        density = chebyshev.Chebyshev.interpolate(
            lambda place: np.cos(np.outer(place, np.append(0.0, waves))) @ spectrum,
            int(40 + 6 * distance / narrow), domain=[0.0, distance],
        )  # fmt: skip
        steps, sides = np.zeros((checks + 1, len(starts), count // 2)), np.zeros((2, checks + 1, len(starts)))
        # an error ``place`` after a jump is unsent after j checks without a jump if |F^i place| ≤ bound, i = 0 … j
        for j in range(checks + 1):
            power = self.F**j
            low = np.maximum(-self.bound / max(1.0, abs(power)), starts - distance)
            width = np.maximum(np.minimum(self.bound / max(1.0, abs(power)), starts + distance) - low, 0.0)
            pieces = 1 + int(width.max() / (4 * narrow))
            local, masses = _pieces(int(fineness * 12), pieces)
            places = low[:, None] + width[:, None] * local
            mass = quiet**j * width[:, None] * masses * density(np.abs(places - starts[:, None]))
            moved = places * power
            steps[j] = np.einsum("rq,rqb->rb", mass, chebyshev.chebvander(moved / self.bound, count - 2)[..., ::2])
            sides[:, j] = mass.sum(1), (mass * moved**2).sum(1) * self.Gamma
        return Sums(np.asarray(basis, dtype=np.float64), steps, sides[0], sides[1], quiet, np.zeros_like(sides[0]))


def _pieces(count: int, pieces: int) -> tuple[Array, Array]:
    nodes, weights = legendre_nodes(count)
    starts = np.arange(pieces)[:, None] / pieces
    return (starts + nodes / pieces).ravel(), np.tile(weights / pieces, pieces)
