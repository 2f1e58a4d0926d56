"""Send rate and cost of an error with Gaussian noise in any dimension, by conditional quasi-Monte Carlo sampling.

The mean interval between sends is T = Σ_j P(no send at the checks 1 … j), and its mean cost is
C = Σ_j E[e_j'Γe_j, no send so far]. The rate is 1/T, and the excess is C/T.

Sampling is conditional on silence (the simulator of Geweke, Hajivassiliou and Keane). At each check, the coordinates of
the noise are drawn one after the other such that the error can still remain unsent, and the weight of the path is
multiplied by the probability of this. The noise is w = G z with z ~ N(0, I), in coordinates in which G'ΨG is diagonal,
ascending. With Ψ = N'N the columns of NG are orthogonal. So the next error is unsent if

    Σ_i m_i (z_i − c_i)² ≤ 1 − |r|²,    m_i = |(NG)_i|²,    c_i = −(NG)_i'N F e/m_i,

where r is the part of N F e that no noise reaches. Each z_i thus lies on a chord whose length depends on the
coordinates before it, and is drawn from the normal distribution truncated to this chord. If the chord is wide, z_i is
drawn without truncation; then no chord may be left for the next coordinate, and the path gets the weight 0. The last
coordinate is the one on which e'Ψe depends most.

The mean weight after k checks is an unbiased estimate of P(no send at k checks). Resampling does not change this,
because it depends only on the past, and because the expected number of copies of a path is proportional to its weight.
The draws are scrambled Sobol points at the first checks and pseudo-random numbers later. Each coordinate of the points
is scrambled independently, so that it is uniform given the others.

The remaining length of an interval is no longer than a new interval, P(T > j + k) ≤ P(T > j) P(T > k), because an error
of 0 has the largest probability to stay in a symmetric convex set (Anderson). So the checks after check j contribute at
most the fraction P(T > j) of the sum, and a course ends when this fraction is negligible. The remainder, which is
assumed to be geometric, is at most a hundredth of the requested error; the uncertainty of its ratio is part of the
standard errors. These follow from the spread of independent randomisations. First the number of points, then the number
of randomisations is increased until they are small enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from taciturn import _scipy
from taciturn._arrays import Array, count, frozen, number
from taciturn._display import Displayed
from taciturn._progress import OutOfTime, Progress, Stages
from taciturn.model.estimate import Estimate
from taciturn.renewal.chain import Chain, Data, Intervals, NoQuadratureError, reduced
from taciturn.renewal.rates import least_interval

IDLE = 1e-8  # relative: a noise direction with a smaller effect on e'Ψe is ignored in a check
FAR = 37.0  # noise standard deviations at which the density underflows
WIDE = 4.0  # noise standard deviations: half-width of a chord from which on a draw is not truncated
ROUNDED = 1e-15  # relative eigenvalue per direction below which it counts as rounding
DIMENSIONS = 40  # dimensions of the Sobol points: if intervals are short, later draws hardly matter
DEGENERATE = 0.5  # fraction of the paths: a smaller effective number of paths causes resampling
FEWEST = 256  # paths after a resampling, at least
SPARE = 2.0  # paths after a resampling, as a multiple of the survival probability times the first number of paths
MOST_CHECKS = 4096
LOST = 1e-30  # survival probability at which a cost that has not converged never will


class Walk:
    """Draws the next error of many paths, conditioned on the event that the error is not sent."""

    def __init__(self, data: Data) -> None:
        """Rotate the noise so that G'ΨG is diagonal."""
        half, seen = _certain_root(data.noise), _certain_root(data.Psi).T
        _, sizes, turn = np.linalg.svd(seen @ half)  # more accurate for small values than the eigenvalues of G'ΨG
        turn = turn[::-1].T  # the noise with the largest effect on e'Ψe is last
        self.F, self.Gamma, self.seen = data.F, data.Gamma, seen
        self.noises: Array = np.asarray(half @ turn, dtype=np.float64)
        along: Array = np.asarray(seen @ self.noises, dtype=np.float64)
        # by rounding, smaller columns are not orthogonal to the others
        rounding = max(IDLE * float(sizes[0]), 1e-14 * float(np.linalg.norm(seen) * np.linalg.norm(half)))
        self.along = along * (np.linalg.norm(along, axis=0) > rounding)
        self.pulls = np.square(self.along).sum(axis=0)
        self.draws = len(self.pulls)

    def step(self, errors: Array, uniform: Array) -> tuple[Array, Array, Array]:
        """Draw the next error of each path, on which nothing is sent. Also return how probable this is, and the mean
        cost.
        """
        moved = errors @ self.F.T
        rest = moved @ self.seen.T
        # ``room`` is what the coordinates so far leave of the threshold: 1 − |r|² − Σ m_i (z_i − c_i)²
        centres = np.zeros((self.draws, len(errors)))
        for axis in np.flatnonzero(self.pulls):
            centres[axis] = rest @ self.along[:, axis] / -self.pulls[axis]
        rest += centres.T @ self.along.T
        room = 1 - np.einsum("ij,ij->i", rest, rest)
        alive, chance = room > 0, np.ones(len(errors))
        for axis in range(self.draws - 1):
            pull, points = float(self.pulls[axis]), uniform[:, -1 - axis]
            if pull * WIDE**2 >= 1:
                draw, share = _truncated(*_chord(centres[axis], room, pull), points)
                chance *= share
            else:
                draw = _scipy.normal_quantile(points)
            moved += draw[:, None] * self.noises[:, axis]
            room -= pull * np.square(draw - centres[axis])
            alive &= room > 0
        low, high = _chord(centres[-1], room, float(self.pulls[-1]))
        draw, share = _truncated(low, high, uniform[:, 0])
        # the cost is averaged over the last coordinate exactly, which reduces the variance
        first, second = _moments(low, high, share, draw)
        last, weighed = self.noises[:, -1], moved @ self.Gamma
        cost = np.einsum("ij,ij->i", weighed, moved) + 2 * first * (weighed @ last)
        cost += second * float(last @ self.Gamma @ last)
        moved += draw[:, None] * last
        chance *= share
        dead = ~alive | (chance == 0)
        moved[dead], chance[dead], cost[dead] = 0.0, 0.0, 0.0  # without weight; zeros avoid overflow
        return moved, chance, cost


