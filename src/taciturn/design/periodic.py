"""The baselines that ignore the state: sending at every tick, and optimal control at one rate."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array, choice, count
from taciturn._modes import radius, stationary
from taciturn.design.certainty import (
    CLOCK,
    SEND,
    Actuation,
    Certainty,
    certainty_policy,
    control_steps,
    count_ticks,
    design_certainty,
)
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete, discretise
from taciturn.lqg.periodic import lift, periodic_cost
from taciturn.lqg.riccati import regulate_continuous
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant, Prediction
from taciturn.model.policy import Assign, ClosedForm, Policy, Received, Send, Step
from taciturn.model.theory import Reset
from taciturn.model.trigger import Form, Scheduled, Trigger


def all_time(plant: Plant | ContinuousPlant, cost: Cost, *, period: float | None = None) -> Policy:
    """Design optimal LQG control that sends at every tick: J_all = tr(QΣ) + tr(K(Σ̃ − Σ)) per tick.

    Args:
        plant: the plant.
        cost: the average cost.
        period: seconds between ticks; only with a continuous plant.

    Returns:
        The policy, with its exact cost.

    Raises:
        ProblemError: period missing or out of place.
        UnstableError: no stabilising gain or filter.

    Source: anderson1990optimal

    Example:
        >>> all_time(Plant([[0.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])).cost_all_time
        1.0
    """
    certainty = design_certainty("all-time", discretise(plant, cost, period))
    return _every_tick("all-time", certainty)


def periodic(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    every: int | None = None,
    period: float | None = None,
    actuation: Actuation = "hold",
) -> Policy:
    """Design the optimal controller that sends at one rate, whatever happens.

    A discrete plant is measured and filtered at every step and its input sent every ``every`` steps; a continuous one
    is sampled exactly at ``period`` [astrom1997computer]. With ``actuation = "model"`` the actuator predicts between
    sends: in continuous time where the plant is continuous.

    Args:
        plant: the plant.
        cost: the average cost.
        every: steps between sends, at least 1; with a discrete plant.
        period: seconds between sends; with a continuous plant.
        actuation: ``"hold"`` or ``"model"``; the latter wants the full state where the plant is continuous.

    Returns:
        The policy, with its exact cost.

    Raises:
        ProblemError: every or period missing or out of place, or output feedback with a continuous prediction.
        UnstableError: no stabilising gain at this rate.

    Source: astrom1997computer

    Example:
        >>> plant = ContinuousPlant([[0.0]], [[1.0]], [[1.0]])
        >>> periodic(plant, Cost([[1.0]], [[1.0]]), period=0.5).closed_form.rates
        {'actuator': 1.0}
    """
    choice("actuation", actuation, ("hold", "model"))
    if isinstance(plant, ContinuousPlant):
        if every is not None:
            raise ProblemError("every is given with a continuous-time plant; expected period, in seconds")
        if actuation == "model":
            return _predicted(plant, cost, period)
        return _every_tick("periodic", design_certainty("periodic", discretise(plant, cost, period)))
    certainty = design_certainty("periodic", discretise(plant, cost, period))
    if every is None:
        raise ProblemError("every is missing; expected the steps between sends, at least 1")
    every = count("every", every)
    if actuation == "model":
        L, average = certainty.regulator.L, _predicted_cost(certainty, every)
    else:
        p = certainty.problem
        held = periodic_cost(plant.A, plant.B, p.Q, p.R, p.N, certainty.filter, every)
        L, average = held.regulator.L, held.cost
    turn = Scheduled(CLOCK, [-1.0] + [1.0] * (every - 1))
    trigger = Trigger({"silent": Form(), SEND: Form(constant=turn)})
    steps, initial = control_steps(certainty.problem.plant, certainty.estimation, L, actuation, trigger)
    return by_the_clock("periodic", certainty, steps, initial, average, 1 / every, every, certainty.reset(actuation))


def _every_tick(kind: str, certainty: Certainty) -> Policy:
    plant, L = certainty.problem.plant, certainty.regulator.L
    steps, initial = control_steps(plant, certainty.estimation, L, "hold", None)
    return by_the_clock(kind, certainty, steps, initial, certainty.cost_all_time, 1.0, 1)


def by_the_clock(
    kind: str,
    certainty: Certainty,
    steps: tuple[Step, ...],
    initial: dict[str, Array],
    average: float,
    rate: float,
    length: int,
    reset: Reset | None = None,
) -> Policy:
    """Return a policy whose clock of so many ticks decides all, with its cost and its sends per tick."""
    return certainty_policy(
        kind,
        certainty,
        steps,
        initial,
        identity=None,
        locations=(count_ticks(length, 0),),
        closed_form=ClosedForm(certainty.problem.per_unit(average), {"actuator": rate}),
        reset=reset,
        slower=length,
    )


def _predicted_cost(certainty: Certainty, every: int) -> float:
    """J_all + (1/k) Σ_{j<k} tr(L'HL V_j): the error before a send is what the innovations of j steps have left."""
    plant = certainty.problem.plant
    free = np.zeros((plant.inputs, plant.inputs))
    excess = lift(
        plant.A, plant.B, certainty.square, free, np.zeros_like(plant.B), certainty.corrections, every
    ).noise_cost
    return certainty.cost_all_time + excess / every


def _predicted(plant: ContinuousPlant, cost: Cost, period: float | None) -> Policy:
    """Samples sent to an actuator that runs ẋ̂ = (A + BL)x̂ between them; the scheduled link is the sensor's."""
    if not plant.full_state:
        raise ProblemError(
            "actuation = 'model' with a continuous-time plant needs the full state; "
            "expected no C and V, or actuation = 'hold'"
        )
    L = regulate_continuous(plant.A, plant.B, cost.Q, cost.R, cost.N).L
    prediction = Prediction.of(plant, L)
    problem: Discrete = discretise(plant, cost, period, prediction)
    unit = np.eye(plant.states)
    closed = problem.plant.A + problem.plant.B
    spread = stationary(closed, problem.plant.W)
    average = float(np.trace((problem.Q + problem.N + problem.N.T + problem.R) @ spread))
    per_unit = (average + problem.noise_cost) / problem.tick
    return Policy(
        kind="periodic",
        steps=(
            Send("sensor", "sensor", ("y",)),
            Assign("controller", "input", ({"input": unit}, {"y": unit}), Received("sensor")),
        ),
        model=problem.plant,
        cost_all_time=per_unit,
        scheduled=("sensor",),
        sites=(frozenset({"controller", "actuator"}),),
        tick=problem.tick,
        noise_cost=problem.noise_cost,
        settling=1 / (1 - radius(closed)),
        cost=cost,
        prediction=prediction,
        closed_form=ClosedForm(per_unit, {"sensor": 1.0}),
    )
