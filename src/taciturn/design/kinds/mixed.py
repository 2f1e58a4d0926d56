"""Mixed threshold: the controller sends when the error exceeds the sum of a relative and an absolute threshold.

The rule is |e|² > σ²|x̂|² + Y². ``bound_by_state`` of ``design/bounds`` proves its bound; with Y = 0 it is ``relative``.

Source: donkers2012
"""

from __future__ import annotations

from taciturn.base.certainty import Actuation
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.design.silence import relative_to_state
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy


def mixed(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    sigma: float,
    threshold: float,
    period: float | None = None,
    actuation: Actuation = "hold",
) -> Policy:
    """Design LQG control that sends when the squared error |e|² exceeds the mixed threshold σ²|x̂|² + Y².

    The error is e = x̃ − x̂, where x̃ is the state that the actuator uses: the last estimate sent, or its prediction.

    Args:
        plant: the plant.
        cost: the average cost.
        sigma: σ ≥ 0, the threshold relative to the norm of the state.
        threshold: Y ≥ 0, in the units of the state.
        period: seconds between steps; only with a continuous plant.
        actuation: ``"hold"`` keeps the last input, ``"model"`` runs x̃⁺ = (A + BL) x̃ from the last sent estimate.

    Returns:
        The policy. With μ = λ_max(L'HL), q = λ_min(Q − NR^{-1}N') and s = σ²μ/q < 1, its cost is
        J ≤ (J_all − s(tr(QΣ) + c) + μY²(1 − rate))/(1−s), where c is the inter-sample noise cost, 0 for a discrete
        plant. No bound is known for a larger σ.

    Raises:
        ProblemError: if σ < 0 or Y < 0, or period is missing or not applicable.
        UnstableError: if no stabilising gain or filter exists.

    Source: donkers2012

    Example:
        >>> plant, cost = Plant([[0.5]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
        >>> mixed(plant, cost, sigma=0.1, threshold=0.5).guarantee.cost < 1.3
        True
    """
    return relative_to_state("mixed", plant, cost, sigma, threshold, period, actuation, "donkers2012")


KIND = Kind(
    name="mixed",
    design=mixed,
    goal="a threshold with an absolute and a relative part",
    tuning=(TradeoffParameter("threshold"),),
    example={"sigma": 0.03, "threshold": 0.1},
    follows=(),
    proved=r"$J\le(J_{all}-s\operatorname{tr}(Q\Sigma)+\mu Y^2(1-\text{rate}))/(1-s)$ if $s<1$",
    relative_to="LQG with every sample",
    data="trigger over [x̃ − x̂; x̂] (`deviation`)",
    order="operations of `lqg`",
    usual={"sigma": 0.1},
)
