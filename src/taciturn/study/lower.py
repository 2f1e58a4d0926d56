"""Lower bounds on the cost: whether they are computed, and the notes on them and on the certified rate."""

from __future__ import annotations

from dataclasses import replace

from taciturn._progress import Progress
from taciturn._text import magnitude
from taciturn.analyse.limits import LEVEL, LowerBound, bound_below, resets
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.estimate import Estimate
from taciturn.problem import Problem
from taciturn.renewal.policy import EventPolicy, OptimalPolicy
from taciturn.study.units import TimeUnit

CONTRADICTION = 3.0  # standard errors by which a rate that is outside its certified bounds deserves a note
SAME = 1e-9  # relative difference of two rates that is a rounding error


def choose_confidence(problem: Problem, asked: float | None) -> float | None:
    """Return the confidence of a lower bound: as requested, or the default if a bound exists; None: no bound."""
    if asked is not None:
        return asked or None
    try:
        expect_bound(problem)
    except ProblemError:
        return None
    return LEVEL


def expect_bound(problem: Problem) -> None:
    """Reject a problem without a lower bound on the cost of any scheduling.

    Raises:
        ProblemError: the problem has no lower bound; the message gives the reason.
    """
    policy = problem.designed()
    if isinstance(policy, EventPolicy):
        raise ProblemError(
            f"a lower bound is requested, but none is available for {policy.kind} without a period; expected no "
            "confidence level"
        )
    resets(problem.close(policy.looked_at if isinstance(policy, OptimalPolicy) else policy))


def bounded(loop: Loop, rate: Estimate, confidence: float, seed: int, progress: Progress) -> LowerBound:
    """Return the lower bound at a measured rate, evaluated at the upper confidence limit of this rate.

    Raises:
        ProblemError: nothing is sent, or no bound exists.
    """
    if rate.value == 0:
        raise ProblemError("nothing is sent")
    from statistics import NormalDist  # which most evaluations do not need

    lower = bound_below(loop, min(rate.value, 1.0), confidence, seed, progress)
    margin = NormalDist().inv_cdf(confidence) * rate.standard_error + rate.error
    return replace(lower, cost=max(lower.at_rate(rate.value + max(margin, 0.0)), loop.policy.cost_all_time))


def contradicted(rate: Estimate, certified: tuple[float, float], unit: TimeUnit) -> tuple[str, ...]:
    """Return a warning if a simulated rate is at least three standard errors outside its certified bounds.

    Args:
        rate: the simulated rate, per unit of time.
        certified: its certified bounds.
        unit: the unit of time.
    """
    nearest = min(max(rate.value, certified[0]), certified[1])
    gap, error = abs(rate.value - nearest), rate.standard_error
    if rate.method != "simulation" or gap < CONTRADICTION * error or gap <= SAME * nearest:
        return ()
    decimals = max(0, 1 - magnitude(gap), 1 - magnitude(error) if error else 0)
    low, high = (f"{bound:.{decimals}f}" for bound in certified)
    off = f"{gap / error:.2g} standard errors " if error else ""
    shown = rate if error else f"{rate.value:.{decimals}f}"
    return (
        f"the simulated rate {shown} per {unit} is {off}outside its certified bounds {low} to {high}; the bounds are "
        "correct: the send intervals are so regular that the initial transient does not decay within the run",
    )
