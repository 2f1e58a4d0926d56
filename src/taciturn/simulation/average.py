"""Cost and rates by simulation, with standard errors: independent paths, a burn-in, as many ticks as needed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from taciturn._arrays import count, instance, number
from taciturn._progress import OutOfTime, Progress
from taciturn.errors import ProblemError, UnstableError
from taciturn.loop import COST, EXCESS, Loop
from taciturn.simulation.doubts import doubt_moments, doubt_tail, expect_arrivals, find_doubts
from taciturn.simulation.parts import Estimator, Part, sends
from taciturn.simulation.sampling import (
    BURN_IN,
    PATHS,
    SETTLE,
    Averages,
    Sampling,
    last_of,
)

LEAST_STEPS = 1024
WINDOWS = 3  # times the burn-in, at least: itself, and two windows that are compared
PER_STEP = 0.05  # operations of work that one of a program takes in a step: many run at once
TO_START = 1.2e7  # operations of work to write a program and to prepare it
LEAN = 60  # operations of a small program


def completed_squares(loop: Loop, reduced: bool | None = None) -> Estimator:
    """Return the estimator J = J_all + E[completed square], in the innovations form where that holds.

    Args:
        loop: the closed loop.
        reduced: whether in that form; omitted: where it holds.

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
    reduced = loop.reducible if reduced is None else reduced
    program = loop.reduced_program() if reduced else loop.program()
    lean = program.keep({EXCESS, *sends(loop)})
    return Estimator(lean, program, EXCESS, identity.constant, 1.0)


def plain_average(loop: Loop) -> Estimator:
    """Return the estimator that averages the stage cost of the loop with its plant."""
    final = {"x"} if loop.problem.cost.terminal is not None else frozenset[str]()
    problem, program = loop.problem, loop.program()
    lean = program.keep({COST, *sends(loop)}, states=final)
    if loop.horizon is None:
        return Estimator(lean, program, COST, problem.noise_cost / problem.tick, 1.0 / problem.tick)
    alpha = problem.cost.discount
    ticks = loop.horizon if alpha == 1 else (1 - alpha**loop.horizon) / (1 - alpha)
    return Estimator(lean, None, COST, problem.noise_cost * ticks, 1.0)


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
        Cost and rates; rates are sends per tick, also of a sampled plant, whose cost is per second (``evaluate`` has
        both per second). ``reached`` is False where the budget ended first: before the asked standard error, or before
        the loop had time to settle; ``notes`` say where the number may be no average.

    Raises:
        ProblemError: a budget, precision or number of threads that is not positive.
        UnstableError: the loop diverges, or a link loses every packet and the plant does not come to rest by itself.
    """
    return Averaging(loop, estimator, seed, standard_error, steps, progress, threads).finish()


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
    """Estimate how much more one loop costs and sends than another, on the same draws.

    Both loops see the same noise path by path, so what they share cancels before it is averaged: the standard error is
    that of the difference. Both costs are completed squares where both have an identity, else both plain averages.

    Args:
        first: the loop.
        second: what is subtracted.
        seed: of the draws.
        standard_error: absolute, of the difference of the costs; omitted: 1e-4 of the first one's cost.
        steps: run this many steps of all paths of both loops together instead.
        progress: called with the fraction done.
        threads: at least 1; omitted: all processors.

    Returns:
        Cost and rates of the first less those of the second; a link that only one of them has counts as silent in the
        other.

    Raises:
        ProblemError: ticks, horizons or discounts differ; or as ``average``.
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
                f"{name} is {values[0]} in one loop and {values[1]} in the other; expected the same, to compare them "
                "tick by tick"
            )
    loops = (first, second)
    if all(loop.identity is not None for loop in loops):
        reduced = all(loop.reducible for loop in loops)
        estimators = [completed_squares(loop, reduced) for loop in loops]
    else:
        estimators = [plain_average(loop) for loop in loops]
    parts = [Part(loop, estimator, sign) for loop, estimator, sign in zip(loops, estimators, (1.0, -1.0), strict=True)]
    return _judged(parts, last_of(_answers(parts, seed, standard_error, steps, progress, threads), None))


