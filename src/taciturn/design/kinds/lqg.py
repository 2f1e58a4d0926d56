"""Event-triggered output-feedback LQG: a packet is sent only if not sending would cost more than θ times the stage
cost.

With the joint trigger, silence requires (1 + θ)e'He ≤ θ·(the stage cost that is expected from x̂ and the held input û).
So (1 + θ)E[(1−σ)e'He] ≤ θJ. By completion of squares, the left side is (1 + θ)(J − J_all), and hence J ≤ (1 + θ)J_all.
The separate trigger has a form without products of x̂ and e that is above the joint one, with ε for the cross terms. So
it sends whenever the joint one does.

Source: khashooei2017
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from taciturn._arrays import block_diagonal, choice, number, symmetrised
from taciturn._modes import least_eigenvalue
from taciturn.base.certainty import (
    Actuation,
    CertaintyEquivalentDesign,
    certainty_policy,
    control_steps,
    design_certainty,
    silence_form,
)
from taciturn.design.bounds import less_noise
from taciturn.design.kind import Kind, TradeoffParameter, on_any_network
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import discretise
from taciturn.model.cost import Cost
from taciturn.model.network import IDEAL, Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.theory import Guarantee
from taciturn.model.trigger import Form, Trigger


@on_any_network
def lqg(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    theta: float,
    period: float | None = None,
    trigger: Literal["joint", "separate"] = "joint",
    epsilon: float | None = None,
    actuation: Actuation = "hold",
    network: Network | None = None,
) -> Policy:
    """Design event-triggered LQG control whose cost is at most 1 + θ times the cost of sending every sample.

    With the filtered estimate x̂ and e = û − Lx̂, where û is the input applied in silence, send if and only if

        joint:    (1+θ) e'(R+B'KB)e − θ (x̂'Qx̂ + û'Rû + 2x̂'Nû) > θ tr(QΣ)
        separate: e'Ze − x̂'Yx̂ > θ tr(QΣ),  Y = θ(Q + L'RL + U − εI),  U = NL + L'N',
                  Z = R + (1+θ)B'KB + (θ/ε)(RL + N')(L'R + N)

    The separate trigger fires whenever the joint one does. A continuous plant is sampled exactly.

    Args:
        plant: the plant.
        cost: the average cost.
        theta: the share θ ≥ 0; 0 sends at every step.
        period: seconds between steps; only with a continuous plant.
        trigger: ``"joint"`` or ``"separate"``.
        epsilon: ε of the separate trigger, 0 < ε < λ_min(Q + L'RL + U); default half this limit.
        actuation: ``"hold"`` keeps the last input, ``"model"`` runs x̃⁺ = (A + BL) x̃ from the last sent estimate.
        network: the nodes, all sensors at the controller's place; with several actuator links, the controller decides
            on the set of links that send. Default: a sensor, a controller and an actuator. Links must be ideal.

    Returns:
        The policy, with J ≤ (1+θ) J_all − θc and mean-square stability; c is the inter-sample noise cost, which no
        control changes and which is 0 for a discrete plant.

    Raises:
        ProblemError: if θ < 0, ε is outside its interval or given with the joint trigger, period is missing or not
            applicable, or links drop or delay packets.
        UnstableError: if no stabilising gain or filter exists.

    Source: khashooei2017

    Example:
        >>> policy = lqg(Plant([[2.0]], [[1.0]], [[0.01]]), Cost([[1.0]], [[2.0]]), theta=0.1)
        >>> round(policy.guarantee.cost / policy.cost_all_time, 9)
        1.1
    """
    theta = number("theta", theta, 0.0, closed=True)
    choice("trigger", trigger, ("joint", "separate"))
    if epsilon is not None and trigger != "separate":
        raise ProblemError(
            "epsilon is given with the joint trigger, which does not use it; expected trigger = 'separate', or no "
            "epsilon: use two runs to compare the two triggers"
        )
    problem = discretise(plant, cost, period)
    certainty = design_certainty("lqg", problem)
    threshold = theta * certainty.estimation_cost
    silent = (
        silence_form(problem, certainty.regulator.H, theta)
        if trigger == "joint"
        else _separate(certainty, theta, epsilon)
    )
    rule = Trigger({"silent": silent, "send": Form(constant=threshold)})
    steps, initial = control_steps(problem.plant, certainty.estimation, certainty.regulator.L, actuation, rule)
    # the separate trigger sends whenever the joint one does in exact arithmetic, but with rounding nothing proves this
    proved = certainty.relative(theta) if trigger == "joint" else None
    policy = certainty_policy(
        "lqg",
        certainty,
        steps,
        initial,
        identity=certainty.completed_square(),
        guarantee=Guarantee(
            problem.per_unit((1 + theta) * certainty.cost_all_time if proved is None else proved),
            f"J ≤ (1+θ) J_all{less_noise(problem, 'θ')}, {certainty.stability}",
            "khashooei2017",
            more_sends=True,
            proved=proved is not None,
        ),
        reset=certainty.reset(actuation),
    )
    return replace(policy, network=network or IDEAL)


def _separate(certainty: CertaintyEquivalentDesign, theta: float, epsilon: float | None) -> Form:
    """Return the form e'Ze − x̂'Yx̂ of equation (2.12)."""
    p, B = certainty.problem, certainty.problem.plant.B
    K, L = certainty.regulator.K, certainty.regulator.L
    U = p.N @ L + L.T @ p.N.T
    M = p.Q + L.T @ p.R @ L + U
    limit = least_eigenvalue(symmetrised(M[np.ix_(~p.registers, ~p.registers)]))
    if limit <= 0:
        raise ProblemError(
            f"Q + L'RL + U has the eigenvalue {limit:.3g}; expected a positive definite matrix for this trigger; use "
            "trigger = 'joint', or add a small positive definite matrix to Q"
        )
    if epsilon is None:
        epsilon = limit / 2
    if not 0 < epsilon < limit:
        raise ProblemError(
            f"epsilon is {epsilon:g}; expected 0 < epsilon < {limit:.6g}, the smallest eigenvalue of Q + L'RL + U"
        )
    G = L.T @ p.R + p.N
    Z = p.R + (1 + theta) * B.T @ K @ B + (theta / epsilon) * G.T @ G
    Y = theta * (M - epsilon * p.weight())
    return Form(("estimate", "error"), block_diagonal(-symmetrised(Y), symmetrised(Z)))


KIND = Kind(
    name="lqg",
    design=lqg,
    goal="the guarantee of excess, with the trigger of the thesis and an actuator that holds its input",
    tuning=(TradeoffParameter("theta"),),
    example={"theta": 0.1},
    proved=r"$J\le(1+\theta)J_{all}$",
    relative_to="LQG with every sample",
    data="trigger over [x̂; candidate; e]",
    order="filter, command, candidate, error, decide, send, hold or model, predict",
    joint_links=True,
    ideal_links=True,
    usual={"theta": 0.1},
    offered=4,
)
