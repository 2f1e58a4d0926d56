"""The filter for measurements that are sometimes missing: one gain for all steps, the best one for their law.

In a step, Γ = diag(γ) states which outputs are measured, and the filter corrects its prediction by them alone:

    x̂ = x̂⁻ + g Γ (y − C x̂⁻),    x̂⁻⁺ = A x̂ + B û.

Its error does not depend on the inputs. Let a Markov chain with the transition probabilities T determine how likely
outputs are missing, P_s be the covariance of the prediction's error in state s times the share π_s of the steps in it,
S_s = C P_s C' + π_s V, M_s = E[Γ | s], and Π_s = E[γγ' | s]. With ∘ for the product of entries,

    Σ_s = P_s − g M_s C P_s − P_s C' M_s g' + g (Π_s∘S_s) g',     P_s⁺ = Σ_r T_rs (A Σ_r A' + π_r W),
    g = (Σ_s P_s C' M_s) (Σ_s Π_s∘S_s)⁻¹,

where g minimises Σ_s Σ_s. If samples are missing independently of the steps before, this recursion increases with P and
approaches the smallest covariance that one gain can attain, in the order of matrices. So it also attains the least cost
E[e'L'HLe] that the error e of an estimate adds to LQG control. In bursts, g minimises the error after each measurement.

A filter whose gains follow the samples that it has had is better, but has no finite table of gains, and needs a Riccati
equation in each node. One gain is what a node computes in any case.

Source: sinopoli2004, smith2003
"""

from __future__ import annotations

import numpy as np

from taciturn._arrays import Array, symmetrised
from taciturn._progress import check_time
from taciturn.errors import UnstableError
from taciturn.model.losses import Chances

SAME = 1e-12  # relative change of the covariances in a step with which the recursion ends
MOST_STEPS = 100_000
HUGE = 1e12  # growth of the covariance, relative to that without missing samples, from which on it diverges
DIGITS = 12  # digits of the gain: more would depend on the processor that computed them


def gain_for_missing(
    A: Array, C: Array, W: Array, V: Array, prior: Array, known: Array, chances: Chances
) -> tuple[Array, Array]:
    """Return the gain of the filter, (n, p), and the mean covariance of its innovations, (p, p), 0 where none is known.

    ``prior`` is the covariance of the prediction's error if no sample is missing, from which the recursion starts;
    ``known``, (cases, p), states which outputs are measured in each case of the law ``chances``, by 1 or 0.
    """
    shares, odds = chances.shares, chances.odds
    M = odds @ known  # (states, p)
    Pi = np.einsum("sc,ci,cj->sij", odds, known, known)
    P = shares[:, None, None] * prior
    most, gain, mean = HUGE * max(float(np.abs(prior).max()), float(np.abs(W).max())), np.zeros(C.T.shape), V
    for step in range(MOST_STEPS):
        if step % 1000 == 0:
            check_time()
        seen = P @ C.T * M[:, None, :]
        S = Pi * (C @ P @ C.T + shares[:, None, None] * V)
        mean = symmetrised(S.sum(axis=0))
        gain = seen.sum(axis=0) @ np.linalg.pinv(mean, hermitian=True)
        cross = gain @ seen.swapaxes(1, 2)
        left = P - cross - cross.swapaxes(1, 2) + gain @ S @ gain.T
        moved = A @ left @ A.T + shares[:, None, None] * W
        after = np.einsum("rs,rij->sij", chances.turns, moved)
        after = (after + after.swapaxes(1, 2)) / 2
        size = float(np.abs(after).max())
        if not size < most:
            break
        if float(np.abs(after - P).max()) <= SAME * size:
            return _rounded(gain), mean
        P = after
    share = 1 - float((shares @ M).min())
    raise UnstableError(
        f"{100 * share:.6g} % of the samples of an output are missing, so the error of the estimate grows without "
        "limit or settles too slowly; expected a smaller probability (links.NAME.missing), or shorter bursts"
    )


def _rounded(gain: Array) -> Array:
    """Round a gain to so many digits that different processors compute the same numbers."""
    scale = float(np.abs(gain).max()) or 1.0
    return np.round(gain / scale, DIGITS) * scale
