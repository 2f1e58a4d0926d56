"""Steady-state Kalman filters. Measurements may also be without noise.

    Σ̃ = AΣA' + W,   S = CΣ̃C' + V,   gain = Σ̃C'S⁻¹,   Σ = Σ̃ − gain S gain'

The prior covariance Σ̃ is the stabilising solution of the Riccati equation of the dual problem (A', C', W, V), which is
solved with a proof of its error (``equation``). The dual of a state without a cost-to-go is a state that is known for
ever; the dual of an input that costs nothing is a combination of outputs that is known in advance, in whose direction
S is singular and the gain is that of a stable observer. Σ is computed in Joseph's form, which stays semidefinite:

    Σ = (I − gain C) Σ̃ (I − gain C)' + gain V gain'.

Modes on the unit circle that no noise reaches and no output shows keep their first uncertainty: their covariance and
gain are 0 (``resting_states``). If no stable filter exists, the error names the mode that is the reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from taciturn import _arrays
from taciturn._arrays import Array, ArrayLike, Bits, block_diagonal, is_definite, symmetrised
from taciturn._display import Displayed
from taciturn._modes import closure, mode_text, radius, root
from taciturn._rational import NONE, Limit, precision, rational, unmoved, unmoved_and_seen
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.cache import remembered
from taciturn.lqg.enclosures import PRECISIONS, Balls, E, UnprovedError
from taciturn.lqg.equation import Equation, Problem, Recipe, exactly, not_held, ranked
from taciturn.lqg.quadratic import Quadratic, price, unpaid, worth_of
from taciturn.lqg.sampling import Exact
from taciturn.model.plant import Plant

CRUMB = 1e-14  # posterior variance relative to the prior, below which it counts as rounding


@dataclass(frozen=True, eq=False, repr=False)
class Filter(Displayed):
    """A steady-state Kalman filter x̂ = x̂⁻ + gain (y − C x̂⁻), where x̂⁻ is the prediction, and its error covariances.

    ``prior`` and ``posterior`` are the error covariances before and after the measurement, and ``innovation`` is the
    covariance S of y − C x̂⁻. The corrections of the estimate have the covariance gain S gain' = prior − posterior.
    ``error`` is a proved bound on the error of the prior: −error ⪯ prior − exact ⪯ error. ``slowest`` is the
    modulus of the slowest mode of the filter error, A − A gain C, without the modes of ``resting_states``, whose
    covariance and gain are 0.
    """

    prior: Array
    posterior: Array
    gain: Array
    innovation: Array
    error: Array
    slowest: float


def steady_filter(A: ArrayLike, C: ArrayLike, W: ArrayLike, V: ArrayLike) -> Filter:
    """Compute the stable steady-state Kalman filter of the plant x⁺ = Ax + w, y = Cx + v.

    Σ̃ = AΣA' + W,  S = CΣ̃C' + V,  gain = Σ̃C'S^{-1},  Σ = Σ̃ − gain S gain', with A − A gain C stable.

    In special cases the equations do not determine the gain. It is then chosen such that the filter is stable:

    - V = 0 and C of full column rank: the measurement determines the state, gain = C^+ (the identity for C = I),
      Σ = 0, Σ̃ = W.
    - W = 0 and V = 0: nothing is random, Σ = Σ̃ = 0, S = 0. The gain is the one for W = sI, V = sI, which is
      the same for every s > 0.
    - S is singular for another reason: some output is known in advance. Then gain S = Σ̃C' still holds, and in the free
      directions the gain is that of a stable observer.
    - W = 0, V > 0 and A unstable: Σ = 0 also solves the equation, but only until the first disturbance. The
      returned filter is the stabilising one, the limit of W = sI as s → 0, with Σ > 0 on the unstable modes.
    - A mode on the unit circle that is observable and that W does not reach, with V > 0: covariance and gain decrease
      only as 1/k. There is no stable steady filter, and the problem is rejected.
    - States with a mode on the unit circle that W does not reach and that is unobservable, directly and through other
      states: their uncertainty stays that of the start; covariance and gain are 0.

    Args:
        A: (n, n) dynamics.
        C: (p, n) output matrix.
        W: (n, n) semidefinite covariance of w, per step.
        V: (p, p) semidefinite covariance of v; may be zero.

    Returns:
        The filter (prior Σ̃, posterior Σ, gain, innovation S).

    Raises:
        ProblemError: data of the wrong shape, or W or V is not semidefinite.
        UnstableError: an unstable mode is unobservable, or a mode on the unit circle is reached by noise and
            unobservable, or is observable and not reached by noise.

    Source: anderson1990optimal

    Example:
        >>> found = steady_filter([[2.0]], [[1.0]], [[0.0]], [[1.0]])
        >>> round(float(found.prior[0, 0]), 9), round(float(found.gain[0, 0]), 9)
        (3.0, 0.75)
    """
    A = _arrays.square("A", A, "states × states")
    n = len(A)
    C = _arrays.array("C", C, (None, n), "outputs × states")
    W = _arrays.semidefinite("W", W, n, "states × states")
    V = _arrays.semidefinite("V", V, C.shape[0], "outputs × outputs")
    return filter_sampled(None, A, C, W, V, 0)


def resting_states(plant: Plant) -> Bits:
    """Mark the states, (n,), with an unobservable mode on the unit circle that no noise excites."""
    # The estimation error of these states remains that of the start.
    return worth_of(_dual(plant.A, plant.C, plant.W, plant.V)).resting


def forgets_the_start(plant: Plant, exact: Exact | None) -> bool:
    """Return whether the filter gains converge to those of the steady-state filter from every initial covariance."""
    # It does if noise reaches all modes that do not decay, except those of the resting states.
    if plant.full_state or is_definite(plant.W):
        return True
    source = None if exact is None else exact.source
    A, W = (plant.A, plant.W) if source is None else (source.given.A, source.W)
    lasting = unmoved(A, W, Limit(source is not None)).lasting.size
    return lasting == (worth_of(_dual(plant.A, plant.C, plant.W, plant.V)).still.size if lasting else 0)


def expect_known_start(plant: Plant, seen: Bits) -> None:
    """Raise an error if the cost always depends on an uncertain initial state that no measurement corrects."""
    resting = resting_states(plant)
    unknown = np.flatnonzero(resting & (plant.covariance.diagonal() > 0))
    if unknown.size and (closure(resting, np.asarray(plant.A != 0, dtype=np.bool_)) & seen).any():
        raise UnstableError(
            f"initial.covariance is {plant.covariance[unknown[0], unknown[0]]:.3g} in state {unknown[0] + 1}"
            f"{plant.told('states', int(unknown[0]))}, which no "
            "noise drives and no measurement shows, so that its initial error remains and causes a cost forever; "
            "expected 0 for this state (its initial value is then initial.mean), or a measurement of it"
        )


def forgetting(plant: Plant, filtered: Sequence[Array], regulated: float, remedy: str) -> float:
    """Return the time constant, in steps, of the loop of a Kalman filter and a regulator."""
    # 1/(1 − |slowest mode per step|) of a steady filter, or of one whose gains repeat along a schedule, without the
    # modes of ``resting_states``
    moving = ~resting_states(plant)
    turn = np.eye(int(moving.sum()))
    for step in filtered:
        turn = step[np.ix_(moving, moving)] @ turn
    slowest = radius(turn) ** (1 / len(filtered))
    if slowest >= 1 - 1e-12:
        raise UnstableError(f"the filter error does not decay along the schedule: {remedy}")
    return 1 / (1 - max(regulated, slowest))


@remembered
def filter_sampled(exact: Exact | None, A: Array, C: Array, W: Array, V: Array, given: int) -> Filter:
    """Compute the steady-state Kalman filter of a plant. ``exact`` gives A and W more precisely than doubles do."""
    # The last states, such as set-points, may be the last outputs, without noise: the filter takes them over, also
    # those that never move. Set-points act on nothing else. A known load does not move by itself; the filter removes it
    # from the other outputs.
    n, p = len(A) - given, len(C) - given
    found = _filtered(A[:n, :n], C[:p, :n], W[:n, :n], V[:p, :p], exact)
    if not given:
        return found
    moved, none = W[n:, n:], np.zeros((given, given))
    return _frozen(
        Filter(
            block_diagonal(found.prior, moved),
            block_diagonal(found.posterior, none),
            taken_over(found.gain, C, given),
            block_diagonal(found.innovation, moved),
            block_diagonal(found.error, none),
            found.slowest,
        )
    )


def taken_over(gain: Array, C: Array, given: int) -> Array:
    """Extend the gain of a filter by the last ``given`` states, which it takes over from as many outputs."""
    if not given:
        return gain
    n, p = gain.shape
    found = block_diagonal(gain, np.eye(given))
    found[:n, p:] = -gain @ C[:p, n:]
    return found


def _filtered(A: Array, C: Array, W: Array, V: Array, exact: Exact | None) -> Filter:
    n, p = A.shape[0], C.shape[0]
    if not V.any() and rational(C).rank() == n:
        gain, slowest = np.eye(n), 0.0
        if not np.array_equal(C, gain):
            gain = np.asarray(np.linalg.pinv(C), dtype=np.float64)
            slowest = _slowest_stored(A, gain, C)
        none = np.zeros((n, n))
        return _frozen(Filter(W, none, gain, C @ W @ C.T, none, slowest))
    given = _dual(A, C, W, V)
    if not W.any() and not V.any():  # nothing is random: the gain is computed as for noise on all states and outputs
        moving = ~worth_of(given, rounded=exact is not None).resting
        noisy = _dual(A, C, np.diag(moving.astype(np.float64)), np.eye(p))
        unit = _filter(*exactly(noisy), noisy, Limit(False), False)
        none = np.zeros((n, n))
        return _frozen(replace(unit, prior=none, posterior=none, innovation=np.zeros((p, p)), error=none))

    def recipe(arithmetic: type[E]) -> Equation[E]:
        assert exact is not None, "only a sampled plant has a recipe"
        step, states = exact(arithmetic), slice(n)
        A, W = step.A.part(states, states), step.W.part(states, states)
        return Equation(A.T, arithmetic.exact(C.T), W, arithmetic.exact(V), arithmetic.exact(np.zeros((n, p))))

    with np.errstate(over="ignore", invalid="ignore"):
        source, own = exact and exact.source, slice(n)
        before, limit = given, Limit(False)
        if source is not None:
            before = _dual(source.given.A[own, own], C, source.W[own, own], V)
            limit = Limit(True, 1.0, source.period)
        problem = exactly(given) if exact is None else (given, recipe)
        found = _filter(*problem, before, limit, exact is not None)
    if not np.isfinite(found.innovation).all():
        raise ProblemError(
            f"C has an entry of {np.abs(C).max():.3g}, with which the variance of an output overflows; expected "
            "outputs in larger units"
        )
    return _frozen(found)


def _slowest_stored(A: Array, gain: Array, C: Array) -> float:
    """Return the modulus of the slowest mode of the errors A(I − gain C), for the gain as it is stored."""
    with precision(PRECISIONS[0]):
        rest = Balls.exact(np.eye(len(A))) - Balls.exact(gain) @ Balls.exact(C)
        loop = Balls.exact(A) @ rest
        try:
            ranked(Balls, loop, np.ones(len(A)))
        except UnprovedError as error:
            raise not_held("filter", A, f"with the rounded gain, {error}") from None
        return radius(loop.middle)


def _dual(A: Array, C: Array, W: Array, V: Array) -> Quadratic:
    """Return the regulator problem whose cost-to-go is the covariance of the filter's prediction."""
    return Quadratic(A.T, C.T, W, V, np.zeros(C.T.shape))


