"""Control that renews its input at fixed ticks: any cycle of intervals, with the best gains and the exact cost.

An interval of k ticks is one tick of a slower plant, the lifted one. A cycle of intervals is one tick of a plant that
is slower still, whose input stacks those of all sends: one Riccati equation gives the cost-to-go at its start, and a
step back through each interval gives the others, with the gains.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from taciturn import _arrays
from taciturn._arrays import Array, ArrayLike, symmetrised
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg._axes import Quadratic
from taciturn.lqg._dare import price
from taciturn.lqg._doubling import double
from taciturn.lqg._interval import Interval, Sampled, repeat, split
from taciturn.lqg.riccati import regulate

__all__ = ["Held", "Pattern", "cycles", "lift", "necklaces", "step_back"]


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


@dataclass(frozen=True, eq=False)
class Pattern:
    """Sends that come these ticks after one another, again and again.

    Args:
        intervals: from one send to the next, in ticks.
        gains: u = L x̂ at each send, held until the next, (sends, m, n).
        values: cost-to-go x̂'Kx̂ at each send, (sends, n, n).
        cost: average per tick of what the input and the corrections of the estimate cost.
    """

    intervals: tuple[int, ...]
    gains: Array
    values: Array
    cost: float

    def unrolled(self) -> tuple[Array, Array]:
        """Return whether each tick sends, and its gain: that of the last send."""
        places = np.zeros(sum(self.intervals), dtype=bool)
        places[np.cumsum((0, *self.intervals[:-1]))] = True
        return places, np.repeat(self.gains, self.intervals, axis=0)


class Held:
    """A plant whose input is held from send to send, for every number of ticks that is asked.

    The estimate is filtered at every tick and obeys x̂⁺ = Ax̂ + Bu + (corrections), white and independent of the error
    of the estimate. So the average cost per tick is tr(QΣ), of the error, plus that of ``solve``.

    Args:
        A: (n, n) dynamics of one tick.
        B: (n, m) input matrix.
        Q: (n, n) symmetric state weight.
        R: (m, m) symmetric input weight.
        N: (n, m) cross weight.
        corrections: (n, n) covariance of what a measurement adds to the estimate, Σ̃ − Σ; W where the state is measured.

    Source: khashooei2017, astrom1997computer, bengaid2006

    Example:
        >>> held = Held([[2.0]], [[1.0]], [[1.0]], [[0.0]], [[0.0]], [[1.0]])
        >>> round(held.solve((2,)).cost, 6), round(held.solve((1, 2)).cost, 6)
        (4.030057, 2.466667)
    """

    def __init__(
        self, A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike, corrections: ArrayLike
    ) -> None:
        """Nothing is computed before it is asked."""
        self._tick, self._known = (A, B, Q, R, N, corrections), dict[int, Sampled]()

    def lifted(self, ticks: int) -> Sampled:
        """Return the problem of holding the input for so many ticks."""
        if ticks not in self._known:
            self._known[ticks] = lift(*self._tick, ticks)
        return self._known[ticks]

    def screen(self, listed: Sequence[tuple[int, ...]]) -> Array:
        """Return about what cycles of as many intervals each cost, all at once; inf where nothing was found.

        The costs are those of the doubling algorithm without a check of its errors: they say which cycles to solve.
        """
        ticks = sorted({interval for cycle in listed for interval in cycle})
        parts = [self.lifted(interval) for interval in ticks]
        chosen = np.searchsorted(ticks, np.array(listed))
        A, B, Q, R, N, W = (
            np.array([getattr(part, name) for part in parts])[chosen].swapaxes(0, 1) for name in "ABQRNW"
        )
        noise = np.array([part.noise_cost for part in parts])[chosen].sum(axis=1)
        with np.errstate(all="ignore"):
            K = _roughly(*_stacked(A, B, Q, R, N))
            for stage in reversed(range(len(A))):
                noise = noise + (K * W[stage]).sum(axis=(1, 2))
                turned = B[stage].swapaxes(1, 2) @ K
                off = turned @ A[stage] + N[stage].swapaxes(1, 2)
                saved = off.swapaxes(1, 2) @ _inverse(R[stage] + turned @ B[stage]) @ off
                K = symmetrised(Q[stage] + A[stage].swapaxes(1, 2) @ K @ A[stage] - saved)
        cost = noise / np.array(listed).sum(axis=1)
        return np.where(np.isfinite(cost) & (cost > 0), cost, np.inf)

    def solve(self, intervals: Sequence[int]) -> Pattern:
        """Return the optimal gains of a cycle of intervals, and its cost.

        Raises:
            ProblemError: the state grows beyond the range of numbers.
            UnstableError: the plant cannot be stabilised so.
        """
        stretches = [self.lifted(ticks) for ticks in intervals]
        try:
            values = [_at_the_start(stretches)]
        except UnstableError as error:
            if sum(intervals) == 1:
                raise
            named = " and ".join(str(ticks) for ticks in intervals)
            lost = f"holding the input for {named} steps leaves the plant beyond control"
            raise UnstableError(f"{lost}: {error}") from None
        gains: list[Array] = []
        total = 0.0
        for stretch in reversed(stretches):
            total += float(np.sum(values[0] * stretch.W)) + stretch.noise_cost
            K, L = step_back(stretch, values[0])
            gains.insert(0, L)
            values.insert(0, K)
        return Pattern(tuple(intervals), np.array(gains), np.array(values[:-1]), total / sum(intervals))


def _at_the_start(stretches: Sequence[Sampled]) -> Array:
    """Return K at the first send: the cycle as one problem, whose input stacks those of all its sends."""
    A, B, Q, R, N = (np.array([[getattr(stretch, name)] for stretch in stretches]) for name in "ABQRN")
    whole = [part[0] for part in _stacked(A, B, Q, R, N)]
    return regulate(*whole).K


def _stacked(A: Array, B: Array, Q: Array, R: Array, N: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Return cycles as one problem each: the stages come first in what is given, (sends, cycles, …)."""
    sends, many, n, m = B.shape
    reach = np.zeros((many, n, n + sends * m))  # the state at a send, of the first one and the inputs so far
    reach[:, :, :n] = np.eye(n)
    M = np.zeros((many, n + sends * m, n + sends * m))
    for k in range(sends):
        now = slice(n + k * m, n + (k + 1) * m)
        turned = reach.swapaxes(1, 2)
        M += turned @ Q[k] @ reach
        across = turned @ N[k]
        M[:, :, now] += across
        M[:, now, :] += across.swapaxes(1, 2)
        M[:, now, now] += R[k]
        reach = A[k] @ reach
        reach[:, :, now] += B[k]
    M = symmetrised(M)
    return reach[:, :, :n], reach[:, :, n:], M[:, :n, :n], M[:, n:, n:], M[:, :n, n:]


