"""Renewal equations for a two-dimensional error with Poisson jumps, by integration along rays.

The integrals are split at the edges of the set of unsent errors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import chebyshev

from taciturn._arrays import Array
from taciturn.renewal._jump_density import (
    TABLES_MEET,
    CompoundPoissonNoise,
    Density,
    Fineness,
    Rays,
    eased,
    legendre_nodes,
)
from taciturn.renewal._jump_sums import Sums
from taciturn.renewal.chain import NoQuadratureError

BREAKING = 1  # checks without a jump whose sets split also the integral over the angle
CROWDED, CROWDING = 0.7, 4.0  # slopes to the longer axis that split the integral over the angle: largest, and ratio
DISTINCT = 1e-10  # least angle between two splits, radians
MOST_NODES = 1600
FAR = 16  # power of the distance (relative to the truncation), whose mean shows how far errors come


@dataclass(frozen=True)
class PlaneGrid:
    """Numbers of quadrature nodes for a two-dimensional error.

    Args:
        along: nodes along the longer axis of the set, an even number.
        across: nodes along the shorter axis.
        angles: angles between two splits.
        radii: nodes on a piece of a ray.
        checks: checks without a jump that are followed one by one.
        cut: where the longer axis is truncated, in standard deviations of the increment of a period.
        density: numbers of nodes in the tables of the density.
    """

    along: int
    across: int
    angles: int
    radii: int
    checks: int
    cut: float
    density: Fineness


class Plane:
    """A two-dimensional error with Poisson jumps, scaled so that its increment over one period has unit covariance.

    Args:
        shower: the jumps.
        F: map of the error from one check to the next, without jumps, (2, 2).
        Psi: Ψ/δ, weight of the trigger over its threshold, (2, 2).
        Gamma: Γ, weight of the cost, (2, 2).
    """

    def __init__(self, shower: CompoundPoissonNoise, F: Array, Psi: Array, Gamma: Array) -> None:
        root = np.linalg.cholesky(shower.covariance())
        inverse = np.linalg.inv(root)
        self.shower = replace(shower, A=inverse @ shower.A @ root, G=inverse @ shower.G)
        self.F, self.Psi, self.Gamma = inverse @ F @ root, root.T @ Psi @ root, root.T @ Gamma @ root
        values, self.axes = np.linalg.eigh(self.Psi)
        self._densities = dict[Fineness, Density]()
        self.long, self.short = (float(1 / np.sqrt(max(value, 1e-14 * values[1]))) for value in values)

    def density(self, fineness: Fineness) -> Density:
        """Return the cached probability density of the error increment over a period with at least one jump."""
        if fineness not in self._densities:
            self._densities[fineness] = Density(self.shower, fineness)
        return self._densities[fineness]

    def sums(self, grid: PlaneGrid) -> Sums:
        """Return the renewal equations of this error on a grid of quadrature nodes.

        Raises:
            NoQuadratureError: too many nodes, or an increment without a density.
        """
        if grid.along * grid.across > 2 * MOST_NODES:
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
        return np.array([mass.sum(), cost, mass @ (errors @ self.plane.axes[:, 0] / self.grid.cut) ** FAR])

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
