"""PID controllers that compute only when a measurement arrives. Their gains depend on the time since the last one.

The sensor sends when the output has changed by more than Δ since the last packet, and in some variants after a longest
interval. With the time t since the last packet, the controller then computes

    u = −(kp y + I + D),  D ← T/(T + t) D + kd/(T + t)(y − last y),  I ← I + ki a,

where a is the area under the error that the variant assumes. The derivative is implicit, and so stable for every t. The
filter of the given controller is explicit: with its time constant Tf and the step h, D⁺ = (1 − h/Tf) D +
kd/Tf (y⁺ − y). Both are the same at t = h if T = Tf − h. With this T, the rule with a packet at every step is the given
controller, with whose cost it is compared.

If the set-point r changes, the controller computes at once, from the last packet. The three parts then have y − b r,
y − r and y − c r in place of y, and the steps before the change count with the set-point that they had.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from taciturn._arrays import Array, number
from taciturn._display import Displayed
from taciturn._text import number_of
from taciturn.base.certainty import expect_average
from taciturn.base.filter import SEND
from taciturn.base.given_controller import GivenLoop
from taciturn.base.route import sensor_base
from taciturn.design.bounds import LARGEST_PARAMETER
from taciturn.design.dead_bands import policy_of_loop
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.errors import ProblemError
from taciturn.model.controller import PID, controller_from, pids_of
from taciturn.model.cost import Cost
from taciturn.model.network import REFERENCE
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.steps import ONE, Apply, Assign, Decide, Evaluate, Received, Send, Step
from taciturn.model.trigger import Form, Trigger

HEARD, FRESH, BEFORE = "heard", "fresh", "last set-point"
STATE = ("command", "area", "derivative", "before", "elapsed")


@dataclass(frozen=True, repr=False)
class EventPID(Displayed):
    """Control law of a PID controller that computes only when a packet arrives."""

    pid: PID  # the gains
    step: float  # seconds per step
    # function of the error, the time since the last packet and the time of a step, all in seconds, that returns the
    # area under the error
    area: Callable[[Any, Any, float], Any]

    def __call__(
        self, heard: Any, fresh: Any, command: Any, integral: Any, derivative: Any, before: Any, elapsed: Any, *r: Any
    ) -> Any:
        """Return the command and the state of the controller; without a packet, only the elapsed steps change.

        ``r`` are the set-point and that of the previous step, if it may change. A change counts as a packet.
        """
        pid, time = self.pid, elapsed * self.step
        T = 0.0 if pid.filter is None else pid.filter - self.step
        weighted, filtered, new = heard, heard, fresh > 0.5
        area = self.area(heard, time, self.step)
        if r:
            now, last = r
            weighted, filtered, new = heard - pid.b * now, heard - pid.c * now, new | (now != last)
            area = self.area(heard - last, time, self.step) + self.step * (last - now)
        slope = (T * derivative + pid.kd * (filtered - before)) / (T + time)
        value = -(pid.kp * weighted + integral + slope)
        return (
            np.where(new, value, command),
            np.where(new, integral + pid.ki * area, integral),
            np.where(new, slope, derivative),
            np.where(new, filtered, before),
            np.where(new, 1.0, elapsed + 1.0),
            *r[:1],
        )


def design_event_pid(
    kind: str,
    plant: Plant | ContinuousPlant,
    cost: Cost,
    controller: object,
    delta: float,
    longest: float | None,
    period: float | None,
    area: Callable[[Any, Any, float], Any],
) -> Policy:
    """Design the policy of a PID controller that computes only when a measurement arrives."""
    delta = number("delta", delta, 0.0, LARGEST_PARAMETER, closed=True)
    loops = pids_of(controller_from(controller))
    if not loops:
        raise ProblemError(
            f"the controller of the policy kind {kind} is not a PID controller; expected the key 'pid' with kp, ki, kd "
            "and filter"
        )
    kept, *others = loops
    if others:
        raise ProblemError(
            f"the controller has {len(loops)} PID loops; expected one PID loop for the policy kind {kind}"
        )
    if kept.tracking_time is not None:
        raise ProblemError(
            f"pid.tracking_time is {kept.tracking_time:g}, which the policy kind {kind} does not use; expected no "
            "tracking_time, because this policy kind has no back-calculation"
        )
    expect_average(kind, cost)
    loop = GivenLoop.of(plant, cost, period, kept)
    (own,) = pids_of(loop.kept)
    plant, step = loop.problem.plant, loop.problem.plant.dt
    if plant.inputs != 1 or plant.sensed != 1:
        raise ProblemError(
            f"the plant has {number_of(plant.inputs, 'input')} and {number_of(plant.sensed, 'output')}; expected one "
            f"input and one output for the policy kind {kind}"
        )
    assert step is not None
    follows = plant.set_points > 0
    steps = 0.0 if longest is None else number("longest", longest, 0.0) / step
    one = np.eye(1)
    late = {} if longest is None else {"late": Form(plus={"age": -1.0}, constant=max(np.ceil(steps - 1e-9), 1.0) - 0.5)}
    sends = 1 + len(late)
    counted, restarted = Form(constant=1.0, plus={"age": 1.0}), Form(constant=1.0)
    moved = Form(("moved",), -one, delta**2)
    decide: tuple[Step, ...] = (
        Assign("sensor", "moved", {"y": one, "last": -one}),
        Decide("sensor", SEND, Trigger({"silent": Form(), "moved": moved, **late})),
        Send("sensor", "sensor", ("y",), SEND),
        Assign("sensor", "last", ({"last": one}, *([{"y": one}] * sends)), SEND),
        *((Evaluate("sensor", "age", (counted, *([restarted] * sends)), SEND),) if late else ()),
    )
    compute: tuple[Step, ...] = (
        Assign("controller", HEARD, ({HEARD: one}, {"y": one}), Received("sensor")),
        Assign("controller", FRESH, ({ONE: 0.0 * one}, {ONE: one}), Received("sensor")),
        Apply(
            "controller",
            dict.fromkeys((*STATE, *([BEFORE] if follows else ())), 1),
            EventPID(own, step, area),
            (HEARD, FRESH, *STATE, *((REFERENCE, BEFORE) if follows else ())),
        ),
        Assign("actuator", "input", {"command": one}),
    )
    initial = {"elapsed": np.ones(1), **_begun(own, loop), **({"age": np.full(1, 1e6)} if late else {})}
    initial |= {BEFORE: plant.given} if follows else {}
    return policy_of_loop(
        kind,
        loop,
        sensor_base(loop.problem, loop.controller),
        (*decide, *compute),
        (frozenset({"controller", "actuator"}),),
        initial,
    )


def _begun(pid: PID, loop: GivenLoop) -> dict[str, Array]:
    """Return the integral part of the command at the start, and the measurement before it, relative to the rest."""
    plant, steady = loop.problem.plant, loop.point.input
    before = (plant.C @ plant.mean)[:1]  # the given controller, too, starts its derivative without the set-point
    integral = steady + pid.kp * (1 - pid.b) * pid.setpoint
    if pid.start_input is not None:
        raised = pid.b * plant.given if plant.set_points else 0.0
        integral = steady - pid.start_input - pid.kp * (before - raised)
    return {"area": integral, "before": before}


def event_pid(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    controller: object,
    delta: float,
    longest: float | None = None,
    period: float | None = None,
) -> Policy:
    """Design an event-based PID controller, which computes after an output change of Δ, or after a longest interval.

    At a packet, the time t since the last packet enters the filter of the derivative, and the integral grows by ki t y.
    With a packet at every step, it is the given controller.

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
    data="memories `last` and `age` at S; a function computes the controller at C",
    order="compare y with the last sent value, decide, send y, compute, input",
    follows=("changing",),
    keeps_controller=True,
)
