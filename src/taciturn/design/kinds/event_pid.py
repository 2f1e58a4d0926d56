"""Årzén's event-based PID controller: it computes when a measurement arrives."""

from __future__ import annotations

from typing import Any

from taciturn.design.event_based import design_event_pid
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy


def event_pid(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    controller: object,
    delta: float,
    longest: float | None = None,
    period: float | None = None,
) -> Policy:
    """Design an event-based PID controller, which computes if the output has changed by more than Δ, or after a time.

    At a packet, the time t since the last packet enters the derivative's filter, and the integral grows by ki t y. With a
    packet at every step, it is the given controller.

    Args:
        plant: the plant, with one input and one output.
        cost: the average cost.
        controller: the PID controller.
        delta: threshold Δ ≥ 0 in the units of the output.
        longest: seconds after which the sensor sends in any case; default: never.
        period: seconds between steps; only with a continuous plant.

    Returns:
        The policy; no bound on its cost is known.

    Raises:
        ProblemError: the controller is no PID controller, or the plant has several inputs or outputs.
        UnstableError: the loop that sends every sample is unstable.

    Source: arzen1999

    Example:
        >>> from taciturn import PID
        >>> plant, cost = Plant([[0.9]], [[0.1]], [[1.0]], dt=0.1), Cost([[1.0]], [[1.0]])
        >>> event_pid(plant, cost, controller=PID(1.0), delta=1.0, longest=2.0).scheduled
        ('sensor',)
    """
    return design_event_pid("event-pid", plant, cost, controller, delta, longest, period, _rectangle)


def _rectangle(error: Any, time: Any, step: float) -> Any:
    """Return the area with the present error since the last packet."""
    return error * time


KIND = Kind(
    name="event-pid",
    design=event_pid,
    goal="a PID controller that computes only when the output has changed by Δ",
    tuning=(TradeoffParameter("delta"),),
    example={"delta": 0.05, "longest": 3.0},
    built_in="pid-tank",
    nodes="S, C+A",
    refused="no PID controller; several inputs or outputs",
    follows=(),
    data="memories `last` and `age` at S; a function computes the controller at C",
    order="compare y with the last sent value, decide, send y, compute, input",
    keeps_controller=True,
)
