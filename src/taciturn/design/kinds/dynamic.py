"""Dynamic trigger: the error may exceed a relative threshold for a while, as long as a stored credit allows it.

The rule is gain·(|e|² − σ²|x̂|²) > η with η⁺ = ρη + σ²|x̂|² − |e|². If gain·ρ ≥ 1, the credit η never becomes negative:
after a silent step, η⁺ ≥ ρη − η/gain ≥ 0. Its mean is stationary, so (1 − ρ)E[η] = E[σ²|x̂|² − |e|²] ≥ 0. Hence the mean
of |e|² is at most that of σ²|x̂|², as with the relative rule, whose bound follows from this alone.

Source: girard2015
"""

from __future__ import annotations

from taciturn._arrays import block_diagonal, number
from taciturn.base.certainty import Actuation, certainty_policy, control_steps, design_certainty
from taciturn.base.filter import DEVIATION, ESTIMATE, SEND
from taciturn.design.bounds import LARGEST_PARAMETER, bound_by_state
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import discretise
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.steps import Evaluate
from taciturn.model.trigger import Form, Trigger

CREDIT = "credit"


def dynamic(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    sigma: float,
    rho: float,
    gain: float,
    period: float | None = None,
    actuation: Actuation = "hold",
) -> Policy:
    """Design LQG control with the dynamic trigger gain·(|e|² − σ²|x̂|²) > η, where η is a stored credit.

    The error is e = x̃ − x̂, where x̃ is the state that the actuator uses. The credit η accumulates the unused part of
    the relative threshold,

        η⁺ = ρη + σ²|x̂|² − |e|², with e after the decision (0 at a send), η_0 = 0.

    If gain·ρ ≥ 1, then η ≥ 0, and the relative rule would send whenever this rule sends. As the gain increases, this
    rule tends to the relative rule.

    Args:
        plant: the plant.
        cost: the average cost.
        sigma: σ ≥ 0, the threshold relative to the norm of the state.
        rho: decay factor ρ of the credit per step, 0 < ρ < 1.
        gain: gain of the trigger, at least 1/ρ.
        period: seconds between steps; only with a continuous plant.
        actuation: ``"hold"`` keeps the last input, ``"model"`` runs x̃⁺ = (A + BL) x̃ from the last sent estimate.

    Returns:
        The policy, with the bound of the relative rule, since the mean of |e|² is again at most the mean of σ²|x̂|².

    Raises:
        ProblemError: if σ < 0, ρ is outside (0, 1), gain is below 1/ρ, or period is missing or not applicable.
        UnstableError: if no stabilising gain or filter exists.

    Source: girard2015

    Example:
        >>> plant, cost = Plant([[0.5]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
        >>> dynamic(plant, cost, sigma=0.5, rho=0.8, gain=2.0).guarantee.source
        'girard2015'
    """
    sigma = number("sigma", sigma, 0.0, LARGEST_PARAMETER, closed=True)
    rho, gain = number("rho", rho, 0.0, 1.0), number("gain", gain, 0.0, LARGEST_PARAMETER)
    if gain * rho < 1 - 1e-12:
        raise ProblemError(
            f"gain = {gain:g} and rho = {rho:g}; expected a gain of at least 1/rho = {1 / rho:.6g}, so that the "
            "threshold η of the trigger is never negative"
        )
    problem = discretise(plant, cost, period)
    certainty, unit = design_certainty("dynamic", problem), problem.weight()
    excess = block_diagonal(unit, -(sigma**2) * unit)
    rule = Trigger({"silent": Form((DEVIATION, ESTIMATE), gain * excess), SEND: Form(plus={CREDIT: 1.0})})
    left = {CREDIT: rho}
    unused = (Form((DEVIATION, ESTIMATE), -excess, plus=left), Form((ESTIMATE,), sigma**2 * unit, plus=left))
    steps, initial = control_steps(
        problem.plant,
        certainty.estimation,
        certainty.regulator.L,
        actuation,
        rule,
        after=(Evaluate("controller", CREDIT, unused, SEND),),
    )
    guarantee, notes = bound_by_state(certainty, sigma, 0.0, "girard2015")
    return certainty_policy(
        "dynamic",
        certainty,
        steps,
        initial,
        identity=certainty.completed_square(),
        guarantee=guarantee,
        reset=certainty.reset(actuation),
        slower=max(1.0, 1 / (1 - rho) / certainty.settling),
        notes=notes,
    )


KIND = Kind(
    name="dynamic",
    design=dynamic,
    goal="a relative threshold on a filtered error, which sends less often",
    tuning=(TradeoffParameter("sigma"),),
    example={"sigma": 0.03, "rho": 0.8, "gain": 2.0},
    follows=(),
    proved="the guarantee of `relative`",
    relative_to="LQG with every sample",
    data="`Evaluate` memory `credit`⁺ = ρ·credit + σ²x̂'x̂ − e'e, which the trigger adds (`plus`)",
    order="operations of `lqg`; the memory is updated after the decision, by its outcome",
    usual={"sigma": 0.1, "rho": 0.5, "gain": 2.0},
)
