"""Notes on values that were given, but have no effect on the result."""

from __future__ import annotations

from collections.abc import Mapping

from taciturn.problem import Problem


def without_effect(asked: Mapping[str, object], method: str) -> tuple[str, ...]:
    """Return a note on simulation options that were given although another method gave the answer."""
    given = [f"{name} = {value}" for name, value in asked.items() if value is not None]
    if not given or method == "simulation":
        return ()
    return (f"{' and '.join(given)} had no effect: no loop was simulated",)


def forgotten_start(problem: Problem) -> tuple[str, ...]:
    """Return a note if an initial state is given, which no average cost depends on."""
    plant = problem.plant if problem.actual is None else problem.actual
    given = [name for name, value in (("mean", plant.mean), ("covariance", plant.covariance)) if value.any()]
    if not given or problem.cost.horizon is not None or problem.cost.discount < 1:
        return ()
    return (f"{' and '.join(f'initial.{name}' for name in given)} had no effect: the cost is an average over all time",)
