"""What silence costs at most: completion of squares, J = J_all + E[(1−σ)e'L'HLe], with a threshold on the error."""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array, symmetrised
from taciturn._modes import least_eigenvalue
from taciturn.design.certainty import Certainty
from taciturn.lqg.discrete import Discrete
from taciturn.model.policy import Guarantee

LARGEST = 1e100  # threshold, factor or share that a rule may have: its square is still a number


def largest_ratio(M: Array, weight: Array) -> float | None:
    """Return the least μ with M ⪯ μ·weight, both semidefinite; None where the weight does not see all that M does."""
    size = np.maximum(np.diag(weight), 0.0)
    size = np.sqrt(np.where(size > 0, size, np.maximum(np.diag(M), 0.0)))
    unit = np.where(size > 0, size, 1.0)  # those of the variables decide nothing
    M, weight = M / unit / unit[:, None], weight / unit / unit[:, None]
    values, vectors = np.linalg.eigh(weight)
    seen = values > 1e-12 * max(float(values[-1]), 1e-300)
    blind = vectors[:, ~seen]
    if blind.size and np.abs(M @ blind).max() > 1e-9 * np.abs(M).max(initial=0.0):
        return None
    turned = vectors[:, seen] / np.sqrt(values[seen])
    return float(np.linalg.eigvalsh(turned.T @ M @ turned)[-1]) if seen.any() else 0.0


def less_noise(problem: Discrete, share: str) -> str:
    """Return the end of a bound whose share is only of what control changes: of a sampled plant, not of c."""
    return f" − {share}c, c the inter-sample noise cost in the same unit" if problem.noise_cost else ""


def bound_by_silence(certainty: Certainty, per_silence: float, source: str) -> Guarantee:
    """Return J ≤ J_all + δ(1 − rate), where a tick in silence costs at most δ beyond J_all."""
    problem, all_time = certainty.problem, certainty.cost_all_time
    return Guarantee(
        problem.per_unit(all_time + per_silence),
        "J ≤ J_all + δ(1 − rate), δ the most that silence can cost; mean-square stable",
        source,
        problem.per_unit(all_time),
        per_silence / problem.tick,
    )


def bound_by_state(
    certainty: Certainty, sigma: float, threshold: float, source: str
) -> tuple[Guarantee | None, tuple[str, ...]]:
    """Return the bound for an error kept at E|e|² ≤ σ²E|x̂|² + Y²(1 − rate), or why there is none.

    With μ = λ_max(L'HL), E[(1−σ_k)e'L'HLe] ≤ μ(σ²E|x̂|² + Y²(1 − rate)), and the stage cost is at least q|x̂|² + tr(QΣ)
    with q = λ_min(Q − NR^{-1}N'). So with s = σ²μ/q < 1: J ≤ (J_all − s tr(QΣ) + μY²(1 − rate))/(1 − s), where of a
    sampled plant the inter-sample noise cost c is in tr(QΣ) as it is in J and J_all.

    Args:
        certainty: filter and regulator.
        sigma: σ.
        threshold: Y.
        source: key of the rule.

    Returns:
        The guarantee, and a note where σ is too large for one.
    """
    problem = certainty.problem
    mu = float(np.linalg.eigvalsh(certainty.square)[-1])
    least = problem.Q - problem.N @ np.linalg.pinv(problem.R, hermitian=True) @ problem.N.T
    q = least_eigenvalue(symmetrised(least))
    if q <= 0:
        return None, ("no bound is known: Q − NR^{-1}N' is not positive definite",) if sigma else ()
    share = sigma**2 * mu / q
    if share >= 1:
        limit = np.sqrt(q / mu)
        return None, (f"no bound is known: sigma is {sigma:g}, and its proof ends at {limit:.4g}",)
    base = (certainty.cost_all_time - share * certainty.unseen) / (1 - share)
    per_silence = mu * threshold**2 / (1 - share)
    unseen, noise = "tr(QΣ)", ""
    if problem.noise_cost:
        unseen, noise = "(tr(QΣ) + c)", ", c the inter-sample noise cost of a tick"
    guarantee = Guarantee(
        problem.per_unit(base + per_silence),
        f"J ≤ (J_all − s {unseen} + μY²(1 − rate))/(1−s), s = σ²μ/q, μ = λ_max(L'HL), "
        f"q = λ_min(Q − NR^{{-1}}N'){noise}; mean-square stable",
        source,
        problem.per_unit(base),
        per_silence / problem.tick,
    )
    return guarantee, ()
