"""Exact sampling of a continuous-time problem: dynamics, weights, noise, and the inter-sample noise cost.

``Ad``, ``Bd``, the weights, the noise and its cost all follow from one extended system ż = Fz + noise of intensity G
with the cost ∫ z'Mz dt. The vector z contains the state and the data that the actuator stores between two decisions:

    Φ = e^{Fh},  M_h = ∫ e^{F't}Me^{Ft}dt,  G_h = ∫ e^{Ft}Ge^{F't}dt,  c = ∫ tr(M G_t)dt.

Power series over h/2^k, with ‖F‖h/2^k ≤ 1/2, are followed by k doublings, which only add semidefinite terms. (Block
exponentials with e^{−Fh} in one corner lose digits if ‖F‖h is large.) The terms that are left out are bounded entry by
entry, and count as radii.

The arithmetic is that of a proof (``enclosures``): a sampled problem has matrices of doubles, and can compute the same
matrices again to any precision (``Exact``). It also knows the problem before it was sampled, whose modes are exact.

Source: vanloan1978
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from math import ceil, log2
from typing import Generic, NamedTuple, Protocol, cast

import numpy as np

from taciturn import _arrays
from taciturn._arrays import Array, ArrayLike, block_diagonal, symmetrised
from taciturn._display import Displayed
from taciturn._modes import balancing, pace
from taciturn._rational import precision
from taciturn.errors import ProblemError
from taciturn.lqg.enclosures import PRECISIONS, Balls, Doubles, E, UnprovedError, block, inner
from taciturn.lqg.equation import FEW, Equation
from taciturn.lqg.quadratic import Quadratic

_DECAYED = 0.5  # norm of a transition matrix below which all modes have decayed
_SMALL = 0.5  # norm of F over the interval of the series
_LATER = 8  # terms after the last one that are bounded entry by entry
_MOST = 1000  # doublings


class Step(NamedTuple, Generic[E]):
    """Enclosures of the matrices of one step of a linear-quadratic problem with noise."""

    # x⁺ = Ax + Bu + w, w of covariance W, and the mean cost x'Qx + u'Ru + 2x'Nu + c, where c is (1, 1).

    A: E
    B: E
    Q: E
    R: E
    N: E
    W: E
    c: E


class Source(NamedTuple):
    """The continuous-time problem that was sampled. Its modes are known exactly."""

    # dx = (Ax + Bu)dt + noise of intensity W, with the weights of the integral of the cost, and the period.

    given: Quadratic
    W: Array
    period: float


class Builder(Protocol):
    """Function that encloses the matrices of one step in a given arithmetic, and computes them anew in each call."""

    def __call__(self, arithmetic: type[E], /) -> Step[E]:
        """Return enclosures of the problem."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class Exact(Displayed):
    """The problem of one step, in an arithmetic of any precision. Enclosures that were computed are kept for reuse."""

    build: Builder  # returns enclosures of the problem
    source: Source | None = None  # the problem before it was sampled
    _kept: dict[tuple[type, float], object] = field(default_factory=dict[tuple[type, float], object])

    def __reduce__(self) -> tuple[type[Exact], tuple[Builder, Source | None]]:
        """Pickle how the enclosures are computed, and not the enclosures."""
        return Exact, (self.build, self.source)

    def __call__(self, arithmetic: type[E], /) -> Step[E]:
        """Return enclosures of the problem, in the present precision."""
        key = arithmetic, arithmetic.unit()
        if key not in self._kept:
            self._kept[key] = self.build(arithmetic)
        return cast("Step[E]", self._kept[key])

    def beside(self, place: int, S: Array, P: Array, source: Source | None = None) -> Exact:
        """Extend the problem by further states, like :meth:`~taciturn.lqg.quadratic.Quadratic.beside`."""
        return Exact(_Beside(self, place, S, P), source)

    def equation(self, arithmetic: type[E], /) -> Equation[E]:
        """Enclose the matrices that the Riccati equation of the problem contains."""
        A, B, Q, R, N, _, _ = self(arithmetic)
        return Equation(A, B, Q, R, N)


