"""Rate and cost of a chain with Gaussian noise in any dimension: never-die paths and randomised quasi-Monte Carlo."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, count, frozen, number
from taciturn._progress import OutOfTime, Progress, Stages
from taciturn.model.estimate import Estimate
from taciturn.renewal._walk import Course, Walk, follow
from taciturn.renewal._whiten import reduced
from taciturn.renewal.chain import Chain, Intervals
from taciturn.renewal.rates import least_interval

RANDOMISATIONS = 16  # at a time: their spread is known to a fifth
FIRST, LARGEST = 1 << 10, 1 << 16  # paths of each
CUT = 0.01  # of the accuracy: what the geometric tail may be of an interval
USUAL = 50_000_000
SHORT = 2.5  # checks
SPARED, PLAIN = 0.75, 0.5  # powers of the paths with which an error falls, where intervals are short and elsewhere
DRAW = 150.0  # operations for a draw that is conditional
START = 3e7  # operations, to scramble points
LASTING = 6.0  # times the checks of an interval: those that few paths take, each of which costs more than of many
LOOKED = 16  # checks that tell about how long intervals are


@dataclass(frozen=True, eq=False)
class PathAnswer:
    """Rate and cost of a chain as never-die paths find them.

    Args:
        rate: sends per check.
        excess: mean of what a check costs, E[(1−σ) e'Γe].
        covariance: of these two, (2, 2).
        intervals: between sends.
        survival_error: standard errors of their survival, (checks,).
        randomisations: independent ones, whose spread the standard errors tell.
        paths: of each.
        steps: paths times checks that it took.
        reached: whether both standard errors are the ones asked for.
    """

    rate: Estimate
    excess: Estimate
    covariance: Array
    intervals: Intervals
    survival_error: Array
    randomisations: int
    paths: int
    steps: int
    reached: bool


def solve_paths(
    chain: Chain,
    *,
    standard_error: float = 1e-4,
    seed: int = 0,
    steps: int = USUAL,
    progress: Progress | None = None,
) -> PathAnswer:
    """Return rate and cost of a chain with Gaussian noise in any dimension, of any rank.

    An interval has T = Σ_j P(kept at the checks 1 … j) checks in the mean and costs C = Σ_j E[e_j'Γe_j, kept so far];
    the rate is 1/T, the excess C/T. Paths never die: in each check one coordinate of the noise after the other is
    drawn such that the error can still be kept, and the probability of that is multiplied to the path's weight, as in
    the simulator of Geweke, Hajivassiliou and Keane. The draws come from scrambled Sobol points, in independent
    randomisations, over whose spread the standard errors of the ratios are had. There are more points, then more
    randomisations, until those are small. What is left to a geometric tail is at most a hundredth of the error asked
    for, and what its ratio is in doubt by counts.

    Args:
        chain: with Gaussian noise, which need not fill all directions in one check.
        standard_error: relative, of rate and excess.
        seed: of the draws, at least 0.
        steps: paths times checks at which it stops asking for more; where this was too few, the errors say so.
        progress: called with the fraction done; the best answer so far is the last one when it is out of time.

    Returns:
        Rate and excess with standard errors, and the distribution of the intervals.

    Raises:
        NoQuadratureError: nothing is ever sent, or hardly ever; the cost has no end.
        ProblemError: an accuracy outside (0, 1), a seed or a number of steps that is none.

    Source: hajivassiliou1996, lecuyer2018

    Example:
        >>> unit = np.eye(4)
        >>> found = solve_paths(Chain(unit, unit, unit, 4.0, unit), standard_error=1e-3)
        >>> found.reached, round(found.rate.value, 2)
        (True, 0.52)
    """
    number("standard_error", standard_error, 0.0, 1.0)
    count("seed", seed, 0)
    count("steps", steps)
    walk = Walk(reduced(chain))
    source = np.random.SeedSequence(seed)
    courses, paths, work, told = list[Course](), FIRST, 0, Stages(progress)
    found, kept = None, courses
    while True:
        draws = (np.random.default_rng(child) for child in source.spawn(RANDOMISATIONS))
        new = list[Course]()
        try:
            for each in draws:
                new.append(follow(walk, paths, each, CUT * standard_error))
                told.tick()
        except OutOfTime:
            if found is None:
                raise
            courses = kept
            break
        spent = sum(course.work for course in new)
        courses, work = courses + new, work + spent
        found, kept = _ratios(courses), courses
        off = _off(*found[:2])
        if off <= standard_error or work + spent > steps:
            break
        told.at = max(told.at, work / steps, min(standard_error / off, 1.0) ** 2)
        if paths < LARGEST:
            # fewer than what a spread that falls as one over the points asks for, and no more than what is left
            more = min(max(off / standard_error, 2.0), LARGEST / paths, max((steps - work) / spent, 2.0))
            paths, courses = paths << int(np.log2(more)), []
    assert found is not None
    rate, excess, covariance = found
    intervals, errors = _intervals(courses, rate.value)
    return PathAnswer(
        rate, excess, covariance, intervals, errors, len(courses), paths, work, _off(rate, excess) <= standard_error
    )


def _off(*found: Estimate) -> float:
    """Return the largest of some relative standard errors."""
    return max(each.standard_error / abs(each.value) if each.value else 0.0 for each in found)


def predict_paths(chain: Chain, known: PathAnswer, standard_error: float) -> float:
    """Return about how many operations ``solve_paths`` takes, from an answer to a coarser accuracy; 0 if that will do.

    Args:
        chain: with Gaussian noise.
        known: what fewer paths found.
        standard_error: relative, of the excess.
    """
    off = known.excess.standard_error / known.excess.value if known.excess.value else 0.0
    if off <= standard_error:
        return 0.0
    power = SPARED if 1 / known.rate.value <= SHORT else PLAIN
    return START + DRAW * len(reduced(chain).F) * known.steps * (off / standard_error) ** (1 / power)


def predict_fewest(chain: Chain) -> float:
    """Return about how many operations the fewest paths take, from a lower bound on the mean interval.

    Args:
        chain: with Gaussian noise.

    Raises:
        NoQuadratureError: nothing is ever sent, or jumps.
    """
    return _fewest(chain, least_interval(chain, LOOKED))


def least_work(chain: Chain) -> float:
    """Return how many operations the fewest paths take, at least: those of intervals of one check."""
    return _fewest(chain, 1.0)


def _fewest(chain: Chain, interval: float) -> float:
    return START + DRAW * len(reduced(chain).F) * RANDOMISATIONS * FIRST * LASTING * interval


def expect_quicker(chain: Chain) -> bool:
    """Say whether never-die paths are expected to beat a plain simulation: whether intervals are short.

    Only where few checks make an interval do points that fill space evenly help: ``benchmarks/paths.py`` measures up
    to which. Intervals are at least as long as those of independent checks (:func:`least_interval`), and about that.

    Args:
        chain: with Gaussian noise.

    Raises:
        NoQuadratureError: nothing is ever sent, or jumps.

    Source: royen2014

    Example:
        >>> unit = np.eye(4)
        >>> [expect_quicker(Chain(unit, unit, unit, delta, unit)) for delta in (4.0, 40.0)]
        [True, False]
    """
    return least_interval(chain) <= SHORT


def _ratios(courses: list[Course]) -> tuple[Estimate, Estimate, Array]:
    """Return rate, excess and their covariance: ratios of means, to first order in what these are off by.

    The doubt about what follows the last check counts in full, as it may be the same in all randomisations.
    """
    sums = np.array([course.sums for course in courses])
    checks, cost = sums.mean(axis=0)
    excess = cost / checks
    moved = np.stack([(checks - sums[:, 0]) / checks**2, (sums[:, 1] - excess * sums[:, 0]) / checks])
    later, price = np.mean([(course.checks_later[1], course.cost_later[1]) for course in courses], axis=0)
    doubt = np.array([later / checks**2, (price + excess * later) / checks])
    covariance = moved @ moved.T / (len(courses) - 1) / len(courses) + np.diag(doubt**2)
    errors = np.sqrt(np.diag(covariance))
    return (
        Estimate(float(1 / checks), float(errors[0]), "simulation"),
        Estimate(float(excess), float(errors[1]), "simulation"),
        frozen(covariance),
    )


def _intervals(courses: list[Course], rate: float) -> tuple[Intervals, Array]:
    """Return the mean survival with its errors, as far as all have one, and the decay with which it sums to 1/rate."""
    known = min(len(course.survival) for course in courses)
    each = np.array([course.survival[:known] for course in courses])
    survival, errors = each.mean(axis=0), each.std(axis=0, ddof=1) / np.sqrt(len(each))
    left = max(1 / rate - float(survival.sum()), 0.0)
    return Intervals(frozen(survival), left / (left + survival[-1]) if survival[-1] > 0 else 0.0), frozen(errors)
