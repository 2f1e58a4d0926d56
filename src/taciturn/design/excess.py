"""The excess trigger: send when silence would cost more than a price, which is exactly what its error costs."""

from __future__ import annotations

from taciturn._arrays import number
from taciturn.design.bounds import LARGEST, bound_by_silence
from taciturn.design.certainty import SEND, Actuation, Certainty, certainty_policy, control_steps, design_certainty
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import discretise
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.trigger import Form, Trigger


def excess(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    delta: float | None = None,
    theta: float | None = None,
    period: float | None = None,
    actuation: Actuation = "hold",
) -> Policy:
    """Design LQG control that sends if and only if silence would cost more than δ beyond sending always.

    With e = û − Lx̂, û the input applied in silence, J = J_all + E[(1−σ)e'He], H = R + B'KB: an input is sent iff
    e'He > δ. What is not sent costs at most δ, so J ≤ J_all + δ(1 − rate), in sends per tick; and e'He ≤ δ after each
    decision, so the loop is that of sending always under a bounded disturbance, stable in the mean square.

    Args:
        plant: the plant.
        cost: the average cost.
        delta: δ ≥ 0, a cost per step, or per second times seconds; or
        theta: θ ≥ 0, for δ = θ(J_all − c) of a tick, c the inter-sample noise cost, which no control changes: 0 of a
            discrete plant.
        period: seconds between ticks; only with a continuous plant.
        actuation: ``"hold"`` keeps the last input, ``"model"`` runs x̃⁺ = (A + BL) x̃ from the last sent estimate.

    Returns:
        The policy, with J ≤ J_all + δ(1 − rate), at most J_all + θ(J_all − c).

    Raises:
        ProblemError: none or both of δ and θ, one that is negative, period missing or out of place.
        UnstableError: no stabilising gain or filter.

    Source: astrom2002, khashooei2017

    Example:
        >>> policy = excess(Plant([[2.0]], [[1.0]], [[0.01]]), Cost([[1.0]], [[2.0]]), theta=0.1)
        >>> round(policy.guarantee.cost / policy.cost_all_time, 12)
        1.1
    """
    if (delta is None) == (theta is None):
        got = "neither delta nor theta is" if delta is None else f"delta ({delta:g}) and theta ({theta:g}) are both"
        raise ProblemError(f"{got} given; expected one of them, the price of silence")
    problem = discretise(plant, cost, period)
    certainty = design_certainty("excess", problem)
    price = _price(certainty, delta, theta)
    rule = Trigger({"silent": Form(("error",), certainty.regulator.H), SEND: Form(constant=price)})
    steps, initial = control_steps(problem.plant, certainty.estimation, certainty.regulator.L, actuation, rule)
    return certainty_policy(
        "excess",
        certainty,
        steps,
        initial,
        identity=certainty.completed_square(),
        guarantee=bound_by_silence(certainty, price, "khashooei2017"),
        reset=certainty.reset(actuation),
    )


def _price(certainty: Certainty, delta: float | None, theta: float | None) -> float:
    """Return δ per tick."""
    if delta is not None:
        return number("delta", delta, 0.0, LARGEST, closed=True)
    return number("theta", 0.0 if theta is None else theta, 0.0, LARGEST, closed=True) * certainty.cost_all_time
