"""Policies that send at fixed steps, with their exact costs.

No decision depends on the state, so the loop is linear and periodic, and cost and rate have closed forms. The decision
is data: a constant that a step counter reads from a table, negative in the steps with a send.

* ``every_tick`` sends in every step. Its cost is J_all.
* ``held_in_cycles`` holds the input between the sends of a cycle, with the optimal gains of its periodic Riccati
  equation (``lqg/periodic``). The cost is tr(QΣ) plus that of the pattern.
* An actuator with a model predicts between sends. k steps after a send, the error of its prediction is the sum of k
  innovations, with the covariance V_k, and its input costs tr(L'HL V_k) more than the best one (``predicted_cost``).
* ``innovation_at_queries`` has the steps of a sensor that is read by a schedule, and of the filter that hears it.

Source: astrom1997computer, bengaid2006
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from taciturn._arrays import Array, Bits
from taciturn.base.certainty import Actuation, CertaintyEquivalentDesign, certainty_policy, control_steps
from taciturn.base.filter import CLOCK, SEND, count_ticks
from taciturn.lqg.periodic import Pattern, lift
from taciturn.model.policy import Policy
from taciturn.model.steps import Assign, Decide, Received, Send, Step
from taciturn.model.theory import ClosedForm
from taciturn.model.trigger import Form, Matrix, Scheduled, Trigger

QUERY = "query"


def every_tick(kind: str, certainty: CertaintyEquivalentDesign, notes: tuple[str, ...] = ()) -> Policy:
    """Return the policy that sends at every step and holds its input, with its exact cost."""
    plant, L = certainty.problem.plant, certainty.regulator.L
    steps, initial = control_steps(plant, certainty.estimation, L, "hold", None)
    return certainty_policy(
        kind,
        certainty,
        steps,
        initial,
        identity=None,
        closed_form=ClosedForm(certainty.problem.per_unit(certainty.cost_all_time), {"actuator": 1.0}),
        notes=notes,
    )


def held_in_cycles(kind: str, certainty: CertaintyEquivalentDesign, pattern: Pattern) -> Policy:
    """Return the policy that holds its input and updates it according to a periodic pattern, with its exact cost."""
    one = len(pattern.gains) == 1
    L = pattern.gains[0] if one else Scheduled(CLOCK, np.repeat(pattern.gains, pattern.intervals, axis=0))
    return time_triggered(kind, certainty, L, "hold", pattern.intervals, certainty.estimation_cost + pattern.cost)


def time_triggered(
    kind: str,
    certainty: CertaintyEquivalentDesign,
    L: Matrix,
    actuation: Actuation,
    intervals: Sequence[int],
    average: float,
) -> Policy:
    """Return the policy that sends after each of the given intervals, with its cost per step."""
    length, sends = sum(intervals), np.cumsum((0, *intervals[:-1]))
    trigger = Trigger({"silent": Form(), SEND: _turn(np.isin(np.arange(length), sends))})
    steps, initial = control_steps(certainty.problem.plant, certainty.estimation, L, actuation, trigger)
    return certainty_policy(
        kind,
        certainty,
        steps,
        initial,
        identity=None,
        locations=(count_ticks(length, 0),),
        closed_form=ClosedForm(certainty.problem.per_unit(average), {"actuator": len(intervals) / length}),
        reset=certainty.reset(actuation),
        slower=length,
    )


def innovation_at_queries(
    node: str, controller: str, seen: Mapping[str, Array], queries: Bits, suffix: str = ""
) -> tuple[Step, ...]:
    """Return the steps of a scheduled sensor, and the innovation at the controller, which is 0 without a packet."""
    (sent, prediction), label = seen, f"{QUERY}{suffix}"  # the innovation is the measurement less what is predicted
    nothing = {prediction: np.zeros(seen[prediction].shape)}
    return (
        Decide(node, label, Trigger({"silent": Form(), QUERY: _turn(queries)})),
        Send(node, node, (sent,), label),
        Assign(controller, f"innovation{suffix}", (nothing, seen), Received(node)),
    )


def _turn(sends: Bits) -> Form:
    """Return the form that is negative in the steps of a cycle in which something is sent."""
    return Form(constant=Scheduled(CLOCK, np.where(sends, -1.0, 1.0)))


def predicted_cost(certainty: CertaintyEquivalentDesign, intervals: Sequence[int]) -> float:
    """Return the cost per step of periodic control whose actuator predicts the state between sends."""
    # The additional cost above J_all is the sum of Σ_{j<k} tr(L'HL V_j) over all intervals k of the cycle, divided by
    # the number of its steps. The inner sum is the noise cost of k steps with the weight L'HL, driven by innovations.
    plant = certainty.problem.plant
    free = np.zeros((plant.inputs, plant.inputs))
    given = plant.A, plant.B, certainty.square, free, np.zeros_like(plant.B), certainty.corrections
    return certainty.cost_all_time + sum(lift(*given, ticks).noise_cost for ticks in intervals) / sum(intervals)
