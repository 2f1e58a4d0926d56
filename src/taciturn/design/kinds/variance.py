"""Variance-based triggering: a sensor sends when the predicted variance of one of its outputs exceeds a threshold.

The error covariance Σ̃ of the prediction depends on which measurements were sent, and not on their values. So the rule
(CΣ̃C')_ii > threshold is a recursion without data, whose covariances return to earlier ones: a schedule that repeats
(``lqg/queries``). The controller is at the actuator and sends no inputs. The cost is exact, J = tr(KW) + the mean of
tr(L'HL Σ) over the schedule, with Σ after the measurements of each step.

Source: trimpe2014
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from taciturn._arrays import Array, number
from taciturn.base.certainty import design_certainty, steps_at_the_actuator
from taciturn.base.filter import CLOCK, ESTIMATE, HELD, FilterSteps, count_ticks
from taciturn.base.nominal import Nominal
from taciturn.design.at_fixed_steps import innovation_at_queries
from taciturn.design.kind import Kind, TradeoffParameter, check_place, on_any_network
from taciturn.lqg.discrete import discretise
from taciturn.lqg.kalman import forgetting
from taciturn.lqg.queries import corrections_of, schedule_by_variance
from taciturn.model.cost import Cost
from taciturn.model.coverage import THEORY
from taciturn.model.network import IDEAL, Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.schedule import Schedule
from taciturn.model.steps import Assign, Step
from taciturn.model.theory import ClosedForm, Theory
from taciturn.model.trigger import Scheduled


@on_any_network
def variance(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    threshold: float,
    period: float | None = None,
    network: Network | None = None,
) -> Policy:
    """Design LQG control whose sensor sends when the predicted variance (CΣ̃C')_ii of an output exceeds a threshold.

    Σ̃ is the error covariance of the state prediction at all nodes. Since Σ̃ does not depend on the measured values, the
    rule is a repeating schedule that is computed offline. The controller is at the actuator and filters the received
    measurements.

    In a network with named nodes, each sensor with a link sends its outputs if the predicted variance of one of
    them exceeds the threshold, and the outputs of sensors at the controller's place are read at every step. Σ̃ takes
    into account which outputs were received.

    Args:
        plant: the plant.
        cost: the average cost.
        threshold: a variance in the units of y², at least 0.
        period: seconds between steps; only with a continuous plant.
        network: the nodes, all actuators at the controller's place; default: a sensor, and a controller at the place of
            the actuator. Links must be ideal.

    Returns:
        The policy with its schedule, its exact cost and the exact rate of each link.

    Raises:
        ProblemError: if the threshold is below 0, period is missing or not applicable, links drop or delay packets, an
            actuator has a link or no sensor has one.
        UnstableError: if no stabilising gain or filter exists, or no schedule repeats.

    Source: trimpe2014

    Example: a random walk of variance 1 that is measured exactly.

        >>> plant, cost = Plant([[1.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
        >>> variance(plant, cost, threshold=2.5).theory.closed_form.rates
        {'sensor': 0.3333333333333333}
    """
    threshold = number("threshold", threshold, 0.0, closed=True)
    network = network or IDEAL
    wired = _wired(network)
    problem = discretise(plant, cost, period)
    certainty, plant = design_certainty("variance", problem), problem.plant
    measured = network.measurements(plant.sensed, plant.set_points)
    sensors = {node: outputs for node, outputs in measured.values() if node in network.links}
    schedule = schedule_by_variance(plant, threshold, sensors)
    corrections = corrections_of(plant, schedule, sensors)
    unit = np.eye(plant.states)
    left = unit - corrections @ plant.C
    posterior = left @ schedule.covariance @ left.swapaxes(1, 2) + corrections @ plant.V @ corrections.swapaxes(1, 2)
    noise = float(np.sum(certainty.regulator.K * plant.W))
    # the schedule depends on no set-point, so the errors of the input are unrelated to the changes
    average = noise + certainty.overlap + float(np.sum(certainty.square * posterior.mean(axis=0)))
    settling = forgetting(
        plant,
        [plant.A @ kept for kept in left],
        certainty.regulator.slowest,
        "there are too few measurements to determine states that the noise does not reach; expected a smaller "
        "threshold, or noise V on the measurement",
    )
    estimation = _measured(plant, network, measured, schedule, corrections)
    return Nominal(problem, certainty.cost_all_time, settling, certainty.error).policy(
        "variance",
        steps_at_the_actuator(plant, estimation, certainty.regulator.L, network),
        estimation.initial,
        Theory(
            closed_form=ClosedForm(problem.per_unit(average), schedule.rates),
            fixed_rates=schedule.rates,
            covers=THEORY,
        ),
        sites=wired,
        locations=(count_ticks(len(schedule.queries), 0),),
        network=network,
        schedule=schedule,
    )


def _wired(network: Network) -> tuple[frozenset[str], ...]:
    """Return the nodes at the controller's place, as a group if there are several."""
    network = network.beside("actuator")
    for node in network.actuators:
        check_place("variance", network, "actuator", node, True)
    if not any(node in network.links for node in network.sensors):
        check_place("variance", network, "sensor", network.sensors[0], False)
    return network.sites_of_controller


def _measured(
    plant: Plant,
    network: Network,
    measured: Mapping[str, tuple[str, Sequence[int]]],
    schedule: Schedule,
    corrections: Array,
) -> FilterSteps:
    """Return the policy steps that send and filter the scheduled measurements."""
    # with one sensor, the signals have the names ``y`` and ``innovation``; with several, these and that of its node
    at, steps = network.controller, list[Step]()
    corrected: dict[str, Array | Scheduled] = {"prior": np.eye(plant.states)}
    for signal, (node, outputs) in measured.items():
        of, sent, rows = (f"_{node}", signal, [*outputs]) if len(measured) > 1 else ("", "y", [*range(plant.outputs)])
        if sent != signal:  # the outputs of the sensor in another order
            steps.append(Assign(node, sent, {signal: np.eye(plant.outputs)[:, [*outputs]]}))
        seen = {sent: np.eye(len(rows)), "prior": -plant.C[rows]}
        if node in network.links:
            steps += innovation_at_queries(node, at, seen, schedule.by_link[node].queries, of)
        else:
            steps.append(Assign(at, f"innovation{of}", seen))
        corrected[f"innovation{of}"] = Scheduled(CLOCK, corrections[:, :, rows])
    return FilterSteps(
        (*steps, Assign(at, ESTIMATE, corrected)),
        (Assign(at, "prior", {ESTIMATE: plant.A, HELD: plant.B}),),
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
    proved="cost and rates, exactly",
    data="the step counter `clock` of the schedule; queries and filter gains are read by `clock`",
    order="decide by the step counter, send y, filter on `Received`, input",
    several_nodes=True,
    ideal_links=True,
)
