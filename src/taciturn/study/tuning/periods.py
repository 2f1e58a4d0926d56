"""Joint tuning of the period of the checks and the threshold, at a given rate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from taciturn._arrays import number
from taciturn._progress import Progress, answered_within
from taciturn._text import pairs_text, table_text
from taciturn.errors import ProblemError
from taciturn.lqg.regulation import has_average
from taciturn.model.plant import ContinuousPlant
from taciturn.model.table import Columns, Tabular, columns_of
from taciturn.problem.bare import Studied, as_problem
from taciturn.study.tuning.tune import Tuned, tune

FASTER = 2.0  # from one period to the next
ENOUGH = 0.01  # share of the excess over the cost of sending every sample: a smaller gain ends the search
MOST = 20


@dataclass(frozen=True, eq=False, repr=False)
class TunedPeriod(Tabular):
    """The period of the checks and the parameter that meet a rate at the least cost.

    Args:
        best: the result with the least cost.
        tried: all results, from the longest period to the shortest, all at the requested rate.
    """

    best: Tuned
    tried: tuple[Tuned, ...]

    def columns(self) -> Columns:
        """Return one row per period: the parameter, the cost, and whether the policy is consistent."""
        return columns_of(
            [
                {
                    "period": one.problem.parameters["period"],
                    one.parameter.name: one.parameter.beside(None),
                    "cost": one.evaluation.cost,
                    "consistency": one.evaluation.consistency,
                }
                for one in self.tried
            ]
        )

    def __str__(self) -> str:
        """Return the text that ``taciturn tune --least-period`` prints."""
        return periods_text(self)

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
    problem: Studied,
    *,
    rate: float,
    least: float,
    link: str | None = None,
    seed: int = 0,
    standard_error: float | None = None,
    time_limit: float | None = None,
    progress: Progress | None = None,
) -> TunedPeriod:
    """Return the period and the parameter with which a policy sends at a rate and costs least.

    The theorem of ``consistent`` relates δ to the period τ. At an equal rate, more frequent checks with a larger
    threshold cost less. So τ is halved, and δ is determined again from the exact rate, until a halving reduces the
    excess over the cost of sending every sample by less than a hundredth, or until τ would be below ``least``. The
    consistency of the result is then verified numerically (``Evaluation.consistency``) and no longer guaranteed.

    Args:
        problem: a problem with a continuous plant and a policy that checks every ``period``, the start of the search.
        rate: sends per second.
        least: the shortest period of the sensor, in seconds.
        link: link whose rate is meant; may be omitted if the policy decides on a single link.
        seed: seed of the random draws, if anything is simulated.
        standard_error: absolute standard error of the cost; default: 1e-4 of the cost.
        time_limit: time limit in seconds; default: none. Without a result in time, an error is raised.
        progress: callback that receives the fraction done.

    Raises:
        ProblemError: the policy has no period, the rate cannot be met, or ``least`` is above the period at the start.

    Source: khashooei2017

    Example:
        >>> from taciturn import ContinuousPlant, Cost, Network, Problem
        >>> walk, cost = ContinuousPlant([[0.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
        >>> problem = Problem(walk, cost, Network(), "consistent", {"period": 0.5})
        >>> found = tune_period(problem, rate=1.0, least=0.1)
        >>> found.best.problem.parameters["period"], found.best.evaluation.consistency
        (0.125, 'verified')
    """
    with answered_within(time_limit):
        problem = as_problem("problem", problem)
        period = problem.parameters.get("period")
        if not isinstance(problem.plant, ContinuousPlant) or not isinstance(period, int | float):
            raise ProblemError(
                f"{problem.kind} has no period to tune here; expected a continuous plant and policy.period"
            )
        if not has_average(problem.plant, problem.cost):
            raise ProblemError(
                "the cost is that at the sampling instants, because the disturbances change the input that they need "
                "between samples and grow without limit, so costs of several periods cannot be compared; expected "
                "disturbances that are constant or decay, or a given period"
            )
        rate, least = number("rate", rate, 0.0), number("least", least, 0.0)
        period = min(float(period), 1 / (FASTER * rate))
        if period < least:
            raise ProblemError(
                f"the least period is {least:g} s, but at {rate:g} sends per second the search starts from at most "
                f"{period:g} s; expected a shorter least period, or a lower rate"
            )
        tried: list[Tuned] = []
        parameters = dict(problem.parameters)
        while period >= least and len(tried) < MOST:
            here = problem.changed({**parameters, "period": period})

            def report(fraction: float, done: int = len(tried)) -> None:
                if progress is not None:
                    progress(1 - 0.7 ** (done + fraction))  # the number of periods is not known in advance

            found = tune(here, rate=rate, link=link, seed=seed, standard_error=standard_error, progress=report)
            tried.append(found)
            if len(tried) > 1 and not _gains(tried[-2], found):
                break
            name, value = found.parameter.name, found.parameter.value
            if isinstance(value, float) and name == "delta":
                value /= FASTER  # δ is a cost per check, so this threshold sends the same error
            parameters[name] = value
            period /= FASTER
        best = min(tried, key=lambda one: one.evaluation.cost.value)
        return TunedPeriod(best, tuple(tried))


def _gains(before: Tuned, after: Tuned) -> bool:
    """Return whether the last halving of the period gained enough to try another one."""
    cost, base = after.evaluation.cost, after.evaluation.cost_all_time
    above = cost.value - (0.0 if base is None else base)
    return before.evaluation.cost.value - cost.value > max(ENOUGH * above, cost.standard_error)


def periods_text(found: TunedPeriod) -> str:
    """Return the periods that were tried at a given rate, and the best of them."""
    names = ["period", found.best.parameter.name, "cost", "consistent"]
    rows = [
        [
            f"{one.problem.parameters['period']:g}",
            one.parameter.beside(None),
            str(one.evaluation.cost),
            one.evaluation.consistency or "",
        ]
        for one in found.tried
    ]
    period = pairs_text([("period", f"{found.best.problem.parameters['period']:g}")])
    return "\n".join([table_text(names, rows, 1), period, str(found.best)])
