"""What costs and rates count per: a step, a second, or a mission."""

from __future__ import annotations

from typing import Literal, TypeAlias

from taciturn.loop import Loop
from taciturn.model.plant import ContinuousPlant
from taciturn.problem import Problem

TimeUnit: TypeAlias = Literal["step", "second"]
Unit: TypeAlias = Literal["step", "second", "mission"]


def time_unit(problem: Problem) -> TimeUnit:
    """Return what the weights of a problem's cost count per, and averages with them."""
    return "second" if isinstance(problem.plant, ContinuousPlant) else "step"


def cost_unit(problem: Problem) -> Unit:
    """Return what a problem's cost counts per: that of a mission is a total."""
    return "mission" if problem.cost.mission else time_unit(problem)


def rate_unit(unit: Unit) -> TimeUnit:
    """Return what a rate counts per beside a cost in this unit: the steps of a mission."""
    return "step" if unit == "mission" else unit


def base_rate(loop: Loop) -> float:
    """Return the rate of sending at every tick."""
    return 1.0 if loop.problem.cost.mission else 1 / loop.policy.tick
