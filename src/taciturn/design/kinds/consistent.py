"""Consistent event-triggered control: provably, its cost is at most that of periodic control at the same send rate.

Every τ seconds, the error e of the prediction is compared with δ by its cost e'Γ(τ)e until the next check. The cost
V_p(1/τ) + E[(1−σ)e'Γe]/τ is then on or below a line through the point of periodic control with the period τ:

    V + δr ≤ V_p(1/τ) + δ/τ.

V_p is convex in the rate, so this line is below it for all r ≤ 1/τ if δ is at most its slope there, −V_p'(1/τ).

Source: khashooei2017
"""

from __future__ import annotations

from functools import partial

from taciturn._arrays import number
from taciturn.base.filter import SEND
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.design.prediction import ERROR, predict_continuously, predicted_policy, refuse_what_is_not_predicted
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.theory import Guarantee
from taciturn.model.trigger import Form, Trigger

ROUNDING = 1e-12  # relative tolerance for a threshold equal to its largest consistent value


def consistent(plant: Plant | ContinuousPlant, cost: Cost, *, period: float, delta: float | None = None) -> Policy:
    """Design the policy that checks the prediction error every τ seconds, and sends the state if the error is costly.

    Sensor and actuator run dx̂/dt = (A + BL)x̂, and a send sets x̂ to x. With e = x − x̂ before the decision, the state
    is sent iff

        e'Γ(τ)e > δ,  Γ(τ) = ∫_0^τ e^{A't} L'RL e^{At} dt.

    Let V_p(r) be the cost of periodic control at the rate r, which is convex. Then V + δr ≤ V_p(1/τ) + δ/τ. If δ is at
    most the slope −V_p'(1/τ), this line is below V_p, so the policy costs no more than periodic control at its own rate
    r. Without noise, nothing is sent. The cost is exactly V_p(1/τ) + E[(1−σ)e'Γe]/τ.

    Args:
        plant: continuous-time plant with measured full state; Wiener noise or jumps.
        cost: the average cost.
        period: τ > 0, seconds between checks.
        delta: threshold δ ≥ 0; default its largest consistent value.

    Returns:
        The policy with its guarantee, or without a guarantee if δ is above its largest consistent value.

    Raises:
        ProblemError: if the plant is discrete in time or has C or V, the cost has a horizon or a discount, or a
            parameter is out of range.
        UnstableError: if no stabilising gain exists.

    Source: khashooei2017

    Example:
        >>> plant = ContinuousPlant([[0.0]], [[1.0]], [[1.0]])
        >>> policy = consistent(plant, Cost([[1.0]], [[1.0]]), period=0.5)
        >>> policy.cost_all_time, policy.guarantee.at_rate(1.0)  # V_p(2) = 1 + 0.5/2
        (1.25, 1.25)
    """
    plant, period = refuse_what_is_not_predicted("consistent", plant, cost), number("period", period, 0.0)
    found = predict_continuously("consistent", plant, cost, period)
    largest, base = found.price.slope_in_rate(period), found.cost_all_time
    delta = largest if delta is None else number("delta", delta, 0.0, closed=True)
    guarantee, notes = None, tuple[str, ...]()
    if delta <= largest * (1 + ROUNDING):
        statement = "V + δr ≤ V_p(1/τ) + δ/τ, and V ≤ V_p(r): no worse than periodic control at its rate"
        guarantee = Guarantee(base + delta / period, statement, "khashooei2017", base, delta / period)
    else:
        notes = (f"delta = {delta:g} is above its largest consistent value {largest:.6g}: consistency not guaranteed",)
    rule = Trigger({"silent": Form((ERROR,), found.Gamma), SEND: Form(constant=delta)})
    return predicted_policy("consistent", found, rule, guarantee, notes)


KIND = Kind(
    name="consistent",
    design=consistent,
    goal="a cost proved to be no higher than that of periodic control at the same rate",
    tuning=(TradeoffParameter("delta"),),
    example={"period": 0.5},
    built_in="double-integrator",
    nodes="S, C+A",
    plants=("continuous", "jumps"),
    follows=(),
    proved=r"$V\le V_p(r)$",
    relative_to="periodic control",
    data=(
        "trigger e'Γ(τ)e against δ; the input is the state of the model, predicted in continuous time "
        "(`prediction`); `reset` names the error"
    ),
    order=(
        "error of the model, decide, send x, estimate on `Received`, forecast; copy and prediction at S on the decision"
    ),
    offered=3,
    check=partial(refuse_what_is_not_predicted, "consistent"),
)
