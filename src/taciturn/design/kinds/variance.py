"""Variance-based triggering: the sensor sends when the predicted variance of an output exceeds a threshold."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array, number
from taciturn.design.certainty import CLOCK, count_ticks, design_certainty, sensor_policy
from taciturn.design.estimation import ESTIMATE, HELD, FilterSteps
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.lqg.discrete import discretise
from taciturn.lqg.kalman import forgetting
from taciturn.lqg.queries import Predictor, schedule_by_variance
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Assign, Decide, Policy, Received, Send
from taciturn.model.schedule import Schedule
from taciturn.model.theory import ClosedForm
from taciturn.model.trigger import Form, Scheduled, Trigger


def variance(plant: Plant | ContinuousPlant, cost: Cost, *, threshold: float, period: float | None = None) -> Policy:
    """Design LQG control whose sensor sends when the predicted variance (CΣ̃C')_ii of some output exceeds a threshold.

    Σ̃ is the error covariance of the state prediction at both ends. Since Σ̃ does not depend on the measured values, the
    rule is a repeating schedule that is computed offline. The controller is at the actuator and filters the received
    measurements.

    Args:
        plant: the plant.
        cost: the average cost.
        threshold: a variance in the units of y², at least 0.
        period: seconds between steps; only with a continuous plant.

    Returns:
        The policy with its schedule and its exact cost.

    Raises:
        ProblemError: if the threshold is below 0, or period is missing or not applicable.
        UnstableError: if no stabilising gain or filter exists, or no schedule repeats.

    Source: trimpe2014

    Example: a random walk of variance 1 that is measured exactly.

        >>> plant, cost = Plant([[1.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
        >>> variance(plant, cost, threshold=2.5).theory.closed_form.rates
        {'sensor': 0.3333333333333333}
    """
    threshold = number("threshold", threshold, 0.0, closed=True)
    problem = discretise(plant, cost, period)
    certainty = design_certainty("variance", problem)
    schedule, plant = schedule_by_variance(problem.plant, threshold), problem.plant
    corrections = Predictor(plant).correction(schedule.covariance) * schedule.queries[:, None, None]
    unit = np.eye(plant.states)
    left = unit - corrections @ plant.C
    posterior = left @ schedule.covariance @ left.swapaxes(1, 2) + corrections @ plant.V @ corrections.swapaxes(1, 2)
    noise = float(np.sum(certainty.regulator.K * plant.W))
    average = noise + float(np.sum(certainty.square * posterior.mean(axis=0)))
    return sensor_policy(
        "variance",
        certainty,
        _measured(plant, schedule, corrections),
        forgetting(
            plant,
            [plant.A @ kept for kept in left],
            certainty.regulator.slowest,
            "there are too few measurements to determine states that the noise does not reach; expected a smaller "
            "threshold, or noise V on the measurement",
        ),
        locations=(count_ticks(len(schedule.queries), 0),),
        closed_form=ClosedForm(problem.per_unit(average), {"sensor": schedule.rate}),
        schedule=schedule,
    )


def _measured(plant: Plant, schedule: Schedule, corrections: Array) -> FilterSteps:
    """Return the policy steps that send and filter the scheduled measurements."""
    p, n = plant.outputs, plant.states
    turn = Form(constant=Scheduled(CLOCK, np.where(schedule.queries, -1.0, 1.0)))
    nothing, seen = {"prior": np.zeros((p, n))}, {"y": np.eye(p), "prior": -plant.C}
    return FilterSteps(
        (
            Decide("sensor", "query", Trigger({"silent": Form(), "query": turn})),
            Send("sensor", "sensor", ("y",), "query"),
            Assign("controller", "innovation", (nothing, seen), Received("sensor")),
            Assign("controller", ESTIMATE, {"prior": np.eye(n), "innovation": Scheduled(CLOCK, corrections)}),
        ),
        (Assign("controller", "prior", {ESTIMATE: plant.A, HELD: plant.B}),),
        {"prior": plant.mean},
        None,
    )


KIND = Kind(
    name="variance",
    design=variance,
    goal="a schedule of measurements that is known in advance",
    tuning=(TradeoffParameter("threshold"),),
    example={"threshold": 0.05},
    nodes="S, C+A",
    proved="cost and rate, exactly",
    data="the step counter `clock` of the schedule; queries and filter gains are read by `clock`",
    order="decide by the step counter, send y, filter on `Received`, input",
)
