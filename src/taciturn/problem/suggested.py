"""The required parameters of a policy kind, and suggested initial values."""

from __future__ import annotations

from typing import Any

from taciturn._arrays import is_definite
from taciturn._modes import pace, radius
from taciturn.design.catalogue import CATALOGUE
from taciturn.design.kind import Kind, Setting
from taciturn.design.kinds.all_time import all_time
from taciturn.errors import ProblemError, TaciturnError
from taciturn.lqg.riccati import regulate_continuous
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.problem import Problem, load

LOOKS = 5  # checks per time constant of the fastest mode of the controlled plant
SHARE = 0.2  # suggested price of a send, relative to the cost of a step with every sample


def needed_parameters(kind: Kind, continuous: bool) -> tuple[str, ...]:
    """Return the required parameters of a policy kind for a discrete or continuous plant.

    Example:
        >>> from taciturn.design.catalogue import CATALOGUE
        >>> needed_parameters(CATALOGUE["lqg"], continuous=True)
        ('period', 'theta')
    """
    required = [name for name, one in kind.parameters.items() if one.default is one.empty]
    period = ["period"] if "period" in kind.parameters and (continuous or "period" in required) else []
    needed = (*period, *(name for name in required if name != "period"))
    tunings = {tuning.name: tuning for tuning in kind.tuning if tuning.continuous in (None, continuous)}
    met = {tunings[name].link for name in needed if name in tunings}
    return (*needed, *(name for name in kind.asked if tunings[name].link not in met))


def offered_kinds() -> tuple[list[Kind], list[str]]:
    """Return the kinds that ``taciturn new`` offers by their goals, in order, and why others cannot be offered."""
    found: list[tuple[int, Kind]] = []
    wrong: list[str] = []
    for name in CATALOGUE:
        try:
            kind = CATALOGUE[name]
        except ProblemError as error:
            wrong.append(str(error))
        else:
            found += [] if kind.offered is None else [(kind.offered, kind)]
    return [kind for _, kind in sorted(found, key=lambda one: (one[0], one[1].name))], wrong


def over_losses() -> list[Kind]:
    """Return the offered kinds for links that drop packets."""
    return [kind for kind in offered_kinds()[0] if kind.for_dropouts]


def suggest_value(
    kind: Kind, name: str, plant: Plant | ContinuousPlant, cost: Cost, period: float | None
) -> Setting | None:
    """Return a suggested value: a usual value, or one digit computed from plant and cost; None if there is none.

    Args:
        kind: the policy kind.
        name: name of the parameter.
        plant: the plant.
        cost: the cost.
        period: seconds between steps of a continuous plant, if already known.
    """
    if name in kind.usual:
        return kind.usual[name]
    try:
        if name == "period" and isinstance(plant, ContinuousPlant):
            fastest = pace(plant.A)
            if is_definite(cost.R):  # otherwise the loop is as fast as the period allows
                L = regulate_continuous(plant.A, plant.B, cost.Q, cost.R, cost.N).L
                fastest = radius(plant.A + plant.B @ L)
            return _digit(1 / (LOOKS * fastest)) if fastest > 0 else None
        if name in ("price", "zeta"):
            always = all_time(plant, cost, period=period)
            return _digit(SHARE * always.cost_all_time * always.tick) if always.cost_all_time > 0 else None
    except TaciturnError:  # the design reports the error
        return None
    return None


def _digit(value: float) -> float:
    """Return a number rounded to one significant digit."""
    return float(f"{value:.1g}")


def example_of(kind: Kind) -> Problem:
    """Return the example of a policy kind: a built-in problem with this kind and the parameters of the example."""
    problem = load(kind.built_in)
    removed: dict[str, Any] = dict.fromkeys(problem.parameters)
    return problem.changed({**removed, "kind": kind.name, **kind.example})
