"""The renewal equations on nodes: where kept errors are, the map of a check, rate and cost, and errors left."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array, symmetrised
from taciturn._progress import OutOfTime, Stages
from taciturn.renewal._check import INTERPOLATED, Effort, Grid, Matrix
from taciturn.renewal._nodes import Nodes, Region, TooManyNodes, Window, place
from taciturn.renewal._whiten import White
from taciturn.renewal.chain import NoQuadratureError

MOST_NODES = 40_000  # whose equations take seconds
DENSE, DENSEST = 1200, 6000  # nodes up to which a matrix is quicker than a grid, and up to which it is affordable
COARSE = 0.5  # density of the nodes that tell where kept errors are
FIRST, USUAL = 0.53, 1e-8  # density below what an accuracy needs; it goes with the root of the digits
LARGE = 1e-6  # in three dimensions
LOOSEST = 1e-4  # coarser nodes would not know their own error
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
class System:
    """The kept error on nodes: its density times weight after one check, and the map of a check.

    Args:
        x: (nodes, n).
        share: the part of the plain density, (2π)^{-n/2} weight, (nodes,).
        start: (nodes,).
        check: the map.
        cost: x'Γx, (nodes,).
    """

    x: Array
    share: Array
    start: Array
    check: Matrix | Grid
    cost: Array


@dataclass(frozen=True, eq=False)
class Solved:
    """Rate and excess, and the checks and the cost that are still to come from each node.

    Args:
        system: what was solved.
        checks: (nodes,).
        costs: (nodes,).
        rate: sends per check.
        excess: cost per check.
        left: relative error of rate and excess that further iterations would take away, where a solution is iterated.
    """

    system: System
    checks: Array
    costs: Array
    rate: float
    excess: float
    left: float = 0.0

    @property
    def rounding(self) -> float:
        """Relative error that no finer nodes take away."""
        return ROUNDING * (1 + 1 / self.rate) + self.system.check.slack

    def moved(self, previous: Solved) -> float:
        """Return the larger of the relative changes of rate and excess."""
        excess = abs(self.excess - previous.excess) / self.excess if self.excess > 0 else 0.0
        return max(abs(self.rate - previous.rate) / self.rate, excess)


@dataclass(frozen=True, eq=False)
class Answer:
    """A solution, a coarser one, and what that says of the error.

    Args:
        found: the finer one.
        rate_error: absolute.
        excess_error: absolute.
        previous: the coarser one.
    """

    found: Solved
    rate_error: float
    excess_error: float
    previous: Solved

    @property
    def off(self) -> float:
        """The larger relative error."""
        excess = self.found.excess
        return max(self.rate_error / self.found.rate, self.excess_error / excess if excess > 0 else 0.0)


def usual_accuracy(white: White) -> float:
    """Return the relative accuracy that is aimed at where none is asked for."""
    return USUAL if len(white.m) < 3 else LARGE


def afforded(step: int, dimensions: int) -> int:
    """Return how many nodes a rung may take: the first leaves room for the next, without which it says nothing."""
    # a chord's ends take nodes at any density
    return MOST_NODES if step else int(MOST_NODES / FINER ** (dimensions / 2))


def most_dense(dimensions: int, accuracy: float) -> int:
    """Return the nodes up to which the map of a check is a matrix: a grid has too few digits for a fine accuracy."""
    return DENSEST if dimensions < 3 and accuracy < 10 * INTERPOLATED else DENSE


def first_density(accuracy: float) -> float:
    """Return the density of the nodes of the first rung."""
    return FIRST * float(np.sqrt(np.log(min(accuracy, LOOSEST)) / np.log(USUAL)))


def climb(
    attempt: Callable[[float, float, int], Solved | None], accuracy: float, less: str, instead: str, told: Stages
) -> Answer:
    """Return the answer of ever finer nodes on ever wider windows that settles first.

    What it last moved by is the error claimed, twice, which is that of the coarser answer.

    Args:
        attempt: solves with a density of the nodes and a factor of the window, on a rung; None where that fails.
        accuracy: relative.
        less: what would make it easier, for the reader of a refusal.
        instead: what else there is.
        told: the progress; the best answer so far is the last one when it is out of time.

    Returns:
        The best answer.

    Raises:
        NoQuadratureError: too many nodes, or too few digits.
        OutOfTime: before the first answer.

    Source: khashooei2017
    """
    density, factor = first_density(accuracy), NARROW
    previous, best, missed = None, None, 0
    for step in range(RUNGS):
        try:
            found = attempt(density, factor, step)
        except TooManyNodes:
            break
        except OutOfTime:
            if best is None:
                raise
            break
        missed += found is None
        if missed > 1 or (found is not None and found.rounding > USELESS):
            break  # hardly ever sent: finer nodes find no more digits
        if previous is not None and found is not None:
            answer = _compared(found, previous)
            best = answer if best is None or answer.off <= best.off else best
            if best.off <= max(accuracy, 2 * found.rounding):
                break
            told.at = max(told.at, float(np.log(max(best.off, accuracy)) / np.log(accuracy)))
        previous = found
        density, factor = density * FINER, factor * WIDER
    if best is None:
        raise NoQuadratureError(
            f"kept errors spread over too many standard deviations of the noise for {MOST_NODES} nodes, or are hardly "
            f"ever sent; expected {less} or more noise for a quadrature; {instead}"
        )
    if best.off > USELESS:
        raise NoQuadratureError(
            f"within {MOST_NODES} nodes and the digits of floating point, rate and excess settle to {best.off:.1g} of "
            f"themselves; expected {USELESS:g}; take {less}, or {instead}"
        )
    return best


def find_window(white: White, region: Region, covariance: Array, effort: Effort) -> Window:
    """Return where kept errors are, as coarse nodes see it on windows that they set themselves.

    Args:
        white: the chain.
        region: where errors are kept.
        covariance: of kept errors, about, (n, n).
        effort: with the accuracy of rate and excess.

    Returns:
        A window beyond which hardly any checks and costs are.
    """
    window = Window(covariance, np.full(len(covariance), REACH))
    accuracy, rough = min(effort.accuracy, LOOSEST), replace(effort, dense=DENSE)
    for _ in range(PASSES):
        try:
            system = discretise(white, place(white, region, window, COARSE, 0, MOST_NODES // 2), rough)
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


def discretise(white: White, nodes: Nodes, effort: Effort) -> System:
    """Return the map of a check on even functions: what comes to −x counts for x; a matrix for so many nodes.

    Args:
        white: the chain.
        nodes: in the region that is kept.
        effort: what may be spent.

    Returns:
        The system.

    Raises:
        TooManyNodes: more than the sums on a grid can serve.
    """
    n = len(white.m)
    density = (2 * np.pi) ** (-n / 2) * nodes.weight
    start = 2 * density * np.exp(-0.5 * (nodes.x * nodes.x).sum(axis=1))
    effort.alive()
    if len(start) > effort.dense:
        check = Grid(white, nodes, effort)
    else:
        kernel = gauss(nodes.x @ white.F.T, nodes.x)
        kernel += gauss(nodes.x @ white.F.T, -nodes.x)
        kernel *= density
        check = Matrix(kernel)
    return System(nodes.x, density, start, check, ((nodes.x @ white.Gamma) * nodes.x).sum(axis=1))


def solve(white: White, nodes: Nodes, effort: Effort) -> Solved | None:
    """Return the solution on some nodes, or None where they are too coarse to have one.

    Args:
        white: the chain.
        nodes: in the region that is kept.
        effort: what may be spent.

    Returns:
        The solution.

    Raises:
        TooManyNodes: more than the sums on a grid can serve.
    """
    system = discretise(white, nodes, effort)
    known = np.stack([np.ones(len(system.start)), system.cost], axis=1)
    solution = system.check.settled(known)
    checks, cost = 1 + float(system.start @ solution[:, 0]), float(system.start @ solution[:, 1])
    if not np.isfinite(solution).all() or checks < 1 or cost < 0:
        return None
    return Solved(system, solution[:, 0], solution[:, 1], 1 / checks, cost / checks)


def _reach(system: System, visits: Array, window: Window, share: float) -> tuple[Array, npt.NDArray[np.bool_]]:
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


def gauss(means: Array, x: Array) -> Array:
    """Return exp(−½|x_j − mean_i|²); differences, as large coordinates would cancel in squares."""
    power = np.zeros((len(means), len(x)))
    for axis in range(x.shape[1]):
        difference = means[:, axis, None] - x[:, axis]
        difference *= difference
        power += difference
    power *= -0.5
    np.maximum(power, -600.0, out=power)  # subnormal numbers are slow
    return np.exp(power, out=power)


def _compared(found: Solved, previous: Solved) -> Answer:
    """Return a solution with what it moved by, which is about the error of the coarser one, and with rounding."""
    floor = found.rounding + SAFETY * found.left
    return Answer(
        found,
        SAFETY * abs(found.rate - previous.rate) + floor * found.rate,
        SAFETY * abs(found.excess - previous.excess) + floor * found.excess,
        previous,
    )
