"""Rate and cost of a chain with Gaussian noise: renewal equations by quadrature, with the error that is left."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from taciturn._arrays import number
from taciturn._progress import Progress, Stages
from taciturn.renewal._check import STENCIL, Effort
from taciturn.renewal._intervals import intervals
from taciturn.renewal._nodes import Ellipsoid, TooManyNodes, Window, place
from taciturn.renewal._system import (
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
    solve,
    usual_accuracy,
)
from taciturn.renewal._whiten import spread, whiten
from taciturn.renewal.chain import Chain, Renewal
from taciturn.renewal.rates import least_interval

PASSES = 3  # that tell where kept errors are
TIGHT = 1e-4  # accuracy from which on one more rung is needed
REACH = 0.85  # of what a normal law would need
ENTRY = 16.0  # operations for an entry of a matrix
SOLVING = 0.05  # times the third power of the nodes: the solver does many at once
READ = (80.0, 50.0)  # operations for a point that a value on a grid is read from: at all, and per check of an interval
LONG = 13.0  # checks of an interval beyond which iterations do not get more
LEAST = {1: 5e6, 2: 1e7, 3: 6e7}  # operations of the easiest chains, by dimension


def solve_gaussian(chain: Chain, accuracy: float | None = None, progress: Progress | None = None) -> Renewal:
    """Return rate and cost of a chain with Gaussian noise.

    With k the density of the next error, E = {e: e'Ψe ≤ δ}: T = 1 + ∫_E k T and C = e'Γe + ∫_E k C are the checks
    and the cost still to come in an interval; the rate is 1/T₀, the excess C₀/T₀, both from an error of 0.

    The coordinates make the noise white and Ψ diagonal. Nodes stand on nested chords of E, as far as kept errors
    get. Resolution and window grow together until both numbers settle; what they last moved by is the error
    claimed, twice, which is that of the coarser answer.

    Args:
        chain: with Gaussian noise.
        accuracy: relative, of rate and excess; where it is out of reach the errors say what was attained. Omitted:
            1e-8, in three dimensions 1e-6.
        progress: called with the fraction done.

    Returns:
        Rate, excess, their errors and the distribution of the intervals.

    Raises:
        NoQuadratureError: more than three directions count, a direction gets no noise in a check, nothing is
            ever sent, or more nodes are needed than can be afforded.

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
    """The renewal equations of a chain with Gaussian noise: what solving them would take, and their solution.

    Args:
        chain: with Gaussian noise.

    Raises:
        NoQuadratureError: as ``solve_gaussian``, before any node is placed.

    Source: khashooei2017

    Example:
        >>> unit = np.eye(2)
        >>> work = [Quadrature(Chain(unit, unit, unit, delta, unit)).predict(1e-4) for delta in (1.0, 20.0)]
        >>> work[0] < work[1]
        True
    """

    def __init__(self, chain: Chain) -> None:
        """Find coordinates, and about the covariance of kept errors."""
        self.chain, self.white = chain, whiten(chain)
        self.region, self.covariance = Ellipsoid(self.white.m), spread(self.white)

    @property
    def dimensions(self) -> int:
        """How many directions count."""
        return len(self.white.m)

    @property
    def usual(self) -> float:
        """The relative accuracy that is aimed at where none is asked for."""
        return usual_accuracy(self.white)

    @property
    def least(self) -> float:
        """Operations that it takes at least."""
        return LEAST[self.dimensions]

    @property
    def rough_excess(self) -> float:
        """About the excess, or more: what errors cost that are kept with a Gaussian probability."""
        return float(np.sum(self.white.Gamma * self.covariance))

    def solve(self, accuracy: float | None = None, progress: Progress | None = None) -> Renewal:
        """Return what ``solve_gaussian`` does."""
        white, region = self.white, self.region
        accuracy = number("accuracy", self.usual if accuracy is None else accuracy, 0.0, 1.0)
        told = Stages(progress)
        effort = Effort(accuracy, told.tick, most_dense(self.dimensions, accuracy))
        window = find_window(white, region, self.covariance, effort)

        def attempt(density: float, factor: float, step: int) -> Solved | None:
            most = afforded(step, len(white.m))
            return solve(white, place(white, region, window.scaled(factor), density, step, most), effort)

        best = climb(attempt, accuracy, "a smaller δ", "simulate instead", told)
        found = best.found
        distribution = intervals(found.system.start, found.system.check, found.checks, 1 / found.rate)
        return Renewal(
            found.rate, found.excess, best.rate_error, best.excess_error, distribution, len(found.system.start)
        )

    def predict(self, accuracy: float) -> float:
        """Return about how many operations a relative accuracy takes: nodes are counted, and nothing is solved.

        It is infinite where the nodes are too many.
        """
        n, looked = self.dimensions, min(accuracy, LOOSEST)
        window = Window(self.covariance, np.full(n, REACH * np.sqrt(-2 * np.log(BEYOND * looked))))
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
        """About the checks of an interval, on which iterations depend, up to where there are no more of them."""
        return min(least_interval(self.chain), LONG)
