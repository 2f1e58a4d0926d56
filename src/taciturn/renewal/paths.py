"""Send rate and cost of an error with Gaussian noise in any dimension, by conditional quasi-Monte Carlo sampling."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, count, frozen, number
from taciturn._display import Displayed
from taciturn._progress import OutOfTime, Progress, Stages
from taciturn.model.estimate import Estimate
from taciturn.renewal._replication import SampledInterval, Walk, follow
from taciturn.renewal._white_coordinates import reduced
from taciturn.renewal.chain import Chain, Intervals
from taciturn.renewal.rates import least_interval

RANDOMISATIONS = 16  # computed at a time; the relative error of their spread is a fifth
FIRST, LARGEST = 1 << 10, 1 << 16  # paths of each randomisation
CUT = 0.01  # largest share of an interval in its geometric tail, times the accuracy
USUAL = 50_000_000  # default limit of paths times checks
SHORT = 2.5  # checks: intervals up to here count as short
SPARED, PLAIN = 0.75, 0.5  # the error falls with this power of the number of paths, for short intervals and others
DRAW = 150.0  # operations for a conditional draw
START = 3e7  # operations to scramble the Sobol points
LASTING = 6.0  # effort of the fewest paths, as a multiple of the mean interval (per path it exceeds that of many paths)
LOOKED = 16  # checks from which the mean interval is estimated roughly


@dataclass(frozen=True, eq=False, repr=False)
class PathAnswer(Displayed):
    """Estimates of send rate, excess cost and intervals of an error, from conditional sampling.

    Args:
        rate: sends per check.
        excess: mean cost per check, E[(1−σ) e'Γe].
        covariance: covariance of both estimates, (2, 2).
        intervals: distribution of the intervals between sends.
        survival_error: standard errors of the survival of the intervals, (checks,).
        randomisations: number of independent randomisations, from whose spread the standard errors follow.
        paths: number of paths of each randomisation.
        steps: number of paths times checks that were computed.
        reached: whether both standard errors are at most the requested one.
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
    """Return send rate and excess cost of an error of any dimension with Gaussian noise, by conditional sampling.

    The mean interval is T = Σ_j P(no send at the checks 1 … j), and its mean cost is C = Σ_j E[e_j'Γe_j, no send so
    far]. The rate is 1/T, and the excess is C/T. Sampling is conditional on silence: at each check, the coordinates of
    the noise are drawn one after the other such that the error can still remain unsent, and the weight of the path is
    multiplied by the probability of this. This is the simulator of Geweke, Hajivassiliou and Keane. The draws come from
    scrambled Sobol points in independent randomisations, whose spread gives the standard errors of the ratios. First
    the number of points, then the number of randomisations is increased until the standard errors are small enough. The
    remainder of an interval, which is assumed to be geometric, is at most a hundredth of the requested error; the
    uncertainty of its ratio is part of the standard errors.

    Args:
        chain: chain with Gaussian noise, which need not reach all directions in one check.
        standard_error: requested relative standard error of rate and excess.
        seed: seed of the random numbers, at least 0.
        steps: limit of paths times checks; if it is too low, the standard errors are larger than requested.
        progress: called with the fraction done; when time runs out, the best answer so far is returned.

    Returns:
        Rate and excess with standard errors, and the distribution of the intervals.

    Raises:
        NoQuadratureError: nothing, or hardly anything, is ever sent, or the cost is infinite.
        ProblemError: an accuracy outside (0, 1), or a seed or a number of steps out of range.

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
    courses, paths, work, told = list[SampledInterval](), FIRST, 0, Stages(progress)
    found, kept = None, courses
    while True:
        draws = (np.random.default_rng(child) for child in source.spawn(RANDOMISATIONS))
        new = list[SampledInterval]()
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
            # the spread falls at most as one over the number of points, and the work is limited to what remains
            more = min(max(off / standard_error, 2.0), LARGEST / paths, max((steps - work) / spent, 2.0))
            paths, courses = paths << int(np.log2(more)), []
    assert found is not None
    rate, excess, covariance = found
    intervals, errors = _intervals(courses, rate.value)
    return PathAnswer(
        rate, excess, covariance, intervals, errors, len(courses), paths, work, _off(rate, excess) <= standard_error
    )


def _off(*found: Estimate) -> float:
    """Return the largest relative standard error of the estimates."""
    return max(each.standard_error / abs(each.value) if each.value else 0.0 for each in found)


def predict_paths(chain: Chain, known: PathAnswer, standard_error: float) -> float:
    """Return approximately how many operations ``solve_paths`` needs, given a less accurate solution.

    The result is 0 if the coarser answer is accurate enough.

    Args:
        chain: chain with Gaussian noise.
        known: answer from fewer paths.
        standard_error: requested relative standard error of the excess.
    """
    off = known.excess.standard_error / known.excess.value if known.excess.value else 0.0
    if off <= standard_error:
        return 0.0
    power = SPARED if 1 / known.rate.value <= SHORT else PLAIN
    return START + DRAW * len(reduced(chain).F) * known.steps * (off / standard_error) ** (1 / power)


def predict_fewest(chain: Chain) -> float:
    """Return approximately how many operations ``solve_paths`` needs for its smallest number of paths.

    Args:
        chain: chain with Gaussian noise.

    Raises:
        NoQuadratureError: nothing is ever sent, or jumps.
    """
    return _fewest(chain, least_interval(chain, LOOKED))


def fewest_operations(chain: Chain) -> float:
    """Return a lower bound on the operations of ``solve_paths``: fewest paths, and a send at every check."""
    return _fewest(chain, 1.0)


def _fewest(chain: Chain, interval: float) -> float:
    return START + DRAW * len(reduced(chain).F) * RANDOMISATIONS * FIRST * LASTING * interval


def expect_quicker(chain: Chain) -> bool:
    """Predict whether conditional sampling is faster than a plain simulation, as it is for short send intervals.

    Quasi-random points help only if intervals have few checks; ``benchmarks/paths.py`` measures the limit. The mean
    interval is at least that of independent checks (:func:`least_interval`), and usually close to it.

    Args:
        chain: chain with Gaussian noise.

    Raises:
        NoQuadratureError: nothing is ever sent, or jumps.

    Source: royen2014

    Example:
        >>> unit = np.eye(4)
        >>> [expect_quicker(Chain(unit, unit, unit, delta, unit)) for delta in (4.0, 40.0)]
        [True, False]
    """
    return least_interval(chain) <= SHORT


def _ratios(courses: list[SampledInterval]) -> tuple[Estimate, Estimate, Array]:
    """Return rate, excess and their covariance, as ratios of means, to first order in the errors of the means.

    The uncertainty about the checks after the last one counts in full, as it may be common to all randomisations.
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


def _intervals(courses: list[SampledInterval], rate: float) -> tuple[Intervals, Array]:
    """Return mean and standard errors of the survival that all courses have, with a decay that sums to 1/rate."""
    known = min(len(course.survival) for course in courses)
    each = np.array([course.survival[:known] for course in courses])
    survival, errors = each.mean(axis=0), each.std(axis=0, ddof=1) / np.sqrt(len(each))
    left = max(1 / rate - float(survival.sum()), 0.0)
    return Intervals(frozen(survival), left / (left + survival[-1]) if survival[-1] > 0 else 0.0), frozen(errors)
