"""A quick evaluation within a search, as precise as the search needs."""

from __future__ import annotations

from taciturn._progress import Progress
from taciturn.analyse.renewal import decides_alone, expect_affordable
from taciturn.errors import ProblemError
from taciturn.model.policy import Policy
from taciturn.problem import Problem
from taciturn.renewal.chain import NoQuadratureError
from taciturn.renewal.policy import OptimalPolicy
from taciturn.study.evaluate import evaluate
from taciturn.study.evaluation import Evaluation

ROUGHLY = 1e-5  # relative accuracy of the cost in a trial by quadrature


def look_at(
    problem: Problem, seed: int, steps: int | None, standard_error: float | None, progress: Progress | None = None
) -> Evaluation:
    """Return an evaluation by quadrature if one applies, else by a simulation of the given number of steps.

    Args:
        problem: the problem to evaluate.
        seed: seed of the random draws.
        steps: number of steps of the simulation; None for full precision, also of the quadrature.
        standard_error: absolute standard error of the cost at full precision.
        progress: callback that receives the fraction done.
    """
    policy = problem.designed()
    if isinstance(policy, OptimalPolicy) or (isinstance(policy, Policy) and _serves(problem, policy)):
        wanted = standard_error if steps is None else ROUGHLY * abs(policy.cost_all_time) or None
        try:
            found = evaluate(
                problem, seed=seed, method="exact", standard_error=wanted, after_step=False, progress=progress
            )
        except ProblemError:
            if isinstance(policy, OptimalPolicy):
                raise
        else:
            if found.reached or isinstance(policy, OptimalPolicy):
                return found
    return evaluate(problem, seed=seed, steps=steps, standard_error=standard_error, after_step=False, progress=progress)


def _serves(problem: Problem, policy: Policy) -> bool:
    """Return whether a quadrature may be quicker than a simulation."""
    if not decides_alone(policy):
        return False
    try:
        expect_affordable(problem.close(policy))
    except NoQuadratureError:
        return False
    return True
