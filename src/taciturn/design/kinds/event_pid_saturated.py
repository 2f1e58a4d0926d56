"""The event-based PID controller of Durand and Marchand: after a long time without a packet, its integral grows less.

It is the controller of ``event_pid`` with another area under the error. In silence the output has changed by at most Δ,
so of the time t since the last packet only the last step h counts with the present error, and the rest with at most Δ:

    a = h y + (t − h) y',   y' = y limited to ±Δ.

Source: durand2009
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.design.kinds.event_pid import design_event_pid
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy


def event_pid_saturated(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    controller: object,
    delta: float,
    period: float | None = None,
) -> Policy:
    """Design an event-based PID controller, which computes after an output change of Δ, without a longest interval.

    While the sensor is silent, the output has changed by at most Δ. So the integral grows by ki times h y for the last
    step h, and at most Δ(t − h) for the silence before it, with the sign of y.

    Args:
        plant: the plant, with one input and one output.
        cost: the average cost.
        controller: the PID controller.
        delta: threshold Δ ≥ 0 in the units of the output.
        period: seconds between steps; only with a continuous plant.

    Returns:
        The policy; no bound on its cost is known.

    Raises:
        ProblemError: the controller is no PID controller, or the plant has several inputs or outputs.
        UnstableError: the loop that sends every sample is unstable.

    Source: durand2009

    Example:
        >>> from taciturn import PID
        >>> plant, cost = Plant([[0.9]], [[0.1]], [[1.0]], dt=0.1), Cost([[1.0]], [[1.0]])
        >>> event_pid_saturated(plant, cost, controller=PID(1.0), delta=1.0).scheduled
        ('sensor',)
    """
    area = partial(_saturated, delta)
    return design_event_pid("event-pid-saturated", plant, cost, controller, delta, None, period, area)


def _saturated(delta: float, error: Any, time: Any, step: float) -> Any:
    """Return the area with the present error in the last step, and at most Δ before."""
    return step * error + (time - step) * np.clip(error, -delta, delta)


KIND = Kind(
    name="event-pid-saturated",
    design=event_pid_saturated,
    goal="an event-based PID controller whose integral grows less after a long silence",
    tuning=(TradeoffParameter("delta"),),
    example={"delta": 0.05},
    built_in="pid-tank",
    nodes="S, C+A",
    refused="no PID controller; several inputs or outputs",
    data="the memory `last` at S; a function computes the controller at C",
    order="operations of `event-pid`",
    follows=("changing",),
    keeps_controller=True,
)
