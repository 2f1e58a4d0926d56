"""Typed interface to the functions of scipy that this package uses."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, cast

import numpy as np

from taciturn._arrays import Array

_FEW_UNKNOWNS = 400  # of a linear system that is stored as a matrix

# scipy's modules are imported where they are used: an import takes 0.1 s to 0.5 s, and most results need none


def discrete_riccati(A: Array, B: Array, Q: Array, R: Array, N: Array) -> Array | None:
    """Return scipy's solution of the discrete Riccati equation, or None if scipy finds none; R may be indefinite."""
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
    """Return A, B, C, D of a continuous system at steps of dt, by scipy's method ``"bilinear"`` or ``"zoh"``."""
    import scipy.signal

    found: Any = scipy.signal.cont2discrete((A, B, C, D), dt, cast("Any", method))
    a, b, c, d = (np.asarray(found[i], dtype=np.float64) for i in range(4))
    return a, b, c, d


def matrix_exponential(A: Array) -> Array:
    """Return e^A."""
    import scipy.linalg

    return np.asarray(scipy.linalg.expm(A), dtype=np.float64)


def part_of_modes(A: Array, chosen: Callable[[complex], bool]) -> Array:
    """Return V with V A = A_u V, where V x are orthonormal coordinates of the chosen modes."""
    import scipy.linalg

    _, basis, count = scipy.linalg.schur(A.T, sort=lambda real, imag: chosen(complex(real, imag)))
    return basis[:, :count].T


def crossing(function: Callable[[float], float], low: float, high: float, width: float = 1e-9) -> float:
    """Return the root of a function in an interval by Brent's method, to an absolute tolerance."""
    import scipy.optimize

    return float(scipy.optimize.brentq(function, low, high, xtol=width))


def least_squares(residuals: Callable[[Array], Array], start: Array) -> Array:
    """Return the local minimiser of the sum of squared residuals near a start, by Levenberg-Marquardt."""
    import scipy.optimize

    return np.asarray(scipy.optimize.least_squares(residuals, start, method="lm", x_scale="jac").x, dtype=np.float64)


def sobol(dimensions: int, points: int, draws: np.random.Generator) -> Array:
    """Return the first points of a scrambled Sobol sequence in the open unit cube, (points, dimensions)."""
    from scipy.stats import qmc

    sequence = qmc.Sobol(dimensions, scramble=True, seed=draws)
    return np.asarray(sequence.random(points), dtype=np.float64) + 2.0**-31  # points of 30 bits: shift to cell centres


def normal_share(x: Array) -> Array:
    """Return the probability that a standard normal variable is below x."""
    from scipy.special import ndtr

    return np.asarray(ndtr(x), dtype=np.float64)


def normal_quantile(share: Array) -> Array:
    """Return the quantile of the standard normal distribution."""
    from scipy.special import ndtri

    return np.asarray(ndtri(share), dtype=np.float64)


def gamma_share(shape: Array, x: float) -> Array:
    """Return the probability that a gamma variable with a given shape and scale 1 is below x."""
    from scipy.special import gammainc

    return np.asarray(gammainc(shape, x), dtype=np.float64)


def gamma_quantile(shape: float, share: float) -> float:
    """Return the value below which a gamma variable with a given shape and scale 1 is with this probability."""
    from scipy.special import gammaincinv

    return float(gammaincinv(shape, share))


def fixed_point(apply: Callable[[Array], Array], added: Array) -> Array:
    """Return x = apply(x) + added for a linear map of spectral radius below 1; the caller checks the residual."""
    # few unknowns are computed from the matrix of the map, many by the method of generalised minimal residuals
    size = len(added)
    if size <= _FEW_UNKNOWNS:
        matrix = np.eye(size) - np.stack([apply(row) for row in np.eye(size)], axis=1)
        return np.asarray(np.linalg.solve(matrix, added), dtype=np.float64)
    import scipy.sparse.linalg as sparse

    operator = sparse.LinearOperator((size, size), matvec=lambda x: x - apply(x), dtype=np.float64)
    found, _ = sparse.gmres(operator, added, rtol=1e-13, restart=100, maxiter=50)
    return np.asarray(found, dtype=np.float64)
