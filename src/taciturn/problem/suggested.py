"""The required parameters of a policy kind, and suggested initial values."""

from __future__ import annotations

import inspect
from collections.abc import Mapping

from taciturn._modes import radius
from taciturn.design.catalogue import CATALOGUE
from taciturn.design.periodic import all_time
from taciturn.errors import TaciturnError
from taciturn.lqg.riccati import regulate_continuous
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant

LOOKS = 5  # checks per time constant of the fastest mode of the controlled plant
SHARE = 0.2  # suggested price of a send, relative to the cost of a step with every sample
USUAL: Mapping[str, float | int] = {
    "theta": 0.1,
    "sigma": 0.1,
    "rho": 0.5,
    "gain": 2.0,
    "beta": 1.2,
    "every": 2,
    "length": 5,
    "sends": 2,
    "horizon": 4,
    "max_interval": 5,
    "fast": 1,
    "slow": 2,
}
ALTERNATIVES = {"remote-lqg": ("theta", "zeta"), "excess": ("theta",), "periodic": ("every",)}
"""Parameters that are optional in a design function with alternatives; these are the usual choice."""


def needed_parameters(kind: str, continuous: bool) -> tuple[str, ...]:
    """Return the required parameters of a policy kind for a discrete or continuous plant.

    Example:
        >>> needed_parameters("lqg", continuous=True)
        ('period', 'theta')
    """
    known = {
        name: parameter
        for name, parameter in inspect.signature(CATALOGUE[kind]).parameters.items()
        if parameter.kind is parameter.KEYWORD_ONLY
    }
    needed = [name for name, parameter in known.items() if parameter.default is parameter.empty and name != "period"]
    needed += [name for name in ALTERNATIVES.get(kind, ()) if name != "every" or not continuous]
    asked = "period" in known and (continuous or known["period"].default is inspect.Parameter.empty)
    period = ["period"] if asked else []
    return (*period, *needed)


def suggest_value(name: str, plant: Plant | ContinuousPlant, cost: Cost, period: float | None) -> float | int | None:
    """Return a suggested value: a usual value, or one digit computed from plant and cost; None if there is none.

    Args:
        name: name of the parameter.
        plant: the plant.
        cost: the cost.
        period: seconds between steps of a continuous plant, if already known.
    """
    if name in USUAL:
        return USUAL[name]
    try:
        if name == "period" and isinstance(plant, ContinuousPlant):
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
