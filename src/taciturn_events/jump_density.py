"""Probability density of the sum of normally distributed jumps in one period, for a prediction error in the plane."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import erfc, exp, lgamma, log, sqrt

import numpy as np
import numpy.typing as npt
from numpy.polynomial import chebyshev

from taciturn.extend import Array, Displayed
from taciturn.renewal.chain import NoQuadratureError
from taciturn.renewal.quadrature import legendre

NEGLECTED_TAIL = 1e-10  # probability of the larger increments, which are neglected
TABLES_MEET = 0.5  # value of √(ρ/reach) at which the two radial tables meet
TAPER = 8  # power in the exponent of the window that ends the Fourier sum
RESOLVED = 1e-6  # largest characteristic function at the highest frequency, relative to its maximum


@dataclass(frozen=True, repr=False)
class Fineness(Displayed):
    """Numbers of quadrature nodes for the table of an error increment's probability density."""

    angles: int  # nodes of a table in the angle
    radii: int  # nodes in the radius of each of the two tables per angle
    waves: int  # frequencies of the Fourier sum per direction
    times: int = 200  # nodes of an integral over the period


@dataclass(frozen=True, eq=False, repr=False)
class CompoundPoissonNoise(Displayed):
    """Noise in a two-dimensional error between two checks: a sum of normally distributed jumps at Poisson times."""

    A: Array  # (2, 2) dynamics per second
    G: Array  # a jump is Gξ with standard normal ξ, (2, 1) or (2, 2)
    rate: float  # λ, jumps per second
    period: float  # τ, seconds

    @property
    def quiet(self) -> float:
        """Probability e^{−λτ} that no jump occurs in a period."""
        return exp(-self.rate * self.period)

    def moved(self, left: Array) -> Array:
        """Return the matrix e^{As}G, which maps a jump to the error that it causes s seconds later."""
        return plane_flow(self.A, left) @ self.G

    def covariance(self, times: int = 60) -> Array:
        """Return the covariance of the error increment due to the jumps of one period, shape (2, 2)."""
        left, weights = legendre_nodes(times, 0.0, self.period)
        moved = self.moved(left)
        return self.rate * np.einsum("k,kij,klj->il", weights, moved, moved)


def legendre_nodes(count: int, low: float = 0.0, high: float = 1.0) -> tuple[Array, Array]:
    """Return nodes and weights of Gauss–Legendre quadrature on an interval."""
    nodes, weights = legendre(count)
    return low + (high - low) * (nodes + 1) / 2, weights * (high - low) / 2


def _composite(count: int, edges: Array) -> tuple[Array, Array]:
    pairs = [legendre_nodes(count, float(low), float(high)) for low, high in pairwise(edges)]
    return np.concatenate([nodes for nodes, _ in pairs]), np.concatenate([weights for _, weights in pairs])


def plane_flow(A: Array, times: Array) -> Array:
    """Return the matrix exponentials e^{At} of a 2×2 matrix A for many times t in closed form, shape (…, 2, 2)."""
    # A = mean·I + rest, and rest² = −det(rest)·I (Cayley–Hamilton): the series of e^{rest·t} is a cosh and a sinh
    mean = float(np.trace(A)) / 2
    rest = A - mean * np.eye(2)
    turn = np.asarray(np.sqrt(complex(-np.linalg.det(rest))) * times, dtype=np.complex128)
    large = np.abs(turn) > 1e-4
    safe = np.where(large, turn, 1.0)
    sine: Array = np.real(np.where(large, np.sinh(safe) / safe, 1 + turn * turn / 6)) * times
    cosine: Array = np.real(np.cosh(turn))
    change = cosine[..., None, None] * np.eye(2) + sine[..., None, None] * rest
    return np.exp(mean * np.asarray(times))[..., None, None] * change


def cross(first: Array, second: Array) -> Array:
    """Return the signed area of the parallelogram that is spanned by two vectors."""
    return first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]


def eased(share: Array) -> Array:
    """Map quadrature nodes x in [0, 1] to 3x² − 2x³, which moves them closer to the ends of the interval.

    At both ends, the integrands have square roots and logarithms.
    """
    return share * share * (3 - 2 * share)