@dataclass(frozen=True, eq=False, repr=False)
class _Beside(Displayed):
    """The problem of :meth:`Exact.beside`, whose further states have no noise."""

    exact: Exact
    place: int
    S: Array
    P: Array

    def __call__(self, arithmetic: type[E], /) -> Step[E]:
        """Return enclosures of the problem."""
        step, r = self.exact(arithmetic), len(self.S)
        (n, m), before, after = step.B.shape, slice(self.place), slice(self.place, None)

        def rows(matrix: E, between: Array) -> E:
            every = slice(None)
            parts = [matrix.part(before, every), arithmetic.exact(between), matrix.part(after, every)]
            return block([[part] for part in parts if part.shape[0]])

        def square(matrix: E, corner: Array) -> E:
            side = np.insert(np.zeros((r, n)), [self.place] * r, corner.T, axis=1)
            return rows(rows(matrix, np.zeros((r, n))).T, side).T

        none, apart = np.zeros((r, r)), np.zeros((r, m))
        A, Q, W = square(step.A, self.S), square(step.Q, none), square(step.W, none)
        return Step(A, rows(step.B, self.P), Q, step.R, rows(step.N, apart), W, step.c)


@dataclass(frozen=True, eq=False, repr=False)
class Sampled(Displayed):
    """A discrete-time LQ problem: one of its steps is equivalent to a time interval, or to several shorter steps.

    x⁺ = Ax + Bu + w, with w of covariance W. The mean cost of the interval is x'Qx + u'Ru + 2x'Nu + noise_cost. No
    controller can change ``noise_cost``, but costs of intervals of different length can only be compared with it.
    ``exact`` encloses the same problem to any precision.
    """

    A: Array
    B: Array
    Q: Array
    R: Array
    N: Array
    W: Array
    noise_cost: float
    exact: Exact

    @property
    def quadratic(self) -> Quadratic:
        """The same problem without noise, as a linear-quadratic regulator problem."""
        return Quadratic(self.A, self.B, self.Q, self.R, self.N)


