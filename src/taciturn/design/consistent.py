"""Consistent periodic event-triggered control: a threshold that provably beats periodic control at its own rate."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array, instance, number
from taciturn._modes import radius
from taciturn.design.certainty import SEND, expect_average
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import discretise
from taciturn.lqg.prediction import prediction_cost
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant, Prediction
from taciturn.model.policy import Assign, Decide, Guarantee, Identity, Policy, Received, Send, Step
from taciturn.model.trigger import Form, Trigger

ERROR = "error"
ROUNDING = 1e-12  # relative, of a threshold that is given as its largest value


def consistent(plant: Plant | ContinuousPlant, cost: Cost, *, period: float, delta: float | None = None) -> Policy:
    """Design the policy that looks every τ seconds, and sends the state when predicting on would cost too much.

    Both ends run dx̂/dt = (A + BL)x̂, set to x at a send; with e = x − x̂ before the decision the state is sent iff

        e'Γ(τ)e > δ,  Γ(τ) = ∫_0^τ e^{A't} L'RL e^{At} dt.

    With V_p(r) the cost of sending at the rate r, which is convex, V + δr ≤ V_p(1/τ) + δ/τ. Where δ is at most the
    slope −V_p'(1/τ), this line is below V_p: at its own rate r the policy costs no more than periodic control. Without
    noise nothing is sent. The cost is exactly V_p(1/τ) + E[(1−σ)e'Γe]/τ.

    Args:
        plant: continuous in time, its full state measured; Wiener noise or jumps.
        cost: an average.
        period: τ > 0, seconds between checks.
        delta: δ ≥ 0; omitted: its largest consistent value.

    Returns:
        The policy with its guarantee; none where δ is above its largest consistent value.

    Raises:
        ProblemError: a discrete plant, C or V, a horizon or discount, or a parameter out of range.
        UnstableError: no stabilising gain.

    Source: khashooei2017

    Example:
        >>> plant = ContinuousPlant([[0.0]], [[1.0]], [[1.0]])
        >>> policy = consistent(plant, Cost([[1.0]], [[1.0]]), period=0.5)
        >>> policy.cost_all_time, policy.guarantee.at_rate(1.0)  # V_p(2) = 1 + 0.5/2
        (1.25, 1.25)
    """
    plant, period = refuse_what_is_not_predicted("consistent", plant, cost), number("period", period, 0.0)
    price = prediction_cost(plant.A, plant.B, cost.Q, cost.R, cost.N, plant.W)
    prediction = Prediction.of(plant, price.L)
    problem = discretise(plant, cost, period, prediction)
    largest, base, Gamma = price.slope_in_rate(period), price.periodic(period), price.weight(period)
    delta = largest if delta is None else number("delta", delta, 0.0, closed=True)
    guarantee, notes = None, tuple[str, ...]()
    if delta <= largest * (1 + ROUNDING):
        statement = "V + δr ≤ V_p(1/τ) + δ/τ, and V ≤ V_p(r): no worse than periodic control at its rate"
        guarantee = Guarantee(base + delta / period, statement, "khashooei2017", base, delta / period)
    else:
        notes = (f"delta = {delta:g} is above its largest consistent value {largest:.6g}: consistency not guaranteed",)
    closed = problem.plant.A + problem.plant.B
    rule = Trigger({"silent": Form((ERROR,), Gamma), SEND: Form(constant=delta)})
    return Policy(
        kind="consistent",
        steps=predicted_steps(closed, rule),
        model=problem.plant,
        cost_all_time=base,
        scheduled=("sensor",),
        sites=(frozenset({"controller", "actuator"}),),
        initial={"prediction": plant.mean, "forecast": plant.mean},
        tick=problem.tick,
        noise_cost=problem.noise_cost,
        settling=1 / (1 - radius(closed)),
        cost=cost,
        prediction=prediction,
        guarantee=guarantee,
        identity=Identity(base, (Form((ERROR,), Gamma / period), Form()), SEND),
        reset=ERROR,
        notes=notes,
    )


def refuse_what_is_not_predicted(kind: str, plant: Plant | ContinuousPlant, cost: Cost) -> ContinuousPlant:
    """Return the plant, if both ends can predict its state in continuous time.

    Raises:
        ProblemError: a discrete plant, C or V, or a cost that is no average.
    """
    instance("plant", plant, Plant, ContinuousPlant)
    instance("cost", cost, Cost)
    if isinstance(plant, Plant):
        raise ProblemError(
            f"the plant is discrete in time, and {kind} predicts in continuous time; "
            "expected a continuous plant: remove plant.dt, and give A, B and W per second"
        )
    if not plant.full_state:
        raise ProblemError(f"C or V is given, and {kind} measures the full state; expected neither: remove them")
    expect_average(kind, cost)
    return plant


def predicted_steps(closed: Array, rule: Trigger) -> tuple[Step, ...]:
    """Return the steps of a sensor that decides on the error of a prediction it shares with the other end.

    Args:
        closed: e^{(A+BL)τ}, (n, n).
        rule: over ``error``, the state less its prediction.
    """
    unit = np.eye(len(closed))
    return (
        Assign("sensor", ERROR, {"y": unit, "prediction": -unit}),
        Decide("sensor", SEND, rule),
        Send("sensor", "sensor", ("y",), SEND),
        Assign("controller", "estimate", ({"forecast": unit}, {"y": unit}), Received("sensor")),
        Assign("actuator", "input", {"estimate": unit}),
        Assign("controller", "forecast", {"estimate": closed}),
        Assign("sensor", "copy", ({"prediction": unit}, {"y": unit}), SEND),
        Assign("sensor", "prediction", {"copy": closed}),
    )
