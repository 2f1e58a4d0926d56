"""Probabilities that a loop's states violate limits, by a simulation that copies paths close to the limits.

In stationary operation, the probability per step is the share of the steps in which a limit is violated. The
probability within a window is that of at least one violation in the window, such as an hour. A window is simulated if
it is short; otherwise the probability without a violation decays by the same factor in each later part of it.

The height of a path is the largest distance beyond a limit, in standard deviations. Paths are copied when they rise
above thresholds of the height (``splitting``). Thresholds are placed one after the other while the simulation
continues, each so that one path in four above the last threshold exceeds it: with four copies of each such path, the
number of paths at each level is about the same.

Standard errors come from sums over an original path and all its copies, which are independent of the others.

Source: villen2002
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Array, Bits, Progress, Stages, closure, in_notebook, instance, number_of
from taciturn.loop import COST, Loop
from taciturn.model.estimate import Estimate
from taciturn.model.limits import Limits, Violation, Violations
from taciturn.program.draws import GENERATOR
from taciturn.simulation.average import check_effort, plain_average
from taciturn.simulation.reliability import escapes, expect_arrivals, wandering_noise
from taciturn.simulation.sampling import HUGE, Estimator, Part, Sampling, counts
from taciturn_rare.splitting import COPIES, Splitting

_MOST_LEVELS = 12  # the highest threshold is exceeded in at least 4^-12 = 6e-8 of the steps, about
_ACCURACY = 0.05  # default standard error, relative to the probability per step
_ORIGINALS = 1024  # paths that are no copies
_SETTLING = 512  # paths, at least, on which it is decided that the loop has settled
_MOST_STEPS = 20_000_000  # of all paths, for each limit
_TO_SETTLE = 1_000_000_000  # steps of all paths until the loop is in stationary operation, at most
_OFTEN = 0.01  # share of the steps with a violation, above which no path is copied
_LEVELS = 8  # levels for which the number of paths is chosen
_SEEN = 30  # paths without common history that see a violation, at least, before a standard error is believed
_STAGE, _LONGEST_STAGE = 32, 256  # least and most steps before the next threshold is placed
_SHORTEST_WINDOW, _CONSTANTS = 64, 6  # half of a window: at least so many steps, and so many time constants
_HOUR, _MANY = 3600.0, 1000  # seconds of a window, and its steps if the step has no length
_GROWN, _QUARTILES = 7.0, 1.65  # standard errors of a ratio of spreads that are growth; one is 1.65/√paths


def violations(
    loop: Loop,
    limits: Limits,
    *,
    seed: int = 0,
    accuracy: float = _ACCURACY,
    steps: int | None = None,
    progress: Progress | None = None,
) -> Violations:
    """Estimate the probabilities that the states of a loop violate limits, which are checked after each step.

    If violations are rare, paths that come near a limit are copied, once for all limits together and
    once for each limit that then has too few violations. Limits of a continuous plant apply at the sampling instants. A
    window of an hour is simulated if it is short. Otherwise, the probability without a violation decays by the same
    factor in each half of the simulated window after the first.

    Args:
        loop: the closed loop.
        limits: the limits; missing columns, those of disturbances, are zero.
        seed: seed of the random draws.
        accuracy: standard error relative to the probability per step.
        steps: largest number of steps of all paths, for each of these simulations.
        progress: callback that receives the fraction done.

    Returns:
        The probabilities, each with its standard error. For a finite horizon, the window is a run.

    Raises:
        ProblemError: the states have no stationary distribution, or the cost has a discount.
        UnstableError: the loop diverges.
        OutOfTime: the time limit has passed.

    Source: villen2002

    Example:
        >>> from taciturn import Cost, Plant, close, design
        >>> plant, cost = Plant([[0.9]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
        >>> loop = close(plant, design.lqg(plant, cost, theta=0.5))
        >>> found = violations(loop, Limits([[1.0]], high=[5.0]), accuracy=0.3)
        >>> found.total.levels > 2, 0 < found.total.per_step.value < 1e-3
        (True, True)
    """
    instance("loop", loop, Loop)
    instance("limits", limits, Limits)
    check_effort(seed, None, steps)
    search = _Search(loop, limits, seed, accuracy, steps or _MOST_STEPS, Stages(in_notebook(progress)))
    every = list(range(len(limits.low)))
    *each, total = search.measured(every, 0.0)
    for i in every if len(every) > 1 else ():
        if not search.precise(each[i].per_step):
            each[i] = search.measured([i], (i + 1) / (len(every) + 1))[i]
    return Violations(limits.names, tuple(each), total, search.window)


class _Search:
    """Simulations of a loop for its limits."""

    def __init__(self, loop: Loop, limits: Limits, seed: int, accuracy: float, budget: int, progress: Stages) -> None:
        """Bring the loop to stationary operation."""
        self.loop, self.seed, self.accuracy, self.budget, self.progress = loop, seed, accuracy, budget, progress
        plant, rows = loop.problem.plant, limits.outputs
        if rows.shape[1] > plant.states:
            limits.expect_states(plant.states)
        self.rows: Array = np.pad(rows, ((0, 0), (0, plant.states - rows.shape[1])))
        point = plant.operating_point  # from which the loop counts its states
        rest = np.zeros(plant.states) if point is None else np.pad(point.x, (0, plant.states - len(point.x)))
        self.offset: Array = (self.rows @ rest)[:, None]
        self.limits, self.horizon = limits, loop.problem.cost.horizon
        if loop.problem.cost.discount < 1:
            raise ProblemError(
                "limits are given with cost.discount, but the weights of a discounted sum do not measure a share of "
                "the time; expected an average cost or a horizon"
            )
        average = plain_average(loop)
        program = loop.program().keep({COST, *counts(loop)}, states={"x"})
        self.part = Part(loop, Estimator(program, None, COST, average.offset, average.scale))
        self.program, self.sampling = program, Sampling([self.part], seed, progress, None)
        self.run, self.fresh = self.sampling.runs[0], 0
        cycle, settling = loop.policy.cycle, self.part.settling
        half = max(_SHORTEST_WINDOW, int(_CONSTANTS * settling))
        self.half = -(-half // cycle) * cycle
        self.stage = int(np.clip(settling / 4, _STAGE, _LONGEST_STAGE))
        paths = int(np.clip(budget // (2 * self.half * _LEVELS), 64, _ORIGINALS))
        self.settled = self._begun(paths) if self.horizon else self._stationary(paths)
        self.deviation = self._deviation()

    @property
    def window(self) -> str:
        """Time window in which violations are counted: a run, an hour, or a number of steps."""
        if self.horizon is not None:
            return "run"
        return f"{_MANY} steps" if self.loop.problem.plant.dt is None else "hour"

    @property
    def ticks(self) -> int:
        """Steps of the window."""
        if self.horizon is not None:
            return self.horizon
        step = self.loop.problem.plant.dt
        return _MANY if step is None else max(1, round(_HOUR / step))

    def precise(self, found: Estimate) -> bool:
        """Return whether an estimated probability has the requested standard error."""
        return 0 < found.standard_error <= self.accuracy * found.value

    def measured(self, picked: Sequence[int], begun: float) -> list[Violation]:
        """Estimate how probable a violation of each limit is, and a violation of at least one limit."""
        split = Splitting(
            self.program, self.run, self.settled, self.seed, lambda x: self._excess(x)[picked].max(axis=0)
        )
        self._place(split)
        parts, length = (1, self.ticks) if self.ticks <= 2 * self.half else (2, self.half)
        events = len(self.limits.low) + 1
        first, shares = np.zeros((parts, events, split.originals)), np.zeros((events, split.originals))
        before, windows, split.steps, near = self._spread(split), 0, 0, 0.0
        told = self.progress.stage(begun, begun + 1 / events)
        while True:
            if self.horizon is not None:
                split.restart(self._begun(split.originals))
            split.mark(events)
            for part in range(parts):
                for _ in range(length):
                    self._count(split, first[part], shares)
                    near += split.near
                    told(max(told.at, split.steps / self.budget))
            windows += 1
            if self.horizon is None and windows == 1:
                self._expect_rest(before, self._spread(split), (1 + parts) * length, split.originals)
            steps = windows * parts * length
            found = [
                self._violation(share, hits, steps, windows, near / steps, len(split.thresholds))
                for share, hits in zip(shares, first.swapaxes(0, 1), strict=True)
            ]
            sought = found[-1 if len(picked) > 1 else picked[0]].per_step
            if self.precise(sought) or split.steps * (1 + 1 / windows) > self.budget:
                return found

    def _violation(self, shares: Array, hits: Array, steps: int, windows: int, near: float, levels: int) -> Violation:
        """Return a probability from sums over steps and windows."""
        # A standard error is at least that of one event, and at least the share of time above the highest threshold if
        # few paths have seen a violation.
        least = float(COPIES) ** -levels / len(shares)
        few = np.count_nonzero(shares) < _SEEN
        unseen = near if few else 0.0
        per_step = _mean(shares / steps, max(least / steps, unseen))
        length = steps // windows // len(hits)
        within = self._within(hits / windows, length, max(least / windows, min(self.ticks * unseen, 1.0)))
        return Violation(per_step, within, levels)

    def _count(self, split: Splitting, first: Array, shares: Array) -> None:
        """Advance all paths by one step, and count the violations and the first violations of each path."""
        split.step()
        if not np.abs(split.heights).max() < HUGE:  # also if it is NaN
            raise self.part.diverges("a state exceeded the range of double precision")
        over = self._excess(split.x) > 0
        events = np.concatenate([over, over.any(axis=0, keepdims=True)])
        for i in np.flatnonzero(events.any(axis=1)):
            shares[i] += split.sums(events[i])
            first[i] += split.sums(events[i] & ~split.marks[i])
        split.marks |= events

    def _place(self, split: Splitting) -> None:
        """Place thresholds, each of which one path in ``COPIES`` above the last one exceeds."""
        for _ in range(_MOST_LEVELS):
            if self.horizon is not None:
                split.restart(self._begun(split.originals))
            heights = list[Array]()
            for _ in range(self.horizon or self.stage):
                split.step()
                heights.append(split.top)
                self.progress.tick()
            reached = np.concatenate(heights)
            threshold = float(np.quantile(reached, 1 - 1 / COPIES)) if reached.size else 0.0
            often = not len(split.thresholds) and (reached > 0).mean() > _OFTEN
            if often or not threshold < 0:
                return
            split.add(threshold)

    def _within(self, hits: Array, length: int, least: float) -> Estimate:
        """Return the probability of a violation within the window, from the first violations in its parts."""
        means = hits.mean(axis=1)
        if len(hits) == 1:
            return _mean(hits[0], least)
        # Let p and q be the probabilities of a first violation in the two parts. No violation occurs in the first part
        # with the probability 1 − p, and in each later one given none before with (1 − p − q)/(1 − p). So with r later
        # parts (``late``) the logarithm of the survival is (1 − r) log(1 − p) + r log(1 − p − q).
        late = float(self.ticks - length) / length
        survive = 1 - np.cumsum(means)
        if not survive[1] > least:
            return Estimate(1.0, 1 / hits.shape[1], "simulation")
        logarithm = (1 - late) * float(np.log1p(-means[0])) + late * float(np.log1p(-means.sum()))
        kept = float(np.exp(logarithm))
        # the standard error follows from the derivatives of this logarithm with respect to p and q
        slopes = np.array([(1 - late) / survive[0] + late / survive[1], late / survive[1]])
        spread = float(np.sqrt(max(slopes @ np.cov(hits) @ slopes, 0.0) / hits.shape[1]))
        return Estimate(0.0 - float(np.expm1(logarithm)), max(kept * spread, least), "simulation")

    def _excess(self, x: Array) -> Array:
        """Return the excess of each combination over its limits, in standard deviations; negative within the limits."""
        z, high, low = self.rows @ x + self.offset, self.limits.high[:, None], self.limits.low[:, None]
        return np.maximum(z - high, low - z) / self.deviation

    def _states(self, states: Array) -> Array:
        return states[[i for i, state in enumerate(self.program.states) if state.name == "x"]]

    def _begun(self, paths: int) -> Array:
        """Return new paths at the start of a run."""
        self.fresh += paths
        return self.loop.start(self.program, paths, self.seed, self.fresh - paths)

    def _stationary(self, paths: int) -> Array:
        """Return paths in stationary operation."""
        if not any(state.name == GENERATOR for state in self.program.states):
            raise ProblemError(
                "nothing in the loop is random, so its states have no distribution; expected noise W or V, or a horizon"
            )
        if escapes(self.loop):
            raise ProblemError(
                "the plant is unstable and its inputs are limited, so its states have no stationary distribution: "
                "the noise eventually drives them to a point from which no input returns them; expected a horizon"
            )
        for i in np.flatnonzero(self._wanders()):
            raise self._wandering(self.limits.names[i], "it follows a disturbance that wanders without limit")
        expect_arrivals(self.loop)
        (states,), history, settled = self.sampling.settle(max(paths, _SETTLING), _TO_SETTLE, self._moments)
        if not settled:
            raise ProblemError(
                f"the loop has not settled within {number_of(history.steps, 'step')}, so no stationary distribution "
                "of its states is known; expected a loop that settles sooner, or a horizon"
            )
        return states[:, :paths]

    def _moments(self, states: Array) -> Array:
        """Return the limited combinations and their squares on each path, whose means have to settle."""
        z = self.rows @ self._states(states)
        return np.vstack([z, z**2])

    def _deviation(self) -> Array:
        """Return the standard deviation of each combination, (limits, 1); 1 if it does not vary."""
        states = self.run(self.settled, self.horizon, None).states if self.horizon else self.settled
        found = (self.rows @ self._states(states)).std(axis=1)
        return np.where(found > 0, found, 1.0)[:, None]

    def _spread(self, split: Splitting) -> Array:
        """Return the distance between the quartiles of each combination, over the paths that are no copies."""
        low, high = np.quantile(self.rows @ split.x[:, split.original], (0.25, 0.75), axis=1)
        return high - low

    def _expect_rest(self, before: Array, after: Array, steps: int, originals: int) -> None:
        """Raise a ``ProblemError`` if the spread of a combination still grows."""
        grown = np.exp(_GROWN * _QUARTILES / np.sqrt(originals))
        for i in np.flatnonzero(after > grown * np.maximum(before, 1e-300)):
            raise self._wandering(
                self.limits.names[i],
                f"its spread grows by a factor of {after[i] / before[i]:.3g} in {number_of(steps, 'step')}",
            )

    def _wandering(self, name: str, why: str) -> ProblemError:
        return ProblemError(
            f"the state in the limit {name} has no stationary distribution: {why}; expected limits of states that "
            "return, or a horizon"
        )

    def _wanders(self) -> Bits:
        """Return the limits of combinations that follow a disturbance or another state that wanders without limit."""
        problem, noise = self.loop.problem, wandering_noise(self.loop)
        if problem.followed is not None:
            rows = problem.followed.outputs(self.rows)
            return np.array([problem.followed.wanders(row[None], noise) for row in rows])
        links = np.asarray(problem.plant.A != 0, dtype=np.bool_)
        wandering = closure(problem.lasting & closure(np.diag(noise) > 0, links), links)
        return np.asarray(self.rows[:, wandering].any(axis=1), dtype=np.bool_)


def _mean(values: Array, least: float) -> Estimate:
    """Return the mean over paths, with a standard error of at least that of one event."""
    error = float(values.std(ddof=1) / np.sqrt(len(values)))
    return Estimate(float(values.mean()), max(error, least), "simulation")
