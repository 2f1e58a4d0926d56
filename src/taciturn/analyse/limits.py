"""Lower bounds on the cost of every send schedule of a controller at a given rate, and the optimal send schedule."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from taciturn._arrays import Array, count, instance, number
from taciturn._display import Displayed
from taciturn._progress import Progress, Stages
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.coverage import INTERVALS, LINEAR_LOOP, STEPS, Coverage
from taciturn.model.theory import Reset

if TYPE_CHECKING:
    from taciturn.renewal.optimal import Optimum

BOUNDED = Coverage(LINEAR_LOOP | STEPS | INTERVALS, "lower bounds and optimal schedules do not support")
LEVEL = 0.999  # default confidence level of a bound
CLOSE = 0.02  # largest relative difference between the given rate and that of the schedule that defines the price
TRIES = 8
FIRST = 1.5  # initial ratio of the price to the threshold with about the same rate
FEW = 300  # number of errors to which the search for a price fits
EASY = 0.97  # sends per step from which on the bound is the cost of sending every sample


@dataclass(frozen=True, repr=False)
class LowerBound(Displayed):
    """A lower bound on the cost of every send schedule of a controller at a given rate of sends.

    Args:
        cost: the bound, in units of the cost.
        confidence: one-sided confidence of the bound.
        rate: sends per step.
        price: price of a send for which the bound is computed, in units of the cost times steps; at another rate r per
            step the bound is cost + price·(rate − r).
    """

    cost: float
    confidence: float
    rate: float
    price: float

    def at_rate(self, rate: float) -> float:
        """Return the lower bound on the cost at another rate of sends per step, for the same price per send."""
        return self.cost + self.price * (self.rate - rate)


def bound_below(
    loop: Loop, rate: float, confidence: float = LEVEL, seed: int = 0, progress: Progress | None = None
) -> LowerBound:
    """Return a lower bound on the cost of every send schedule of a loop's controller, at a given rate per step.

    For every schedule, J = J_all + E[(1−σ)e'Γe] with the error e of the actuator's model, which a send resets. For any
    price λ of a send E[(1−σ)e'Γe + λσ] ≥ g. Therefore J ≥ J_all + g − λ·rate for every schedule. λ is the price for
    which a nearly optimal schedule has the given rate; duality gives g (``renewal/dual``).
    """
    reset = resets(loop)
    rate, confidence = number("rate", rate, 0.0), number("confidence", confidence, 0.0, 1.0)
    count("seed", seed, 0)
    if rate > 1 + 1e-9:
        raise ProblemError(f"rate is {rate:g}; expected at most 1")
    base = loop.policy.cost_all_time
    if rate >= EASY or not reset.weight.any():
        return LowerBound(base, confidence, rate, 0.0)
    from taciturn.renewal.dual import bound_schedules
    from taciturn.renewal.fitted import fit_schedule

    F = loop.problem.plant.A
    told = Stages(progress)
    price = _price_of(F, reset, rate, told.stage(0.0, 0.4))
    fitted = fit_schedule(F, reset.covariance, reset.weight, price, seed)
    told(0.5)
    rest = told.stage(0.5, 1.0)
    found = bound_schedules(F, reset.covariance, reset.weight, price, fitted, confidence, seed, rest)
    if found.gain <= price * rate:
        raise ProblemError(
            f"at {rate:g} sends per step, no lower bound above the cost of sending every sample was found; "
            "expected a higher rate"
        )
    return LowerBound(base + found.gain - price * rate, confidence, rate, price)


def solve_optimum(loop: Loop, price: float, accuracy: float | None = None, progress: Progress | None = None) -> Optimum:
    """Return the optimal send schedule of a loop's controller for a given price per send, computed by quadrature."""
    from taciturn.renewal.optimal import solve_optimal

    reset = resets(loop)
    number("price", price, 0.0)
    return solve_optimal(
        loop.problem.plant.A, reset.covariance, reset.weight, price / loop.policy.tick, accuracy, progress
    )


def resets(loop: Loop) -> Reset:
    """Return the error of a loop that a send resets to zero and that only Gaussian noise drives."""
    instance("loop", loop, Loop)
    if loop.violated_assumptions:
        raise ProblemError(
            f"{loop.violated_assumptions[0]}; expected the plant, network and cost of the design, which a lower bound "
            "requires"
        )
    if loop.problem.plant.changes is not None:
        raise ProblemError(
            "the set-points change (reference.steps or file); expected constant set-points for optimal schedules and "
            "lower bounds"
        )
    if loop.policy.theory.reset is None or loop.horizon is not None:
        kind, links = loop.policy.kind, loop.policy.scheduled
        several = f"{kind} decides on several links ({', '.join(links)})"
        raise ProblemError(
            "a lower bound requires that a send resets the error that determines the cost, but "
            f"{several if len(links) > 1 else f'a send of {kind} does not reset it'}; expected LQG control of the kind "
            "excess with one link and actuation = 'model', or the kind consistent or near-optimal"
        )
    if loop.problem.jumps is not None:
        raise ProblemError(
            "the noise consists of jumps; expected Gaussian noise for optimal schedules and lower bounds"
        )
    BOUNDED.check(loop.parts)
    return loop.policy.theory.reset


def _price_of(F: Array, reset: Reset, rate: float, told: Stages) -> float:
    """Return the price at which a nearly optimal schedule sends approximately at the given rate."""
    from taciturn.renewal.fitted import Fitting, keep_errors, squares

    Gamma, noise, wanted = reset.weight, reset.covariance, 1 / rate
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
    """Return an approximate root of an increasing function, by the secant method with slopes of at least 0.2."""
    value, slope = above(x), 0.6
    for _ in range(TRIES):
        if abs(value) < CLOSE:
            break
        step = float(np.clip(-value / slope, -3.0, 3.0))
        following = above(x + step)
        slope = max((following - value) / step, 0.2)
        x, value = x + step, following
    return x
