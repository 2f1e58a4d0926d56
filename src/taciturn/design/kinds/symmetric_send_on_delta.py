"""Symmetric send-on-delta: the sensor quantises the output with hysteresis in steps of Δ, and sends the changes.

The level changes when the output is Δ away from it, to the multiple of Δ that the output has crossed: a quantiser with
hysteresis, symmetric about zero. It differs from the output by at most Δ, so the certificate of dead bands holds
(``design/dead_bands``). Both ends know the first level, that of the expected output.

Source: beschi2012
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from taciturn._arrays import number
from taciturn._display import Displayed
from taciturn.base.certainty import expect_average
from taciturn.base.filter import SEND
from taciturn.base.given_controller import GivenLoop
from taciturn.base.route import nonempty, sensor_base
from taciturn.design.bounds import LARGEST_PARAMETER
from taciturn.design.dead_bands import errors_of_one, policy_of_loop
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.errors import ProblemError
from taciturn.model.controller import controller_from
from taciturn.model.cost import Cost
from taciturn.model.network import REFERENCE
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.steps import Apply, Assign, Decide, Received, Send
from taciturn.model.trigger import Form, Trigger

LEVEL, USED, STATE = "level", "used", "state"


def symmetric_send_on_delta(
    plant: Plant | ContinuousPlant, cost: Cost, *, controller: object, delta: float, period: float | None = None
) -> Policy:
    """Design the loop of a given controller that uses the output quantised to multiples of Δ, with hysteresis.

    The levels are the multiples of Δ, so zero is one of them, and around it the sensor is silent. The controller
    computes in every step with the last level.

    Args:
        plant: the plant, with one output.
        cost: the average cost.
        controller: a linear controller to keep, or an object that ``controller_from`` converts.
        delta: threshold Δ > 0 in the units of the output.
        period: seconds between steps; only with a continuous plant.

    Returns:
        The policy, with the certificate of ``send-on-delta``: the level differs from the output by at most Δ.

    Raises:
        ProblemError: the plant has several outputs, or a parameter is out of range.
        UnstableError: the loop that sends every sample is unstable.

    Source: beschi2012

    Example:
        >>> from taciturn import PID
        >>> plant, cost = Plant([[0.9]], [[0.1]], [[1.0]], dt=0.1), Cost([[1.0]], [[1.0]])
        >>> symmetric_send_on_delta(plant, cost, controller=PID(1.0), delta=1.0).scheduled
        ('sensor',)
    """
    kind, delta = "symmetric-send-on-delta", number("delta", delta, 0.0, LARGEST_PARAMETER)
    expect_average(kind, cost)
    loop = GivenLoop.of(plant, cost, period, controller_from(controller))
    problem, c = loop.problem, loop.controller
    if problem.plant.sensed != 1:
        raise ProblemError(
            f"the plant has {problem.plant.sensed} outputs; expected one output for the policy kind {kind}"
        )
    one, read = np.eye(1), {USED: slice(0, 1), REFERENCE: slice(1, None)}  # columns of the controller's B and D
    expected = (problem.plant.C @ problem.plant.mean)[:1]  # which both ends know
    level = Crossed(delta)(expected)
    moved = {name: c.B[:, at] for name, at in read.items()}
    changed = Trigger({"silent": Form(), SEND: Form(("moved",), -one, delta**2)})
    steps = (
        Assign("sensor", "moved", {"y": one, LEVEL: -one}),
        Decide("sensor", SEND, changed),
        Apply("sensor", {"crossed": 1}, Crossed(delta), ("moved",)),
        Assign("sensor", LEVEL, ({LEVEL: one}, {LEVEL: one, "crossed": one}), SEND),
        Send("sensor", "sensor", (LEVEL,), SEND),
        Assign("controller", USED, ({USED: one}, {LEVEL: one}), Received("sensor")),
        Assign("controller", "command", nonempty({STATE: c.C, **{name: c.D[:, at] for name, at in read.items()}})),
        Assign("actuator", "input", {"command": np.eye(problem.plant.inputs)}),
        *((Assign("controller", STATE, nonempty({STATE: c.A, **moved, "command": c.E})),) if len(c.A) else ()),
    )
    initial = {**({STATE: loop.point.start} if len(c.A) else {}), LEVEL: level, USED: level}
    return policy_of_loop(
        kind,
        loop,
        sensor_base(problem, c),
        steps,
        (frozenset({"controller", "actuator"}),),
        initial,
        errors=errors_of_one(loop, "sensor", delta),
        functions=frozenset({"crossed"}),
    )


@dataclass(frozen=True, repr=False)
class Crossed(Displayed):
    """Computes by which multiple of Δ the quantised output changes."""

    delta: float

    def __call__(self, moved: Any) -> Any:
        """Return the change, which is below Δ in silence and then not used."""
        return np.where(moved < 0.0, -1.0, 1.0) * self.delta * np.floor(np.abs(moved) / self.delta)


KIND = Kind(
    name="symmetric-send-on-delta",
    design=symmetric_send_on_delta,
    goal="a given controller that uses the output in multiples of Δ",
    tuning=(TradeoffParameter("delta"),),
    example={"delta": 0.05},
    built_in="pid-tank",
    proved=r"$\sqrt J\le\sqrt{J_b}+\gamma\Delta$, a conservative certificate",
    relative_to="the same controller with every sample",
    nodes="S, C+A",
    refused="several outputs",
    data="memory `level` at S, `used` at C",
    order="compare y with the level, decide, change and send the level, input",
    follows=("changing",),
    keeps_controller=True,
)
