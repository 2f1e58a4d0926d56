"""Lower confidence bounds on the cost of all send schedules for an error that a send resets to 0, by duality.

The error is e⁺ = F e(1−σ) + w, where σ is 1 at a send. Silence costs c(e) = e'Γe, and a send costs λ. Let t be the
check of the first send in a cycle, and M_t any martingale. Then

    D(g) = E min_{t≥1} [Σ_{j<t} (c(e_j) − g) − M_t]  ≤  inf_t E Σ_{j<t} (c(e_j) − g),

and any g with h(g) = λ − g + D(g) ≥ 0 is a lower bound on the mean cost per check. The martingale

    M_t = Σ_{j≤t} φ(e_j) − E[φ(e_j)|e_{j−1}],   φ = min(0, U),

with a fitted U (``fitted``) is nearly optimal. Its conditional means are averages over randomly shifted lattice points;
M remains a martingale with them (``Martingale``).

A path ends when its minimum is certain, because no schedule can save more than β from there on. To bound the largest
further saving S, let a be the present error, n_j the errors from 0, and r_t = min_a Σ_{j<t} c(F^j a + n_j) the residual
of a least-squares fit of a. Then S ≤ E max(max_{t≤T} (g t − r_t), g T − r_T + S), so any β at which the right-hand side
with S = β is below β is an upper bound. A path that is not certain after the last check is charged β.

h is concave, and its slope is minus a mean number of checks. Therefore its root g° satisfies, for either sign of h(g),

    g° ≥ g + ρ h(g),   ρ = 1/|h'(g°)|.

A pilot run, which may end before its minima are certain, locates the root approximately. Independent draws then give h
near the root, and the slope of h on either side bounds ρ. For a sum Σ c_i g°_i over independent loops, the ρ_i are
unknown constants, not random numbers. So the estimate of Σ c_i ρ_i h_i is unbiased and has the standard error of a sum
of independent terms for any values of them, and the bound uses the least value within their bounds (``bound_sum``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from taciturn.errors import ProblemError
from taciturn.extend import NO_VARIANCE, Array, Bits, Displayed, Progress, Stages, check_time, root
from taciturn_limits.fitted import Fitted, Lattice, decayed

BLOCK = 2**17  # numbers per block: larger blocks do not fit the cache, and their memory is allocated anew each time


class Martingale:
    """Martingale that is built from φ = min(0, U), where U is the cost of not sending minus the cost of a send.

    The Gaussian function (called bell) has the height and the curvature of φ at 0. Its conditional mean under Gaussian
    noise has a closed form, so that only the conditional mean of the rest, φ minus the bell, is sampled.
    """

    def __init__(self, F: Array, noise: Array, Gamma: Array, fitted: Fitted) -> None:
        """Compute the bell and its mean under the noise."""
        self.F, self.half, self.fitted = F, root(noise), fitted
        # M is a martingale only if every form is computed from the same factors: Π may have entries of 1e10, of which
        # the forms of correlated errors leave numbers of about 1
        self.cost, self.power = root(Gamma).T, root(fitted.Pi).T
        self.depth = fitted.gain + fitted.height  # of φ at 0
        bent = np.concatenate([2**0.5 * self.cost, fitted.height**0.5 * self.power]) / self.depth**0.5
        spread = bent @ self.half
        values, vectors = np.linalg.eigh(spread @ spread.T)
        widths = 1 + np.maximum(values, 0.0)
        self.blurred = (vectors / np.sqrt(widths)).T @ bent @ F
        self.less = float(np.prod(widths)) ** -0.5

    def after(self, error: Array, w: Array) -> Array:
        """Return the mean, over the given noises, of the function φ without its Gaussian part at the next check."""
        rows = max(1, BLOCK // (error.shape[1] * w.shape[1]))
        return np.concatenate([self._after(error[k : k + rows], w[k : k + rows]) for k in range(0, len(w), rows)])

    def _after(self, error: Array, w: Array) -> Array:
        mean = error @ self.F.T

        def spread(factor: Array) -> Array:
            before, added = mean @ factor.T, w @ factor.T
            found = 2 * before @ np.swapaxes(added, 1, 2)
            found += lengths(before)[:, :, None]
            found += lengths(added)[:, None]
            return found

        return self._off(spread(self.cost), spread(self.power)).mean(axis=2)

    def bell_after(self, error: Array) -> Array:
        """Return the mean of the Gaussian part of the function φ at the next check, for the present error."""
        return -self.depth * self.less * np.exp(-0.5 * lengths(error @ self.blurred.T))

    def now(self, error: Array) -> tuple[Array, Array]:
        """Return the function φ at each error in two parts: its Gaussian part, and the rest."""
        cost, power = lengths(error @ self.cost.T), lengths(error @ self.power.T)
        bell = -self.depth * np.exp(-(cost + (0.5 * self.fitted.height) * power) / self.depth)
        return bell, self._off(cost, power)

    def _off(self, cost: Array, power: Array) -> Array:
        """Return φ minus the bell, and overwrite both arguments; most of the time of a bound is spent here."""
        power *= 0.5
        bell = power * (self.fitted.height / -self.depth)
        bell -= cost / self.depth
        np.exp(bell, out=bell)
        bell *= self.depth
        kept = np.exp(np.negative(power, out=power), out=power)
        kept *= self.fitted.height
        cost -= self.fitted.gain
        cost -= kept
        np.minimum(cost, 0.0, out=cost)
        cost += bell
        return cost


def lengths(vectors: Array) -> Array:
    """Return the squared length of each vector along the last axis of an array."""
    return np.einsum("...i,...i->...", vectors, vectors)


ABREAST = 32  # batches that are computed together; their means are independent
MOST = 16  # most rounds of ABREAST batches
WORK = 5_000_000  # checks of all paths together, about, at most
PATHS, FEWEST = 64, 16  # paths of a batch: at most, and in a pilot run
NARROWER = 0.8  # fraction of unfinished paths below which the finished ones are removed from the arrays
PRECISE = 5e-4  # relative margin between estimate and bound that the confidence requires, to aim at
NOISES = 32  # noises in a conditional mean, plus as many mirrored ones
FREE = 2000  # paths without sends, from which the largest further saving is bounded
CERTAIN = 6.0  # standard errors that count as certain
ASIDE = 2.0  # distance from the root at which the slope is estimated, in CERTAIN errors of the pilot
SAFETY = 1.1
INTERVALS = 16  # mean intervals after which a pilot ends
LIKELY = 2.0  # further saving at which a path of a pilot ends, in prices; a larger one is unlikely
AWAY = 1.0  # times the depth of φ: a path this far above its minimum hardly ever reaches a lower one
HIGHEST = 1.25  # largest bound that is tried, times the fitted gain
LONGEST = 4096  # checks of a path
ROUNDS = 60


@dataclass(frozen=True, repr=False)
class SampledDual(Displayed):
    """Estimate of a lower bound g° on the mean cost per check, from simulation; g° is the root of a function h."""

    gain: float  # g, close to the root
    above: float  # unbiased estimate of h(g)
    error: float  # standard error of ``above``
    batches: int  # number of independent batches whose mean is ``above``
    least: float  # lower bound on ρ, from the slope of h above the root; 0 if unknown
    most: float  # upper bound on ρ, from the slope of h below the root; 1 if unknown
    expected: float  # estimate of the root
    checks: int  # number of checks of the longest path


def bound_sum(terms: Sequence[tuple[float, SampledDual]], confidence: float) -> float:
    """Compute a lower confidence bound on a weighted sum Σ c_i g°_i of independent estimates."""
    if not terms:
        return 0.0
    middle = sum(c * (one.gain + min(one.least * one.above, one.most * one.above)) for c, one in terms)
    spread = float(np.linalg.norm([c * one.most * one.error for c, one in terms]))
    return middle - float(stdtrit(min(one.batches for _, one in terms) - 1, confidence)) * spread


@dataclass(frozen=True, repr=False)
class DualBound(Displayed):
    """Lower bound on the mean cost per check, including the price of sends, valid for every send schedule."""

    gain: float  # the bound, at the requested confidence
    expected: float  # the estimate of which ``gain`` is the lower confidence limit
    checks: int  # number of checks of the longest path


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
    """Compute a lower bound on E[e'Γe(1−σ) + λσ] for all causal send schedules σ of the error e⁺ = F e(1−σ) + w."""
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
) -> SampledDual:
    """Estimate a lower bound on the mean cost per check, valid for every send schedule, by simulation."""
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
    gain = float(np.clip(gain, NO_VARIANCE, highest))
    aside = ASIDE * CERTAIN * spread / np.sqrt(ABREAST) / pilot.slope
    sides = [max(gain - aside, gain / 2), gain, min(gain + aside, highest)]
    saved = _most_saved(game, sides[2], fitted.interval, draws)
    below, here, beyond = _Duel(game, sides, saved, draws, paths, LONGEST, told.stage(0.05, 1.0)).run(batches)
    above = price - gain + float(here.least.mean())
    # certain that the root is above sides[0] (``before``) and below sides[2] (``after``): only then the slopes bound ρ
    before = price - sides[0] + below.end(below.least, -1) >= 0
    after = price - sides[2] + beyond.end(beyond.least, 1) <= 0
    return SampledDual(
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
    """The estimates of batches at one g."""

    least: Array  # mean minimum of each batch, (batches,)
    when: Array  # mean check at which the minimum is attained, an estimate of −h'(g), (batches,)
    checks: int  # number of checks of the longest path
    work: int  # number of checks of all paths

    @property
    def slope(self) -> float:
        """Estimate of −h'(g)."""
        return float(self.when.mean())

    def end(self, values: Array, side: int) -> float:
        """Return a lower (side −1) or upper (side 1) limit of a mean: its estimate ∓ six standard errors."""
        return float(values.mean() + side * CERTAIN * values.std(ddof=1) / np.sqrt(len(values)))


class _Duel:
    """Computes the minimum along each path for several g, in batches that share the noises of conditional means."""

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
        """Simulate the batches, ``ABREAST`` at a time, and return the estimates for each gain g."""
        found, rounds = list[tuple[Array, int, int]](), batches // ABREAST
        while len(found) < rounds:
            found.append(self._side_by_side())
            self.told(len(found) / rounds)
        sums = np.concatenate([sums for sums, _, _ in found], axis=2) / self.paths
        longest, work = max(last for _, last, _ in found), sum(work for _, _, work in found)
        return [_Outcome(sums[0, k], sums[1, k], longest, work) for k in range(len(self.gains))]

    def _side_by_side(self) -> tuple[Array, int, int]:
        """Return sums of minima and of their checks, (2, gains, batches), and the checks of the longest and of all."""
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
            # φ enters the martingale only on paths that may still reach a new minimum; this choice depends on the past
            # alone, so that M remains a martingale
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
            total = total + lengths(error @ game.cost.T)
            # the minimum is certain if even the largest further saving does not lower it
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
            if width < NARROWER * going.shape[1]:  # remove finished paths from the arrays
                first = np.argsort(~going, axis=1, kind="stable")[:, :width]
                going, total = np.take_along_axis(going, first, 1), np.take_along_axis(total, first, 1)
                least, when = np.take_along_axis(least, first[None], 2), np.take_along_axis(when, first[None], 2)
                error = np.take_along_axis(error, first[:, :, None], 1)
        raise AssertionError

    def _off(self, error: Array, near: Bits) -> Array:
        """Return the conditional mean of φ minus its Gaussian part where ``near``, else 0, (batches, paths)."""
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
    """Return the largest bound to try, at most halfway to the cost of silence, near which β grows without limit."""
    covariance = decayed(F, noise)
    if covariance is None:
        return HIGHEST * gain
    return min(HIGHEST * gain, (gain + float(np.sum(Gamma * covariance))) / 2)


def _most_saved(game: Martingale, gain: float, interval: float, draws: np.random.Generator) -> float:
    """Return β, an upper bound on the further saving of any schedule, from any error."""
    looks = max(16, int(4 * interval))
    while looks <= LONGEST:
        check_time()
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
        f"more than {LONGEST} checks may pass without a send before the cost of not sending certainly exceeds "
        "the price of a send; "
        "expected a lower price, or a higher rate, for a lower bound"
    )


