"""The best scheduling of an error that a send resets, nearly: its value as the exponential of a quadratic."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, Bits, frozen, symmetrised
from taciturn._modes import radius, root
from taciturn.errors import ProblemError
from taciturn.renewal._lattice import Lattice
from taciturn.renewal.rare import bound_rate

PATHS = 1000
SNAPSHOTS = 100  # of the paths, whose kept errors are fitted to
LONGEST = 20_000  # checks in which every path should have been sent a few times
SENDS = 4  # those
RAREST = SENDS / LONGEST  # sends per check
SETTLE = 12  # time constants after which errors that decay have settled by themselves
POINTS = 1200  # at which the value is fitted, from near 0 to beyond the farthest
NEAREST, FARTHEST = 0.3, 1.5
SHARERS = 8  # errors over whose noises a mean is taken
NOISES = 128  # over which the value after a check is averaged, and as many mirrored
RANK = 1e-9  # relative standard deviation of a direction that no noise reaches
DIRECTIONS = 24  # of errors to which a value is fitted: its terms, some 300, take a gigabyte and half a minute
ITERATIONS, SETTLED = 100, 1e-7  # in many directions a fit may move forever within its own noise
DAMPING = 0.5
FULL = 1e-8  # relative entry of a triangle, above which its columns are independent
FLOOR = 1e-9  # of the price, below which a value is no longer told from 0


@dataclass(frozen=True, eq=False)
class Fitted:
    """Send iff e'Γe − height·exp(−½e'Πe) > gain.

    Args:
        gain: about the least mean of what a check costs, sends at their price included.
        height: what it saves at most to keep an error, on average.
        Pi: Π, (n, n), semidefinite.
        interval: mean checks between sends of the threshold policy whose errors it was fitted to.
    """

    gain: float
    height: float
    Pi: Array
    interval: float

    def sends(self, error: Array, Gamma: Array) -> Bits:
        """Tell which errors are sent, (errors, n) to (errors,)."""
        bell = self.height * np.exp(-0.5 * np.maximum(squares(error, self.Pi), 0.0))
        return squares(error, Gamma) - bell > self.gain


def fit_schedule(F: Array, noise: Array, Gamma: Array, price: float, seed: int = 0, points: int = POINTS) -> Fitted:
    """Return nearly the best schedule of e⁺ = F e(1−σ) + w where silence costs e'Γe and a send λ.

    The best sends iff U(e) = e'Γe − g + V(e) > 0 with V(e) = E min(0, U(F e + w)), and g such that λ − g + V(0) = 0.
    V is −exp(a − ½e'Πe) here: value iteration, each time fitted in least squares of log(−V), weighed with |V|, at
    errors that a threshold keeps.

    Args:
        F: (n, n).
        noise: covariance of w, (n, n).
        Gamma: Γ, (n, n), semidefinite.
        price: λ > 0, of a send.
        seed: of the errors it is fitted to.
        points: how many those are.

    Raises:
        ProblemError: at this price hardly anything is ever sent, or at none.

    Source: cogill2007

    Example:
        >>> found = fit_schedule(np.eye(1), np.eye(1), np.eye(1), 10.0)
        >>> 0 < found.gain < 10 and found.height > 0
        True
    """
    return Fitting(F, noise, Gamma, seed, points).at(price)


class Fitting:
    """Fits schedules to many prices: those of half an octave share the errors, and what stands there.

    Args:
        F: (n, n).
        noise: covariance of w, (n, n).
        Gamma: Γ, (n, n), semidefinite.
        seed: of the errors it is fitted to.
        points: how many those are.
    """

    def __init__(self, F: Array, noise: Array, Gamma: Array, seed: int = 0, points: int = POINTS) -> None:
        """Fit none yet."""
        self._given = F, noise, Gamma, seed, points
        self._grounds: tuple[float, _Ground] | None = None

    def at(self, price: float) -> Fitted:
        """Return nearly the best schedule at a price λ > 0, as ``fit_schedule``.

        Raises:
            ProblemError: at this price hardly anything is ever sent, or at none.
        """
        F, noise, Gamma, _, _ = self._given
        half = root(noise)
        if not any((np.linalg.matrix_power(F, k) @ half).T.dot(Gamma).any() for k in range(len(F))):
            raise ProblemError(
                "nothing is ever sent: the noise reaches no direction of the error that silence costs; expected some; "
                "give the plant noise, or weigh the states that it reaches"
            )
        # the same errors for all prices of half an octave, so that what is found changes smoothly with the price
        scale = float(np.sum(Gamma * noise)) or price
        about = scale * 2.0 ** (round(2 * math.log2(price / scale)) / 2)
        if self._grounds is None or self._grounds[0] != about:
            self._grounds = about, _stand(about, *self._given)
        return self._grounds[1].fit(price)


@dataclass(frozen=True, eq=False)
class _Ground:
    """Where a value is fitted: errors, and those a check later, over noises that a block of errors shares.

    Args:
        here: terms of the quadratic at the errors, (errors, terms).
        mean: of the errors after the check, (blocks, errors of one, size).
        noise: half of the noises, the others are mirrored, (blocks, noises, size).
        cost: of the errors after the check, (2, blocks, errors of one, noises).
        into: coordinates in which kept errors have about the covariance 1, (size, n).
        interval: mean checks between sends of the threshold that keeps them.
    """

    here: Array
    mean: Array
    noise: Array
    cost: Array
    into: Array
    interval: float

    def fit(self, price: float) -> Fitted:
        """Return the schedule at a price, by value iteration."""
        here, into = self.here, self.into
        size = len(into)
        gain, fit = price / 2, np.zeros(here.shape[1], dtype=np.float64)
        fit[: size + 1] = [np.log(price / 2), *[-0.2] * size]
        for _ in range(ITERATIONS):
            value = np.maximum(-self._saved(price, gain, fit), FLOOR * price)
            weight = value / price
            found = _least_squares(here * weight[:, None], np.log(value) * weight)
            change = max(abs(price - value[0] - gain) / price, np.abs(found - fit).max())
            gain, fit = max(gain + DAMPING * (price - value[0] - gain), FLOOR * price), found
            if change < SETTLED:
                break
        values, vectors = np.linalg.eigh(_weight(-2 * fit[1:], size))
        Pi = into.T @ (vectors * np.maximum(values, 0.0)) @ vectors.T @ into
        return Fitted(float(gain), float(np.exp(fit[0])), frozen(symmetrised(Pi)), self.interval)

    def _saved(self, price: float, gain: float, fit: Array) -> Array:
        """Return the mean over the noises of min(0, U) a check after each error, (errors,)."""
        bell = spread(self.mean, self.noise, _weight(fit[1:], len(self.into)))
        bell += fit[0]
        np.exp(np.minimum(bell, np.log(price), out=bell), out=bell)
        saved = np.subtract(self.cost, bell, out=bell)
        saved -= gain
        return np.minimum(saved, 0.0, out=saved).mean(axis=(0, 3)).ravel()


def spread(mean: Array, noise: Array, weight: Array) -> Array:
    """Return (m ± w)'M(m ± w), the plus first, of errors and of the noises that they share.

    Args:
        mean: m, (blocks, errors, n).
        noise: w, (blocks, noises, n).
        weight: M, (n, n), symmetric.

    Returns:
        (2, blocks, errors, noises).
    """
    crossed = 2 * (mean @ weight) @ np.swapaxes(noise, 1, 2)
    apart = squares(mean, weight)[:, :, None] + squares(noise, weight)[:, None]
    return np.stack([apart + crossed, apart - crossed])


def _stand(about: float, F: Array, noise: Array, Gamma: Array, seed: int, points: int) -> _Ground:
    """Return errors that a threshold keeps, and what stands there."""
    half = root(noise)
    if bound_rate(F, noise, Gamma, about) < RAREST:
        raise _too_rare()
    kept, interval = keep_errors(F, noise, lambda e: squares(e, Gamma) > about, seed)
    units = np.where(kept.std(axis=0) > 0, kept.std(axis=0), 1.0)
    _, deviations, right = np.linalg.svd(kept / units / np.sqrt(len(kept)), full_matrices=False)
    seen = deviations > RANK * deviations[0]
    into = (right[seen] / deviations[seen, None]) / units
    if len(into) > DIRECTIONS:
        raise ProblemError(
            f"the error moves in {len(into)} directions, and the value of keeping one is fitted in at most "
            f"{DIRECTIONS}; expected a plant with fewer states, or policy 'excess'"
        )
    draws = np.random.default_rng(seed)
    blocks = -(-(points + 1) // SHARERS)
    x = kept[draws.choice(len(kept), blocks * SHARERS)] * draws.uniform(NEAREST, FARTHEST, (blocks * SHARERS, 1))
    x[0] = 0.0
    w = Lattice(NOISES, half.shape[1]).normals(draws, blocks) @ half.T
    after = (x @ F.T).reshape(blocks, SHARERS, len(F))
    return _Ground(_terms(x @ into.T), after @ into.T, w @ into.T, spread(after, w, Gamma), into, interval)


def _least_squares(rows: Array, values: Array) -> Array:
    """Return the shortest x that is nearest to rows·x = values."""
    triangle: Array = np.asarray(np.linalg.qr(np.column_stack([rows, values]), mode="r"), dtype=np.float64)
    turned, upper = triangle[: rows.shape[1], -1], triangle[: rows.shape[1], :-1]
    diagonal = np.abs(np.diag(upper))
    if diagonal.min(initial=1.0) > FULL * diagonal.max(initial=0.0):
        return np.asarray(np.linalg.solve(upper, turned), dtype=np.float64)
    left, sizes, right = np.linalg.svd(upper, full_matrices=False)
    used = sizes > 1e-10 * sizes[0]
    return right[used].T @ (left[:, used].T @ turned / sizes[used])


def squares(x: Array, weight: Array) -> Array:
    """Return x'Mx of each row, (…, n) to (…,)."""
    return np.einsum("...i,...i->...", x @ weight, x)


def _terms(z: Array) -> Array:
    """Return 1, the squares and the products of the coordinates, (points, terms)."""
    d = z.shape[1]
    products = [z[:, i] * z[:, j] for i in range(d) for j in range(i)]
    return np.stack([np.ones(len(z)), *(z * z).T, *products], axis=1)


def _weight(terms: Array, d: int) -> Array:
    """Return M with z'Mz = Σ terms · (squares, products)."""
    M = np.diag(terms[:d])
    pairs = [(i, j) for i in range(d) for j in range(i)]
    for (i, j), value in zip(pairs, terms[d:], strict=True):
        M[i, j] = M[j, i] = value / 2
    return M


def keep_errors(F: Array, noise: Array, sends: Callable[[Array], Bits], seed: int = 0) -> tuple[Array, float]:
    """Return errors that a rule keeps, once every path was sent a few times, and the mean checks between sends.

    Args:
        F: (n, n).
        noise: covariance of w, (n, n).
        sends: tells which of some errors are sent, (errors, n) to (errors,).
        seed: of the draws.

    Returns:
        Errors, (any, n), all of those that occur if none is ever kept; and the interval, to a few per cent.

    Raises:
        ProblemError: hardly any is ever sent.
    """
    draws, half = np.random.default_rng(seed), root(noise)
    error, sent_ever, counted, checks = np.zeros((PATHS, len(F))), 0, 0, 0
    kept: list[Array] = []
    settle, growth = 8, radius(F)
    settled = SETTLE / (1 - growth) if growth < 1 else np.inf
    while checks < settle + SNAPSHOTS:
        error = error @ F.T + draws.standard_normal((PATHS, half.shape[1])) @ half.T
        sent = sends(error)
        checks, sent_ever = checks + 1, sent_ever + int(sent.sum())
        if checks > settle:
            kept.append(error[~sent])
            counted += int(sent.sum())
        error[sent] = 0.0
        if checks == settle and sent_ever < SENDS * PATHS and settle < settled:
            settle *= 2
            if settle > LONGEST:
                raise _too_rare()
    if sent_ever < RAREST * PATHS * checks:
        raise _too_rare()
    found = np.concatenate(kept)
    if not len(found):
        found = draws.standard_normal((PATHS, half.shape[1])) @ half.T
    return found, SNAPSHOTS * PATHS / max(counted, 1)


def _too_rare() -> ProblemError:
    return ProblemError(
        f"an error is sent less than once in {LONGEST // SENDS} checks; expected a lower price or threshold"
    )
