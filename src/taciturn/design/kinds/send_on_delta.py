"""Send-on-delta: the sensor sends when an output has changed by more than a threshold since the last send."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import number
from taciturn.design.bounds import LARGEST_PARAMETER
from taciturn.design.certainty import SEND, design_certainty, expect_average, sensor_policy
from taciturn.design.estimation import ESTIMATE, HELD, FilterSteps
from taciturn.design.kept import lqg_observer
from taciturn.design.kept_loop import KeptLoop
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.design.routes import route_over
from taciturn.lqg.discrete import discretise
from taciturn.lqg.kalman import Filter, steady_filter
from taciturn.model.cost import Cost
from taciturn.model.kept import controller_from
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Assign, Decide, Evaluate, Policy, Received, Send
from taciturn.model.trigger import Form, Trigger

LAST, HEARD, WHICH = "last", "heard", "changed"


def send_on_delta(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    delta: float,
    period: float | None = None,
    controller: object = None,
    link: str = "sensor",
) -> Policy:
    """Design LQG control whose sensor sends if and only if an output has changed by more than Δ since the last send.

    The controller, at the actuator, filters the last outputs sent as if they were measured at the current step. The
    filter models the change since the send as an additional error, uniform in ±Δ: it is the steady-state Kalman filter
    for the measurement noise V + (Δ²/3) I [suh2007]. A given ``controller`` uses the last outputs sent. With ``link =
    "actuator"``, the controller sends its command when an input has changed by more than Δ.

    Args:
        plant: the plant.
        cost: the average cost.
        delta: threshold Δ ≥ 0, in the units of the outputs, or of the inputs.
        period: seconds between steps; only with a continuous plant.
        controller: a linear controller to keep, or an object that ``controller_from`` converts; default: LQG.
        link: ``"sensor"``: measurements are sent; ``"actuator"``: commands of a controller at the sensor's site.

    Returns:
        The policy; no bound on its cost is known.

    Raises:
        ProblemError: if Δ < 0, or period is missing or not applicable.
        UnstableError: if no stabilising gain or filter exists.

    Source: miskowicz2006, suh2007

    Example:
        >>> plant, cost = Plant([[0.9]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
        >>> send_on_delta(plant, cost, delta=1.0).scheduled
        ('sensor',)
    """
    delta = number("delta", delta, 0.0, LARGEST_PARAMETER, closed=True)
    if controller is not None or link != "sensor":
        return _keep("send-on-delta", plant, cost, period, controller, delta, link)
    problem = discretise(plant, cost, period)
    certainty, plant = design_certainty("send-on-delta", problem), problem.plant
    taken = plant.V + delta**2 / 3 * np.eye(plant.outputs)
    steady = steady_filter(plant.A, plant.C, plant.W, taken)
    settling = 1 / (1 - max(certainty.regulator.slowest, steady.slowest))
    return sensor_policy("send-on-delta", certainty, _heard(plant, steady, delta), settling)


def _keep(
    kind: str,
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    controller: object,
    delta: float,
    link: str,
) -> Policy:
    """Return the policy that sends when the value that a given controller needs, or its command, has changed by Δ."""
    expect_average(kind, cost)
    kept = lqg_observer(kind, discretise(plant, cost, period)) if controller is None else controller_from(controller)
    loop = KeptLoop.of(plant, cost, period, kept)
    route = route_over(link, loop.problem, loop.controller, "hold", False, start=loop.point.start)
    size = len(route.base.K)
    moved = {f"entry {i}": Form(("error",), -np.diag(row), delta**2) for i, row in enumerate(np.eye(size))}
    decide = (
        Decide(route.node, WHICH, Trigger({"none": Form(), **moved})),
        Evaluate(route.node, "any", tuple(Form(constant=float(i > 0)) for i in range(size + 1)), WHICH),
        Decide(route.node, SEND, Trigger({"silent": Form(plus={"any": 1.0}), SEND: Form(constant=0.5)})),
    )
    steps = route.steps({"y": np.eye(loop.problem.plant.outputs)}, decide, ())
    return loop.policy(kind, route.base, steps, route.sites, route.initial)


def _heard(plant: Plant, steady: Filter, delta: float) -> FilterSteps:
    """Return the policy steps that send the outputs and compute the estimate."""
    p, unit = plant.outputs, np.eye(plant.outputs)
    moved = {f"output {i}": Form(("moved",), -np.diag(unit[i]), delta**2) for i in range(p)}
    kept, now = {LAST: unit}, {"y": unit}
    return FilterSteps(
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


KIND = Kind(
    name="send-on-delta",
    design=send_on_delta,
    goal="a simple sensor that sends when an output has changed by Δ",
    tuning=(TradeoffParameter("delta"),),
    example={"delta": 0.2},
    nodes="S, C+A",
    data="memories `last` at S and `heard` at C; one label per output",
    order="compare y with the last sent value, decide, send y, filter, input",
    offered=6,
    keeps_controller=True,
)
