"""The dynamic trigger: a relative threshold that may be passed for a while, on credit."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import block_diagonal, number
from taciturn.design.bounds import LARGEST, bound_by_state
from taciturn.design.certainty import DEVIATION, SEND, Actuation, certainty_policy, control_steps, design_certainty
from taciturn.design.estimation import ESTIMATE
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import discretise
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Evaluate, Policy
from taciturn.model.trigger import Form, Trigger

CREDIT = "credit"


def dynamic(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    sigma: float,
    rho: float,
    gain: float,
    period: float | None = None,
    actuation: Actuation = "hold",
) -> Policy:
    """Design LQG control that sends if and only if gain·(|e|² − σ²|x̂|²) > η.

    e = x̃ − x̂, with x̃ the state that the actuator acts on. The credit is what the relative rule has left unused,

        η⁺ = ρη + σ²|x̂|² − |e|², e after the decision (0 where it was sent), η_0 = 0.

    With gain·ρ ≥ 1 it stays η ≥ 0: wherever this rule sends, the relative one would. A growing gain makes it that.

    Args:
        plant: the plant.
        cost: the average cost.
        sigma: σ ≥ 0, the share of the state.
        rho: 0 < ρ < 1, what is left of the credit a tick later.
        gain: at least 1/ρ.
        period: seconds between ticks; only with a continuous plant.
        actuation: ``"hold"`` keeps the last input, ``"model"`` runs x̃⁺ = (A + BL) x̃ from the last sent estimate.

    Returns:
        The policy, with the bound of the relative rule: the mean of |e|² is at most that of σ²|x̂|² here, too.

    Raises:
        ProblemError: σ < 0, ρ outside (0, 1), gain below 1/ρ, period missing or out of place.
        UnstableError: no stabilising gain or filter.

    Source: girard2015

    Example:
        >>> plant, cost = Plant([[0.5]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
        >>> dynamic(plant, cost, sigma=0.5, rho=0.8, gain=2.0).guarantee.source
        'girard2015'
    """
    sigma = number("sigma", sigma, 0.0, LARGEST, closed=True)
    rho, gain = number("rho", rho, 0.0, 1.0), number("gain", gain, 0.0, LARGEST)
    if gain * rho < 1 - 1e-12:
        raise ProblemError(
            f"gain is {gain:g} and rho {rho:g}; expected a gain of at least 1/rho = {1 / rho:.6g}, "
            "so that the credit never falls below 0"
        )
    problem = discretise(plant, cost, period)
    certainty, unit = design_certainty("dynamic", problem), np.eye(problem.plant.states)
    excess = block_diagonal(unit, -(sigma**2) * unit)
    rule = Trigger({"silent": Form((DEVIATION, ESTIMATE), gain * excess), SEND: Form(plus={CREDIT: 1.0})})
    left = {CREDIT: rho}
    unused = (Form((DEVIATION, ESTIMATE), -excess, plus=left), Form((ESTIMATE,), sigma**2 * unit, plus=left))
    steps, initial = control_steps(
        problem.plant,
        certainty.estimation,
        certainty.regulator.L,
        actuation,
        rule,
        after=(Evaluate("controller", CREDIT, unused, SEND),),
    )
    guarantee, notes = bound_by_state(certainty, sigma, 0.0, "girard2015")
    return certainty_policy(
        "dynamic",
        certainty,
        steps,
        initial,
        identity=certainty.completed_square(),
        guarantee=guarantee,
        reset=certainty.reset(actuation),
        slower=max(1.0, 1 / (1 - rho) / certainty.settling),
        notes=notes,
    )
