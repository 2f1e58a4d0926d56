"""What no scheduling of an error that a send resets can beat: a lower bound by duality, with its confidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from taciturn._arrays import TINY, Array, Bits
from taciturn._modes import root, stationary
from taciturn._progress import Progress, Stages
from taciturn.errors import ProblemError, UnstableError
from taciturn.renewal._lattice import Lattice
from taciturn.renewal._martingale import Martingale
from taciturn.renewal.fitted import Fitted, squares

ABREAST = 32  # batches that run side by side; their means are independent
MOST = 16  # times as many, where that is no more
WORK = 5_000_000  # checks of all paths
PATHS, FEWEST = 64, 16  # of a batch: at most, and of a pilot
NARROWER = 0.8  # of the paths that are left, before the others are dropped
PRECISE = 5e-4  # of the bound: what the confidence should cost
NOISES = 32  # over which a conditional mean is taken, and as many mirrored
FREE = 2000  # paths that bound what is still to be saved
CERTAIN = 6.0  # standard errors
ASIDE = 2.0  # times the certain error of a pilot: how far on either side of the root its slope is taken
SAFETY = 1.1
INTERVALS = 16  # mean intervals after which a pilot ends
LIKELY = 2.0  # prices that hardly any path still saves: where those of a pilot end
AWAY = 1.0  # times the depth of φ: so far above its minimum a path hardly ever finds another
HIGHEST = 1.25  # times what the fit says: no bound is sought above, nor beyond halfway to what silence costs
LONGEST = 4096  # checks of a path
ROUNDS = 60


@dataclass(frozen=True)
class Sampled:
    """What draws tell of the root g° of h(g) = λ − g + D(g), below which the least mean cost of a check is not.

    h is concave, and its slope is minus a mean number of checks. So whatever the sign of h(g),

        g° ≥ g + ρ h(g),   ρ = 1/|h'(g°)|.

    Args:
        gain: g, about the root.
        above: an estimate of h(g) without bias.
        error: its standard error.
        batches: independent ones, of which that is the mean.
        least: what ρ is at least.
        most: what ρ is at most; as ``least``, where it is not told, by the slope of h on either side of the root.
        expected: about the root.
        checks: that the longest path took.
    """

    gain: float
    above: float
    error: float
    batches: int
    least: float
    most: float
    expected: float
    checks: int


def bound_sum(terms: Sequence[tuple[float, Sampled]], confidence: float) -> float:
    """Return a lower bound of a sum of roots Σ c_i g°_i, from independent draws.

    Whoever is right, the ρ_i are numbers and no draws: Σ c_i ρ_i h_i is estimated without bias, and has the standard
    error of independent terms. It is taken where it is least within the bounds of the ρ_i. No share of the confidence
    is lost to the number of terms.

    Args:
        terms: c_i ≥ 0, and what is known of each root.
        confidence: in (0, 1), one-sided.
    """
    if not terms:
        return 0.0
    middle = sum(c * (one.gain + min(one.least * one.above, one.most * one.above)) for c, one in terms)
    spread = float(np.linalg.norm([c * one.most * one.error for c, one in terms]))
    return middle - float(stdtrit(min(one.batches for _, one in terms) - 1, confidence)) * spread


@dataclass(frozen=True)
class DualBound:
    """No schedule has a mean cost per check, sends at their price included, below ``gain``.

    Args:
        gain: with this confidence.
        expected: the estimate that it is the lower end of.
        checks: that the longest path took.
    """

    gain: float
    expected: float
    checks: int


def bound_schedules(
    F: Array,
    noise: Array,
    Gamma: Array,
    price: float,
    fitted: Fitted,
    confidence: float,
    seed: int = 0,
    progress: Progress | None = None,
) -> DualBound:
    """Return a lower bound of min E[e'Γe(1−σ) + λσ] over all schedules σ of e⁺ = F e(1−σ) + w that look back only.

    Args:
        F: (n, n).
        noise: covariance of w, (n, n).
        Gamma: Γ, (n, n).
        price: λ > 0.
        fitted: a schedule that is nearly the best; the bound holds whatever it is.
        confidence: with which the bound holds, in (0, 1), one-sided.
        seed: of the draws.
        progress: called with the fraction done.

    Raises:
        ProblemError: what may still be saved has no bound within the longest path.

    Source: brown2010, rogers2002

    Example:
        >>> from taciturn.renewal.fitted import fit_schedule
        >>> unit = np.eye(1)
        >>> fitted = fit_schedule(unit, unit, unit, 10.0)
        >>> 0.98 < bound_schedules(unit, unit, unit, 10.0, fitted, 0.999).gain / fitted.gain < 1.02
        True
    """
    found = sample_dual(F, noise, Gamma, price, fitted, confidence, seed, progress=progress)
    return DualBound(max(bound_sum([(1.0, found)], confidence), 0.0), found.expected, found.checks)


def sample_dual(
    F: Array,
    noise: Array,
    Gamma: Array,
    price: float,
    fitted: Fitted,
    confidence: float,
    seed: int | Sequence[int] = 0,
    precise: float | None = None,
    progress: Progress | None = None,
) -> Sampled:
    """Return what bounds the least mean cost of a check from below, arguments as in ``bound_schedules``.

    With the first send of a cycle at the check t, c_j = e_j'Γe_j and any martingale M_t,

        D(g) = E min_{t≥1} [Σ_{j<t} (c_j − g) − M_t]  ≤  inf_t E Σ_{j<t} (c_j − g),

    and a g with λ − g + D(g) ≥ 0 is not above the least mean. M_t = Σ_{j≤t} φ(e_j) − E[φ(e_j)|e_{j−1}] with
    φ = min(0, U) of a fitted U is nearly the best. Conditional means are those of lattice points shifted at random,
    which keeps M a martingale.

    A path ends where the minimum is certain: whatever it sees later, no schedule saves more than β from there on.
    From any error a, with n_j the errors from 0 and r_t = min_a Σ_{j<t} c(F^j a + n_j) what a least-squares fit
    of a leaves, the most that is ever saved is at most E max(max_{t≤T} (g t − r_t), g T − r_T + itself): a β at which
    the right-hand side is below β is larger. A path that is not certain after the last check is charged β.

    A pilot, which need not be certain of its minima, tells about where the root is. Draws of their own tell h there
    and, on either side, its slope.

    Args:
        precise: what the confidence should cost, in the units of the gain; omitted: 5e-4 of it.
    """
    game = Martingale(F, noise, Gamma, fitted)
    draws, told = np.random.default_rng(seed), Stages(progress)
    highest = _highest(F, noise, Gamma, fitted.gain)
    saved = min(_most_saved(game, min(fitted.gain, highest), fitted.interval, draws), LIKELY * price)
    soon = int(np.clip(INTERVALS * fitted.interval, INTERVALS, LONGEST))
    (pilot,) = _Duel(game, [fitted.gain], saved, draws, FEWEST, soon, told.stage(0.0, 0.05)).run(ABREAST)
    spread, quantile = float(pilot.least.std(ddof=1)), float(stdtrit(ABREAST - 1, confidence))
    error = (precise or PRECISE * fitted.gain) / quantile if quantile > 0 else np.inf
    wanted = FEWEST * (spread / (error * pilot.slope)) ** 2  # paths
    batches = ABREAST * int(
        np.clip(np.ceil(wanted / PATHS / ABREAST), 1, min(MOST, max(WORK * FEWEST // (PATHS * pilot.work), 1)))
    )
    paths = int(np.clip(np.ceil(wanted / ABREAST), FEWEST, PATHS))
    gain = fitted.gain + (price - fitted.gain + float(pilot.least.mean())) / pilot.slope
    gain = float(np.clip(gain, TINY, highest))
    aside = ASIDE * CERTAIN * spread / np.sqrt(ABREAST) / pilot.slope
    sides = [max(gain - aside, gain / 2), gain, min(gain + aside, highest)]
    saved = _most_saved(game, sides[2], fitted.interval, draws)
    below, here, beyond = _Duel(game, sides, saved, draws, paths, LONGEST, told.stage(0.05, 1.0)).run(batches)
    above = price - gain + float(here.least.mean())
    before = price - sides[0] + below.end(below.least, -1) >= 0  # the root is above the first, and below the last
    after = price - sides[2] + beyond.end(beyond.least, 1) <= 0
    return Sampled(
        gain,
        above,
        float(here.least.std(ddof=1)) / np.sqrt(batches),
        batches,
        1 / beyond.end(beyond.when, 1) if after else 0.0,
        1 / max(below.end(below.when, -1), 1.0) if before else 1.0,
        gain + above / here.slope,
        here.checks,
    )


@dataclass(frozen=True, eq=False)
class _Outcome:
    """What batches find at one g.

    Args:
        least: the mean minimum of each batch, (batches,).
        when: the mean check it is at, which is how fast h falls with g, (batches,).
        checks: of the longest path.
        work: checks of all paths.
    """

    least: Array
    when: Array
    checks: int
    work: int

    @property
    def slope(self) -> float:
        """How fast h falls."""
        return float(self.when.mean())

    def end(self, values: Array, side: int) -> float:
        """Return the lower (−1) or upper (1) end of a mean, which is certain."""
        return float(values.mean() + side * CERTAIN * values.std(ddof=1) / np.sqrt(len(values)))


class _Duel:
    """Paths of which each takes its minimum at some g, in batches that share the noises of conditional means."""

    def __init__(
        self,
        game: Martingale,
        gains: Sequence[float],
        saved: float,
        draws: np.random.Generator,
        paths: int,
        longest: int,
        told: Stages,
    ) -> None:
        self.paths, self.longest = paths, longest
        self.game, self.gains, self.saved, self.draws = game, np.array(gains)[:, None, None], saved, draws
        self.rank, self.away, self.told = game.half.shape[1], AWAY * game.depth, told
        self.lattice = Lattice(NOISES, self.rank)

    def run(self, batches: int) -> list[_Outcome]:
        """Return what so many batches find at each g, a multiple of those that run side by side."""
        found, rounds = list[tuple[Array, int, int]](), batches // ABREAST
        while len(found) < rounds:
            found.append(self._side_by_side())
            self.told(len(found) / rounds)
        sums = np.concatenate([sums for sums, _, _ in found], axis=2) / self.paths
        longest, work = max(last for _, last, _ in found), sum(work for _, _, work in found)
        return [_Outcome(sums[0, k], sums[1, k], longest, work) for k in range(len(self.gains))]

    def _side_by_side(self) -> tuple[Array, int, int]:
        """Return the sums of minima and of their checks, (2, gains, batches), and the checks of the longest and all."""
        game, n = self.game, len(self.game.F)
        error: Array = np.zeros((ABREAST, self.paths, n))
        going: Bits = np.ones((ABREAST, self.paths), dtype=np.bool_)
        total: Array = np.zeros(going.shape)
        least: Array = np.full((len(self.gains), *going.shape), np.inf)
        when: Array = np.zeros(least.shape)
        sums, work = np.zeros((2, len(self.gains), ABREAST)), 0
        for check in range(1, self.longest + 1):
            self.told.tick()
            work += going.size
            nearly: Bits = np.asarray(total - (check - 1) * self.gains < least + self.away, dtype=np.bool_)
            near: Bits = np.asarray(going & nearly.any(axis=0), dtype=np.bool_)
            expected = game.bell_after(error) + self._off(error, near)
            drawn = self.draws.standard_normal((ABREAST, error.shape[1], self.rank))
            error = error @ game.F.T + drawn @ game.half.T
            bell, off = game.now(error)
            total = total + expected - bell - np.where(near, off, 0.0)
            sent = total - (check - 1) * self.gains
            lower = sent < least
            least, when = np.where(lower, sent, least), np.where(lower, check, when)
            total = total + squares(error, game.Gamma)
            saves = total - check * self.gains - self.saved
            if check == self.longest:
                least, when = np.minimum(least, saves), np.where(saves < least, check + 1, when)
            certain: Bits = np.asarray((saves >= least).all(axis=0), dtype=np.bool_)
            ends = going & (certain | (check == self.longest))
            sums += np.stack([np.where(ends, least, 0.0).sum(axis=2), np.where(ends, when, 0.0).sum(axis=2)])
            going = going & ~ends
            width = int(going.sum(axis=1).max())
            if not width:
                return sums, check, work
            if width < NARROWER * going.shape[1]:
                first = np.argsort(~going, axis=1, kind="stable")[:, :width]
                going, total = np.take_along_axis(going, first, 1), np.take_along_axis(total, first, 1)
                least, when = np.take_along_axis(least, first[None], 2), np.take_along_axis(when, first[None], 2)
                error = np.take_along_axis(error, first[:, :, None], 1)
        raise AssertionError

    def _off(self, error: Array, near: Bits) -> Array:
        """Return the conditional mean of φ less the bell for the errors that are near, (batches, paths), else 0."""
        expected, width = np.zeros(near.shape), int(near.sum(axis=1).max())
        if width:
            live: Bits = np.asarray(near.any(axis=1), dtype=np.bool_)
            w = self.lattice.normals(self.draws, ABREAST, live) @ self.game.half.T
            first = np.argsort(~near[live], axis=1, kind="stable")[:, :width]
            means = self.game.after(np.take_along_axis(error[live], first[:, :, None], 1), np.concatenate([w, -w], 1))
            found = np.zeros((len(first), near.shape[1]))
            np.put_along_axis(found, first, means, 1)
            expected[live] = found
        return np.where(near, expected, 0.0)


def _highest(F: Array, noise: Array, Gamma: Array, gain: float) -> float:
    """Return the highest bound to seek about a fitted gain; β grows without limit as it nears what silence costs."""
    try:
        silent = float(np.sum(Gamma * stationary(F, noise)))
    except UnstableError:  # or so near it that silence costs more than can be told
        return HIGHEST * gain
    return min(HIGHEST * gain, (gain + silent) / 2)


def _most_saved(game: Martingale, gain: float, interval: float, draws: np.random.Generator) -> float:
    """Return β, which no schedule saves more than, from any error on.

    Raises:
        ProblemError: within the longest path there is none.
    """
    looks = max(16, int(4 * interval))
    while looks <= LONGEST:
        best, last = _left_over(game, gain, looks, draws)
        saved = SAFETY * max(float(best.mean()), gain)
        for _ in range(ROUNDS):
            more = np.maximum(best, last + saved)
            gap = more - saved
            if gap.mean() + CERTAIN * gap.std() / np.sqrt(FREE) < 0:
                return saved
            saved = max(SAFETY * float(more.mean()), 1.1 * saved)
        looks *= 2
    raise ProblemError(
        f"an error may be kept for more than {LONGEST} checks before silence is sure to cost; expected a lower price "
        "or a higher rate for a lower bound"
    )


def _left_over(game: Martingale, gain: float, looks: int, draws: np.random.Generator) -> tuple[Array, Array]:
    """Return max_{t≤T} (g t − r_t) and g T − r_T of free paths, the maximum over whole strides of checks from above."""
    n, weigh = len(game.F), root(game.Gamma).T
    stride = max(1, looks // 64)
    entries, error = len(weigh), np.zeros((FREE, n))
    seen, rows = np.empty((looks * entries, FREE)), np.empty((looks * entries, n))
    power, before, best, squares = np.eye(n), np.zeros(FREE), np.zeros(FREE), np.zeros(FREE)
    for check in range(1, looks + 1):
        end = check * entries
        rows[end - entries : end], seen[end - entries : end] = weigh @ power, weigh @ error.T
        squares = squares + (seen[end - entries : end] ** 2).sum(axis=0)
        if check % stride == 0 or check == looks:
            scale = np.abs(rows[:end]).max(axis=0)
            basis, triangle = np.linalg.qr(rows[:end] / np.where(scale > 0, scale, 1.0))
            basis = basis[:, np.abs(np.diag(triangle)) > 0]
            along = basis.T @ seen[:end]
            left = np.maximum(squares - (along * along).sum(axis=0), before)
            best = np.maximum(best, gain * check - before)  # r grows with t
            before = left
        power = game.F @ power
        error = error @ game.F.T + draws.standard_normal((FREE, game.half.shape[1])) @ game.half.T
    return np.maximum(best, gain * looks - before), gain * looks - before
