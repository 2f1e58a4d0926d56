"""Average cost and send rates of a closed loop, simulated on independent paths, with standard errors.

The paths are independent, so the standard error is that of the mean over paths, for any correlation in time. If the
theory has an identity for the cost, completed squares are averaged instead of stage costs:

    J = J_base + E[e'He],   e the error of the input that silence causes.

Their variance is up to thousands of times smaller. It is a difference of large numbers if J is far below J_base, so in
this case, such as a horizon over which sending every sample destabilises the loop, the first windows are also simulated
with the plain average, and the smaller standard error decides.

A loop without an identity is simulated together with the loop that sends every sample, on the same random numbers, if
the cost of the latter is known exactly (``analyse.every_sample``). The mean of the difference of their stage costs is
added to this cost. The same first windows tell the error of the plain average, which is used if it needs less work for
an error. A baseline, such as the loop that sends every sample through the same limits and losses, may run on the same
random numbers too; the excess over it then has the error of the pair (``sampling``).

A loop without a horizon is simulated in stationary operation, in windows of steps until the standard error is reached
(``sampling``); over a horizon, runs are repeated. Two loops are compared with the same noise on each path, so that
common variations cancel. ``reliability`` adds the reasons why a result may not be an average.

Source: khashooei2017
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from taciturn._arrays import count, instance, number
from taciturn._progress import OutOfTime, Progress, in_notebook
from taciturn.analyse.every_sample import BASELINE, MORE, OVER, join, with_every_sample
from taciturn.errors import ProblemError, UnstableError
from taciturn.loop import COST, EXCESS, Loop
from taciturn.model.estimate import Estimate
from taciturn.program.draws import with_controls, with_draws
from taciturn.simulation.reliability import (
    doubt_errors,
    doubt_moments,
    doubt_tail,
    drifts_of,
    expect_arrivals,
    find_doubts,
)
from taciturn.simulation.sampling import (
    SETTLING_CONSTANTS,
    SHORTEST_BURN_IN,
    Averages,
    Estimator,
    Part,
    Sampling,
    counts,
    last_of,
    paths_of,
)

_LEAST_STEPS, _MOST_STEPS = 1024, 1e13  # the largest number takes hours
_WINDOWS = 3  # least run in units of the burn-in: the burn-in itself, and two windows that are compared
_PER_STEP = 0.05  # counted work per operation of a program in a step, since many run in parallel
_TO_START = 1.2e7  # counted work to build and compile a program
_LEAN = 60  # operations of a small program
_CANCELS = 0.5  # share of an identity's constant below which the cost is a difference of larger numbers
AVERAGED = {EXCESS: "completed squares", MORE: "difference to every sample", COST: "plain average"}
_BOTH = 2.0  # largest ratio of the work of a loop and the one that sends every sample, and of the loop alone
_DIGITS = 1e-12  # rounding error of such a difference, relative to the constant


def average(
    loop: Loop,
    estimator: Estimator | None = None,
    *,
    seed: int = 0,
    standard_error: float | None = None,
    steps: int | None = None,
    progress: Progress | None = None,
    threads: int | None = None,
    baseline: Loop | None = None,
) -> Averages:
    """Estimate average cost and send rates of a loop, in stationary operation or over a finite horizon.

    The paths are independent, so the standard error is that of the mean over paths, for any correlation in time. Steps
    are dropped until the initial transient has decayed: at least twelve time constants of the slowest mode and eight
    mean intervals between sends, and until nearly every path has sent. Windows of steps that differ from the later ones
    are also dropped.

    Args:
        loop: the closed loop.
        estimator: estimator of the cost; default: the best that is valid.
        seed: seed of the random draws; the result depends on nothing else.
        standard_error: absolute standard error of the cost; default: 1e-4 of the cost.
        steps: total number of steps to simulate, over all paths, instead of a standard error.
        progress: callback that receives the fraction done.
        threads: number of threads, at least 1; default: all processors.
        baseline: another loop, such as one that sends every sample, that runs on the same random numbers; the
            ``excess`` of the result over it has the standard error of this pair.

    Returns:
        Cost and rates, per second for a continuous plant and per step for a discrete one, as in ``evaluate``;
        ``rate_unit`` is the unit. ``reached`` is False if the budget was used up before the requested standard error
        was reached or before the loop had settled. ``notes`` give reasons why the number may not be an average.

    Raises:
        ProblemError: a budget, a standard error or a number of threads is not positive.
        UnstableError: the loop diverges, or a link drops every packet and the plant does not come to rest by itself.
    """
    told = in_notebook(progress)
    return _per_unit(loop, Averaging(loop, estimator, seed, standard_error, steps, told, threads, baseline).finish())


def difference(
    first: Loop,
    second: Loop,
    *,
    seed: int = 0,
    standard_error: float | None = None,
    steps: int | None = None,
    progress: Progress | None = None,
    threads: int | None = None,
) -> Averages:
    """Estimate by how much cost and send rates of two loops differ, simulated with the same noise.

    Each path has the same noise in both loops, so common variations cancel before averaging, and the standard error is
    that of the difference. Both costs are computed from completed squares if both loops have a cost identity; otherwise
    both are plain averages.

    Args:
        first: first loop.
        second: second loop, whose cost and rates are subtracted.
        seed: seed of the random draws.
        standard_error: absolute standard error of the difference of the costs; default: 1e-4 of the first cost.
        steps: total number of steps to simulate, over all paths of both loops, instead of a standard error.
        progress: callback that receives the fraction done.
        threads: number of threads, at least 1; default: all processors.

    Returns:
        Cost and rates of the first loop minus those of the second; a link that only one loop has counts as silent in
        the other.

    Raises:
        ProblemError: the steps, horizons or discounts differ, or as for ``average``.
        UnstableError: a loop diverges.

    Example:
        >>> from taciturn import Cost, Plant, close, design
        >>> plant, cost = Plant([[0.9]], [[1.0]], [[1.0]]), Cost([[1.0]], [[0.1]])
        >>> loops = [close(plant, design.lqg(plant, cost, theta=theta)) for theta in (0.2, 0.21)]
        >>> found = difference(*loops, steps=200_000)
        >>> found.cost.value < 0 < found.rates["actuator"].value
        True
    """
    instance("first", first, Loop)
    instance("second", second, Loop)
    for name, values in {
        "period": (first.problem.tick, second.problem.tick),
        "horizon": (first.horizon, second.horizon),
        "discount": (first.problem.cost.discount, second.problem.cost.discount),
    }.items():
        if values[0] != values[1]:
            raise ProblemError(
                f"{name} is {values[0]} in one loop and {values[1]} in the other; expected equal values for a "
                "comparison step by step"
            )
    loops = (first, second)
    if all(loop.identity is not None for loop in loops):
        reduced = all(loop.reducible for loop in loops)
        estimators = [completed_squares(loop, reduced) for loop in loops]
    else:
        estimators = [plain_average(loop) for loop in loops]
    parts = [Part(loop, estimator, sign) for loop, estimator, sign in zip(loops, estimators, (1.0, -1.0), strict=True)]
    return _per_unit(
        first, _judged(parts, last_of(_answers(parts, seed, standard_error, steps, progress, threads), None))
    )


class Averaging:
    """Simulation of a loop that can be stopped. After its first steps, it predicts how much computation remains."""

    def __init__(
        self,
        loop: Loop,
        estimator: Estimator | None = None,
        seed: int = 0,
        standard_error: float | None = None,
        steps: int | None = None,
        progress: Progress | None = None,
        threads: int | None = None,
        baseline: Loop | None = None,
    ) -> None:
        """Choose the estimator; nothing is run yet."""
        instance("loop", loop, Loop)
        if estimator is not None:
            instance("estimator", estimator, Estimator)
        self.loop, self.chosen, self.baseline = loop, estimator is not None, baseline
        self.effort = seed, standard_error, steps, progress, threads
        self._use(estimator or choose_estimator(loop, baseline))
        self.first: Averages | None = None
        self.failed: UnstableError | OutOfTime | None = None

    def predict(self, standard_error: float) -> float:
        """Simulate the first windows of steps, and return about how many operations remain."""
        # The number is infinite if the loop is unstable.
        self._begin()
        if isinstance(self.failed, OutOfTime):
            raise self.failed
        if self.first is None:
            return float("inf")
        # the squared standard error falls as 1/steps; half of the steps seen so far are the burn-in
        seen = self.first.steps / 2
        missing = seen * (self.first.cost.standard_error / standard_error) ** 2
        return _PER_STEP * self.estimator.program.operations * max(missing - seen, seen)

    def finish(self) -> Averages:
        """Continue the simulation to its end, and return what the function :func:`average` returns."""
        self._begin()
        if self.failed is not None:
            raise self.failed
        return _judged(self.parts, last_of(self.answers, self.first))

    def _use(self, estimator: Estimator) -> None:
        """Prepare a simulation with an estimator."""
        self.estimator = estimator
        self.parts = [Part(self.loop, estimator)]
        self.answers: Iterator[Averages] = _answers(self.parts, *self.effort)

    def _begin(self) -> None:
        """Simulate the first windows, unless this is done, and choose the estimator with the smaller error."""
        if self.first is not None or self.failed is not None:
            return
        try:
            self.first = next(self.answers)
        except (UnstableError, OutOfTime) as error:
            self.failed = error
            return
        estimator, answers, found = self.estimator, self.answers, self.first
        if not self.chosen and found.plain_error is not None:
            self._without_difference(found.cost.standard_error, found.plain_error)
        if self.chosen or estimator.sum != EXCESS or found.cost.value > _CANCELS * estimator.offset:
            return
        with suppress(UnstableError, OutOfTime):
            self._use(plain_average(self.loop))
            self.first = next(self.answers)
        error = float(np.hypot(found.cost.standard_error, _DIGITS * estimator.offset))
        if self.first is found or self.first.cost.standard_error > error:
            self.estimator, self.answers, self.first = estimator, answers, found
            self.parts = [Part(self.loop, estimator)]

    def _without_difference(self, error: float, plain_error: float) -> None:
        """Choose the plain average and simulate its first windows, if it needs less work for an error."""
        if plain_error**2 >= _BOTH * error**2:
            return
        plain, before = plain_average(self.loop, self.baseline), (self.estimator, self.parts, self.answers)
        if plain.program.operations * plain_error**2 < self.estimator.program.operations * error**2:
            try:
                self._use(plain)
                self.first = next(self.answers)
            except (UnstableError, OutOfTime):
                self.estimator, self.parts, self.answers = before


def _answers(
    parts: Sequence[Part],
    seed: int,
    standard_error: float | None,
    steps: int | None,
    progress: Progress | None,
    threads: int | None,
) -> Iterator[Averages]:
    """Return an iterator over successively better answers."""
    check_effort(seed, standard_error, steps)
    if threads is not None:
        count("threads", threads)
    sampling, horizon = Sampling(parts, seed, progress, threads), parts[0].loop.horizon
    if horizon is not None:
        return sampling.missions(horizon, standard_error, steps)
    for part in parts:
        expect_arrivals(part.loop)
    return sampling.stationary(standard_error, steps)


def check_effort(seed: int, standard_error: float | None, steps: int | None) -> None:
    """Raise an error if the seed, the standard error or the number of steps of a simulation is invalid."""
    count("seed", seed, 0)
    if standard_error is not None and steps is not None:
        raise ProblemError("standard_error and steps are both given; expected one of them")
    if standard_error is not None:
        number("standard_error", standard_error, 0.0)
    if steps is not None:
        number("steps", count("steps", steps, _LEAST_STEPS), high=_MOST_STEPS)


def _judged(parts: Sequence[Part], found: Averages) -> Averages:
    """Add the name of the estimator and the reasons for doubt to averages."""
    found, loop = replace(found, estimator=AVERAGED[parts[0].estimator.sum]), parts[0].loop
    if len(parts) > 1:
        return found
    if mute := {link for link, rate in found.rates.items() if rate.value == 0} and loop.mute:
        found = replace(found, rates={**found.rates, **{link: Estimate(0.0, 0.0, "exact") for link in mute}})
    # completed squares are bounded if they are those of a decision and not of the input that is applied
    identity, lossy = loop.identity, any(loop.network.loss(link) > 0 for link in loop.network.links)
    unbounded = parts[0].estimator.sum != EXCESS or (identity is not None and identity.on is None and lossy)
    notes = doubt_moments(loop) if unbounded or (loop.policy.theory.fourth or 0.0) >= 1 else ()
    notes = notes or doubt_tail(found.tail)
    if loop.horizon is not None:
        return replace(found, notes=notes + doubt_errors(found.cost, found.steps), trusted=not notes)
    if drifts_of(loop):
        found = replace(found, settled=False, reached=False)
    more = find_doubts(loop, found.cost, found.rates, found.steps, found.settled)
    return replace(found, notes=notes + more, trusted=not notes)


def _per_unit(loop: Loop, found: Averages) -> Averages:
    """Return averages with rates per second if the plant is continuous."""
    if loop.problem.cost.mission or not loop.problem.sampled:
        return found
    pace = base_rate(loop)
    rates = {link: rate.scaled(pace) for link, rate in found.rates.items()}
    return replace(found, rates=rates, rate_unit="second")


def base_rate(loop: Loop) -> float:
    """Return the rate of sending every sample, per second or per step. It is 1 for a finite horizon."""
    return 1.0 if loop.problem.cost.mission else 1 / loop.policy.tick


def least_work(loop: Loop) -> float:
    """Return how many operations ``average`` needs, at least, until a loop is in stationary operation."""
    least = max(SHORTEST_BURN_IN, int(SETTLING_CONSTANTS * loop.policy.theory.settling))
    return _TO_START + _PER_STEP * _LEAN * _WINDOWS * least * paths_of(loop, least)


def choose_estimator(loop: Loop, baseline: Loop | None = None) -> Estimator:
    """Choose how to estimate a loop's cost: completed squares, difference to every sample, or plain average."""
    if loop.identity is not None:
        return completed_squares(loop)
    return difference_to_every_sample(loop, baseline) or plain_average(loop, baseline)


