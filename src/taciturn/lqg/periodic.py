"""Optimal control with sends at fixed steps: one held input with a cycle of intervals, or several periodic links.

**One link.** An interval of k steps with a constant input is one step of a slower plant, the lifted plant:

    A^k,   B_k = Σ_{j<k} A^j B,   weights Σ_{j<k} F'^j M F^j with F = [[A, B], [0, I]] and M = [[Q, N], [N', R]].

A cycle of intervals is one step of an even slower plant, whose input contains the inputs of all sends. One Riccati
equation gives the cost-to-go at the start of the cycle; one backward step per interval gives the other costs-to-go and
the gains. Many cycles are first screened by doubling without an error check.

A disturbance or a set-point d that lasts costs nothing only if a held input follows it: if Ud stays (``followed``).
Otherwise its cost grows without limit, and no average exists. Since the mode of d lies on the unit circle only up to
the rounding of its matrix, such as the cosine of a sinusoid, the Riccati equation of the doubles may still have a huge
solution. So ``Held`` refuses these cycles before it solves anything.

**Several links,** each with a period and a phase of its own. A packet of a sensor contains all its measurements so far.
So the error covariance of the estimate at a step depends only on the age of the last packet of each sensor: it is that
of the Kalman filter of all sensors at the oldest of these packets, continued with the measurements of the sensors whose
packets are newer. A packet to an actuator contains an input that the actuator holds, or the inputs of all steps until
the next packet. Both are states of a periodic linear quadratic problem. Since the information of the controller does
not depend on its inputs, the optimal gains are those of a known state, and the error of the estimate adds tr(L'HL P).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from math import lcm
from typing import NamedTuple

import numpy as np

from taciturn import _arrays
from taciturn._arrays import Array, ArrayLike, is_definite, symmetrised
from taciturn._display import Displayed
from taciturn._progress import check_time
from taciturn._text import number_of
from taciturn.errors import ProblemError, TaciturnError, UnstableError
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.enclosures import Doubles, E, UnprovedError, block
from taciturn.lqg.equation import Equation
from taciturn.lqg.followed import CANCELS, followed
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.quadratic import Quadratic, Span, price
from taciturn.lqg.queries import Predictor
from taciturn.lqg.riccati import costs_nothing, regulate_for
from taciturn.lqg.sampling import Interval, Sampled, Step, sampled
from taciturn.model.network import Network

_CRUMB = 1e-12  # change of a cost-to-go, relative to the products in its sum, that is rounding
_SETTLED = 1e-11  # relative change of the cost-to-go over a cycle at which it is stationary
_LARGEST = 1e12  # growth of the cost-to-go at which a cycle counts as unstable
_MOST_STEPS = 20_000  # steps of the backward iteration


def lift(
    A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike, W: ArrayLike, every: int, factor: float = 1.0
) -> Sampled:
    """Return the lifted LQ problem: one of its steps consists of ``every`` steps of the given problem, with a held
    input.
    """
    # W_k = Σ_{j<k} A^jWA'^j, and noise_cost = Σ_{j<k} tr(QW_j), the cost of the noise since the input was set
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
            f"every = {every}, and within that many steps the state overflows; expected a smaller value: hold the "
            "input for fewer steps"
        ) from None


@dataclass(frozen=True, eq=False, repr=False)
class Pattern(Displayed):
    """A repeating pattern of intervals between sends, with its optimal gains, costs-to-go and average cost."""

    intervals: tuple[int, ...]  # steps from one send to the next, over one period
    gains: Array  # u = L x̂ at each send, held until the next, (sends, m, n)
    values: Array  # cost-to-go x̂'Kx̂ at each send, (sends, n, n)
    cost: float  # average cost per step of the input and of the corrections of the estimate


class Held:
    """Optimal control of a plant whose input is held from one send to the next, for given intervals between sends."""

    # The estimate is filtered at every step and obeys x̂⁺ = Ax̂ + Bu + (corrections). The corrections are white and
    # independent of the estimation error. So the average cost per step is tr(QΣ) plus that of ``solve``.

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
        """Cost-to-go with a send at every step; None if no input stabilises the plant."""
        # As the weight of the final state of a screened cycle, it does not count where a disturbance or a set-point
        # keeps the state away from zero: another weight would be paid for ever, and most by cycles of many sends.
        try:
            return _at_the_start([self.lifted(1)])
        except TaciturnError:
            return None

    @cached_property
    def _follows(self) -> bool:
        """Whether an input that is held follows the disturbances and set-points that last: whether Ud stays."""
        own = Quadratic.checked(*self._tick[:5])
        change = followed(own)
        if change is None:
            return True
        U, S = change.inputs, change.problem.A
        moved = U @ S - U
        moved[np.abs(moved) <= CANCELS * (np.abs(U) @ np.abs(S) + np.abs(U))] = 0.0
        return not change.wanders(moved, np.eye(len(S)))

    def lifted(self, ticks: int) -> Sampled:
        """Return the LQ problem lifted over ``ticks`` steps. Between sends, the input is held or decays by a factor."""
        if ticks not in self._known:
            self._known[ticks] = lift(*self._tick, ticks, self._factor)
        return self._known[ticks]

    def screen(self, listed: Sequence[tuple[int, ...]]) -> Array:
        """Compute approximate costs of many cycles with equally many intervals; infinite if no cost was found."""
        # by doubling without an error check: enough to show which cycles are worth solving
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
            K = reduce(Span.then, stages).for_ever(last, _CRUMB * sum(map(np.diag, sums))) - last
            # backwards: the noise of an interval costs what the state at its end, the next send, costs from there on
            for k in reversed(many):
                noise = noise + ((last + K) * np.array([part.W for part in parts])[chosen[:, k]]).sum(axis=(1, 2))
                K = stages[k].before(K)
        cost = noise / np.array(listed).sum(axis=1)
        if not self._follows:
            cost[np.array(listed).max(axis=1) > 1] = np.inf
        return np.where(np.isfinite(cost) & (cost > 0), cost, np.inf)

    def solve(self, intervals: Sequence[int]) -> Pattern:
        """Compute optimal gains and average cost for a cycle of intervals, in each of which the input is held."""
        if max(intervals) > 1 and not self._follows:
            raise UnstableError(
                "a lasting disturbance or set-point requires an input that changes between sends, but the input is "
                "held, so the cost grows without limit and has no average; expected a packet at every step, or a "
                "constant disturbance"
            )
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
        raise UnstableError(f"the cost of periodic control cannot be computed: {error}") from None
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
    """Compute cost-to-go and gain at the start of an interval with a held input, from the cost-to-go at its end."""
    H, inverse = price(stretch.B, K, stretch.R)
    if not (is_definite(stretch.R) or is_definite(H)):
        raise costs_nothing(H)
    L = -inverse @ (stretch.B.T @ K @ stretch.A + stretch.N.T)
    return symmetrised(stretch.Q + stretch.A.T @ K @ stretch.A - L.T @ H @ L), L


def necklaces(length: int, sends: int) -> Iterator[tuple[int, ...]]:
    """Yield every cycle of ``sends`` intervals of the total length ``length``. Rotations of a cycle count as equal."""
    return _extended((), length, sends, range(1, length + 1))


def cycles(intervals: Sequence[int], most: int) -> Iterator[tuple[int, ...]]:
    """Yield every cycle of at most ``most`` intervals, without rotations and repetitions of shorter cycles."""
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


class Timing(NamedTuple):
    """The steps at which a link sends periodically: ``phase``, ``phase + period``, …"""

    period: int  # steps from one packet to the next
    phase: int = 0  # first step, less than the period

    def age(self, step: int) -> int:
        """Return the number of steps since the link last sent."""
        return (step - self.phase) % self.period


@dataclass(frozen=True, eq=False, repr=False)
class MultirateControl(Displayed):
    """Computes the least cost of control over several links, each of which sends at fixed steps."""

    problem: Discrete  # the discrete-time problem, with an average cost
    network: Network  # the nodes and links, which deliver every packet; a node without a link sends in every step
    plans: bool  # whether a packet to an actuator contains the inputs until the next packet, or one input that is held

    def cost(self, timings: Mapping[str, Timing]) -> float:
        """Compute the least cost, in the units of the problem, if the links send at the given steps."""
        inputs = tuple(timings[link] for link in self._linked)
        sensors = tuple(timings[link] for link in self._heard)
        if inputs not in self._known:
            self._known[inputs] = self._regulated(inputs)
        values, squares = self._known[inputs]
        total = sum(float(np.sum(value * self.problem.plant.W)) for value in values) / len(values)
        steps = lcm(len(squares), *(one.period for one in sensors))
        errors = [self._error(tuple(one.age(step) for one in sensors)) for step in range(steps)]
        total += sum(float(np.sum(squares[k % len(squares)] * error)) for k, error in enumerate(errors)) / steps
        return self.problem.per_unit(total)

    @cached_property
    def _known(self) -> dict[tuple[Timing, ...], tuple[list[Array], list[Array]]]:
        return {}

    @cached_property
    def _covariances(self) -> dict[tuple[int, ...], Array]:
        return {}

    @cached_property
    def _measured(self) -> Mapping[str, list[int]]:
        """The outputs that each node measures."""
        plant = self.problem.plant
        measured = self.network.measurements(plant.sensed, plant.set_points)
        return {node: [*held] for node, held in measured.values()}

    @cached_property
    def _applied(self) -> Mapping[str, list[int]]:
        """The inputs that each node applies."""
        return {node: [*held] for node, held in self.network.applications(self.problem.plant.inputs).values()}

    @cached_property
    def _heard(self) -> list[str]:
        return [node for node in self._measured if node in self.network.links]

    @cached_property
    def _linked(self) -> list[str]:
        return [node for node in self._applied if node in self.network.links]

    def _error(self, ages: tuple[int, ...]) -> Array:
        """Return the error covariance of the estimate, given the age of the last packet of each sensor."""
        if ages not in self._covariances:
            plant, oldest = self.problem.plant, max(ages, default=0)
            known = dict(zip(self._heard, ages, strict=True))
            found = steady_filter(plant.A, plant.C, plant.W, plant.V).posterior
            for step in range(1, oldest + 1):
                found = plant.A @ found @ plant.A.T + plant.W
                newer = [node for node in self._measured if known.get(node, 0) <= oldest - step]
                seen = [i for node in newer for i in self._measured[node]]
                if seen:
                    found = symmetrised(found - Predictor(plant, seen).correction(found) @ plant.C[seen] @ found)
            self._covariances[ages] = found
        return self._covariances[ages]

    def _regulated(self, timings: tuple[Timing, ...]) -> tuple[list[Array], list[Array]]:
        """Return, for each step of a cycle, the cost-to-go of the state after it, and L'HL of the step."""
        cycle, n = lcm(1, *(one.period for one in timings)), self.problem.plant.states
        steps = [self._step(timings, step) for step in range(cycle)]
        K, size = np.zeros(steps[0].A.shape), 1.0
        values, squares = [K] * cycle, [K] * cycle
        for _ in range(max(2, _MOST_STEPS // cycle)):
            check_time()
            before = K
            for step in reversed(range(cycle)):
                values[step] = K[:n, :n]
                K, saved = steps[step].back(K)
                squares[step] = saved[:n, :n]
            size = float(np.abs(K).max())
            if not np.isfinite(size) or size > _LARGEST * max(1.0, float(np.abs(self.problem.Q).max())):
                break
            if float(np.abs(K - before).max()) <= _SETTLED * size:
                return values, squares
        named = ", ".join(
            f"{link} every {number_of(one.period, 'step')}" for link, one in zip(self._linked, timings, strict=True)
        )
        raise UnstableError(
            f"periodic packets on the links ({named}) do not stabilise the plant; expected shorter periods"
        )

    def _step(self, timings: tuple[Timing, ...], step: int) -> Quadratic:
        """Return the transition, inputs and weights of a step, over the state x and the inputs of later steps."""
        plant, A, B = self.problem.plant, self.problem.plant.A, self.problem.plant.B
        n, m = plant.states, plant.inputs
        kept = [one.period - 1 if self.plans else min(one.period - 1, 1) for one in timings]
        sizes = [len(self._applied[node]) * count for node, count in zip(self._linked, kept, strict=True)]
        states, at = n + sum(sizes), n
        from_state = np.zeros((m, states))
        columns = [(np.zeros((m, 0)), np.zeros((states, 0)))]  # of u, and of the kept inputs
        F = np.zeros((states, states))
        for node in (node for node in self._applied if node not in self._linked):
            columns.append((np.eye(m)[:, self._applied[node]], np.zeros((states, len(self._applied[node])))))
        for node, timing, size in zip(self._linked, timings, sizes, strict=True):
            held, width = np.eye(m)[:, self._applied[node]], len(self._applied[node])
            place = slice(at, at + size)
            if timing.age(step) == 0:
                count = 1 + size // width if self.plans else 1
                chosen = np.zeros((m, count * width))
                chosen[:, :width] = held
                later = np.zeros((states, count * width))
                later[place] = np.eye(size, count * width, k=width) if self.plans else np.eye(size, width)
                columns.append((chosen, later))
            else:
                from_state[:, at : at + width] = held
                F[place, place] = np.eye(size, k=width) if self.plans else np.eye(size)
            at += size
        given, G = (np.hstack(part) for part in zip(*columns, strict=True))
        F[:n, :n] = A
        F[:n] += B @ from_state
        G[:n] += B @ given
        M = np.block([[self.problem.Q, self.problem.N], [self.problem.N.T, self.problem.R]])
        whole = np.block([
            [np.eye(n, states), np.zeros((n, given.shape[1]))],
            [from_state, given],
        ])  # fmt: skip
        M = symmetrised(whole.T @ M @ whole)
        x, v = slice(states), slice(states, None)
        return Quadratic(F, G, M[x, x], M[v, v], M[x, v])
