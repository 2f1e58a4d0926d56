"""Optimal gains: infinite and finite horizon, discounted, and in continuous time. The input is u = L x."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn import _arrays
from taciturn._arrays import Array, ArrayLike, Bits, is_definite, symmetrised
from taciturn._modes import (
    SCATTER,
    TOLERANCE,
    Modes,
    eigenvalues,
    lost_modes,
    mode_text,
    pace,
    root,
    uncontrollable_modes,
)
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg import _care, _dare
from taciturn.lqg._axes import Quadratic
from taciturn.lqg._kept import kept
from taciturn.lqg._newton import Solution, refuse_doubtful

__all__ = [
    "FiniteRegulator",
    "Regulator",
    "refuse_uncertain",
    "regulate",
    "regulate_continuous",
    "regulate_discounted",
    "regulate_finite",
    "states_with_cost",
    "uncontrollable_modes",
]


@dataclass(frozen=True, eq=False)
class Regulator:
    """An optimal gain: the cost-to-go x'Kx, the input u = Lx, and the price H of another input.

    The cost tr(KW) of a noise is right to tr(error·W), to first order. ``slowest`` is the modulus of the slowest mode
    of A + BL, with a discount of √α(A + BL); in continuous time its real part. Modes on the unit circle that no input
    moves and the cost does not see do not count.
    """

    K: Array
    L: Array
    H: Array
    error: Array
    slowest: float


@dataclass(frozen=True, eq=False)
class FiniteRegulator:
    """The gains of a finite horizon: K of shape (N+1, n, n), L of shape (N, m, n), H of shape (N, m, m)."""

    K: Array
    L: Array
    H: Array


def regulate(A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike) -> Regulator:
    """Return the gain that minimises the sum of x'Qx + u'Ru + 2x'Nu along x⁺ = Ax + Bu.

    K = Q + A'KA − L'HL,  L = −H^{-1}(B'KA + N'),  H = R + B'KB, with A + BL stable. Any other input costs
    (u − Lx)'H(u − Lx) more. States on the unit circle that no input moves and the cost does not see, themselves or by
    what they move, stay as they are: K and L are 0 along them.

    Args:
        A: (n, n) dynamics.
        B: (n, m) input matrix.
        Q: (n, n) symmetric state weight; [[Q, N], [N', R]] semidefinite is the caller's duty.
        R: (m, m) symmetric input weight; may be singular as long as H is definite.
        N: (n, m) cross weight.

    Returns:
        The regulator (K, L, H); adding noise of covariance W costs tr(KW) per step.

    Raises:
        ProblemError: data of the wrong shape, or H singular.
        UnstableError: an unstable mode that B cannot move, or a mode on the unit circle that the cost sees and B
            cannot move, or that B moves and the cost does not see.

    Source: anderson1990optimal

    Example:
        >>> found = regulate([[2.0]], [[1.0]], [[1.0]], [[2.0]], [[0.0]])
        >>> round(float(found.L[0, 0]), 6)
        -1.568729
    """
    return regulate_checked(*Quadratic.checked(A, B, Q, R, N), 1.0)


def regulate_discounted(
    A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike, discount: float
) -> Regulator:
    """Return the gain that minimises Σ α^k (x'Qx + u'Ru + 2x'Nu) along x⁺ = Ax + Bu.

    L = −H^{-1}(αB'KA + N'),  H = R + αB'KB,  K = Q + αA'KA − L'HL. It is the undiscounted problem of √α·A and
    √α·B; only √α(A + BL) is certain to be stable.

    Args:
        A: (n, n) dynamics.
        B: (n, m) input matrix.
        Q: (n, n) symmetric state weight.
        R: (m, m) symmetric input weight.
        N: (n, m) cross weight.
        discount: α, 0 < α ≤ 1.

    Returns:
        The regulator (K, L, H).

    Raises:
        ProblemError: data of the wrong shape or range, or H singular.
        UnstableError: a mode with √α·|λ| ≥ 1 that B cannot move, or one with √α·|λ| = 1 that the cost does
            not see.

    Source: khashooei2017

    Example:
        >>> found = regulate_discounted([[2.0]], [[1.0]], [[1.0]], [[2.0]], [[0.0]], 0.9)
        >>> round(float(found.L[0, 0]), 6)
        -1.522789
    """
    A, B, Q, R, N = Quadratic.checked(A, B, Q, R, N)
    discount = _arrays.number("discount", discount, 0.0)
    if discount > 1:
        raise ProblemError(f"discount is {discount:g}; expected 0 < discount ≤ 1")
    root = np.sqrt(discount)
    return regulate_checked(root * A, root * B, Q, R, N, float(root))


def regulate_finite(
    A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike, terminal: ArrayLike, horizon: int
) -> FiniteRegulator:
    """Return the gains that minimise x_N'Q_N x_N + Σ_{k<N} (x'Qx + u'Ru + 2x'Nu) along x⁺ = Ax + Bu.

    K_N = Q_N,  H_k = R + B'K_{k+1}B,  L_k = −H_k^{-1}(B'K_{k+1}A + N'),  K_k = Q + A'K_{k+1}A − L_k'H_kL_k.

    Args:
        A: (n, n) dynamics.
        B: (n, m) input matrix.
        Q: (n, n) symmetric state weight.
        R: (m, m) symmetric input weight.
        N: (n, m) cross weight.
        terminal: (n, n) symmetric terminal weight Q_N.
        horizon: number of steps N, at least 1.

    Returns:
        K (N+1, n, n), L (N, m, n), H (N, m, m), indexed by time.

    Raises:
        ProblemError: data of the wrong shape, or some H_k singular.
        UnstableError: the cost overflows: an unstable mode that B cannot move, over too long a horizon.

    Source: anderson1990optimal

    Example:
        >>> found = regulate_finite([[1.0]], [[1.0]], [[1.0]], [[1.0]], [[0.0]], [[0.0]], 3)
        >>> found.K[:, 0, 0].tolist()
        [1.6, 1.5, 1.0, 0.0]
    """
    A, B, Q, R, N = Quadratic.checked(A, B, Q, R, N)
    horizon = _arrays.count("horizon", horizon)
    n, m = B.shape
    K, L, H = np.zeros((horizon + 1, n, n)), np.zeros((horizon, m, n)), np.zeros((horizon, m, m))
    K[horizon] = _arrays.symmetric("terminal", terminal, n, "states × states")
    for k in reversed(range(horizon)):
        with np.errstate(over="ignore", invalid="ignore"):
            H[k] = symmetrised(R + B.T @ K[k + 1] @ B)
            cross = B.T @ K[k + 1] @ A + N.T
        if not (np.isfinite(H[k]).all() and np.isfinite(cross).all()):
            raise UnstableError(
                f"the cost-to-go overflows {horizon - k} steps before the end of the horizon of {horizon}; A "
                f"has the eigenvalue {mode_text(complex(eigenvalues(A)[0]))}; shorten the horizon or let B "
                "reach that mode"
            )
        if not is_definite(H[k]):
            raise _singular(H[k], f" at step {k}")
        L[k] = -np.linalg.solve(H[k], cross)
        closed = A + B @ L[k]
        with np.errstate(over="ignore", invalid="ignore"):  # an overflow is met, and named, in the next turn
            K[k] = symmetrised(closed.T @ K[k + 1] @ closed + Q + N @ L[k] + L[k].T @ N.T + L[k].T @ R @ L[k])
    if not np.isfinite(K[0]).all():
        raise UnstableError(f"the cost-to-go overflows at step 0 of the horizon of {horizon}; shorten the horizon")
    return FiniteRegulator(_arrays.frozen(K), _arrays.frozen(L), _arrays.frozen(H))


def regulate_continuous(A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike) -> Regulator:
    """Return the gain that minimises ∫ x'Qx + u'Ru + 2x'Nu dt along ẋ = Ax + Bu.

    0 = A'K + KA + Q − L'RL,  L = −R^{-1}(B'K + N'), with A + BL stable; H = R. States on the imaginary axis that no
    input moves and the cost does not see stay as they are, as with :func:`regulate`.

    Args:
        A: (n, n) dynamics, per unit of time.
        B: (n, m) input matrix.
        Q: (n, n) symmetric state weight.
        R: (m, m) positive definite input weight.
        N: (n, m) cross weight.

    Returns:
        The regulator (K, L, H = R); noise of intensity W costs tr(KW) per unit of time.

    Raises:
        ProblemError: data of the wrong shape, or R not positive definite.
        UnstableError: an unstable mode that B cannot move, or a mode on the imaginary axis that the cost sees and B
            cannot move, or that B moves and the cost does not see.

    Source: anderson1990optimal

    Example:
        >>> found = regulate_continuous([[0, 1], [0, 0]], [[0], [1]], [[1, 0], [0, 1]], [[10]], [[0], [0]])
        >>> found.L.round(6).tolist()
        [[-0.316228, -0.855836]]
    """
    given = Quadratic.checked(A, B, Q, R, N)
    R = _arrays.definite("R", given.R, len(given.R), "inputs × inputs")
    seen = given.among(_care.worth(*given).states)
    lost = lost_modes(seen.A, seen.B, True)
    _refuse_unmoved(
        lost, "the open left half-plane", np.abs(lost.real) <= SCATTER * pace(given.A), "the imaginary axis"
    )
    unseen = _unseen_modes(*seen)
    _refuse_unseen(unseen[np.abs(unseen.real) <= SCATTER * pace(given.A)], "the imaginary axis")
    found = _checked_solution(_care.solve(*given), None)
    return Regulator(_arrays.frozen(found.K), _arrays.frozen(found.L), R, _arrays.frozen(found.error), found.slowest)


def states_with_cost(A: Array, B: Array, Q: Array, R: Array, N: Array) -> Bits:
    """Return which states have a cost-to-go, (n,); the others and what they move cost nothing, and need no input."""
    return _dare.worth(A, B, Q, R, N).states


def refuse_uncertain(cost: float, doubt: float) -> None:
    """Refuse a cost of sending always that rounding makes uncertain.

    Args:
        cost: J_all.
        doubt: bound on its error.

    Raises:
        UnstableError: the error may be larger than 1e-6 of the cost.
    """
    if not doubt <= TOLERANCE * abs(cost):
        raise UnstableError(
            f"the cost of sending always is {cost:.6g} and uncertain by {doubt:.1e} (at most {TOLERANCE:.0e} of it): "
            "modes that hardly any noise excites cost so much more than those it does that their rounding covers the "
            "cost; expected noise W on them, or a plant without them"
        )


@kept
def regulate_checked(A: Array, B: Array, Q: Array, R: Array, N: Array, unit: float) -> Regulator:
    """Return what :func:`regulate` returns, of matrices that were checked.

    A and B are already multiplied by ``unit`` = √α, which is taken out of the modes that a refusal names.
    """
    found = _dare.solve(A, B, Q, R, N)
    if found is None or not _dare.is_clear(found):  # what it is that has no solution
        seen = Quadratic(A, B, Q, R, N).among(_dare.worth(A, B, Q, R, N).states)
        lost = lost_modes(seen.A, seen.B, False)
        _refuse_unmoved(lost / unit, _disc(unit), np.abs(np.abs(lost) - 1) <= SCATTER, _disc(unit))
        if is_definite(R):
            unseen = _unseen_modes(*seen)
            _refuse_unseen(unseen[np.abs(np.abs(unseen) - 1) <= SCATTER] / unit, "the edge of " + _disc(unit))
    found = _checked_solution(found, A / unit)
    if not is_definite(found.H):
        raise _singular(found.H, "")
    K, L, H, error = (_arrays.frozen(part) for part in (found.K, found.L, found.H, found.error))
    return Regulator(K, L, H, error, found.slowest)


def _checked_solution(found: Solution | None, A: Array | None) -> Solution:
    """Return a solution; of steps x⁺ = Ax, whose growth may be the reason why there is none."""
    if found is None:
        raise UnstableError(
            "the Riccati equation of the regulator has no solution that stabilises clear of rounding: from no gain "
            "Newton's method settles; expected unstable modes that the inputs move more strongly, or a weight in Q and "
            "R on every state and input"
        )
    refuse_doubtful(found, "regulator", "that the inputs move more strongly, or a plant without them", A)
    return found


def _unseen_modes(A: Array, B: Array, Q: Array, R: Array, N: Array) -> Modes:
    """Return the modes that cost nothing once the input is −R^{-1}N'x plus a free part, for R definite."""
    share = np.linalg.solve(R, N.T)
    weight = Q - N @ share
    weight = np.where(np.abs(weight) > 1e-13 * (np.abs(Q) + np.abs(N) @ np.abs(share)), weight, 0.0)
    return uncontrollable_modes((A - B @ share).T, root(symmetrised(weight)))


def _refuse_unmoved(modes: Modes, region: str, on_edge: Bits, edge: str) -> None:
    """Refuse modes that no input moves, and say of one on the edge of stability that only the cost makes it matter."""
    if not modes.size:
        return
    named = f"A has the eigenvalue {mode_text(complex(modes[0]))}, which B cannot move"
    if on_edge[0]:
        raise UnstableError(
            f"{named}; it lies on {edge} and the cost sees it, so the cost along it is infinite, or rests on numbers "
            "that cancel exactly; expected (A, B) stabilisable, or no weight in Q and N on that state and on those "
            "that it moves; let it decay, or take it out of the problem"
        )
    raise UnstableError(
        f"{named}; expected (A, B) stabilisable: every eigenvalue outside {region} must be reached; add an actuator or "
        "take that state out of the problem"
    )


def _refuse_unseen(modes: Modes, edge: str) -> None:
    if modes.size:
        raise UnstableError(
            f"the cost does not see the mode {mode_text(complex(modes[0]))} on {edge}, so no optimal gain "
            "moves it inside; give Q a small positive part there"
        )


def _disc(unit: float) -> str:
    return "the unit circle" if unit == 1 else f"the circle of radius 1/√discount = {1 / unit:.6g}"


def _singular(H: Array, where: str) -> ProblemError:
    smallest = float(np.linalg.eigvalsh(H)[0])
    return ProblemError(
        f"R + B'KB is not positive definite{where}: it has the eigenvalue {smallest:.3g}, so an input "
        "direction is free; expected every input to cost something; give R a positive part or drop the "
        "redundant input"
    )
