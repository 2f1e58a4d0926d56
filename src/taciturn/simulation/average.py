"""Cost and rates by simulation, with standard errors: independent paths, a burn-in, as many ticks as needed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, count, number
from taciturn.errors import ProblemError, UnstableError
from taciturn.loop import COST, EXCESS, SENT, Loop
from taciturn.model.estimate import Estimate
from taciturn.program.engine import prepare
from taciturn.program.ir import Program

PATHS = 4096
RELATIVE_ERROR = 1e-4  # of the cost, where no standard error is asked
FEWEST_PATHS = 64  # where a slow loop makes every path long
FEWEST_MISSIONS = 8
BURN_IN = 512  # ticks, at least
SETTLE = 12  # time constants of the loop that are dropped: e^-12 is left of the start
KEEP = 8  # time constants, and mean intervals between sends, that are dropped and that are kept at least
SILENT = 1e-3  # share of the paths that need not have sent in what is dropped
BUDGET = 4_000_000_000  # steps of all paths together
LEAST_STEPS = 1024
DETERMINISTIC = 1e-9  # relative spread of the paths below which they are one path
RUNAWAY = 1e12  # times the cost of the median path
HUGE = 1e150  # its square is still a number
CHUNK = 1 << 26  # steps between two reports of progress
DRIFT = 3.5  # standard errors by which the latest window may differ from those before it
Progress = Callable[[float], None]


@dataclass(frozen=True)
class Averages:
    """What a simulation found.

    Args:
        cost: per unit of time, or the total of a finite horizon.
        rates: sends per tick (finite horizon: mean fraction of the steps; discount: (1−α)Σα^k of them), by link.
        steps: simulated steps of all paths together, burn-in included.
        burn_in: ticks dropped at the start of each path.
        reached: whether the asked standard error was met.
    """

    cost: Estimate
    rates: Mapping[str, Estimate]
    steps: int
    burn_in: int
    reached: bool


@dataclass(frozen=True, eq=False)
class Estimator:
    """Which program is run, and how the mean of a sum gives the cost: offset + scale·mean.

    Args:
        program: one tick of the loop.
        sum: name of the sum.
        offset: what is added, in the units of the cost.
        scale: factor of the mean per tick.
    """

    program: Program
    sum: str
    offset: float
    scale: float


def completed_squares(loop: Loop) -> Estimator:
    """Return the estimator J = J_all + E[completed square], in the innovations form where that holds.

    Raises:
        ProblemError: the policy has no identity, or the plant is not the one of its design.

    Source: khashooei2017
    """
    identity = loop.identity
    if identity is None:
        raise ProblemError(
            "completion of squares holds for the plant and network of the design and a policy that has an identity; "
            "expected those, or use the plain average"
        )
    program = loop.reduced_program() if loop.reducible else loop.program()
    return Estimator(program.keep({EXCESS, *_rates(loop)}), EXCESS, identity.constant, 1.0)


def plain_average(loop: Loop) -> Estimator:
    """Return the estimator that averages the stage cost of the loop with its plant."""
    final = {"x"} if loop.problem.cost.terminal is not None else frozenset[str]()
    problem, program = loop.problem, loop.program().keep({COST, *_rates(loop)}, states=final)
    if loop.horizon is None:
        return Estimator(program, COST, problem.noise_cost / problem.tick, 1.0 / problem.tick)
    alpha = problem.cost.discount
    ticks = loop.horizon if alpha == 1 else (1 - alpha**loop.horizon) / (1 - alpha)
    return Estimator(program, COST, problem.noise_cost * ticks, 1.0)


def choose_estimator(loop: Loop) -> Estimator:
    """Return completion of squares where the theory allows it, else the plain average."""
    return plain_average(loop) if loop.identity is None else completed_squares(loop)


def average(
    loop: Loop,
    estimator: Estimator | None = None,
    *,
    seed: int = 0,
    standard_error: float | None = None,
    steps: int | None = None,
    progress: Progress | None = None,
    threads: int | None = None,
) -> Averages:
    """Estimate the stationary cost and rates, or those of a finite horizon.

    Every path is independent, so the standard error is that of the mean over paths, whatever the correlation in time.
    Ticks are dropped until the loop has forgotten its start: twelve time constants of its slowest mode, eight mean
    intervals between sends, a send on nearly every path, and whatever precedes a window that differs from the latest.

    Args:
        loop: the closed loop.
        estimator: omitted: the best that holds.
        seed: of the draws; the result depends on nothing else.
        standard_error: absolute, of the cost; omitted: 1e-4 of the cost.
        steps: run this many steps of all paths together instead.
        progress: called with the fraction done.
        threads: at least 1; omitted: all processors.

    Returns:
        Cost and rates; ``reached`` is False where the budget ended first: before the asked standard error, or before
        the loop had time to settle.

    Raises:
        ProblemError: a budget, precision or number of threads that is not positive.
        UnstableError: the loop diverges.
    """
    estimator = estimator or choose_estimator(loop)
    check_effort(seed, standard_error, steps)
    if threads is not None:
        count("threads", threads)
    sampling = _Sampling(loop, estimator, seed, progress, threads)

    def target(cost: Estimate) -> float:
        return RELATIVE_ERROR * abs(cost.value) if standard_error is None else standard_error

    if loop.horizon is not None:
        return sampling.missions(loop.horizon, target, steps)
    return sampling.stationary(target, steps)


def check_effort(seed: int, standard_error: float | None, steps: int | None) -> None:
    """Refuse a seed, a precision or a budget that means nothing.

    Raises:
        ProblemError: seed below 0, precision not positive, too few steps, or both precision and steps.
    """
    count("seed", seed, 0)
    if standard_error is not None and steps is not None:
        raise ProblemError("standard_error and steps are both given; expected one of them")
    if standard_error is not None:
        number("standard_error", standard_error, 0.0)
    if steps is not None:
        count("steps", steps, LEAST_STEPS)


class _Sampling:
    def __init__(
        self, loop: Loop, estimator: Estimator, seed: int, progress: Progress | None, threads: int | None
    ) -> None:
        self.loop, self.estimator, self.seed, self.threads = loop, estimator, seed, threads
        self.progress = progress
        self.names = [estimator.sum, *_rates(loop)]
        self.run = prepare(estimator.program)
        self.steps = 0

    def stationary(self, target: Callable[[Estimate], float], steps: int | None) -> Averages:
        budget = steps or BUDGET
        least = max(BURN_IN, int(SETTLE * self.loop.policy.settling))
        paths = min(PATHS, max(8, budget // (2 * least) // 8 * 8))
        state = self.loop.start(self.estimator.program, paths, self.seed)
        state, dropped, forgotten = self._burn_in(state, min(least, budget // paths // 2), budget)
        kept: list[tuple[int, Array]] = []  # ticks and sums per path, of each window
        window = min(dropped, (budget - self.steps) // state.shape[1] // 2)  # two windows, to compare them
        while True:
            left = (budget - self.steps) // state.shape[1]
            if left < 1.5 * window:  # no crumb is left over, whose mean would be compared with all before it
                window = left
            window = self._whole(max(1, window))
            sums, state = self._advance(state, window)
            self._refuse_runaways(sums[0], window)
            kept.append((window, sums))
            if len(kept) > 1 and not self._settled(kept):
                dropped += sum(length for length, _ in kept[:-1])
                kept = kept[-1:]
            cost, rates = self._summary(kept)
            measured, pace = sum(length for length, _ in kept), self._pace([rate.value for rate in rates.values()])
            long_enough = forgotten and measured >= pace and len(kept) > 1
            if steps is None and long_enough and cost.standard_error <= target(cost):
                return Averages(cost, rates, self.steps, dropped, True)
            if left <= window:
                return Averages(cost, rates, self.steps, dropped, steps is not None and long_enough)
            self._report(cost, None if steps else target(cost), self.steps / budget)
            missing = left if steps else _missing(measured, cost.standard_error, target(cost))
            window = min(max(measured, int(pace)), max(missing, int(pace) - measured, BURN_IN // 4))

    def _whole(self, ticks: int) -> int:
        """Return ticks as whole turns of the policy's clocks: all paths are at the same place of a schedule."""
        cycle = self.loop.policy.cycle
        return -(-ticks // cycle) * cycle

    def _burn_in(self, state: Array, length: int, budget: int) -> tuple[Array, int, bool]:
        """Run until the start is forgotten: return the state, the ticks that took, and whether it was reached.

        Forgotten means: a few time constants, a few mean intervals between sends, and a late send on nearly every path.
        Where that takes long, fewer paths go on; half of the budget is left for what is kept.
        """
        least, dropped = length, length // 2
        _, state = self._advance(state, dropped)  # what the start itself makes a path send says nothing
        length -= dropped
        while True:
            sums, state = self._advance(state, length)
            dropped += length
            pace = self._pace(list(sums[1:].mean(axis=1) / length))
            silent = max((float((row == 0).mean()) for row in sums[1:] if row.any()), default=0.0)
            if dropped >= max(least, pace) and silent <= SILENT:
                return state, dropped, True
            length = max(dropped, int(pace) - dropped + 1)
            paths = min(state.shape[1], (budget - self.steps) // 2 // length // 8 * 8)
            if paths < min(FEWEST_PATHS, state.shape[1]):
                return state, dropped, False
            state = state[:, :paths]

    def _pace(self, rates: Sequence[float]) -> float:
        """Return the ticks in which the loop forgets: some of its slowest mode, and some intervals between sends."""
        return KEEP * max([self.loop.policy.settling, *(1 / rate for rate in rates if rate > 0)])

    def missions(self, horizon: int, target: Callable[[Estimate], float], steps: int | None) -> Averages:
        budget = steps or BUDGET
        if FEWEST_MISSIONS * horizon > budget:
            raise ProblemError(
                f"a mission has {horizon} ticks, and {budget} steps are for fewer than {FEWEST_MISSIONS} of them; "
                "expected more steps, a shorter horizon, or a discount further from 1"
            )
        paths, discount = min(PATHS, budget // horizon), self.loop.problem.cost.discount
        share = 1 / horizon if discount == 1 else 1 - discount  # of a tick in a rate
        moments = [_Moments() for _ in self.names]
        program = self.estimator.program
        while True:
            state = self.loop.start(program, paths, self.seed, first=self.steps // horizon)
            sums, state = self._advance(state, horizon)
            if self.estimator.sum == COST:
                final = self.loop.final_cost(program, state)
                sums[0] += 0.0 if final is None else final
            for moment, row in zip(moments, sums, strict=True):
                moment.add(row)
            cost, *sent = [moment.mean() for moment in moments]
            cost = cost.scaled(self.estimator.scale, self.estimator.offset)
            rates = {name.split()[1]: rate.scaled(share) for name, rate in zip(self.names[1:], sent, strict=True)}
            reached = steps is None and cost.standard_error <= target(cost)
            if reached or self.steps + paths * horizon > budget:
                return Averages(cost, rates, self.steps, 0, reached or steps is not None)
            self._report(cost, None if steps else target(cost), self.steps / budget)

    def _advance(self, state: Array, ticks: int) -> tuple[Array, Array]:
        """Run ticks in chunks that let progress be seen and the run be interrupted."""
        sums = np.zeros((len(self.names), state.shape[1]))
        chunk = max(1, CHUNK // state.shape[1])
        while ticks > 0:
            now = min(ticks, chunk)
            result = self.run(state, now, self.threads)
            state = result.states
            sums += np.array([result.sums[name] for name in self.names])
            self.steps += now * state.shape[1]
            ticks -= now
            if not np.abs(sums).max() < HUGE:  # or not a number
                raise self._diverges(f"its cost passed {HUGE:g} within {self.steps} steps")
        return sums, state

    def _refuse_runaways(self, costs: Array, ticks: int) -> None:
        """Refuse paths that have left the others for good, as a clipped input leaves an unstable plant."""
        size = np.abs(costs)
        largest, typical = float(size.max()), float(np.median(size))
        all_time = self.loop.policy.cost_all_time * self.loop.policy.tick
        if self.estimator.sum == COST and typical > 0 and largest > max(RUNAWAY * typical, ticks * all_time):
            raise self._diverges(f"one path costs {largest / typical:.1g} times as much as another")

    def _settled(self, kept: list[tuple[int, Array]]) -> bool:
        """Compare the last window with what came before it, path by path."""
        before, (length, last) = kept[:-1], kept[-1]
        earlier = sum((sums for _, sums in before), np.zeros_like(last)) / sum(ticks for ticks, _ in before)
        change = last / length - earlier
        spread = change.std(axis=1, ddof=1) / np.sqrt(change.shape[1])
        if np.abs(last).max() > 1e6 * length * max(float(np.abs(earlier).max()), 1e-300):
            raise self._diverges("its cost grew a million times between two windows")
        counted = np.array([0.0, *[1.0] * (len(self.names) - 1)]) / length  # a window may end just before a send
        drift = DRIFT * spread + counted + 1e-12 * np.abs(earlier.mean(axis=1))
        return bool((np.abs(change.mean(axis=1)) <= drift).all())

    def _diverges(self, how: str) -> UnstableError:
        return UnstableError(
            f"the loop of {self.loop.policy.kind} diverges: {how}; expected a stable loop; send more often, "
            "or check [plant.actual] and input_limit"
        )

    def _summary(self, kept: list[tuple[int, Array]]) -> tuple[Estimate, dict[str, Estimate]]:
        ticks = sum(length for length, _ in kept)
        means = sum((sums for _, sums in kept), np.zeros_like(kept[0][1])) / ticks
        cost = mean(means[0])
        if cost.standard_error <= DETERMINISTIC * abs(cost.value):  # paths that agree tell nothing of a cycle cut short
            length, last = kept[-1]
            cost = Estimate(cost.value, abs(float(last[0].mean()) / length - cost.value), cost.method)
        cost = cost.scaled(self.estimator.scale, self.estimator.offset)
        seen = ticks * means.shape[1]
        rates = {name.split()[1]: _rate(row, seen) for name, row in zip(self.names[1:], means[1:], strict=True)}
        return cost, rates

    def _report(self, cost: Estimate, wanted: float | None, spent: float) -> None:
        precise = 0.0 if wanted is None or cost.standard_error == 0 else min(1.0, wanted / cost.standard_error) ** 2
        if self.progress is not None:
            self.progress(min(1.0, max(spent, precise)))


def _rates(loop: Loop) -> list[str]:
    return [f"{SENT} {link}" for link in loop.policy.scheduled]


class _Moments:
    """Mean and spread of values that come in batches, in constant memory."""

    def __init__(self) -> None:
        self.count, self.center, self.squares = 0, 0.0, 0.0

    def add(self, values: Array) -> None:
        """Merge a batch (Chan's formula)."""
        count, center = len(values), float(values.mean())
        total, shift = self.count + count, center - self.center
        self.squares += float(((values - center) ** 2).sum()) + shift**2 * self.count * count / total
        self.center += shift * count / total
        self.count = total

    def mean(self) -> Estimate:
        """Return the mean of all values with its standard error."""
        return Estimate(self.center, float(np.sqrt(self.squares / (self.count - 1) / self.count)), "simulation")


def _missing(measured: int, error: float, wanted: float) -> int:
    """Return how many more ticks bring a standard error down to what is wanted, with 5 % to spare."""
    if error <= wanted:
        return 0
    return measured * 1000 if wanted < 1e-3 * error else int(measured * ((error / wanted) ** 2 * 1.05 - 1)) + 1


def mean(values: Array) -> Estimate:
    """Return the mean over independent paths, with its standard error."""
    moments = _Moments()
    moments.add(values)
    return moments.mean()


def _rate(values: Array, seen: int) -> Estimate:
    """Return a mean rate; a send that never or always came in so many steps may still be as rare as one in them."""
    found = mean(values)
    return Estimate(found.value, max(found.standard_error, 1 / seen), found.method)
