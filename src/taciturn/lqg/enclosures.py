"""Matrices with proved error bounds: every entry is a middle and a radius within which the exact value lies.

Two arithmetics have the same operations. ``Balls`` computes with python-flint at any precision; its radii are proofs
for any conditioning, units and sampling period. ``Doubles`` computes middles in double precision and bounds their
rounding: products of the leading halves of the digits are exact, so that only the rest is rounded, by at most k units
of roundoff for a sum of k products. It is faster for many states, and sufficient for well-conditioned problems.
Formulas are written once, for either arithmetic.

Source: johansson2017, ozaki2012, rump2006
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import reduce
from typing import Self, TypeAlias, TypeVar, cast

import numpy as np
from flint import arb, arb_mat, ctx, fmpq_mat

from taciturn._arrays import Array, Bits, symmetrised

PRECISIONS = (128, 256, 512, 1024)  # bits that are tried in turn
UNIT = 2.0**-53  # largest relative error of one rounding
UNDERFLOW = 1e-290  # above the error of any sum of products that underflow

Rows: TypeAlias = slice | Bits  # some of the rows or columns of a matrix


class UnprovedError(ArithmeticError):
    """A property that does not follow from the enclosures at this precision."""


class Enclosure(ABC):
    """A matrix whose entries lie within known radii of known middles: what both arithmetics conclude from these."""

    @property
    @abstractmethod
    def middle(self) -> Array:
        """The middles, as the nearest doubles."""

    @property
    @abstractmethod
    def radius(self) -> Array:
        """Bounds on the distances of the exact entries from ``middle``."""

    @property
    def most(self) -> Array:
        """Bounds on the moduli of the exact entries."""
        return np.asarray(np.nextafter(np.abs(self.middle) + self.radius, np.inf), dtype=np.float64)

    @property
    def trace(self) -> tuple[float, float]:
        """The trace, and a bound on its error."""
        middle, radius = np.diag(self.middle), np.diag(self.radius)
        rounding = 2 * len(middle) * UNIT * float(np.abs(middle).sum())
        return float(middle.sum()), 1.001 * float(radius.sum()) + rounding


class Balls(Enclosure):
    """A matrix of balls of python-flint, for use within ``precision``."""

    __slots__ = ("_balls", "_middle", "_radius")

    def __init__(self, balls: arb_mat) -> None:
        """Take over a matrix of python-flint."""
        self._balls = balls
        self._middle: Array | None = None
        self._radius: Array | None = None

    @classmethod
    def exact(cls, values: Array) -> Self:
        """Return the matrix of given doubles, without an error."""
        return cls(arb_mat(len(values), values.shape[1], values.ravel().tolist()))

    @classmethod
    def enclosing(cls, middle: Array, radius: Array) -> Self:
        """Return the matrix with given middles and radii."""
        return cls.exact(middle).widened(radius)

    @classmethod
    def rational(cls, values: fmpq_mat) -> Self:
        """Return an enclosure of a matrix of rational numbers."""
        return cls(arb_mat(values))

    @classmethod
    def root(cls, value: float, size: int) -> Self:
        """Return the square root of a number times the unit matrix."""
        one, none = arb(value).sqrt(), arb(0)
        return cls.of([[one if i == j else none for j in range(size)] for i in range(size)], size)

    @classmethod
    def of(cls, table: list[list[arb]], columns: int) -> Self:
        """Return the matrix with given rows of balls."""
        return cls(arb_mat(table) if table and columns else arb_mat(len(table), columns))

    @property
    def rows(self) -> list[list[arb]]:
        """The rows, as balls of python-flint."""
        return self._balls.tolist()

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of rows and columns."""
        return self._balls.nrows(), self._balls.ncols()

    @property
    def T(self) -> Self:
        """The transpose."""
        return type(self)(self._balls.transpose())

    @property
    def middle(self) -> Array:
        """The middles, as the nearest doubles."""
        if self._middle is None:
            self._middle = np.array([float(one) for one in self._balls.mid().entries()]).reshape(self.shape)
        return self._middle

    @property
    def radius(self) -> Array:
        """Bounds on the distances of the exact entries from ``middle``."""
        if self._radius is None:
            found = np.array([float(one.rad()) for one in self._balls.entries()]).reshape(self.shape)
            rounding = np.where(self.middle == 0, 0.0, 2 * UNIT * np.abs(self.middle) + UNDERFLOW)
            self._radius = np.where(found == 0, rounding, (found + rounding) * (1 + 8 * UNIT))
        return self._radius

    def __add__(self, other: Self) -> Self:
        """Return the sum."""
        return type(self)(self._balls + other._balls)

    def __sub__(self, other: Self) -> Self:
        """Return the difference."""
        return type(self)(self._balls - other._balls)

    def __matmul__(self, other: Self) -> Self:
        """Return the product."""
        return type(self)(self._balls * other._balls)

    def times(self, factor: float | arb) -> Self:
        """Return the product with an exact number, or with a ball."""
        return type(self)(self._balls * arb(factor))

    def over(self, count: int) -> Self:
        """Return the quotient by a number."""
        return type(self)(self._balls / arb(count))

    @classmethod
    def unit(cls) -> float:
        """Return a size relative to 1 that may be left out, if it counts as a radius."""
        return 2.0 ** -int(ctx.prec)

    def widened(self, by: Array) -> Self:
        """Return the matrix with larger radii."""
        more = [arb(0.0, radius) for radius in by.ravel().tolist()]
        return type(self)(self._balls + arb_mat(len(by), by.shape[1], more)) if by.any() else self

    @property
    def row(self) -> Self:
        """All entries in one row."""
        n, m = self.shape
        return type(self)(arb_mat(1, n * m, self._balls.entries()))

    def part(self, rows: Rows, columns: Rows) -> Self:
        """Return some rows and columns."""
        table, (n, m) = self.rows, self.shape
        down, across = _places(n, rows), _places(m, columns)
        return self.of([[table[i][j] for j in across] for i in down], len(across))

    def solve(self, right: Self) -> Self:
        """Return the inverse of this matrix times another one.

        Raises:
            UnprovedError: the matrix may be singular.
        """
        if not all(self.shape) or not all(right.shape):
            return type(self)(arb_mat(*right.shape))
        try:
            return type(self)(self._balls.solve(right._balls))
        except ZeroDivisionError as error:
            raise UnprovedError("the matrix may be singular") from error

    def centre(self) -> Self:
        """Return the middles without radii, at the present precision."""
        return type(self)(self._balls.mid())

    def symmetric(self) -> Self:
        """Return the mean of the matrix and its transpose, for a matrix that is exactly symmetric."""
        return (self + self.T).times(0.5)

    def definite(self) -> bool:
        """Return whether this symmetric matrix is proved to be positive definite."""
        if not np.isfinite(self.most).all():
            return False
        return _definite(self.middle, self.radius) or self._has_positive_pivots()

    def _has_positive_pivots(self) -> bool:
        """Eliminate row by row: a symmetric matrix is definite if and only if all pivots are positive."""
        rows = self.rows
        for k, row in enumerate(rows):
            pivot = row[k]
            if not pivot > 0:
                return False
            for i in range(k + 1, len(rows)):
                if not rows[i][k].is_zero():
                    factor = rows[i][k] / pivot
                    for j in range(i, len(rows)):
                        rows[i][j] -= factor * row[j]
                        rows[j][i] = rows[i][j]
        return True


