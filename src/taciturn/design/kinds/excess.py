"""Excess trigger: the controller sends when not sending would increase the cost by more than a threshold.

By completion of squares J = J_all + E[(1−σ)e'He], e the error of the input and H = R + B'KB. The trigger sends iff this
term would exceed δ, so silence costs at most δ per step and

    J ≤ J_all + δ(1 − rate) ≤ (1 + θ)J_all   with δ = θ J_all.

Two forms have this rule. Optimal gains over an ideal actuator link need no more than e'He (``_lqg``). For a given
controller, for links that drop packets, and for a base with packets at every q-th step, silence is compared with a
packet by the value function of the base (``design/silence``). The cost of silence then also has a linear part.

With limits of the inputs, the cost of silence is that of a short forecast of both choices (``base/limited_value``).

Source: astrom2002, khashooei2017, antunes2014rollout, schenato2009
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from taciturn._arrays import choice, count, number
from taciturn.base.certainty import Actuation as LQGActuation
from taciturn.base.certainty import certainty_policy, control_steps, design_certainty
from taciturn.base.filter import ESTIMATE, SEND
from taciturn.base.gains import gains_for_losses
from taciturn.base.given_controller import lqg_observer
from taciturn.base.limited_value import COST, LimitedSilence
from taciturn.base.route import CANDIDATE, Actuation, Ahead
from taciturn.design.bounds import bound_by_silence, expect_one_threshold, threshold_of
from taciturn.design.kind import Kind, TradeoffParameter, on_any_network
from taciturn.design.late import late_excess
from taciturn.design.late_base import acknowledged_links, informed
from taciturn.design.late_sensor import late_measurements, tells_sensor
from taciturn.design.silence import drops, send_for_given, total_excess, unsure
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete, discretise
from taciturn.model.controller import controller_from
from taciturn.model.cost import Cost
from taciturn.model.network import IDEAL, Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.steps import Apply
from taciturn.model.transport import promptly
from taciturn.model.trigger import Form, Trigger

MOST_STEPS = 50  # of a plan
LONGEST = 100_000  # steps between packets of the base: their value is computed step by step


@on_any_network
def excess(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    delta: float | None = None,
    theta: float | None = None,
    period: float | None = None,
    actuation: Actuation = "hold",
    controller: object = None,
    link: str = "actuator",
    network: Network | None = None,
    every: int = 1,
    gains: Literal["lqg", "loss-optimal"] = "lqg",
    retry: bool = False,
    plan: int = 0,
    design_delay: float | None = None,
) -> Policy:
    """Design LQG control that sends when silence would add more than δ to the cost of sending every sample.

    Let e = û − Lx̂, with the input û applied in silence, and H = R + B'KB. Then J = J_all + E[(1−σ)e'He], and an input
    is sent iff e'He > δ. Silence costs at most δ per step, so J ≤ J_all + δ(1 − rate), with the rate in sends per step.
    Since e'He ≤ δ after each decision, the loop equals that of sending every sample under a bounded disturbance, and is
    mean-square stable.

    With limits of the inputs, silence costs what a forecast of ten steps without a packet costs more than one with a
    packet, and no bound holds.

    With a ``controller``, this controller computes the input instead, and J_all is its cost with every sample. Silence
    costs E[e'He + 2e'(slope)z] more, now and later, with the weights of its value (``design/base``), and a packet is
    sent iff this exceeds δ. It can be negative: δ = 0 sends less and costs less than the controller with every sample.

    Args:
        plant: the plant.
        cost: the cost: an average, a total over a horizon, or a discounted sum.
        delta: threshold δ ≥ 0, a cost per step (for a continuous plant, cost per second times seconds); or
        theta: share θ ≥ 0, for δ = θ(J_all − c) per step, with the inter-sample noise cost c, which no control changes
            and which is 0 for a discrete plant.
        period: seconds between steps; only with a continuous plant.
        actuation: in silence, ``"hold"`` keeps the last input, ``"model"`` simulates plant and controller, for LQG
            x̃⁺ = (A + BL) x̃, from the last sent estimate, and ``"zero"`` applies 0, or the input at rest of
            an operating point or of the controller's set-point. With random delays, ``"model"`` makes up for the age
            of each packet.
        controller: a linear controller to keep, or an object that ``controller_from`` converts; default: LQG.
        link: ``"actuator"``: the controller is at the sensor's site and sends inputs. ``"sensor"``: the sensor decides
            and sends measurements to a controller at the actuator's site. In silence, the controller uses the last
            measurement (``"hold"``) or the prediction of a model from the last sent estimate (``"model"``).
        network: the network; default ideal links. With several actuator links, all ideal, the controller decides on the
            set of links that send: that with the least sum of the cost of silence on the others and δ times the share
            of its packets in the price of packets on all links; the rate of the bound is then the mean of the rates,
            weighted by the prices. If the link drops packets and acknowledges those that arrive
            (``"tcp"``), J_all is the cost of an attempt to send every sample, and the rate is that of attempts. Losses
            without acknowledgement are not taken into account.
        every: q, steps between packets of the base that δ refers to; J + δ·rate ≤ J_q + δ/q with the cost J_q of
            packets at every q-th step, so at the rate 1/q the policy costs no more than J_q. Without a controller, the
            gains are the optimal ones for these packets and for what the actuator applies between them. Default: every
            sample.
        gains: without a controller, ``"lqg"``: the gains of LQG, as if no packet were dropped; ``"loss-optimal"``:
            those that cost least with the network's mean loss or, with acknowledged random delays, with the packets
            that are in flight.
        design_delay: with a link whose packets have random delays, the constant delay for which the gains of LQG are
            made: seconds, or steps of a discrete plant; default: the mean delay of the packets that arrive.
        retry: attempt again in the step after a missing acknowledgement. The bound holds, as it does for every policy
            that attempts more often.
        plan: number N of later steps for which a packet carries the inputs L(A + BL)ⁱx̂, i = 1, …, N. In silence, the
            actuator applies them in turn, by the age of the packet, and then holds the last one. Default: none.

    Returns:
        The policy, with J ≤ J_all + δ(1 − rate), at most J_all + θ(J_all − c).

    Raises:
        ProblemError: unless exactly one of δ and θ is given, if it is negative, or if period is missing or not
            applicable.
        UnstableError: if no stabilising gain or filter exists.

    Source: astrom2002, khashooei2017, antunes2014rollout, schenato2009

    Example:
        >>> policy = excess(Plant([[2.0]], [[1.0]], [[0.01]]), Cost([[1.0]], [[2.0]]), theta=0.1)
        >>> round(policy.guarantee.cost / policy.cost_all_time, 9)
        1.1
    """
    expect_one_threshold(delta, theta)
    links, every = network or IDEAL, count("every", every)
    choice("link", link, ("actuator", "sensor"))
    if every > LONGEST:
        raise ProblemError(
            f"every = {every}; expected at most {LONGEST}: the base policy must send at least once in {LONGEST} steps"
        )

    def price_at(cost_all_time: float) -> float:
        return threshold_of(cost_all_time, delta, theta)

    planned = number("plan", plan, 0, MOST_STEPS, closed=True)
    if planned % 1.0:
        raise ProblemError(f"plan is {plan}; expected a whole number of steps from 0 to {MOST_STEPS}")
    choice("gains", gains, ("lqg", "loss-optimal"))
    own = (link, every, gains, retry, actuation) != ("actuator", 1, "lqg", False, "hold")
    if informed(links):
        best = gains == "loss-optimal"
        if (link, every, retry, actuation) != ("actuator", 1, False, "hold") or plan:
            raise ProblemError(
                f"{links.lateness(acknowledged_links(links)[0])}, with acknowledgements; expected link = 'actuator', "
                "every = 1, actuation = 'hold', no retry and no plan, or a buffer"
            )
        if best and (controller is not None or design_delay is not None):
            stated = "a controller" if design_delay is None else "design_delay"
            raise ProblemError(
                f"gains = 'loss-optimal', and {stated} is given, which states the gains; expected gains = 'lqg', or no "
                f"{stated.removeprefix('a ')}"
            )
        kept = None if controller is None else controller_from(controller)
        return late_excess("excess", plant, cost, period, kept, price_at, links, design_delay, best)
    if link == "sensor" and tells_sensor(links) and actuation == "hold":
        if (every, gains, retry) != (1, "lqg", False) or plan or design_delay is not None:
            raise ProblemError(
                f"{links.lateness('sensor')}, with acknowledgements; expected every = 1, gains = 'lqg', no retry, no "
                "plan and no design_delay, or a buffer"
            )
        observer = None if controller is not None else lqg_observer("excess", discretise(plant, cost, period))
        kept = observer or controller_from(controller)
        return late_measurements("excess", plant, cost, period, kept, observer is not None, price_at, links)
    if design_delay is not None:
        raise ProblemError(
            f"design_delay is {design_delay:g}, but no link has acknowledged packets with random delays; expected no "
            "design_delay: a constant delay is known, and the gains are made for it"
        )
    if plan and (own or controller is not None or drops(links, link)):
        raise ProblemError(
            f"plan is {plan}; expected actuation = 'hold', which holds the last input of the plan, link = 'actuator' "
            "without acknowledged losses, every = 1, gains = 'lqg' and no retry or controller to keep; or no plan"
        )
    if plan or actuation == "model":  # the actuator makes up for the age of packets itself
        plant = promptly(plant, links)
    ideal = link == "actuator" and every == 1 and gains == "lqg" and not (retry or drops(links, link))
    if controller is None and ideal and actuation != "zero":
        problem = discretise(plant, cost, period)
        ahead = Ahead(links.longest(link, problem.tick), int(plan))
        return _lqg(problem, actuation, price_at, unsure(links, link), ahead)
    L = None
    if gains == "loss-optimal":
        if controller is not None or not drops(links, link) or actuation == "model" or link == "sensor" or every > 1:
            raise ProblemError(
                "gains = 'loss-optimal' does not apply here; expected an actuator link that drops packets and "
                "acknowledges the packets that arrive, no given controller, actuation = 'hold' or 'zero', and every "
                "= 1; or use gains = 'lqg'"
            )
        L = gains_for_losses(discretise(plant, cost, period), links.loss(link), actuation == "zero", links.lost(link))
    if controller is None:  # a model predicts the input that LQG with every sample would apply
        problem = discretise(plant, cost, period)
        lqg = lqg_observer("excess", problem, L=L)
        kept = (
            lqg
            if actuation == "model" or every == 1
            else lqg_observer("excess", problem, every, zero=actuation == "zero")
        )
    else:
        kept, lqg = controller_from(controller), None
    return send_for_given("excess", plant, cost, period, kept, price_at, actuation, link, links, every, retry, lqg)


def _lqg(
    problem: Discrete,
    actuation: LQGActuation,
    price_at: Callable[[float], float],
    unacknowledged: bool,
    ahead: Ahead,
) -> Policy:
    """Return the policy with the gains of LQG, over the actuator link, relative to a packet at every step."""
    if problem.cost.mission:
        return total_excess("excess", problem, actuation, price_at, unacknowledged, ahead)
    certainty = design_certainty("excess", problem)
    price = price_at(certainty.cost_all_time)
    plant, best = problem.plant, certainty.regulator
    silent, foreseen = Form(("error",), best.H), tuple[Apply, ...]()
    if plant.saturation is not None and not unacknowledged:
        F, slope = plant.A + plant.B @ best.L, np.zeros_like(best.L)
        rollout = LimitedSilence.of(F, plant.B, best.L, best.H, slope, plant.saturation)
        silent, foreseen = Form(plus={COST: 1.0}), (rollout.step("controller", (ESTIMATE,), CANDIDATE, "command"),)
    rule = Trigger({"silent": silent, SEND: Form(constant=price)})
    steps, initial = control_steps(plant, certainty.estimation, best.L, actuation, rule, before=foreseen, ahead=ahead)
    return certainty_policy(
        "excess",
        certainty,
        steps,
        initial,
        identity=certainty.completed_square(),
        guarantee=bound_by_silence(certainty, price, "khashooei2017"),
        reset=certainty.reset(actuation),
        functions=frozenset({COST}),
        unsure=unacknowledged,
    )


KIND = Kind(
    name="excess",
    design=excess,
    goal="few packets with a guarantee: a cost of at most 1 + θ times the cost of sending every sample",
    tuning=(TradeoffParameter("delta"), TradeoffParameter("theta")),
    example={"theta": 0.1},
    proved=r"$J\le J_{all}+\delta(1-\text{rate})\le(1+\theta)J_{all}$, rate in sends per step",
    relative_to="LQG or the given controller, with every sample or every $q$-th",
    nodes='S+C, A; `link = "sensor"`: S, C+A',
    data="trigger e'He against δ",
    order="operations of `lqg`",
    usual={"theta": 0.1, "actuation": "model"},  # a model sends fewer packets than a held input
    asked=("theta",),
    offered=1,
    keeps_controller=True,
    joint_links=True,
    informed_links=True,
    costs=("average", "horizon", "discount"),
)
