"""Bounds on the cost of not sending, and checks of the trigger thresholds that these bounds contain.

Four arguments give all bounds of the policy kinds.

* **Completion of squares.** A deviation e from the best input that depends on the measurements so far costs e'He, now
  and later, with H = R + B'KB. So J = J_all + E[(1−σ)e'He]: a trigger that allows at most δ in silence costs at most
  δ(1 − rate) more (``bound_by_silence``). An error e of the state at the actuator is the deviation Le of the input, and
  costs e'L'HLe. A weight W of a trigger is compared with the cost by the least μ with H ⪯ μW or L'HL ⪯ μW
  (``largest_ratio``).
* **A share of the stage cost.** If the threshold grows with the state, silence costs at most a share of J itself, and
  the inequality is solved for J (``bound_by_state``).
* **Gains.** For a given controller and any noise, the errors of all links enter a linear loop. The roots of the costs
  that they cause add up at most, each with the H∞ norm γ from its error (``bound_by_errors``).
* **Attempts.** With the value function of a base that sends at every q-th step, a packet is sent iff silence would cost
  more than δ. So J + δ·rate ≤ J_q + δ/q, with the cost J_q and the rate 1/q of the base (``bound_by_attempts``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import sqrt
from typing import cast

import numpy as np

from taciturn._arrays import Array, number, quoted, symmetrised
from taciturn._modes import least_eigenvalue
from taciturn._text import ordinal
from taciturn.base.certainty import CertaintyEquivalentDesign
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete
from taciturn.model.theory import ErrorGain, Guarantee, with_silence

PULLED = " + 2γ√(what silence adds), γ of the timetable"
NO_BOUND = "no guarantee is known: the weight is zero for some errors that have a cost"
LARGEST_PARAMETER = 1e100  # largest threshold, factor or share of a rule; its square does not overflow


def expect_one_threshold(delta: float | None, theta: float | None) -> None:
    """Raise a ``ProblemError`` if both ``delta`` and ``theta`` are given, or neither."""
    if (delta is None) == (theta is None):
        got = "neither delta nor theta is" if delta is None else f"delta ({delta:g}) and theta ({theta:g}) are both"
        raise ProblemError(
            f"delta or theta sets the trigger threshold, but {got} given; expected exactly one of these parameters"
        )


def threshold_of(cost: float, delta: float | None, theta: float | None) -> float:
    """Return the trigger threshold per step: ``delta``, or ``theta`` times the cost of sending every sample."""
    expect_one_threshold(delta, theta)
    if delta is not None:
        return number("delta", delta, 0.0, LARGEST_PARAMETER, closed=True)
    return number("theta", 0.0 if theta is None else theta, 0.0, LARGEST_PARAMETER, closed=True) * cost


def shares_of(shares: Mapping[str, float] | None, links: Sequence[str]) -> dict[str, float]:
    """Return the weight of each link in the trigger threshold. It is 1 for links that ``shares`` does not list."""
    given = cast("object", {} if shares is None else shares)
    if not isinstance(given, Mapping):
        raise ProblemError(
            f"shares = {quoted(given)}; expected one number for each link, such as {{{links[0]!r}: 2.0}}"
        )
    found = dict.fromkeys(links, 1.0)
    for link, share in cast("Mapping[str, object]", given).items():
        if link not in found:
            raise ProblemError(
                f"shares.{link} is {quoted(share)}, but the policy makes no send decisions on this link; expected "
                f"shares only for the links {', '.join(links)}"
            )
        found[link] = number(f"shares.{link}", share, 0.0, LARGEST_PARAMETER, closed=True)
    return found


def expect_some_weight(W: Array) -> None:
    """Raise a ``ProblemError`` if a trigger's weighting matrix is zero, because the policy would never send."""
    if not W.any():
        raise ProblemError(
            "all entries of weight are 0, so the policy would never send; expected a weight with at least one nonzero "
            "entry"
        )


def largest_ratio(M: Array, weight: Array) -> float | None:
    """Return the least μ with M ⪯ μ·weight, for positive semidefinite matrices; None if no μ satisfies this."""
    size = np.maximum(np.diag(weight), 0.0)
    size = np.sqrt(np.where(size > 0, size, np.maximum(np.diag(M), 0.0)))
    unit = np.where(size > 0, size, 1.0)  # scaling that makes the result independent of units
    M, weight = M / unit / unit[:, None], weight / unit / unit[:, None]
    values, vectors = np.linalg.eigh(weight)
    seen = values > 1e-12 * max(float(values[-1]), 1e-300)
    blind = vectors[:, ~seen]
    if blind.size and np.abs(M @ blind).max() > 1e-9 * np.abs(M).max(initial=0.0):
        return None
    turned = vectors[:, seen] / np.sqrt(values[seen])
    return float(np.linalg.eigvalsh(turned.T @ M @ turned)[-1]) if seen.any() else 0.0


def less_noise(problem: Discrete, share: str) -> str:
    """Write the term by which a bound subtracts the inter-sample noise cost; empty if there is no such cost."""
    return f" − {share}c, c the inter-sample noise cost in the same unit" if problem.noise_cost else ""