class Doubles(Enclosure):
    """A matrix of doubles with bounds on their errors."""

    __slots__ = ("_middle", "_radius")

    def __init__(self, middle: Array, radius: Array) -> None:
        """Take over middles and radii; a middle or radius that is not finite ends the proof.

        Raises:
            UnprovedError: a number is too large.
        """
        if not (np.isfinite(radius).all() and np.isfinite(middle).all()):
            raise UnprovedError("a number exceeds the range of doubles")
        self._middle, self._radius = middle, radius

    @classmethod
    def exact(cls, values: Array) -> Self:
        """Return the matrix of given doubles, without an error."""
        return cls(values, np.zeros(values.shape))

    @classmethod
    def enclosing(cls, middle: Array, radius: Array) -> Self:
        """Return the matrix with given middles and radii."""
        return cls(middle, radius)

    @classmethod
    def rational(cls, values: fmpq_mat) -> Self:
        """Return an enclosure of a matrix of rational numbers."""
        nearest = [int(one.p) / int(one.q) for one in values.entries()]
        middle = np.array(nearest, dtype=np.float64).reshape(values.nrows(), values.ncols())
        return cls(middle, 2 * UNIT * np.abs(middle))

    @classmethod
    def root(cls, value: float, size: int) -> Self:
        """Return the square root of a number times the unit matrix."""
        middle = np.sqrt(value) * np.eye(size)
        return cls(middle, 2 * UNIT * middle)

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of rows and columns."""
        n, m = self._middle.shape
        return n, m

    @property
    def T(self) -> Self:
        """The transpose."""
        return type(self)(self._middle.T, self._radius.T)

    @property
    def middle(self) -> Array:
        """The middles, as the nearest doubles."""
        return self._middle

    @property
    def radius(self) -> Array:
        """Bounds on the distances of the exact entries from ``middle``."""
        return self._radius

    def __add__(self, other: Self) -> Self:
        """Return the sum."""
        return self._rounded(self._middle + other._middle, self._radius + other._radius)

    def __sub__(self, other: Self) -> Self:
        """Return the difference."""
        return self._rounded(self._middle - other._middle, self._radius + other._radius)

    def __matmul__(self, other: Self) -> Self:
        """Return the product."""
        k = self._middle.shape[1]
        bits = int((53 - np.log2(max(k, 1))) / 2)
        high, low, coarse = _split(self._middle, bits)
        top, bottom, fine = _split(other._middle.T, bits)
        rest = high @ bottom.T + low @ other._middle
        middle = high @ top.T + rest
        left, right = np.abs(self._middle), np.abs(other._middle)
        # the first product is exact; only the rest is rounded, and the last sum
        radius = (k + 4) * UNIT * (left.sum(axis=1)[:, None] * fine + coarse[:, None] * right.sum(axis=0))
        radius += UNIT * np.abs(middle)
        if other._radius.any():
            radius += left @ other._radius
        if self._radius.any():
            radius += self._radius @ (right + other._radius)
        return type(self)(middle, radius * (1 + (2 * k + 12) * UNIT) + UNDERFLOW)

    def times(self, factor: float) -> Self:
        """Return the product with an exact number."""
        return self._rounded(self._middle * factor, self._radius * abs(factor))

    def over(self, count: int) -> Self:
        """Return the quotient by a number."""
        return self._rounded(self._middle / count, self._radius / count)

    @classmethod
    def unit(cls) -> float:
        """Return a size relative to 1 that may be left out, if it counts as a radius."""
        return 2.0**-60

    def widened(self, by: Array) -> Self:
        """Return the matrix with larger radii."""
        return type(self)(self._middle, (self._radius + by) * (1 + 4 * UNIT))

    @property
    def row(self) -> Self:
        """All entries in one row."""
        return type(self)(self._middle.reshape(1, -1), self._radius.reshape(1, -1))

    def _rounded(self, middle: Array, radius: Array) -> Self:
        """Return an entrywise result whose middle was rounded once."""
        return type(self)(middle, (radius + UNIT * np.abs(middle)) * (1 + 8 * UNIT))

    def part(self, rows: Rows, columns: Rows) -> Self:
        """Return some rows and columns."""
        return type(self)(self._middle[rows][:, columns], self._radius[rows][:, columns])

    def solve(self, right: Self) -> Self:
        """Enclose the solution X of S X = R from an approximate inverse Z: X = X̃ + (ZS)⁻¹Z(R − S X̃).

        With |I − ZS| ≤ G, whose row sums are at most q < 1, the correction of each column is at most
        |Z(R − S X̃)| plus q/(1 − q) times its largest entry.
        """
        try:
            inverse = type(self).exact(np.asarray(np.linalg.inv(self._middle), dtype=np.float64))
        except np.linalg.LinAlgError as error:
            raise UnprovedError("the matrix may be singular") from error
        off = float((type(self).exact(np.eye(len(self._middle))) - inverse @ self).most.sum(axis=1).max(initial=0.0))
        if not off < 0.5:
            raise UnprovedError("the matrix may be singular")
        found = inverse.middle @ right._middle
        missed = (inverse @ (right - self @ type(self).exact(found))).most
        radius = (missed + 2 * off * missed.max(axis=0, initial=0.0)) * (1 + 16 * len(found) * UNIT)
        return type(self)(found, radius)

    def centre(self) -> Self:
        """Return the middles without radii."""
        return type(self).exact(self._middle)

    def symmetric(self) -> Self:
        """Return the mean of the matrix and its transpose, for a matrix that is exactly symmetric."""
        return self._rounded(symmetrised(self._middle), symmetrised(self._radius))

    def definite(self) -> bool:
        """Return whether this symmetric matrix is proved to be positive definite."""
        return _definite(self._middle, self._radius)


def _split(matrix: Array, bits: int) -> tuple[Array, Array, Array]:
    """Return the leading bits of the entries of each row, the rest, and twice a bound on the rest of each row.

    The leading parts of a row are multiples of one power of two, and at most 2^bits of it. So sums of products of such
    parts are whole numbers below 2^53, which are exact.
    """
    unit = np.exp2(np.ceil(np.log2(np.maximum(np.abs(matrix).max(axis=1, initial=0.0), 1e-280))) - bits)
    shift = (1.5 * 2.0**52 * unit)[:, None]
    high = (matrix + shift) - shift
    return high, matrix - high, unit


def _places(count: int, some: Rows) -> list[int]:
    return list(range(count)[some]) if isinstance(some, slice) else np.flatnonzero(some).tolist()


def _definite(middle: Array, radius: Array) -> bool:
    """Return whether a symmetric enclosure is proved to be positive definite, by a Cholesky factorisation.

    In units in which the diagonal is about 1, the factors of a completed factorisation reproduce the matrix up to
    (n + 1) units of roundoff times its trace. So a matrix from whose diagonal twice this and the radii have been
    subtracted is only factorised if the exact matrix is definite.
    """
    n, diagonal = len(middle), np.diag(middle)
    if not (diagonal > 0).all():
        return n == 0
    with np.errstate(over="ignore", under="ignore"):
        units = np.exp2(-np.round(np.log2(diagonal) / 2))
        scaled = symmetrised(middle) * units * units[:, None]
        spread = (radius * units * units[:, None]).sum(axis=1)  # a diagonal matrix above any error with these radii
        shift = 1.01 * spread + 4 * (n + 2) * UNIT * float(np.trace(scaled))
        if not (shift < np.diag(scaled)).all():
            return False
        scaled.flat[:: n + 1] -= shift
    try:
        np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        return False
    return True


E = TypeVar("E", Balls, Doubles)


def block(rows: Sequence[Sequence[E]]) -> E:
    """Return a matrix of blocks."""
    kind = type(rows[0][0])
    if kind is Balls:
        found: list[list[arb]] = []
        for row in cast("Sequence[Sequence[Balls]]", rows):
            found += [reduce(list[arb].__add__, lines) for lines in zip(*(part.rows for part in row), strict=True)]
        return cast("E", Balls.of(found, sum(part.shape[1] for part in rows[0])))
    middle, radius = (
        np.block([[getattr(part, name) for part in row] for row in rows]) for name in ("middle", "radius")
    )
    return cast("E", Doubles(middle, radius))


def solve(left: E, right: E) -> E:
    """Return the inverse of a matrix times another one.

    Raises:
        UnprovedError: the matrix may be singular.
    """
    if isinstance(left, Balls):
        return left.solve(right)
    return left.solve(right)  # the same method of the other arithmetic, which type checkers take for another one
