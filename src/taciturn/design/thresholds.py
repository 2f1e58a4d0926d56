"""Thresholds on the error that grow with the norm of the state estimate."""

from __future__ import annotations

from taciturn._arrays import block_diagonal, number
from taciturn.design.bounds import LARGEST_PARAMETER, bound_by_state
from taciturn.design.certainty import Actuation, certainty_policy, control_steps, design_certainty
from taciturn.design.estimation import DEVIATION, ESTIMATE, SEND
from taciturn.lqg.discrete import discretise
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.trigger import Form, Trigger


def relative_to_state(
    kind: str,
    plant: Plant | ContinuousPlant,
    cost: Cost,
    sigma: float,
    threshold: float,
    period: float | None,
    actuation: Actuation,
    source: str,
) -> Policy:
    """Return the policy that sends when the squared error |e|² exceeds the threshold σ²|x̂|² + Y²."""
    sigma = number("sigma", sigma, 0.0, LARGEST_PARAMETER, closed=True)
    threshold = number("threshold", threshold, 0.0, LARGEST_PARAMETER, closed=True)
    problem = discretise(plant, cost, period)
    certainty, unit = design_certainty(kind, problem), problem.weight()
    silent = Form((DEVIATION, ESTIMATE), block_diagonal(unit, -(sigma**2) * unit))
    rule = Trigger({"silent": silent, SEND: Form(constant=threshold**2)})
    steps, initial = control_steps(problem.plant, certainty.estimation, certainty.regulator.L, actuation, rule)
    guarantee, notes = bound_by_state(certainty, sigma, threshold, source)
    return certainty_policy(
        kind,
        certainty,
        steps,
        initial,
        identity=certainty.completed_square(),
        guarantee=guarantee,
        reset=certainty.reset(actuation),
        notes=notes,
    )
