"""Optimal LQG control that sends at every step.

Kalman filter and regulator are designed apart (certainty equivalence), with the error covariances Σ̃ before and Σ after
a measurement and the cost-to-go x'Kx:  J_all = tr(QΣ) + tr(K(Σ̃ − Σ)). The bounds of the other kinds refer to it.

Source: anderson1990optimal
"""

from __future__ import annotations

from taciturn.base.certainty import design_certainty, expect_average
from taciturn.design.at_fixed_steps import every_tick, send_at_fixed_steps
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.lqg.discrete import discretise
from taciturn.model.controller import controller_from
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy


def all_time(
    plant: Plant | ContinuousPlant, cost: Cost, *, period: float | None = None, controller: object = None
) -> Policy:
    """Design optimal LQG control that sends at every step.

    Its cost per step is J_all = tr(QΣ) + tr(K(Σ̃ − Σ)). A given ``controller`` computes the input instead.

    Args:
        plant: the plant.
        cost: the average cost.
        period: seconds between steps; only with a continuous plant.
        controller: a linear controller to keep, or an object that ``controller_from`` converts; default: LQG.

    Returns:
        The policy, with its exact cost.

    Raises:
        ProblemError: if period is missing or not applicable.
        UnstableError: if no stabilising gain or filter exists.

    Source: anderson1990optimal

    Example:
        >>> all_time(Plant([[0.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])).cost_all_time
        1.0
    """
    if controller is not None:
        expect_average("all-time", cost)
        return send_at_fixed_steps("all-time", plant, cost, period, controller_from(controller))
    certainty = design_certainty("all-time", discretise(plant, cost, period))
    return every_tick("all-time", certainty)


KIND = Kind(
    name="all-time",
    design=all_time,
    goal="a comparison with standard LQG, or a given controller, at every sample",
    tuning=(TradeoffParameter("period", continuous=True),),
    proved="cost and rate, exactly",
    order="filter, command, send, hold, predict",
    runs_with_losses=True,
    keeps_controller=True,
)
