"""Lower bounds on the cost of all send schedules of a controller at a given rate, and the optimal schedule.

For every schedule, J = J_all + E[(1−σ)e'Γe] with the error e of the actuator's model, which a send (σ = 1) resets. For
any price λ of a send, duality (``dual``) gives a g with E[(1−σ)e'Γe + λσ] ≥ g. Therefore

    J ≥ J_all + g − λ·rate

for every schedule. λ is the price for which a nearly optimal schedule has the given rate, approximately: any price
gives a bound. It is found by the secant method, first for a threshold on e'Γe, whose rate takes little time, and then
for a fitted schedule.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from taciturn.analyse.renewal import resets
from taciturn.errors import ProblemError
from taciturn.extend import Array, Progress, Stages, count, number
from taciturn.loop import Loop
from taciturn.model.theory import LEVEL, LowerBound, Reset

if TYPE_CHECKING:
    from taciturn_limits.optimal import Optimum

CLOSE = 0.02  # largest relative difference between the given rate and that of the schedule that defines the price
TRIES = 8
FIRST = 1.5  # initial ratio of the price to the threshold with about the same rate
FEW = 300  # number of errors to which the search for a price fits
EASY = 0.97  # sends per step from which on the bound is the cost of sending every sample


def bound_below(
    loop: Loop, rate: float, confidence: float = LEVEL, seed: int = 0, progress: Progress | None = None
) -> LowerBound:
    """Compute a lower bound on the cost of all send schedules of a loop's controller with a given rate per step."""
    reset = resets(loop)
    rate, confidence = number("rate", rate, 0.0), number("confidence", confidence, 0.0, 1.0)
    count("seed", seed, 0)
    if rate > 1 + 1e-9:
        raise ProblemError(f"rate is {rate:g}; expected a rate of at most 1 send per step")
    base = loop.policy.cost_all_time
    if rate >= EASY or not reset.weight.any():
        return LowerBound(base, confidence, rate, 0.0)
    from taciturn_limits.dual import bound_schedules
    from taciturn_limits.fitted import fit_schedule

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
    """Compute the optimal send schedule of a loop's controller for a price per send, by quadrature."""
    from taciturn_limits.optimal import solve_optimal

    reset = resets(loop)
    number("price", price, 0.0)
    return solve_optimal(
        loop.problem.plant.A, reset.covariance, reset.weight, price / loop.policy.tick, accuracy, progress
    )


def _price_of(F: Array, reset: Reset, rate: float, told: Stages) -> float:
    """Return the price at which a nearly optimal schedule sends approximately at the given rate."""
    from taciturn_limits.fitted import Fitting, keep_errors, squares

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
