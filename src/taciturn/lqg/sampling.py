"""Exact sampling of a continuous-time problem: dynamics, weights, noise, and inter-sample noise cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn import _arrays
from taciturn._arrays import Array, ArrayLike
from taciturn._display import Displayed
from taciturn._modes import balancing, pace
from taciturn.lqg.enclosures import E, block
from taciturn.lqg.intervals import Integrated, Sampled, Source, Step, integrated, sampled
from taciturn.lqg.quadratic import Quadratic

__all__ = ["Sampled", "sample", "sample_prediction"]


def sample(
    A: ArrayLike,
    B: ArrayLike,
    Q: ArrayLike,
    R: ArrayLike,
    N: ArrayLike,
    W: ArrayLike,
    period: float,
    moved: ArrayLike | None = None,
) -> Sampled:
    """Return the discrete-time LQ problem of a continuous-time problem whose input is held between samples.

    dx = (Ax + Bu)dt + noise of intensity W, cost ∫ x'Qx + u'Ru + 2x'Nu dt, u constant over a period h:
    A_d = e^{Ah}, B_d = ∫e^{As}ds B, W_d = ∫e^{As}We^{A's}ds, [[Q_d, N_d], [N_d', R_d]] = ∫e^{F't}Me^{Ft}dt
    with F = [[A, B], [0, 0]], M = [[Q, N], [N', R]], and noise_cost = ∫_0^h tr(Q ∫_0^s e^{Ar}We^{A'r}dr)ds.
    N_d is nonzero even if N = 0. The cost per unit of time is (discrete average + noise_cost)/h.

    An input may also move between samples by itself, du = Dx dt + noise, from the input u at the start of the period:
    F = [[A, B], [D, 0]]. Such an input is the deviation u − Ud of a held input from what a disturbance d needs at each
    instant.

    Args:
        A: (n, n) dynamics, per unit of time.
        B: (n, m) input matrix, per unit of time.
        Q: (n, n) symmetric state weight, per unit of time.
        R: (m, m) symmetric input weight, per unit of time.
        N: (n, m) cross weight, per unit of time.
        W: (n, n) semidefinite noise intensity, covariance per unit of time; of states and inputs, (n + m, n + m), if
            these move.
        period: h > 0, in the same unit of time.
        moved: D, (m, n), how the states move the inputs, per unit of time; omitted: the inputs are held.

    Returns:
        The sampled problem, to the precision of its entries; ``exact`` encloses it.

    Raises:
        ProblemError: data of the wrong shape or range, or the state overflows within a period.

    Source: astrom1997computer, vanloan1978

    Example:
        >>> A, B, Q, W = [[0, 1], [0, 0]], [[0], [1]], [[1, 0], [0, 0]], [[0, 0], [0, 1]]
        >>> found = sample(A, B, Q, [[0]], [[0], [0]], W, 1.0)
        >>> found.B.ravel().tolist(), round(found.noise_cost * 12, 12)
        ([0.5, 1.0], 1.0)
        >>> found = sample([[0]], [[1]], [[1]], [[1]], [[0]], [[0, 0], [0, 1]], 1.0, moved=[[0]])
        >>> round(found.noise_cost * 12, 12)  # ∫ Var u dt = 1/2, and ∫ Var x dt = ∫ t³/3 dt = 1/12
        7.0
    """
    A, B, Q, R, N = given = Quadratic.checked(A, B, Q, R, N)
    n, m = B.shape
    period, scale, source = _arrays.number("period", period, 0.0), balancing(A), None
    if moved is None:
        W = _arrays.semidefinite("W", W, n, "states × states")
        source, D, G = Source(given, W, period), np.zeros((m, n)), np.pad(W, (0, m))
    else:
        D = _arrays.array("moved", moved, (m, n), "inputs × states")
        G = _arrays.semidefinite("W", W, n + m, "(states + inputs) × (states + inputs)")
    reach: Array = np.max(np.abs(B / scale[:, None]), axis=0, initial=0.0)
    reach = np.where(reach > 0, reach, 1.0)
    units = np.concatenate([scale, np.exp2(np.round(np.log2(max(pace(A), 1 / period) / reach)))])
    F, M = np.block([[A, B], [D, np.zeros((m, m))]]), np.block([[Q, N], [N.T, R]])
    return sampled(Integrated(F, M, G, period, units, n), n + m, source)


def sample_prediction(
    A: ArrayLike,
    B: ArrayLike,
    Q: ArrayLike,
    R: ArrayLike,
    N: ArrayLike,
    W: ArrayLike,
    L: ArrayLike,
    period: float,
    dynamics: ArrayLike | None = None,
) -> Sampled:
    """Return the discrete-time LQ problem of a continuous-time problem with an actuator that predicts the state.

    Between samples u = L x̂ with dx̂/dt = (A + BL)x̂; the sampled "input" is x̂ at the start of the period:
    x⁺ = e^{Ah}x + (e^{(A+BL)h} − e^{Ah})x̂ + w. Weights and noise_cost are those of :func:`sample`, with
    F = [[A, BL], [0, A+BL]] and M = [[Q, NL], [L'N', L'RL]]. If the actuator has another model, F contains that model.

    Args:
        A: (n, n) dynamics, per unit of time.
        B: (n, m) input matrix, per unit of time.
        Q: (n, n) symmetric state weight, per unit of time.
        R: (m, m) symmetric input weight, per unit of time.
        N: (n, m) cross weight, per unit of time.
        W: (n, n) semidefinite noise intensity, covariance per unit of time.
        L: (m, n) gain, u = L x̂.
        period: h > 0, in the same unit of time.
        dynamics: (n, n), closed-loop model of the actuator; omitted: A + BL.

    Returns:
        The sampled problem with an input of n entries: B is (n, n), R is (n, n), N is (n, n).

    Raises:
        ProblemError: data of the wrong shape or range, or the state overflows within a period.

    Source: khashooei2017, vanloan1978

    Example:
        >>> found = sample_prediction([[0]], [[1]], [[1]], [[1]], [[0]], [[1]], [[-1]], 1.0)
        >>> round(float(found.A[0, 0] + found.B[0, 0]), 6)  # e^{-1}: the prediction is exact at the sample
        0.367879
    """
    A, B, Q, R, N = Quadratic.checked(A, B, Q, R, N)
    n, m = B.shape
    W = _arrays.semidefinite("W", W, n, "states × states")
    L = _arrays.array("L", L, (m, n), "inputs × states")
    given = None if dynamics is None else _arrays.array("dynamics", dynamics, (n, n), "states × states")
    period, units = _arrays.number("period", period, 0.0), np.tile(balancing(A), 2)

    return sampled(_Predicted(Quadratic(A, B, Q, R, N), W, L, given, period, units), 2 * n)


@dataclass(frozen=True, eq=False, repr=False)
class _Predicted(Displayed):
    """The problem of :func:`sample_prediction`, with the units of state and predicted state."""

    given: Quadratic
    W: Array
    L: Array
    model: Array | None
    period: float
    units: Array

    def __call__(self, arithmetic: type[E], /) -> Step[E]:
        """Return enclosures of the problem."""
        exact, n = arithmetic.exact, len(self.W)
        a, b, q, r, cross, gain = (exact(part) for part in (*self.given, self.L))
        model = a + b @ gain if self.model is None else exact(self.model)
        F = block([[a, b @ gain], [exact(np.zeros((n, n))), model]])
        across = cross @ gain
        M = block([[q, across], [across.T, (gain.T @ r @ gain).symmetric()]])
        return integrated(arithmetic, F, M, exact(np.pad(self.W, (0, n))), self.period, self.units).split(n)
