"""Rate and cost of a chain with Gaussian noise: renewal equations by quadrature, with the error that is left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array, number, symmetrised
from taciturn.renewal._check import INTERPOLATED, Grid, Matrix
from taciturn.renewal._intervals import intervals
from taciturn.renewal._nodes import Nodes, TooManyNodes, Window, place
from taciturn.renewal._whiten import White, spread, whiten
from taciturn.renewal.chain import Chain, NoQuadratureError, Renewal

MOST_NODES = 40_000  # whose equations take seconds
DENSE, DENSEST = 1200, 6000  # nodes up to which a matrix is quicker than a grid, and up to which it is affordable
COARSE = 0.5  # density of the nodes that tell where kept errors are
FIRST, USUAL = 0.53, 1e-8  # density below what an accuracy needs; it goes with the root of the digits
LARGE = 1e-6  # in three dimensions
LOOSEST = 1e-5  # coarser nodes would not know their own error
NARROW = 0.85  # of the windows that the coarse nodes ask for
FINER, WIDER = 1.25, 1.1  # from one answer to the next
RUNGS = 12
PASSES = 12
REACH = 8.0  # conditional standard deviations, at first
BEYOND = 0.01  # of the accuracy: the share of checks and of cost that a window may cut off
SAFETY = 2.0  # of what an answer moved by
ROUNDING = 1e-14  # per check of the mean interval
USELESS = 0.01  # relative error


@dataclass(frozen=True, eq=False)
class _System:
    """The kept error on nodes: its density times weight after one check, and the map of a check.

    Args:
        x: (nodes, n).
        start: (nodes,).
        check: the map.
        cost: x'Γx, (nodes,).
    """

    x: Array
    start: Array
    check: Matrix | Grid
    cost: Array


@dataclass(frozen=True, eq=False)
class _Solved:
    """Rate and excess, and the checks that are still to come from each node."""

    system: _System
    checks: Array
    rate: float
    excess: float

    @property
    def rounding(self) -> float:
        """Relative error that no finer nodes take away."""
        return ROUNDING * (1 + 1 / self.rate) + self.system.check.slack


@dataclass(frozen=True, eq=False)
class _Answer:
    found: _Solved
    rate_error: float
    excess_error: float

    @property
    def off(self) -> float:
        """The larger relative error."""
        excess = self.found.excess
        return max(self.rate_error / self.found.rate, self.excess_error / excess if excess > 0 else 0.0)


def solve_gaussian(chain: Chain, accuracy: float | None = None) -> Renewal:
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

    Returns:
        Rate, excess, their errors and the distribution of the intervals.

    Raises:
        NoQuadratureError: more than three directions count, a direction gets no noise in a check, nothing is
            ever sent, or more nodes are needed than can be afforded.

    Source: khashooei2017

    Example:
        >>> unit = np.eye(1)
        >>> found = solve_gaussian(Chain(unit, unit, unit, 1.0, unit))
        >>> round(found.rate, 6)
        0.359334
    """
    white = whiten(chain)
    if accuracy is None:
        accuracy = USUAL if len(white.m) < 3 else LARGE
    number("accuracy", accuracy, 0.0, 1.0)
    asked = min(accuracy, LOOSEST)
    window = _window(white, asked)
    dense = DENSEST if len(white.m) < 3 and accuracy < 10 * INTERPOLATED else DENSE
    density, factor = FIRST * float(np.sqrt(np.log(asked) / np.log(USUAL))), NARROW
    previous, best, missed = None, None, 0
    for step in range(RUNGS):
        try:
            found = _solve(white, place(white, window.scaled(factor), density, step, MOST_NODES), dense)
        except TooManyNodes:
            break
        missed += found is None
        if missed > 1 or (found is not None and found.rounding > USELESS):
            break  # hardly ever sent: finer nodes find no more digits
        if previous is not None and found is not None:
            answer = _compared(found, previous)
            best = answer if best is None or answer.off <= best.off else best
            if best.off <= max(accuracy, 2 * found.rounding):
                break
        previous = found
        density, factor = density * FINER, factor * WIDER
    if best is None:
        raise NoQuadratureError(
            f"kept errors spread over too many standard deviations of the noise for {MOST_NODES} nodes, or are hardly "
            "ever sent; expected a smaller δ or more noise for a quadrature; simulate instead"
        )
    if best.off > USELESS:
        raise NoQuadratureError(
            f"within {MOST_NODES} nodes and the digits of floating point, rate and excess settle to {best.off:.1g} of "
            f"themselves; expected {USELESS:g}; take a smaller δ, or simulate instead"
        )
    system = best.found.system
    distribution = intervals(system.start, system.check, best.found.checks, 1 / best.found.rate)
    return Renewal(
        best.found.rate, best.found.excess, best.rate_error, best.excess_error, distribution, len(system.start)
    )


