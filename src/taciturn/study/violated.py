"""Probabilities of the violation of a problem's limits, as part of an evaluation."""

from __future__ import annotations

from dataclasses import replace

from taciturn._progress import OutOfTime, Progress, late_text
from taciturn.errors import ProblemError, TaciturnError
from taciturn.model.limits import Limits
from taciturn.model.policy import Policy
from taciturn.problem import Problem
from taciturn.simulation.violations import violations
from taciturn.study.evaluation import Evaluation
from taciturn.study.measure import Request


def with_violations(
    problem: Problem, limits: Limits, request: Request, found: Evaluation, progress: Progress
) -> Evaluation:
    """Return an evaluation with the probabilities that limits are violated, or with a note that tells why not.

    Args:
        problem: the problem.
        limits: its limits.
        request: seed and number of steps.
        found: the evaluation of cost and rates.
        progress: callback that receives the fraction done.
    """
    policy = problem.designed()
    try:
        if not isinstance(policy, Policy):
            raise ProblemError(
                f"limits are given, and {policy.kind} has no steps that can be simulated; expected a policy with a "
                "period, such as near-optimal"
            )
        seen = violations(problem.close(policy), limits, seed=request.seed, steps=request.steps, progress=progress)
    except TaciturnError as error:
        return replace(found, notes=(*found.notes, f"no probability of violation: {error}"))
    except OutOfTime:
        late = f"{late_text()}; expected a longer one"
        return replace(found, notes=(*found.notes, f"no probability of violation: {late}"))
    return replace(found, violations=seen)
