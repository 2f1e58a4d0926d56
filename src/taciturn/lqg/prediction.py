"""Cost of control with a predicted state, which follows from how the prediction error grows between corrections.

The input is u = L x̂ with the gain of the continuous-time regulator, and a model predicts x̂ between corrections. The
error e = x − x̂ obeys ė = A e + noise of intensity W and is 0 after a correction, so s seconds later its covariance is
V(s) = ∫_0^s e^{Ar} W e^{A'r} dr. With S = L'RL and corrections every h seconds,

    J_per(h) = tr(PW) + g(h),   g(h) = (1/h) tr(S ∫_0^h V(s) ds).

V, its integral, e^{Ah} and ∫ e^{A't} S e^{At} dt are the noise, the noise cost, the transition and the weight of one
sampled problem (``sampling``), whose entries are known to fourteen digits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, ArrayLike, number, symmetrised
from taciturn._display import Displayed
from taciturn._modes import balancing
from taciturn.errors import ProblemError
from taciturn.lqg.enclosures import E
from taciturn.lqg.riccati import refuse_uncertain, regulate_continuous
from taciturn.lqg.sampling import Sampled, Step, integrated, sampled

_GRID = 400  # intervals at which the cost is evaluated
_FINER, _ROUNDS = 42, 3  # of them about the least ratio, in turn


@dataclass(frozen=True, eq=False, repr=False)
class PredictionCost(Displayed):
    """Cost per second of control u = L x̂, where a model predicts x̂, and a policy decides when to correct x̂.

    The error e = x − x̂ obeys ė = A e + noise and is 0 after a correction. The cost is tr(PW) + E[e'S e], S = L'RL.
    With a correction every h seconds, J_per(h) = tr(PW) + g(h), where g(h) = (1/h) tr(S ∫_0^h V(s) ds) and
    V(s) = ∫_0^s e^{Ar} W e^{A'r} dr.

    Args:
        A: dynamics per second, (n, n).
        W: noise intensity per second, (n, n); for Poisson jumps rate × covariance.
        L: gain, (m, n).
        S: L'RL, (n, n).
        base: tr(PW), cost per second if the state is always known.

    Source: khashooei2017
    """

    A: Array
    W: Array
    L: Array
    S: Array
    base: float

    def flow(self, length: float) -> Array:
        """Return the transition matrix e^{Ah} for an interval of h seconds, (n, n)."""
        return self._over(length).A

    def spread(self, length: float) -> Array:
        """Return V(h), the covariance of the prediction error h seconds after a correction, (n, n)."""
        return self._over(length).W

    def weight(self, length: float) -> Array:
        """Return Γ(h) = ∫_0^h e^{A't} S e^{At} dt, the weight of the cost of an error over h seconds, (n, n)."""
        return self._over(length).Q

    def growth(self, length: float) -> float:
        """Return g(h), the cost per second that the prediction errors add if the state is corrected every h seconds."""
        return self._over(length).noise_cost / length

    def periodic(self, length: float) -> float:
        """Return J_per(h), the cost per second if the state is corrected every h seconds."""
        return self.base + self.growth(length)

    def slope_in_rate(self, length: float) -> float:
        """Return −dJ_per/dr = h² g'(h): by how much the periodic cost falls per unit of the correction rate r = 1/h.

        It equals tr(S(hV(h) − ∫_0^h V)).
        """
        found = self._over(length)
        return float(length * np.sum(self.S * found.W) - found.noise_cost)

    @property
    def initial_slope(self) -> float:
        """Slope g'(0+) = ½ tr(SW), at the interval h = 0, of the prediction cost g(h)."""
        return float(np.sum(self.S * self.W)) / 2

    def least_ratio(self, shortest: float, longest: float) -> tuple[float, float]:
        """Compute the infimum over h of g(h)/h, where g is the prediction cost, and the interval h that attains it.

        If g is convex, the infimum is at the left end; for shortest = 0 it is g'(0+).

        Args:
            shortest: shortest interval in seconds, at least 0.
            longest: longest interval in seconds, above ``shortest``. Infinity is allowed: a ratio that still decreases
                after a hundred time constants is assumed to tend to 0, as for a stable plant.
        """
        lengths = self._lengths(shortest, longest)
        ratios = [self._ratio(length) for length in lengths]
        if shortest == 0:
            lengths, ratios = [0.0, *lengths], [self.initial_slope, *ratios]
        if np.isinf(longest) and ratios[-1] < ratios[-2]:
            return 0.0, longest
        least = int(np.argmin(ratios))
        for _ in range(_ROUNDS if 0 < least < len(lengths) - 1 else 0):
            lengths = np.linspace(lengths[least - 1], lengths[least + 1], _FINER)[1:-1].tolist()
            ratios = [self._ratio(length) for length in lengths]
            least = min(max(int(np.argmin(ratios)), 1), len(lengths) - 2)
        return ratios[least], lengths[least]

    def _lengths(self, shortest: float, longest: float) -> list[float]:
        lasting = 100 * max(shortest, 1 / max(float(np.abs(self.A).max()), 1e-3))
        end = min(longest, lasting)
        lengths = np.geomspace(shortest if shortest > 0 else 1e-4 * end, end, _GRID).tolist()
        beyond = np.isfinite(longest) and longest > lasting
        return lengths + (np.geomspace(lasting, longest, _GRID)[1:].tolist() if beyond else [])

    def _ratio(self, length: float) -> float:
        """Return g(h)/h, or infinity if the error overflows."""
        try:
            return self._over(length).noise_cost / length**2
        except ProblemError:
            return np.inf

    def _over(self, length: float) -> Sampled:
        length, units = number("length", length, 0.0), balancing(self.A)

        def build(arithmetic: type[E]) -> Step[E]:
            F, M, G = (arithmetic.exact(part) for part in (self.A, self.S, self.W))
            return integrated(arithmetic, F, M, G, length, units).split(len(units))

        return sampled(build, len(units))


def prediction_cost(
    A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike, W: ArrayLike
) -> PredictionCost:
    """Return the cost of control that applies the gain of the continuous-time regulator to a predicted state.

    Args:
        A: (n, n) dynamics, per second.
        B: (n, m) input matrix, per second.
        Q: (n, n) state weight, per second.
        R: (m, m) definite input weight, per second.
        N: (n, m) cross weight.
        W: (n, n) noise intensity, per second.

    Returns:
        The cost; P is the solution of the continuous Riccati equation, and L = −R^{-1}(B'P + N').

    Raises:
        ProblemError: data of the wrong shape or range.
        UnstableError: no gain stabilises the plant.

    Source: khashooei2017

    Example:
        >>> found = prediction_cost([[0.0]], [[1.0]], [[1.0]], [[1.0]], [[0.0]], [[2.0]])
        >>> found.base, found.growth(0.5)  # P = 1, S = 1, g(h) = h
        (2.0, 0.5)
    """
    regulator = regulate_continuous(A, B, Q, R, N)
    A, R, W = (np.asarray(matrix, dtype=np.float64) for matrix in (A, R, W))
    S = symmetrised(regulator.L.T @ R @ regulator.L)
    base = float(np.sum(regulator.K * W))
    refuse_uncertain(base, float(np.sum(regulator.error * W)))
    return PredictionCost(A, W, regulator.L, S, base)