def _left_over(game: Martingale, gain: float, looks: int, draws: np.random.Generator) -> tuple[Array, Array]:
    """Return an upper bound of max_{t≤T} (g t − r_t), and g T − r_T, of paths without sends."""
    n, weigh = len(game.F), game.cost
    stride = max(1, looks // 64)
    entries, error = len(weigh), np.zeros((FREE, n))
    seen, rows = np.empty((looks * entries, FREE)), np.empty((looks * entries, n))
    power, before, best, squares = np.eye(n), np.zeros(FREE), np.zeros(FREE), np.zeros(FREE)
    for check in range(1, looks + 1):
        check_time()
        end = check * entries
        rows[end - entries : end], seen[end - entries : end] = weigh @ power, weigh @ error.T
        squares = squares + (seen[end - entries : end] ** 2).sum(axis=0)
        if check % stride == 0 or check == looks:
            scale = np.abs(rows[:end]).max(axis=0)
            basis, triangle = np.linalg.qr(rows[:end] / np.where(scale > 0, scale, 1.0))
            basis = basis[:, np.abs(np.diag(triangle)) > 0]
            along = basis.T @ seen[:end]
            left = np.maximum(squares - (along * along).sum(axis=0), before)
            # r increases with t: its value at the start of a stride bounds it within the stride
            best = np.maximum(best, gain * check - before)
            before = left
        power = game.F @ power
        error = error @ game.F.T + draws.standard_normal((FREE, game.half.shape[1])) @ game.half.T
    return np.maximum(best, gain * looks - before), gain * looks - before
