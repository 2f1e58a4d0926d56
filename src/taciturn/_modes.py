"""Eigenvalues, units, factors of covariances, and sums along stable maps."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from taciturn import _arrays
from taciturn._arrays import NO_VARIANCE, Array
from taciturn._cycles import largest_cycle

Modes: TypeAlias = npt.NDArray[np.complex128]

ROUNDOFF = float(np.finfo(np.float64).eps) / 2
COST_ERROR = 1e-6  # largest relative error of a returned cost; rounding alone causes 1e-14 to 1e-9
SCATTER = 1e-7  # computed eigenvalues of a defective matrix scatter by the root of the rounding error
LARGEST = 1e140  # limit on a power of a stable map: its square is still finite
FADED = 1e-4  # squared norm of a power of a stable map below which its sum may have converged


def eigenvalues(A: Array) -> Modes:
    """Return the eigenvalues of ``A``, largest modulus first."""
    values = np.asarray(np.linalg.eigvals(A), dtype=np.complex128)
    return values[np.argsort(-np.abs(values), kind="stable")]


def radius(A: Array) -> float:
    """Return the largest modulus among the eigenvalues of ``A``."""
    return float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))


def balancing(A: Array) -> Array:
    """Return the powers of two d for which D^{-1}AD has rows and columns of similar norm, (n,).

    Each state in turn is scaled so that the norms of its row and column are most similar, until no scaling gains 5 %.
    """
    balanced, scale = A / max(float(np.abs(A).max(initial=0.0)), NO_VARIANCE), np.ones(len(A))
    while _may_gain(balanced):
        gains = False
        for i in range(len(A)):
            row, column = math.sqrt(balanced[i] @ balanced[i]), math.sqrt(balanced[:, i] @ balanced[:, i])
            if row == 0 or column == 0:
                continue
            factor = 2.0 ** round(math.log2(row / column) / 2)
            if column * factor + row / factor < 0.95 * (row + column):
                gains = True
                scale[i] *= factor
                balanced[i] /= factor
                balanced[:, i] *= factor
        if not gains:
            break
    return scale


def _may_gain(A: Array) -> bool:
    """Return whether the row and column of a state differ so much (a factor of two) that scaling may help."""
    squares = A * A
    rows, columns = squares.sum(axis=1), squares.sum(axis=0)
    return bool(((rows > 1.9 * columns) & (columns > 0) | (columns > 1.9 * rows) & (rows > 0)).any())


def pace(A: Array) -> float:
    """Return the largest entry of the balanced matrix ``A``, the reference for rounding errors of its modes."""
    scale = balancing(A)
    return float(np.abs(A / scale[:, None] * scale).max(initial=0.0))


def mode_text(mode: complex, digits: int = 6) -> str:
    """Return an eigenvalue as text for a message."""
    if abs(mode.imag) <= 1e-12 * max(abs(mode), 1e-300):
        return f"{mode.real:.{digits}g}"
    return f"{mode.real:.{digits}g}{mode.imag:+.{digits}g}i"


def least_eigenvalue(matrix: Array) -> float:
    """Return the least eigenvalue of a definite matrix, accurate in any units; at most 0 for any other matrix.

    Definiteness is decided by the eigenvalues after scaling to a unit diagonal. The least eigenvalue is then computed
    as the inverse of the largest eigenvalue of the inverse, which the rounding of large entries does not affect.
    """
    diagonal = np.diag(matrix)
    if not (diagonal > NO_VARIANCE).all():
        return min(float(np.linalg.eigvalsh(matrix)[0]), 0.0)
    unit = np.sqrt(diagonal)
    scaled = matrix / unit / unit[:, None]
    smallest = float(np.linalg.eigvalsh(scaled)[0])
    if smallest <= 1e-12:
        return min(float(np.linalg.eigvalsh(matrix)[0]), smallest, 0.0)
    inverse = np.linalg.inv(scaled) / unit / unit[:, None]
    return 1 / float(np.linalg.eigvalsh(_arrays.symmetrised(np.asarray(inverse, dtype=np.float64)))[-1])


def reach(A: Array, B: Array) -> tuple[Array, Array]:
    """Return units of the states and inputs in which each input of 1 changes every state that it affects by about 1.

    The unit of a state is the largest direct effect of an input on it. Other states get the largest effect of states
    with known units, relative to the couplings in cycles. This reverses a change of units, also of uncoupled states.

    Args:
        A: (n, n) dynamics.
        B: (n, m) input matrix.

    Returns:
        Powers of two, (n,) and (m,); no entry of A/s·s' is much larger than the largest mean of A along a cycle.
    """
    balanced = balancing(A)
    off = np.abs(A - np.diag(np.diag(A)))
    largest = largest_cycle(off) or 1.0  # so that no cycle increases a unit
    state, inputs = balanced, np.ones(B.shape[1])
    for _ in range(3):  # each unit depends on the other
        moved = (np.abs(B) / state[:, None]).max(axis=0, initial=0.0)
        inputs = 1 / np.where(moved > NO_VARIANCE, moved, 1.0)
        found = np.max(np.abs(B) * inputs, axis=1, initial=0.0)
        for _ in range(len(A)):
            found, before = np.maximum(found, (off * found).max(axis=1, initial=0.0) / largest), found
            if (found <= before).all():
                break
        state = np.where(found > NO_VARIANCE, found, 0.0)
        if not state.all():  # unreached states: the size that balancing gives them
            beside = np.max(state / balanced, initial=0.0)
            state = np.where(state > 0, state, balanced * (beside if beside > 0 else 1.0))
    return np.exp2(np.round(np.log2(state))), np.exp2(np.round(np.log2(inputs)))


def root(matrix: Array, beside: Array | None = None, crumb: float = 1e-13) -> Array:
    """Return G with G G' = matrix and one column per nonzero eigenvalue, independently of the units.

    Args:
        matrix: (n, n), semidefinite up to rounding.
        beside: a covariance whose rounding errors the matrix may contain, (n, n); default: the matrix itself.
        crumb: eigenvalue per row, relative to this covariance, below which a direction counts as rounding.
    """
    spread = np.diag(matrix if beside is None else beside)
    scale = np.sqrt(np.where(spread > NO_VARIANCE, spread, 0.0))
    inverse = np.where(scale > 0, 1 / np.where(scale > 0, scale, 1.0), 0.0)
    values, vectors = np.linalg.eigh(matrix * inverse * inverse[:, None])
    kept = values > crumb * len(matrix)
    return scale[:, None] * vectors[:, kept] * np.sqrt(values[kept])


def factor(covariance: Array) -> Array:
    """Return G with G G' = covariance: the Cholesky factor if it exists, because it is cheaper to apply."""
    found = root(covariance)
    if found.shape[1] == len(covariance):
        found[:] = np.linalg.cholesky(covariance)
    return found


