"""Optimal periodic control at the rate of another policy: what every trade-off is measured by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taciturn.design.certainty import Actuation
from taciturn.design.periodic import periodic
from taciturn.errors import TaciturnError
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant
from taciturn.problem import Problem

CURVE_POINTS = 40  # at most where the plant is discrete
PREDICTING = ("consistent", "integral", "near-optimal", "optimal")  # kinds whose actuator always does


@dataclass(frozen=True)
class PeriodicPoint:
    """Optimal periodic control at one rate: exact cost."""

    rate: float
    cost: float


def actuation_of(problem: Problem) -> Actuation:
    """Return how the actuator of a problem's policy fills the time between sends."""
    predicts = problem.parameters.get("actuation") == "model" or problem.kind in PREDICTING
    return "model" if predicts else "hold"


def periodic_cost_at(problem: Problem, rate: float, actuation: Actuation) -> float | None:
    """Return the exact cost of optimal periodic control at a rate, or None where there is none (rate 0, or unstable).

    A discrete plant has the rates 1/k only; between them two controllers share the time over long phases, which
    interpolates rate and cost linearly; an interval at which sampling loses a mode is passed over.

    Args:
        problem: its plant and cost.
        rate: sends per step or per second.
        actuation: of the periodic controller.

    Returns:
        The cost; none where the loop of a periodic policy would not be the one of its design: over links that lose, of
        inputs that are clipped, of a plant that is not linear or not the one of the design.
    """
    if rate <= 0:
        return None
    if isinstance(problem.plant, ContinuousPlant):
        return _cost(problem, 1 / rate, actuation)
    every = int(np.floor(1 / rate * (1 + 1e-12)))
    faster = _first_stable(problem, range(every, 0, -1), actuation)
    if faster is None or faster.rate == rate:
        return None if faster is None else faster.cost
    slower = _first_stable(problem, range(every + 1, 2 * every + 8), actuation)
    if slower is None:
        return None
    share = (rate - slower.rate) / (faster.rate - slower.rate)
    return share * faster.cost + (1 - share) * slower.cost


def why_no_periodic(problem: Problem, actuation: Actuation) -> str | None:
    """Return why there is no periodic control whose actuator predicts, or None where that is not the reason."""
    plant = problem.plant
    if (
        actuation == "hold"
        or problem.network != Network()
        or not isinstance(plant, ContinuousPlant)
        or plant.full_state
    ):
        return None
    remedy = "; actuation=hold has one" if "actuation" in problem.parameters else ""
    return (
        "no periodic control of this actuation to compare with: of a continuous plant a prediction wants the full "
        f"state, and C or V is given{remedy}"
    )


def periodic_curve(problem: Problem, fastest: float, slowest: float, actuation: Actuation) -> tuple[PeriodicPoint, ...]:
    """Return optimal periodic control from one rate down to another; unstable rates are left out."""
    if isinstance(problem.plant, ContinuousPlant):
        longest = 1.05 * max(1 / slowest, 1 / fastest)
        intervals: Sequence[float] = np.geomspace(1 / fastest, longest, CURVE_POINTS).tolist()
    else:
        longest = int(np.ceil(1 / slowest))
        listed = (
            range(1, longest + 1) if longest <= CURVE_POINTS else np.geomspace(1, longest, CURVE_POINTS).astype(int)
        )
        intervals = sorted({int(every) for every in listed})
    found = [(1 / interval, _cost(problem, interval, actuation)) for interval in intervals]
    return tuple(PeriodicPoint(rate, cost) for rate, cost in found if cost is not None)


def _first_stable(problem: Problem, steps: Sequence[int], actuation: Actuation) -> PeriodicPoint | None:
    """Return periodic control at the first of these intervals that has a stable one."""
    for every in steps:
        cost = _cost(problem, every, actuation)
        if cost is not None:
            return PeriodicPoint(1 / every, cost)
    return None


def _cost(problem: Problem, interval: float, actuation: Actuation) -> float | None:
    """Return the closed form of a periodic policy; None where it has none, or its loop is not the one of its design."""
    try:
        if isinstance(problem.plant, ContinuousPlant):
            policy = periodic(problem.plant, problem.cost, period=interval, actuation=actuation)
        else:
            policy = periodic(problem.plant, problem.cost, every=int(interval), actuation=actuation)
        nominal = problem.close(policy).nominal
    except TaciturnError:  # such as sampling that loses a mode, a prediction without the state, a link with delay
        return None
    return policy.closed_form.cost if nominal and policy.closed_form is not None else None
