"""Eigenvalues, modes that no input moves or no output shows, factors of covariances, stationary sums."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from taciturn import _arrays, _scipy
from taciturn._arrays import Array, ArrayLike
from taciturn.errors import UnstableError

Modes: TypeAlias = npt.NDArray[np.complex128]

TINY = 1e-290  # a variance or weight below this is zero: its inverse could not be computed with
RANK_TOLERANCE = 1e-11  # relative: a coupling this much smaller than its matrix is taken for rounding


def eigenvalues(A: Array) -> Modes:
    """Return the eigenvalues of ``A``, largest modulus first."""
    values = np.asarray(np.linalg.eigvals(A), dtype=np.complex128)
    return values[np.argsort(-np.abs(values), kind="stable")]


def radius(A: Array) -> float:
    """Return the largest modulus among the eigenvalues of ``A``."""
    return float(np.abs(eigenvalues(A)).max(initial=0.0))


def mode_text(mode: complex) -> str:
    """Return an eigenvalue as a reader expects it in a sentence."""
    if abs(mode.imag) <= 1e-12 * max(abs(mode), 1e-300):
        return f"{mode.real:.6g}"
    return f"{mode.real:.6g}{mode.imag:+.6g}i"


def uncontrollable_modes(A: ArrayLike, B: ArrayLike) -> Modes:
    """Return the eigenvalues of A that the input through B cannot move.

    They are the λ for which v'[A − λI, B] = 0 for some v ≠ 0. An orthogonal staircase splits off what B
    reaches, then what A reaches from there, and so on; the modes are the eigenvalues of the block that is
    never reached. Unlike a rank test at each computed eigenvalue this stays right where eigenvalues coincide.
    By duality ``uncontrollable_modes(A.T, C.T)`` are the modes the output y = Cx cannot see.

    Args:
        A: (n, n) dynamics, discrete or continuous.
        B: (n, m) input matrix.

    Returns:
        The complex eigenvalues, largest modulus first; empty if (A, B) is controllable. The caller decides
        which of them matter: |λ| ≥ 1 in discrete time, Re λ ≥ 0 in continuous time.

    Raises:
        ProblemError: a matrix of the wrong shape, or not finite.

    Source: anderson1990optimal

    Example:
        >>> uncontrollable_modes([[2.0, 1.0], [0.0, 0.5]], [[1.0], [0.0]])
        array([0.5+0.j])
    """
    A = _arrays.array("A", A, (None, None), "states × states")
    A = _arrays.array("A", A, (A.shape[0], A.shape[0]), "states × states")
    reach = _arrays.array("B", B, (A.shape[0], None), "states × inputs")
    scale = _scipy.balancing(A)  # the units of the states decide nothing
    rest, reach = A / scale[:, None] * scale, reach / scale[:, None]
    lengths = np.linalg.norm(reach, axis=0)
    reach = reach[:, lengths > 0] / lengths[lengths > 0]  # the unit of an input decides nothing
    size = float(np.linalg.norm(reach, 2)) if reach.size else 0.0
    norm = float(np.linalg.norm(rest, 2)) if rest.size else 0.0
    while rest.shape[0]:
        left, values, _ = np.linalg.svd(reach)
        rank = int((values > RANK_TOLERANCE * size).sum()) if size > 0 else 0
        if rank == 0:
            break
        turned = left.T @ rest @ left
        reach, rest = turned[rank:, :rank], turned[rank:, rank:]
        size = norm
    return eigenvalues(rest) if rest.size else np.zeros(0, dtype=np.complex128)


def root(matrix: Array) -> Array:
    """Return G with G G' = matrix, one column per direction; the units of the variables decide nothing."""
    scale = np.sqrt(np.where(np.diag(matrix) > TINY, np.diag(matrix), 0.0))
    inverse = np.where(scale > 0, 1 / np.where(scale > 0, scale, 1.0), 0.0)
    values, vectors = np.linalg.eigh(matrix * inverse * inverse[:, None])
    kept = values > 1e-13 * len(matrix)
    return scale[:, None] * vectors[:, kept] * np.sqrt(values[kept])


def factor(covariance: Array) -> Array:
    """Return G with G G' = covariance: the Cholesky factor, which is cheaper to apply, where there is one."""
    found = root(covariance)
    if found.shape[1] == len(covariance):
        found[:] = np.linalg.cholesky(covariance)
    return found


def accumulate(F: ArrayLike, W: ArrayLike) -> Array:
    """Return the stationary sum X = Σ_k F^k W F'^k, the solution of X = F X F' + W.

    Repeated squaring: X ← X + F X F', F ← F²; every term is semidefinite when W is, so nothing cancels.

    Args:
        F: (n, n) map with all eigenvalues inside the unit circle.
        W: (n, n) symmetric matrix added at each step.

    Returns:
        X, (n, n), symmetric.

    Raises:
        ProblemError: a matrix of the wrong shape, not finite, or not symmetric.
        UnstableError: F has an eigenvalue on or outside the unit circle.

    Source: anderson1990optimal

    Example:
        >>> float(accumulate([[0.5]], [[3.0]])[0, 0])
        4.0
    """
    F = _arrays.array("F", F, (None, None))
    F = _arrays.array("F", F, (F.shape[0], F.shape[0]))
    W = _arrays.symmetric("W", W, F.shape[0])
    if radius(F) >= 1:
        raise UnstableError(
            f"F has the eigenvalue {mode_text(complex(eigenvalues(F)[0]))}; the sum Σ F^k W F'^k needs all "
            "of them inside the unit circle; stabilise the loop first"
        )
    X = summed(F, W)
    if not np.isfinite(X).all():
        raise UnstableError(
            "the sum Σ F^k W F'^k overflows: F is stable but its powers grow too far first; scale the states"
        )
    return _arrays.frozen(X)


def summed(F: Array, W: Array) -> Array:
    """Return Σ_k F^k W F'^k for an F already known to be stable (:func:`accumulate` without its checks)."""
    X, power = np.array(W), np.array(F)
    with np.errstate(over="ignore", invalid="ignore"):  # the callers look for overflow
        for _ in range(64):  # 2^64 terms
            term = power @ X @ power.T
            X = X + (term + term.T) / 2
            settled = (np.abs(np.diag(term)) <= 1e-17 * np.abs(np.diag(X))).all()
            if settled and np.abs(power).max(initial=0.0) < 1:
                break
            power = power @ power
    return X
