"""Policies that send at fixed steps, with their exact costs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from taciturn.base.certainty import Actuation, CertaintyEquivalentDesign, certainty_policy, control_steps
from taciturn.base.filter import CLOCK, SEND, count_ticks
from taciturn.lqg.periodic import Pattern, lift
from taciturn.model.policy import Policy
from taciturn.model.theory import ClosedForm
from taciturn.model.trigger import Form, Matrix, Scheduled, Trigger


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
    _, gains = pattern.unrolled()
    L = gains[0] if len(pattern.gains) == 1 else Scheduled(CLOCK, gains)
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
    turn = Scheduled(CLOCK, np.where(np.isin(np.arange(length), sends), -1.0, 1.0))
    trigger = Trigger({"silent": Form(), SEND: Form(constant=turn)})
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


def predicted_cost(certainty: CertaintyEquivalentDesign, intervals: Sequence[int]) -> float:
    """Return the cost per step of periodic control whose actuator predicts the state between sends.

    The additional cost above J_all is the sum of Σ_{j<k} tr(L'HL V_j) over all intervals k of the cycle, divided by the
    number of its steps. V_j is the error covariance accumulated from the innovations of j steps after a send.
    """
    plant = certainty.problem.plant
    free = np.zeros((plant.inputs, plant.inputs))
    given = plant.A, plant.B, certainty.square, free, np.zeros_like(plant.B), certainty.corrections
    return certainty.cost_all_time + sum(lift(*given, ticks).noise_cost for ticks in intervals) / sum(intervals)
