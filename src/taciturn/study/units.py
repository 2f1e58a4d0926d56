"""Units of costs and rates: per step, per second, per second at the sampling instants, or per finite-horizon run."""

from __future__ import annotations

from typing import Literal, TypeAlias

from taciturn.lqg.regulation import has_average
from taciturn.model.plant import ContinuousPlant
from taciturn.problem import Problem

TimeUnit: TypeAlias = Literal["step", "second"]
Unit: TypeAlias = Literal["step", "second", "second at the sampling instants", "mission"]


def time_unit(problem: Problem) -> TimeUnit:
    """Return the unit of time of a problem's cost weights and average cost."""
    return "second" if isinstance(problem.plant, ContinuousPlant) else "step"


def cost_unit(problem: Problem) -> Unit:
    """Return the unit that a problem's cost refers to; the cost of a finite-horizon run is a total.

    If the integral of the cost has no average, the cost is that of the deviations at the sampling instants.
    """
    if problem.cost.mission:
        return "mission"
    integrated = all(has_average(plant, problem.cost) for plant in (problem.plant, problem.actual) if plant is not None)
    return time_unit(problem) if integrated else "second at the sampling instants"


def rate_unit(unit: Unit) -> TimeUnit:
    """Return the unit of time of a rate for a given unit of the cost; rates of a finite-horizon run are per step."""
    return "second" if unit.startswith("second") else "step"
