"""A controller away from its sensor: an offline schedule queries the sensor, an online trigger sends the input."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array, choice, number
from taciturn._modes import radius
from taciturn.design.certainty import (
    CLOCK,
    COLLOCATED,
    SEND,
    completed_square,
    control_steps,
    count_ticks,
    silence_form,
)
from taciturn.design.estimation import ESTIMATE, HELD, Estimation
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete, discretise
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.queries import Predictor, Weights, follow_every_query, schedule_queries
from taciturn.lqg.riccati import regulate_discounted, regulate_finite
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import (
    Assign,
    ClosedForm,
    Decide,
    Guarantee,
    Innovations,
    LinkName,
    NodeName,
    Policy,
    Received,
    Send,
    Step,
)
from taciturn.model.trigger import Form, Matrix, Scheduled, Trigger

Controller = Literal["remote", "actuator", "sensor"]
LINKS: Mapping[Controller, tuple[LinkName, ...]] = {
    "remote": ("actuator", "sensor"),
    "actuator": ("sensor",),
    "sensor": ("actuator",),
}
SITES: Mapping[Controller, tuple[frozenset[NodeName], ...]] = {
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
    """Design the policy that queries the sensor by a schedule and sends the input by a trigger.

    The measurement of step k reaches the control of step k + 1: x̂_k predicts x_k with error covariance Σ_k. The sensor
    is queried iff h(Σ_k) > ζ, where h is what a query now saves of the optimal cost-to-go; covariances alone decide, so
    the schedule is computed here. The input is sent iff

        [x̂; û]'Γ[x̂; û] > θ tr(QΣ_k),  Γ = [[(1+θ)P − θQ, N + α(1+θ)A'KB], [·, R + α(1+θ)B'KB]]

    with û the input held and P = L'(R + αB'KB)L. Of a finite horizon K, L, P and h depend on the step (K_{k+1} in Γ_k).

    Args:
        plant: the plant.
        cost: an average, a discounted sum or a finite horizon.
        theta: the share θ ≥ 0; not with controller = "actuator".
        zeta: the price ζ ≥ 0 of a query, in cost per tick; not with controller = "sensor".
        controller: ``"remote"``, or at the place of the ``"actuator"`` or the ``"sensor"``: then one link is left.
        period: seconds between ticks; only with a continuous plant.

    Returns:
        The policy with its schedule, and J ≤ (1+θ)(J_all + ζ) for an average, (1+θ)(J_all + ζ/(1−α)) discounted,
        (1+θ)(J_all + (N−1)ζ) for N steps; mean-square stable.

    Raises:
        ProblemError: θ or ζ negative, missing or of no use; period missing or out of place.
        UnstableError: no stabilising gain or filter, or no schedule that repeats.

    Source: khashooei2017

    Example:
        >>> plant = Plant([[2.0]], [[1.0]], [[0.01]], [[3.0]], [[0.02]])
        >>> remote_lqg(plant, Cost([[1.0]], [[2.0]]), theta=0.2, zeta=1.5).schedule.period
        3
    """
    choice("controller", controller, ("remote", "actuator", "sensor"))
    theta = _parameter("theta", theta, controller, "actuator")
    zeta = _parameter("zeta", zeta, controller, "sensor")
    problem = discretise(plant, cost, period)
    model = problem.plant
    gains, prices = _regulate(problem)
    always = follow_every_query(model, prices.initial, cost.horizon)
    raw_all_time = prices.cost(*always)
    schedule = None
    if controller != "sensor":
        weights = Weights(prices.P, cost.discount)
        schedule = schedule_queries(model, weights, zeta, prices.initial)
        schedule = schedule.repeating() if prices.average else schedule
    covariance, start = always if schedule is None else (schedule.covariance, schedule.start)
    queries = np.full(len(covariance), True) if schedule is None else schedule.queries
    constant = prices.in_units(prices.cost(covariance, start))
    estimation, filtering = _estimate(model, controller, covariance, queries)
    if controller == "actuator":
        steps, initial = _at_the_actuator(estimation, gains, model.inputs), estimation.initial
    else:
        threshold = theta * (problem.Q * covariance).sum(axis=(1, 2))
        rule = {"silent": silence_form(problem, prices.H, theta), SEND: Form(constant=Scheduled(CLOCK, threshold))}
        steps, initial = control_steps(model, estimation, gains, "hold", Trigger(rule))
    square = completed_square(constant, prices.form(prices.H))
    one_tick = prices.average and len(covariance) == 1
    return Policy(
        kind="remote-lqg",
        steps=steps,
        model=model,
        cost_all_time=prices.in_units(raw_all_time),
        scheduled=LINKS[controller],
        sites=SITES[controller],
        locations=(count_ticks(len(covariance), start),),
        initial=initial,
        tick=problem.tick,
        noise_cost=problem.noise_cost,
        settling=1 / (1 - max(filtering, prices.closed_loop)) if prices.average else 0.0,
        cost=cost,
        guarantee=Guarantee(
            prices.in_units((1 + theta) * (raw_all_time + zeta * prices.queries_paid)),
            f"J ≤ (1+θ)(J_all + {prices.queries_text}), mean-square stable",
            "khashooei2017",
        ),
        identity=None if controller == "actuator" else square,
        innovations=estimation.innovations if one_tick else None,
        closed_form=ClosedForm(constant, {"sensor": schedule.rate})
        if controller == "actuator" and schedule is not None
        else None,
        schedule=schedule,
    )


@dataclass(frozen=True, eq=False)
class _Prices:
    """What inputs and errors cost, at each tick of a finite horizon or always the same.

    Args:
        problem: the problem from tick to tick.
        K: cost-to-go, (n, n), or (N + 1, n, n).
        H: price of another input, (m, m), or (N, m, m).
        P: price of an estimation error, (n, n), or (N, n, n).
        initial: error covariance from which the schedule starts: that of the initial state, or the steady one of an
            average.
        closed_loop: spectral radius of A + BL of an average.
    """

    problem: Discrete
    K: Array
    H: Array
    P: Array
    initial: Array
    closed_loop: float

    @property
    def average(self) -> bool:
        """Whether the cost is an average, not the total of a mission."""
        return self.problem.cost.horizon is None and self.problem.cost.discount == 1

    @property
    def ticks(self) -> float:
        """Ticks that a total counts, each with its weight."""
        cost = self.problem.cost
        return 1 / (1 - cost.discount) if cost.horizon is None else float(cost.horizon)

    @property
    def queries_paid(self) -> float:
        """How often the guarantee counts the price of a query."""
        return 1.0 if self.average else self.ticks - (self.problem.cost.horizon is not None)

    @property
    def queries_text(self) -> str:
        """The same, as the theorem writes it."""
        finite = self.problem.cost.horizon is not None
        return "ζ" if self.average else "(N−1)ζ" if finite else "ζ/(1−α)"

    def form(self, H: Array) -> Array | Scheduled:
        """Return the weight of the completed square in the units of the cost."""
        scaled = H / self.problem.tick if self.average else H
        return scaled if H.ndim == 2 else Scheduled(CLOCK, scaled)

    def in_units(self, raw: float) -> float:
        """Return a cost per tick, or a total, with the inter-sample noise cost in the units of the cost."""
        return self.problem.per_unit(raw) if self.average else raw + self.problem.noise_cost * self.ticks

    def cost(self, covariance: Array, start: int | None) -> float:
        """Return the cost of sending every input, the error covariances given: per tick, or the total.

        tr(KW) + mean tr(PΣ_k);  Σ tr(P_kΣ_k) + E[x_0'K_0x_0] + Σ tr(K_{k+1}W);  discounted likewise.
        """
        plant, alpha = self.problem.plant, self.problem.cost.discount
        errors = (self.P * covariance).sum(axis=(1, 2))
        if self.average:
            return float(np.sum(self.K * plant.W) + errors[start:].mean())
        first = self.K if self.K.ndim == 2 else self.K[0]
        total = plant.mean @ first @ plant.mean + np.sum(first * plant.covariance)
        if start is None:
            return float(total + np.sum(self.K[1:] * plant.W) + errors.sum())
        weights = alpha ** np.arange(len(errors))
        weights[start:] /= 1 - alpha ** (
            len(errors) - start
        )  # each later turn of the cycle counts α^period of the last
        return float(total + weights @ errors + alpha / (1 - alpha) * np.sum(self.K * plant.W))


def _regulate(problem: Discrete) -> tuple[Matrix, _Prices]:
    """Return the gain L and the prices of the cost that the problem has."""
    plant, cost = problem.plant, problem.cost
    if cost.horizon is not None:
        assert cost.terminal is not None
        found = regulate_finite(plant.A, plant.B, problem.Q, problem.R, problem.N, cost.terminal, cost.horizon)
        P = np.swapaxes(found.L, 1, 2) @ found.H @ found.L
        return Scheduled(CLOCK, found.L), _Prices(problem, found.K, found.H, P, plant.covariance, 0.0)
    best = regulate_discounted(plant.A, plant.B, problem.Q, problem.R, problem.N, cost.discount)
    average = cost.discount == 1
    initial = steady_filter(plant.A, plant.C, plant.W, plant.V).prior if average else plant.covariance
    P, slowest = best.L.T @ best.H @ best.L, radius(plant.A + plant.B @ best.L)
    return best.L, _Prices(problem, best.K, best.H, P, initial, slowest)


def _parameter(name: str, value: float | None, controller: Controller, place: Controller) -> float:
    """Return a parameter, 0 where the controller's place leaves it without use."""
    if controller == place:
        if value is not None:
            raise ProblemError(f"{name} is given with controller = {place!r}, which has no use for it: remove it")
        return 0.0
    if value is None:
        raise ProblemError(f"{name} is missing; expected a number, at least 0, with controller = {controller!r}")
    return number(name, value, 0.0, closed=True)


def _estimate(
    plant: Plant, controller: Controller, covariance: Array, queries: npt.NDArray[np.bool_]
) -> tuple[Estimation, float]:
    """Return the predicting filter along a schedule, and by how much its error shrinks per tick."""
    n, p = plant.states, plant.outputs
    predictor, turn = Predictor(plant), np.eye(n)
    gains = predictor.gain(covariance) * queries[:, None, None]
    for gain in gains:
        turn = (plant.A - gain @ plant.C) @ turn
    watch: tuple[Step, ...] = ()
    seen = {"y": np.eye(p), ESTIMATE: -plant.C}
    innovation = Assign("controller", "innovation", seen)
    innovations = None
    if controller == "sensor":
        S = plant.C @ covariance[0] @ plant.C.T + plant.V
        innovations = Innovations("innovation", (S + S.T) / 2, ESTIMATE, covariance[0])
    else:
        asked = Form(constant=Scheduled(CLOCK, np.where(queries, -1.0, 1.0)))
        watch = (
            Decide("sensor", "query", Trigger({"silent": Form(), "query": asked})),
            Send("sensor", "sensor", ("y",), "query"),
        )
        nothing = {ESTIMATE: np.zeros((p, n))}
        innovation = Assign("controller", "innovation", (nothing, seen), Received("sensor"))
    moved = {ESTIMATE: plant.A, HELD: plant.B, "innovation": Scheduled(CLOCK, gains)}
    estimation = Estimation(
        (Assign("controller", ESTIMATE, {"prior": np.eye(n)}),),
        (*watch, innovation, Assign("controller", "prior", moved)),
        {"prior": plant.mean},
        innovations,
    )
    return estimation, radius(turn) ** (1 / len(gains))


def _at_the_actuator(estimation: Estimation, L: Matrix, inputs: int) -> tuple[Step, ...]:
    """Return the steps of a controller that needs no link to the actuator."""
    command = {"command": np.eye(inputs)}
    return (
        *estimation.correct,
        Assign("controller", "command", {ESTIMATE: L}),
        Assign("actuator", "input", command),
        Assign("controller", HELD, command),
        *estimation.predict,
    )
