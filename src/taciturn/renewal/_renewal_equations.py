"""Renewal equations of an error that sends reset, on quadrature nodes: discretisation, solution, error estimates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array, symmetrised
from taciturn._progress import OutOfTime, Stages
from taciturn.renewal._quadrature_nodes import ErrorRegion, QuadratureNodes, Region, TooManyNodes, place
from taciturn.renewal._trigger_check import INTERPOLATED, CheckMatrix, GridCheck, QuadratureEffort
from taciturn.renewal._white_coordinates import White
from taciturn.renewal.chain import NoQuadratureError

MOST_STORED_NODES = 40_000  # most nodes; their equations take seconds
DENSE, DENSEST = 1200, 6000  # nodes up to which a matrix is faster than a grid, and up to which it is affordable
COARSE = 0.5  # density of the nodes from which the window of unsent errors is found
FIRST, USUAL = 0.53, 1e-8  # first density for this accuracy; it is proportional to the root of the number of digits
LARGE = 1e-6  # default accuracy in three dimensions
LOOSEST = 1e-4  # loosest accuracy: the error of coarser nodes cannot be estimated
NARROW = 0.85  # first window, relative to the one found with coarse nodes
FINER, WIDER = 1.25, 1.1  # factors of density and window from one answer to the next
RUNGS = 12
PASSES = 12
REACH = 8.0  # first reach of a window, in conditional standard deviations
BEYOND = 0.01  # fraction of checks and of cost that a window may cut off, relative to the accuracy
ERROR_SAFETY = 2.0  # claimed error over the last change
ROUNDING = 1e-14  # relative rounding error per check of the mean interval
USELESS = 0.01  # relative error above which an answer is rejected


@dataclass(frozen=True, eq=False)
class System:
    """Discretised renewal equations: the distribution of the unsent error after one check, and the map of a check.

    Args:
        x: nodes, (nodes, n).
        share: weight of each node times (2π)^{-n/2}, the factor of the normal density, (nodes,).
        start: probability of each node after the first check, (nodes,).
        check: the map of a check.
        cost: x'Γx at each node, (nodes,).
    """

    x: Array
    share: Array
    start: Array
    check: CheckMatrix | GridCheck
    cost: Array


@dataclass(frozen=True, eq=False)
class Solved:
    """Solution of the renewal equations: send rate, excess cost, and the expected time and cost until the next send.

    Args:
        system: the equations that were solved.
        checks: expected checks until the next send, (nodes,).
        costs: expected cost until the next send, (nodes,).
        rate: sends per check.
        excess: cost per check.
        left: relative error of rate and excess that further policy iterations would remove.
    """

    system: System
    checks: Array
    costs: Array
    rate: float
    excess: float
    left: float = 0.0

    @property
    def rounding(self) -> float:
        """Relative error of the solution that finer nodes would not reduce."""
        return ROUNDING * (1 + 1 / self.rate) + self.system.check.slack

    def moved(self, previous: Solved) -> float:
        """Return the larger of the relative changes of rate and excess from a previous solution."""
        excess = abs(self.excess - previous.excess) / self.excess if self.excess > 0 else 0.0
        return max(abs(self.rate - previous.rate) / self.rate, excess)


@dataclass(frozen=True, eq=False)
class SolutionPair:
    """Solutions of the renewal equations on fine and on coarser nodes, and the error estimated from their difference.

    Args:
        found: the finer solution.
        rate_error: absolute error of the rate.
        excess_error: absolute error of the excess.
        previous: the coarser solution.
    """

    found: Solved
    rate_error: float
    excess_error: float
    previous: Solved

    @property
    def off(self) -> float:
        """The larger of the relative errors of send rate and excess cost."""
        excess = self.found.excess
        return max(self.rate_error / self.found.rate, self.excess_error / excess if excess > 0 else 0.0)


def usual_accuracy(white: White) -> float:
    """Return the default relative accuracy."""
    return USUAL if len(white.m) < 3 else LARGE


def afforded(step: int, dimensions: int) -> int:
    """Return the largest number of quadrature nodes that is allowed in an attempt.

    The first attempt uses fewer nodes, because its error estimate needs a finer one.
    """
    # the exponent is n/2, not n, as part of the nodes of a chord does not depend on the density
    return MOST_STORED_NODES if step else int(MOST_STORED_NODES / FINER ** (dimensions / 2))


def most_dense(dimensions: int, accuracy: float) -> int:
    """Return the largest number of nodes for which the map of a trigger check is stored as a matrix.

    It is larger for a fine accuracy, which the sums on a grid do not reach.
    """
    return DENSEST if dimensions < 3 and accuracy < 10 * INTERPOLATED else DENSE


def first_density(accuracy: float) -> float:
    """Return the density of the quadrature nodes in the first attempt."""
    return FIRST * float(np.sqrt(np.log(min(accuracy, LOOSEST)) / np.log(USUAL)))


def climb(
    attempt: Callable[[float, float, int], Solved | None], accuracy: float, less: str, instead: str, told: Stages
) -> SolutionPair:
    """Solve the renewal equations on finer nodes and wider windows until rate and excess no longer change.

    The claimed error is twice the last change, which is the error of the coarser answer.

    Args:
        attempt: solves for a density of the nodes, a factor of the window, and a number of the attempt; returns None if
            this fails.
        accuracy: requested relative accuracy.
        less: remedy in error messages, such as a smaller threshold.
        instead: alternative in error messages, such as a simulation.
        told: reports the progress; when time runs out, the best answer so far is returned.

    Returns:
        The most accurate answer.

    Raises:
        NoQuadratureError: too many nodes are needed, or the answers do not agree.
        OutOfTime: time runs out before the first answer.

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
            break  # hardly ever sent: finer nodes would not be more accurate
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
            f"between sends, the error spreads over too many standard deviations of the noise for {MOST_STORED_NODES} "
            f"quadrature nodes, or sends are too rare; expected {less} or more noise for a quadrature; {instead}"
        )
    if best.off > USELESS:
        raise NoQuadratureError(
            f"with {MOST_STORED_NODES} nodes in double precision, rate and excess cost have a relative error of "
            f"{best.off:.1g}; "
            f"expected at most {USELESS:g}; use {less}, or {instead}"
        )
    return best


