"""A quick evaluation within a search, as precise as the search needs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from taciturn._progress import Progress
from taciturn.analyse.renewal import decides_alone, expect_affordable
from taciturn.errors import ProblemError, UnstableError
from taciturn.model.policy import Policy
from taciturn.problem import Problem
from taciturn.renewal.chain import NoQuadratureError
from taciturn.renewal.policy import OptimalPolicy
from taciturn.study.evaluate import evaluate
from taciturn.study.evaluation import Evaluation

ROUGHLY = 1e-5  # relative accuracy of the cost in a trial by quadrature
ALIKE = 1e-3  # share of the range of all results within which a result counts as an end of this range
TINY = 1e-300  # in place of a value of 0, which has no logarithm
LONGER = 8  # factor on the steps of a trial if the loop has not settled


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
    if isinstance(policy, Policy) and policy.theory.cost_all_time == 0:
        raise ProblemError(
            "sending every sample costs nothing, so that no budget determines a parameter; expected noise W or V that "
            "the cost depends on"
        )
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


def settled(
    problem: Problem, tuned: str, seed: int, steps: int, progress: Progress | None = None, longer: int = LONGER
) -> Evaluation:
    """Return the evaluation of a loop that settles.

    Args:
        problem: the problem to evaluate.
        tuned: name of the parameter that is tuned.
        seed: seed of the random draws.
        steps: number of steps of the simulation.
        progress: callback that receives the fraction done.
        longer: factor on the steps of a second simulation, if the loop has not settled in the first.

    Raises:
        UnstableError: the loop diverges or does not settle.
    """
    found = look_at(problem, seed, steps, None, progress)
    if not found.reached and longer > 1:
        found = look_at(problem, seed, longer * steps, None, progress)
    if not found.reached:
        given = f"{problem.kind} with {tuned} = {problem.parameters[tuned]:g}"
        raise UnstableError(f"the mean cost of {given} does not settle within {longer * steps} steps")
    return found


def out_of_reach(
    policy: str, tuned: str, name: str, budget: float, tried: Sequence[tuple[float, float]], failed: str = ""
) -> ProblemError:
    """Return an error that states the range that can be reached.

    Args:
        policy: kind of the policy.
        tuned: name of the parameter that is tuned.
        name: name of the quantity that has a budget.
        budget: the budget.
        tried: values of the parameter, each with the quantity that it gives; the first one is where a search began.
        failed: why other values give no policy.
    """
    found, first = sorted(value for _, value in tried), np.log(max(tried[0][0], TINY))
    same = ALIKE * (found[-1] - found[0])

    def end(limit: float) -> str:
        values = [value for value, given in tried if abs(given - limit) <= same]
        return f"{limit:.5g} ({tuned} = {min(values, key=lambda value: abs(np.log(max(value, TINY)) - first)):.4g})"

    near = [value for value in found if value < budget][-1:] + [value for value in found if value > budget][:1]
    expected = "within this range" if len(near) < 2 else f"such as {near[0]:.5g} or {near[1]:.5g}, the nearest found"
    return ProblemError(
        f"no {tuned} gives {policy} the {name} {budget:g}: the {name} ranges from {end(found[0])} to {end(found[-1])}"
        f"{f', and other values fail ({failed})' if failed else ''}; expected a {name} {expected}"
    )


def _serves(problem: Problem, policy: Policy) -> bool:
    """Return whether a quadrature may be quicker than a simulation."""
    if not decides_alone(policy):
        return False
    try:
        expect_affordable(problem.close(policy))
    except NoQuadratureError:
        return False
    return True
