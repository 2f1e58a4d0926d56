"""Estimate the mean interval between sends and the mean cost per second by simulating many such intervals.

The mean cost per second is E[∫_0^θ e'Se ds]/E[θ] for intervals θ between sends. When enough cycles are counted, every
path is run until its current cycle has ended. The number of counted cycles is then a stopping time. By Wald's identity,
durations and costs have no bias from a last cycle that is cut short. The standard error of the ratio comes from the
spread over independent paths.

The times of the sends of a ``JumpProcess`` are exact (``events``). A ``SampledProcess`` is checked every τ seconds,
with jumps or Wiener noise. Its cost in an interval is the conditional expectation given the errors at the checks:
e'Γ(τ)e for a period that begins with the error e, plus the mean cost of the noise of a period. So E[cost]/E[θ] equals
the value of the loop exactly. At each check the expected cost of the next period is available, and the state is sent
before the cost exceeds the allowed value: at the first time t with cost + e'Γe + noise > c min(t + τ, ε), never before
h_min, and no later than the last check before h_max.

Source: khashooei2017
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from taciturn.errors import ProblemError, UnstableError
from taciturn.extend import Array, Displayed, array, count, factor, instance, number
from taciturn.model.estimate import Estimate
from taciturn.model.plant import JumpNoise
from taciturn.program.draws import GENERATOR, NORMAL, seed_generators, with_draws
from taciturn.program.engine import prepare
from taciturn.program.ir import Builder, Program
from taciturn.program.ops import State
from taciturn.program.signals import add_jumps
from taciturn.program.translation import TimeStep
from taciturn_events.events import (
    CLOSING,
    COST,
    CYCLES,
    DURATION,
    ENDED,
    ERROR,
    INTEGRAL,
    OPEN,
    TIME,
    UNDISTURBED,
    CycleTrigger,
    IntegralTrigger,
    JumpProcess,
    check,
    count_cycle,
    cycle_program,
    filled_states,
    start_cycles,
)

PERIOD_TOLERANCE = 1 + 1e-12  # tolerance for limits that are a whole number of periods


@dataclass(frozen=True, eq=False, repr=False)
class SampledProcess(Displayed):
    """Error e⁺ = F e + w from one periodic check of the trigger to the next, with its cost per period.

    Args:
        F: map of the error from one check to the next, (n, n).
        noise: covariance of w, (n, n), or jumps.
        Gamma: Γ(τ), weight of the cost of a period, (n, n).
        running: mean cost of the noise of one period, τ g(τ).
        period: τ, seconds between checks.
    """

    F: Array
    noise: Array | JumpNoise
    Gamma: Array
    running: float
    period: float


def sampled_program(process: SampledProcess, trigger: IntegralTrigger) -> Program:
    """Return the program that simulates an error over one period and checks the trigger at the end of the period.

    The sums and outputs of the program are those of ``cycle_program``.
    """
    n = len(process.F)
    tick = TimeStep(Builder(), {}, {}, ())
    b = tick.builder
    zero, period = b.constant(0.0), b.constant(process.period)
    state = {name: b.state(State(name, 0, start=(name, 0))) for name in (INTEGRAL, TIME, OPEN, CLOSING)}
    error = [b.state(State(ERROR, i, start=(ERROR, i))) for i in range(n)]

    def ahead(e: list[int]) -> int:
        square = b.quadratic([[float(entry) for entry in row] for row in process.Gamma], e)
        return tick.builder.value(b.add(square, b.constant(process.running)))

    moved = [tick.builder.value(b.combine([float(entry) for entry in row], error)) for row in process.F]
    moved = [b.emit("add", x, w) for x, w in zip(moved, _noise(tick, process.noise), strict=True)]
    spent, time = b.emit("add", state[INTEGRAL], ahead(error)), b.emit("add", state[TIME], period)
    # the threshold c min(t + τ, ε) is that of the end of the next period, whose expected cost is ``ahead``
    after = b.emit("add", time, period)
    allowed = after
    if np.isfinite(trigger.saturation):
        flat = b.constant(trigger.saturation)
        allowed = b.emit("select", b.emit("greater", after, flat), flat, after)
    allowed = b.emit("mul", b.constant(trigger.c), allowed)
    ended = b.emit("greater", b.emit("add", spent, ahead(moved)), allowed)
    if trigger.h_min > 0:
        ended = b.emit(
            "and", ended, b.emit("not", b.emit("greater", b.constant(trigger.h_min / PERIOD_TOLERANCE), time))
        )
    if np.isfinite(trigger.h_max):
        late = b.emit("greater", after, b.constant(trigger.h_max * PERIOD_TOLERANCE))
        ended = b.emit("not", b.emit("and", b.emit("not", ended), b.emit("not", late)))
    opened, sums, outputs = count_cycle(b, ended, time, spent, state[OPEN], state[CLOSING])
    following = [
        *(b.emit("select", ended, zero, value) for value in (spent, time)),
        opened,
        state[CLOSING],
        *(b.emit("select", ended, zero, value) for value in moved),
    ]
    return with_draws(b.finish(following, sums, outputs))


def _noise(tick: TimeStep, noise: Array | JumpNoise) -> list[int]:
    if isinstance(noise, JumpNoise):
        return add_jumps(tick, noise)
    spread = factor(noise)
    drawn = tick.supplied(NORMAL, spread.shape[1])
    return [tick.builder.value(tick.builder.combine([float(g) for g in row], drawn)) for row in spread]


PATHS = 4096
FEWEST_PATHS, CYCLES_PER_PATH = 64, 16  # few cycles are spread over fewer paths
DEFAULT_CYCLES = 1_000_000
FIRST_TICKS = 64
CHUNK = 1 << 25  # attempts between two evaluations of the results, and between two calls of ``alive``
BUDGET = 10_000_000_000  # attempts of all paths together
ENDLESS = 100_000  # attempts within which a cycle must end
RECORD = 1 << 22  # attempts recorded at once
RECORDED_PER_CYCLE = 8
ErrorProcess: TypeAlias = JumpProcess | SampledProcess


@dataclass(frozen=True, repr=False)
class CycleEstimate(Displayed):
    """Estimated mean interval between sends and estimated cost per second, from many simulated intervals.

    Args:
        interval: mean seconds between sends, E[θ].
        cost: mean of e'Se, E[∫_0^θ e'Se ds]/E[θ].
        cycles: number of counted cycles.
        ticks: number of attempts at pieces, on all paths together.
        undisturbed: number of cycles that ended before h_max without a jump since the last send; it is 0 if the second
            property of consistency holds, and None for a process that is checked every period.
    """

    interval: Estimate
    cost: Estimate
    cycles: int
    ticks: int
    undisturbed: int | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Sample(Displayed):
    """Durations and costs of simulated intervals between sends; every simulated path contributes equally many."""

    durations: Array  # θ, (cycles,)
    costs: Array  # ∫_0^θ e'Se ds, (cycles,)


def estimate_cycles(
    process: ErrorProcess,
    trigger: CycleTrigger,
    *,
    cycles: int | None = None,
    standard_error: float | None = None,
    seed: int = 0,
    paths: int = PATHS,
    threads: int | None = None,
    alive: Callable[[], None] | None = None,
) -> CycleEstimate:
    """Simulate an error with a trigger, and estimate the mean interval between sends and the cost per second.

    Args:
        process: the error.
        trigger: when the error is sent.
        cycles: least number of cycles to count; if neither this nor a standard error is given: a million.
        standard_error: absolute standard error of the mean interval to reach, instead of a number of cycles.
        seed: seed of the random numbers; seed, number of paths and number of cycles determine the result.
        paths: largest number of independent paths.
        threads: number of threads; omitted: all processors. The result does not depend on it.
        alive: called regularly; it may raise ``OutOfTime``.

    Returns:
        Both numbers, with standard errors from the spread over independent paths.

    Raises:
        ProblemError: an argument is out of range, or the requested standard error exceeds the budget of attempts.
        UnstableError: a cycle does not end.

    Source: khashooei2017
    """
    count("seed", seed, 0)
    count("paths", paths, 2)
    if threads is not None:
        count("threads", threads)
    if cycles is not None and standard_error is not None:
        raise ProblemError("cycles and standard_error are both given; expected one of them")
    if standard_error is not None:
        number("standard_error", standard_error, 0.0)
        counting = _Counting(process, trigger, paths, seed, threads)
        while (missing := counting.until_precise(standard_error)) > 0:
            counting.advance(missing)
        return counting.close()
    wanted = DEFAULT_CYCLES if cycles is None else count("cycles", cycles)
    counting = _Counting(process, trigger, min(paths, max(FEWEST_PATHS, wanted // CYCLES_PER_PATH)), seed, threads)
    while (missing := counting.until_counted(wanted)) > 0:
        counting.advance(min(missing, max(FIRST_TICKS, CHUNK // counting.paths)))
        if alive is not None:
            alive()
    return counting.close()


def sweep_thresholds(
    process: ErrorProcess,
    cs: Sequence[float],
    *,
    trigger: IntegralTrigger | None = None,
    cycles: int = DEFAULT_CYCLES,
    seed: int = 0,
    paths: int = PATHS,
    threads: int | None = None,
) -> tuple[CycleEstimate, ...]:
    """Estimate the integral trigger's mean interval M(c) = E[θ] between sends for many thresholds c.

    The jumps and their times are the same for every c.

    For c = αC the interval depends on c alone: α = M(c) is the fixed point for C = c/M(c).

    Args:
        process: the error.
        cs: values of c.
        trigger: the trigger, whose c is replaced; omitted: no saturation and no limits of the interval.
        cycles: least number of cycles for each c.
        seed: seed of the random numbers.
        paths: largest number of independent paths.
        threads: number of threads; omitted: all processors.

    Returns:
        One estimate for each c.

    Raises:
        ProblemError: as ``estimate_cycles``.
        UnstableError: as ``estimate_cycles``.

    Source: khashooei2017
    """
    values = array("cs", cs, (None,), "(values,)")
    triggers = [IntegralTrigger(float(c)) if trigger is None else replace(trigger, c=float(c)) for c in values]
    return tuple(estimate_cycles(process, t, cycles=cycles, seed=seed, paths=paths, threads=threads) for t in triggers)


def sample_cycles(
    process: JumpProcess,
    trigger: CycleTrigger,
    *,
    cycles: int,
    seed: int = 0,
    paths: int = PATHS,
    threads: int | None = None,
) -> Sample:
    """Simulate intervals between sends, and return the duration and the cost of each, for quantiles and histograms."""
    count("seed", seed, 0)
    paths = min(count("paths", paths), count("cycles", cycles))
    each = -(-cycles // paths)
    program = _written(process, trigger).keep(outputs={ENDED, DURATION, COST})
    run, states = prepare(program), _start(process, program, paths, seed)
    found, seen, ticks = np.zeros((2, paths, each)), np.zeros(paths, dtype=np.int64), 0
    while seen.min() < each:
        chunk = max(1, min(RECORD // paths, FIRST_TICKS + RECORDED_PER_CYCLE * int(each - seen.min())))
        ticks += chunk
        if ticks > ENDLESS * each:
            raise _endless(ticks)
        result = run(states, chunk, threads)
        states, ended = result.states, result.outputs[ENDED] > 0
        place = seen + np.cumsum(ended, axis=0) - 1
        tick, path = np.nonzero(ended & (place < each))
        for row, name in zip(found, (DURATION, COST), strict=True):
            row[path, place[tick, path]] = result.outputs[name][tick, path]
        seen += ended.sum(axis=0)
    return Sample(found[0].ravel(), found[1].ravel())


class _Counting:
    """Running paths, and their sums so far."""

    def __init__(
        self, process: ErrorProcess, trigger: CycleTrigger, paths: int, seed: int, threads: int | None
    ) -> None:
        kept = {CYCLES, DURATION, COST, UNDISTURBED}
        self.program = _written(process, trigger).keep(kept, states={OPEN, CLOSING})
        self.run, self.threads = prepare(self.program), threads
        self.states = _start(process, self.program, paths, seed)
        self.sums = {name: np.zeros(paths) for name in self.program.sums}
        self.paths, self.ticks = paths, 0

    def advance(self, ticks: int) -> None:
        """Simulate ``ticks`` further steps on every path; if there are many paths, simulate fewer steps."""
        ticks = max(1, min(ticks, CHUNK // self.paths))
        result = self.run(self.states, ticks, self.threads)
        self.states = result.states
        for name, total in self.sums.items():
            total += result.sums[name]
        self.ticks += ticks

    def until_counted(self, cycles: int) -> int:
        """Predict how many further steps must be simulated until ``cycles`` intervals between sends are counted."""
        counted = float(self.sums[CYCLES].sum())
        if counted >= cycles:
            return 0
        return self._more(cycles / counted if counted else 2.0)

    def until_precise(self, wanted: float) -> int:
        """Predict how many further steps must be simulated until the mean interval has the wanted standard error."""
        if self.sums[CYCLES].min() < CYCLES_PER_PATH:  # the standard error of fewer cycles is unreliable
            return self._more(2.0)
        error = _ratio(self.sums[DURATION], self.sums[CYCLES]).standard_error
        return 0 if error <= wanted else self._more((error / wanted) ** 2)

    def _more(self, factor: float) -> int:
        if not self.sums[CYCLES].any() and self.ticks > ENDLESS:
            raise _endless(self.ticks)
        if self.ticks * self.paths > BUDGET:
            raise ProblemError(
                f"{BUDGET} simulated attempts completed only {self.sums[CYCLES].sum():.0f} cycles; expected a request "
                "for fewer cycles, or a larger standard error"
            )
        return max(FIRST_TICKS, int(self.ticks * min(factor - 1, 100.0) * 1.02) + 1)

    def close(self) -> CycleEstimate:
        """Simulate every path until its next send, and return the estimates from all intervals between sends."""
        opened, closing = [[s.name for s in self.program.states].index(name) for name in (OPEN, CLOSING)]
        self.states[closing] = 1.0
        last = self.ticks + ENDLESS
        while self.states[opened].any():
            if self.ticks > last:
                raise _endless(ENDLESS)
            self.advance(FIRST_TICKS)
        if not all(np.isfinite(total).all() for total in self.sums.values()):
            raise UnstableError(
                "the error grows without bound within a cycle; expected a trigger that gives weight to every growing "
                "direction of the error"
            )
        return CycleEstimate(
            _ratio(self.sums[DURATION], self.sums[CYCLES]),
            _ratio(self.sums[COST], self.sums[DURATION]),
            int(self.sums[CYCLES].sum()),
            self.ticks * self.paths,
            int(self.sums[UNDISTURBED].sum()) if UNDISTURBED in self.sums else None,
        )


def _written(process: ErrorProcess, trigger: CycleTrigger) -> Program:
    """Return the program of a process, after a check of the arguments."""
    if isinstance(process, SampledProcess):
        instance("trigger", trigger, IntegralTrigger)
        assert isinstance(trigger, IntegralTrigger)
        return sampled_program(process, trigger)
    check(process, trigger)
    return cycle_program(process, trigger)


def _start(process: ErrorProcess, program: Program, paths: int, seed: int) -> Array:
    """Return the initial program states of simulated paths, just after a send."""
    if isinstance(process, SampledProcess):
        return filled_states(program, paths, {GENERATOR: seed_generators(seed, paths), OPEN: np.ones((1, paths))})
    return start_cycles(process, program, paths, seed)


def _ratio(above: Array, below: Array) -> Estimate:
    """Return E[above]/E[below] over independent paths, with the standard error of the delta method."""
    value = float(above.sum() / below.sum())
    rest = above - value * below
    error = float(np.sqrt((rest**2).sum() * len(rest) / (len(rest) - 1)) / below.sum())
    return Estimate(value, error, "simulation")


def _endless(ticks: int) -> UnstableError:
    return UnstableError(
        f"a cycle has not ended after {ticks} pieces of time: the trigger may never fire; expected an error that grows "
        "until the trigger fires, a finite h_max, or, for a process that is checked every period, a longer period"
    )
