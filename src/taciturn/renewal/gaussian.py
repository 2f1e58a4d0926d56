"""Send rate and cost of an error with Gaussian noise: renewal equations by quadrature, with an error estimate."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from taciturn._arrays import number
from taciturn._progress import Progress, Stages
from taciturn.renewal._intervals import intervals
from taciturn.renewal._quadrature_nodes import Ellipsoid, ErrorRegion, TooManyNodes, place
from taciturn.renewal._renewal_equations import (
    BEYOND,
    COARSE,
    DENSE,
    FINER,
    LOOSEST,
    WIDER,
    Solved,
    afforded,
    climb,
    find_window,
    first_density,
    most_dense,
    solve_on_nodes,
    usual_accuracy,
)
from taciturn.renewal._trigger_check import STENCIL, QuadratureEffort
from taciturn.renewal._white_coordinates import unsent_covariance, whiten
from taciturn.renewal.chain import Chain, Renewal
from taciturn.renewal.rates import least_interval

PASSES = 3  # passes in which the window of unsent errors is found
TIGHT = 1e-4  # accuracy below which one more refinement is needed
REACH = 0.85  # window relative to the one that a normal distribution would need
ENTRY = 16.0  # operations per entry of a matrix
SOLVING = 0.05  # operations of the linear solver over the third power of the nodes; it is vectorised
READ = (80.0, 50.0)  # operations per point in an interpolation on a grid: once, and per check of an interval
LONG = 13.0  # checks of an interval beyond which the number of iterations does not increase
LEAST = {1: 5e6, 2: 1e7, 3: 6e7}  # operations for the easiest chains, by dimension


def solve_gaussian(chain: Chain, accuracy: float | None = None, progress: Progress | None = None) -> Renewal:
    """Return send rate and excess cost of an error with Gaussian noise, by quadrature of its renewal equations.

    Let k be the density of the next error and E = {e: e'Ψe ≤ δ}. The expected checks T and the expected cost C until
    the next send satisfy T = 1 + ∫_E k T and C = e'Γe + ∫_E k C. The rate is 1/T₀ and the excess is C₀/T₀, both from an
    error of 0.

    In the coordinates of the quadrature the noise is white and Ψ is diagonal. Nodes lie on nested chords of E, within a
    window of the errors that occur. Resolution and window increase together until rate and excess no longer change. The
    claimed error is twice the last change, which is the error of the coarser answer.

    Args:
        chain: chain with Gaussian noise.
        accuracy: relative accuracy of rate and excess; if it is not reached, the claimed errors are larger. Omitted:
            1e-8, or 1e-6 in three dimensions.
        progress: called with the fraction done.

    Returns:
        Rate, excess, their errors and the distribution of the intervals.

    Raises:
        NoQuadratureError: more than three directions of the error matter, a direction gets no noise in a check, nothing
            is ever sent, or too many nodes are needed.

    Source: khashooei2017

    Example:
        >>> import numpy as np
        >>> unit = np.eye(1)
        >>> found = solve_gaussian(Chain(unit, unit, unit, 1.0, unit))
        >>> round(found.rate, 6)
        0.359334
    """
    return Quadrature(chain).solve(accuracy, progress)


class Quadrature:
    """Solver for the renewal equations of an error with Gaussian noise, which can first predict the computation.

    Args:
        chain: chain with Gaussian noise.

    Raises:
        NoQuadratureError: as ``solve_gaussian``, if it can be found before any node is placed.

    Source: khashooei2017

    Example:
        >>> unit = np.eye(2)
        >>> work = [Quadrature(Chain(unit, unit, unit, delta, unit)).predict(1e-4) for delta in (1.0, 20.0)]
        >>> work[0] < work[1]
        True
    """

    def __init__(self, chain: Chain) -> None:
        """Find coordinates, and the approximate covariance of unsent errors."""
        self.chain, self.white = chain, whiten(chain)
        self.region, self.covariance = Ellipsoid(self.white.m), unsent_covariance(self.white)

    @property
    def dimensions(self) -> int:
        """Number of directions of the error that noise reaches and that affect trigger or cost."""
        return len(self.white.m)

    @property
    def usual(self) -> float:
        """The default relative accuracy."""
        return usual_accuracy(self.white)

    @property
    def least(self) -> float:
        """Least number of arithmetic operations that a solution of the renewal equations needs."""
        return LEAST[self.dimensions]

    @property
    def rough_excess(self) -> float:
        """Rough estimate of the excess cost, usually too large, from the approximate covariance of unsent errors."""
        return float(np.sum(self.white.Gamma * self.covariance))

    def solve(self, accuracy: float | None = None, progress: Progress | None = None) -> Renewal:
        """Return send rate and excess cost, as :func:`solve_gaussian` does."""
        white, region = self.white, self.region
        accuracy = number("accuracy", self.usual if accuracy is None else accuracy, 0.0, 1.0)
        told = Stages(progress)
        effort = QuadratureEffort(accuracy, told.tick, most_dense(self.dimensions, accuracy))
        window = find_window(white, region, self.covariance, effort)

        def attempt(density: float, factor: float, step: int) -> Solved | None:
            most = afforded(step, len(white.m))
            return solve_on_nodes(white, place(white, region, window.scaled(factor), density, step, most), effort)

        best = climb(attempt, accuracy, "a smaller δ", "simulate instead", told)
        found = best.found
        distribution = intervals(found.system.start, found.system.check, found.checks, 1 / found.rate)
        return Renewal(
            found.rate, found.excess, best.rate_error, best.excess_error, distribution, len(found.system.start)
        )

    def predict(self, accuracy: float) -> float:
        """Return approximately how many operations a given relative accuracy requires, without solving the equations.

        The result is infinite if too many nodes are needed.
        """
        n, looked = self.dimensions, min(accuracy, LOOSEST)
        window = ErrorRegion(self.covariance, np.full(n, REACH * np.sqrt(-2 * np.log(BEYOND * looked))))
        try:
            coarse, first = (
                len(place(self.white, self.region, window, density, 0, afforded(0, n)).x)
                for density in (COARSE, first_density(accuracy))
            )
        except TooManyNodes:
            return float("inf")
        rungs = [first * (FINER * WIDER) ** (n * rung) for rung in range(4 if accuracy < TIGHT else 3)]
        if rungs[1] > afforded(1, n):
            return float("inf")
        return (
            self.least
            + PASSES * self._work(coarse, DENSE)
            + sum(self._work(min(nodes, afforded(1, n)), most_dense(self.dimensions, accuracy)) for nodes in rungs)
        )

    def _work(self, nodes: float, dense: int) -> float:
        if nodes > dense:
            return nodes * STENCIL**self.dimensions * (READ[0] + READ[1] * self._interval)
        return nodes**2 * ENTRY + SOLVING * nodes**3

    @cached_property
    def _interval(self) -> float:
        """Approximate checks of an interval, up to LONG; the number of iterations depends on it."""
        return min(least_interval(self.chain), LONG)
