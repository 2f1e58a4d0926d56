"""Rate and cost of a chain with Gaussian noise: renewal equations by quadrature, with the error that is left."""

from __future__ import annotations

from taciturn._arrays import number
from taciturn._progress import Progress, Stages
from taciturn.renewal._check import INTERPOLATED, Effort
from taciturn.renewal._intervals import intervals
from taciturn.renewal._nodes import Ellipsoid, place
from taciturn.renewal._system import (
    DENSE,
    DENSEST,
    Solved,
    afforded,
    climb,
    find_window,
    solve,
    usual_accuracy,
)
from taciturn.renewal._whiten import spread, whiten
from taciturn.renewal.chain import Chain, Renewal


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
