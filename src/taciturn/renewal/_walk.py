"""One randomisation of never-die paths: errors that no check sends, with the probability that none does as weight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from taciturn import _scipy
from taciturn._arrays import Array
from taciturn.renewal._whiten import Data
from taciturn.renewal.chain import NoQuadratureError

IDLE = 1e-8  # relative: a noise that moves what Ψ sees by less than this does not count in one check
FAR = 37.0  # noise deviations, where nothing is left of the density
WIDE = 4.0  # noise deviations: half of a chord that is worth no truncation
ROUNDED = 1e-15  # relative eigenvalue per direction, below which it is rounding
DIMENSIONS = 40  # of the Sobol points: where intervals are short, later draws hardly matter
DEGENERATE = 0.5  # of the paths: an effective number below it asks for resampling
FEWEST = 256  # paths that are left by it
SPARE = 2.0  # it leaves so many times the share of the paths that is still kept
MOST_CHECKS = 4096
LOST = 1e-30  # survival at which a cost that has not ended yet never will


class Walk:
    """A step of the chain in the coordinates of its noise, w = G z with z ~ N(0, I) and G'ΨG diagonal, ascending.

    With Ψ = N'N the columns of NG are orthogonal, so the coordinates of a next error that is kept lie one after the
    other on chords: with c_i = −(NG)_i'N F e/m_i, m_i = |(NG)_i|², that is Σ_i m_i (z_i − c_i)² ≤ 1 − |what of N F e no
    noise reaches|². Each is drawn from the normal law on the chord that those before it leave; one whose chord is
    wide is drawn freely, and may then leave none for the next. The last is the one along which Ψ acts most.

    Args:
        data: the chain, its threshold 1.
    """

    def __init__(self, data: Data) -> None:
        """Turn the noise."""
        half, seen = _certain_root(data.noise), _certain_root(data.Psi).T
        _, sizes, turn = np.linalg.svd(seen @ half)  # more digits of the small ones than G'ΨG has
        turn = turn[::-1].T  # the noise that Ψ sees most last
        self.F, self.Gamma, self.seen = data.F, data.Gamma, seen
        self.noises: Array = np.asarray(half @ turn, dtype=np.float64)
        along: Array = np.asarray(seen @ self.noises, dtype=np.float64)
        # rounding leaves what is less not orthogonal to the others
        rounding = max(IDLE * float(sizes[0]), 1e-14 * float(np.linalg.norm(seen) * np.linalg.norm(half)))
        self.along = along * (np.linalg.norm(along, axis=0) > rounding)
        self.pulls = np.square(self.along).sum(axis=0)
        self.draws = len(self.pulls)

    def step(self, errors: Array, uniform: Array) -> tuple[Array, Array, Array]:
        """Return the next errors, kept, the probability that they are, and their cost in the mean over the last draw.

        Args:
            errors: (paths, n).
            uniform: the last noise first, (paths, draws).
        """
        moved = errors @ self.F.T
        rest = moved @ self.seen.T
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
        first, second = _moments(low, high, share, draw)
        last, weighed = self.noises[:, -1], moved @ self.Gamma
        cost = np.einsum("ij,ij->i", weighed, moved) + 2 * first * (weighed @ last)
        cost += second * float(last @ self.Gamma @ last)
        moved += draw[:, None] * last
        chance *= share
        dead = ~alive | (chance == 0)
        moved[dead], chance[dead], cost[dead] = 0.0, 0.0, 0.0  # of no weight, and they shall not overflow
        return moved, chance, cost


def _certain_root(weight: Array) -> Array:
    """Return R with RR' = weight, without the columns that are rounding: they would not be orthogonal to others."""
    values, vectors = np.linalg.eigh(weight)
    certain = values > ROUNDED * len(values) * values[-1]
    return np.asarray(vectors[:, certain] * np.sqrt(values[certain]), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Course:
    """What one randomisation finds of an interval.

    Args:
        survival: P(kept at the checks 1 … k) for k = 0, 1, …, (checks + 1,).
        cost: E[e'Γe, kept so far] at each of them.
        checks_later: what the survival at later checks adds as if geometric, and how far that is in doubt.
        cost_later: the same of the cost.
        work: paths times checks.
    """

    survival: Array
    cost: Array
    checks_later: tuple[float, float]
    cost_later: tuple[float, float]
    work: int

    @property
    def sums(self) -> tuple[float, float]:
        """Checks and cost of an interval."""
        return float(self.survival.sum()) + self.checks_later[0], float(self.cost.sum()) + self.cost_later[0]


def follow(walk: Walk, paths: int, draws: np.random.Generator, negligible: float) -> Course:
    """Return the course of one randomisation: scrambled Sobol points first, pseudo-random numbers after them.

    Weights are unbiased estimates: the mean weight after k checks has the mean P(kept k times). Resampling keeps
    that, as it only looks at what was drawn, and gives each path as many heirs, in the mean, as its weight asks for;
    and each coordinate of the points is scrambled on its own, so that it is uniform whatever the others were.

    An interval that has lasted does not last longer than a new one would, P(T > j + k) ≤ P(T > j) P(T > k), as what an
    error of 0 becomes stays in a symmetric convex set most probably (Anderson). So what comes after check j is no more
    than the share P(T > j) of the sum; that share ends a course.

    Args:
        walk: the chain.
        paths: a power of two.
        draws: the source of every random number.
        negligible: share of checks and of cost that may be left to the geometric tail.

    Raises:
        NoQuadratureError: too many checks, or a cost without end.

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
            return Course(np.array(survival), np.array(cost), _later(survival), _later(cost), work)
        if mean < LOST or not np.isfinite(cost[-1]):
            raise NoQuadratureError(
                "kept errors cost more and more where Γ sees what Ψ does not; expected a Ψ that sees every growing "
                "direction of the error; simulate instead"
            )
        if mean**2 * count < DEGENERATE * float(weights @ weights):
            heirs = _heirs(weights, _left(paths, count, mean), float(draws.random()))
            errors, weights = errors[heirs], np.full(len(heirs), mean)
    raise NoQuadratureError(
        f"after {MOST_CHECKS} checks one of {1 / survival[-1]:.3g} errors is not sent yet; expected shorter intervals, "
        "from a smaller δ or more noise; simulate instead"
    )


def _left(paths: int, count: int, kept: float) -> int:
    """Return how many paths go on: in proportion to what they still decide, a power of two."""
    wanted = max(FEWEST, SPARE * kept * paths)
    return min(count, 1 << int(np.ceil(np.log2(wanted))))


def _heirs(weights: Array, count: int, offset: float) -> npt.NDArray[np.intp]:
    """Return whom each of so many heirs continues: systematic resampling."""
    ends: Array = np.asarray(np.cumsum(weights), dtype=np.float64)
    places = (np.arange(count) + offset) * (float(ends[-1]) / count)
    return np.clip(np.searchsorted(ends, places, side="right"), 0, len(weights) - 1)


def _chord(centre: Array, room: Array, pull: float) -> tuple[Array, Array]:
    """Return the ends of {t: pull (t − centre)² ≤ room}; far out where nothing pulls."""
    if pull == 0:
        return np.full(len(room), -FAR), np.full(len(room), FAR)
    half = np.sqrt(np.maximum(room, 0.0) / pull)
    return centre - half, centre + half


def _truncated(low: Array, high: Array, uniform: Array) -> tuple[Array, Array]:
    """Return draws of the normal law between two ends, and its share there; both on the side where it has digits."""
    mirrored = low + high > 0
    below = np.where(mirrored, -high, low)
    above = np.where(mirrored, -low, high)
    first = _scipy.normal_share(below)
    share = _scipy.normal_share(above) - first
    # mirrored draws take the points from the other end, so that the map from points to draws has no jump
    quantile = _scipy.normal_quantile(first + share * np.where(mirrored, 1 - uniform, uniform))
    draw = np.clip(quantile, below, above)
    return np.where(mirrored, -draw, draw), share


def _moments(low: Array, high: Array, share: Array, draw: Array) -> tuple[Array, Array]:
    """Return mean and mean square of such draws; those of the draw itself where the formula has lost its digits."""
    falls = [np.exp(-0.5 * np.square(np.clip(end, -FAR, FAR))) / np.sqrt(2 * np.pi) for end in (low, high)]
    known = (share > 1e-6) & (high - low > 0.1)
    safe = np.where(known, share, 1.0)
    first = (falls[0] - falls[1]) / safe
    second = 1 + (np.clip(low, -FAR, FAR) * falls[0] - np.clip(high, -FAR, FAR) * falls[1]) / safe
    return np.where(known, first, draw), np.where(known, second, draw * draw)


def _later(terms: list[float]) -> tuple[float, float]:
    """Return the sum of what follows if it is geometric as the last quarter is, and how far the last half says other.

    The sum is infinite where the terms do not fall; of a few terms all of it is in doubt.
    """
    quarter, half = max((len(terms) - 1) // 4, 1), max((len(terms) - 1) // 2, 1)
    if terms[-1] <= 0:
        return 0.0, 0.0
    ratios = [(terms[-1] / terms[-1 - back]) ** (1 / back) if terms[-1 - back] > 0 else 1.0 for back in (quarter, half)]
    if ratios[0] >= 1:
        return np.inf, np.inf
    sums = [terms[-1] * ratio / (1 - ratio) if ratio < 1 else np.inf for ratio in ratios]
    return sums[0], min(abs(sums[1] - sums[0]), sums[0]) if half > quarter else sums[0]
