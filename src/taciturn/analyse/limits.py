"""How far a policy is from the best: what no scheduling of its controller can cost less than, at its own rate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from taciturn._arrays import Array, count, instance, number
from taciturn._progress import Progress, Stages
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.theory import Reset

if TYPE_CHECKING:
    from taciturn.renewal.optimal import Optimum

USUAL = 0.999  # confidence of a bound
CLOSE = 0.02  # of the rate: how near to it the schedule sends whose price is taken
TRIES = 8
FIRST = 1.5  # price over the threshold with about the same rate
FEW = 300  # errors that the search for a price is fitted to
EASY = 0.97  # sends per tick from which on nothing is to be told from sending always


@dataclass(frozen=True)
class LowerBound:
    """No scheduling of a controller that sends at a rate costs less.

    Args:
        cost: in the units of the cost.
        confidence: with which that holds, one-sided.
        rate: sends per tick.
        price: of a send, for which the bound is taken, in the units of the cost times ticks: at another rate r per tick
            the same bound is cost + price·(rate − r).
    """

    cost: float
    confidence: float
    rate: float
    price: float

    def at_rate(self, rate: float) -> float:
        """Return what the same price says at another rate of sends per tick."""
        return self.cost + self.price * (self.rate - rate)


def bound_below(
    loop: Loop, rate: float, confidence: float = USUAL, seed: int = 0, progress: Progress | None = None
) -> LowerBound:
    """Return what no scheduling of a loop's controller can cost less than, at a rate of sends per tick.

    Whatever decides, J = J_all + E[(1−σ)e'Γe] with the error e of the actuator's model, which a send resets. At any
    price λ of a send E[(1−σ)e'Γe + λσ] ≥ g, so that J ≥ J_all + g − λ·rate: a line below every schedule. λ is that of a
    nearly optimal schedule with the rate asked for, g by duality (``renewal/dual``).

    Args:
        loop: of the design, whose actuator runs a model; Gaussian noise.
        rate: sends per tick, in (0, 1].
        confidence: in (0, 1).
        seed: of the draws.
        progress: called with the fraction done.

    Raises:
        ProblemError: no send resets an error of the loop, the noise comes in jumps, or the rate is too low for a bound
            that says more than J_all.

    Source: cogill2007, rogers2002

    Example:
        >>> from taciturn import Cost, Plant, close, design
        >>> plant = Plant([[1.0]], [[1.0]], [[1.0]])
        >>> policy = design.excess(plant, Cost([[1.0]], [[1.0]]), delta=2.0, actuation="model")
        >>> found = bound_below(close(plant, policy), rate=0.4)
        >>> policy.cost_all_time < found.cost < policy.guarantee.at_rate(0.4)
        True
    """
    reset = resets(loop)
    rate, confidence = number("rate", rate, 0.0), number("confidence", confidence, 0.0, 1.0)
    count("seed", seed, 0)
    if rate > 1 + 1e-9:
        raise ProblemError(f"rate is {rate:g}; expected a number at most 1")
    base = loop.policy.cost_all_time
    if rate >= EASY or not reset.square.any():
        return LowerBound(base, confidence, rate, 0.0)
    from taciturn.renewal.dual import bound_schedules
    from taciturn.renewal.fitted import fit_schedule

    F = loop.problem.plant.A
    told = Stages(progress)
    price = _price_of(F, reset, rate, told.stage(0.0, 0.4))
    fitted = fit_schedule(F, reset.covariance, reset.square, price, seed)
    told(0.5)
    rest = told.stage(0.5, 1.0)
    found = bound_schedules(F, reset.covariance, reset.square, price, fitted, confidence, seed, rest)
    if found.gain <= price * rate:
        raise ProblemError(f"at {rate:g} sends per tick no bound above sending always is found; expected a higher rate")
    return LowerBound(base + found.gain - price * rate, confidence, rate, price)


def solve_optimum(loop: Loop, price: float, accuracy: float | None = None, progress: Progress | None = None) -> Optimum:
    """Return the best schedule of a loop's controller at a price per send, solved by quadrature.

    Args:
        loop: of the design, whose actuator runs a model; Gaussian noise, at most three states that count.
        price: λ > 0, of a send, in the units of the cost times those of time.
        accuracy: relative; omitted: 1e-8, in three dimensions 1e-6.
        progress: called with the fraction done.

    Returns:
        Rate and excess per tick, their errors, the distribution of the intervals, the schedule itself. The cost is the
        all-time cost and the excess.

    Raises:
        ProblemError: no send resets an error of the loop, or the noise comes in jumps.
        NoQuadratureError: more than three states, or hardly anything is sent.

    Source: cogill2007

    Example:
        >>> from taciturn import Cost, Plant, close, design
        >>> plant = Plant([[1.0]], [[1.0]], [[1.0]])
        >>> policy = design.excess(plant, Cost([[1.0]], [[1.0]]), delta=2.0, actuation="model")
        >>> found = solve_optimum(close(plant, policy), price=2.0)
        >>> 0 < found.rate < 1, found.intervals.quantile(0.5) >= 1
        (True, True)
    """
    from taciturn.renewal.optimal import solve_optimal

    reset = resets(loop)
    number("price", price, 0.0)
    return solve_optimal(
        loop.problem.plant.A, reset.covariance, reset.square, price / loop.policy.tick, accuracy, progress
    )


def resets(loop: Loop) -> Reset:
    """Return the error of a loop that a send resets, and that Gaussian noise alone moves.

    Raises:
        ProblemError: there is none.
    """
    instance("loop", loop, Loop)
    if loop.departures:
        raise ProblemError(f"{loop.departures[0]}; expected the loop of the design for a lower bound")
    if loop.policy.reset is None or loop.horizon is not None:
        raise ProblemError(
            f"no send of {loop.policy.kind} resets the error that costs, which a lower bound needs; expected a policy "
            "with actuation = 'model', or one of consistent, near-optimal"
        )
    if loop.problem.jumps is not None:
        raise ProblemError("the noise comes in jumps; expected Gaussian noise for the best schedule and what bounds it")
    return loop.policy.reset


def _price_of(F: Array, reset: Reset, rate: float, told: Stages) -> float:
    """Return the price at which a nearly optimal schedule sends about at a rate."""
    from taciturn.renewal.fitted import Fitting, keep_errors, squares

    Gamma, noise, wanted = reset.square, reset.covariance, 1 / rate
    fitting = Fitting(F, noise, Gamma, points=FEW)

    def thresholds(log_price: float) -> float:
        told(told.at + 0.5 / TRIES)
        delta = np.exp(log_price)
        return float(np.log(keep_errors(F, noise, lambda e: squares(e, Gamma) > delta)[1] / wanted))

    def schedules(log_price: float) -> float:
        told(told.at + 0.5 / TRIES)
        found = fitting.at(float(np.exp(log_price)))
        return float(np.log(keep_errors(F, noise, lambda e: found.sends(e, Gamma))[1] / wanted))

    start = float(np.log(max(np.trace(Gamma @ noise), 1e-300)))
    return float(np.exp(_root(schedules, _root(thresholds, start) + np.log(FIRST))))


def _root(above: Callable[[float], float], x: float) -> float:
    """Return about where an increasing function is 0, by secants with a slope of at least a fifth."""
    value, slope = above(x), 0.6
    for _ in range(TRIES):
        if abs(value) < CLOSE:
            break
        step = float(np.clip(-value / slope, -3.0, 3.0))
        following = above(x + step)
        slope = max((following - value) / step, 0.2)
        x, value = x + step, following
    return x
