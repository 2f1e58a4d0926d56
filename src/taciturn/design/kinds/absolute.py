"""Absolute threshold: the controller sends when the error of the actuator's input or state is large.

The rule is e'We > Y². In silence e'We ≤ Y², and silence costs e'He for an error e of the input, e'L'HLe for one of the
state. With the least μ for which H ⪯ μW or L'HL ⪯ μW, it costs at most μY², so J ≤ J_all + μY²(1 − rate). There is no
such μ if W does not see an error that has a cost. With W = H, this is the trigger of ``excess``.

Source: astrom2002, lunze2010
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from taciturn._arrays import ArrayLike, choice, number, semidefinite
from taciturn.base.certainty import Actuation, certainty_policy, control_steps, design_certainty
from taciturn.base.filter import DEVIATION, SEND
from taciturn.design.bounds import LARGEST_PARAMETER, NO_BOUND, bound_by_silence, expect_some_weight, largest_ratio
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.lqg.discrete import discretise
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.trigger import Form, Trigger


def absolute(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    threshold: float,
    weight: ArrayLike | None = None,
    error: Literal["input", "state"] = "input",
    period: float | None = None,
    actuation: Actuation = "hold",
) -> Policy:
    """Design LQG control that sends when the weighted squared error e'We at the actuator exceeds a threshold Y².

    The error e is either û − Lx̂, with the input û applied in silence, or x̃ − x̂, with the state x̃ that the actuator
    uses: the last estimate sent, or its prediction [lunze2010]. By completion of squares, silence costs at most μY²,
    where μ is the smallest number with H ⪯ μW or L'HL ⪯ μW.

    Args:
        plant: the plant.
        cost: the average cost.
        threshold: Y ≥ 0, in the units of √(e'We).
        weight: weight W, (m, m) or (n, n), positive semidefinite; default the identity.
        error: ``"input"`` for e = û − Lx̂ or ``"state"`` for e = x̃ − x̂.
        period: seconds between steps; only with a continuous plant.
        actuation: ``"hold"`` keeps the last input, ``"model"`` runs x̃⁺ = (A + BL) x̃ from the last sent estimate.

    Returns:
        The policy, with J ≤ J_all + μY²(1 − rate); without this bound if e'We is 0 for an error that has a cost.

    Raises:
        ProblemError: if Y < 0, W has the wrong size or is indefinite, or period is missing or not applicable.
        UnstableError: if no stabilising gain or filter exists.

    Source: astrom2002, lunze2010

    Example:
        >>> plant, cost = Plant([[1.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1e-6]])
        >>> round(absolute(plant, cost, threshold=3.0, actuation="model").guarantee.cost, 3)
        10.0
    """
    threshold = number("threshold", threshold, 0.0, LARGEST_PARAMETER, closed=True)
    choice("error", error, ("input", "state"))
    problem = discretise(plant, cost, period)
    certainty = design_certainty("absolute", problem)
    m = problem.plant.inputs
    if error == "state":
        W = problem.weight(weight)
    else:
        W = np.eye(m) if weight is None else semidefinite("weight", weight, m, "(inputs, inputs)")
    expect_some_weight(W)
    rule = Trigger({
        "silent": Form(("error" if error == "input" else DEVIATION,), W),
        SEND: Form(constant=threshold**2),
    })  # fmt: skip
    steps, initial = control_steps(problem.plant, certainty.estimation, certainty.regulator.L, actuation, rule)
    mu = largest_ratio(certainty.regulator.H if error == "input" else certainty.square, W)
    return certainty_policy(
        "absolute",
        certainty,
        steps,
        initial,
        identity=certainty.completed_square(),
        guarantee=None if mu is None else bound_by_silence(certainty, mu * threshold**2, "astrom2002"),
        reset=certainty.reset(actuation),
        notes=() if mu is not None else (NO_BOUND,),
    )


KIND = Kind(
    name="absolute",
    design=absolute,
    goal="an absolute threshold on the error of the input or of the state",
    tuning=(TradeoffParameter("threshold"),),
    example={"threshold": 1.0},
    proved=r"$J\le J_{all}+\mu Y^2(1-\text{rate})$",
    relative_to="LQG with every sample",
    data="trigger over e, or over `deviation`",
    order="operations of `lqg`",
)