def _roughly(A: Array, B: Array, Q: Array, R: Array, N: Array) -> Array:
    """Return the costs-to-go of a stack of problems by the doubling algorithm, whose errors nobody has looked at."""
    last = Q + np.trace(Q, axis1=1, axis2=2)[:, None, None] / len(Q[0]) * np.eye(len(Q[0]))
    H = symmetrised(R + B.swapaxes(1, 2) @ last @ B)
    return double(A, B, Q, N, last, H, _inverse(H))


def _inverse(H: Array) -> Array:
    """Return the inverses of a stack of symmetric matrices, pseudo-inverses where one is singular; NaN stays NaN."""
    try:
        return np.asarray(np.linalg.inv(H), dtype=np.float64)
    except np.linalg.LinAlgError:  # an input that costs nothing
        unknown = np.flatnonzero(~np.isfinite(H.sum(axis=(1, 2))))
        H = H.copy()
        H[unknown] = 0.0
        inverses = np.asarray(np.linalg.pinv(H, hermitian=True), dtype=np.float64)
        inverses[unknown] = np.nan
        return inverses


def step_back(stretch: Sampled, K: Array) -> tuple[Array, Array]:
    """Return the cost-to-go and the gain at the start of a stretch, from the cost-to-go at its end."""
    H, inverse = price(stretch.B, K, stretch.R)
    L = -inverse @ (stretch.B.T @ K @ stretch.A + stretch.N.T)
    return symmetrised(stretch.Q + stretch.A.T @ K @ stretch.A - L.T @ H @ L), L


def necklaces(length: int, sends: int) -> Iterator[tuple[int, ...]]:
    """Return the ways to write ``length`` as a sum of so many intervals, one of all rotations: the largest."""
    return _extended((), length, sends, range(1, length + 1))


def cycles(intervals: Sequence[int], most: int) -> Iterator[tuple[int, ...]]:
    """Return the cycles of at most so many of these intervals, one of all rotations, none that repeats another."""
    low, high = min(intervals), max(intervals)
    for sends in range(1, most + 1):
        for length in range(low * sends, high * sends + 1):
            for cycle in _extended((), length, sends, intervals):
                if all(cycle != cycle[i:] + cycle[:i] for i in range(1, sends)):
                    yield cycle


def _extended(head: tuple[int, ...], left: int, sends: int, intervals: Sequence[int]) -> Iterator[tuple[int, ...]]:
    missing = sends - len(head)
    if missing == 0:
        if left == 0 and all(head >= head[i:] + head[:i] for i in range(1, sends)):
            yield head
        return
    for interval in reversed(intervals):
        if interval <= min(head[0] if head else left, left - missing + 1):
            yield from _extended((*head, interval), left - interval, sends, intervals)
