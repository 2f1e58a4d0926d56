"""Paths of one loop, or of two with the same draws, on their way to a mean with its standard error."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import lcm

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array
from taciturn._progress import OutOfTime, Progress, Stages
from taciturn.errors import ProblemError
from taciturn.loop import COST, SENT
from taciturn.model.estimate import Estimate
from taciturn.program.controls import CONTROL
from taciturn.program.engine import prepare
from taciturn.program.ir import Program
from taciturn.simulation.doubts import comes_never_to_rest
from taciturn.simulation.lost import find_loss
from taciturn.simulation.parts import Part
from taciturn.simulation.statistics import Moments, controlled_mean, rate_of, tail_index

PATHS = 4096
RELATIVE_ERROR = 1e-4  # of the cost, where no standard error is asked
FEW_PATHS, SMALL = 512, 2000  # paths of a large loop; operations of a step, above which a loop is large
FEWEST_PATHS = 64  # where a slow loop makes every path long
FEWEST_MISSIONS = 8
BURN_IN = 512  # ticks, at least
SETTLE = 12  # time constants of the loop that are dropped: e^-12 is left of the start
KEEP = 8  # time constants, and mean intervals between sends, that are dropped and that are kept at least
SILENT = 1e-3  # share of the paths that need not have sent in what is dropped
BUDGET = 4_000_000_000  # steps of all paths together
DETERMINISTIC = 1e-9  # relative spread of the paths below which they are one path
HUGE = 1e150  # its square is still a number
CHUNK = 1 << 24  # steps between two reports of progress
ROUNDING = 1e-6  # relative, of what is simulated in single precision; measured: 7e-7 and less
ROOM = 8  # paths for each control variate
PAYS = 4  # times what was run so far must be left to run, for control variates to pay
DRIFT = 3.5  # standard errors by which the latest window may differ from those before it


@dataclass(frozen=True)
class Averages:
    """What a simulation found.

    Args:
        cost: per unit of time, or the total of a finite horizon.
        rates: sends per tick (finite horizon: mean fraction of the steps; discount: (1−α)Σα^k of them), by link.
        steps: simulated steps of all paths together, burn-in included.
        burn_in: ticks dropped at the start of each path.
        reached: whether the asked standard error was met.
        notes: what makes the numbers doubtful.
        settled: whether the loop had time to forget its start.
        estimator: what was averaged: "completed squares", "plain average" or "conditional sampling"; or "".
        tail: index of the power law by which the costs of the dearest paths fall off; infinite where there are too few.
    """

    cost: Estimate
    rates: Mapping[str, Estimate]
    steps: int
    burn_in: int
    reached: bool
    notes: tuple[str, ...] = ()
    estimator: str = ""
    settled: bool = True
    tail: float = np.inf


class Sampling:
    """Runs the parts side by side on the same draws, and adds up their means path by path.

    Args:
        parts: one loop, or two that are compared.
        seed: of the draws.
        progress: called with the fraction done.
        threads: omitted: all processors.
    """

    def __init__(self, parts: Sequence[Part], seed: int, progress: Progress | None, threads: int | None) -> None:
        """Compile."""
        self.parts, self.seed, self.threads, self.progress = parts, seed, threads, Stages(progress)
        self.offset = sum(part.sign * part.estimator.offset for part in parts)
        self.steps = 0
        self._read([part.estimator.program for part in parts], [part.names for part in parts])

    def _read(self, programs: Sequence[Program], names: Sequence[Sequence[str]]) -> None:
        """Run these programs from now on, and read these sums of theirs."""
        self.programs, self.runs, self.names = programs, [prepare(program) for program in programs], names
        sizes = [len(some) for some in names]
        self.rows = [slice(int(end) - size, int(end)) for end, size in zip(np.cumsum(sizes), sizes, strict=True)]
        kinds = [name.split()[0] for some in names for name in some]
        self.counted: npt.NDArray[np.bool_] = np.array([kind == SENT for kind in kinds])
        self.controls: npt.NDArray[np.bool_] = np.array([kind == CONTROL for kind in kinds])

    def _add_controls(self, paths: int) -> bool:
        """Add control variates to what is read, if there are some and enough paths to fit them; tell whether.

        Not to a difference: of two loops that differ on few paths, these are all that a fit would see.
        """
        part = self.parts[0]
        if len(self.parts) > 1 or self.controls.any():
            return False
        program, many = part.estimator.controlled, len(part.controls)
        if program is None or many == 0 or paths < ROOM * (many + 1):
            return False
        self._read([program], [[*part.names, *part.controls]])
        return True

    def stationary(self, standard_error: float | None, steps: int | None) -> Iterator[Averages]:
        """Yield the means of the stationary loop after each window of ticks.

        The last ones have an absolute standard error, or so many steps.
        """
        budget, width = steps or BUDGET, len(self.parts)
        least = max(BURN_IN, int(SETTLE * max(part.settling for part in self.parts)))
        operations = max(program.operations for program in self.programs)  # many: the burn-in is more than is needed
        most = PATHS if steps else min(PATHS, max(FEW_PATHS, PATHS * SMALL // max(operations, 1) // 8 * 8))
        paths = min(most, max(8, budget // (2 * least * width) // 8 * 8))
        states = [part.loop.start(part.estimator.program, paths, self.seed) for part in self.parts]
        states, dropped, forgotten = self._burn_in(states, min(least, budget // paths // width // 2), budget)
        paths = states[0].shape[1]
        if steps is not None and self._affordable(states, budget) > PAYS * dropped:
            self._add_controls(paths)
        kept: list[tuple[int, Array]] = []  # ticks and sums per path, of each window
        window = min(dropped, self._affordable(states, budget) // 2)  # two windows, to compare them
        while True:
            left = self._affordable(states, budget)
            if left < 1.5 * window:  # no crumb is left over, whose mean would be compared with all before it
                window = left
            window = self._whole(max(1, window))
            sums, states = self._advance(states, window)
            for part, rows in zip(self.parts, self.rows, strict=True):
                part.refuse_runaways(sums[rows][0], window)
            kept.append((window, sums))
            if len(kept) > 1 and not self._settled(kept):
                dropped += sum(length for length, _ in kept[:-1])
                kept = kept[-1:]
            means = _means(kept)
            cost, rates = self._summary(means, kept)
            measured, pace = sum(length for length, _ in kept), self._pace(means[self.counted].mean(axis=1))
            long_enough = forgotten and measured >= pace and len(kept) > 1
            target = self._target(standard_error, float(means[0].mean()))
            if steps is None and long_enough and self._is_precise(cost, target):
                yield Averages(cost, rates, self.steps, dropped, True, tail=self._tail(means))
                return
            reached = left <= window and steps is not None and long_enough
            yield Averages(cost, rates, self.steps, dropped, reached, settled=long_enough, tail=self._tail(means))
            if left <= window:
                return
            self._report(cost, None if steps else target, self.steps / budget)
            missing = left if steps else _missing(measured, cost.standard_error, target)
            if missing > PAYS * measured and self._add_controls(paths):
                dropped += measured
                kept = []
                missing = measured
            window = min(max(measured, int(pace)), max(missing, int(pace) - measured, BURN_IN // 4))

    def missions(self, horizon: int, standard_error: float | None, steps: int | None) -> Iterator[Averages]:
        """Yield the means of missions of so many ticks after each batch of them.

        The last ones have an absolute standard error, or so many steps.
        """
        budget, width = steps or BUDGET, len(self.parts)
        if FEWEST_MISSIONS * horizon * width > budget:
            raise ProblemError(
                f"a mission has {horizon} ticks, and {budget} steps are for fewer than {FEWEST_MISSIONS} of them; "
                "expected more steps, a shorter horizon, or a discount further from 1"
            )
        paths, discount = min(PATHS, budget // horizon // width), self.parts[0].loop.problem.cost.discount
        share = 1 / horizon if discount == 1 else 1 - discount  # of a tick in a rate
        costs, first, rates = Moments(), Moments(), dict[str, Moments]()
        while True:
            done = self.steps // horizon // width
            states = [part.loop.start(part.estimator.program, paths, self.seed, first=done) for part in self.parts]
            sums, states = self._advance(states, horizon)
            for part, rows, state in zip(self.parts, self.rows, states, strict=True):
                if part.estimator.sum == COST:
                    final = part.loop.final_cost(part.estimator.program, state)
                    sums[rows.start] += 0.0 if final is None else final
            costs.add(self._contrast(sums))
            first.add(sums[0])
            for link, row in self._sends(sums).items():
                rates.setdefault(link, Moments()).add(row)
            cost = self._rounded(costs.mean()).scaled(1.0, self.offset)
            found = {link: moments.mean().scaled(share) for link, moments in rates.items()}
            target = self._target(standard_error, first.center)
            reached = steps is None and self._is_precise(cost, target)
            last = reached or self.steps + paths * horizon * width > budget
            yield Averages(cost, found, self.steps, 0, reached or (last and steps is not None), tail=self._tail(sums))
            if last:
                return
            self._report(cost, None if steps else target, self.steps / budget)

    @cached_property
    def _restless(self) -> bool:
        """Whether a plant that is left alone costs ever more."""
        return any(comes_never_to_rest(part.loop) for part in self.parts)

    def _affordable(self, states: Sequence[Array], budget: int) -> int:
        """Return how many ticks the budget is still good for."""
        return (budget - self.steps) // states[0].shape[1] // len(self.parts)

    def _target(self, standard_error: float | None, first: float) -> float:
        """Return the standard error that is asked, or a share of the first part's cost, given the mean of its sum."""
        estimator = self.parts[0].estimator
        default = RELATIVE_ERROR * abs(estimator.scale * first + estimator.offset)
        return default if standard_error is None else standard_error

    def _whole(self, ticks: int) -> int:
        """Return ticks as whole turns of the policies' clocks: all paths are at the same place of a schedule."""
        cycle = lcm(*(part.loop.policy.cycle for part in self.parts))
        return -(-ticks // cycle) * cycle

    def _burn_in(self, states: list[Array], length: int, budget: int) -> tuple[list[Array], int, bool]:
        """Run until the start is forgotten: return the states, the ticks that took, and whether it was reached.

        Forgotten means: a few time constants, a few mean intervals between sends, and a late send on nearly every path;
        on none where nothing is sent and silence is safe.
        Where that takes long, fewer paths go on; half of the budget is left for what is kept.
        """
        least, dropped = length, length // 2
        _, states = self._advance(states, dropped)  # what the start itself makes a path send says nothing
        length -= dropped
        while True:
            sums, states = self._advance(states, length)
            dropped += length
            sent = sums[self.counted]
            pace = self._pace(sent.mean(axis=1) / length)
            silent = max((float((row == 0).mean()) for row in sent if row.any() or self._restless), default=0.0)
            if dropped >= max(least, pace) and silent <= SILENT:
                return states, dropped, True
            length = max(dropped, int(pace) - dropped + 1)
            now = states[0].shape[1]
            paths = min(now, (budget - self.steps) // 2 // length // len(self.parts) // 8 * 8)
            if paths < min(FEWEST_PATHS, now):
                return states, dropped, False
            states = [state[:, :paths] for state in states]

    def _pace(self, rates: Array) -> float:
        """Return the ticks in which the loop forgets: some of its slowest mode, and some intervals between sends."""
        return KEEP * max([part.settling for part in self.parts] + [1 / float(rate) for rate in rates if rate > 0])

    def _advance(self, states: Sequence[Array], ticks: int) -> tuple[Array, list[Array]]:
        """Run ticks in chunks that let progress be seen and the run be interrupted."""
        paths, after = states[0].shape[1], list(states)
        sums = np.zeros((len(self.counted), paths))
        chunk = max(1, CHUNK // paths)
        while ticks > 0:
            now = min(ticks, chunk)
            for k, (part, run, rows, names) in enumerate(
                zip(self.parts, self.runs, self.rows, self.names, strict=True)
            ):
                before, result = after[k], run(after[k], now, self.threads)
                after[k] = result.states
                sums[rows] += np.array([result.sums[name] for name in names])
                self.steps += now * paths
                if not np.abs(sums[rows]).max() < HUGE:  # or not a number
                    find_loss(part.loop, self.programs[k], run, before, now)
                    single = part.loop.precision == "float32"
                    passed = "the range of single precision" if single else f"{HUGE:g}"
                    raise part.diverges(f"its cost passed {passed} within {self.steps} steps")
            ticks -= now
            self.progress.tick()
        return sums, after

    def _settled(self, kept: Sequence[tuple[int, Array]]) -> bool:
        """Compare the last window with what came before it, path by path."""
        before, (length, last) = kept[:-1], kept[-1]
        earlier = _means(before)
        change = last / length - earlier
        spread = change.std(axis=1, ddof=1) / np.sqrt(change.shape[1])
        for part, rows in zip(self.parts, self.rows, strict=True):
            if np.abs(last[rows]).max() > 1e6 * length * max(float(np.abs(earlier[rows]).max()), 1e-300):
                raise part.diverges("its cost grew a million times between two windows")
        early = self.counted / length  # a window may end just before a send
        drift = DRIFT * spread + early + 1e-12 * np.abs(earlier.mean(axis=1))
        return bool((np.abs(change.mean(axis=1)) <= drift)[~self.controls].all())

    def _contrast(self, sums: Array) -> Array:
        """Return the costs of the paths without their constants, added up over the parts, (paths,)."""
        terms = [
            part.sign * part.estimator.scale * sums[rows.start]
            for part, rows in zip(self.parts, self.rows, strict=True)
        ]
        return np.sum(terms, axis=0)

    def _tail(self, means: Array) -> float:
        return np.inf if len(self.parts) > 1 else tail_index(means[0])

    def _sends(self, sums: Array) -> dict[str, Array]:
        """Return the sends of the paths on each link, added up over the parts, (paths,)."""
        found: dict[str, Array] = {}
        for part, rows in zip(self.parts, self.rows, strict=True):
            for name, row in zip(part.names[1:], sums[rows][1 : len(part.names)], strict=True):
                link = name.split()[1]
                found[link] = found.get(link, 0.0) + part.sign * row
        return found

    def _summary(self, means: Array, kept: Sequence[tuple[int, Array]]) -> tuple[Estimate, dict[str, Estimate]]:
        cost = controlled_mean(self._contrast(means), means[self.controls])
        if cost.standard_error <= DETERMINISTIC * abs(cost.value):  # paths that agree tell nothing of a cycle cut short
            length, last = kept[-1]
            late = float(self._contrast(last).mean()) / length
            cost = Estimate(cost.value, abs(late - cost.value), cost.method)
        seen = sum(length for length, _ in kept) * means.shape[1]
        rates = {link: rate_of(row, seen) for link, row in self._sends(means).items()}
        return self._rounded(cost).scaled(1.0, self.offset), rates

    def _rounded(self, cost: Estimate) -> Estimate:
        """Return a mean with what single precision may have done to it; of a difference that is what is measured."""
        if len(self.parts) > 1 or self.parts[0].loop.precision == "float64":
            return cost
        error = float(np.hypot(cost.standard_error, ROUNDING * cost.value))
        return Estimate(cost.value, error, cost.method)

    def _is_precise(self, cost: Estimate, target: float) -> bool:
        """Tell whether a standard error is small enough; loops that have not yet differed have told nothing."""
        programs = [part.estimator.program for part in self.parts]
        told = cost.standard_error > 0 or all(program == programs[0] for program in programs)
        return told and cost.standard_error <= target

    def _report(self, cost: Estimate, wanted: float | None, spent: float) -> None:
        precise = 0.0 if wanted is None or cost.standard_error == 0 else min(1.0, wanted / cost.standard_error) ** 2
        self.progress(max(spent, precise))


def last_of(answers: Iterator[Averages], found: Averages | None) -> Averages:
    """Return the last of ever better answers, or the best so far when the time is up.

    Args:
        answers: that are still to come.
        found: the one before them, or None.

    Raises:
        OutOfTime: before the first.
    """
    try:
        for found in answers:  # noqa: B007 (the last one counts)
            pass
    except OutOfTime:
        if found is None:
            raise
    assert found is not None
    return found


def _means(windows: Sequence[tuple[int, Array]]) -> Array:
    """Return the means per tick over windows of so many ticks, (sums, paths)."""
    return sum((sums for _, sums in windows), np.zeros_like(windows[0][1])) / sum(length for length, _ in windows)


def _missing(measured: int, error: float, wanted: float) -> int:
    """Return how many more ticks bring a standard error down to what is wanted, with 5 % to spare."""
    if error <= wanted:
        return 0
    return measured * 1000 if wanted < 1e-3 * error else int(measured * ((error / wanted) ** 2 * 1.05 - 1)) + 1
