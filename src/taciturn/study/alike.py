"""Check that problems can be compared: the same plant, cost, network and limits, and different policies."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, cast

import numpy as np

from taciturn._arrays import instance
from taciturn.errors import ProblemError
from taciturn.lqg.regulation import has_average
from taciturn.model.plant import ContinuousPlant
from taciturn.problem import Problem
from taciturn.problem.bare import Studied, as_problem


def comparable(given: Mapping[str, Studied], link: str | None, budget: str = "rate") -> dict[str, Problem]:
    """Return the problems to compare by name, at the same ``budget``: the rate or the traffic.

    Raises:
        ProblemError: if they cannot be compared.
    """
    instance("problems", given, Mapping)
    problems = {name: as_problem(f"problems[{name!r}]", problem) for name, problem in given.items()}
    if len(problems) < 2:
        raise ProblemError(f"the number of policies is {len(problems)}; expected at least two policies to compare")
    for (one, first), (other, second) in itertools.combinations(problems.items(), 2):
        for what in ("plant", "actual", "cost", "network", "reference", "limits"):
            if not _same(getattr(first, what), getattr(second, what)):
                tables = {"actual": "[plant.actual]", "network": "[network], [nodes] or [links]"}
                where = tables.get(what, f"[{what}]")
                raise ProblemError(f"{one} and {other} differ in {where}; expected the same in all problems")
        periods = [each.parameters.get("period") for each in (first, second)]
        if periods[0] != periods[1] and not has_average(first.plant, first.cost):
            raise ProblemError(
                f"{one} has the period {periods[0]} and {other} {periods[1]}, but the cost is that at the sampling "
                "instants, because the disturbances change the input that they need between samples and grow without "
                "limit; expected equal periods, or disturbances that are constant or decay"
            )
        if first.record is second.record and _same(_fixed(first, link), _fixed(second, link)):
            raise ProblemError(
                f"{one} and {other} are the same policy, {first.kind}, at the same {budget}; expected policies that "
                "differ in more than the tuned parameter"
            )
    return problems


def measuring_alike(problems: Mapping[str, Problem]) -> dict[str, list[Problem]]:
    """Return the variants of each problem; periodic control gets a variant that measures as often as the others."""
    given = [problem.parameters.get("period") for problem in problems.values()]
    periods = [period for period in given if isinstance(period, int | float)]
    found = {name: [problem] for name, problem in problems.items()}
    for name, problem in problems.items():
        plant, tunings = problem.plant, [tuning for tuning in problem.record.tuning if tuning.cycles]
        seen_in_part = isinstance(plant, ContinuousPlant) and not plant.full_state
        if tunings and seen_in_part and periods and tunings[0].name not in problem.parameters:
            found[name].append(problem.changed({"period": min(periods), tunings[0].name: 1}))
    return found


def _fixed(problem: Problem, link: str | None) -> dict[str, object]:
    """Return the parameters that are not tuned, with their defaults if they are not given."""
    defaults = {
        key: parameter.default
        for key, parameter in problem.record.arguments.items()
        if parameter.default is not parameter.empty
    }
    tuned = {tuning.name for tuning in problem.record.tuning if link is None or tuning.link in (None, link)}
    return {key: value for key, value in (defaults | dict(problem.parameters)).items() if key not in tuned}


def _same(one: object, other: object) -> bool:
    """Return whether two values are equal; they may be data classes with arrays."""
    if is_dataclass(one) and type(one) is type(other):
        return all(_same(getattr(one, part.name), getattr(other, part.name)) for part in fields(one))
    if isinstance(one, dict) and isinstance(other, dict):
        known, found = cast("dict[str, object]", one), cast("dict[str, object]", other)
        return known.keys() == found.keys() and all(_same(value, found[key]) for key, value in known.items())
    return bool(np.array_equal(cast("Any", one), cast("Any", other)))
