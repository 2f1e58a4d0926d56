"""Time-triggered LQG control, which sends at every step or at other fixed steps.

With a cycle of intervals, the input of each interval is held, or a model at the actuator predicts the state. The gains
solve the periodic Riccati equation of the cycle, and the cost is exact (``design/at_fixed_steps``). With a model in
continuous time, the sensor sends its samples, and the cost is tr((Q + N + N' + R)Σ) of the sampled problem whose input
is the state of the model, Σ the covariance of the state at the samples.

Source: astrom1997computer, bengaid2006
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from taciturn._arrays import choice, count
from taciturn.base.certainty import Actuation, design_certainty, expect_average
from taciturn.design.at_fixed_steps import (
    every_tick,
    held_in_cycles,
    predicted_cost,
    send_at_fixed_steps,
    time_triggered,
)
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete, discretise
from taciturn.lqg.equation import stationary
from taciturn.lqg.riccati import regulate_continuous
from taciturn.model.controller import controller_from
from taciturn.model.cost import Cost
from taciturn.model.coverage import THEORY
from taciturn.model.plant import ContinuousPlant, Plant, Prediction
from taciturn.model.policy import Policy
from taciturn.model.steps import Assign, Received, Send
from taciturn.model.theory import ClosedForm, Theory

LONGEST = 1_000_000  # largest number of steps of a cycle
MEASURES_WHEN_IT_SENDS = (
    "it measures only when it sends; with every = 1, 2, … and a shorter period it measures between sends too"
)


def periodic(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    every: int | Sequence[int] | None = None,
    period: float | None = None,
    actuation: Actuation = "hold",
    controller: object = None,
) -> Policy:
    """Design the optimal time-triggered LQG controller, which sends at fixed steps.

    With ``every``, the plant is measured and filtered at every step, and the input is sent every ``every`` steps, or
    after each interval of a cycle. Without ``every``, a continuous plant is sampled exactly at ``period``
    [astrom1997computer] and every sample is sent, so the controller measures only when it sends. With
    ``actuation = "model"``, the actuator predicts between sends, in discrete time with ``every`` and in continuous time
    without it.

    Args:
        plant: the plant.
        cost: the average cost.
        every: steps from one send to the next, at least 1, or a cycle of such intervals, for example ``(4, 5)``.
        period: seconds between steps; only with a continuous plant.
        actuation: ``"hold"`` or ``"model"``; ``"model"`` requires a measured full state if the plant is continuous and
            ``every`` is not given.
        controller: a linear controller to keep, or an object that ``controller_from`` converts; it computes at every
            step, also between sends. Default: LQG with the best gains for these sends.

    Returns:
        The policy, with its exact cost.

    Raises:
        ProblemError: if every or period is missing or not applicable, or a continuous prediction is combined with C or
            V.
        UnstableError: if no stabilising gain exists at this rate.

    Source: astrom1997computer, bengaid2006

    Example:
        >>> plant = ContinuousPlant([[0.0]], [[1.0]], [[1.0]])
        >>> periodic(plant, Cost([[1.0]], [[1.0]]), period=0.5).theory.closed_form.rates
        {'actuator': 1.0}
        >>> periodic(plant, Cost([[1.0]], [[1.0]]), period=0.1, every=(4, 6)).theory.closed_form.rates
        {'actuator': 0.2}
    """
    choice("actuation", actuation, ("hold", "model"))
    if controller is not None:
        expect_average("periodic", cost)
        kept, sends = controller_from(controller), _cycle(1 if every is None and period is not None else every)
        return send_at_fixed_steps("periodic", plant, cost, period, kept, "actuator", sends, actuation)
    if every is None and isinstance(plant, ContinuousPlant):
        if actuation == "model":
            return _predicted(plant, cost, period)
        certainty = design_certainty("periodic", discretise(plant, cost, period))
        return every_tick("periodic", certainty, () if plant.full_state else (MEASURES_WHEN_IT_SENDS,))
    certainty = design_certainty("periodic", discretise(plant, cost, period))
    intervals = _cycle(every)
    if actuation == "hold":
        return held_in_cycles("periodic", certainty, certainty.held.solve(intervals))
    average = predicted_cost(certainty, intervals)
    return time_triggered("periodic", certainty, certainty.regulator.L, "model", intervals, average)


def _cycle(every: object) -> tuple[int, ...]:
    """Return the intervals between sends."""
    if every is None:
        raise ProblemError(
            "every is missing; expected the number of steps between sends, at least 1, or a list of such numbers"
        )
    listed = list(cast("Sequence[object]", every)) if isinstance(every, list | tuple) else [every]
    intervals = tuple(count("every", ticks) for ticks in listed)
    if not intervals:
        raise ProblemError(
            "every = []; expected the number of steps between sends, at least 1, or a list of such numbers"
        )
    if sum(intervals) > LONGEST:
        raise ProblemError(
            f"the intervals in the list 'every' add up to {sum(intervals)} steps; expected at most {LONGEST} steps"
        )
    return intervals


def _predicted(plant: ContinuousPlant, cost: Cost, period: float | None) -> Policy:
    """Return the policy that sends samples over the sensor link to an actuator that runs ẋ̂ = (A + BL)x̂ between them."""
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
    place = np.ix_(problem.moving, problem.moving)
    spread = stationary(closed[place], problem.plant.W[place])
    average = float(np.trace((problem.Q + problem.N + problem.N.T + problem.R)[place] @ spread))
    per_unit = (average + problem.noise_cost) / problem.tick
    return Policy(
        kind="periodic",
        steps=(
            Send("sensor", "sensor", ("y",)),
            Assign("controller", "input", ({"input": unit}, {"y": unit}), Received("sensor")),
        ),
        model=problem.plant,
        theory=Theory(
            cost=cost,
            cost_all_time=per_unit,
            noise_cost=problem.noise_cost,
            settling=1 / (1 - problem.slowest(closed)),
            closed_form=ClosedForm(per_unit, {"sensor": 1.0}),
            covers=THEORY,
        ),
        sites=(frozenset({"controller", "actuator"}),),
        tick=problem.tick,
        prediction=prediction,
    )


KIND = Kind(
    name="periodic",
    design=periodic,
    goal="only a rate that is known in advance, with the best gains",
    tuning=(
        TradeoffParameter("every", least=1, whole=True, cycles=True),
        TradeoffParameter("period", continuous=True),
    ),
    example={"every": 3},
    nodes="S+C, A (`model` with a continuous plant: S, C+A)",
    proved="cost and rate, exactly",
    data='the step counter `clock`; the constant of "send", read from a table by `clock`',
    order="filter, command, decide by the step counter, send, hold or model, predict",
    usual={"every": 2},
    asked=("every",),
    runs_with_losses=True,
    keeps_controller=True,
)
