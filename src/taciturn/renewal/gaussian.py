"""Send rate, cost and intervals of an error with Gaussian noise, by quadrature of its renewal equations.

Let k be the density of the next error and E = {e: e'Ψe ≤ δ}. The expected checks T and the expected cost C until the
next send satisfy

    T = 1 + ∫_E k T,    C = e'Γe + ∫_E k C,

and the rate is 1/T₀, the excess C₀/T₀, both from an error of 0. ``quadrature`` solves these equations on nodes;
resolution and window increase together until rate and excess no longer change. The operations of a solution can be
predicted from the numbers of nodes before it is computed.

The distribution of the intervals follows from the density of unsent errors, which is propagated from check to check
until the probability of no send is negligible, or decreases geometrically. Long intervals take many checks per product,
with powers of the map. After the last check, the survival is assumed to decrease by a constant factor per check, such
that its sum is the mean interval. If the survival is geometric, this factor is the dominant eigenvalue of the map.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from taciturn._arrays import Array, frozen, number
from taciturn._progress import Progress, Stages
from taciturn.renewal.chain import Chain, Intervals, Renewal, unsent_covariance, whiten
from taciturn.renewal.quadrature import (
    BEYOND,
    COARSE,
    DENSE,
    FINER,
    LOOSEST,
    STENCIL,
    WIDER,
    CheckMatrix,
    Ellipsoid,
    ErrorRegion,
    GridCheck,
    QuadratureEffort,
    Solved,
    TooManyNodes,
    afforded,
    climb,
    find_window,
    first_density,
    most_dense,
    place,
    solve_on_nodes,
    usual_accuracy,
)
from taciturn.renewal.rates import least_interval

# of the distribution of the intervals
NEGLIGIBLE = 1e-14  # survival probability that counts as 0
SETTLED = 1e-12  # change of the distribution of the unsent error below which the survival is geometric
SMALL = 1e-3  # share of the mean interval after the last check below which a difference would cancel
STEPS = 1024  # checks that are computed one by one; after them this many per product
SLOW_STEPS = 128  # checks that are computed one by one on a grid
MOST_NODES = 2500  # most nodes of a map that is raised to a power
MOST_CHECKS = 1 << 22

# of the prediction of the operations
WINDOW_PASSES = 3  # passes in which the window of unsent errors is found
TIGHT = 1e-4  # accuracy below which one more refinement is needed
NORMAL_WINDOW = 0.85  # window relative to the one that a normal distribution would need
ENTRY = 16.0  # operations per entry of a matrix
SOLVING = 0.05  # operations of the linear solver over the third power of the nodes; it is vectorised
READ = (80.0, 50.0)  # operations per point in an interpolation on a grid: once, and per check of an interval
LONG = 13.0  # checks of an interval beyond which the number of iterations does not increase
LEAST = {1: 5e6, 2: 1e7, 3: 6e7}  # operations for the easiest chains, by dimension


def intervals(start: Array, check: CheckMatrix | GridCheck, checks: Array, mean: float) -> Intervals:
    """Compute the distribution of the number of checks from one send to the next."""
    survival, error, done = _one_by_one(start, check)
    if not done and isinstance(check, CheckMatrix) and len(start) <= MOST_NODES:
        more, error = _many_at_once(error, check.entries)
        survival = np.concatenate([survival, more])
    left = mean - float(survival.sum())
    if left < SMALL * mean:  # the difference cancels; the sum of the rest is then accurate enough
        left = float(error @ (checks - 1))
    left = left / survival[-1] if survival[-1] > 0 else 0.0
    return Intervals(frozen(survival), left / (1 + left))


def _one_by_one(start: Array, check: CheckMatrix | GridCheck) -> tuple[Array, Array, bool]:
    """Return the survival, the distribution of the unsent error after the last check, and whether it is complete."""
    survival, error = [1.0, float(start.sum())], start
    steps = STEPS if isinstance(check, CheckMatrix) else SLOW_STEPS
    while survival[-1] > NEGLIGIBLE:
        if len(survival) > steps:
            return np.array(survival), error, False
        before, error = error, check.after(error)
        survival.append(float(error.sum()))
        if _same(before, error):
            break
    return np.array(survival), error, True


def _many_at_once(error: Array, kernel: Array) -> tuple[Array, Array]:
    """Return the further survival, and the distribution after its last check, with STEPS checks per product."""
    ahead = np.empty((len(error), STEPS))  # column k: probability of no send at the next k + 1 checks
    column = np.ones(len(error))
    for k in range(STEPS):
        column = kernel @ column
        ahead[:, k] = column
    jump = np.linalg.matrix_power(kernel, STEPS)
    survival = list[Array]()
    for _ in range(MOST_CHECKS // STEPS):
        survival.append(error @ ahead)
        before, error = error, error @ jump
        if survival[-1][-1] <= NEGLIGIBLE or _same(before, error):
            break
    return np.concatenate(survival), error


def _same(before: Array, after: Array) -> bool:
    """Return whether two densities have the same shape."""
    sizes = before.sum(), after.sum()
    return bool(sizes[1] > 0 and np.abs(after / sizes[1] - before / sizes[0]).sum() <= SETTLED)


def solve_gaussian(chain: Chain, accuracy: float | None = None, progress: Progress | None = None) -> Renewal:
    """Compute send rate and excess cost of an error with Gaussian noise, by quadrature of its renewal equations.

    Let k be the density of the next error and E = {e: e'Ψe ≤ δ}. The expected checks T and the expected cost C until
    the next send satisfy T = 1 + ∫_E k T and C = e'Γe + ∫_E k C. The rate is 1/T₀ and the excess is C₀/T₀, both from an
    error of 0.

    In the coordinates of the quadrature the noise is white and Ψ is diagonal. Nodes lie on nested chords of E, within a
    window of the errors that occur. Resolution and window increase together until rate and excess no longer change. The
    estimated error is twice the last change, which is the error of the coarser answer.

    Args:
        chain: chain with Gaussian noise.
        accuracy: relative accuracy of rate and excess; if it is not reached, the estimated errors are larger; default:
            1e-8, or 1e-6 in three dimensions.
        progress: called with the fraction done.

    Returns:
        Rate, excess, their errors and the distribution of the intervals.

    Raises:
        NoQuadratureError: more than three directions of the error matter, noise does not reach a direction within one
            check, nothing is ever sent, or too many nodes are needed.

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
    """Solves the renewal equations of an error with Gaussian noise by quadrature, and predicts its computing effort."""

    def __init__(self, chain: Chain) -> None:
        """Find coordinates, and the approximate covariance of unsent errors."""
        self.chain, self.white = chain, whiten(chain)
        self.region, self.covariance = Ellipsoid(self.white.m), unsent_covariance(self.white)

    @property
    def dimensions(self) -> int:
        """Number of directions in which noise moves the error, and which affect the trigger or the cost."""
        return len(self.white.m)

    @property
    def usual(self) -> float:
        """Default relative accuracy of the computed send rate and excess cost."""
        return usual_accuracy(self.white)

    @property
    def least(self) -> float:
        """Least number of arithmetic operations with which the renewal equations can be solved."""
        return LEAST[self.dimensions]

    @property
    def rough_excess(self) -> float:
        """Rough estimate of the excess cost, usually too large, from the covariance of the errors that are not sent."""
        return float(np.sum(self.white.Gamma * self.covariance))

    def solve(self, accuracy: float | None = None, progress: Progress | None = None) -> Renewal:
        """Solve the renewal equations for send rate and excess cost, like the function :func:`solve_gaussian`."""
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
        """Predict how many operations a relative accuracy needs; infinite if it needs too many quadrature nodes."""
        n, looked = self.dimensions, min(accuracy, LOOSEST)
        window = ErrorRegion(self.covariance, np.full(n, NORMAL_WINDOW * np.sqrt(-2 * np.log(BEYOND * looked))))
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
            + WINDOW_PASSES * self._work(coarse, DENSE)
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
