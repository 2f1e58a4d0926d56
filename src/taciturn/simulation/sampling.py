"""Simulation of many paths of a loop, or of two loops with the same noise, to estimate means and standard errors.

A run has a burn-in and windows of steps that are averaged. Control variates, whose mean is 0, reduce the variance of
the means (``program.draws``). A path whose cost grows without limit, or a non-finite number, ends the run with an error
that says what diverges.

**When has a loop settled?** The time constants of a design are those of the loop that always sends. A policy that
seldom sends can be much slower: while it is silent, a slow mode of the plant or an integrator of the controller moves
as in open loop. So the sums that the paths have had since their start decide (``History``). The steps are divided into
windows, and the mean over a range of windows is compared with the mean over all later ones, path by path. The last
range that differs ends at the step t. Until then, a transient of amplitude A has decayed to the resolution r of the
comparison, so by the step 2t it has decayed to about r²/A, which is far below r. Windows that begin earlier are
dropped. A range reaches back to a quarter of its last step at most: it contains two windows whose lengths have doubled,
which resolves more than one window, and it does not contain the start, whose large transient would be seen at any later
time.

Some slow transients hardly change the sums of one window. With a held input, for example, small and large commands may
alternate, and it takes hundreds of packets until the pairs of commands have their distribution in the long run, which
moves the rate by a few percent. So the distribution of each state over the paths is also compared between the ends of
windows, by the largest distance of the distribution functions (Smirnov). This prolongs the burn-in by a limited factor
and refuses nothing, because paths that send in phase have other distributions at each step although their sums have
settled.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import lcm

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array, Bits
from taciturn._display import Displayed
from taciturn._progress import OutOfTime, Progress, Stages
from taciturn._text import number_of
from taciturn.analyse.every_sample import BASELINE, MORE, OVER
from taciturn.errors import ProblemError, UnstableError
from taciturn.loop import COST, Loop
from taciturn.model.estimate import Estimate
from taciturn.program.draws import GENERATOR, controlled
from taciturn.program.engine import Runner, prepare
from taciturn.program.ir import Program
from taciturn.program.ops import Control, Name, Sent, Silence
from taciturn.simulation.reliability import comes_never_to_rest, drifts_of
from taciturn.simulation.statistics import Moments, controlled_mean, mean, rate_of, tail_index

# the run: paths, steps, and the precision that is asked for
SIMULATED_PATHS = 4096
_FEW_PATHS, _SMALL = 512, 2000  # paths of a large loop; a loop is large if a step has more operations than this
_BEGUN = 1 << 23  # most steps of all paths in a burn-in with more than _FEW_PATHS
_FEWEST_PATHS = 64  # least number of paths, for slow loops with long paths
_FEWEST_MISSIONS = 8
MOST_OPERATIONS = 4_000_000_000  # steps of all paths together
_DRIFTING_STEPS = 20_000_000  # of a loop that has no average
_CHUNK = 1 << 24  # steps between two reports of progress
USUAL_RELATIVE_ERROR = 1e-4  # default standard error, relative to the cost
_ROOM = 8  # least number of paths per control variate
_SEEN = 1e-6  # difference of two loops on a path, relative to the largest one, below which it does not count
_PAYS = 4  # least ratio of remaining to finished steps for which control variates are worthwhile

# the burn-in, and the comparison of windows
SHORTEST_BURN_IN = 512  # least number of steps of the burn-in
SETTLING_CONSTANTS = 12  # burn-in in time constants of the loop: the initial transient decays to e^-12
_KEEP = 8  # least length of the burn-in and of the measurement, in time constants and in mean send intervals
_SILENT = 1e-3  # largest share of paths without a late send in the burn-in
_DIFFERENT = 3.5  # standard errors by which the mean over a range may differ from that over the later windows
_REACH = 4  # the first step of a range is at least its last step divided by this number
_AGAIN = 2  # windows are kept from this multiple of the last step at which a difference was seen
_IN_PHASE = 0.5  # spread of a count over the paths below which all paths send at nearly the same steps

# the comparison of distributions
_FAR = 2.4  # limit of Smirnov's distance, in units of √(2/paths), exceeded by equal distributions in 1 of 50,000 cases
_PROLONGED = 8  # the burn-in is prolonged by at most this factor while distributions change
_GROWS = 1.2  # ratio of the deviations at two steps, one twice as late, above which a state may wander: √2 if it does
_GONE = 1e-6  # spread of a state, relative to its largest one, below which it has decayed

# divergence, and rounding
_RUNAWAY = 1e12  # a path has diverged if it costs more than this multiple of the median path
HUGE = 1e150  # a limit whose square is still finite
_DETERMINISTIC = 1e-9  # relative spread below which all paths count as identical
_ROUNDING_OF_MEANS = 1e-12  # relative rounding error of a mean
_ROUNDING_OF_SINGLES = 1e-6  # relative rounding error in single precision; measured: at most 7e-7

Window = tuple[int, Array]  # steps, and sums over them, (sums, paths)
Watch = Callable[[Array], Array]  # further numbers of each path that have to settle, from its states


@dataclass(frozen=True, eq=False, repr=False)
class Estimator(Displayed):
    """How to estimate a loop's cost: a simulation program, and cost = offset + scale·(mean of one of its sums)."""

    program: Program  # program of one step of the loop
    whole: Program | None  # the complete program, from which control variates are derived; None for finite-horizon runs
    sum: str  # name of the sum
    offset: float  # constant term, in the units of the cost
    scale: float  # factor of the mean per step
    settling: float = 0.0  # time constant in steps of another loop that the program contains

    @cached_property
    def controlled(self) -> Program | None:
        """Simulation program with control variates as further sums; None for runs over a finite horizon."""
        return None if self.whole is None else controlled(self.whole, self.program)


