"""The best a scheduler can do at a price per send: policy iteration on the renewal equations, with a free boundary."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from taciturn._arrays import TINY, Array, ArrayLike, array, number, semidefinite, square
from taciturn._progress import Progress, Stages
from taciturn.renewal._check import Effort
from taciturn.renewal._intervals import intervals
from taciturn.renewal._nodes import Ellipsoid, Region, TooManyNodes, Window, place
from taciturn.renewal._quiet import Quiet, holes, improve
from taciturn.renewal._system import (
    COARSE,
    LOOSEST,
    MOST_NODES,
    SAFETY,
    Solved,
    climb,
    find_window,
    most_dense,
    solve,
    usual_accuracy,
)
from taciturn.renewal._whiten import AGES, White, spread, whiten
from taciturn.renewal.chain import Chain, NoQuadratureError, Renewal

ROUGHLY = 1e-4  # what coarse nodes settle to
ROUNDS = 12  # of policy iteration on one set of nodes; it converges like Newton's method
LITTLE = 0.1  # of the accuracy: what may be left to iterate
BOUNDARY = 2.5  # times the error of the nodes: that of the boundary, which between two answers may hide it
START = 2.0  # times the cost of the best period: about where the boundary is in a few dimensions
SPLIT = 1e-3  # of the cost: what a region may lose by having no holes
OTHERWISE = "ask for the policy 'near-optimal', which serves any number, and simulate it"


@dataclass(frozen=True, eq=False)
class Optimum(Renewal):
    """The best scheduler at a price per send, with the errors that its quadrature claims.

    Args:
        cost: g = excess + price · rate, the least there is.
        cost_error: claimed absolute error of it.
        price: λ.
        iterations: of the policy.
        region: in coordinates with white noise, in units of the price.
    """

    cost: float
    cost_error: float
    price: float
    iterations: int
    region: Quiet

    def value(self, e: ArrayLike) -> Array:
        """Return U(e), what silence costs more than a send, for errors before the decision.

        Where hardly any error ever comes (beyond the window of the quadrature) it is e'Γe − g.

        Args:
            e: (…, n).

        Returns:
            (…,), in the units of the price.

        Raises:
            ProblemError: no numbers, or another size.
        """
        states = self.region.white.rows.shape[1]
        given = np.asarray(e)
        points = array("e", given.reshape(-1, given.shape[-1] if given.ndim else 1), (None, states), "(…, n)")
        return self.price * self.region.values(points @ self.region.white.rows.T).reshape(given.shape[:-1])

    def sends(self, e: ArrayLike) -> np.typing.NDArray[np.bool_]:
        """Return whether errors before the decision are sent: U(e) > 0.

        Args:
            e: (…, n).

        Returns:
            (…,).

        Raises:
            ProblemError: no numbers, or another size.
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
    """Return the scheduler that minimises the mean of e'Γe over silence and of a price over sends.

    Before a check e⁺ = F e + w; then it is sent, and the error is 0, or kept, and costs e⁺'Γe⁺. Optimal is

        send iff U(e) > 0,  U(e) = e'Γe − g + E min(0, U(F e + w)),  g such that λ − g + E min(0, U(w)) = 0.

    Policy iteration: the renewal equations of a region give T(e) and C(e), the checks and the cost to come until the
    next send, g = (C₀ + λ)/T₀ and U, whose negative part is the next region. Four or five regions converge. The rest
    is as under a threshold: nodes on nested chords, resolution and window growing together until rate and
    excess settle.

    Args:
        F: (n, n), any.
        noise: covariance of w ~ N(0, ·), (n, n), semidefinite.
        Gamma: Γ, (n, n), semidefinite.
        price: λ > 0, of a send.
        accuracy: relative, of rate and excess; where it is out of reach the errors say what was attained. Omitted:
            1e-8, in three dimensions 1e-6.
        progress: called with the fraction done.

    Returns:
        Cost, rate and excess per check, their errors, the distribution of the intervals, and the scheduler.

    Raises:
        ProblemError: wrong shapes, no covariances, a price or an accuracy out of range.
        NoQuadratureError: more than three directions count, a direction gets no noise in a check, silence costs
            nothing, hardly anything is sent, or the region is not one piece along an axis.

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
        rate_error=BOUNDARY * best.rate_error + SAFETY * gaps[0],
        excess_error=price * (BOUNDARY * best.excess_error + SAFETY * gaps[1]),
        intervals=intervals(found.system.start, found.system.check, found.checks, 1 / found.rate),
        nodes=len(found.system.start),
        cost=price * costs[0],
        cost_error=price * (BOUNDARY * SAFETY * (abs(costs[0] - costs[1]) + gaps[2]) + found.rounding * costs[0]),
        price=price,
        iterations=iteration.count,
        region=improve(white, found, iteration.window),
    )


def optimal_curve(
    F: ArrayLike, noise: ArrayLike, Gamma: ArrayLike, prices: ArrayLike, accuracy: float | None = None
) -> tuple[Optimum, ...]:
    """Return the best scheduler at each of some prices: the curve of rate and excess that no scheduler gets below.

    Args:
        F: (n, n), any.
        noise: covariance of w ~ N(0, ·), (n, n), semidefinite.
        Gamma: Γ, (n, n), semidefinite.
        prices: λ > 0, (prices,).
        accuracy: relative, of rates and excesses.

    Returns:
        One for each price.

    Raises:
        ProblemError: as of one price.
        NoQuadratureError: as of one price.

    Source: khashooei2017

    Example:
        >>> curve = optimal_curve([[1.0]], [[1.0]], [[1.0]], [1.0, 4.0])
        >>> [round(found.rate, 3) for found in curve]
        [0.388, 0.202]
    """
    return tuple(solve_optimal(F, noise, Gamma, float(price), accuracy) for price in array("prices", prices, (None,)))


class _Iteration:
    """Policy iteration: the region that is kept, on nodes that change under it.

    Args:
        white: the chain, in units of the price.
        accuracy: relative.
        told: the progress.
    """

    def __init__(self, white: White, accuracy: float, told: Stages) -> None:
        self.white = white
        self.effort = Effort(accuracy, told.tick, most_dense(len(white.m), accuracy))
        self.settled = LITTLE * min(accuracy, LOOSEST)
        self.count = 0
        self.found: Solved | None = None
        soft = replace(white, m=white.m / min(START * _periodic(white), 1.0))
        self.region: Region = Ellipsoid(soft.m)
        self.window = find_window(white, self.region, spread(soft), self.effort)
        try:
            self._iterate(COARSE, 1.0, 0, MOST_NODES // 2, ROUGHLY)
        except TooManyNodes:
            return
        self.window = find_window(white, self.region, self.window.covariance, self.effort)

    def attempt(self, density: float, factor: float, step: int) -> Solved | None:
        """Return the optimum on nodes of a density and a window of so many times the reach."""
        found = self._iterate(density, factor, step, MOST_NODES, self.settled)
        if found is not None and step == 1:
            _gaps(found, ROUGHLY)  # refused before many nodes are spent on it
        return found

    def _iterate(self, density: float, factor: float, step: int, most: int, settled: float) -> Solved | None:
        window: Window = self.window.scaled(factor)
        before = TINY
        for _ in range(ROUNDS):
            found = solve(self.white, place(self.white, self.region, window, density, step, most), self.effort)
            if found is None:
                return None
            self.count += 1
            moved = 1.0 if self.found is None else found.moved(self.found)
            # a change shrinks at least as it last did; the first one is one of nodes too, and may be left as a whole
            found = replace(found, left=moved * min(1.0, moved / before))
            self.region, self.found, before = improve(self.white, found, window), found, max(moved, TINY)
            if found.left <= settled:
                break
        return self.found


def _gaps(solved: Solved, negligible: float) -> tuple[float, float, float]:
    """Return what rate, excess and cost lack because the region is taken without holes; refuse where that is much."""
    gaps = holes(solved, negligible)
    if gaps[2] > SPLIT * (solved.excess + solved.rate):
        raise NoQuadratureError(
            f"errors that should be sent lie between errors that should be kept, and keeping them costs {gaps[2]:.1g} "
            f"prices per check; expected a region in one piece along every axis; {OTHERWISE}"
        )
    return gaps


def _periodic(white: White) -> float:
    """Return the cost of the best period, in units of the price: one send after so many checks without a look."""
    spreads, total, best = np.zeros_like(white.F), 1.0, 1.0
    for checks in range(1, AGES):
        spreads = white.F @ spreads @ white.F.T + np.eye(len(white.m))
        total += float(white.m @ np.diag(spreads))
        if total >= best * (checks + 1):
            break
        best = total / (checks + 1)
    return best
