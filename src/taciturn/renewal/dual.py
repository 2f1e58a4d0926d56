"""What no scheduling of an error that a send resets can beat: a lower bound by duality, with its confidence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from taciturn._arrays import Array, symmetrised
from taciturn._modes import root, stationary
from taciturn._progress import Progress, Stages
from taciturn.errors import ProblemError, UnstableError
from taciturn.renewal._lattice import Lattice
from taciturn.renewal.fitted import Bits, Fitted, squares

ABREAST = 32  # batches that run side by side; their means are independent
MOST = 16  # times as many, where that is no more
WORK = 5_000_000  # checks of all paths
PATHS = 64  # of a batch
NARROWER = 0.8  # of the paths that are left, before the others are dropped
PRECISE = 5e-4  # of the bound: what the confidence should cost
NOISES = 32  # over which a conditional mean is taken, and as many mirrored
FREE = 2000  # paths that bound what is still to be saved
CERTAIN = 6.0  # standard errors
SAFETY = 1.5
AWAY = 1.0  # times the depth of φ: so far above its minimum a path hardly ever finds another
HIGHEST = 1.25  # times what the fit says: no bound is sought above, nor beyond halfway to what silence costs
LONGEST = 4096  # checks of a path
ROUNDS = 60
BLOCK = 2**17  # numbers worked on at once: more leave the cache, and memory is asked for anew each time


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

    With the first send of a cycle at the check t, c_j = e_j'Γe_j and any martingale M_t,

        D(g) = E min_{t≥1} [Σ_{j<t} (c_j − g) − M_t]  ≤  inf_t E Σ_{j<t} (c_j − g),

    and a g with λ − g + D(g) ≥ 0 is not above the least mean. M_t = Σ_{j≤t} φ(e_j) − E[φ(e_j)|e_{j−1}] with
    φ = min(0, U) of a fitted U is nearly the best. Conditional means are those of lattice points shifted at random,
    which keeps M a martingale.

    A path ends where the minimum is certain: whatever it sees later, no schedule saves more than β from there on.
    From any error a, with n_j the errors from 0 and r_t = min_a Σ_{j<t} c(F^j a + n_j) what a least-squares fit
    of a leaves, the most that is ever saved is at most E max(max_{t≤T} (g t − r_t), g T − r_T + itself): a β at which
    the right-hand side is below β is larger. A path that is not certain after the last check is charged β.

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
    game = _Game(F, noise, Gamma, fitted)
    draws, told = np.random.default_rng(seed), Stages(progress)
    highest = _highest(F, noise, Gamma, fitted.gain)
    saved = _most_saved(game, highest, fitted.interval, draws)
    pilot = _Duel(game, fitted.gain, saved, draws, told.stage(0.0, 0.05)).run(ABREAST)
    above = price - fitted.gain + pilot.values
    spread, sure = float(above.std(ddof=1)), (1 + confidence) / 2  # of each of two runs at most
    quantile = float(stdtrit(ABREAST - 1, sure))
    wanted = (quantile * spread / (PRECISE * fitted.gain * pilot.slope)) ** 2
    batches = ABREAST * int(np.clip(np.ceil(wanted / ABREAST), 1, min(MOST, max(WORK // pilot.work, 1))))
    gain, slope, found = fitted.gain, pilot.slope, DualBound(0.0, fitted.gain, pilot.checks)
    for low, high in ((0.05, 0.5), (0.5, 1.0)):
        lower = (quantile + 1) * spread / np.sqrt(batches)
        gain = min(max(gain + (float(above.mean()) - lower) / slope, 0.0), highest)
        final = _Duel(game, gain, saved, draws, told.stage(low, high)).run(batches)
        above, slope = price - gain + final.values, final.slope
        mean, error = float(above.mean()), float(above.std(ddof=1)) / np.sqrt(batches)
        short = min(mean - float(stdtrit(batches - 1, sure)) * error, 0.0)
        lower = max(found.gain, gain + short)  # λ − g + D(g) falls at least as fast as g grows
        found = DualBound(float(lower), float(gain + mean / slope), max(found.checks, final.checks))
        if not short:  # else too much was asked for, and what was seen says what to ask of new draws
            break
    return found


class _Game:
    """The error, and the schedule that the martingale is made of: φ = min(0, U), and a bell near it.

    The bell has the height and the curvature of φ at 0, and Gaussian noise turns it into another bell. So its
    conditional mean is exact, and only that of φ less the bell is taken over noises.

    Args:
        F: (n, n).
        noise: covariance of w, (n, n).
        Gamma: Γ, (n, n).
        fitted: the schedule.
    """

    def __init__(self, F: Array, noise: Array, Gamma: Array, fitted: Fitted) -> None:
        """Find the bell and what noise makes of it."""
        self.F, self.half, self.Gamma, self.fitted = F, root(noise), Gamma, fitted
        self.depth = fitted.gain + fitted.height  # of φ at 0
        bent = (2 * Gamma + fitted.height * fitted.Pi) / self.depth
        spread = np.eye(len(F)) + noise @ bent
        self.blurred = symmetrised(bent @ np.linalg.inv(spread))
        self.less = float(np.linalg.det(spread)) ** -0.5

    def after(self, error: Array, w: Array) -> Array:
        """Return the means over the noises of φ less the bell after a check, (batches, paths).

        Args:
            error: (batches, paths, n).
            w: (batches, noises, n).
        """
        rows = max(1, BLOCK // (error.shape[1] * w.shape[1]))
        return np.concatenate([self._after(error[k : k + rows], w[k : k + rows]) for k in range(0, len(w), rows)])

    def _after(self, error: Array, w: Array) -> Array:
        mean, turned = error @ self.F.T, np.swapaxes(w, 1, 2)

        def spread(weight: Array) -> Array:
            crossed = 2 * (mean @ weight) @ turned
            crossed += squares(mean, weight)[:, :, None]
            crossed += squares(w, weight)[:, None]
            return crossed

        return self._off(spread(self.Gamma), spread(self.fitted.Pi)).mean(axis=2)

    def bell_after(self, error: Array) -> Array:
        """Return the conditional mean of the bell after a check."""
        return -self.depth * self.less * np.exp(-0.5 * squares(error @ self.F.T, self.blurred))

    def now(self, error: Array) -> tuple[Array, Array]:
        """Return the bell at each error, and φ less the bell."""
        cost, power = squares(error, self.Gamma), squares(error, self.fitted.Pi)
        bell = -self.depth * np.exp(-(cost + (0.5 * self.fitted.height) * power) / self.depth)
        return bell, self._off(cost, power)

    def _off(self, cost: Array, power: Array) -> Array:
        """Return φ less the bell, written over what it is given: most of the time of a bound goes here."""
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


@dataclass(frozen=True, eq=False)
class _Outcome:
    """Mean of the minimum of each batch, how fast it falls with g (and 1), checks of the longest path and of all."""

    values: Array
    slope: float
    checks: int
    work: int


class _Duel:
    """Paths of which each takes its minimum, in batches that share the noises of conditional means."""

    def __init__(self, game: _Game, gain: float, saved: float, draws: np.random.Generator, told: Stages) -> None:
        self.game, self.gain, self.saved, self.draws, self.told = game, gain, saved, draws, told
        self.rank = game.half.shape[1]
        self.away = AWAY * game.depth
        self.lattice = Lattice(NOISES, self.rank)

    def run(self, batches: int) -> _Outcome:
        """Return what so many batches find, a multiple of those that run side by side."""
        found, rounds = list[tuple[Array, Array, int, int]](), batches // ABREAST
        while len(found) < rounds:
            found.append(self._side_by_side())
            self.told(len(found) / rounds)
        slope = float(np.mean([when.mean() for _, when, _, _ in found]))
        longest, work = max(last for _, _, last, _ in found), sum(work for _, _, _, work in found)
        return _Outcome(np.concatenate([least for least, _, _, _ in found]), slope, longest, work)

    def _side_by_side(self) -> tuple[Array, Array, int, int]:
        """Return the mean minimum of each batch, the mean check it is at, the checks of the longest path and of all."""
        game, n = self.game, len(self.game.F)
        error, going = np.zeros((ABREAST, PATHS, n)), np.ones((ABREAST, PATHS), dtype=bool)
        total, least, when = np.zeros(going.shape), np.full(going.shape, np.inf), np.zeros(going.shape)
        sums, work = np.zeros((2, ABREAST)), 0
        for check in range(1, LONGEST + 1):
            work += going.size
            self.told.tick()
            near: Bits = np.asarray(going & (total < least + self.away), dtype=np.bool_)
            expected = game.bell_after(error) + self._off(error, near)
            drawn = self.draws.standard_normal((ABREAST, error.shape[1], self.rank))
            error = error @ game.F.T + drawn @ game.half.T
            bell, off = game.now(error)
            total = total + expected - bell - np.where(near, off, 0.0)
            lower = total < least
            least, when = np.where(lower, total, least), np.where(lower, check, when)
            total = total + squares(error, game.Gamma) - self.gain
            if check == LONGEST:
                least = np.minimum(least, total - self.saved)
            certain: Bits = np.asarray(total - self.saved >= least, dtype=np.bool_)
            ends = going & (certain | (check == LONGEST))
            sums += np.stack([np.where(ends, least, 0.0).sum(axis=1), np.where(ends, when, 0.0).sum(axis=1)])
            going = going & ~ends
            width = int(going.sum(axis=1).max())
            if not width:
                return sums[0] / PATHS, sums[1] / PATHS, check, work
            if width < NARROWER * going.shape[1]:
                first = np.argsort(~going, axis=1, kind="stable")[:, :width]
                going = np.take_along_axis(going, first, 1)
                total, least, when = (np.take_along_axis(a, first, 1) for a in (total, least, when))
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


def _most_saved(game: _Game, gain: float, interval: float, draws: np.random.Generator) -> float:
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


def _left_over(game: _Game, gain: float, looks: int, draws: np.random.Generator) -> tuple[Array, Array]:
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