def symmetric_factor(covariance: Array) -> Array:
    """Return G with G G' = covariance, D S with the deviations D and the symmetric root S of the correlation matrix.

    Unlike a Cholesky factor, it does not depend on the order of the states or on their units: states in another order
    have the rows and columns of G in this order. A covariance of rank one has the only column that it can have.
    """
    if (found := root(covariance)).shape[1] == 1:
        return found
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    inverse = np.where(scale > 0, 1 / np.where(scale > 0, scale, 1.0), 0.0)
    values, vectors = np.linalg.eigh(covariance * inverse * inverse[:, None])
    found = scale[:, None] * ((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)
    return found[:, scale > 0]


def summed(F: Array, W: Array) -> Array:
    """Return Σ_k F^k W F'^k for an F that is known to be stable (``lqg.lyapunov`` proves sums)."""
    X, power = np.array(W), np.array(F)
    with np.errstate(over="ignore", invalid="ignore"):  # the callers check for overflow
        for _ in range(64):  # 2^64 terms
            term = power @ X @ power.T
            X = X + term
            square = float(np.vdot(power, power))
            if not square < LARGEST**2:
                return X * np.inf
            if square < FADED and (np.abs(term.diagonal()) <= 1e-17 * np.abs(X.diagonal())).all():
                break
            power = power @ power
        return (X + X.T) / 2