def _filter(given: Quadratic, recipe: Recipe, before: Quadratic, limit: Limit, sampled: bool) -> Filter:
    """Return the filter by duality with the regulator of (A', C', W, V), given also as it was before sampling."""
    A, C, V = given.A.T, given.B.T, given.R
    problem = Problem(given, recipe, sampled=sampled, dual=True, before=(before, limit) if limit.continuous else None)
    try:
        found = problem.solve()
    except UnprovedError as error:
        _refuse(before.among(problem.worth.states), limit)
        if is_definite(before.R):
            raise UnstableError(
                f"the stable steady filter could not be proved with 1,024 bits: {error}; expected modes that decay "
                "faster or that are measured more strongly, or noise W on every state"
            ) from None
        raise UnstableError(
            "no stable steady filter was found: with this V some combination of outputs has no noise and leaves a "
            f"mode on the unit circle, or the proof needs more than 1,024 bits ({error}); expected a larger V: add a "
            "small positive definite matrix to it"
        ) from None
    if found.lacking:
        raise not_held("filter", A, found.lacking)
    Sigma, gain, S = found.K, found.correction.T, found.H
    if found.free:
        # −L' = A gain also in the directions that S leaves free; −L' = A X there for some X, by construction.
        inverse = price(C.T, Sigma, V)[1]
        gain = gain + np.linalg.pinv(A) @ (-found.L.T - A @ gain) @ (np.eye(len(S)) - S @ inverse)
    return Filter(Sigma, _posterior(Sigma, gain, C, V), gain, S, found.error, found.slowest)


