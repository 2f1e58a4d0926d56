"""Units of costs and rates: per step, per second, or per finite-horizon run."""

from __future__ import annotations

from typing import Literal, TypeAlias

from taciturn.model.plant import ContinuousPlant
from taciturn.problem import Problem

TimeUnit: TypeAlias = Literal["step", "second"]
Unit: TypeAlias = Literal["step", "second", "mission"]


def time_unit(problem: Problem) -> TimeUnit:
    """Return the unit of time of a problem's cost weights and average cost."""
    return "second" if isinstance(problem.plant, ContinuousPlant) else "step"


def cost_unit(problem: Problem) -> Unit:
    """Return the unit that a problem's cost refers to; the cost of a finite-horizon run is a total."""
    return "mission" if problem.cost.mission else time_unit(problem)


def rate_unit(unit: Unit) -> TimeUnit:
    """Return the unit of time of a rate for a given unit of the cost; rates of a finite-horizon run are per step."""
    return "step" if unit == "mission" else unit
