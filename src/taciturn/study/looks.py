"""One look of a search: quick, and as precise as a search needs."""

from __future__ import annotations

from taciturn.analyse.renewal import decides_alone, expect_affordable
from taciturn.errors import ProblemError
from taciturn.model.policy import Policy
from taciturn.problem import Problem
from taciturn.renewal.chain import NoQuadratureError
from taciturn.renewal.policy import OptimalPolicy
from taciturn.study.evaluate import Evaluation, evaluate

ROUGHLY = 1e-5  # of the cost: the accuracy of a look that needs no draws


def look_at(problem: Problem, seed: int, steps: int | None, standard_error: float | None) -> Evaluation:
    """Return an evaluation by quadrature where one serves, else by so many steps on the draws of the seed.

    Args:
        problem: its policy.
        seed: of the draws.
        steps: of the simulation; None asks for full precision, of the quadrature too.
        standard_error: absolute, of the cost, with full precision.
    """
    policy = problem.designed()
    if isinstance(policy, OptimalPolicy) or (isinstance(policy, Policy) and _serves(problem, policy)):
        wanted = standard_error if steps is None else ROUGHLY * abs(policy.cost_all_time) or None
        try:
            found = evaluate(problem, seed=seed, method="exact", standard_error=wanted)
        except ProblemError:
            if isinstance(policy, OptimalPolicy):
                raise
        else:
            if found.reached or isinstance(policy, OptimalPolicy):
                return found
    return evaluate(problem, seed=seed, steps=steps, standard_error=standard_error)


def _serves(problem: Problem, policy: Policy) -> bool:
    """Tell whether a quadrature may be quicker than a simulation."""
    if not decides_alone(policy):
        return False
    try:
        expect_affordable(problem.close(policy))
    except NoQuadratureError:
        return False
    return True