def _posterior(Sigma: Array, gain: Array, C: Array, V: Array) -> Array:
    """Return the covariance after a measurement in Joseph's form, which stays semidefinite under rounding."""
    rest = np.eye(len(Sigma)) - gain @ C
    posterior = symmetrised(rest @ Sigma @ rest.T + gain @ V @ gain.T)
    # A noise-free output leaves exact zeros, whose rounding must not be inverted in the next step.
    if is_definite(V):
        return posterior
    half = root(posterior, Sigma, CRUMB)
    return half @ half.T


def _refuse(seen: Quadratic, limit: Limit) -> None:
    """Raise an error if a mode is the reason why there is no stable filter, of the dual regulator problem ``seen``."""
    lost = unmoved(seen.A, seen.B, limit)
    if lost.lasting.size:
        noisy = NONE if lost.growing.size else unmoved_and_seen(seen.A, seen.B, seen.Q, limit)
        mode = complex((noisy if noisy.staying.size else lost).lasting[0])
        digits = limit.digits(mode)
        named = f"A has the eigenvalue {mode_text(mode, digits)}, which C does not observe"
        if not (lost.growing.size or noisy.staying.size):
            raise UnstableError(
                f"(A, C) is not detectable: {named}; this mode lies on {limit}, noise W does not affect it, and it is "
                "a combination of several states, but such a mode is accepted only if it is a single state; expected "
                "coordinates in which it is a single state, for which W and A have zeros, or a problem without this "
                "mode"
            )
        on_edge = "" if lost.growing.size else f"; it lies on {limit} and noise W reaches it"
        raise UnstableError(
            f"(A, C) is not detectable: {named}{on_edge}; expected (A, C) detectable: every eigenvalue on or outside "
            f"{limit.text(digits)} must be observable; add a sensor, or remove the state of this mode from the problem"
        )
    noisy, still = is_definite(seen.R), unpaid(seen, limit).staying
    if still.size and not noisy:  # a mode that W does not reach needs noise W, also with noise V
        later = unpaid(seen._replace(R=np.eye(len(seen.R)), N=np.zeros_like(seen.N)), limit).staying
        noisy, still = later.size > 0, later if later.size else still
    if still.size:
        raise UnstableError(
            f"A has the eigenvalue {mode_text(complex(still[0]))} on {limit}, which the noise W does not reach, so the "
            "optimal gain tends to zero and no steady filter is stable; add a small positive definite matrix to W"
            if noisy
            else f"outputs without noise V leave the mode {mode_text(complex(still[0]))} on {limit}, so no steady "
            "filter is stable; add a small positive definite matrix to V"
        )


def _frozen(found: Filter) -> Filter:
    prior, posterior, error = map(_arrays.frozen, (found.prior, found.posterior, found.error))
    return Filter(prior, posterior, _arrays.frozen(found.gain), _arrays.frozen(found.innovation), error, found.slowest)
