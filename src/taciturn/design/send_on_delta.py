"""Send-on-delta: the sensor sends when an output has moved."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import number
from taciturn.design.bounds import LARGEST
from taciturn.design.certainty import SEND, design_certainty, sensor_policy
from taciturn.design.estimation import ESTIMATE, HELD, Estimation
from taciturn.lqg.discrete import discretise
from taciturn.lqg.kalman import Filter, steady_filter
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Assign, Decide, Policy, Received, Send
from taciturn.model.trigger import Form, Trigger

LAST, HEARD = "last", "heard"


def send_on_delta(plant: Plant | ContinuousPlant, cost: Cost, *, delta: float, period: float | None = None) -> Policy:
    """Design LQG control whose sensor sends its outputs if and only if one has moved by more than Δ since it sent last.

    The controller, at the actuator, filters the last outputs sent as if they were measured now, each with an error that
    is uniform in ±Δ beside V: the steady Kalman filter for V + (Δ²/3) I [suh2007].

    Args:
        plant: the plant.
        cost: the average cost.
        delta: Δ ≥ 0, in the units of the outputs.
        period: seconds between ticks; only with a continuous plant.

    Returns:
        The policy; no bound on its cost is known.

    Raises:
        ProblemError: Δ < 0, period missing or out of place.
        UnstableError: no stabilising gain or filter.

    Source: miskowicz2006, suh2007

    Example:
        >>> plant, cost = Plant([[0.9]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
        >>> send_on_delta(plant, cost, delta=1.0).scheduled
        ('sensor',)
    """
    delta = number("delta", delta, 0.0, LARGEST, closed=True)
    problem = discretise(plant, cost, period)
    certainty, plant = design_certainty("send-on-delta", problem), problem.plant
    taken = plant.V + delta**2 / 3 * np.eye(plant.outputs)
    steady = steady_filter(plant.A, plant.C, plant.W, taken)
    settling = 1 / (1 - max(certainty.regulator.slowest, steady.slowest))
    return sensor_policy("send-on-delta", certainty, _heard(plant, steady, delta), settling)


def _heard(plant: Plant, steady: Filter, delta: float) -> Estimation:
    """Return the steps from the outputs to the estimate."""
    p, unit = plant.outputs, np.eye(plant.outputs)
    moved = {f"output {i}": Form(("moved",), -np.diag(unit[i]), delta**2) for i in range(p)}
    kept, now = {LAST: unit}, {"y": unit}
    return Estimation(
        (
            Assign("sensor", "moved", {"y": unit, LAST: -unit}),
            Decide("sensor", SEND, Trigger({"silent": Form(), **moved})),
            Send("sensor", "sensor", ("y",), SEND),
            Assign("sensor", LAST, (kept, *([now] * p)), SEND),
            Assign("controller", HEARD, ({HEARD: unit}, {"y": unit}), Received("sensor")),
            Assign("controller", "innovation", {HEARD: unit, "prior": -plant.C}),
            Assign("controller", ESTIMATE, {"prior": np.eye(plant.states), "innovation": steady.gain}),
        ),
        (Assign("controller", "prior", {ESTIMATE: plant.A, HELD: plant.B}),),
        {"prior": plant.mean},
        None,
    )