def _window(white: White, accuracy: float) -> Window:
    """Return where kept errors are, as coarse nodes see it on windows that they set themselves."""
    covariance = spread(white)
    window = Window(covariance, np.full(len(covariance), REACH))
    for _ in range(PASSES):
        try:
            system = _discretise(white, place(white, window, COARSE, 0, MOST_NODES // 2), DENSE)
        except TooManyNodes:
            break
        visits = system.check.settled_shares(system.start)
        if not np.isfinite(visits).all() or visits.sum() <= 0:
            break
        found = symmetrised((system.x * visits[:, None]).T @ system.x / visits.sum())
        if np.linalg.eigvalsh(found)[0] <= 0:
            break
        reach, cut = _reach(system, visits, window, BEYOND * accuracy)
        ratio = np.linalg.eigvals(np.linalg.solve(window.covariance, found)).real
        if not cut.any() and ratio.min() > 0.8 and ratio.max() < 1.1:
            return Window(window.covariance, reach)
        # an axis that ends with its chord has no more nodes for a wider window
        window = Window(found, np.where(cut, 1.5 * window.reach, window.reach))
    return window


def _reach(system: _System, visits: Array, window: Window, share: float) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Return the reach of each axis beyond which no more than a share of checks and cost lies, and where there is none.

    There the window cut off more than that.
    """
    weight = visits / visits.sum()
    if system.cost.any():
        weight = weight + visits * system.cost / (visits @ system.cost)
    reach, cut = np.empty_like(window.reach), np.zeros(len(window.reach), dtype=bool)
    for axis in range(len(reach)):
        centre, deviation = window.given_outer(system.x[:, :axis])
        away = np.abs(system.x[:, axis] - centre) / deviation
        order = np.argsort(-away)
        beyond = np.cumsum(weight[order])
        least = float(away[order[min(np.searchsorted(beyond, share), len(order) - 1)]])
        reach[axis] = 1.0 + 1.1 * least
        cut[axis] = least > window.reach[axis] - 2 / deviation - 0.5
    return reach, cut


def _discretise(white: White, nodes: Nodes, dense: int) -> _System:
    """Return the map of a check on even functions: what comes to −x counts for x; a matrix for so many nodes."""
    n = len(white.m)
    density = (2 * np.pi) ** (-n / 2) * nodes.weight
    start = 2 * density * np.exp(-0.5 * (nodes.x * nodes.x).sum(axis=1))
    if len(start) > dense:
        check = Grid(white, nodes)
    else:
        kernel = _gauss(nodes.x @ white.F.T, nodes.x)
        kernel += _gauss(nodes.x @ white.F.T, -nodes.x)
        kernel *= density
        check = Matrix(kernel)
    return _System(nodes.x, start, check, ((nodes.x @ white.Gamma) * nodes.x).sum(axis=1))


def _gauss(means: Array, x: Array) -> Array:
    """Return exp(−½|x_j − mean_i|²); differences, as large coordinates would cancel in squares."""
    power = np.zeros((len(means), len(x)))
    for axis in range(x.shape[1]):
        difference = means[:, axis, None] - x[:, axis]
        difference *= difference
        power += difference
    power *= -0.5
    np.maximum(power, -600.0, out=power)  # subnormal numbers are slow
    return np.exp(power, out=power)


def _solve(white: White, nodes: Nodes, dense: int) -> _Solved | None:
    """Return the solution on some nodes, or None where they are too coarse to have one."""
    system = _discretise(white, nodes, dense)
    known = np.stack([np.ones(len(system.start)), system.cost], axis=1)
    solution = system.check.settled(known)
    checks, cost = 1 + float(system.start @ solution[:, 0]), float(system.start @ solution[:, 1])
    if not np.isfinite(solution).all() or checks < 1 or cost < 0:
        return None
    return _Solved(system, solution[:, 0], 1 / checks, cost / checks)


def _compared(found: _Solved, previous: _Solved) -> _Answer:
    """Return a solution with what it moved by, which is about the error of the coarser one, and with rounding."""
    return _Answer(
        found,
        SAFETY * abs(found.rate - previous.rate) + found.rounding * found.rate,
        SAFETY * abs(found.excess - previous.excess) + found.rounding * found.excess,
    )