def _uneased(share: Array) -> Array:
    return 0.5 - np.sin(np.arcsin(np.clip(1 - 2 * share, -1, 1)) / 3)


def _chebyshev(count: int) -> Array:
    """Return the Chebyshev nodes on [0, 1]."""
    return (1 - np.cos(np.pi * (np.arange(count) + 0.5) / count)) / 2


def _coefficients(values: Array) -> Array:
    """Return the Chebyshev coefficients, along the first axis, of a function with these values at the nodes."""
    count = len(values)
    basis = chebyshev.chebvander(2 * _chebyshev(count) - 1, count - 1)
    found = (basis.T @ values.reshape(count, -1)) * (2 / count)
    found[0] /= 2
    return found.reshape(values.shape)


@dataclass(frozen=True, eq=False, repr=False)
class Rays(Displayed):
    """Probability density p of a two-dimensional error increment along rays from the origin, for each radius ρ.

    The probability of an area element is ρ p(ρ) dρ dθ.
    """

    tables: Array  # Chebyshev coefficients in √(ρ/reach) of ρ p without single jumps, below and above SPLIT
    single: Array  # amplitude of single jumps, whose ρ p is single·exp(−(ρ/size)²/2), (rays,)
    size: Array  # standard deviation of a single jump that points along the ray, (rays,)

    def part(self, chosen: npt.NDArray[np.bool_]) -> Rays:
        """Return the chosen rays."""
        return Rays(self.tables[:, chosen], self.single[chosen], self.size[chosen])

    def density(self, root: Array, radius: Array, outer: int) -> Array:
        """Return the density times the radius, ρ·p(ρ), for the given radii on each ray, shape (rays, nodes).

        The radii are given as √(ρ/reach) and as ρ.

        All radii must lie in the same radial table.
        """
        table, low = self.tables[outer], TABLES_MEET * outer
        turn = 2 * (root - low) / TABLES_MEET - 1
        last, before = np.zeros_like(root), np.zeros_like(root)
        for k in range(table.shape[1] - 1, 0, -1):  # Clenshaw's recurrence sums the Chebyshev series
            last, before = table[:, k : k + 1] + 2 * turn * last - before, last
        many = table[:, :1] + turn * last - before
        return many + self.single[:, None] * np.exp(-((radius / self.size[:, None]) ** 2) / 2)


