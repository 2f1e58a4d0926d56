"""The optimal controller that may change its input only every so many steps, and its exact average cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn import _arrays
from taciturn._arrays import ArrayLike
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg._axes import Quadratic
from taciturn.lqg._interval import Interval, Sampled, repeat, split
from taciturn.lqg.kalman import Filter
from taciturn.lqg.riccati import Regulator, regulate

__all__ = ["Periodic", "lift", "periodic_cost"]


@dataclass(frozen=True, eq=False)
class Periodic:
    """An input u = L x̂ renewed every few steps, L = ``regulator.L``, and its average cost per step."""

    regulator: Regulator
    cost: float


def lift(A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike, W: ArrayLike, every: int) -> Sampled:
    """Return the problem of ``every`` steps taken as one, the input held meanwhile.

    A^k, B_k = Σ_{j<k} A^jB, W_k = Σ_{j<k} A^jWA'^j, the weights Σ_{j<k} F'^jMF^j with F = [[A, B], [0, I]]
    and M = [[Q, N], [N', R]], and noise_cost = Σ_{j<k} tr(QW_j), the cost of noise that entered since the
    input was set.

    Args:
        A: (n, n) dynamics of one step.
        B: (n, m) input matrix.
        Q: (n, n) symmetric state weight.
        R: (m, m) symmetric input weight.
        N: (n, m) cross weight.
        W: (n, n) semidefinite covariance of the noise of one step.
        every: k, the number of steps, at least 1.

    Returns:
        The lifted problem; its costs are sums over k steps.

    Raises:
        ProblemError: data of the wrong shape or range, or a growth over k steps beyond the range of numbers.

    Source: astrom1997computer

    Example:
        >>> found = lift([[2.0]], [[1.0]], [[1.0]], [[0.0]], [[0.0]], [[1.0]], 2)
        >>> float(found.A[0, 0]), float(found.B[0, 0]), float(found.W[0, 0]), found.noise_cost
        (4.0, 3.0, 5.0, 1.0)
    """
    A, B, Q, R, N = Quadratic.checked(A, B, Q, R, N)
    n, m = B.shape
    W = _arrays.semidefinite("W", W, n, "states × states")
    every = _arrays.count("every", every)
    F = np.block([[A, B], [np.zeros((m, n)), np.eye(m)]])
    once = Interval(F, np.block([[Q, N], [N.T, R]]), np.pad(W, ((0, m), (0, m))), 0.0)
    with np.errstate(over="ignore", invalid="ignore"):
        whole = repeat(once, every)
    if not all(np.isfinite(part).all() for part in (whole.Phi, whole.M, whole.G, whole.noise_cost)):
        raise ProblemError(
            f"every is {every}, over which the state grows beyond every number the computer holds; hold for fewer steps"
        )
    return split(whole, n)


def periodic_cost(
    A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike, estimator: Filter, every: int
) -> Periodic:
    """Return the best controller that filters at every step and changes its input every ``every`` steps.

    At the steps 0, k, 2k, … the filtered estimate sets u = L x̂, held for k steps. The estimate obeys
    x̂⁺ = Ax̂ + Bu + (corrections of covariance Σ̃ − Σ), white and independent of the error, hence

        cost per step = tr(QΣ) + (tr(K X_k) + noise_cost)/k,   with the lifted problem of W = Σ̃ − Σ;

    X_k is its noise covariance, noise_cost the part that entered after the last update, and K, L its
    regulator. For k = 1 this is J_all = tr(QΣ) + tr(K(Σ̃ − Σ)). With the whole state measured, pass
    ``steady_filter(A, I, W, 0)``.

    Args:
        A: (n, n) dynamics of one step.
        B: (n, m) input matrix.
        Q: (n, n) symmetric state weight.
        R: (m, m) symmetric input weight.
        N: (n, m) cross weight.
        estimator: the steady filter of the plant.
        every: k, the number of steps between updates, at least 1.

    Returns:
        The regulator of the lifted problem (its K and H are sums over k steps) and the average cost per step.

    Raises:
        ProblemError: data of the wrong shape or range.
        UnstableError: the plant held for k steps cannot be stabilised.

    Source: khashooei2017, astrom1997computer

    Example:
        >>> from taciturn.lqg.kalman import steady_filter
        >>> seen = steady_filter([[2.0]], [[1.0]], [[1.0]], [[0.0]])
        >>> found = periodic_cost([[2.0]], [[1.0]], [[1.0]], [[0.0]], [[0.0]], seen, 2)
        >>> round(found.cost, 6)
        4.030057
    """
    n = len(_arrays.square("A", A, "states × states"))
    Q = _arrays.symmetric("Q", Q, n, "states × states")
    posterior = _arrays.semidefinite("estimator.posterior", estimator.posterior, n, "states × states")
    # gain S gain' rather than the difference Σ̃ − Σ: semidefinite under rounding.
    corrections = estimator.gain @ estimator.innovation @ estimator.gain.T
    whole = lift(A, B, Q, R, N, corrections, every)
    try:
        regulator = regulate(whole.A, whole.B, whole.Q, whole.R, whole.N)
    except UnstableError as error:
        if every == 1:
            raise
        raise UnstableError(f"holding the input for {every} steps leaves the plant beyond control: {error}") from None
    held = float(np.sum(regulator.K * whole.W)) + whole.noise_cost
    return Periodic(regulator, float(np.sum(Q * posterior)) + held / every)
