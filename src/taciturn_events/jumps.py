"""Compute send rate and extra cost for an error with normally distributed jumps at Poisson times, by quadrature.

The error is checked every τ seconds, and is not sent while it lies in the set E of all e with e'Ψe ≤ δ. With the
probability q = e^{−λτ}, a period is without a jump, and then e⁺ = F e exactly. So an expectation over later checks is
discontinuous wherever F^j e leaves E. After a jump it is smooth, since the density of the jumps makes it so. The
renewal equations are therefore written for errors after a jump. Let p be the density of the error after a period with a
jump, whose integral is the probability 1 − q of a jump, and v the expected sum over the checks from the next jump on,
times the probability that a jump occurs in the next period. The error is still unsent after j checks without a jump if
e, Fe, …, F^j e ∈ E, so that

    v = Σ_j q^j ∫ p(e) (a + v)(F^j e) de   over these e,

with a = 1 to count checks and a = e'Γe for costs. From the error 0 after a send they give the mean number of checks and
the mean cost of a cycle, and by recursion over the checks the distribution of the intervals (``Sums``).

A few even polynomials represent v, and every integral is split at the edges of the sets:

* A scalar error (``Line``): Gauss-Legendre nodes on the interval of unsent errors. The density is the Fourier series of
  its characteristic function.
* An error in the plane (``Plane``), scaled so that its increment over a period has unit covariance: along rays from
  each node. The integral over the angle is split at the tangents to the sets and at the directions of their corners,
  between which chords depend smoothly on the angle. A long set is truncated where hardly any error comes.
  ``jump_density`` has the density along the rays.

``solve_jumps`` reduces the error to the directions that matter, and refines the nodes until two results agree.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev

from taciturn.extend import Array, Displayed, OutOfTime, Progress, Stages, number, number_of, root, symmetrised
from taciturn.model.plant import JumpNoise
from taciturn.renewal.chain import Chain, Intervals, NoQuadratureError, Renewal
from taciturn_events.jump_density import (
    TABLES_MEET,
    CompoundPoissonNoise,
    Density,
    Fineness,
    Rays,
    eased,
    jump_reach,
    legendre_nodes,
)

GONE = 1e-10  # survival probability below which a single decay factor is used for all later checks
MOST = 20_000  # checks at which a survival function is computed
STEADY = 1e-12  # relative change of the decay factor per check below which the factor counts as constant


@dataclass(frozen=True, eq=False, repr=False)
class Sums(Displayed):
    """Discretised renewal equations of an error with jumps: one row per quadrature node, and a last row for e = 0."""

    basis: Array  # values of the basis polynomials at the nodes, (nodes, nodes)
    steps: Array  # for each j, the integrals of the polynomials at F^j e, (checks, nodes + 1, nodes)
    ones: Array  # for each j, the integrals of 1, (checks, nodes + 1)
    costs: Array  # for each j, the integrals of the cost, (checks, nodes + 1)
    quiet: float  # e^{−λτ}, the probability of no jump in a period
    # for each j, the integrals of a high power of the distance, relative to the distance at which the set is
    # truncated, (checks, nodes + 1)
    far: Array

    @cached_property
    def _last(self) -> Array:
        """Weight of each j; the last weight includes all larger j, as a geometric series."""
        weights = np.ones(len(self.steps))
        weights[-1] = 1 / (1 - self.quiet)
        return weights

    @cached_property
    def _whole(self) -> tuple[Array, Array]:
        """Return the integrals, summed over j."""
        sides = np.stack([self._last @ part for part in (self.ones, self.costs, self.far)], -1)
        return np.tensordot(self._last, self.steps, 1), sides

    @cached_property
    def _cycle(self) -> Array:
        # v at the nodes, then at the error 0; without a jump this error stays 0, which gives the factor 1/(1 − quiet)
        steps, sides = self._whole
        after = np.linalg.solve(self.basis - steps[:-1], sides[:-1])
        return (steps[-1] @ after + sides[-1] + np.array([1.0, 0.0, 0.0])) / (1 - self.quiet)

    def cycle(self) -> tuple[float, float]:
        """Return the mean number of checks between two sends, and the mean cost of such an interval."""
        return float(self._cycle[0]), float(self._cycle[1])

    def outskirts(self) -> float:
        """Return a bound on the share of checks at which an unsent error is outside the region of the quadrature."""
        return float(abs(self._cycle[2] / self._cycle[0]))

    def intervals(self, mean: float) -> Intervals:
        """Compute the distribution of the number of checks between two sends; ``mean`` is its mean."""
        # past[k]: P(no send at the next k + 1 checks, and a jump in the next period), as coefficients of the basis;
        # origin[k]: the same from the error 0
        inverse = np.linalg.inv(self.basis)
        steps, ones = inverse @ self.steps[:, :-1], self.ones[:, :-1] @ inverse.T
        count = len(self.steps)
        past, origin, survival = [ones[0]], [self.ones[0, -1]], [1.0]
        weights = np.power(self.quiet, np.arange(count))
        decay = before = 0.0
        while survival[-1] > GONE and len(survival) < MOST:
            k = len(past)
            recent = np.array(past[: -count - 1 : -1])
            stood = np.array(origin[: -count - 1 : -1])
            survival.append(float(weights[: len(stood)] @ stood) + self.quiet**k)
            decay, before = survival[-1] / survival[-2], decay
            if k > count and abs(decay - before) < STEADY * (1 - decay):
                break
            here = steps[: len(recent)]
            fresh = np.einsum("jab,jb->a", here, recent)
            raised = float(np.einsum("jb,jb->", self.steps[: len(recent), -1], recent))
            past.append(fresh + (ones[k] if k < count else 0.0))
            origin.append(raised + (self.ones[k, -1] if k < count else 0.0))
        rest = max(mean - sum(survival), 0.0)
        return Intervals(np.array(survival), rest / (survival[-1] + rest))


BREAKING = 1  # checks without a jump whose sets split also the integral over the angle
CROWDED, CROWDING = 0.7, 4.0  # slopes to the longer axis that split the integral over the angle: largest, and ratio
DISTINCT = 1e-10  # least angle between two splits, radians
MOST_PLANE_NODES = 1600
DISTANCE_POWER = 16  # power of the distance (relative to the truncation), whose mean shows how far errors come


@dataclass(frozen=True, repr=False)
class PlaneGrid(Displayed):
    """Numbers of quadrature nodes for a two-dimensional error."""

    along: int  # nodes along the longer axis of the set, an even number
    across: int  # nodes along the shorter axis
    angles: int  # angles between two splits
    radii: int  # nodes on a piece of a ray
    checks: int  # checks without a jump that are followed one by one
    cut: float  # where the longer axis is truncated, in standard deviations of the increment of a period
    density: Fineness  # numbers of nodes in the tables of the density


class Plane:
    """A two-dimensional error with Poisson jumps, scaled so that its increment per period has unit covariance."""

    def __init__(self, shower: CompoundPoissonNoise, F: Array, Psi: Array, Gamma: Array) -> None:
        """Store the coordinates."""
        root = np.linalg.cholesky(shower.covariance())
        inverse = np.linalg.inv(root)
        self.shower = replace(shower, A=inverse @ shower.A @ root, G=inverse @ shower.G)
        self.F, self.Psi, self.Gamma = inverse @ F @ root, root.T @ Psi @ root, root.T @ Gamma @ root
        values, self.axes = np.linalg.eigh(self.Psi)
        self._densities = dict[Fineness, Density]()
        self.long, self.short = (float(1 / np.sqrt(max(value, 1e-14 * values[1]))) for value in values)

    def density(self, fineness: Fineness) -> Density:
        """Return the probability density of the error increment over a period with at least one jump; it is cached."""
        if fineness not in self._densities:
            self._densities[fineness] = Density(self.shower, fineness)
        return self._densities[fineness]

    def sums(self, grid: PlaneGrid) -> Sums:
        """Discretise the renewal equations of this error on a grid of quadrature nodes."""
        if grid.along * grid.across > 2 * MOST_PLANE_NODES:
            raise NoQuadratureError(
                f"between sends, the error spreads over a region that needs {grid.along} × {grid.across} quadrature "
                "nodes, more than are supported; the threshold is large compared with the noise in one period: check "
                "less often, or simulate"
            )
        return _Operator(self, grid).sums()


class _Operator:
    """Computes the integrals of a chain in the plane on a grid."""

    def __init__(self, plane: Plane, grid: PlaneGrid) -> None:
        self.plane, self.grid = plane, grid
        self.density = plane.density(grid.density)
        self.cut = min(grid.cut, plane.long)
        self.widest = float(np.arcsin(self.cut / plane.long))
        powers = [np.eye(2)]
        for _ in range(grid.checks):
            powers.append(plane.F @ powers[-1])
        self.powers = np.array(powers)
        # set j holds the errors that are unsent after j checks without a jump: (F^j e)'Ψ(F^j e) ≤ 1, truncated
        edge = plane.axes[:, 0] / self.cut
        sides = [plane.Psi, np.outer(edge, edge)][: 2 if grid.cut < plane.long else 1]
        self.sets = np.array([[power.T @ side @ power for side in sides] for power in powers])
        self.corners = self._corners()
        self.narrow = [d for matrix in self.sets[: BREAKING + 1, 0] for d in self._narrow(matrix)]
        orders = np.add.outer(np.arange(grid.along), np.arange(grid.across))
        self.even = orders % 2 == 0  # expectations are even functions of the error

    def sums(self) -> Sums:
        """Return the equations."""
        grid = self.grid
        along = np.cos(np.pi * (np.arange(grid.along) + 0.5) / grid.along)
        across = np.cos(np.pi * (np.arange(grid.across) + 0.5) / grid.across)
        first, second = (part.ravel() for part in np.meshgrid(along[along > 0], across, indexing="ij"))
        starts = np.concatenate([self._error(first, second) @ self.plane.F.T, np.zeros((1, 2))])
        rows = [self._row(start) for start in starts]
        values = chebyshev.chebvander(first, grid.along - 1)[:, :, None]
        basis = (values * chebyshev.chebvander(second, grid.across - 1)[:, None])[:, self.even]
        return Sums(
            basis,
            np.stack([row[0] for row in rows], 1),
            np.stack([row[1] for row in rows], 1),
            np.stack([row[2] for row in rows], 1),
            self.plane.shower.quiet,
            np.stack([row[3] for row in rows], 1),
        )

    def _error(self, along: Array, across: Array) -> Array:
        """Return the errors at coordinates in [−1, 1]²: an angle and a fraction of the chord, smooth on a disc."""
        angle = along * self.widest
        long = self.plane.long * np.sin(angle)[:, None] * self.plane.axes[:, 0]
        return long + (self.plane.short * np.cos(angle) * across)[:, None] * self.plane.axes[:, 1]

    def _coordinates(self, errors: Array) -> tuple[Array, Array]:
        sine = np.clip(errors @ self.plane.axes[:, 0] / self.plane.long, -1, 1)
        chord = np.sqrt(np.maximum(1 - sine * sine, 1e-30)) * self.plane.short
        along = np.clip(np.arcsin(sine) / self.widest, -1, 1)
        return along, np.clip(errors @ self.plane.axes[:, 1] / chord, -1, 1)

    def _corners(self) -> list[Array]:
        """Return the points where the boundaries of two sets meet on the boundary of the intersection of all sets."""
        found = list[Array]()
        sides = self.sets.shape[1]
        matrices = self.sets[: BREAKING + 1].reshape(-1, 2, 2)
        for i in range(len(matrices)):
            for k in range(i):
                for direction in _null_directions(matrices[i] - matrices[k]):
                    corner = direction / np.sqrt(direction @ matrices[i] @ direction)
                    if (corner @ matrices[: (i // sides + 1) * sides] @ corner).max() < 1 + 1e-9:
                        found += [corner, -corner]
        return found

    def _narrow(self, matrix: Array) -> list[Array]:
        """Return directions close to the longer axis of a set, where the length of chords changes fast."""
        values, axes = np.linalg.eigh(matrix)
        slope = float(1 / np.sqrt(values[1])) / self.density.reach
        found = [axes[:, 0]] if slope < CROWDED else []
        while slope < CROWDED:
            found += [axes[:, 0] + slope * axes[:, 1], axes[:, 0] - slope * axes[:, 1]]
            slope *= CROWDING
        return found

    def _breaks(self, start: Array) -> Array:
        """Return the angles, over half a turn, between which chords through a point depend smoothly on the angle.

        From a point outside a set these are the tangents. From a point inside it is the direction of the chord that the
        point bisects: this chord becomes short as the point approaches the boundary.
        """
        directions = [corner - start for corner in self.corners] + self.narrow
        for matrix in self.sets[: BREAKING + 1].reshape(-1, 2, 2):
            normal = matrix @ start
            outside = float(start @ normal) - 1
            if outside > 0:
                directions += _null_directions(np.outer(normal, normal) - outside * matrix)
            elif outside > -0.95:
                directions.append(np.array([-normal[1], normal[0]]))
        low, middle = self.density.sectors[0]
        angles = low + np.mod([np.arctan2(y, x) - low for x, y in directions], np.pi)
        angles = np.sort(np.concatenate([angles, [low, middle, low + np.pi]]))
        kept = angles[np.append(np.diff(angles) > DISTINCT, True)]
        kept[0] = low
        return kept

    def _rays(self, start: Array) -> tuple[Array, Array, Rays]:
        """Return directions and weights of rays from a point, and the density along them."""
        breaks = self._breaks(start)
        nodes, weights = legendre_nodes(self.grid.angles)
        widths = np.diff(breaks)[:, None]
        angles = (breaks[:-1, None] + widths * eased(nodes)).ravel()
        # 6x(1 − x) is the derivative of ``eased``
        weights = (widths * 6 * nodes * (1 - nodes) * weights).ravel()
        within = angles < self.density.sectors[0][1]
        parts = [self.density.rays(angles[within], 0), self.density.rays(angles[~within], 1)] * 2
        both = Rays(
            np.concatenate([part.tables for part in parts], 1),
            np.concatenate([part.single for part in parts]),
            np.concatenate([part.size for part in parts]),
        )
        # both directions along each chord: the density is even, so that opposite rays share their tables
        angles = np.concatenate([angles, angles + np.pi])
        return np.stack([np.cos(angles), np.sin(angles)], -1), np.tile(weights, 2), both

    def _row(self, start: Array) -> tuple[Array, ...]:
        """Return the integrals from one starting point, for each number of checks without a jump."""
        directions, weights, rays = self._rays(start)
        count = len(self.sets)
        steps, sides = np.zeros((count, int(self.even.sum()))), np.zeros((3, count))
        low, high = np.zeros(len(directions)), np.full(len(directions), self.density.reach)
        for j, edges in enumerate(self.sets):
            # an error counts at check j if it lies in all sets so far: each ray is clipped to the part [low, high]
            for side in edges:
                low, high = _narrowed(low, high, start, directions, side)
            chosen = high > low
            if not chosen.any():
                break
            low, high, directions, weights, rays = (
                low[chosen], high[chosen], directions[chosen], weights[chosen], rays.part(chosen),
            )  # fmt: skip
            count = self.grid.radii if j == 0 else self.grid.radii * 3 // 5
            for outer in range(2):  # the two radial tables meet at SPLIT, so each part of a ray is integrated by itself
                span = TABLES_MEET * outer, TABLES_MEET + TABLES_MEET * outer
                first, last = (np.clip(np.sqrt(end / self.density.reach), *span) for end in (low, high))
                met = last > first
                if met.any():
                    ends, part = (first[met], last[met]), rays.part(met)
                    errors, mass = self._piece(start, j, ends, directions[met], part, outer, count)
                    mass = mass * weights[met, None] * self.plane.shower.quiet**j
                    steps[j] += self._polynomials(errors, mass.ravel())
                    sides[:, j] += self._sides(errors, mass.ravel())
        return steps, *sides

    def _polynomials(self, errors: Array, mass: Array) -> Array:
        """Return the integrals of the basis polynomials."""
        along, across = self._coordinates(errors)
        seen = chebyshev.chebvander(along, self.grid.along - 1) * mass[:, None]
        return (seen.T @ chebyshev.chebvander(across, self.grid.across - 1))[self.even]

    def _sides(self, errors: Array, mass: Array) -> Array:
        """Return the integrals of 1, of the cost, and of a high power of the distance."""
        cost = mass @ np.einsum("qi,qi->q", errors @ self.plane.Gamma, errors)
        return np.array([mass.sum(), cost, mass @ (errors @ self.plane.axes[:, 0] / self.grid.cut) ** DISTANCE_POWER])

    def _piece(
        self, start: Array, check: int, ends: tuple[Array, Array], directions: Array, rays: Rays, outer: int, count: int
    ) -> tuple[Array, Array]:
        """Return errors on a piece of every ray after a number of checks, and their probabilities, (rays, nodes)."""
        # ρ = reach·root², so that dρ = 2·reach·root d(root)
        nodes, weights = legendre_nodes(count)
        width = (ends[1] - ends[0])[:, None]
        roots = ends[0][:, None] + width * nodes
        radii = self.density.reach * roots * roots
        mass = 2 * self.density.reach * roots * width * weights * rays.density(roots, radii, outer)
        places = start + radii[..., None] * directions[:, None]
        return places.reshape(-1, 2) @ self.powers[check].T, mass


def _null_directions(matrix: Array) -> list[Array]:
    """Return the directions d with d'Md = 0: none, or two."""
    a, b, c = float(matrix[0, 0]), float(matrix[0, 1]), float(matrix[1, 1])
    square = b * b - a * c
    if square <= 0:
        return []
    q = -(b + np.copysign(np.sqrt(square), b))
    return [np.array([q, a]), np.array([c, q])]


