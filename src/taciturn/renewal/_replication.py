"""One replication of conditional sampling: simulated paths without a send, weighted by the probability of no send."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from taciturn import _scipy
from taciturn._arrays import Array
from taciturn.renewal._white_coordinates import Data
from taciturn.renewal.chain import NoQuadratureError

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
    """Sampler of the next error of many paths, conditioned on the event that the error is not sent.

    The noise is w = G z with z ~ N(0, I), in coordinates in which G'ΨG is diagonal, ascending.

    With Ψ = N'N the columns of NG are orthogonal. So the next error is unsent if Σ_i m_i (z_i − c_i)² ≤ 1 − |r|², where
    m_i = |(NG)_i|², c_i = −(NG)_i'N F e/m_i, and r is the part of N F e that no noise reaches. Each coordinate z_i thus
    lies on a chord whose length depends on the coordinates before it, and is drawn from the normal distribution
    truncated to this chord. If the chord is wide, z_i is drawn without truncation; then no chord may be left for the
    next coordinate, and the path gets the weight 0. The last coordinate is the one on which e'Ψe depends most.

    Args:
        data: the chain, scaled to the threshold 1.
    """

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
        """Return the next unsent error of each path, the probability that it is unsent, and its expected cost.

        The expectation of the cost is over the last coordinate that is drawn.

        Args:
            errors: errors before the step, (paths, n).
            uniform: uniform random numbers, the one for the last noise first, (paths, draws).
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


@dataclass(frozen=True, eq=False)
class SampledInterval:
    """Estimated distribution and cost of the interval between two sends, from one randomisation.

    Args:
        survival: P(no send at the checks 1 … k) for k = 0, 1, …, (checks + 1,).
        cost: E[e'Γe, no send so far] at each of these checks.
        checks_later: sum of the survival at later checks, assumed to be geometric, and the uncertainty of the sum.
        cost_later: sum of the cost at later checks, and its uncertainty.
        work: number of paths times checks.
    """

    survival: Array
    cost: Array
    checks_later: tuple[float, float]
    cost_later: tuple[float, float]
    work: int

    @property
    def sums(self) -> tuple[float, float]:
        """Mean number of checks and mean cost of an interval between sends."""
        return float(self.survival.sum()) + self.checks_later[0], float(self.cost.sum()) + self.cost_later[0]


def follow(walk: Walk, paths: int, draws: np.random.Generator, negligible: float) -> SampledInterval:
    """Simulate many paths, conditioned on no send, and return the estimates from one randomisation.

    The draws are scrambled Sobol points at the first checks and pseudo-random numbers at later checks.

    The mean weight after k checks is an unbiased estimate of P(no send at k checks). Resampling does not change this,
    because it depends only on the past, and because the expected number of copies of a path is proportional to its
    weight. Each coordinate of the Sobol points is scrambled independently, so that it is uniform given the others.

    The remaining length of an interval is no longer than a new interval, P(T > j + k) ≤ P(T > j) P(T > k), because an
    error of 0 has the largest probability to stay in a symmetric convex set (Anderson). So the checks after check j
    contribute at most the fraction P(T > j) of the sum. A course ends when this fraction is negligible.

    Args:
        walk: the chain.
        paths: number of paths, a power of two.
        draws: the source of all random numbers.
        negligible: largest fraction of checks and cost that the geometric tail may contribute.

    Raises:
        NoQuadratureError: an interval has too many checks, or its cost is infinite.

    Source: anderson1955, delmoral2006, lecuyer2018
    """
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
                "without sends, the cost of the error grows without bound in a direction that Γ weighs and Ψ does "
                "not; expected a Ψ that weighs every growing direction of the error; simulate instead"
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
    """Return the sum of later terms, extrapolated with the ratio of the last quarter, and its uncertainty.

    The uncertainty is the difference to the ratio of the last half, or the whole sum if there are few terms. If the
    terms do not decrease, the sum is infinite.
    """
    quarter, half = max((len(terms) - 1) // 4, 1), max((len(terms) - 1) // 2, 1)
    if terms[-1] <= 0:
        return 0.0, 0.0
    ratios = [(terms[-1] / terms[-1 - back]) ** (1 / back) if terms[-1 - back] > 0 else 1.0 for back in (quarter, half)]
    if ratios[0] >= 1:
        return np.inf, np.inf
    sums = [terms[-1] * ratio / (1 - ratio) if ratio < 1 else np.inf for ratio in ratios]
    return sums[0], min(abs(sums[1] - sums[0]), sums[0]) if half > quarter else sums[0]