def least_work(loop: Loop) -> float:
    """Return how many operations ``average`` takes at least to settle, whatever the loop's program is."""
    least = max(BURN_IN, int(SETTLE * loop.policy.settling))
    return TO_START + PER_STEP * LEAN * WINDOWS * least * PATHS


class Averaging:
    """A simulation that predicts from its first windows how much work is left, and continues from them.

    Args:
        loop: the closed loop.
        estimator: omitted: the best that holds.
        seed: of the draws.
        standard_error: absolute, of the cost; omitted: 1e-4 of the cost.
        steps: run this many steps of all paths together instead.
        progress: called with the fraction done.
        threads: at least 1; omitted: all processors.

    Raises:
        ProblemError: as ``average``.

    Example:
        >>> from taciturn import load
        >>> problem = load("two-mass")
        >>> loop = problem.close(problem.design())
        >>> rough, fine = (Averaging(loop, standard_error=error) for error in (1e-3, 1e-5))
        >>> rough.predict(1e-3) < fine.predict(1e-5)
        True
        >>> rough.finish() == average(loop, standard_error=1e-3)
        True
    """

    def __init__(
        self,
        loop: Loop,
        estimator: Estimator | None = None,
        seed: int = 0,
        standard_error: float | None = None,
        steps: int | None = None,
        progress: Progress | None = None,
        threads: int | None = None,
    ) -> None:
        """Choose the estimator, and run nothing yet."""
        instance("loop", loop, Loop)
        if estimator is not None:
            instance("estimator", estimator, Estimator)
        self.estimator = estimator or choose_estimator(loop)
        self.parts = [Part(loop, self.estimator)]
        self.answers = _answers(self.parts, seed, standard_error, steps, progress, threads)
        self.first: Averages | None = None
        self.failed: UnstableError | OutOfTime | None = None

    def predict(self, standard_error: float) -> float:
        """Return about how many operations are left after the first windows, which are run; infinite if unstable.

        Args:
            standard_error: absolute, of the cost.

        Raises:
            OutOfTime: the time limit has passed.
        """
        if self.first is None and self.failed is None:
            try:
                self.first = next(self.answers)
            except (UnstableError, OutOfTime) as error:
                self.failed = error
        if isinstance(self.failed, OutOfTime):
            raise self.failed
        if self.first is None:
            return float("inf")
        seen = self.first.steps / 2  # the other half is the burn-in
        missing = seen * (self.first.cost.standard_error / standard_error) ** 2
        return PER_STEP * self.estimator.program.operations * max(missing - seen, seen)

    def finish(self) -> Averages:
        """Return what ``average`` does.

        Raises:
            UnstableError: the loop diverges.
            OutOfTime: before there was any answer.
        """
        if self.failed is not None:
            raise self.failed
        return _judged(self.parts, last_of(self.answers, self.first))


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


def _answers(
    parts: Sequence[Part],
    seed: int,
    standard_error: float | None,
    steps: int | None,
    progress: Progress | None,
    threads: int | None,
) -> Iterator[Averages]:
    """Return ever better answers, none of which is computed yet."""
    check_effort(seed, standard_error, steps)
    if threads is not None:
        count("threads", threads)
    sampling, horizon = Sampling(parts, seed, progress, threads), parts[0].loop.horizon
    if horizon is not None:
        return sampling.missions(horizon, standard_error, steps)
    for part in parts:
        expect_arrivals(part.loop)
    return sampling.stationary(standard_error, steps)


def _judged(parts: Sequence[Part], found: Averages) -> Averages:
    """Return averages with what was averaged, and what makes them doubtful."""
    used = "completed squares" if parts[0].estimator.sum == EXCESS else "plain average"
    found, loop = replace(found, estimator=used), parts[0].loop
    if len(parts) > 1:
        return found
    if loop.horizon is not None:
        return replace(found, notes=doubt_tail(found.tail))
    notes = (
        doubt_moments(loop) if parts[0].estimator.sum == COST else ()
    )  # the terms of a square are bounded, or nothing is lost
    notes = notes or doubt_tail(found.tail)
    return replace(found, notes=notes + find_doubts(loop, found.cost, found.rates, found.steps, found.settled))
