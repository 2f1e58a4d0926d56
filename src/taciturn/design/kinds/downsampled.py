"""Downsampled threshold: the policy checks the error soon after a send, and then less often until the next send.

The rule |e| > Y holds only in the steps of a check: ``fast`` steps after a send, and ``slow`` after a check without
one. A counter of the steps to the next check is a location of the policy. It reads the weight of the trigger, zero
between checks, from a table. The error may grow between checks, so no bound on the cost is known.

Source: heemels2013
"""

from __future__ import annotations

import numpy as np

from taciturn._arrays import count, number
from taciturn.base.certainty import Actuation, certainty_policy, control_steps, design_certainty
from taciturn.base.filter import DEVIATION, SEND
from taciturn.design.bounds import LARGEST_PARAMETER
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import discretise
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.steps import Location
from taciturn.model.trigger import Form, Scheduled, Trigger

WAIT_LABEL = "wait"
LONGEST = 10_000  # largest number of steps between checks


def downsampled(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    fast: int,
    slow: int,
    threshold: float,
    period: float | None = None,
    actuation: Actuation = "hold",
) -> Policy:
    """Design LQG control that checks the error only at some steps, and sends if |e| then exceeds a threshold Y.

    The error is e = x̃ − x̂, where x̃ is the state that the actuator uses. The next check follows ``fast`` steps after a
    send, and ``slow`` steps after a check without a send. This is periodic event-triggered control [heemels2013] with
    checks that depend on the events. With fast = slow = 1, the policy is the absolute threshold.

    Args:
        plant: the plant.
        cost: the average cost.
        fast: steps to the next check after a send, at least 1.
        slow: steps to the next check after a check without a send, at least ``fast``.
        threshold: Y ≥ 0, in the units of the state.
        period: seconds between steps; only with a continuous plant.
        actuation: ``"hold"`` keeps the last input, ``"model"`` runs x̃⁺ = (A + BL) x̃ from the last sent estimate.

    Returns:
        The policy; no bound on its cost is known.

    Raises:
        ProblemError: if fast or slow is not an integer, slow < fast, Y < 0, or period is missing or not applicable.
        UnstableError: if no stabilising gain or filter exists.

    Source: heemels2013

    Example:
        >>> plant, cost = Plant([[0.5]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
        >>> downsampled(plant, cost, fast=1, slow=4, threshold=1.0).locations[0].table.tolist()
        [[3, 0], [0, 0], [1, 1], [2, 2]]
    """
    fast, slow = count("fast", fast), count("slow", slow)
    if slow > LONGEST:
        raise ProblemError(f"slow = {slow}; expected at most {LONGEST} steps")
    if slow < fast:
        raise ProblemError(
            f"slow = {slow} and fast = {fast}; expected slow ≥ fast, where both are numbers of steps between checks"
        )
    threshold = number("threshold", threshold, 0.0, LARGEST_PARAMETER, closed=True)
    problem = discretise(plant, cost, period)
    certainty, unit = design_certainty("downsampled", problem), problem.weight()
    looked_at = Scheduled(WAIT_LABEL, [unit] + [0 * unit] * (slow - 1))
    rule = Trigger({"silent": Form((DEVIATION,), looked_at), SEND: Form(constant=threshold**2)})
    steps, initial = control_steps(problem.plant, certainty.estimation, certainty.regulator.L, actuation, rule)
    left = [[slow - 1, fast - 1], *([wait - 1] * 2 for wait in range(1, slow))]
    return certainty_policy(
        "downsampled",
        certainty,
        steps,
        initial,
        identity=certainty.completed_square(),
        locations=(Location(WAIT_LABEL, np.array(left), "controller", SEND),),
        reset=certainty.reset(actuation),
        slower=slow,
    )


KIND = Kind(
    name="downsampled",
    design=downsampled,
    goal="a next check whose time is known at the previous one",
    tuning=(TradeoffParameter("threshold"),),
    example={"fast": 1, "slow": 3, "threshold": 1.0},
    data=(
        "the location `wait` counts down to the next check and depends on the decision; the weight of the "
        "trigger is read by `wait`"
    ),
    order="operations of `lqg`",
    usual={"fast": 1, "slow": 2},
)
