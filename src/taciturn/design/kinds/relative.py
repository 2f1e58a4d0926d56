"""Relative threshold: the controller sends when the error is large in proportion to the state estimate.

The rule is |e| > σ|x̂|. Silence costs at most μσ²|x̂|², μ = λ_max(L'HL), and the stage cost is at least q|x̂|², so the
excess is at most the share s = σ²μ/q of the cost itself, which gives a bound if s < 1 (``bound_by_state`` of
``design/bounds``).

Source: tabuada2007
"""

from __future__ import annotations

from taciturn.base.certainty import Actuation
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.design.silence import relative_to_state
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy


def relative(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    sigma: float,
    period: float | None = None,
    actuation: Actuation = "hold",
) -> Policy:
    """Design LQG control that sends when the error norm |e| exceeds σ times the norm |x̂| of the state estimate.

    The error is e = x̃ − x̂, where x̃ is the state that the actuator uses: the last estimate sent, or its prediction.
    Without noise the state tends to zero if σ is small. With noise, the rule sends often while the state is near zero.

    Args:
        plant: the plant.
        cost: the average cost.
        sigma: σ ≥ 0, the threshold relative to the norm of the state.
        period: seconds between steps; only with a continuous plant.
        actuation: ``"hold"`` keeps the last input, ``"model"`` runs x̃⁺ = (A + BL) x̃ from the last sent estimate.

    Returns:
        The policy. With μ = λ_max(L'HL), q = λ_min(Q − NR^{-1}N') and s = σ²μ/q < 1, its cost is
        J ≤ (J_all − s(tr(QΣ) + c))/(1−s), where c is the inter-sample noise cost, 0 for a discrete plant. No bound is
        known for a larger σ.

    Raises:
        ProblemError: if σ < 0, or period is missing or not applicable.
        UnstableError: if no stabilising gain or filter exists.

    Source: tabuada2007

    Example:
        >>> plant, cost = Plant([[0.5]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
        >>> policy = relative(plant, cost, sigma=0.5)
        >>> policy.guarantee.cost / policy.cost_all_time < 1.04
        True
    """
    return relative_to_state("relative", plant, cost, sigma, 0.0, period, actuation, "tabuada2007")


KIND = Kind(
    name="relative",
    design=relative,
    goal="a threshold that grows with the norm of the state",
    tuning=(TradeoffParameter("sigma"),),
    example={"sigma": 0.03},
    follows=(),
    proved=r"$J\le(J_{all}-s\operatorname{tr}(Q\Sigma))/(1-s)$ if $s<1$",
    relative_to="LQG with every sample",
    data="trigger over [x̃ − x̂; x̂] (`deviation`)",
    order="operations of `lqg`",
    usual={"sigma": 0.1},
)