class Density:
    """Probability density of the increment of a two-dimensional error over one period with at least one jump.

    A single jump of rank one has a density only in the cone that its direction sweeps until the check; this part has a
    closed form. The density of two such jumps has a logarithmic singularity and is integrated over both times. The
    density of more jumps, or of jumps of rank two, is smooth enough for a Fourier sum of the characteristic function.
    """

    def __init__(self, shower: CompoundPoissonNoise, fineness: Fineness) -> None:
        """Store the noise and the accuracy."""
        self.shower, self.fineness = shower, fineness
        self.flat = shower.G.shape[1] == 1
        sizes = np.linalg.norm(shower.moved(legendre_nodes(60, 0.0, shower.period)[0]), 2, axis=(-2, -1))
        self.reach = jump_reach(float(sizes.max()), shower.rate * shower.period)
        self._times, self._turns = self._sweep() if self.flat else (np.zeros(0), np.array([0.0, np.pi / 2]))
        low, high = float(self._turns[0]), float(self._turns[-1])
        # sector 0 is the cone of single jumps; its edges are the only angles at which the density is not smooth
        self.sectors = ((low, high), (high, low + np.pi))
        self._tables = [self._table(sector) for sector in range(2)]

    def _sweep(self) -> tuple[Array, Array]:
        """Return times from a jump to the check, and the angle of the jump at the check, in the order of the angle."""
        times = np.linspace(0.0, self.shower.period, 2001)
        moved = self.shower.moved(times)[..., 0]
        angles = np.unwrap(np.arctan2(moved[:, 1], moved[:, 0]))
        if not 1e-6 < abs(angles[-1] - angles[0]) < 0.99 * np.pi:
            raise NoQuadratureError(
                f"the direction of a jump turns by {abs(angles[-1] - angles[0]):.3g} rad within a period; expected an "
                "angle above 0 and below 3.14 rad (half a turn); check more often, or simulate"
            )
        return (times, angles) if angles[-1] > angles[0] else (times[::-1], angles[::-1])

    def _left(self, angles: Array) -> Array:
        """Return the times from a jump to the check at which the jump then points in given directions."""
        times = np.interp(angles, self._turns, self._times)
        rays = np.stack([np.cos(angles), np.sin(angles)], -1)
        for _ in range(3):  # Newton's method, from the interpolated table
            moved = self.shower.moved(times)[..., 0]
            times = times - cross(rays, moved) / cross(rays, moved @ self.shower.A.T)
        return np.clip(times, 0.0, self.shower.period)

    def _table(self, sector: int) -> Array:
        """Return the coefficients of ρ p in the eased angle and in √(ρ/reach), (2, angles, radii)."""
        low, high = self.sectors[sector]
        angles = low + (high - low) * eased(_chebyshev(self.fineness.angles))
        share = _chebyshev(self.fineness.radii)
        radii = self.reach * np.concatenate([TABLES_MEET * share, TABLES_MEET + TABLES_MEET * share]) ** 2
        rays = np.stack([np.cos(angles), np.sin(angles)], -1)
        values = self._fourier((rays[:, None] * radii[:, None]).reshape(-1, 2)).reshape(len(angles), -1)
        if self.flat:
            lefts = self._left(angles) if sector == 0 else np.full(len(angles), np.nan)
            values += np.array([self._two(ray, radii, float(left)) for ray, left in zip(rays, lefts, strict=True)])
        halves = (values * radii).reshape(len(angles), 2, -1)
        return np.stack([_coefficients(_coefficients(halves[:, k]).T).T for k in range(2)])

    @cached_property
    def _spectrum(self) -> tuple[Array, Array]:
        """Return frequencies and the characteristic function of at least one jump (of rank one: of at least three)."""
        # λ ∫ exp(−½|wave·jump|²) dt is the exponent of the characteristic function of a compound Poisson process
        shower, count = self.shower, self.fineness.waves
        waves = np.pi / self.reach * np.arange(-(count // 2), count // 2)
        jumps = np.zeros((count, count // 2))
        left, weights = legendre_nodes(self.fineness.times, 0.0, shower.period)
        for moved, weight in zip(shower.moved(left), weights, strict=True):
            seen = sum((waves[:, None] * g[0] + waves[count // 2 :] * g[1]) ** 2 for g in moved.T)
            jumps += shower.rate * weight * np.exp(-seen / 2)
        few = jumps < 0.05  # where the differences would cancel, so that a series is used
        if self.flat:
            series = jumps**3 / 6 * (1 + jumps / 4 * (1 + jumps / 5 * (1 + jumps / 6)))
            spectrum = np.where(few, series, np.expm1(jumps) - jumps - jumps**2 / 2)
        else:
            spectrum = np.expm1(jumps)
            if max(spectrum[0].max(), spectrum[:, -1].max()) > RESOLVED * spectrum.max():
                raise NoQuadratureError(
                    "the distribution of the jumps is nearly degenerate: in one direction it is much narrower than the "
                    "change of the state in one period; simulate instead"
                )
        if self.flat:  # a sharp end of the sum would cause oscillations in the tables
            share = np.hypot(waves[:, None], waves[count // 2 :]) / waves[-1]
            spectrum *= np.exp(-36 * share**TAPER)
        spectrum[:, 0] /= 2  # only half of the frequencies is stored, by symmetry; column 0 would count twice
        return np.asarray(waves, dtype=np.float64), spectrum * shower.quiet

    def _fourier(self, places: Array) -> Array:
        waves, spectrum = self._spectrum
        along, across = np.outer(waves, places[:, 0]), np.outer(waves[len(waves) // 2 :], places[:, 1])
        real = np.einsum("kp,kp->p", np.cos(along), spectrum @ np.cos(across))
        imaginary = np.einsum("kp,kp->p", np.sin(along), spectrum @ np.sin(across))
        return 2 * (real - imaginary) / (2 * self.reach) ** 2

    def _two(self, ray: Array, radii: Array, left: float) -> Array:
        """Return the density of the sum of two jumps along a ray.

        Given the times of both jumps, their sum is normal. The integrand over the two times is nearly singular where
        both jumps point along the ray, and has a logarithm where the times are equal: nodes are dense at both places.
        """
        # the square of both times is divided at the corner (left, left), where both jumps point along the ray
        shower, period = self.shower, self.shower.period
        sizes, weights = _composite(6, np.r_[0.0, np.exp2(np.arange(-14.0, 1.0))])
        close, crowd = _composite(8, np.array([0.0, 1.0, 3.0, 6.0, 10.0, 16.0, 32.0]))
        near, near_weights = -np.expm1(-close), crowd * np.exp(-close)
        far, far_weights = _composite(8, np.array([0.0, 0.002, 0.03, 0.15, 0.5, 1.0]))
        inside = left == left
        corner = left if inside else period / 2
        above, up = (corner, period - corner) if inside else (0.0, corner)
        below, down = (corner, corner) if inside else (period, corner)
        size, same = sizes[:, None], np.ones_like(near)
        after, before = period - corner, corner
        pieces = [
            (above + up * size * near, above + up * size * same, up**2 * size * weights[:, None] * near_weights),
            (below - down * size * same, below - down * size * near, down**2 * size * weights[:, None] * near_weights),
        ]
        area, same = before * after * size * weights[:, None] * far_weights, np.ones_like(far)
        pieces.append((corner - before * size * same, corner + after * size * far, area))
        pieces.append((corner - before * size * far, corner + after * size * same, area))
        exponents, masses = list[Array](), list[Array]()
        for first, second, mass in pieces:
            one, two = shower.moved(first)[..., 0], shower.moved(second)[..., 0]
            spanned = np.abs(cross(one, two))
            kept = spanned > 0
            spanned = np.where(kept, spanned, 1.0)
            # N(0, one one' + two two') at ρ·ray: exp(−½ρ² exponent)/(2π spanned)
            exponent = (cross(ray, two) ** 2 + cross(one, ray) ** 2) / spanned**2
            kept &= exponent * radii[0] ** 2 < 80
            exponents.append(exponent[kept])
            masses.append((mass / (2 * np.pi * spanned))[kept])
        decay = np.exp(-np.outer(radii**2 / 2, np.concatenate(exponents)))
        return shower.rate**2 * shower.quiet * (decay @ np.concatenate(masses))

    def rays(self, angles: Array, sector: int) -> Rays:
        """Return the probability density of the error increment along rays whose angles lie in one sector."""
        low, high = self.sectors[sector]
        table = self._tables[sector]
        basis = chebyshev.chebvander(2 * _uneased((angles - low) / (high - low)) - 1, table.shape[1] - 1)
        single, size = np.zeros(len(angles)), np.ones(len(angles))
        if self.flat and sector == 0:
            moved = self.shower.moved(self._left(angles))[..., 0]
            size = np.hypot(moved[:, 0], moved[:, 1])
            turning = np.abs(cross(moved, moved @ self.shower.A.T)) / size**2
            single = self.shower.rate * self.shower.quiet / np.sqrt(2 * np.pi) / size / turning
        return Rays(basis @ table, single, size)


def jump_reach(jump: float, mean: float) -> float:
    """Return a radius that the sum of one period's jumps exceeds only with negligible probability."""
    counts = range(1, int(mean + 12 * sqrt(mean) + 30))
    chances = [exp(m * log(mean) - mean - lgamma(m + 1)) for m in counts]
    distance = jump
    while sum(p * erfc(distance / (sqrt(2 * m) * jump)) for m, p in zip(counts, chances, strict=True)) > NEGLECTED_TAIL:
        distance *= 1.05
    return distance
