"""Rate and cost of a chain with Gaussian noise: renewal equations by quadrature, with the error that is left."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import number
from taciturn._progress import Progress, Stages
from taciturn.renewal._check import INTERPOLATED, STENCIL, Effort
from taciturn.renewal._intervals import intervals
from taciturn.renewal._nodes import Ellipsoid, TooManyNodes, Window, place
from taciturn.renewal._system import (
    BEYOND,
    COARSE,
    DENSE,
    DENSEST,
    FINER,
    LOOSEST,
    WIDER,
    Solved,
    afforded,
    climb,
    find_window,
    first_density,
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
CALLS = 3e6  # operations, of calls alone


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
    white = whiten(chain)
    accuracy = number("accuracy", usual_accuracy(white) if accuracy is None else accuracy, 0.0, 1.0)
    region = Ellipsoid(white.m)
    dense = DENSEST if len(white.m) < 3 and accuracy < 10 * INTERPOLATED else DENSE
    told = Stages(progress)
    effort = Effort(accuracy, told.tick, dense)
    window = find_window(white, region, spread(white), effort)

    def attempt(density: float, factor: float, step: int) -> Solved | None:
        most = afforded(step, len(white.m))
        return solve(white, place(white, region, window.scaled(factor), density, step, most), effort)

    best = climb(attempt, accuracy, "a smaller δ", "simulate instead", told)
    found = best.found
    distribution = intervals(found.system.start, found.system.check, found.checks, 1 / found.rate)
    return Renewal(found.rate, found.excess, best.rate_error, best.excess_error, distribution, len(found.system.start))


def rough_excess(chain: Chain) -> float:
    """Return about the excess of a chain, or more: what errors cost that are kept with a Gaussian probability.

    Raises:
        NoQuadratureError: as ``solve_gaussian``, before any node is placed.
    """
    white = whiten(chain)
    return float(np.sum(white.Gamma * spread(white)))


def predict_gaussian(chain: Chain, accuracy: float) -> float:
    """Return about how many operations ``solve_gaussian`` takes: its nodes are counted, and nothing is solved.

    Args:
        chain: with Gaussian noise.
        accuracy: relative.

    Returns:
        Operations, infinite where the nodes are too many.

    Raises:
        NoQuadratureError: as ``solve_gaussian``, before any node is placed.

    Source: khashooei2017

    Example:
        >>> unit = np.eye(2)
        >>> work = [predict_gaussian(Chain(unit, unit, unit, delta, unit), 1e-4) for delta in (1.0, 20.0)]
        >>> work[0] < work[1]
        True
    """
    white = whiten(chain)
    covariance, region, n = spread(white), Ellipsoid(white.m), len(white.m)
    looked = min(accuracy, LOOSEST)
    window = Window(covariance, np.full(n, REACH * np.sqrt(-2 * np.log(BEYOND * looked))))
    waited = min(least_interval(chain), LONG)
    dense = DENSEST if n < 3 and accuracy < 10 * INTERPOLATED else DENSE

    def work(nodes: int, dense: int) -> float:
        if nodes > dense:
            return nodes * STENCIL**n * (READ[0] + READ[1] * waited)
        return nodes**2 * ENTRY + SOLVING * nodes**3 + CALLS

    try:
        coarse = len(place(white, region, window, COARSE, 0, afforded(0, n)).x)
        first = len(place(white, region, window, first_density(accuracy), 0, afforded(0, n)).x)
    except TooManyNodes:
        return float("inf")
    rungs = [first * (FINER * WIDER) ** (n * rung) for rung in range(4 if accuracy < TIGHT else 3)]
    if rungs[1] > afforded(1, n):
        return float("inf")
    return PASSES * work(coarse, DENSE) + sum(work(int(min(nodes, afforded(1, n))), dense) for nodes in rungs)