def _narrowed(low: Array, high: Array, start: Array, directions: Array, matrix: Array) -> tuple[Array, Array]:
    """Return the part of each ray that also lies in the set e'Me ≤ 1."""
    # a ρ² + 2bρ + c ≤ 0; q/a and c/q are the roots without cancellation
    a = np.maximum(np.einsum("ri,ij,rj->r", directions, matrix, directions), 1e-300)
    b, c = directions @ matrix @ start, float(start @ matrix @ start) - 1
    square = b * b - a * c
    hit = square > 0
    q = -(b + np.copysign(np.sqrt(np.maximum(square, 0.0)), b))
    q = np.where(q == 0, 1e-300, q)
    ends = np.sort(np.stack([q / a, c / q]), axis=0)
    return np.where(hit, np.maximum(low, ends[0]), 1.0), np.where(hit, np.minimum(high, ends[1]), 0.0)


MOST_LINE_NODES = 1000
FADED = 9.0  # frequency times the smallest standard deviation at which the characteristic function is negligible


@dataclass(frozen=True, repr=False)
class Line(Displayed):
    """A scalar error with Poisson jumps; the sensor sends if the absolute value of the error exceeds a threshold."""

    a: float  # dynamics between jumps, ė = a e, per second
    jump: float  # standard deviation of a jump
    rate: float  # λ, jumps per second
    period: float  # τ, seconds between two checks
    F: float  # factor of the error from one check to the next, without jumps
    bound: float  # an error e is sent if |e| is above it
    Gamma: float  # Γ, weight of the cost of an unsent error

    def sums(self, fineness: float, checks: int) -> Sums:
        """Discretise the renewal equations of this error; the number of nodes is proportional to ``fineness``.

        Given the times of the jumps, the increment of a period is normal. The narrowest of these normal densities sets
        the scale of all nodes.
        """
        # a jump grows by e^{a·left} in the time ``left`` from the jump to the check
        left, weights = legendre_nodes(60, 0.0, self.period)
        sizes = self.jump * np.exp(self.a * left)
        narrow, distance = float(sizes.min()), jump_reach(float(sizes.max()), self.rate * self.period)
        count = 2 * int(fineness * (6 + 1.5 * min(self.bound, self.bound * abs(self.F) + distance) / narrow))
        if max(count, fineness * distance / narrow) > MOST_LINE_NODES:
            raise NoQuadratureError(
                f"between sends, the error spreads over {self.bound / narrow:.3g} standard deviations of the smallest "
                "jump, more than this quadrature supports; check less often, or simulate"
            )
        # Fourier series on [−distance, distance] of the density of at least one jump: its characteristic function is
        # e^{−λτ} (exp(λ ∫ e^{−(wave·size)²/2} dt) − 1)
        waves = np.pi / distance * np.arange(1, int(FADED * distance / narrow / np.pi) + 2)
        logs = self.rate * np.exp(-np.outer(waves**2 / 2, sizes**2)) @ weights
        quiet = float(np.exp(-self.rate * self.period))
        spectrum = quiet * np.concatenate([[np.expm1(self.rate * self.period) / 2], np.expm1(logs)]) / distance
        # all expectations are even functions of the error: half of the nodes and the even polynomials suffice
        nodes = np.cos(np.pi * (np.arange(count) + 0.5) / count) * self.bound
        starts = np.append(nodes[: count // 2] * self.F, 0.0)
        basis = chebyshev.chebvander(nodes[: count // 2] / self.bound, count - 2)[:, ::2]
        # the density is replaced by a polynomial, as it is evaluated at far more points than there are waves
        density = chebyshev.Chebyshev.interpolate(
            lambda place: np.cos(np.outer(place, np.append(0.0, waves))) @ spectrum,
            int(40 + 6 * distance / narrow), domain=[0.0, distance],
        )  # fmt: skip
        steps, sides = np.zeros((checks + 1, len(starts), count // 2)), np.zeros((2, checks + 1, len(starts)))
        # an error ``place`` after a jump is unsent after j checks without a jump if |F^i place| ≤ bound, i = 0 … j
        for j in range(checks + 1):
            power = self.F**j
            low = np.maximum(-self.bound / max(1.0, abs(power)), starts - distance)
            width = np.maximum(np.minimum(self.bound / max(1.0, abs(power)), starts + distance) - low, 0.0)
            pieces = 1 + int(width.max() / (4 * narrow))
            local, masses = _pieces(int(fineness * 12), pieces)
            places = low[:, None] + width[:, None] * local
            mass = quiet**j * width[:, None] * masses * density(np.abs(places - starts[:, None]))
            moved = places * power
            steps[j] = np.einsum("rq,rqb->rb", mass, chebyshev.chebvander(moved / self.bound, count - 2)[..., ::2])
            sides[:, j] = mass.sum(1), (mass * moved**2).sum(1) * self.Gamma
        return Sums(np.asarray(basis, dtype=np.float64), steps, sides[0], sides[1], quiet, np.zeros_like(sides[0]))


def _pieces(count: int, pieces: int) -> tuple[Array, Array]:
    nodes, weights = legendre_nodes(count)
    starts = np.arange(pieces)[:, None] / pieces
    return (starts + nodes / pieces).ravel(), np.tile(weights / pieces, pieces)


RANK = 1e-10  # relative: a smaller singular value is rounding
SAFETY = 16.0  # claimed error over the change at the last refinement; in the plane the levels share part of it
USELESS = 0.01  # claimed relative error above which a result is rejected
FLOOR = 1e-11  # relative error due to rounding
FORGOTTEN = 1e-12  # probability below which a longer run of checks without a jump is not followed
LONGEST = {1: 400, 2: 80}  # checks without a jump that are followed one by one, by dimension
RARE = 1e-3  # largest probability of more checks without a jump than LONGEST
FAR = 1e-6  # largest fraction of the checks with an error beyond the truncation of the set
CUTS = 14  # how many times the truncation is moved outwards
FINENESS = (Fineness(32, 24, 384), Fineness(48, 40, 800), Fineness(56, 48, 1200))


def solve_jumps(chain: Chain, accuracy: float = 1e-7, progress: Progress | None = None) -> Renewal:
    """Compute send rate and extra cost of an error with normally distributed jumps at Poisson times."""
    number("accuracy", accuracy, 0.0)
    noise = chain.noise
    if not isinstance(noise, JumpNoise):
        raise NoQuadratureError(
            "the noise does not consist of jumps; expected jump noise, the only noise that this quadrature supports"
        )
    if noise.jumps.distribution != "normal":
        raise NoQuadratureError(
            f"jumps with the distribution '{noise.jumps.distribution}' have no smooth density; expected 'normal'; "
            "simulate instead"
        )
    A, G, F, Psi, Gamma = _reduced(noise.A, root(noise.jumps.covariance), chain)
    if not Psi.size or not (np.abs(Psi) > 0).any():
        raise NoQuadratureError(
            "the policy would never send: the jumps affect no direction of the error to which Ψ gives weight; "
            "expected at least one such direction: give weight to the states that the jumps affect"
        )
    if len(A) > 2:
        raise NoQuadratureError(
            f"the jumps affect {number_of(len(A), 'dimension')} of the error to which Ψ or Γ gives weight, but this "
            "quadrature supports at most two; simulate instead"
        )
    rate, period, told = noise.jumps.rate, noise.period, Stages(progress)
    checks = _followed(rate * period, LONGEST[len(A)])
    if len(A) == 1:
        jump = float(np.sqrt((G @ G.T)[0, 0]))
        bound = float(np.sqrt(chain.delta / Psi[0, 0]))
        line = Line(float(A[0, 0]), jump, rate, period, float(F[0, 0]), bound, float(Gamma[0, 0]))
        levels = zip((1.0, 1.5, 2.0, 3.0), (0.7, 0.8, 0.9, 1.0), strict=True)
        return _refined((line.sums(fineness, _share(checks, share)) for fineness, share in levels), accuracy, told)
    plane = Plane(CompoundPoissonNoise(A, G, rate, period), F, Psi / chain.delta, Gamma)
    return _refined(_planes(plane, checks), accuracy, told)


def _followed(mean: float, most: int) -> int:
    """Return the number of checks without a jump that are followed, given the mean number of jumps per period."""
    if np.exp(-mean * most) > RARE:
        raise NoQuadratureError(
            f"{mean:.3g} jumps per period on average are too rare for this quadrature; check less often, or simulate"
        )
    return max(1, min(int(np.ceil(-np.log(FORGOTTEN) / mean)), most))


def _share(checks: int, share: float) -> int:
    return max(1, int(checks * share))


def _planes(plane: Plane, checks: int) -> Iterator[Sums]:
    """Yield the equations in the plane on finer and finer grids, truncated where hardly any error comes."""

    def grid(level: int, cut: float) -> PlaneGrid:
        more = 1 + 0.25 * level
        along = 2 * int(more * (5 + 0.22 * min(cut, plane.long)))
        across = int(more * (7 + 2.5 * plane.short))
        followed = _share(checks, 0.7 + 0.15 * level)
        return PlaneGrid(along, across, 8 + 4 * level, 12 + 3 * level, followed, cut, FINENESS[level])

    cut = 8.0
    for _ in range(CUTS):
        coarse = plane.sums(grid(0, cut))
        if cut >= plane.long or coarse.outskirts() < FAR:
            break
        cut *= 1.5
    else:
        raise NoQuadratureError("between sends, the error spreads too far for this quadrature; simulate instead")
    yield coarse
    for level in range(1, len(FINENESS)):
        yield plane.sums(grid(level, cut * (1 + 0.15 * level)))


def _refined(levels: Iterator[Sums], accuracy: float, told: Stages) -> Renewal:
    """Return the result of the first level that agrees with the previous one to the accuracy, or of the last level."""
    found = np.full(2, np.nan)
    change = np.full(2, np.inf)
    sums = None
    for level, sums in enumerate(levels):
        before = found
        checks, cost = sums.cycle()
        found = np.array([1 / checks, cost / checks])
        change = SAFETY * np.abs(found - before) + FLOOR * np.abs(found)
        if (change <= accuracy * np.abs(found)).all():
            break
        try:
            told((level + 1) / len(FINENESS))
        except OutOfTime:
            if np.isnan(before).any():
                raise
            break
    assert sums is not None
    off = float((change / np.abs(found)).max())
    if off > USELESS:
        raise NoQuadratureError(
            f"rate and excess cost have a relative error of {off:.1g}; expected at most {USELESS:g}; use a smaller "
            "threshold δ, or "
            "simulate instead"
        )
    rate, excess = (float(value) for value in found)
    return Renewal(rate, excess, float(change[0]), float(change[1]), sums.intervals(1 / rate), sums.basis.shape[0])


def _reduced(A: Array, G: Array, chain: Chain) -> tuple[Array, Array, Array, Array, Array]:
    """Return A, G, F, Ψ and Γ restricted to the directions that jumps reach and that Ψ or Γ weighs."""
    reached = _span(A, G)
    A, G, F = reached.T @ A @ reached, reached.T @ G, reached.T @ chain.F @ reached
    Psi, Gamma = symmetrised(reached.T @ chain.Psi @ reached), symmetrised(reached.T @ chain.Gamma @ reached)
    seen = _span(A.T, np.hstack([root(Psi), root(Gamma)])) if len(A) else np.zeros((0, 0))
    A, G, F = seen.T @ A @ seen, seen.T @ G, seen.T @ F @ seen
    return A, G, F, symmetrised(seen.T @ Psi @ seen), symmetrised(seen.T @ Gamma @ seen)


def _span(A: Array, start: Array) -> Array:
    """Return an orthonormal basis of the smallest A-invariant subspace that contains the columns of ``start``."""
    basis, fresh = np.zeros((len(A), 0)), start
    while fresh.shape[1]:
        fresh = fresh - basis @ (basis.T @ fresh)
        lengths = np.linalg.norm(fresh, axis=0)
        fresh = fresh[:, lengths > 0]
        left, sizes, _ = np.linalg.svd(fresh, full_matrices=False)
        scale = max(float(np.linalg.norm(A, 2)), 1e-300) if basis.shape[1] else float(sizes.max(initial=0.0))
        added = left[:, sizes > RANK * scale]
        basis = np.hstack([basis, added])
        fresh = A @ added
    return basis