def _certain_root(weight: Array) -> Array:
    """Return R with RR' = weight, without columns that are rounding, as these would not be orthogonal to the others."""
    values, vectors = np.linalg.eigh(weight)
    certain = values > ROUNDED * len(values) * values[-1]
    return np.asarray(vectors[:, certain] * np.sqrt(values[certain]), dtype=np.float64)


@dataclass(frozen=True, eq=False, repr=False)
class SampledInterval(Displayed):
    """Distribution and cost of the interval from one send to the next, estimated from one set of random paths."""

    survival: Array  # P(no send at the checks 1 … k) for k = 0, 1, …, (checks + 1,)
    cost: Array  # E[e'Γe, no send so far] at each of these checks
    # sum of the survival at later checks, assumed to be geometric, and the uncertainty of the sum
    checks_later: tuple[float, float]
    cost_later: tuple[float, float]  # sum of the cost at later checks, and its uncertainty
    work: int  # number of paths times checks

    @property
    def sums(self) -> tuple[float, float]:
        """Mean number of checks in the interval from one send to the next, and mean cost of the interval."""
        return float(self.survival.sum()) + self.checks_later[0], float(self.cost.sum()) + self.cost_later[0]


def follow(walk: Walk, paths: int, draws: np.random.Generator, negligible: float) -> SampledInterval:
    """Simulate many paths on which nothing is sent. From them, estimate distribution and cost of the interval."""
    known = DIMENSIONS // walk.draws
    points = _scipy.sobol(known * walk.draws, paths, draws) if known else np.empty((paths, 0))
    errors, weights = np.zeros((paths, len(walk.F))), np.ones(paths)
    survival, cost, work = [1.0], [0.0], 0
    for check in range(MOST_CHECKS):
        count = len(errors)
        if check < known:
            uniform = points[:count, check * walk.draws : (check + 1) * walk.draws]
        else:
            uniform = draws.random((count, walk.draws))
            np.maximum(uniform, 2.0**-54, out=uniform)
        with np.errstate(over="ignore", invalid="ignore"):
            errors, chance, price = walk.step(errors, uniform)
            weights = weights * chance
            mean = float(weights.mean())
            survival.append(mean)
            cost.append(float(weights @ price) / count)
        work += count
        if mean <= negligible and _later(cost)[0] <= negligible * sum(cost):
            return SampledInterval(np.array(survival), np.array(cost), _later(survival), _later(cost), work)
        if mean < LOST or not np.isfinite(cost[-1]):
            raise NoQuadratureError(
                "without sends, the cost of the error grows without bound in a direction to which Γ gives weight and "
                "Ψ does not; expected a Ψ that gives weight to every growing direction of the error; simulate instead"
            )
        if mean**2 * count < DEGENERATE * float(weights @ weights):
            heirs = _heirs(weights, _left(paths, count, mean), float(draws.random()))
            errors, weights = errors[heirs], np.full(len(heirs), mean)
    raise NoQuadratureError(
        f"the probability of no send in {MOST_CHECKS} checks is {survival[-1]:.3g}, which is too large; expected "
        "shorter intervals between sends: use a smaller threshold δ or more noise, or simulate instead"
    )


