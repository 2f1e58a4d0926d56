"""Optimal send schedule for a given price per send, by policy iteration on the renewal equations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from taciturn._arrays import NO_VARIANCE, Array, ArrayLike, array, number, semidefinite, square
from taciturn._progress import Progress, Stages, check_time
from taciturn.renewal._continuation import ContinuationRegion, holes, improve
from taciturn.renewal._intervals import intervals
from taciturn.renewal._quadrature_nodes import Ellipsoid, ErrorRegion, Region, TooManyNodes, place
from taciturn.renewal._renewal_equations import (
    COARSE,
    ERROR_SAFETY,
    LOOSEST,
    MOST_STORED_NODES,
    Solved,
    climb,
    find_window,
    most_dense,
    solve_on_nodes,
    usual_accuracy,
)
from taciturn.renewal._trigger_check import QuadratureEffort
from taciturn.renewal._white_coordinates import AGES, White, unsent_covariance, whiten
from taciturn.renewal.chain import Chain, NoQuadratureError, Renewal

ROUGHLY = 1e-4  # relative accuracy to which the policy is iterated on coarse nodes
ROUNDS = 12  # of policy iteration on one set of nodes; it converges like Newton's method
LITTLE = 0.1  # remaining error of the policy iteration, as a fraction of the accuracy
BOUNDARY = 2.5  # factor on the error of the nodes: two answers may share part of the error of the boundary
START = 2.0  # first boundary, times the cost of the best period: about right in a few dimensions
SPLIT = 1e-3  # relative loss in cost that is accepted because the region has no holes
OTHERWISE = "use the policy 'near-optimal', which supports any number of states, and simulate it"


@dataclass(frozen=True, eq=False, repr=False)
class Optimum(Renewal):
    """Optimal send schedule for a given price per send, with its rate, its cost, and error estimates of the quadrature.

    Args:
        cost: g = excess + price · rate, the least mean cost per check.
        cost_error: claimed absolute error of the cost.
        price: λ, the price of a send.
        iterations: number of policy iterations.
        region: the errors that are not sent, in coordinates with white noise and in units of the price.
    """

    cost: float
    cost_error: float
    price: float
    iterations: int
    region: ContinuationRegion

    def value(self, e: ArrayLike) -> Array:
        """Return U(e), the cost of silence minus the cost of a send, for errors e before the decision.

        Beyond the window of the quadrature, where errors hardly ever occur, U(e) = e'Γe − g is returned.

        Args:
            e: errors, (…, n).

        Returns:
            U(e) in the units of the price, (…,).

        Raises:
            ProblemError: e does not contain finite numbers, or has another size.
        """
        states = self.region.white.rows.shape[1]
        given = np.asarray(e)
        points = array("e", given.reshape(-1, given.shape[-1] if given.ndim else 1), (None, states), "(…, n)")
        return self.price * self.region.values(points @ self.region.white.rows.T).reshape(given.shape[:-1])

    def sends(self, e: ArrayLike) -> np.typing.NDArray[np.bool_]:
        """Return, for each error e, whether the optimal schedule sends it because silence would cost more: U(e) > 0.

        Args:
            e: errors, (…, n).

        Returns:
            Whether each error is sent, (…,).

        Raises:
            ProblemError: e does not contain finite numbers, or has another size.
        """
        return self.value(e) > 0


def solve_optimal(
    F: ArrayLike,
    noise: ArrayLike,
    Gamma: ArrayLike,
    price: float,
    accuracy: float | None = None,
    progress: Progress | None = None,
) -> Optimum:
    """Return the send schedule that minimises the mean cost per check: e'Γe in silence, or the price of a send.

    The error before a check is e⁺ = F e + w. A send resets it to 0; an unsent error costs e⁺'Γe⁺. The optimal rule is

        send iff U(e) > 0,  U(e) = e'Γe − g + E min(0, U(F e + w)),  g such that λ − g + E min(0, U(w)) = 0.

    The rule is found by policy iteration. The renewal equations of a region give T(e) and C(e), the expected checks and
    cost until the next send. From these follow g = (C₀ + λ)/T₀ and U, and the errors with U < 0 form the next region.
    Four or five iterations converge. The quadrature is the same as for a threshold: nodes on nested chords, with a
    resolution and a window that are increased together until rate and excess no longer change.

    Args:
        F: map of the error from one check to the next, any (n, n) matrix.
        noise: covariance of w ~ N(0, ·), (n, n), semidefinite.
        Gamma: Γ, weight of the cost of silence, (n, n), semidefinite.
        price: λ > 0, the price of a send.
        accuracy: relative accuracy of rate and excess; if it is not reached, the claimed errors are larger. Omitted:
            1e-8, or 1e-6 in three dimensions.
        progress: called with the fraction done.

    Returns:
        Cost, rate and excess per check, their errors, the distribution of the intervals, and the scheduler.

    Raises:
        ProblemError: a matrix has the wrong shape or is not semidefinite, or price or accuracy is out of range.
        NoQuadratureError: more than three directions of the error matter, a direction gets no noise in a check, silence
            costs nothing, hardly anything is sent, or the region has several pieces along an axis.

    Source: khashooei2017

    Example:
        >>> found = solve_optimal([[1.0]], [[1.0]], [[1.0]], 4.0)
        >>> round(found.cost, 6), bool(found.sends([0.1])), bool(found.sends([3.0]))
        (1.346628, False, True)
    """
    F = square("F", F)
    n = len(F)
    noise, Gamma = semidefinite("noise", noise, n), semidefinite("Gamma", Gamma, n)
    price = number("price", price, 0.0)
    white = whiten(Chain(F, noise, Gamma, price, Gamma / price), OTHERWISE)
    white = replace(white, Gamma=np.diag(white.m))
    accuracy = number("accuracy", usual_accuracy(white) if accuracy is None else accuracy, 0.0, 1.0)
    told = Stages(progress)
    iteration = _Iteration(white, accuracy, told)
    best = climb(iteration.attempt, accuracy / BOUNDARY, "a lower price", "near-optimal instead", told)
    found, costs = best.found, [solved.excess + solved.rate for solved in (best.found, best.previous)]
    gaps = _gaps(found, accuracy)
    return Optimum(
        rate=found.rate,
        excess=price * found.excess,
        rate_error=BOUNDARY * best.rate_error + ERROR_SAFETY * gaps[0],
        excess_error=price * (BOUNDARY * best.excess_error + ERROR_SAFETY * gaps[1]),
        intervals=intervals(found.system.start, found.system.check, found.checks, 1 / found.rate),
        nodes=len(found.system.start),
        cost=price * costs[0],
        cost_error=price * (BOUNDARY * ERROR_SAFETY * (abs(costs[0] - costs[1]) + gaps[2]) + found.rounding * costs[0]),
        price=price,
        iterations=iteration.count,
        region=improve(white, found, iteration.window),
    )


def optimal_curve(
    F: ArrayLike, noise: ArrayLike, Gamma: ArrayLike, prices: ArrayLike, accuracy: float | None = None
) -> tuple[Optimum, ...]:
    """Return the optimal send schedules for several prices per send, which trace the curve of least cost against rate.

    Args:
        F: map of the error from one check to the next, any (n, n) matrix.
        noise: covariance of w ~ N(0, ·), (n, n), semidefinite.
        Gamma: Γ, weight of the cost of silence, (n, n), semidefinite.
        prices: λ > 0, the prices of a send, (prices,).
        accuracy: relative accuracy of rates and excesses.

    Returns:
        One scheduler for each price.

    Raises:
        ProblemError: as ``solve_optimal``.
        NoQuadratureError: as ``solve_optimal``.

    Source: khashooei2017

    Example:
        >>> curve = optimal_curve([[1.0]], [[1.0]], [[1.0]], [1.0, 4.0])
        >>> [round(found.rate, 3) for found in curve]
        [0.388, 0.202]
    """
    return tuple(solve_optimal(F, noise, Gamma, float(price), accuracy) for price in array("prices", prices, (None,)))


class _Iteration:
    """Policy iteration on the region of unsent errors; the nodes are placed anew in every iteration.

    Args:
        white: the chain, in units of the price.
        accuracy: relative accuracy of rate and excess.
        told: reports the progress.
    """

    def __init__(self, white: White, accuracy: float, told: Stages) -> None:
        self.white = white
        self.effort = QuadratureEffort(accuracy, told.tick, most_dense(len(white.m), accuracy))
        self.settled = LITTLE * min(accuracy, LOOSEST)
        self.count = 0
        self.found: Solved | None = None
        soft = replace(white, m=white.m / min(START * _periodic(white), 1.0))
        self.region: Region = Ellipsoid(soft.m)
        self.window = find_window(white, self.region, unsent_covariance(soft), self.effort)
        try:
            self._iterate(COARSE, 1.0, 0, MOST_STORED_NODES // 2, ROUGHLY)
        except TooManyNodes:
            return
        self.window = find_window(white, self.region, self.window.covariance, self.effort)

    def attempt(self, density: float, factor: float, step: int) -> Solved | None:
        """Return the optimal schedule, computed with a density of quadrature nodes; factor scales their region."""
        found = self._iterate(density, factor, step, MOST_STORED_NODES, self.settled)
        if found is not None and step == 1:
            _gaps(found, ROUGHLY)  # rejects a region with holes before many nodes are used
        return found

    def _iterate(self, density: float, factor: float, step: int, most: int, settled: float) -> Solved | None:
        window: ErrorRegion = self.window.scaled(factor)
        before = NO_VARIANCE
        for _ in range(ROUNDS):
            check_time()
            found = solve_on_nodes(self.white, place(self.white, self.region, window, density, step, most), self.effort)
            if found is None:
                return None
            self.count += 1
            moved = 1.0 if self.found is None else found.moved(self.found)
            # the next change is smaller by at least the last ratio; the first change is also due to the new nodes, so
            # that all of it counts as the remaining error
            found = replace(found, left=moved * min(1.0, moved / before))
            self.region, self.found, before = improve(self.white, found, window), found, max(moved, NO_VARIANCE)
            if found.left <= settled:
                break
        return self.found


def _gaps(solved: Solved, negligible: float) -> tuple[float, float, float]:
    """Return the errors of rate, excess and cost from ignoring holes in the region; reject a large error."""
    gaps = holes(solved, negligible)
    if gaps[2] > SPLIT * (solved.excess + solved.rate):
        raise NoQuadratureError(
            f"the region of errors without a send has gaps, and ignoring these gaps costs {gaps[2]:.1g} times the "
            "price of "
            f"a send per check; expected a region without gaps along every axis; {OTHERWISE}"
        )
    return gaps


def _periodic(white: White) -> float:
    """Return the cost of the best periodic schedule, in units of the price."""
    spreads, total, best = np.zeros_like(white.F), 1.0, 1.0
    for checks in range(1, AGES):
        check_time()
        spreads = white.F @ spreads @ white.F.T + np.eye(len(white.m))
        total += float(white.m @ np.diag(spreads))
        if total >= best * (checks + 1):
            break
        best = total / (checks + 1)
    return best
