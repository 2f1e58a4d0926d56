"""A policy kind: the threshold decays with the time since the last send."""

from __future__ import annotations

import numpy as np

from taciturn import Cost, Plant, Policy, Theory, Trigger
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.lqg.riccati import regulate
from taciturn.model.steps import ONE, Assign, Decide, Received, Send
from taciturn.model.trigger import Form


def decaying(plant: Plant, cost: Cost, *, delta: float, rho: float = 0.9) -> Policy:
    """Design LQG control that sends when silence costs more than a decaying threshold.

    With the held input û, the command Lx and H = R + B'KB, an input is sent iff
    (û − Lx)'H(û − Lx) > δρ^k, k steps after the step that follows the last send.

    Args:
        plant: discrete-time plant with measured full state.
        cost: the average cost.
        delta: threshold δ > 0 in the step after a send, a cost per step.
        rho: factor ρ in (0, 1] of the threshold per step.

    Returns:
        The policy; silence in a step costs at most δ.

    Source: astrom2002
    """
    found = regulate(plant.A, plant.B, cost.Q, cost.R, cost.N)
    unit = np.eye(plant.inputs)
    forms = {"silent": Form(("gap",), found.H), "send": Form(plus={"level": 1.0})}
    arrived = Received("actuator")
    steps = (
        Assign("controller", "command", {"y": found.L}),
        Assign("controller", "gap", {"command": unit, "held": -unit}),
        Decide("controller", "send", Trigger(forms)),
        Send("controller", "actuator", ("command",), "send"),
        Assign("controller", "held", ({"held": unit}, {"command": unit}), "send"),
        Assign("controller", "level", ({"level": [[rho]]}, {ONE: [[delta]]}), "send"),
        Assign("actuator", "input", ({"input": unit}, {"command": unit}), arrived),
    )
    return Policy(
        kind="decaying",
        steps=steps,
        model=plant,
        theory=Theory(cost, cost_all_time=float(np.trace(found.K @ plant.W))),
        sites=(frozenset({"sensor", "controller"}),),
        initial={"level": [delta]},
    )


KIND = Kind(
    name="decaying",
    design=decaying,
    goal="a threshold that forgets: rare sends after a send, none that is long overdue",
    tuning=(TradeoffParameter("delta"),),
    example={"delta": 0.1},
    built_in="lossy-double-integrator",
    plants=("discrete",),
    usual={"delta": 0.1},
)
