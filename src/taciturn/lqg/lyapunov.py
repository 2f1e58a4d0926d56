"""Sums of F^k W F'^k along a stable map F, with a proof of their error.

Let X̂ be a candidate, and Y the sum of F^k D F'^k for a diagonal D ≻ 0. If Y ≻ 0 and P = Y − FYF' ≻ 0, F is stable. If
for a number ε also −εP ≺ FX̂F' + W − X̂ ≺ εP, the sum lies between X̂ − εY and X̂ + εY. The proof holds for every F and
W within one rounding of the given ones, such as the closed loop A + BL that was computed in doubles.
"""

from __future__ import annotations

import numpy as np

from taciturn import _arrays
from taciturn._arrays import NO_VARIANCE, Array, ArrayLike
from taciturn._cycles import closure
from taciturn._exact_modes import Limit, modes_of
from taciturn._modes import COST_ERROR, radius, summed
from taciturn._precision import precision
from taciturn._rational import rational
from taciturn.errors import UnstableError
from taciturn.lqg.enclosures import PRECISIONS, UNIT, Balls, Doubles, E, UnprovedError

TURNS = 100  # doublings


def accumulate(F: ArrayLike, W: ArrayLike) -> Array:
    """Return the stationary sum X = Σ_k F^k W F'^k, the solution of X = F X F' + W.

    Repeated squaring: X ← X + F X F', F ← F². The error of each variance is proved to be at most 1e-6.

    Args:
        F: (n, n) map with all eigenvalues inside the unit circle.
        W: (n, n) symmetric matrix added at each step.

    Returns:
        X, (n, n), symmetric.

    Raises:
        ProblemError: a matrix has the wrong shape, is not finite, or is not symmetric.
        UnstableError: F has an eigenvalue on or outside the unit circle, or so near to it that the sum is inaccurate.

    Source: anderson1990optimal

    Example:
        >>> float(accumulate([[0.5]], [[3.0]])[0, 0])
        4.0
    """
    F = _arrays.square("F", F)
    W = _arrays.symmetric("W", W, F.shape[0])
    if radius(F) >= 1:
        lasting = modes_of(rational(F), Limit(False)).lasting
        if lasting.size:
            raise UnstableError(
                f"F has the eigenvalue {Limit(False).named(complex(lasting[0]))}, so the sum Σ F^k W F'^k diverges; "
                "expected all eigenvalues inside the unit circle: stabilise the loop first"
            )
        raise UnstableError(
            "F is stable, but rounding its entries can make it unstable, so the sum Σ F^k W F'^k is not proved; "
            "expected a larger stability margin"
        )
    return _arrays.frozen(stationary(F, W))


def stationary(F: Array, W: Array) -> Array:
    """Return Σ_k F^k W F'^k for a semidefinite W and an F that is known to be stable, with a proof of its error.

    Raises:
        UnstableError: the sum overflows, or is not proved to six digits.
    """
    X = summed(F, W)
    if not np.isfinite(X).all():
        raise UnstableError(
            "the sum Σ F^k W F'^k overflows: F is stable, but its powers first grow too large; scale the states"
        )
    moving = closure(np.asarray(W.any(axis=1), dtype=np.bool_), np.asarray(F != 0, dtype=np.bool_))
    place = np.ix_(moving, moving)
    if moving.any():
        X[place] = _proved(F[place], W[place], X[place])
    return X


def _proved(F: Array, W: Array, X: Array) -> Array:
    """Return the sum after the proof of its error, in doubles or in balls."""
    try:
        return _judged(Doubles, F, W, X)
    except UnprovedError:
        with precision(PRECISIONS[0]):
            try:
                return _judged(Balls, F, W, X)
            except UnprovedError as error:
                raise UnstableError(
                    f"the sum Σ F^k W F'^k is not proved to a relative error of {COST_ERROR:.0e}: {error}; F has an "
                    f"eigenvalue at a distance of {1 - radius(F):.1e} inside the unit circle, and the powers of F "
                    "decay too slowly, or grow too large before they decay; expected a larger stability margin"
                ) from None


def _judged(arithmetic: type[E], F: Array, W: Array, X: Array) -> Array:
    size = np.where(np.diag(X) > NO_VARIANCE, np.diag(X), 1.0)
    step, noise = (arithmetic.exact(part).widened(UNIT * np.abs(part)) for part in (F, W))
    for _ in range(2):
        found = arithmetic.exact(X)
        missed = (step @ found @ step.T + noise - found).symmetric()
        Y, _, slack = bounded(arithmetic, step.T, missed, size)
        if slack * float(np.mean(np.diag(Y.middle) / size)) <= COST_ERROR:
            return X
        X = X + summed(F, missed.middle)
    raise UnprovedError("its terms and their rounding leave too large a residual")


def bounded(arithmetic: type[E], F: E, missed: E, size: Array) -> tuple[E, E, float]:
    """Return X, X − F'XF and ε with −εX ⪯ Σ F'^k M F^k ⪯ εX for the residual M of a sum of about the given diagonal.

    Raises:
        UnprovedError: the loop is not proved stable, or the bound is not proved.
    """
    X, falls = ranked(arithmetic, F, size)
    slack = 4 * relative(missed, size)
    if not ((falls.times(slack) - missed).definite() and (falls.times(slack) + missed).definite()):
        raise UnprovedError("the error of a sum along the loop is not proved")
    return X, falls, slack


def sizes(A: Array, Q: Array, K: Array, crumb: float) -> Array:
    """Return the cost-to-go of each state, or a small part of the terms whose sum it is if it is still smaller."""
    diagonal = np.diag(K)
    size = np.maximum(diagonal, crumb * (np.abs(np.diag(Q)) + (A * A).T @ np.abs(diagonal)))
    return np.where(size > NO_VARIANCE, size, 1.0)


def relative(form: E, size: Array) -> float:
    """Return a bound on a form relative to the diagonal form of given sizes, above zero."""
    unit = 1 / np.sqrt(size)
    return max(float((form.most * unit * unit[:, None]).sum(axis=1).max(initial=0.0)), 1e-200)


def ranked(arithmetic: type[E], F: E, size: Array) -> tuple[E, E]:
    """Return X and X − F'XF, both proved definite, where X is about the sum of F'^k D F^k for the diagonal D of sizes.

    Raises:
        UnprovedError: the closed loop is not proved stable at this precision.
    """
    with np.errstate(all="ignore"):
        rough = summed(F.middle.T, np.diag(size))
    if np.isfinite(rough).all():
        X = arithmetic.exact(rough)
        falls = (X - F.T @ X @ F).symmetric()
        if falls.definite() and X.definite():
            return X, falls
    if arithmetic is Balls:  # double precision does not suffice for the sum
        X = total(arithmetic, F, arithmetic.exact(np.diag(size)))
        falls = (X - F.T @ X @ F).symmetric()
        if falls.definite() and X.definite():
            return X, falls
    raise UnprovedError("the closed loop is not proved stable")


def total(arithmetic: type[E], F: E, M: E) -> E:
    """Return about the sum of F'^k M F^k, without radii, by doubling the number of terms.

    Raises:
        UnprovedError: the loop is not stable.
    """
    found, power = M.centre(), F.centre()
    for _ in range(TURNS):
        more = (power.T @ found @ power).symmetric()
        found = (found + more).centre()
        if not np.isfinite(found.middle).all():
            break
        if np.abs(more.middle).max(initial=0.0) <= arithmetic.unit() * np.abs(np.diag(found.middle)).max(initial=0.0):
            return found
        power = (power @ power).centre()
    raise UnprovedError("the closed loop does not forget")
