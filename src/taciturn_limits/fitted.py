"""Near-optimal send schedules for an error that a send resets to 0, computed from a fitted value function.

The error is e⁺ = F e(1−σ) + w, where σ is 1 at a send and 0 otherwise. Silence costs e'Γe, and a send costs λ. The
schedule with the least mean cost g per check sends if and only if

    U(e) = e'Γe − g + V(e) > 0,   V(e) = E min(0, U(F e + w)),   λ − g + V(0) = 0.

V is approximated by −exp(a − ½e'Πe), in any number of dimensions. In each value iteration, a and Π minimise the squared
errors of log(−V), weighted with |V|, at errors that a threshold policy does not send. The mean over w is one over Sobol
points, shifted by a random vector (``Lattice``), so that it has no bias [cranley1976].

Few sends. Let S = Γ + F'SF. A send at the error e saves at most e'Se, so that the optimal schedule never sends if
e'Se < λ. Let f = tr(ΓP) be the cost without sends, and ē ~ N(0, P) the error without sends. Every even schedule
satisfies

    g = f − E σ(e'Se − λ) ≥ f − E max(ē'Sē − λ, 0),

because ē − e is symmetric given e, and the tail of ē'Sē bounds the rate (``bound_rare_sends``). With q = ē'Sē =
Σ w_i z_i² for standard normal z_i, both are Chernoff bounds: for every 0 < s < 1/(2 max w), 1{q > x} ≤ exp(s(q − x))
and max(q − x, 0) ≤ exp(s(q − x) − 1)/s, with E exp(sq) = Π (1 − 2 s w_i)^{−1/2}.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from taciturn.errors import ProblemError, UnstableError
from taciturn.extend import (
    Array,
    Bits,
    Displayed,
    check_time,
    frozen,
    normal_quantile,
    number_of,
    radius,
    root,
    sobol,
    symmetrised,
)
from taciturn.lqg.equation import stationary


class Lattice:
    """A fixed set of Sobol points, to which each use adds a new random vector."""

    def __init__(self, points: int, dimensions: int) -> None:
        """Compute the points."""
        self.dimensions = dimensions
        self.places = _places(points, max(dimensions, 1))

    def normals(
        self, draws: np.random.Generator, copies: int, wanted: slice | npt.NDArray[np.bool_] = slice(None)
    ) -> Array:
        """Return standard normal samples, shape (copies, points, dimensions); each copy is a Sobol set shifted anew.

        Each copy is shifted by an independent uniform draw [cranley1976]. All shifts are drawn, and the wanted copies
        are returned.
        """
        levels = (self.places + draws.random((copies, 1, self.places.shape[1]))[wanted]) % 1.0
        found = normal_quantile(np.clip(levels, 1e-300, 1 - 1e-16))
        return found[..., : self.dimensions]


@cache
def _places(points: int, dimensions: int) -> Array:
    """Return Sobol points with a fixed seed, cached, as computing them takes longer than using them."""
    return frozen(sobol(dimensions, points, np.random.default_rng(points)))


SHARES = 1 - 2.0 ** -np.arange(0.25, 10.0, 0.25)  # exponents to try, relative to the largest with a finite moment


@dataclass(frozen=True, repr=False)
class Rarity(Displayed):
    """Bounds on the send rate and on the cost of the optimal schedule at a given price per send."""

    rate: float  # upper bound on its sends per check
    gain: float  # lower bound on its mean cost per check, including the price of the sends


def decayed(F: Array, W: Array) -> Array | None:
    """Return Σ_k F^k W F'^k; None if F is unstable, or so close to unstable that rounding errors decide.

    A mode on the unit circle, such as the position of a rigid body, may be computed as slightly inside of it.
    """
    if radius(F) >= 1:
        return None
    try:
        return stationary(F, W)
    except UnstableError:
        return None


def bound_rare_sends(F: Array, noise: Array, Gamma: Array, price: float) -> Rarity:
    """Bound the rate and the cost of the optimal schedule; the bounds are 1 and 0 if the error does not decay."""
    covariance, value = decayed(F, noise), decayed(F.T, Gamma)
    if covariance is None or value is None:
        return Rarity(1.0, 0.0)
    weights = _weights(covariance, value)
    if not weights.any():  # no noise, or none in the directions that Γ weighs
        return Rarity(0.0, 0.0)
    tail, beyond = bound_tail(weights, price)
    forever = float(np.sum(Gamma * covariance))
    return Rarity(min(1.0, tail), max(forever - beyond, 0.0))


def bound_rare_rate(F: Array, noise: Array, Gamma: Array, threshold: float) -> float:
    """Compute an upper bound on the send rate of the rule "send the error e if e'Γe > threshold".

    The bound is P(e'Γe > threshold) for the error without sends.

    An error that has not been sent is closer to 0 than an error without this condition (Gaussian correlation
    inequality).
    """
    covariance = decayed(F, noise)
    if covariance is None:
        return 1.0
    weights = _weights(covariance, Gamma)
    return min(1.0, bound_tail(weights, threshold)[0]) if weights.any() else 0.0


def bound_tail(weights: Array, limit: float) -> tuple[float, float]:
    """Compute Chernoff bounds on P(q > x) and E max(q − x, 0) for q = Σ w_i z_i²; the best of some s is used."""
    s = SHARES / (2 * weights.max())
    logs = -0.5 * np.log1p(-2 * s[:, None] * weights).sum(axis=1) - s * limit
    return float(np.exp(logs.min())), float(np.exp((logs - 1 - np.log(s)).min()))


def _weights(covariance: Array, square: Array) -> Array:
    """Return the weights w_i with x'Mx = Σ w_i z_i² for x ~ N(0, P) and standard normal z_i."""
    half = root(covariance)
    return np.maximum(np.linalg.eigvalsh(half.T @ square @ half), 0.0)


PATHS = 1000
SNAPSHOTS = 100  # checks at which unsent errors of all paths are collected for the fit
LONGEST = 20_000  # checks within which every path should have SENDS sends
SENDS = 4
RAREST = SENDS / LONGEST  # sends per check
SETTLE = 12  # time constants after which decaying errors are stationary even without sends
POINTS = 1200  # errors at which the value is fitted
NEAREST, FARTHEST = 0.3, 1.5  # these errors are simulated ones times a random factor in this range
SHARERS = 8  # errors that share the noises of their means
NOISES = 128  # noises over which the value after a check is averaged, plus as many mirrored ones
RANK = 1e-5  # relative standard deviation below which a direction is not fitted: entries of Π reach 1 / RANK²
DIRECTIONS = 24  # most directions of the error in a fit: its 300 or so terms take a gigabyte and half a minute
ITERATIONS, SETTLED = 100, 1e-7  # in many dimensions the iterates may keep varying within the sampling noise
DAMPING = 0.5
FULL = 1e-8  # relative diagonal entry of the QR factor above which the columns count as independent
FLOOR = 1e-9  # times the price: values below count as 0


@dataclass(frozen=True, eq=False, repr=False)
class Fitted(Displayed):
    """Near-optimal schedule that sends an error e if and only if e'Γe − height·exp(−½e'Πe) > gain."""

    gain: float  # approximation of the least mean cost per check, including the price of the sends
    height: float  # largest mean saving from not sending an error
    Pi: Array  # Π, (n, n), semidefinite
    interval: float  # mean number of checks between sends of the threshold policy whose errors were used for the fit

    def sends(self, error: Array, Gamma: Array) -> Bits:
        """Return, for each error, whether this schedule sends; errors have the shape (errors, n)."""
        bell = self.height * np.exp(-0.5 * np.maximum(squares(error, self.Pi), 0.0))
        return squares(error, Gamma) - bell > self.gain


def fit_schedule(F: Array, noise: Array, Gamma: Array, price: float, seed: int = 0, points: int = POINTS) -> Fitted:
    """Compute a near-optimal send schedule for the price λ of a send."""
    return Fitting(F, noise, Gamma, seed, points).at(price)


class Fitting:
    """Fits near-optimal send schedules to simulated errors, for any number of prices per send."""

    def __init__(self, F: Array, noise: Array, Gamma: Array, seed: int = 0, points: int = POINTS) -> None:
        """Start without a fit."""
        self._given = F, noise, Gamma, seed, points
        self._grounds: tuple[float, _Ground] | None = None

    def at(self, price: float) -> Fitted:
        """Compute a near-optimal send schedule for a price λ > 0 per send, as :func:`fit_schedule` does."""
        F, noise, Gamma, _, _ = self._given
        half = root(noise)
        if not any((np.linalg.matrix_power(F, k) @ half).T.dot(Gamma).any() for k in range(len(F))):
            raise ProblemError(
                "the policy would never send: the noise affects no direction of the error to which Γ gives weight; "
                "expected at least one such direction: add process noise to the plant, or give weight to the states "
                "that the noise affects"
            )
        # all prices within half an octave use the same errors, so that the result changes smoothly with the price
        scale = float(np.sum(Gamma * noise)) or price
        about = scale * 2.0 ** (round(2 * math.log2(price / scale)) / 2)
        if self._grounds is None or self._grounds[0] != about:
            self._grounds = about, _stand(about, *self._given)
        return self._grounds[1].fit(price)


@dataclass(frozen=True, eq=False)
class _Ground:
    """The errors at which a value function is fitted, and samples of the errors one check later."""

    here: Array  # terms of the quadratic form at the errors, (errors, terms)
    mean: Array  # mean of each error one check later, (blocks, errors per block, size)
    noise: Array  # half of the noises that the errors of a block share; the others are mirrored, (blocks, noises, size)
    cost: Array  # cost of the errors one check later, (2, blocks, errors per block, noises)
    into: Array  # map to coordinates in which unsent errors have about unit covariance, (size, n)
    interval: float  # mean number of checks between sends of the threshold policy that gave the errors

    def fit(self, price: float) -> Fitted:
        """Compute the near-optimal send schedule for a given price per send, by fitted value iteration."""
        here, into = self.here, self.into
        size = len(into)
        gain, fit = price / 2, np.zeros(here.shape[1], dtype=np.float64)
        fit[: size + 1] = [np.log(price / 2), *[-0.2] * size]
        for _ in range(ITERATIONS):
            check_time()
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
        """Return the mean over the noises of min(0, U) one check after each error, (errors,)."""
        bell = shifted_forms(self.mean, self.noise, _weight(fit[1:], len(self.into)))
        bell += fit[0]
        np.exp(np.minimum(bell, np.log(price), out=bell), out=bell)
        saved = np.subtract(self.cost, bell, out=bell)
        saved -= gain
        return np.minimum(saved, 0.0, out=saved).mean(axis=(0, 3)).ravel()


def shifted_forms(mean: Array, noise: Array, weight: Array) -> Array:
    """Return the quadratic forms (m + w)'M(m + w) and (m − w)'M(m − w) for all pairs of errors m and noises w."""
    crossed = 2 * (mean @ weight) @ np.swapaxes(noise, 1, 2)
    apart = squares(mean, weight)[:, :, None] + squares(noise, weight)[:, None]
    return np.stack([apart + crossed, apart - crossed])


def _stand(about: float, F: Array, noise: Array, Gamma: Array, seed: int, points: int) -> _Ground:
    """Return errors that the threshold policy e'Γe > about does not send, and samples one check later."""
    half = root(noise)
    if bound_rare_rate(F, noise, Gamma, about) < RAREST:
        raise _too_rare()
    kept, interval = keep_errors(F, noise, lambda e: squares(e, Gamma) > about, seed)
    units = np.where(kept.std(axis=0) > 0, kept.std(axis=0), 1.0)
    _, deviations, right = np.linalg.svd(kept / units / np.sqrt(len(kept)), full_matrices=False)
    seen = deviations > RANK * deviations[0]
    into = (right[seen] / deviations[seen, None]) / units
    if len(into) > DIRECTIONS:
        raise ProblemError(
            f"the error has {number_of(len(into), 'dimension')}, but its value function can be fitted in at most "
            f"{DIRECTIONS}; expected a plant with fewer states, or policy 'excess'"
        )
    check_time()
    draws = np.random.default_rng(seed)
    blocks = -(-(points + 1) // SHARERS)
    x = kept[draws.choice(len(kept), blocks * SHARERS)] * draws.uniform(NEAREST, FARTHEST, (blocks * SHARERS, 1))
    x[0] = 0.0
    w = Lattice(NOISES, half.shape[1]).normals(draws, blocks) @ half.T
    check_time()
    after = (x @ F.T).reshape(blocks, SHARERS, len(F))
    return _Ground(_terms(x @ into.T), after @ into.T, w @ into.T, shifted_forms(after, w, Gamma), into, interval)


def _least_squares(rows: Array, values: Array) -> Array:
    """Return the least-squares solution of rows·x = values of minimum norm."""
    triangle: Array = np.asarray(np.linalg.qr(np.column_stack([rows, values]), mode="r"), dtype=np.float64)
    turned, upper = triangle[: rows.shape[1], -1], triangle[: rows.shape[1], :-1]
    diagonal = np.abs(np.diag(upper))
    if diagonal.min(initial=1.0) > FULL * diagonal.max(initial=0.0):
        return np.asarray(np.linalg.solve(upper, turned), dtype=np.float64)
    left, sizes, right = np.linalg.svd(upper, full_matrices=False)
    used = sizes > 1e-10 * sizes[0]
    return right[used].T @ (left[:, used].T @ turned / sizes[used])


def squares(x: Array, weight: Array) -> Array:
    """Return the quadratic form x'Mx of each vector x along the last axis of an array."""
    return np.einsum("...i,...i->...", x @ weight, x)


def _terms(z: Array) -> Array:
    """Return 1, the squares of the coordinates, and their products, (points, terms)."""
    d = z.shape[1]
    products = [z[:, i] * z[:, j] for i in range(d) for j in range(i)]
    return np.stack([np.ones(len(z)), *(z * z).T, *products], axis=1)


def _weight(terms: Array, d: int) -> Array:
    """Return the matrix M with z'Mz = Σ terms · (squares, products)."""
    M = np.diag(terms[:d])
    pairs = [(i, j) for i in range(d) for j in range(i)]
    for (i, j), value in zip(pairs, terms[d:], strict=True):
        M[i, j] = M[j, i] = value / 2
    return M


def keep_errors(F: Array, noise: Array, sends: Callable[[Array], Bits], seed: int = 0) -> tuple[Array, float]:
    """Simulate a send rule; return errors at which it does not send, and the mean interval between sends.

    The errors are collected after a few sends on every path.
    """
    draws, half = np.random.default_rng(seed), root(noise)
    error, sent_ever, counted, checks = np.zeros((PATHS, len(F))), 0, 0, 0
    kept: list[Array] = []
    settle, growth = 8, radius(F)
    settled = SETTLE / (1 - growth) if growth < 1 else np.inf
    while checks < settle + SNAPSHOTS:
        check_time()
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
        f"errors are sent less than once in {LONGEST // SENDS} checks; expected a lower price or threshold"
    )
