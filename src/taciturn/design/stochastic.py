"""The stochastic trigger: a drawn threshold keeps what is Gaussian Gaussian, so that cost and rate are exact."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import TINY, Array, ArrayLike, number, semidefinite, symmetrised
from taciturn._modes import root
from taciturn.design.bounds import LARGEST, largest_ratio
from taciturn.design.certainty import (
    DEVIATION,
    SEND,
    Actuation,
    Certainty,
    certainty_policy,
    control_steps,
    design_certainty,
)
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.discrete import discretise
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import ClosedForm, Draw, Guarantee, Policy
from taciturn.model.trigger import Form, Trigger

DRAWN = "luck"
LONGEST = 100_000  # ticks of silence that are followed one by one
CONVERGED = 1e-13  # relative change of a covariance


def stochastic(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    weight: ArrayLike | None = None,
    scale: float = 1.0,
    period: float | None = None,
    actuation: Actuation = "hold",
) -> Policy:
    """Design LQG control that keeps silent with the probability exp(−½ s e'We).

    e = x̃ − x̂, with x̃ the state that the actuator acts on. It is sent iff ½ s e'We > ξ, ξ drawn from the exponential
    law of mean 1. With ``actuation = "model"`` a send resets e, and silence leaves it Gaussian: of a covariance Σ
    before the look it has (Σ^{-1} + sW)^{-1} after, with the probability det(I + sWΣ)^{-½}. Products and sums of these
    are the exact rate and cost.

    Args:
        plant: the plant.
        cost: the average cost.
        weight: W, (n, n), semidefinite; omitted: the identity.
        scale: s > 0.
        period: seconds between ticks; only with a continuous plant.
        actuation: ``"hold"`` keeps the last input, ``"model"`` runs x̃⁺ = (A + BL) x̃ from the last sent estimate.

    Returns:
        The policy, with J ≤ J_all + 2μ/(e s), μ the least with L'HL ⪯ μW, as t exp(−t/2) ≤ 2/e; with a model and
        Gaussian noise its exact cost and rate.

    Raises:
        ProblemError: W of the wrong size, indefinite or zero, s not positive, period missing or out of place.
        UnstableError: no stabilising gain or filter, or a weight that lets a growing error stand.

    Source: han2015

    Example: from e = 0 a random walk of variance 3 is silent with the probability 1/2.

        >>> plant, cost = Plant([[1.0]], [[1.0]], [[3.0]]), Cost([[1.0]], [[1.0]])
        >>> policy = stochastic(plant, cost, actuation="model")
        >>> round(policy.closed_form.rates["actuator"], 6)
        0.520178
    """
    scale = number("scale", scale, 0.0, LARGEST)
    problem = discretise(plant, cost, period)
    certainty, n = design_certainty("stochastic", problem), problem.plant.states
    W = scale * (np.eye(n) if weight is None else semidefinite("weight", weight, n, "(states, states)"))
    if not W.any():
        raise ProblemError("weight is zero, so that nothing would ever be sent; expected a weight that sees an error")
    rule = Trigger({"silent": Form((DEVIATION,), W / 2), SEND: Form(plus={DRAWN: 1.0})})
    steps, initial = control_steps(
        problem.plant,
        certainty.estimation,
        certainty.regulator.L,
        actuation,
        rule,
        before=(Draw("controller", DRAWN),),
    )
    mu, guarantee = largest_ratio(certainty.square, W), None
    if mu is not None:
        bound = problem.per_unit(certainty.cost_all_time + 2 * mu / np.e)
        statement = "J ≤ J_all + 2μ/(e s), μ the least with L'HL ⪯ μW; mean-square stable"
        guarantee = Guarantee(bound, statement, "han2015")
    exact = actuation == "model" and problem.jumps is None
    return certainty_policy(
        "stochastic",
        certainty,
        steps,
        initial,
        identity=certainty.completed_square(),
        guarantee=guarantee,
        closed_form=_renewed(certainty, W) if exact else None,
        reset=certainty.reset(actuation),
        notes=("no bound is known: the weight does not see every error that costs",) if mu is None else (),
    )


def _renewed(certainty: Certainty, W: Array) -> ClosedForm | None:
    """Return cost and rate from one send to the next; None where silence may last too long to be followed.

    Raises:
        UnstableError: silence that the weight does not end costs more and more, so that the mean is infinite.
    """
    problem, A, noise = certainty.problem, certainty.problem.plant.A, certainty.corrections
    half = root(W)
    Sigma, silent, length, excess, before = noise, 1.0, 1.0, 0.0, np.inf
    for _ in range(LONGEST):
        factor = np.linalg.cholesky(np.eye(half.shape[1]) + half.T @ Sigma @ half)
        reach = np.linalg.solve(factor, half.T @ Sigma)
        kept, stays = symmetrised(Sigma - reach.T @ reach), 1 / float(np.prod(np.diag(factor)))
        following = symmetrised(A @ kept @ A.T + noise)
        silent *= stays
        paid = silent * float(np.sum(certainty.square * kept))
        unit = np.sqrt(np.maximum(np.diag(following), TINY))
        settled = np.abs((following - Sigma) / unit / unit[:, None]).max() <= CONVERGED
        tail = stays / (1 - stays) if settled and stays < 1 else 0.0  # what is left is geometric
        length, excess = length + silent * (1 + tail), excess + paid * (1 + tail)
        ended = silent <= CONVERGED * length
        if tail or (ended and paid <= CONVERGED * excess):
            average = certainty.cost_all_time + excess / length
            return ClosedForm(problem.per_unit(average), {"actuator": 1 / length})
        if ended and paid >= before:
            raise UnstableError(
                "the mean cost is infinite: weight does not see an error that grows faster than silence becomes rare; "
                "expected a weight that sees every mode that does not decay, or a larger scale"
            )
        Sigma, before = following, paid
        if not np.isfinite(Sigma @ Sigma).all():
            return None
    return None