def difference_to_every_sample(loop: Loop, baseline: Loop | None = None) -> Estimator | None:
    """Return the cost estimator J = J_every + E[difference of the stage costs], or None if J_every is not known.

    Source: henderson2002
    """
    both, problem = with_every_sample(loop, baseline), loop.problem
    if both is None:
        return None
    lean = both.program.keep({MORE, COST, *counts(loop), *([] if baseline is None else [OVER])})
    return Estimator(lean, both.program, MORE, problem.per_unit(both.cost), 1.0 / problem.tick, both.settling)


def completed_squares(loop: Loop, reduced: bool | None = None) -> Estimator:
    """Return the cost estimator J = J_all + E[completed square], driven by innovations if this is valid.

    Args:
        loop: the closed loop.
        reduced: whether to use the innovations form; default: if it is valid.

    Raises:
        ProblemError: the policy has no cost identity, or the plant is not the one of its design.

    Source: khashooei2017
    """
    identity = loop.identity
    if identity is None:
        raise ProblemError(
            "completion of squares does not apply to this loop; expected the plant and network of the design and a "
            "policy with a cost identity, or the sample average of the cost"
        )
    reduced = loop.reducible if reduced is None else reduced
    program = loop.reduced_program() if reduced else loop.program()
    lean = program.keep({EXCESS, *counts(loop)})
    return Estimator(lean, program, EXCESS, identity.constant, 1.0)


def plain_average(loop: Loop, baseline: Loop | None = None) -> Estimator:
    """Return the cost estimator that averages the stage cost over the steps of a loop."""
    final = {"x"} if loop.problem.cost.terminal is not None else frozenset[str]()
    both = final if baseline is None else {*final, *map(BASELINE.format, final)}
    problem = loop.problem
    program = with_draws(join(with_controls(loop.whole_program()), baseline, final))
    lean = program.keep({COST, *counts(loop), *([] if baseline is None else [OVER])}, states=both)
    if loop.horizon is None:
        return Estimator(lean, program, COST, problem.noise_cost / problem.tick, 1.0 / problem.tick)
    alpha = problem.cost.discount
    ticks = loop.horizon if alpha == 1 else (1 - alpha**loop.horizon) / (1 - alpha)
    return Estimator(lean, None, COST, problem.noise_cost * ticks, 1.0)