def bound_by_silence(certainty: CertaintyEquivalentDesign, per_silence: float, source: str) -> Guarantee:
    """Return the guarantee J ≤ J_all + δ(1 − rate) of a policy in which each step without a packet costs at most δ
    more.
    """
    problem, pull = certainty.problem, certainty.pull
    all_time, factor = certainty.raised(per_silence, certainty.allowance)
    per_silence *= factor
    return Guarantee(
        problem.per_unit(with_silence(all_time, per_silence, pull)),
        f"J ≤ J_all + δ(1 − rate){PULLED if pull else ''}, δ the most that silence can cost; {certainty.stability}",
        source,
        problem.per_unit(all_time),
        per_silence / problem.tick,
        more_sends=True,
        pull=pull / sqrt(problem.tick),
        proved=certainty.allowance is not None,
    )


def bound_by_state(
    certainty: CertaintyEquivalentDesign, sigma: float, threshold: float, source: str
) -> tuple[Guarantee | None, tuple[str, ...]]:
    """Return the guarantee of a trigger with E|e|² ≤ σ²E|x̂|² + Y²(1 − rate). If none is proved, a note says why."""
    # With μ = λ_max(L'HL), E[(1−σ_k)e'L'HLe] ≤ μ(σ²E|x̂|² + Y²(1 − rate)), and the stage cost is at least
    # q|x̂|² + tr(QΣ) with q = λ_min(Q − NR^{-1}N'). Therefore, with s = σ²μ/q < 1,
    # J ≤ (J_all − s tr(QΣ) + μY²(1 − rate))/(1 − s). For a sampled plant, tr(QΣ) includes the inter-sample noise cost
    # c, as do J and J_all.
    problem = certainty.problem
    if problem.source is not None and problem.source.exosystem is not None:
        raise ProblemError(
            "disturbances or set-points are given, but the trigger compares the error with the size of the state, "
            "which grows with disturbances and set-points; expected a trigger with a constant threshold, such as "
            "that of the policy kind 'excess' or 'absolute'"
        )
    mu = float(np.linalg.eigvalsh(certainty.square)[-1])
    least = problem.Q - problem.N @ np.linalg.pinv(problem.R, hermitian=True) @ problem.N.T
    q = least_eigenvalue(symmetrised(least[np.ix_(~problem.registers, ~problem.registers)]))
    if q <= 0:
        return None, ("no guarantee is known: Q − NR^{-1}N' is not positive definite",) if sigma else ()
    share = sigma**2 * mu / q
    if share >= 1:
        limit = np.sqrt(q / mu)
        return None, (f"no guarantee is known: sigma is {sigma:g}, and the proof requires sigma < {limit:.4g}",)
    base = (certainty.cost_all_time - share * certainty.estimation_cost) / (1 - share)
    per_silence = mu * threshold**2 / (1 - share)
    unseen, noise = "tr(QΣ)", ""
    if problem.noise_cost:
        unseen, noise = "(tr(QΣ) + c)", ", c the inter-sample noise cost of a step"
    guarantee = Guarantee(
        problem.per_unit(base + per_silence),
        f"J ≤ (J_all − s {unseen} + μY²(1 − rate))/(1−s), s = σ²μ/q, μ = λ_max(L'HL), "
        f"q = λ_min(Q − NR^{{-1}}N'){noise}; {certainty.stability}",
        source,
        problem.per_unit(base),
        per_silence / problem.tick,
        more_sends=True,
    )
    return guarantee, ()


def bound_by_errors(problem: Discrete, base: float, errors: Mapping[str, ErrorGain]) -> Guarantee:
    """Return the bound √J ≤ √J_b + Σγ_lΔ_l, where J_b is the cost of the same controller with every sample sent."""
    added = sum(one.gain * one.largest for one in errors.values())
    return Guarantee(
        problem.per_unit((sqrt(base) + added) ** 2),
        f"√J ≤ √J_b + Σγ_lΔ_l{', without the inter-sample noise cost' if problem.noise_cost else ''}; J_b the cost of "
        "this controller with every sample, γ_l the gain from the error of link l, Δ_l its largest error; a "
        "conservative certificate for any noise, not an estimate",
        "miskowicz2006",
        more_sends=True,
    )


def bound_by_attempts(
    problem: Discrete,
    base: float,
    price: float,
    every: int,
    lossy: bool,
    lqg: bool = False,
) -> Guarantee:
    """Return the bound J ≤ J_b + δ(a_b − a): the policy attempts a sends per step, and the base loop a_b."""
    cost, word = problem.cost, "an attempt to send" if lossy else "a packet"
    name, at = ("J_all", "every sample") if every == 1 else ("J_q", f"every {ordinal(every)} step")
    base_of = f"{name} the cost of {'LQG' if lqg else 'this controller'} with {word} at {at}"
    if cost.discount < 1:
        power = "α" if every == 1 else f"α^{every}"
        most = price / (1 - cost.discount**every)
        statement = f"J ≤ {name} + δ/(1 − {power}), {base_of}"
        return Guarantee(problem.per_unit(base + most), statement, "antunes2014rollout", more_sends=every == 1)
    share, ticks, times = 1.0 / every, problem.ticks, ""
    if cost.horizon is not None:
        share, times = -(-cost.horizon // every) / cost.horizon, f"·{cost.horizon}"
    whole = "1" if every == 1 else "1/q" if cost.horizon is None else f"{share:.4g}"
    statement = f"J ≤ {name} + δ{times}({whole} − rate), {base_of}, δ the most that silence adds on average"
    low, high = (problem.per_unit(base + price * ticks * part) for part in (share - 1, share))
    # a base that is silent in some steps may profit from silence in them
    rate = price * ticks / problem.unit
    return Guarantee(high, statement, "antunes2014rollout", low, rate, more_sends=every == 1)
