"""Period and threshold together: how often to look at an error that is sent at a given rate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from taciturn._arrays import number
from taciturn._progress import Progress
from taciturn.errors import ProblemError
from taciturn.model.plant import ContinuousPlant
from taciturn.model.policy import LinkName
from taciturn.problem import Problem, expect_problem
from taciturn.study.tune import Tuned, tune

FASTER = 2.0  # from one period to the next
ENOUGH = 0.01  # of what the cost is above that of sending always: a gain that ends the search
MOST = 20


@dataclass(frozen=True, eq=False)
class TunedPeriod:
    """The period of the checks and the parameter that meet a rate at the least cost.

    Args:
        best: of all that were tried.
        tried: from the longest period to the shortest, all at the rate asked for.
    """

    best: Tuned
    tried: tuple[Tuned, ...]

    def document(self) -> dict[str, Any]:
        """Return the JSON document of ``taciturn tune --least-period --json``."""
        rows = [
            {
                "period": one.problem.parameters["period"],
                one.parameter.name: one.parameter.value,
                "cost": one.evaluation.cost.value,
                "consistency": one.evaluation.consistency,
            }
            for one in self.tried
        ]
        return {"period": self.best.problem.parameters["period"]} | self.best.document() | {"periods": rows}


def tune_period(
    problem: Problem,
    *,
    rate: float,
    least: float,
    link: LinkName | None = None,
    seed: int = 0,
    standard_error: float | None = None,
    progress: Progress | None = None,
) -> TunedPeriod:
    """Return the period and the parameter with which a policy sends at a rate and costs least.

    The theorem of ``consistent`` ties δ to the period τ. At an equal rate it costs less to look more often and to ask
    for more: τ is halved, δ found anew from the exact rate, until a halving gains less than a hundredth of what the
    cost is above sending always, or τ would be below the least one. Whether the result is consistent is then verified
    by its numbers (``Evaluation.consistency``) and no longer guaranteed.

    Args:
        problem: a continuous plant, and a policy that looks every ``period``, from which the search starts.
        rate: sends per second.
        least: the shortest period that may be asked of the sensor, in seconds.
        link: whose rate; omitted where the policy decides one only.
        seed: of the draws, where anything is simulated.
        standard_error: absolute, of the cost; omitted: 1e-4 of it.
        progress: called with the fraction done.

    Raises:
        ProblemError: no period to seek, no rate that can be met, or a least period above the one to start from.

    Source: khashooei2017

    Example:
        >>> from taciturn import ContinuousPlant, Cost, Network
        >>> walk, cost = ContinuousPlant([[0.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
        >>> problem = Problem(walk, cost, Network(), "consistent", {"period": 0.5})
        >>> found = tune_period(problem, rate=1.0, least=0.1)
        >>> found.best.problem.parameters["period"], found.best.evaluation.consistency
        (0.125, 'verified')
    """
    expect_problem("problem", problem)
    period = problem.parameters.get("period")
    if not isinstance(problem.plant, ContinuousPlant) or not isinstance(period, int | float):
        raise ProblemError(
            f"{problem.kind} has no period here, which is to be sought; expected a continuous plant and policy.period"
        )
    rate, least = number("rate", rate, 0.0), number("least", least, 0.0)
    period = min(float(period), 1 / (FASTER * rate))
    if period < least:
        raise ProblemError(
            f"the least period is {least:g} s, and {rate:g} sends per second want one of at most {period:g} s to start "
            "from; expected a shorter least period, or a lower rate"
        )
    tried: list[Tuned] = []
    parameters = dict(problem.parameters)
    while period >= least and len(tried) < MOST:
        here = problem.changed({**parameters, "period": period})

        def report(fraction: float, done: int = len(tried)) -> None:
            if progress is not None:
                progress(1 - 0.7 ** (done + fraction))  # how many there will be is not known

        found = tune(here, rate=rate, link=link, seed=seed, standard_error=standard_error, progress=report)
        tried.append(found)
        if len(tried) > 1 and not _gains(tried[-2], found):
            break
        name, value = found.parameter.name, found.parameter.value
        if isinstance(value, float) and name == "delta":
            value /= FASTER  # δ is a cost per look: the same error is sent
        parameters[name] = value
        period /= FASTER
    best = min(tried, key=lambda one: one.evaluation.cost.value)
    return TunedPeriod(best, tuple(tried))


def _gains(before: Tuned, after: Tuned) -> bool:
    """Tell whether a shorter period is worth the next."""
    cost, base = after.evaluation.cost, after.evaluation.cost_all_time
    above = cost.value - (0.0 if base is None else base)
    return before.evaluation.cost.value - cost.value > max(ENOUGH * above, cost.standard_error)
