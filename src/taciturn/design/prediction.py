"""Policies whose actuator predicts the loop with a model, and which send when the prediction error is large.

The model predicts the state x̂ from the last packet, and the input is Lx̂. A send resets the error e = x − x̂, which then
grows with the dynamics of the plant and the noise until the next send. So the intervals between sends are independent
and alike (``renewal``), and silence costs a quadratic form of e alone:

* **In continuous time**, with a measured full state. Sensor and actuator run dx̂/dt = (A + BL)x̂ with the gain L of the
  continuous-time regulator, also between the checks, one every τ seconds. At a check, an error that is not sent costs
  e'Γ(τ)e until the next one, with Γ(τ) = ∫_0^τ e^{A't} L'RL e^{At} dt, so V = V_p(1/τ) + E[(1−σ)e'Γe]/τ with the cost
  V_p(1/τ) of sending at every check (``lqg/prediction``).
* **From step to step**, with outputs or a discrete plant. The actuator runs x̃⁺ = (A + BL)x̃, and silence costs e'L'HLe
  with e = x̃ − x̂ for the filtered estimate x̂ (``base/certainty``).

``modelled`` makes the policy of either form for a trigger that is given by a function of the error: kinds of other
packages use it for the optimal schedule and for shared channels.

Source: khashooei2017
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, instance
from taciturn._display import Displayed
from taciturn.base.certainty import certainty_policy, control_steps, design_certainty, expect_average
from taciturn.base.filter import SEND
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete, discretise
from taciturn.lqg.prediction import PredictionCost, prediction_cost
from taciturn.model.cost import Cost
from taciturn.model.coverage import SIMULATED, THEORY
from taciturn.model.plant import ContinuousPlant, Plant, Prediction
from taciturn.model.policy import Policy
from taciturn.model.steps import Assign, Decide, Received, Send, Step
from taciturn.model.theory import Guarantee, Identity, Reset, Theory
from taciturn.model.trigger import Form, Trigger

ERROR = "error"


@dataclass(frozen=True, eq=False, repr=False)
class Predicted(Displayed):
    """The design data that all policies share which check the prediction error every τ seconds."""

    problem: Discrete  # the discrete-time problem between checks; its input is the state of the model
    prediction: Prediction  # the model of the actuator
    price: PredictionCost  # cost of the prediction as a function of time
    Gamma: Array  # weight Γ(τ) of the error before the decision, for the cost of silence per check
    cost_all_time: float  # cost V_p(1/τ) of sending at every check, per second

    @property
    def reset(self) -> Reset:
        """Model of the prediction error, which each send resets to zero."""
        square = self.Gamma / self.problem.tick
        return Reset(self.problem.plant.W, {ERROR: np.eye(len(self.Gamma))}, square)


def predict_continuously(kind: str, plant: Plant | ContinuousPlant, cost: Cost, period: float | None) -> Predicted:
    """Compute the design data of a policy that checks a continuous-time plant's prediction error every τ seconds."""
    plant = refuse_what_is_not_predicted(kind, plant, cost)
    price = prediction_cost(plant.A, plant.B, cost.Q, cost.R, cost.N, plant.W)
    prediction = Prediction.of(plant, price.L)
    problem = discretise(plant, cost, period, prediction)
    tick = problem.tick
    return Predicted(problem, prediction, price, price.weight(tick), price.periodic(tick))


def predicted_policy(
    kind: str, predicted: Predicted, rule: Trigger, guarantee: Guarantee | None = None, notes: tuple[str, ...] = ()
) -> Policy:
    """Return the policy whose sensor decides with the given trigger, which reads the prediction error, when to send."""
    problem, base = predicted.problem, predicted.cost_all_time
    closed = problem.plant.A + problem.plant.B
    return Policy(
        kind=kind,
        steps=predicted_steps(closed, rule),
        model=problem.plant,
        theory=Theory(
            cost=problem.cost,
            cost_all_time=base,
            noise_cost=problem.noise_cost,
            settling=1 / (1 - problem.slowest(closed)),
            guarantee=guarantee,
            identity=Identity(base, (Form((ERROR,), predicted.Gamma / problem.tick), Form()), SEND),
            reset=predicted.reset,
            covers=THEORY,
        ),
        sites=(frozenset({"controller", "actuator"}),),
        initial={"prediction": problem.plant.mean, "forecast": problem.plant.mean},
        tick=problem.tick,
        prediction=predicted.prediction,
        notes=notes,
    )


def refuse_what_is_not_predicted(kind: str, plant: Plant | ContinuousPlant, cost: Cost) -> ContinuousPlant:
    """Raise an error unless sensor and actuator can predict the state of a continuous-time plant; return the plant."""
    instance("plant", plant, Plant, ContinuousPlant)
    instance("cost", cost, Cost)
    SIMULATED.check(plant, cost)
    if isinstance(plant, Plant):
        raise ProblemError(
            f"the plant is discrete in time, but the policy kind {kind} predicts in continuous time; expected a plant "
            "that is continuous in time: omit dt (plant.dt in a file), and give A, B and W per second"
        )
    if not plant.full_state:
        raise ProblemError(
            f"C or V is given, but the policy kind {kind} measures the full state; expected neither C nor V: remove "
            "them"
        )
    expect_average(kind, cost)
    return plant


def predicted_steps(closed: Array, rule: Trigger) -> tuple[Step, ...]:
    """Return the policy steps of a sensor and an actuator that predict the state, and send when the error is large."""
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


def modelled(
    kind: str,
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    silence: Callable[[Discrete, Reset], Form],
) -> Policy:
    """Return the policy whose actuator runs a model, and which sends if a function of the model's error is positive."""
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
            f"{noise}, and C or V is given, so successive estimation errors are dependent; expected Gaussian noise and "
            "constant set-points, or neither C nor V"
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
