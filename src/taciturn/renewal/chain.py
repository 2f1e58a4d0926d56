"""An error that each send resets to 0: its data, the results of its renewal analysis, and its reduced coordinates.

Before a check the error is e⁺ = F e + w. If e⁺'Ψe⁺ > δ, it is sent, and is 0 afterwards; otherwise it costs e⁺'Γe⁺. As
every send resets the error, the intervals between sends are independent and have one distribution, so that by renewal

    rate = 1/E[T],    excess = E[cost of an interval]/E[T],    E[T] = Σ_k P(T > k).

The methods work in as few coordinates as possible. First the directions are left out that the noise never reaches
(outside the span of G, FG, F²G, …, for noise of covariance GG'), then those that affect neither trigger nor cost, now
or later (which Ψ and Γ do not observe). For the quadrature the rest is transformed such that the noise is white and the
trigger diagonal: with the eigenvectors V and the eigenvalues m_i of G'ΨG/δ, the noise of x = (GV)⁻¹e is N(0, I), and x
is unsent if Σ_i m_i x_i² ≤ 1.

The size of the region that unsent errors reach is estimated with a random trigger, which does not send with probability
exp(−½ (π/2) Σ_i m_i x_i²), and hence has the mass of the interval m x² ≤ 1 along each axis. Under this rule the errors
are Gaussian at any number of checks since the last send, so that covariances and probabilities have a closed form.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from taciturn._arrays import Array, ArrayLike, count, number, symmetrised
from taciturn._display import Displayed
from taciturn._figure import HEIGHT, Panel, Series, Size, draw
from taciturn._modes import radius, root
from taciturn._style import StyleName
from taciturn.errors import ProblemError
from taciturn.model.plant import JumpNoise

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWN = 0.999  # probability of the intervals that a figure shows


class NoQuadratureError(ProblemError):
    """Raised for an error process that the quadratures do not support. The message states the reason and a remedy."""

    @property
    def reason(self) -> str:
        """The first part of the error message, which tells the reason; the expected value and a remedy follow."""
        return str(self).split("; ", 1)[0]


@dataclass(frozen=True, eq=False, repr=False)
class Chain(Displayed):
    """A discrete-time estimation error. Each check compares it with a threshold, and a send resets it to 0.

    Before a check the error is e⁺ = F e + w. If e⁺'Ψe⁺ > δ, it is sent, and the error is 0 after the check. Otherwise
    it is not sent, and costs e⁺'Γe⁺. The first check is one step after an error of 0.

    Args:
        F: map of the error from one check to the next, (n, n).
        noise: covariance of w ~ N(0, ·), (n, n), semidefinite; or jumps.
        Psi: Ψ, weight of the trigger, (n, n), semidefinite.
        delta: δ > 0, threshold of the trigger.
        Gamma: Γ, weight of the cost of an unsent error, (n, n), semidefinite.
    """

    F: Array
    noise: Array | JumpNoise
    Psi: Array
    delta: float
    Gamma: Array


@dataclass(frozen=True, eq=False, repr=False)
class Intervals(Displayed):
    """Distribution of the number of checks from one send to the next.

    Args:
        survival: P(interval > k) for k = 0, 1, …, which begins with 1, (checks,).
        decay: factor per check of the survival after these checks, in [0, 1).
    """

    survival: Array
    decay: float

    def plot(
        self,
        ax: Any = None,
        figsize: Size | None = None,
        style: StyleName = "light",
        *,
        measured: ArrayLike | None = None,
    ) -> Figure:
        """Draw the probability of each interval. If measured intervals are given, draw their histogram too.

        Args:
            ax: existing axes to draw in instead of a new figure.
            figsize: width and height of a new figure, in inches.
            style: ``"light"``, ``"dark"``, ``"paper"`` or ``"paper-wide"``.
            measured: numbers of checks between two sends, such as differences of the steps with a packet.
        """
        seen = np.zeros(0) if measured is None else np.asarray(measured, dtype=np.float64).ravel()
        if not (np.isfinite(seen) & (seen >= 1) & (seen == np.floor(seen))).all():
            raise ProblemError(
                "'measured' has an entry that is not a positive integer; expected positive integers, the numbers of "
                "checks"
            )
        most = int(max(self.quantile(SHOWN), 1, *seen.tolist()))
        checks, series = [float(k) for k in range(1, most + 1)], list[Series]()
        if seen.size:
            counts = np.bincount(seen.astype(np.int64), minlength=most + 1)[1:]
            shares, edges = (counts / seen.size).tolist(), [k - 0.5 for k in (*checks, most + 1.0)]
            series.append(Series(edges, shares, f"measured: {seen.size} intervals", "histogram", thing="trigger"))
        law = self.probability(most).tolist()
        series.append(Series(checks, law, "law", "points", thing="policy"))
        title = f"mean {self.mean:.4g} checks"
        panel = Panel(
            series, "checks from one send to the next", "probability", title, xlim=(0.4, most + 0.6), ylim=(0.0, None),
            height=0.7 * HEIGHT,
        )  # fmt: skip
        return draw([panel], ax, figsize, style)

    @property
    def mean(self) -> float:
        """Mean number of checks from one send to the next: Σ_k P(interval > k)."""
        return float(self.survival.sum() + self.survival[-1] * self.decay / (1 - self.decay))

    def probability(self, checks: int) -> Array:
        """Compute P(interval = k), the probability of k checks from one send to the next, for k = 1, …, checks.

        Raises:
            ProblemError: checks is not an integer of at least 1.
        """
        count("checks", checks)
        ticks = np.arange(checks + 1)
        return -np.diff(self.beyond(ticks.astype(np.float64)))

    def beyond(self, checks: ArrayLike) -> Array:
        """Compute P(interval > k), the probability of more than k checks between sends, for integers k ≥ 0.

        Raises:
            ProblemError: an entry is not an integer of at least 0.
        """
        given = np.asarray(checks)
        checks = np.asarray(given, dtype=np.float64) if given.dtype.kind in "iuf" else np.array(np.nan)
        if not (np.isfinite(checks) & (checks >= 0) & (checks == np.floor(checks))).all():
            raise ProblemError(
                "'checks' has an entry that is not a non-negative integer; expected non-negative integers, the "
                "numbers of checks"
            )
        last = len(self.survival) - 1
        inside = np.minimum(checks, last).astype(int)
        return self.survival[inside] * np.power(self.decay, np.maximum(checks - last, 0))

    def quantile(self, share: float) -> int:
        """Compute a quantile of the number of checks between sends: the least k with P(interval ≤ k) ≥ share.

        Raises:
            ProblemError: share is outside (0, 1).
        """
        left = 1 - number("share", share, 0.0, 1.0)
        found = np.flatnonzero(self.survival <= left)
        if found.size:
            return max(int(found[0]), 1)
        last = len(self.survival) - 1
        if self.decay == 0:
            return last + 1
        return last + int(np.ceil(np.log(left / self.survival[-1]) / np.log(self.decay)))


@dataclass(frozen=True, eq=False, repr=False)
class Renewal(Displayed):
    """Send rate and excess cost of an error process, with the error estimates of the quadrature.

    Args:
        rate: sends per check.
        excess: mean cost per check, E[(1−σ) e'Γe].
        rate_error: estimated absolute error of the rate.
        excess_error: estimated absolute error of the excess.
        intervals: distribution of the intervals between sends.
        nodes: number of nodes of the quadrature.
    """

    rate: float
    excess: float
    rate_error: float
    excess_error: float
    intervals: Intervals
    nodes: int

    def plot(self, ax: Any = None, figsize: Size | None = None, style: StyleName = "light") -> Figure:
        """Draw the distribution of the intervals from one send to the next."""
        return self.intervals.plot(ax, figsize, style)


CRUMB = 1e-13  # weight relative to the largest, below which it counts as rounding
RANK = 1e-10  # singular value relative to the largest, below which its direction counts as rounding
MOST_STATES = 3
SOFT = np.pi / 2  # exp(−SOFT m x²/2) has the mass of the interval m x² ≤ 1
SETTLED = 1e-6  # relative change below which a covariance is final
DOUBLINGS = 12  # 2^12 powers of a map decide which directions it reaches
AGES = 20_000  # most checks without a send


@dataclass(frozen=True, eq=False, repr=False)
class White(Displayed):
    """Error process x⁺ = F x + w with w ~ N(0, I). While Σ_i m_i x_i² ≤ 1, nothing is sent, and the error costs
    x'Γx.
    """

    F: Array  # map of the error from one check to the next, (n, n)
    m: Array  # weights of the trigger, ascending, so that the least bounded axes come first, (n,)
    Gamma: Array  # Γ, weight of the cost, (n, n)
    rows: Array  # map to these coordinates, x = rows e for an error e of the original chain, (n, states)


@dataclass(frozen=True, eq=False, repr=False)
class Data(Displayed):
    """An error process that each send resets to 0, scaled such that the trigger's threshold is 1."""

    F: Array  # map of the error from one check to the next, (n, n)
    noise: Array  # covariance of the noise, (n, n)
    Psi: Array  # Ψ/δ, (n, n)
    Gamma: Array  # Γ, weight of the cost, (n, n)
    rows: Array  # map from the coordinates of the original chain to these, (n, states)

    def seen_in(self, rows: Array, columns: Array) -> Data:
        """Express the error process in other coordinates z, with z = rows·e and e = columns·z."""
        return Data(
            rows @ self.F @ columns,
            symmetrised(rows @ self.noise @ rows.T),
            symmetrised(columns.T @ self.Psi @ columns),
            symmetrised(columns.T @ self.Gamma @ columns),
            rows @ self.rows,
        )


def reduced(chain: Chain) -> Data:
    """Remove the directions in which noise never moves the error, or which affect neither trigger nor cost."""
    if isinstance(chain.noise, JumpNoise):
        raise NoQuadratureError("the noise consists of jumps; expected Gaussian noise; use solve_jumps instead")
    data = _seen(_reached(Data(chain.F, chain.noise, chain.Psi / chain.delta, chain.Gamma, np.eye(len(chain.F)))))
    if not data.Psi.any():
        raise NoQuadratureError(
            "the policy would never send: the noise affects no direction of the error to which Ψ gives weight; "
            "expected at least one such direction: add process noise to the plant, or give weight to the states that "
            "the noise affects"
        )
    return data


def whiten(chain: Chain, otherwise: str = "simulate instead") -> White:
    """Transform an error process to as few coordinates as possible, with white noise and a diagonal trigger."""
    data = reduced(chain)
    n = len(data.F)
    if n > MOST_STATES:
        raise NoQuadratureError(
            f"noise affects {n} directions of the error that influence trigger or cost, but the quadrature supports "
            f"at most {MOST_STATES}; {otherwise}"
        )
    half = root(data.noise)
    if half.shape[1] < n:
        raise NoQuadratureError(
            f"the noise between two checks excites {half.shape[1]} of the {n} directions of the error that affect "
            f"trigger or cost, but the quadrature needs noise in all of them; {otherwise}"
        )
    m, turn = np.linalg.eigh(symmetrised(half.T @ data.Psi @ half))
    inverse: Array = np.asarray(np.linalg.inv(half @ turn), dtype=np.float64)
    white = data.seen_in(inverse, half @ turn)
    return White(white.F, np.where(m > 1e-15 * n * m[-1], m, 0.0), white.Gamma, white.rows)


def unsent_covariance(white: White) -> Array:
    """Approximate the covariance of the errors at which nothing is sent, as if a random trigger decided."""
    unit = np.eye(len(white.m))
    before, last, share = unit, np.zeros_like(unit), 1.0
    total, shares = np.zeros_like(unit), 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(AGES):
            soft = unit + SOFT * before * white.m
            kept = symmetrised(np.asarray(np.linalg.solve(soft, before), dtype=np.float64))
            share /= float(np.sqrt(max(np.linalg.det(soft), 1.0)))
            total, shares = total + share * kept, shares + share
            if not np.isfinite(total).all():
                break
            if np.abs(kept - last).max() <= SETTLED * np.abs(kept).max():
                return kept
            if share <= SETTLED * shares and share * np.abs(kept).max() <= SETTLED * np.abs(total).max():
                return total / shares
            last, before = kept, symmetrised(white.F @ kept @ white.F.T) + unit
        else:
            return total / shares
    raise NoQuadratureError(
        "without sends, the error grows without bound in a direction to which Ψ gives no weight; expected a Ψ that "
        "gives weight to every growing direction of the error; simulate instead"
    )


def _reached(data: Data) -> Data:
    """Return the data restricted to the directions that the noise reaches."""
    reach = _accumulated(data.F, root(data.noise))
    lengths = np.linalg.norm(reach, axis=1)
    unit = np.where(lengths > 0, lengths, 1.0)  # the result must not depend on the units of the states
    left, values, _ = np.linalg.svd(reach / unit[:, None], full_matrices=False)
    basis: Array = np.asarray(left[:, values > RANK * values.max(initial=0.0)], dtype=np.float64)
    weight: Array = np.asarray(values[: basis.shape[1]], dtype=np.float64)
    # each direction in units of the effect of the noise on it
    return data.seen_in((basis / weight).T / unit, unit[:, None] * basis * weight)


def _accumulated(F: Array, start: Array) -> Array:
    """Return a matrix whose columns span the images of some columns under all powers of F."""
    # If the first n powers do not span the whole space, the sum of 2^DOUBLINGS powers decides: with short periods, slow
    # modes differ only after many steps.
    size = float(np.linalg.norm(F, 2)) if F.any() else 1.0
    blocks = [start]
    for _ in range(len(F) - 1):
        blocks.append(F @ blocks[-1] / size)
    found = np.hstack(blocks)
    lengths = np.linalg.norm(found, axis=1)
    values = np.linalg.svd(found / np.where(lengths > 0, lengths, 1.0)[:, None], compute_uv=False)
    if (values > RANK * values.max(initial=0.0)).sum() == len(F) or not F.any():
        return found
    power, factor = F / max(radius(F), 1e-3 * size), start
    for _ in range(DOUBLINGS):
        wide = np.hstack([factor, power @ factor])
        factor = np.asarray(np.linalg.qr(wide.T, mode="r"), dtype=np.float64).T
        power = power @ power
    return factor


def _half(weight: Array) -> Array:
    """Return H with H'H = weight up to rounding; coordinates are in units of the effect of the noise on them."""
    values, vectors = np.linalg.eigh(weight / np.abs(weight).max())
    kept = values > CRUMB * len(weight)
    return (vectors[:, kept] * np.sqrt(values[kept])).T


def _seen(data: Data) -> Data:
    """Return the data without directions that affect neither trigger nor cost, now or later (unobservable ones)."""
    if not data.F.size:
        return data
    halves = [_half(weight) for weight in (data.Psi, data.Gamma) if weight.any()]
    effect = _accumulated(data.F.T, np.vstack([np.zeros((1, len(data.F))), *halves]).T)
    _, values, right = np.linalg.svd(effect.T, full_matrices=False)
    rows: Array = np.asarray(right[values > RANK * values.max(initial=0.0)], dtype=np.float64)
    return data.seen_in(rows, rows.T)
