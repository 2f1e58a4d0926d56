"""Stochastic trigger: its random threshold keeps the error Gaussian, so that cost and rate can be computed exactly.

An error e is not sent with the probability exp(−½ s e'We). This factor has the form of a Gaussian density, so silence
only changes the covariance Σ of the error, to (Σ⁻¹ + sW)⁻¹. If the actuator has a model, a send resets the error. Then
the mean interval is the sum of the probabilities of silence, products of det(I + sWΣ)^{-½}, and the excess is the sum
of their products with tr(L'HL Σ), divided by the mean interval (``_renewed``).

For any error, silence costs e'L'HLe ≤ μ e'We, and has the probability exp(−½ s e'We). As t exp(−t/2) ≤ 2/e, this is at
most 2μ/(e s) on average, in every step.

Source: han2015
"""

from __future__ import annotations

import numpy as np

from taciturn._arrays import NO_VARIANCE, Array, ArrayLike, number, symmetrised
from taciturn._modes import root
from taciturn._progress import check_time
from taciturn.base.certainty import (
    Actuation,
    CertaintyEquivalentDesign,
    certainty_policy,
    control_steps,
    design_certainty,
)
from taciturn.base.filter import DEVIATION, SEND
from taciturn.design.bounds import LARGEST_PARAMETER, NO_BOUND, expect_some_weight, largest_ratio
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.errors import UnstableError
from taciturn.lqg.discrete import discretise
from taciturn.lqg.kalman import resting_states
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.steps import Draw
from taciturn.model.theory import ClosedForm, Guarantee
from taciturn.model.trigger import Form, Trigger

LUCK = "luck"
LONGEST = 100_000  # largest number of silent steps that are computed one by one
CONVERGED = 1e-13  # relative change of a covariance at convergence


def stochastic(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    weight: ArrayLike | None = None,
    scale: float = 1.0,
    period: float | None = None,
    actuation: Actuation = "hold",
) -> Policy:
    """Design LQG control with a random trigger, which stays silent with probability exp(−½ s e'We) at an error e.

    The error is e = x̃ − x̂, where x̃ is the state that the actuator uses. The controller sends iff ½ s e'We > ξ, where ξ
    is drawn from the exponential distribution with mean 1. With ``actuation = "model"``, a send resets e, and silence
    leaves e Gaussian: a covariance Σ before the check becomes (Σ^{-1} + sW)^{-1} after a silent check, which has the
    probability det(I + sWΣ)^{-½}. The exact rate and cost follow from products and sums of these terms.

    Args:
        plant: the plant.
        cost: the average cost.
        weight: weight W, (n, n), positive semidefinite; default the identity.
        scale: scale s > 0 of the weight.
        period: seconds between steps; only with a continuous plant.
        actuation: ``"hold"`` keeps the last input, ``"model"`` runs x̃⁺ = (A + BL) x̃ from the last sent estimate.

    Returns:
        The policy, with J ≤ J_all + 2μ/(e s), where μ is the smallest number with L'HL ⪯ μW for the states that may
        have an error, since t exp(−t/2) ≤ 2/e.
        With a model and Gaussian noise, the policy has its exact cost and rate.

    Raises:
        ProblemError: if W has the wrong size, is indefinite or is zero, s is not positive, or period is missing or not
            applicable.
        UnstableError: if no stabilising gain or filter exists, or the weight does not limit a growing error.

    Source: han2015

    Example: starting from e = 0, a random walk of variance 3 stays silent with probability 1/2.

        >>> plant, cost = Plant([[1.0]], [[1.0]], [[3.0]]), Cost([[1.0]], [[1.0]])
        >>> policy = stochastic(plant, cost, actuation="model")
        >>> round(policy.theory.closed_form.rates["actuator"], 6)
        0.520178
    """
    scale = number("scale", scale, 0.0, LARGEST_PARAMETER)
    problem = discretise(plant, cost, period)
    certainty = design_certainty("stochastic", problem)
    W = scale * problem.weight(weight)
    expect_some_weight(W)
    rule = Trigger({"silent": Form((DEVIATION,), W / 2), SEND: Form(plus={LUCK: 1.0})})
    steps, initial = control_steps(
        problem.plant,
        certainty.estimation,
        certainty.regulator.L,
        actuation,
        rule,
        before=(Draw("controller", LUCK),),
    )
    # the error of a state that is known for ever, such as a set-point, is 0
    moving, guarantee = np.ix_(*2 * (~resting_states(problem.plant),)), None
    mu = largest_ratio(certainty.square[moving], W[moving])
    if mu is not None:
        bound = problem.per_unit(certainty.cost_all_time + 2 * mu / np.e)
        statement = f"J ≤ J_all + 2μ/(e s), μ the least with L'HL ⪯ μW; {certainty.stability}"
        guarantee = Guarantee(bound, statement, "han2015")
    exact = actuation == "model" and problem.gaussian
    return certainty_policy(
        "stochastic",
        certainty,
        steps,
        initial,
        identity=certainty.completed_square(),
        guarantee=guarantee,
        closed_form=_renewed(certainty, W) if exact else None,
        reset=certainty.reset(actuation),
        notes=() if mu is not None else (NO_BOUND,),
    )


def _renewed(certainty: CertaintyEquivalentDesign, W: Array) -> ClosedForm | None:
    """Return the exact cost and rate from the sums of one interval between sends, or None if silence lasts too long."""
    problem, A, noise = certainty.problem, certainty.problem.plant.A, certainty.corrections
    half = root(W)
    Sigma, silent, length, excess, before = noise, 1.0, 1.0, 0.0, np.inf
    for _ in range(LONGEST):
        check_time()
        spread = root(Sigma)
        rows = np.vstack([np.eye(spread.shape[1]), half.T @ spread])
        factor: Array = np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64)
        reach = np.linalg.solve(factor.T, spread.T)
        kept, stays = symmetrised(reach.T @ reach), 1 / abs(float(np.prod(np.diag(factor))))
        following = symmetrised(A @ kept @ A.T + noise)
        silent *= stays
        paid = silent * float(np.sum(certainty.square * kept))
        unit = np.sqrt(np.maximum(np.diag(following), NO_VARIANCE))
        settled = np.abs((following - Sigma) / unit / unit[:, None]).max() <= CONVERGED
        tail = stays / (1 - stays) if settled and stays < 1 else 0.0  # the remaining sum is geometric
        length, excess = length + silent * (1 + tail), excess + paid * (1 + tail)
        ended = silent <= CONVERGED * length
        if tail or (ended and paid <= CONVERGED * excess):
            average = certainty.cost_all_time + excess / length
            return ClosedForm(problem.per_unit(average), {"actuator": 1 / length})
        if ended and paid >= before:
            raise UnstableError(
                "the mean cost is infinite: an error that the weight of the trigger does not limit grows faster than "
                "the probability of not sending decreases; expected a positive weight for every mode that does not "
                "decay, or a larger scale"
            )
        Sigma, before = following, paid
        if not np.isfinite(Sigma @ Sigma).all():
            return None
    return None


KIND = Kind(
    name="stochastic",
    design=stochastic,
    goal="exact cost and rate without simulation, by a random threshold",
    tuning=(TradeoffParameter("scale", falls=False),),
    example={"actuation": "model"},
    proved=r"$J\le J_{all}+2\mu/(e\,s)$; with a model exact cost and rate",
    relative_to="LQG with every sample",
    data="`Draw` ξ, which the trigger adds (`plus`)",
    order="draw, then operations of `lqg`",
)