def find_window(white: White, region: Region, covariance: Array, effort: QuadratureEffort) -> ErrorRegion:
    """Return a window, found by iteration on coarse nodes, that contains nearly all unsent errors.

    Args:
        white: the chain.
        region: the errors that are not sent.
        covariance: approximate covariance of unsent errors, (n, n).
        effort: budget, with the accuracy of rate and excess.

    Returns:
        A window outside which the share of checks and cost is negligible.
    """
    window = ErrorRegion(covariance, np.full(len(covariance), REACH))
    accuracy, rough = min(effort.accuracy, LOOSEST), replace(effort, dense=DENSE)
    for _ in range(PASSES):
        try:
            system = discretise_renewal(white, place(white, region, window, COARSE, 0, MOST_STORED_NODES // 2), rough)
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
            return ErrorRegion(window.covariance, reach)
        # widen only axes that the window cuts off; on others the chord ends before the window
        window = ErrorRegion(found, np.where(cut, 1.5 * window.reach, window.reach))
    return window


def discretise_renewal(white: White, nodes: QuadratureNodes, effort: QuadratureEffort) -> System:
    """Return the discretised renewal equations; because of symmetry, one node represents both x and −x.

    Args:
        white: the chain.
        nodes: nodes in the region of unsent errors.
        effort: budget; it decides between matrix and grid.

    Returns:
        The system.

    Raises:
        TooManyNodes: the grid would be too large.
    """
    n = len(white.m)
    density = (2 * np.pi) ** (-n / 2) * nodes.weight
    start = 2 * density * np.exp(-0.5 * (nodes.x * nodes.x).sum(axis=1))
    effort.alive()
    if len(start) > effort.dense:
        check = GridCheck(white, nodes, effort)
    else:
        kernel = gaussian_factors(nodes.x @ white.F.T, nodes.x)
        kernel += gaussian_factors(nodes.x @ white.F.T, -nodes.x)
        kernel *= density
        check = CheckMatrix(kernel)
    return System(nodes.x, density, start, check, ((nodes.x @ white.Gamma) * nodes.x).sum(axis=1))


def solve_on_nodes(white: White, nodes: QuadratureNodes, effort: QuadratureEffort) -> Solved | None:
    """Return the solution of the renewal equations on given nodes, or None if the nodes are too coarse.

    Args:
        white: the chain.
        nodes: nodes in the region of unsent errors.
        effort: budget of the solution.

    Returns:
        The solution.

    Raises:
        TooManyNodes: the grid would be too large.
    """
    system = discretise_renewal(white, nodes, effort)
    known = np.stack([np.ones(len(system.start)), system.cost], axis=1)
    solution = system.check.settled(known)
    checks, cost = 1 + float(system.start @ solution[:, 0]), float(system.start @ solution[:, 1])
    if not np.isfinite(solution).all() or checks < 1 or cost < 0:
        return None
    return Solved(system, solution[:, 0], solution[:, 1], 1 / checks, cost / checks)


def _reach(system: System, visits: Array, window: ErrorRegion, share: float) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Return the reach of each axis that leaves out at most a share of checks and cost, and which axes are cut off.

    An axis is cut off if more than this share lies at the edge of the window.
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


def gaussian_factors(means: Array, x: Array) -> Array:
    """Return the Gaussian factors exp(−½|x_j − mean_i|²) for all means and points.

    They are computed from differences, because squares of large coordinates would cancel.
    """
    power = np.zeros((len(means), len(x)))
    for axis in range(x.shape[1]):
        difference = means[:, axis, None] - x[:, axis]
        difference *= difference
        power += difference
    power *= -0.5
    np.maximum(power, -600.0, out=power)  # subnormal numbers are slow
    return np.exp(power, out=power)


def _compared(found: Solved, previous: Solved) -> SolutionPair:
    """Return a solution with its error: the change from the coarser solution, and rounding."""
    floor = found.rounding + ERROR_SAFETY * found.left
    return SolutionPair(
        found,
        ERROR_SAFETY * abs(found.rate - previous.rate) + floor * found.rate,
        ERROR_SAFETY * abs(found.excess - previous.excess) + floor * found.excess,
        previous,
    )
