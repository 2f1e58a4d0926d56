"""Remote LQG control: an offline schedule determines when to query the sensor, and an online trigger when to send.

The two decisions are independent. A query reduces the error covariance Σ of the prediction, which no input changes. So
its value h(Σ), by which all later costs are less, is known in advance, and the queries with h(Σ_k) > ζ are a schedule
(``lqg/queries``). Each query that is left out costs at most ζ. The sends of the input have the trigger of ``lqg`` for
this filter, which costs at most the factor 1 + θ. Together J ≤ (1 + θ)(J_all + ζ) for an average cost.

Source: khashooei2017
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from taciturn._arrays import Array, choice, number, symmetrised
from taciturn.base.certainty import (
    completed_square,
    control_steps,
    expect_constant_set_points,
    silence_form,
    steps_at_the_actuator,
)
from taciturn.base.filter import CLOCK, COLLOCATED, ESTIMATE, HELD, SEND, FilterSteps, by_clock, count_ticks
from taciturn.base.gains import Prices, price_control
from taciturn.base.nominal import Nominal
from taciturn.design.at_fixed_steps import innovation_at_queries
from taciturn.design.bounds import less_noise
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import discretise
from taciturn.lqg.kalman import expect_known_start, forgetting
from taciturn.lqg.queries import Predictor, Weights, follow_every_query, schedule_queries
from taciturn.model.cost import Cost
from taciturn.model.coverage import GAUSSIAN_THEORY, THEORY
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.schedule import Schedule
from taciturn.model.steps import Assign, Step
from taciturn.model.theory import ClosedForm, Guarantee, Innovations, Theory
from taciturn.model.trigger import Form, Scheduled, Trigger

Controller = Literal["remote", "actuator", "sensor"]
SITES: Mapping[Controller, tuple[frozenset[str], ...]] = {
    "remote": (),
    "actuator": (frozenset({"controller", "actuator"}),),
    "sensor": COLLOCATED,
}


def remote_lqg(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    theta: float | None = None,
    zeta: float | None = None,
    controller: Controller = "remote",
    period: float | None = None,
) -> Policy:
    """Design LQG control that queries the sensor by an offline schedule and sends the input by an online trigger.

    The measurement of step k is available to the control of step k + 1: x̂_k predicts x_k with error covariance Σ_k.
    The sensor is queried iff h(Σ_k) > ζ, where h is the reduction of the optimal cost-to-go by a query. Since h depends
    only on covariances, the schedule is computed offline. The input is sent iff

        [x̂; û]'Γ[x̂; û] > θ tr(QΣ_k),  Γ = [[(1+θ)P − θQ, N + α(1+θ)A'KB], [·, R + α(1+θ)B'KB]]

    with the held input û and P = L'(R + αB'KB)L. With a finite horizon, K, L, P and h depend on the step (K_{k+1} in
    Γ_k).

    Args:
        plant: the plant.
        cost: an average, a discounted sum or a finite-horizon cost.
        theta: the share θ ≥ 0; not with controller = "actuator".
        zeta: the price ζ ≥ 0 of a query, in cost per step; not with controller = "sensor".
        controller: site of the controller: ``"remote"``, or at the ``"actuator"`` or the ``"sensor"``, which leaves one
            link.
        period: seconds between steps; only with a continuous plant.

    Returns:
        The policy with its schedule, and J ≤ (1+θ)(J_all + ζ) for an average, (1+θ)(J_all + ζ/(1−α)) for a discounted
        sum, (1+θ)(J_all + (N−1)ζ) for N steps; mean-square stable. For a sampled plant, θ times the inter-sample noise
        cost is subtracted from the bound, since no control changes this cost.

    Raises:
        ProblemError: if θ or ζ is negative, missing or not applicable, or period is missing or not applicable.
        UnstableError: if no stabilising gain or filter exists, or no schedule repeats.

    Source: khashooei2017

    Example:
        >>> plant = Plant([[2.0]], [[1.0]], [[0.01]], [[3.0]], [[0.02]])
        >>> remote_lqg(plant, Cost([[1.0]], [[2.0]]), theta=0.2, zeta=1.5).schedule.period
        3
    """
    choice("controller", controller, SITES)
    theta = _parameter("theta", theta, controller, "actuator")
    zeta = _parameter("zeta", zeta, controller, "sensor")
    problem = discretise(plant, cost, period)
    prices = price_control(problem)
    all_time, watch = _watch(prices, None), _watch(prices, None if controller == "sensor" else zeta)
    cost_all_time = prices.total(all_time.covariance, all_time.start)
    cost_of_watch = problem.per_unit(prices.total(watch.covariance, watch.start))
    estimation = _estimate(problem.plant, watch)
    if controller == "actuator":
        steps, initial = steps_at_the_actuator(problem.plant, estimation, by_clock(prices.L)), estimation.initial
    else:
        threshold = theta * (problem.Q * watch.covariance).sum(axis=(1, 2))
        rule = {"silent": silence_form(problem, prices.H, theta), SEND: Form(constant=Scheduled(CLOCK, threshold))}
        steps, initial = control_steps(problem.plant, estimation, by_clock(prices.L), "hold", Trigger(rule))
    queries = problem.ticks - 1 if cost.horizon is not None else problem.ticks  # the last measurement is not used
    closed_form = None
    if controller == "actuator" and watch.schedule is not None:  # no decision depends on the state
        closed_form = ClosedForm(cost_of_watch, {"sensor": watch.schedule.rate})
    settling = _settling(prices, watch) if prices.average else 0.0
    nominal = Nominal(problem, cost_all_time, settling, innovations=estimation.innovations)
    return nominal.policy(
        "remote-lqg",
        steps,
        initial,
        Theory(
            guarantee=Guarantee(
                problem.per_unit((1 + theta) * (cost_all_time + zeta * queries)),
                _statement(prices, controller),
                "khashooei2017",
                more_sends=True,
            ),
            identity=None if controller == "actuator" else completed_square(cost_of_watch, prices.square()),
            closed_form=closed_form,
            fixed_rates={} if watch.schedule is None else {"sensor": watch.schedule.rate},
            covers=GAUSSIAN_THEORY if closed_form is None else THEORY,
        ),
        sites=SITES[controller],
        locations=(count_ticks(len(watch.covariance), watch.start),),
        schedule=watch.schedule,
    )


@dataclass(frozen=True, eq=False)
class _Watch:
    """The filter for a schedule of queries, or for measurements at every step."""

    covariance: Array  # error covariances Σ_k of the prediction, (steps, n, n)
    gains: Array  # gains of the innovation, zero at steps without a measurement, (steps, n, p)
    start: int | None  # step from which covariances and gains repeat, or None with a finite horizon
    schedule: Schedule | None  # schedule of the queries; None if the sensor is read at every step


def _watch(prices: Prices, zeta: float | None) -> _Watch:
    """Return the filter with queries at a price, or at every step if ``zeta`` is None; steady for an average cost."""
    plant, cost = prices.problem.plant, prices.problem.cost
    initial, steady = plant.covariance, None
    if prices.average:
        steady = prices.problem.filter()
        expect_known_start(plant, prices.K.diagonal() > 0)
        initial = steady.prior
    if zeta is not None:
        found = schedule_queries(plant, Weights(prices.P, cost.discount), zeta, initial)
        schedule = found.repeating() if prices.average else found
        gains = Predictor(plant).gain(schedule.covariance) * schedule.queries[:, None, None]
        return _Watch(schedule.covariance, gains, schedule.start, schedule)
    if steady is not None:  # its gain gives a stable observer even without noise
        return _Watch(steady.prior[None], (plant.A @ steady.gain)[None], 0, None)
    covariance, start = follow_every_query(plant, initial, cost.horizon, cost.discount)
    return _Watch(covariance, Predictor(plant).gain(covariance), start, None)


def _settling(prices: Prices, watch: _Watch) -> float:
    plant = prices.problem.plant
    return forgetting(
        plant,
        [plant.A - gain @ plant.C for gain in watch.gains],
        prices.problem.slowest(plant.A + plant.B @ prices.L),
        "there are too few queries to determine states that the noise does not reach; expected a smaller zeta, or "
        "noise V on the measurement",
    )


def _parameter(name: str, value: float | None, controller: Controller, place: Controller) -> float:
    """Return a parameter, or 0 if it does not apply at this site of the controller."""
    if controller == place:
        if value is not None:
            raise ProblemError(
                f"the parameter {name} is given with controller = {place!r}, which does not use it; expected no {name}"
            )
        return 0.0
    if value is None:
        raise ProblemError(
            f"the parameter {name} is missing; expected a number of at least 0, which controller = {controller!r} "
            "requires"
        )
    return number(name, value, 0.0, closed=True)


def _statement(prices: Prices, controller: Controller) -> str:
    """Return the theorem in one line."""
    if controller == "sensor":
        bound = "(1+θ) J_all"
    else:
        paid = "ζ" if prices.average else "ζ/(1−α)" if prices.problem.cost.horizon is None else "(N−1)ζ"
        bound = f"J_all + {paid}" if controller == "actuator" else f"(1+θ)(J_all + {paid})"
    if controller != "actuator":
        bound += less_noise(prices.problem, "θ")
    return f"J ≤ {bound}" + (", mean-square stable" if prices.average else "")


def _estimate(plant: Plant, watch: _Watch) -> FilterSteps:
    """Return the steps of the predictor x̂⁺ = Ax̂ + Bû + gain·innovation, with innovation 0 without a measurement."""
    expect_constant_set_points("remote-lqg", plant)
    n, p = plant.states, plant.outputs
    seen = {"y": np.eye(p), ESTIMATE: -plant.C}
    watched: tuple[Step, ...] = (Assign("controller", "innovation", seen),)
    innovations = None
    if watch.schedule is not None:
        watched = innovation_at_queries("sensor", "controller", seen, watch.schedule.queries)
    elif len(watch.covariance) == 1:  # steady: white innovations
        S = plant.C @ watch.covariance[0] @ plant.C.T + plant.V
        innovations = Innovations("innovation", symmetrised(S), ESTIMATE, watch.covariance[0])
    moved = {ESTIMATE: plant.A, HELD: plant.B, "innovation": Scheduled(CLOCK, watch.gains)}
    return FilterSteps(
        (Assign("controller", ESTIMATE, {"prior": np.eye(n)}),),
        (*watched, Assign("controller", "prior", moved)),
        {"prior": plant.mean},
        innovations,
    )


KIND = Kind(
    name="remote-lqg",
    design=remote_lqg,
    goal="a sensor that is queried by a schedule, and inputs that are sent when needed",
    tuning=(TradeoffParameter("theta", "actuator"), TradeoffParameter("zeta", "sensor")),
    example={"theta": 0.2, "zeta": 1.5},
    built_in="remote-scalar",
    nodes="S, C, A (or C with S or A); the sensor link has a delay of one step",
    costs=("average", "horizon", "discount"),
    follows=("constant",),
    proved=r"$J\le(1+\theta)(J_{all}+\zeta)$; the queries are a schedule",
    relative_to="LQG with every sample",
    refused="a sensor that is never queried with an unstable plant; a schedule that does not repeat",
    data=(
        "the step counter `clock` runs through the schedule and returns to the step from which the schedule "
        "repeats; queries, filter gains and tr(QΣ) are read by `clock`, and for a finite horizon also L and H"
    ),
    order=(
        "estimate := prior, command, candidate, error, decide, send, hold, decide the query by the step "
        "counter, send y, innovation on `Received`, predict"
    ),
    usual={"theta": 0.1},
    asked=("theta", "zeta"),
    offered=5,
)