def _left(paths: int, count: int, kept: float) -> int:
    """Return the number of paths after a resampling: a power of two, in proportion to the survival probability."""
    wanted = max(FEWEST, SPARE * kept * paths)
    return min(count, 1 << int(np.ceil(np.log2(wanted))))


def _heirs(weights: Array, count: int, offset: float) -> npt.NDArray[np.intp]:
    """Return the path that each of ``count`` new paths continues, by systematic resampling."""
    ends: Array = np.asarray(np.cumsum(weights), dtype=np.float64)
    places = (np.arange(count) + offset) * (float(ends[-1]) / count)
    return np.clip(np.searchsorted(ends, places, side="right"), 0, len(weights) - 1)


def _chord(centre: Array, room: Array, pull: float) -> tuple[Array, Array]:
    """Return the ends of the interval {t: pull (t − centre)² ≤ room}, or ±FAR if ``pull`` is 0."""
    if pull == 0:
        return np.full(len(room), -FAR), np.full(len(room), FAR)
    half = np.sqrt(np.maximum(room, 0.0) / pull)
    return centre - half, centre + half


def _truncated(low: Array, high: Array, uniform: Array) -> tuple[Array, Array]:
    """Return draws from the standard normal distribution between two ends, and the probability of this interval."""
    # both are computed in the lower tail, where small probabilities are accurate
    mirrored = low + high > 0
    below = np.where(mirrored, -high, low)
    above = np.where(mirrored, -low, high)
    first = _scipy.normal_share(below)
    share = _scipy.normal_share(above) - first
    # mirrored draws use 1 − uniform, so that the map from points to draws is continuous
    quantile = _scipy.normal_quantile(first + share * np.where(mirrored, 1 - uniform, uniform))
    draw = np.clip(quantile, below, above)
    return np.where(mirrored, -draw, draw), share


def _moments(low: Array, high: Array, share: Array, draw: Array) -> tuple[Array, Array]:
    """Return mean and mean square of these draws; those of the draw itself if the formula is inaccurate."""
    falls = [np.exp(-0.5 * np.square(np.clip(end, -FAR, FAR))) / np.sqrt(2 * np.pi) for end in (low, high)]
    known = (share > 1e-6) & (high - low > 0.1)
    safe = np.where(known, share, 1.0)
    first = (falls[0] - falls[1]) / safe
    second = 1 + (np.clip(low, -FAR, FAR) * falls[0] - np.clip(high, -FAR, FAR) * falls[1]) / safe
    return np.where(known, first, draw), np.where(known, second, draw * draw)