@dataclass(frozen=True, eq=False, repr=False)
class Part(Displayed):
    """A loop in a simulation, its cost estimator, and whether its cost and rates are added or subtracted."""

    loop: Loop  # the closed loop
    estimator: Estimator  # estimator of its cost
    sign: float = 1.0  # 1, or −1 if cost and rates are subtracted

    @property
    def names(self) -> list[Name]:
        """Names of the sums that the simulation needs: cost estimator, ``counts`` and, if needed, stage cost and
        difference to a baseline.
        """
        more = [COST] if self.estimator.sum == MORE else []
        return [self.estimator.sum, *counts(self.loop), *more, *([OVER] if self.compared else [])]

    @property
    def compared(self) -> bool:
        """Whether the program also contains a baseline."""
        return OVER in self.estimator.program.sums

    @property
    def paid(self) -> int | None:
        """Index of the stage cost among the sums of ``names``; None if the simulation does not need it."""
        return self.names.index(COST) if COST in self.names else None

    @property
    def controls(self) -> list[Control]:
        """Names of the control variates for this loop's cost. Each has mean 0."""
        program = self.estimator.controlled
        return [] if program is None else [name for name in program.sums if isinstance(name, Control)]

    @property
    def settling(self) -> float:
        """Largest time constant of the loop, in steps."""
        return max(self.loop.policy.theory.settling, self.estimator.settling)

    @property
    def distance(self) -> float:
        """Number of time constants until a large initial state has decayed to the size of the noise: ln(1 +
        |mean|/deviation).
        """
        plant = self.loop.problem.plant
        deviation = float(np.sqrt(np.diag(plant.W).max()))
        return float(np.log1p(np.abs(plant.mean).max() / deviation)) if deviation > 0 else 0.0

    def diverges(self, how: str) -> UnstableError:
        """Create the exception for a loop that diverges. ``how`` is the observation that shows it."""
        ranges = ", the range of the payload" if self.loop.network.payload != "float64" else ""
        return UnstableError(
            f"the loop of {self.loop.policy.kind} diverges: {how}; expected a stable loop: send more often, "
            f"or check [plant.actual]{ranges} and input_limit"
        )

    def refuse_runaways(self, sums: Array, ticks: int) -> None:
        """Raise an error if a path has diverged, as may happen for an unstable plant with limited inputs."""
        if self.paid is None:
            return
        size = np.sort(np.abs(sums[self.paid]))  # np.median would load all of masked arrays
        largest, typical = float(size[-1]), float(size[len(size) // 2])
        all_time = (self.loop.policy.theory.cost_all_time or 0.0) * self.loop.policy.tick
        if typical > 0 and largest > max(_RUNAWAY * typical, ticks * all_time):
            raise self.diverges(f"one path costs {largest / typical:.1g} times as much as the median path")


def sends(loop: Loop) -> list[Sent]:
    """List the names of the sums of packets, one for each link on which the policy decides when to send."""
    return [Sent(link) for link in loop.policy.scheduled]


def silences(loop: Loop) -> list[Silence]:
    """List the names of the sums of the cost of not sending, one for each node that bounds this cost by itself."""
    return [Silence(links) for links in loop.policy.theory.silence]


def counts(loop: Loop) -> list[Sent | Silence]:
    """List the names of all sums except the cost: packets sent, and cost of not sending."""
    return [*sends(loop), *silences(loop)]


@dataclass(frozen=True, repr=False)
class Averages(Displayed):
    """Average cost and send rates of a simulated loop, with their standard errors.

    Args:
        cost: cost per unit of time, or the total of a finite horizon.
        rates: sends per ``rate_unit`` by link; for a finite horizon, the mean fraction of steps with a send, and with a
            discount, the weighted sum (1−α)Σα^k over these steps.
        steps: simulated steps of all paths together, including burn-in.
        burn_in: steps dropped at the start of each path.
        reached: whether the requested standard error was reached.
        notes: reasons to doubt the numbers.
        settled: whether the initial transient has decayed.
        estimator: averaged quantity: "completed squares", "difference to every sample", "plain average" or "conditional
            sampling"; or "".
        tail: index of the power law of the paths with the highest costs; infinite if there are too few paths.
        rate_unit: unit of time of the rates: ``"step"`` or ``"second"``.
        trusted: whether the variance of the cost is finite, as far as is known; if not, the standard error is
            meaningless.
        silence: what the silence of each node adds to the cost of its own response, in the unit of the cost, by the
            links that the node decides together.
        plain_error: standard error that the plain average has over the same steps, if the difference to every sample is
            averaged; else None.
        baseline: cost of the baseline, on the same random numbers, if the simulation contains one; else None.
        excess: J/J_baseline − 1, with the standard error of the pair; None without a baseline of positive cost.
    """

    cost: Estimate
    rates: Mapping[str, Estimate] = field(hash=False)
    steps: int
    burn_in: int
    reached: bool
    notes: tuple[str, ...] = ()
    estimator: str = ""
    settled: bool = True
    tail: float = np.inf
    rate_unit: str = "step"
    trusted: bool = True
    silence: Mapping[tuple[str, ...], Estimate] = field(hash=False, default_factory=lambda: {})
    plain_error: float | None = None
    baseline: Estimate | None = None
    excess: Estimate | None = None


class Sampling:
    """Simulation of one loop, or of two loops with the same noise whose results are subtracted path by path."""

    def __init__(self, parts: Sequence[Part], seed: int, progress: Progress | None, threads: int | None) -> None:
        """Compile the programs."""
        self.parts, self.seed, self.threads, self.progress = parts, seed, threads, Stages(progress)
        self.offset = sum(part.sign * part.estimator.offset for part in parts)
        self.steps = 0
        self._read([part.estimator.program for part in parts], [part.names for part in parts])

    def _read(self, programs: Sequence[Program], names: Sequence[Sequence[Name]]) -> None:
        """Select the programs to run and the sums to read."""
        self.programs, self.runs, self.names = programs, [prepare(program) for program in programs], names
        sizes = [len(some) for some in names]
        self.rows = [slice(int(end) - size, int(end)) for end, size in zip(np.cumsum(sizes), sizes, strict=True)]
        read = [name for some in names for name in some]
        self.counted: npt.NDArray[np.bool_] = np.array([isinstance(name, Sent) for name in read])
        self.controls: npt.NDArray[np.bool_] = np.array([isinstance(name, Control) for name in read])
        self.links = [  # of the counted sums
            (part.loop, name.link)
            for part, some in zip(self.parts, names, strict=True)
            for name in some
            if isinstance(name, Sent)
        ]

    def _add_controls(self, history: History) -> bool:
        """Add control variates to the sums if there are any and enough paths to fit them; return whether it did."""
        # If two loops differ on few paths, the fit depends on these paths only. So there are none for a difference of
        # two parts, and of every sample only the paths on which it is seen count.
        part, size = self.parts[0], np.abs(history.windows[-1][1][0])
        if len(self.parts) > 1 or self.controls.any():
            return False
        paths = int((size > _SEEN * size.max()).sum()) if part.estimator.sum == MORE else len(size)
        program, many = part.estimator.controlled, len(part.controls)
        if program is None or many == 0 or paths < _ROOM * (many + 1):
            return False
        self._read([program], [[*part.names, *part.controls]])
        return True

    def stationary(self, standard_error: float | None, steps: int | None) -> Iterator[Averages]:
        """Yield estimates of stationary cost and rates, a new one after each window of simulated steps."""
        # The iteration ends at the given absolute standard error or number of steps.
        drifts = any(drifts_of(part.loop) for part in self.parts)  # no average, so no precision is worth more steps
        budget = steps or (_DRIFTING_STEPS if drifts else MOST_OPERATIONS)
        operations = max(program.operations for program in self.programs)  # if large, fewer paths: burn-in dominates
        few = max(_FEW_PATHS, SIMULATED_PATHS * _SMALL // max(operations, 1) // 8 * 8)
        most = SIMULATED_PATHS if steps else min(few, *(paths_of(part.loop, self._burn_in) for part in self.parts))
        states, history, forgotten = self.settle(most, budget)
        first = history.steps
        if steps is not None and self._affordable(states, budget) > _PAYS * first:
            self._add_controls(history)
        window = min(first, self._affordable(states, budget) // 2)  # at least two windows, for comparison
        while True:
            left = self._affordable(states, budget)
            if left < 1.5 * window:  # avoid a short last window, which would be compared with all earlier ones
                window = left
            window = self._whole(max(1, window))
            sums, states = self._advance(states, window)
            for part, rows in zip(self.parts, self.rows, strict=True):
                part.refuse_runaways(sums[rows], window)
            self._refuse_growth(history, window, sums)
            history.add(window, sums)
            kept = history.kept(first)
            settled = bool(kept)
            kept = kept or history.windows[-1:]
            dropped = history.steps - sum(length for length, _ in kept)
            length, sums = _joined(kept)
            means = sums / length
            cost, rates = self._summary(means, kept)
            silence = {links: mean(row).scaled(self._pace_of_cost) for links, row in self._added(means).items()}
            baseline, excess = self._compared(means, cost)
            found = Averages(
                cost, rates, self.steps, dropped, True, tail=self._tail(means), silence=silence,
                plain_error=self._plain_error(means), baseline=baseline, excess=excess,
            )  # fmt: skip
            settled = settled and not self._unheard(means)
            measured, pace = history.steps - dropped, self._pace(means[self.counted].mean(axis=1))
            long_enough = forgotten and settled and measured >= pace and len(kept) > 1
            target = self._target(standard_error, float(means[0].mean()))
            if steps is None and (drifts or (long_enough and self._is_precise(cost, target))):
                yield found
                return
            reached = left <= window and steps is not None and long_enough
            yield replace(found, reached=reached, settled=long_enough)
            if left <= window:
                return
            self._report(cost, None if steps else target, self.steps / budget)
            missing = left if steps else _missing(measured, cost.standard_error, target)
            if missing > _PAYS * measured and self._add_controls(history):
                first = history.steps
                missing = measured
            window = min(max(measured, int(pace)), max(missing, int(pace) - measured, SHORTEST_BURN_IN // 4))

    def missions(self, horizon: int, standard_error: float | None, steps: int | None) -> Iterator[Averages]:
        """Yield estimates of cost and rates of runs over a finite horizon, a new one after each batch of runs."""
        # The iteration ends at the given absolute standard error or number of steps.
        budget, width = steps or MOST_OPERATIONS, len(self.parts)
        if _FEWEST_MISSIONS * horizon * width > budget:
            raise ProblemError(
                f"the horizon is {horizon}, so {number_of(budget, 'step')} contain fewer than "
                f"{_FEWEST_MISSIONS} runs; "
                "expected more steps, a shorter horizon, or a discount further from 1"
            )
        paths, discount = min(SIMULATED_PATHS, budget // horizon // width), self.parts[0].loop.problem.cost.discount
        share = 1 / horizon if discount == 1 else 1 - discount  # weight of a step in a rate
        costs, first, rates = Moments(), Moments(), dict[str, Moments]()
        added = dict[tuple[str, ...], Moments]()
        pair = Pair()
        while True:
            done = self.steps // horizon // width
            states = [part.loop.start(part.estimator.program, paths, self.seed, first=done) for part in self.parts]
            sums, states = self._advance(states, horizon)
            for part, rows, state in zip(self.parts, self.rows, states, strict=True):
                if part.estimator.sum == COST:
                    final = part.loop.final_cost(part.estimator.program, state)
                    sums[rows.start] += 0.0 if final is None else final
                    if part.compared and final is not None:
                        other = part.loop.final_cost(part.estimator.program, state, BASELINE.format("x"))
                        sums[rows.start + part.names.index(OVER)] += final - (0.0 if other is None else other)
            costs.add(self._contrast(sums))
            if (over := self._over(sums)) is not None:
                pair.add(self._contrast(sums), over)
            first.add(sums[0])
            for link, row in self._sends(sums).items():
                rates.setdefault(link, Moments()).add(row)
            for links, row in self._added(sums).items():
                added.setdefault(links, Moments()).add(row)
            cost = self._rounded(costs.mean()).scaled(1.0, self.offset)
            found = {link: moments.mean().scaled(share) for link, moments in rates.items()}
            target = self._target(standard_error, first.center)
            reached = steps is None and self._is_precise(cost, target)
            last = reached or self.steps + paths * horizon * width > budget
            silence = {links: moments.mean() for links, moments in added.items()}
            done = reached or (last and steps is not None)
            baseline, excess = pair.compared(self.offset)
            yield Averages(
                cost, found, self.steps, 0, done, tail=self._tail(sums), silence=silence,
                baseline=baseline, excess=excess,
            )  # fmt: skip
            if last:
                return
            self._report(cost, None if steps else target, self.steps / budget)

    @cached_property
    def _restless(self) -> bool:
        """Whether the cost of an uncontrolled plant grows without limit."""
        return any(comes_never_to_rest(part.loop) for part in self.parts)

    def _must_send(self, loop: Loop, link: str) -> bool:
        """Return whether the loop has settled only after a packet on the link: if it can send, and silence is not
        safe.
        """
        return self._restless and link not in loop.mute

    def _affordable(self, states: Sequence[Array], budget: int) -> int:
        """Return the number of steps per path that the budget still allows."""
        return (budget - self.steps) // states[0].shape[1] // len(self.parts)

    def _target(self, standard_error: float | None, first: float) -> float:
        """Return the requested standard error, or the default relative to the cost of the first part."""
        estimator = self.parts[0].estimator
        default = USUAL_RELATIVE_ERROR * abs(estimator.scale * first + estimator.offset)
        return default if standard_error is None else standard_error

    def _whole(self, ticks: int) -> int:
        """Round steps up to whole cycles of the policies, so that every window ends at the same phase of a schedule."""
        cycle = lcm(*(part.loop.policy.cycle for part in self.parts))
        return -(-ticks // cycle) * cycle

    @property
    def _burn_in(self) -> int:
        """Steps after which a transient has decayed that is as slow as the time constants of the designs."""
        slowest = max((SETTLING_CONSTANTS + part.distance) * part.settling for part in self.parts)
        return max(SHORTEST_BURN_IN, int(slowest))

    def settle(self, most: int, budget: int, watch: Watch | None = None) -> tuple[list[Array], History, bool]:
        """Simulate until the transient has decayed. Return the final states, the history, and whether it has
        decayed.
        """
        # The initial transient has decayed after a few time constants, a few mean intervals between sends, a late send
        # on nearly every path, and when sums no longer change (``History``). No send is required if nothing is sent and
        # silence is safe. If the burn-in is long, fewer paths continue; half of the budget is reserved for the
        # measurement.
        width = len(self.parts)
        least = self._burn_in
        paths = min(most, max(8, budget // (2 * least * width) // 8 * 8))
        least = min(least, budget // paths // width // 2)
        states: list[Array] = [
            part.loop.start(part.estimator.program, paths, self.seed, stationary=True) for part in self.parts
        ]
        counted = self.counted
        if watch is not None:
            counted = np.append(counted, np.zeros(len(watch(states[0])), dtype=np.bool_))
        history, snapshots, enough = History(counted), Snapshots(), 0
        own = [[i for i, state in enumerate(p.states) if state.name != GENERATOR] for p in self.programs]
        pieces = [piece for piece in (least // 4, least // 2 - least // 4, least - least // 2) if piece]
        sums: Array = np.zeros((0, 0))
        changed = True
        while True:
            for piece in map(self._whole, pieces):  # so that states are compared at the same phase of a schedule
                sums, states = self._advance(states, piece)
                found = sums if watch is None else np.vstack([sums, piece * watch(states[0])])
                history.add(piece, found)
                changed = snapshots.changed(np.vstack([state[rows] for state, rows in zip(states, own, strict=True)]))
            length = history.windows[-1][0]
            sent = sums[self.counted]  # sends that are caused by the initial state are in an earlier window
            pace = self._pace(sent.mean(axis=1) / length)
            awaited = [row for row, link in zip(sent, self.links, strict=True) if row.any() or self._must_send(*link)]
            silent = max((float((row == 0).mean()) for row in awaited), default=0.0)
            settled = history.steps >= max(least, pace) and silent <= _SILENT and bool(history.kept(0))
            enough = enough or (history.steps if settled else 0)
            if settled and (not changed or history.steps >= _PROLONGED * enough):
                return states, history, True
            pieces = [max(history.steps, int(pace) - history.steps + 1)]
            now = states[0].shape[1]
            paths = min(now, (budget - self.steps) // 2 // pieces[0] // width // 8 * 8)
            if paths < min(_FEWEST_PATHS, now):
                return states, history, settled
            states = [state[:, :paths] for state in states]

    def _unheard(self, means: Array) -> bool:
        """Return whether no packet has been sent on a link, after which the loop may be another one for long."""
        # With an identity, each silent step costs what it has cost so far. Without one, the controller goes on as if
        # its packets had arrived, and a rare first packet moves integrals and banks that have been at rest. A node that
        # sends on another link has been heard, and a link that cannot send moves nothing.
        loop = self.parts[0].loop
        if len(self.parts) > 1 or loop.identity is not None or loop.policy.theory.closed_form is not None:
            return False
        rates: list[float] = means[self.counted].mean(axis=1).tolist()
        silent = {name.link for name, rate in zip(sends(loop), rates, strict=True) if rate == 0}
        heard = [link for node in silences(loop) if not silent.issuperset(node.links) for link in node.links]
        return any(link not in loop.mute for link in silent.difference(loop.policy.theory.fixed_rates, heard))

    def _pace(self, rates: Array) -> float:
        """Return the steps until a transient has decayed, from time constants and intervals between sends."""
        return _KEEP * max([part.settling for part in self.parts] + [1 / float(rate) for rate in rates if rate > 0])

    def _advance(self, states: Sequence[Array], ticks: int) -> tuple[Array, list[Array]]:
        """Run steps in chunks, between which progress is reported and the run can be interrupted."""
        paths, after = states[0].shape[1], list(states)
        sums = np.zeros((len(self.counted), paths))
        chunk = max(1, _CHUNK // paths)
        while ticks > 0:
            now = min(ticks, chunk)
            for k, (part, run, rows, names) in enumerate(
                zip(self.parts, self.runs, self.rows, self.names, strict=True)
            ):
                before, result = after[k], run(after[k], now, self.threads)
                after[k] = result.states
                sums[rows] += np.array([result.sums[name] for name in names])
                self.steps += now * paths
                if not np.abs(sums[rows]).max() < HUGE:  # also if it is NaN
                    find_loss(part.loop, self.programs[k], run, before, now)
                    single = part.loop.precision == "float32"
                    passed = "the range of single precision" if single else f"{HUGE:g}"
                    raise part.diverges(f"the cost exceeded {passed} within {number_of(self.steps, 'step')}")
            ticks -= now
            self.progress.tick()
        return sums, after

    def _refuse_growth(self, history: History, length: int, sums: Array) -> None:
        """Raise an error if the mean cost grows from the latest window to the next by a factor of a million."""
        steps, earlier = history.windows[-1]
        for part, rows in zip(self.parts, self.rows, strict=True):
            before = float(np.abs(earlier[rows.start : rows.start + len(part.names)]).max()) / steps
            if np.abs(sums[rows]).max() > 1e6 * length * max(before, 1e-300):
                raise part.diverges(
                    "the mean cost grew by a factor of a million from one simulated interval to the next"
                )

    def _contrast(self, sums: Array) -> Array:
        """Return the costs of the paths without their constants, summed over the parts, (paths,)."""
        terms = [
            part.sign * part.estimator.scale * sums[rows.start]
            for part, rows in zip(self.parts, self.rows, strict=True)
        ]
        return np.sum(terms, axis=0)

    def _tail(self, means: Array) -> float:
        return np.inf if len(self.parts) > 1 else tail_index(means[0])

    def _sends(self, sums: Array) -> dict[str, Array]:
        """Return the sends of the paths on each link, summed over the parts, (paths,)."""
        found: dict[str, Array] = {}
        for part, rows in zip(self.parts, self.rows, strict=True):
            for name, row in zip(part.names, sums[rows], strict=False):  # control variates follow
                if isinstance(name, Sent):
                    found[name.link] = found.get(name.link, 0.0) + part.sign * row
        return found

    def _added(self, sums: Array) -> dict[tuple[str, ...], Array]:
        """Return the cost that the silence of each node adds, (paths,); nothing for the difference of two loops."""
        if len(self.parts) > 1:
            return {}
        named = zip(self.parts[0].names, sums[self.rows[0]], strict=False)  # control variates follow
        return {name.links: row for name, row in named if isinstance(name, Silence)}

    def _plain_error(self, means: Array) -> float | None:
        """Return the standard error of the plain average, if the difference to every sample is averaged."""
        part, place = self.parts[0], self.parts[0].paid
        if part.estimator.sum != MORE or place is None:
            return None
        return part.estimator.scale * mean(means[self.rows[0].start + place]).standard_error

    def _over(self, sums: Array) -> Array | None:
        """Return the costs of the paths minus those of the baseline, (paths,); None without a baseline."""
        part = self.parts[0]
        if len(self.parts) > 1 or not part.compared:
            return None
        return part.estimator.scale * sums[self.rows[0].start + part.names.index(OVER)]

    def _compared(self, means: Array, cost: Estimate) -> tuple[Estimate | None, Estimate | None]:
        """Return the cost of the baseline and the excess over it, of which the draws that both loops share cancel."""
        over, own, controls = self._over(means), self._contrast(means), means[self.controls]
        if over is None:
            return None, None
        baseline = self._rounded(controlled_mean(own - over, controls)).scaled(1.0, self.offset)
        if baseline.value <= 0:
            return baseline, None
        excess = controlled_mean(over, controls).value / baseline.value
        rest = self._rounded(controlled_mean(over - excess * (own - over), controls)).standard_error
        # without noise all paths agree, and the error is that of a cycle that the window cuts off
        cut = cost.standard_error if baseline.standard_error <= _DETERMINISTIC * baseline.value and over.any() else 0.0
        return baseline, Estimate(excess, max(rest, cut) / baseline.value, cost.method)

    @cached_property
    def _pace_of_cost(self) -> float:
        """Steps per unit of time of an average cost."""
        return 1 / self.parts[0].loop.problem.tick

    def _summary(self, means: Array, kept: Sequence[Window]) -> tuple[Estimate, dict[str, Estimate]]:
        cost = controlled_mean(self._contrast(means), means[self.controls])
        # if all paths agree, their spread hides the error of a cycle that the window cuts off: the change from all
        # windows to the last one shows it
        if cost.standard_error <= _DETERMINISTIC * abs(cost.value):
            length, last = kept[-1]
            late = float(self._contrast(last).mean()) / length
            cost = Estimate(cost.value, abs(late - cost.value), cost.method)
        seen = sum(length for length, _ in kept) * means.shape[1]
        windows = [(length, self._sends(sums)) for length, sums in kept]
        rates = {
            link: rate_of(row, seen, _shared_end([(length, sends[link]) for length, sends in windows]))
            for link, row in self._sends(means).items()
        }
        return self._rounded(cost).scaled(1.0, self.offset), rates

    def _rounded(self, cost: Estimate) -> Estimate:
        """Add the rounding error of single precision to a mean; a difference of two precisions already measures it."""
        if len(self.parts) > 1 or self.parts[0].loop.precision == "float64":
            return cost
        error = float(np.hypot(cost.standard_error, _ROUNDING_OF_SINGLES * cost.value))
        return Estimate(cost.value, error, cost.method)

    def _is_precise(self, cost: Estimate, target: float) -> bool:
        """Return whether a standard error is small enough; an error of 0 counts only if both programs are equal."""
        programs = [part.estimator.program for part in self.parts]
        told = cost.standard_error > 0 or all(program == programs[0] for program in programs)
        return told and cost.standard_error <= target

    def _report(self, cost: Estimate, wanted: float | None, spent: float) -> None:
        precise = 0.0 if wanted is None or cost.standard_error == 0 else min(1.0, wanted / cost.standard_error) ** 2
        self.progress(max(spent, precise))


class Pair:
    """The mean costs of runs of a loop and of its baseline, with the error of their ratio."""

    def __init__(self) -> None:
        """Start without runs."""
        self._own, self._over, self._both = Moments(), Moments(), Moments()

    def add(self, own: Array, over: Array) -> None:
        """Add the costs of some runs, and their differences to the baseline."""
        for moments, values in ((self._own, own), (self._over, over), (self._both, own + over)):
            moments.add(values)

    def compared(self, offset: float) -> tuple[Estimate | None, Estimate | None]:
        """Return the cost of the baseline and the excess over it; None without runs."""
        if self._own.count < 2:
            return None, None
        own, over, both = (moments.mean() for moments in (self._own, self._over, self._both))
        variances = [one.standard_error**2 for one in (own, over, both)]
        shared = (variances[2] - variances[0] - variances[1]) / 2

        def error(of_own: float, of_over: float) -> float:
            found = of_own**2 * variances[0] + of_over**2 * variances[1] + 2 * of_own * of_over * shared
            return float(np.sqrt(max(found, 0.0)))

        baseline = Estimate(own.value - over.value + offset, error(1.0, -1.0), own.method)
        if baseline.value <= 0:
            return baseline, None
        excess = over.value / baseline.value
        return baseline, Estimate(excess, error(-excess, 1 + excess) / baseline.value, own.method)


def paths_of(loop: Loop, burn_in: int) -> int:
    """Return the number of paths of a loop without a horizon: few if the burn-in is long, which every path repeats.

    If links drop packets, many paths show whether a few of them dominate the cost.
    """
    few = max(_FEW_PATHS, _BEGUN // burn_in // 8 * 8)
    return min(SIMULATED_PATHS, few) if loop.network.ideal else SIMULATED_PATHS


def last_of(answers: Iterator[Averages], found: Averages | None) -> Averages:
    """Return the last result that a simulation yields: at its end, or before the time limit."""
    try:
        for found in answers:  # noqa: B007 (only the last one is used)
            pass
    except OutOfTime:
        if found is None:
            raise
    assert found is not None
    return found


def _missing(measured: int, error: float, wanted: float) -> int:
    """Return the number of further steps until a standard error reaches its target, with a margin of 5 %."""
    # the squared standard error falls as 1/steps; a very small target is far away in any case
    if error <= wanted:
        return 0
    return measured * 1000 if wanted < 1e-3 * error else int(measured * ((error / wanted) ** 2 * 1.05 - 1)) + 1


def _shared_end(windows: Sequence[Window]) -> float:
    """Return the standard deviation of the error of a rate that all paths share."""
    # Paths that send at the same steps, as after a common start with nearly equal intervals, all end just before or
    # just after a send. With intervals of ℓ steps, the number of sends of n steps is off n/ℓ by one of 0, 1/ℓ …
    # 1 − 1/ℓ, all alike, so its standard deviation is √((1 − 1/ℓ²)/12). Windows of whole cycles of a schedule have
    # equal rates, and no such error.
    steps, sends = sum(length for length, _ in windows), np.sum([sums for _, sums in windows], axis=0)
    rates = [float(sums.mean()) / length for length, sums in windows]
    apart = sends.std() >= _IN_PHASE or sends.mean() < 1
    if apart or np.ptp(rates) <= _ROUNDING_OF_MEANS:
        return 0.0
    rate = min(1.0, float(sends.mean()) / steps)
    return float(np.sqrt((1 - rate**2) / 12)) / steps


def _joined(windows: Sequence[Window], rows: int | None = None) -> Window:
    """Return the steps and the sums of several windows, all or the first ones."""
    (_, first), *later = windows
    total = first[:rows].copy()
    for _, sums in later:  # added in turn: a stack takes much memory
        total += sums[:rows]
    return sum(length for length, _ in windows), total


class History:
    """The sums of all paths since their start, window of steps by window of steps."""

    def __init__(self, counted: Bits) -> None:
        """Start without windows."""
        self.counted = counted
        self.windows: list[Window] = []  # later windows may have more sums, which are not compared

    @property
    def steps(self) -> int:
        """Number of steps that each path has taken since its start."""
        return sum(length for length, _ in self.windows)

    def add(self, length: int, sums: Array) -> None:
        """Add a window of steps. If fewer paths are simulated than before, only these are kept in earlier windows."""
        paths = sums.shape[1]
        self.windows = [(steps, earlier[:, :paths]) for steps, earlier in self.windows] + [(length, sums)]

    def drift(self) -> int:
        """Return the step at which the last significant change of the means ends; 0 if there was no change."""
        ends, rows = np.cumsum([length for length, _ in self.windows]), len(self.counted)
        for j in range(len(self.windows) - 1, 0, -1):  # from the last one, as the latest difference decides
            later = _joined(self.windows[j:], rows)
            for i in range(j - 1, -1, -1):
                begins = int(ends[i - 1]) if i else 0
                if i < j - 1 and begins * _REACH < ends[j - 1]:
                    break
                if self._differ(_joined(self.windows[i:j], rows), later):
                    return int(ends[j - 1])
        return 0

    def kept(self, first: int) -> list[Window]:
        """Return the windows after step ``first`` that begin long enough after the last change of the means."""
        first = max(first, _AGAIN * self.drift())
        begins = np.cumsum([0] + [length for length, _ in self.windows])
        return [window for begin, window in zip(begins, self.windows, strict=False) if begin >= first]

    def _differ(self, before: Window, after: Window) -> bool:
        """Return whether the mean of a sum differs between two ranges of windows."""
        (steps, sums), (others, late) = before, after
        earlier = sums / steps
        change = late / others - earlier
        spread = change.std(axis=1, ddof=1) / np.sqrt(change.shape[1])
        # paths that send at the same steps: a window may end just before a send
        same = self.counted & (sums.std(axis=1) < _IN_PHASE) & (late.std(axis=1) < _IN_PHASE)
        early = same * (1 / steps + 1 / others)
        least = _DIFFERENT * spread + early + _ROUNDING_OF_MEANS * np.abs(earlier.mean(axis=1))
        return bool((np.abs(change.mean(axis=1)) > least).any())


class Snapshots:
    """States of all paths at the end of a window, which show whether their distribution still changes."""

    def __init__(self) -> None:
        """Start without states."""
        self._states: Array | None = None
        self._largest: Array | float = 0.0

    def changed(self, states: Array) -> bool:
        """Check whether the distribution of a state has changed since the last call. Store the present states."""
        # A state whose spread grows may wander without limit, and a state that has decayed has no distribution.
        before, self._states = self._states, states
        spread = states.std(axis=1)
        self._largest = np.maximum(self._largest, spread)
        if before is None:
            return True
        limit = _FAR * np.sqrt(2 / states.shape[1])
        earlier = before[:, : states.shape[1]].std(axis=1)
        settles = (spread > _GONE * self._largest) & (spread < _GROWS * earlier)
        return any(_distance(before[i], states[i]) > limit for i in np.flatnonzero(settles))


def _distance(first: Array, second: Array) -> float:
    """Return the largest distance between two distribution functions."""
    values = np.concatenate([first, second])
    one, two = (np.searchsorted(np.sort(part), values, side="right") / len(part) for part in (first, second))
    return float(np.abs(one - two).max())


def expect_numbers(loop: Loop, states: Array) -> None:
    """Raise an error if a state of a nonlinear plant has become infinite or NaN on a simulated path."""
    lost = np.flatnonzero(~np.isfinite(states).all(axis=1))
    if loop.problem.plant.function is None or not lost.size:
        return
    tick = int(lost[0])
    raise _leaves(loop, states[tick], states[tick - 1] if tick else None)


def find_loss(loop: Loop, program: Program, run: Runner, before: Array, ticks: int) -> None:
    """Raise an error if the function of a nonlinear plant has returned infinite values or NaN."""
    # One path is run again to find the step.
    rows = [i for i, state in enumerate(program.states) if state.name == "x"]
    if loop.problem.plant.function is None or not rows:
        return
    lost = np.flatnonzero(~np.isfinite(run(before, ticks, None).states[rows]).all(axis=0))
    if not lost.size:
        return
    path = before[:, [int(lost[0])]]

    def after(wanted: int) -> Array:
        return (run(path, wanted, 1).states if wanted else path)[rows, 0]

    good, bad = 0, ticks  # steps after which the state is finite, and is not
    while bad - good > 1:
        middle = (good + bad) // 2
        if np.isfinite(after(middle)).all():
            good = middle
        else:
            bad = middle
    found, last = after(bad), after(good)
    if not np.isfinite(last).all():  # in the last step before this run
        found, last = last, None
    raise _leaves(loop, found, last, [program.states[i].index for i in rows])


def _leaves(loop: Loop, found: Array, last: Array | None, entries: list[int] | None = None) -> UnstableError:
    """Return the error that names the non-finite entry of the state and the previous state."""
    place = int(np.flatnonzero(~np.isfinite(found))[0])
    entry = place if entries is None else entries[place]
    point = loop.problem.plant.operating_point
    if last is not None and point is not None:
        last = last + (point.x if entries is None else point.x[entries])
    whence = "" if last is None else f", from x = [{', '.join(f'{value:.4g}' for value in last)}]"
    named = "" if loop.names is None else loop.names.told("states", entry)
    return UnstableError(
        f"the plant's function returns no finite number as state {entry + 1}{named} in the loop of "
        f"{loop.policy.kind}{whence};"
        " expected finite numbers: send more often, clip the inputs (input_limit), or correct the function"
    )
