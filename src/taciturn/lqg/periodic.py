"""Optimal gains and exact cost of control whose input is updated only at fixed steps of a repeating cycle.

An interval of k steps is one step of a slower plant, the lifted plant. A cycle of intervals is one step of an even
slower plant, whose input contains the inputs of all sends. One Riccati equation gives the cost-to-go at the start of
the cycle; one backward step per interval gives the other costs-to-go and the gains.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce

import numpy as np

from taciturn import _arrays
from taciturn._arrays import Array, ArrayLike, is_definite, symmetrised
from taciturn._display import Displayed
from taciturn.errors import ProblemError, TaciturnError, UnstableError
from taciturn.lqg.enclosures import Doubles, E, UnprovedError, block
from taciturn.lqg.intervals import Interval, Sampled, Step, sampled
from taciturn.lqg.quadratic import Quadratic, Span, price
from taciturn.lqg.riccati import costs_nothing, regulate_for
from taciturn.lqg.stabilising import Equation

__all__ = ["Held", "Pattern", "cycles", "lift", "necklaces", "step_back"]

CRUMB = 1e-12  # change of a cost-to-go, relative to the products in its sum, that is rounding


def lift(
    A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike, W: ArrayLike, every: int, factor: float = 1.0
) -> Sampled:
    """Return the lifted LQ problem, in which ``every`` steps with a constant input become one step.

    A^k, B_k = Σ_{j<k} A^jB, W_k = Σ_{j<k} A^jWA'^j, the weights Σ_{j<k} F'^jMF^j with F = [[A, B], [0, I]]
    and M = [[Q, N], [N', R]], and noise_cost = Σ_{j<k} tr(QW_j), the cost of the noise since the input was set.

    Args:
        A: (n, n) dynamics of one step.
        B: (n, m) input matrix.
        Q: (n, n) symmetric state weight.
        R: (m, m) symmetric input weight.
        N: (n, m) cross weight.
        W: (n, n) semidefinite covariance of the noise of one step.
        every: k, the number of steps, at least 1.
        factor: by which the input changes from one step to the next, instead of being constant: F = [[A, B],
            [0, factor·I]]. For 0, the input is zero after the first step, and B_k = A^(k−1)B.

    Returns:
        The lifted problem; its costs are sums over k steps.

    Raises:
        ProblemError: data of the wrong shape or range, or the state overflows within k steps.

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
    F, M = np.block([[A, B], [np.zeros((m, n)), factor * np.eye(m)]]), np.block([[Q, N], [N.T, R]])
    G = np.pad(W, ((0, m), (0, m)))

    def build(arithmetic: type[E]) -> Step[E]:
        exact = arithmetic.exact
        once = Interval(exact(F), exact(M), exact(G), exact(np.zeros((1, 1))))
        return once.repeated(every).split(n)

    try:
        return sampled(build, n + m)
    except ProblemError:
        raise ProblemError(
            f"every is {every}, over which the state overflows; hold the input for fewer steps"
        ) from None


@dataclass(frozen=True, eq=False, repr=False)
class Pattern(Displayed):
    """A periodic pattern of sends with given intervals, with its optimal gains, costs-to-go and average cost.

    Args:
        intervals: steps from one send to the next, over one period.
        gains: u = L x̂ at each send, held until the next, (sends, m, n).
        values: cost-to-go x̂'Kx̂ at each send, (sends, n, n).
        cost: average cost per step of the input and of the corrections of the estimate.
    """

    intervals: tuple[int, ...]
    gains: Array
    values: Array
    cost: float

    def unrolled(self) -> tuple[Array, Array]:
        """Return, for each step of a period, whether a send occurs, and the gain of the most recent send."""
        places = np.zeros(sum(self.intervals), dtype=bool)
        places[np.cumsum((0, *self.intervals[:-1]))] = True
        return places, np.repeat(self.gains, self.intervals, axis=0)


class Held:
    """Optimal control of a plant whose input is held from one send to the next, for given intervals between sends.

    The estimate is filtered at every step and obeys x̂⁺ = Ax̂ + Bu + (corrections). The corrections are white and
    independent of the estimation error. So the average cost per step is tr(QΣ) plus that of ``solve``.

    Args:
        A: (n, n) dynamics of one step.
        B: (n, m) input matrix.
        Q: (n, n) symmetric state weight.
        R: (m, m) symmetric input weight.
        N: (n, m) cross weight.
        corrections: (n, n) covariance of the correction by a measurement, Σ̃ − Σ; W if the state is measured.
        factor: by which the input changes from one step to the next between sends: 1 if it is held, 0 if it is zero.

    Source: khashooei2017, astrom1997computer, bengaid2006

    Example:
        >>> held = Held([[2.0]], [[1.0]], [[1.0]], [[0.0]], [[0.0]], [[1.0]])
        >>> round(held.solve((2,)).cost, 6), round(held.solve((1, 2)).cost, 6)
        (4.030057, 2.466667)
    """

    def __init__(
        self,
        A: ArrayLike,
        B: ArrayLike,
        Q: ArrayLike,
        R: ArrayLike,
        N: ArrayLike,
        corrections: ArrayLike,
        factor: float = 1.0,
    ) -> None:
        """Store the problem of one step."""
        self._tick, self._factor, self._known = (A, B, Q, R, N, corrections), factor, dict[int, Sampled]()

    @cached_property
    def _last(self) -> Array | None:
        """Cost-to-go with a send at every step; None if no input stabilises the plant.

        As the weight of the final state of a screened cycle, it does not count where a disturbance or a set-point keeps
        the state away from zero: another weight would be paid for ever, and most by cycles of many sends.
        """
        try:
            return _at_the_start([self.lifted(1)])
        except TaciturnError:
            return None

    def lifted(self, ticks: int) -> Sampled:
        """Return the LQ problem in which the input is held for a number of steps, or changes by the factor."""
        if ticks not in self._known:
            self._known[ticks] = lift(*self._tick, ticks, self._factor)
        return self._known[ticks]

    def screen(self, listed: Sequence[tuple[int, ...]]) -> Array:
        """Return approximate costs of many cycles with equal numbers of intervals; inf for a cost that was not found.

        The costs come from the doubling algorithm without an error check. They show which cycles are worth solving.
        """
        ticks = sorted({interval for cycle in listed for interval in cycle})
        parts, chosen = [self.lifted(interval) for interval in ticks], np.searchsorted(ticks, np.array(listed))
        Q, many = parts[0].Q, range(chosen.shape[1])
        last = Q + np.trace(Q) / len(Q) * np.eye(len(Q)) if self._last is None else self._last
        # where a disturbance lasts, an entry of the cost-to-go may be exactly 0, and only its rounding error remains
        sums = (np.abs(part.A).T @ np.abs(last) @ np.abs(part.A) + np.abs(part.Q) + np.abs(last) for part in parts)
        noise = np.array([part.noise_cost for part in parts])[chosen].sum(axis=1)
        with np.errstate(all="ignore"):
            spans = [Span.of(part.quadratic, last, price(part.B, last, part.R)[1]) for part in parts]
            stages = [Span(*(np.array(one)[chosen[:, k]] for one in zip(*spans, strict=True))) for k in many]
            K = reduce(Span.then, stages).for_ever(last, CRUMB * sum(map(np.diag, sums))) - last
            # backwards: the noise of an interval costs what the state at its end, the next send, costs from there on
            for k in reversed(many):
                noise = noise + ((last + K) * np.array([part.W for part in parts])[chosen[:, k]]).sum(axis=(1, 2))
                K = stages[k].before(K)
        cost = noise / np.array(listed).sum(axis=1)
        return np.where(np.isfinite(cost) & (cost > 0), cost, np.inf)

    def solve(self, intervals: Sequence[int]) -> Pattern:
        """Return the optimal gains and the average cost of a cycle of intervals with held inputs.

        Raises:
            ProblemError: the state overflows within an interval, or an input costs nothing.
            UnstableError: the plant cannot be stabilised with this cycle.
        """
        stretches = [self.lifted(ticks) for ticks in intervals]
        try:
            values = [_at_the_start(stretches)]
        except UnstableError as error:
            if sum(intervals) == 1:
                raise
            named = " and ".join(str(ticks) for ticks in intervals)
            lost = f"holding the input for {named} steps prevents stabilisation"
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
    """Return K at the first send, from the cycle as one problem whose input contains the inputs of all sends."""

    def recipe(arithmetic: type[E]) -> Equation[E]:
        return _joined(arithmetic, [stretch.exact.equation(arithmetic) for stretch in stretches])

    try:
        rough = _joined(Doubles, [Equation(*map(Doubles.exact, stretch.quadratic)) for stretch in stretches])
    except UnprovedError as error:
        raise UnstableError(f"the cost cannot be computed: {error}") from None
    return regulate_for(Quadratic(*(part.middle for part in rough)), recipe).K


def _joined(arithmetic: type[E], steps: Sequence[Equation[E]]) -> Equation[E]:
    """Return one problem for the intervals of a cycle, whose input contains the inputs of all sends."""
    n, m = steps[0].B.shape
    x, u = slice(n), slice(n, None)
    size = n + len(steps) * m
    reach = arithmetic.exact(np.eye(n, size))  # maps the state at the first send and the inputs to that at send k
    M = arithmetic.exact(np.zeros((size, size)))
    for k, step in enumerate(steps):
        now = arithmetic.exact(np.eye(size)[n + k * m : n + (k + 1) * m])
        both = block([[reach], [now]])
        weight = block([[step.Q, step.N], [step.N.T, step.R]])
        M = (M + both.T @ weight @ both).symmetric()
        reach = step.A @ reach + step.B @ now
    return Equation(reach.part(x, x), reach.part(x, u), M.part(x, x), M.part(u, u), M.part(x, u))


def step_back(stretch: Sampled, K: Array) -> tuple[Array, Array]:
    """Return cost-to-go and gain at the start of an interval with a held input, from the cost-to-go at its end.

    Raises:
        ProblemError: an input costs nothing, now or later.
    """
    H, inverse = price(stretch.B, K, stretch.R)
    if not (is_definite(stretch.R) or is_definite(H)):
        raise costs_nothing(H)
    L = -inverse @ (stretch.B.T @ K @ stretch.A + stretch.N.T)
    return symmetrised(stretch.Q + stretch.A.T @ K @ stretch.A - L.T @ H @ L), L


def necklaces(length: int, sends: int) -> Iterator[tuple[int, ...]]:
    """Yield all cycles of ``sends`` intervals with the sum ``length``, but only one rotation of each cycle.

    The lexicographically largest rotation of each cycle is given.
    """
    return _extended((), length, sends, range(1, length + 1))


def cycles(intervals: Sequence[int], most: int) -> Iterator[tuple[int, ...]]:
    """Yield all cycles of up to ``most`` of the given intervals, but only one rotation of each cycle.

    Cycles that repeat a shorter cycle are left out.
    """
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