def _later(terms: list[float]) -> tuple[float, float]:
    """Return the sum of later terms, extrapolated with the ratio of the last quarter, and its uncertainty."""
    # The uncertainty is the difference to the ratio of the last half, or the whole sum if there are few terms. If the
    # terms do not decrease, the sum is infinite.
    quarter, half = max((len(terms) - 1) // 4, 1), max((len(terms) - 1) // 2, 1)
    if terms[-1] <= 0:
        return 0.0, 0.0
    ratios = [(terms[-1] / terms[-1 - back]) ** (1 / back) if terms[-1 - back] > 0 else 1.0 for back in (quarter, half)]
    if ratios[0] >= 1:
        return np.inf, np.inf
    sums = [terms[-1] * ratio / (1 - ratio) if ratio < 1 else np.inf for ratio in ratios]
    return sums[0], min(abs(sums[1] - sums[0]), sums[0]) if half > quarter else sums[0]


RANDOMISATIONS = 16  # computed at a time; the relative error of their spread is a fifth
FIRST_PATHS, MOST_PATHS = 1 << 10, 1 << 16  # paths of each randomisation
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
    """Send rate, excess cost and intervals between sends, estimated by conditional sampling of an error."""

    rate: Estimate  # sends per check
    excess: Estimate  # mean cost per check, E[(1−σ) e'Γe]
    covariance: Array  # covariance of both estimates, (2, 2)
    intervals: Intervals  # distribution of the intervals between sends
    survival_error: Array  # standard errors of the survival of the intervals, (checks,)
    randomisations: int  # number of independent randomisations, from whose spread the standard errors follow
    paths: int  # number of paths of each randomisation
    steps: int  # number of paths times checks that were computed
    reached: bool  # whether both standard errors are at most the requested one


def solve_paths(
    chain: Chain,
    *,
    standard_error: float = 1e-4,
    seed: int = 0,
    steps: int = USUAL,
    progress: Progress | None = None,
) -> PathAnswer:
    """Estimate send rate and excess cost of an error with Gaussian noise, in any dimension, by conditional sampling."""
    number("standard_error", standard_error, 0.0, 1.0)
    count("seed", seed, 0)
    count("steps", steps)
    walk = Walk(reduced(chain))
    source = np.random.SeedSequence(seed)
    courses, paths, work, told = list[SampledInterval](), FIRST_PATHS, 0, Stages(progress)
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
        if paths < MOST_PATHS:
            # the spread falls at most as one over the number of points, and the work is limited to what remains
            more = min(max(off / standard_error, 2.0), MOST_PATHS / paths, max((steps - work) / spent, 2.0))
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
    """Predict how many operations ``solve_paths`` needs, from a less accurate solution; 0 if that is accurate
    enough.
    """
    off = known.excess.standard_error / known.excess.value if known.excess.value else 0.0
    if off <= standard_error:
        return 0.0
    power = SPARED if 1 / known.rate.value <= SHORT else PLAIN
    return START + DRAW * len(reduced(chain).F) * known.steps * (off / standard_error) ** (1 / power)


def predict_fewest(chain: Chain) -> float:
    """Predict how many operations ``solve_paths`` needs with its smallest number of paths."""
    return fewest_operations(chain, least_interval(chain, LOOKED))


def fewest_operations(chain: Chain, interval: float = 1.0) -> float:
    """Return how many operations ``solve_paths`` needs with its smallest number of paths, for a mean interval."""
    return START + DRAW * len(reduced(chain).F) * RANDOMISATIONS * FIRST_PATHS * LASTING * interval


def _ratios(courses: list[SampledInterval]) -> tuple[Estimate, Estimate, Array]:
    """Return rate, excess and their covariance, as ratios of means, to first order in the errors of the means."""
    # the uncertainty about the checks after the last one counts in full, as it may be common to all randomisations
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
