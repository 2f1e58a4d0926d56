"""Lower bounds on the cost: whether they are computed, and the notes on them and on the certified rate."""

from __future__ import annotations

from dataclasses import replace
from statistics import NormalDist

from taciturn._progress import Progress
from taciturn.analyse.limits import USUAL, LowerBound, bound_below, resets
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.estimate import Estimate
from taciturn.problem import Problem
from taciturn.renewal.policy import EventPolicy, OptimalPolicy


def choose_confidence(problem: Problem, asked: float | None) -> float | None:
    """Return the confidence of a lower bound: as requested, or the default if a bound exists; None: no bound."""
    if asked is not None:
        return asked or None
    try:
        expect_bound(problem)
    except ProblemError:
        return None
    return USUAL


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
    lower = bound_below(loop, min(rate.value, 1.0), confidence, seed, progress)
    margin = NormalDist().inv_cdf(confidence) * rate.standard_error + rate.error
    return replace(lower, cost=max(lower.at_rate(rate.value + max(margin, 0.0)), loop.policy.cost_all_time))


def contradicted(rate: Estimate, certified: tuple[float, float] | None) -> tuple[str, ...]:
    """Return a warning if a simulated rate is outside its certified bounds."""
    if certified is None or rate.method != "simulation" or certified[0] <= rate.value <= certified[1]:
        return ()
    nearest = min(certified, key=lambda end: abs(end - rate.value))
    off = abs(nearest - rate.value) / max(rate.standard_error, 1e-300)
    return (
        f"the simulated rate is {off:.2g} standard errors outside its certified bounds; the bounds are correct: the "
        "send intervals are so regular that the initial transient does not decay within the run",
    )
