"""Functions of scipy that Taciturn uses, with type annotations."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array

_FEW_UNKNOWNS = 400  # of a linear system that is stored as a matrix

# scipy's modules are imported where they are used: an import takes 0.1 s to 0.5 s, and most results need none


def discrete_riccati(A: Array, B: Array, Q: Array, R: Array, N: Array) -> Array | None:
    """Solve a discrete-time Riccati equation with scipy, also for an indefinite R. Return None if scipy fails."""
    import scipy.linalg

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            K = cast(Array, scipy.linalg.solve_discrete_are(A, B, Q, R, s=N))
    except (np.linalg.LinAlgError, ValueError):
        return None
    return (K + K.T) / 2 if np.isfinite(K).all() else None


def discrete_controller(
    A: Array, B: Array, C: Array, D: Array, dt: float, method: str
) -> tuple[Array, Array, Array, Array]:
    """Discretise a linear system (A, B, C, D) with scipy, with the period ``dt`` and the method ``"bilinear"`` or
    ``"zoh"``.
    """
    import scipy.signal

    found: Any = scipy.signal.cont2discrete((A, B, C, D), dt, cast("Any", method))
    a, b, c, d = (np.asarray(found[i], dtype=np.float64) for i in range(4))
    return a, b, c, d


def matrix_exponential(A: Array) -> Array:
    """Return e^A."""
    import scipy.linalg

    return np.asarray(scipy.linalg.expm(A), dtype=np.float64)


def part_of_modes(A: Array, chosen: Callable[[complex], bool]) -> Array:
    """Compute V and A_u with V A = A_u V, where V x are orthonormal coordinates of the chosen modes; return V."""
    import scipy.linalg

    _, basis, count = scipy.linalg.schur(A.T, sort=lambda real, imag: chosen(complex(real, imag)))
    return basis[:, :count].T


def real_schur(A: Array, least: float = np.inf) -> tuple[Array, Array, int]:
    """Compute the real Schur form A = Z T Z' with modes of modulus ≥ ``least`` first. Return T, Z and their number."""
    import scipy.linalg

    if not len(A):
        return A, A, 0
    found = scipy.linalg.schur(A, sort=lambda real, imag: abs(complex(real, imag)) >= least)
    return np.asarray(found[0], dtype=np.float64), np.asarray(found[1], dtype=np.float64), int(found[2])


def largest_ratios(
    forms: npt.NDArray[np.complex128], others: npt.NDArray[np.complex128], tiny: float
) -> npt.NDArray[np.float64]:
    """Compute the largest ratio of each pair of Hermitian forms. The small number ``tiny`` keeps the denominators
    positive.
    """
    size = np.asarray(np.trace(others, axis1=1, axis2=2).real, dtype=np.float64)
    least = np.asarray(tiny * size[:, None, None] * np.eye(others.shape[-1]), dtype=np.complex128)
    algebra: Any = np.linalg  # whose functions lose the type of complex arrays
    inverse = algebra.inv(algebra.cholesky(others + least))
    return np.asarray(algebra.eigvalsh(inverse @ forms @ inverse.conj().swapaxes(1, 2))[:, -1], dtype=np.float64)


def crossing(function: Callable[[float], float], low: float, high: float, width: float = 1e-9) -> float:
    """Find a root of a function between ``low`` and ``high`` by Brent's method, with absolute tolerance ``width``."""
    import scipy.optimize

    return float(scipy.optimize.brentq(function, low, high, xtol=width))


def least_squares(residuals: Callable[[Array], Array], start: Array) -> Array:
    """Find a local minimum of a sum of squares by the Levenberg–Marquardt method, from the point ``start``."""
    import scipy.optimize

    return np.asarray(scipy.optimize.least_squares(residuals, start, method="lm", x_scale="jac").x, dtype=np.float64)


def sobol(dimensions: int, points: int, draws: np.random.Generator) -> Array:
    """Draw the first points of a randomly scrambled Sobol sequence in the open unit cube, (points, dimensions)."""
    from scipy.stats import qmc

    sequence = qmc.Sobol(dimensions, scramble=True, seed=draws)
    return np.asarray(sequence.random(points), dtype=np.float64) + 2.0**-31  # points of 30 bits: shift to cell centres


def normal_share(x: Array) -> Array:
    """Compute the standard normal distribution function: the probability that the variable is at most x."""
    from scipy.special import ndtr

    return np.asarray(ndtr(x), dtype=np.float64)


def normal_quantile(share: Array) -> Array:
    """Compute the quantile of the standard normal distribution for the probability ``share``."""
    from scipy.special import ndtri

    return np.asarray(ndtri(share), dtype=np.float64)


def gamma_share(shape: Array, x: float) -> Array:
    """Compute the probability that a gamma variable with the given shape parameter and scale 1 is at most x."""
    from scipy.special import gammainc

    return np.asarray(gammainc(shape, x), dtype=np.float64)


def gamma_quantile(shape: float, share: float) -> float:
    """Compute the quantile of the gamma distribution with the given shape and scale 1 for the probability ``share``."""
    from scipy.special import gammaincinv

    return float(gammaincinv(shape, share))


def fixed_point(apply: Callable[[Array], Array], added: Array) -> Array:
    """Solve x = apply(x) + added for a stable linear map ``apply``. The caller must check the residual."""
    # few unknowns are computed from the matrix of the map, many by the method of generalised minimal residuals
    size = len(added)
    if size <= _FEW_UNKNOWNS:
        matrix = np.eye(size) - np.stack([apply(row) for row in np.eye(size)], axis=1)
        return np.asarray(np.linalg.solve(matrix, added), dtype=np.float64)
    import scipy.sparse.linalg as sparse

    operator = sparse.LinearOperator((size, size), matvec=lambda x: x - apply(x), dtype=np.float64)
    found, _ = sparse.gmres(operator, added, rtol=1e-13, restart=100, maxiter=50)
    return np.asarray(found, dtype=np.float64)