def sample(
    A: ArrayLike,
    B: ArrayLike,
    Q: ArrayLike,
    R: ArrayLike,
    N: ArrayLike,
    W: ArrayLike,
    period: float,
    moved: ArrayLike | None = None,
    cuts: Sequence[float] = (0.0,),
) -> Sampled:
    """Convert a continuous-time LQ problem to discrete time; the input is held from one sample to the next.

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
        cuts: parts of the period, increasing from 0 and below 1, from which on an input may be another one. The inputs
            of the sampled problem are those of each of these pieces, one after the other. Default: one piece.

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
    pieces = len(cuts)
    same: Array = np.tile(np.eye(m), (pieces, 1))  # the inputs of all pieces move alike
    noise, dynamics, weights = block_diagonal(np.eye(n), same), list[Array](), list[Array]()
    for piece in range(pieces):
        acts = block_diagonal(np.eye(n), np.eye(pieces * m)[piece * m : (piece + 1) * m])
        moves = np.hstack([same @ D, np.zeros((pieces * m, pieces * m))])
        dynamics.append(np.vstack([np.hstack([A, B]) @ acts, moves]))
        weights.append(acts.T @ np.block([[Q, N], [N.T, R]]) @ acts)
    units = np.concatenate([units[:n], np.tile(units[n:], pieces)])
    lasts = tuple((np.diff([*cuts, 1.0]) * period).tolist())
    build = _Integrated(tuple(dynamics), tuple(weights), lasts, noise @ G @ noise.T, units, n)
    return sampled(build, n + pieces * m, source if pieces == 1 else None)


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
    """Convert a continuous-time LQ problem to discrete time; between samples, the actuator predicts the state."""
    # Between samples u = L x̂ with dx̂/dt = (A + BL)x̂; the sampled "input" is x̂ at the start of the period:
    # x⁺ = e^{Ah}x + (e^{(A+BL)h} − e^{Ah})x̂ + w. Weights and noise_cost are those of ``sample``, with
    # F = [[A, BL], [0, A+BL]] and M = [[Q, NL], [L'N', L'RL]]; F contains another model if the actuator has one
    A, B, Q, R, N = Quadratic.checked(A, B, Q, R, N)
    n, m = B.shape
    W = _arrays.semidefinite("W", W, n, "states × states")
    L = _arrays.array("L", L, (m, n), "inputs × states")
    given = None if dynamics is None else _arrays.array("dynamics", dynamics, (n, n), "states × states")
    period, units = _arrays.number("period", period, 0.0), np.tile(balancing(A), 2)

    return sampled(_Predicted(Quadratic(A, B, Q, R, N), W, L, given, period, units), 2 * n)


@dataclass(frozen=True, eq=False, repr=False)
class _Integrated(Displayed):
    """The problem of ż = Fz + noise of intensity G over some times in turn, where z are states and inputs."""

    F: tuple[Array, ...]
    M: tuple[Array, ...]
    times: tuple[float, ...]
    G: Array
    units: Array  # powers of two, the units of z
    states: int  # number of entries of z that are states

    def __call__(self, arithmetic: type[E], /) -> Step[E]:
        """Return enclosures of the problem."""
        exact, whole = arithmetic.exact, None
        G = exact(self.G)
        for F, M, time in zip(self.F, self.M, self.times, strict=True):
            part = integrated(arithmetic, exact(F), exact(M), G, time, self.units)
            whole = part if whole is None else whole.then(part)
        assert whole is not None, "a period has one part at least"
        return whole.split(self.states)


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


def sampled(build: Builder, size: int, source: Source | None = None) -> Sampled:
    """Compute a problem in doubles: each entry to 14 digits, or to 1e-30 of the largest entry in its row or column."""
    # For many states, to 11 digits, or to 1e-13 of the largest in its row or column.
    exact = Exact(build, source)
    step: Step[Doubles] | Step[Balls] | None = None
    if size > FEW:
        with suppress(UnprovedError):
            step = exact(Doubles)
            if not all(_is_sharp(part.middle, part.radius, 1e-11, 1e-13) for part in step):
                step = None
    if step is None:
        for bits in PRECISIONS:
            with precision(bits), suppress(UnprovedError):
                step = exact(Balls)
            if step is not None and all(_is_sharp(part.middle, part.radius, 1e-14, 1e-30) for part in step):
                break
    if step is None or not all(np.isfinite(part.middle).all() for part in step):
        raise ProblemError(
            "a number of the problem sampled over one period exceeds the range of double precision; expected a "
            "shorter period, or states and inputs in other units"
        )
    A, B, Q, R, N, W, c = (_arrays.frozen(part.middle) for part in step)
    return Sampled(A, B, Q, R, N, W, float(c[0, 0]), exact)


def _is_sharp(middle: Array, radius: Array, own: float, others: float) -> bool:
    """Return whether radii are small relative to each entry, or to the largest one of its row or column."""
    size = np.abs(middle)
    largest = np.maximum(size.max(axis=1, keepdims=True, initial=0.0), size.max(axis=0, keepdims=True, initial=0.0))
    return bool((radius <= np.maximum(own * size, others * largest)).all())


def integrated(arithmetic: type[E], F: E, M: E, G: E, period: float, units: Array) -> Interval[E]:
    """Integrate ż = Fz + noise of intensity G, and the cost ∫ z'Mz dt, over the time ``period``."""
    to, back = arithmetic.exact(np.diag(1 / units)), arithmetic.exact(np.diag(units))
    F, M, G = to @ F @ back, back @ M @ back, to @ G @ to
    size = float(max(F.most.sum(axis=i).max(initial=0.0) for i in (0, 1))) * period
    doublings = max(0, ceil(log2(max(size, 1e-300) / _SMALL))) if np.isfinite(size) else _MOST + 1
    if doublings > _MOST:
        raise _overflowing(period, size)
    found = _series(arithmetic, F, M, G, period / 2.0**doublings)
    one, moving = arithmetic.exact(np.eye(len(units))), np.flatnonzero(F.middle.any(axis=1))
    change, (Phi, M, G, c) = found.Phi, found
    Phi = one + change
    for _ in range(doublings):
        found = Interval(Phi, M, G, c).then(Interval(Phi, M, G, c))
        _, M, G, c = found
        # Each squaring of Φ doubles the relative error of a slow mode; the same step for Φ − I does not, and is as
        # accurate for a fast mode. Once all modes have decayed, Φ itself is more accurate.
        if np.linalg.norm(Phi.middle[np.ix_(moving, moving)], 1) < _DECAYED:
            Phi = found.Phi
        else:
            change = change.times(2.0) + change @ change
            Phi = one + change
        if not all(np.isfinite(part.middle).all() for part in (Phi, M, G, c)):
            raise _overflowing(period, size)
    return Interval(back @ Phi @ to, to @ M @ to, back @ G @ back, c)


