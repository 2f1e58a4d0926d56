"""Policies whose actuator runs a model, and which send if a function of the model's error is positive."""

from __future__ import annotations

from collections.abc import Callable

from taciturn.design.certainty import certainty_policy, control_steps, design_certainty
from taciturn.design.estimation import SEND
from taciturn.design.prediction import predict_continuously, predicted_policy
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete, discretise
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.theory import Reset
from taciturn.model.trigger import Form, Trigger


def modelled(
    kind: str,
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    silence: Callable[[Discrete, Reset], Form],
) -> Policy:
    """Return a policy whose actuator runs a model, and which sends if a function of the model's error is positive.

    Args:
        kind: name of the policy kind in the catalogue.
        plant: the plant; if it is continuous in time with measured full state, both ends predict in continuous time.
        cost: the average cost.
        period: seconds between checks; only with a continuous plant.
        silence: function that returns the form over the error of the reset.
    """
    if isinstance(plant, ContinuousPlant) and plant.full_state:
        found = predict_continuously(kind, plant, cost, period)
        rule = Trigger({"silent": silence(found.problem, found.reset), SEND: Form()})
        return predicted_policy(kind, found, rule, notes=_notes(found.problem))
    problem = discretise(plant, cost, period)
    certainty = design_certainty(kind, problem)
    reset = certainty.reset("model")
    if reset is None:
        noise = "the plant has jumps" if problem.jumps else "the set-points change (reference.steps or file)"
        raise ProblemError(
            f"{noise} and C or V is given, so successive estimation errors are dependent; "
            "expected Gaussian noise and constant set-points, or neither C nor V"
        )
    rule = Trigger({"silent": silence(problem, reset), SEND: Form()})
    steps, initial = control_steps(problem.plant, certainty.estimation, certainty.regulator.L, "model", rule)
    return certainty_policy(
        kind, certainty, steps, initial, identity=certainty.completed_square(), reset=reset, notes=_notes(problem)
    )


def _notes(problem: Discrete) -> tuple[str, ...]:
    """Return a note on the approximation of jumps by Gaussian noise, if the plant has jumps."""
    told = "the plant has jumps: the schedule is optimised for Gaussian noise of the same covariance"
    return () if problem.jumps is None else (told,)