class Interval(NamedTuple, Generic[E]):
    """Enclosures for a time interval: transition matrix, weight at the start, noise covariance, and noise cost."""

    Phi: E
    M: E
    G: E
    c: E

    def then(self, second: Interval[E]) -> Interval[E]:
        """Combine this interval and the interval ``second`` that follows it to one interval."""
        return Interval(
            second.Phi @ self.Phi,
            (self.M + self.Phi.T @ second.M @ self.Phi).symmetric(),
            (second.G + second.Phi @ self.G @ second.Phi.T).symmetric(),
            self.c + second.c + inner(second.M, self.G),
        )

    def repeated(self, times: int) -> Interval[E]:
        """Combine ``times`` copies of this interval to one interval, by repeated squaring."""
        result: Interval[E] | None = None
        once = self
        while True:
            if times & 1:
                result = once if result is None else result.then(once)
            times >>= 1
            if not times:
                assert result is not None, "one repetition at least"
                return result
            once = once.then(once)

    def split(self, states: int) -> Step[E]:
        """Return the problem in which the first ``states`` variables are the state, and all others are the input."""
        x, u = slice(states), slice(states, None)
        Phi, M = self.Phi, self.M
        return Step(Phi.part(x, x), Phi.part(x, u), M.part(x, x), M.part(u, u), M.part(x, u), self.G.part(x, x), self.c)


def _series(arithmetic: type[E], F: E, M: E, G: E, step: float) -> Interval[E]:
    """Return Φ − I, M_h, G_h and c over a step with ‖F‖·step ≤ 1/2, by power series with bounds on omitted terms."""
    F, least, k, left_out = F.times(step), arithmetic.unit(), 1, 0.5
    most, power, m, g = F.most, F, M.times(step), G.times(step)
    change, weight, noise, spread = power, m, g, g.over(2)  # spread: the sum of the covariances of all instants
    while left_out > least:  # 1/(k + 1)!
        k += 1
        left_out /= k + 1
        m, g, power = m @ F, F @ g, (power @ F).over(k)
        m, g = (m + m.T).over(k), (g + g.T).over(k)
        weight, noise, change = weight + m, noise + g, change + power
        spread = spread + g.over(k + 1)
    c = inner(M, spread).times(step)
    change = change.widened(_tail(power.most, k, lambda term: term @ most))
    weight = weight.widened(_tail(m.most, k, lambda term: 2 * symmetrised(term @ most)))
    later = _tail(g.most, k, lambda term: 2 * symmetrised(most @ term))
    rest = np.array([[1.01 * step * float((np.where(later > 0, M.most, 0.0) * later).sum())]])
    return Interval(change, weight, noise.widened(later), c.widened(rest))


def _tail(term: Array, k: int, following: Callable[[Array], Array]) -> Array:
    """Return a bound on the sum of the terms after the k-th one, of which each is at most half of the one before."""
    found = np.zeros_like(term)
    for later in range(k + 1, k + _LATER + 1):
        term = following(term) / later
        found += term
    return 1.01 * (found + 2 * float(term.sum()))


def _overflowing(period: float, size: float) -> ProblemError:
    """Return the error that the state overflows within a period."""
    most = size if np.isfinite(size) else np.inf
    return ProblemError(
        f"period is {period:g}, over which the state overflows (‖A‖·period = {most:.3g}); shorten the period"
    )
