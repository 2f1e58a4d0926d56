"""Matrices with proven error bounds: each entry is a midpoint with a radius, and encloses the exact value.

Two arithmetics have the same operations. ``Balls`` computes with python-flint at any precision; its radii are proofs
for any conditioning, units and sampling period. ``Doubles`` computes middles in double precision and bounds their
rounding: products of the leading halves of the digits are exact, so that only the rest is rounded, by at most k units
of roundoff for a sum of k products. It is faster for many states, and sufficient for well-conditioned problems.
Formulas are written once, for either arithmetic.

Source: johansson2017, ozaki2012, rump2006
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from math import isfinite
from typing import Self, TypeAlias, TypeVar, cast

import numpy as np
from flint import arb, arb_mat, ctx, fmpq_mat

from taciturn._arrays import Array, Bits, symmetrised

PRECISIONS = (128, 256, 512, 1024)  # bits that are tried in turn
UNIT = 2.0**-53  # largest relative error of one rounding
_UNDERFLOW = 1e-290  # above the error of any sum of products that underflow
_SMALL = 8  # most rows for which elimination in balls is faster than a factorisation in doubles with its conversions

Rows: TypeAlias = slice | Bits  # some of the rows or columns of a matrix


class UnprovedError(ArithmeticError):
    """Raised if a property cannot be proved at the precision with which it is computed."""


class Balls:
    """A matrix of balls (midpoint and radius) of python-flint, of any precision. Use it within ``precision``."""

    __slots__ = ("_balls", "_middle", "_radius")

    def __init__(self, balls: arb_mat, middle: Array | None = None, radius: Array | None = None) -> None:
        """Take over a matrix of python-flint; its middles may be known as doubles, and their errors."""
        self._balls, self._middle, self._radius = balls, middle, radius

    @classmethod
    def exact(cls, values: Array) -> Self:
        """Convert a matrix of doubles, whose values count as exact."""
        return cls(arb_mat(len(values), values.shape[1], values.ravel().tolist()), values, np.zeros(values.shape))

    @classmethod
    def rational(cls, values: fmpq_mat) -> Self:
        """Enclose a matrix of rational numbers."""
        return cls(arb_mat(values))

    @classmethod
    def root(cls, value: float, size: int) -> Self:
        """Enclose the identity matrix times the square root of a number."""
        one, none = arb(value).sqrt(), arb(0)
        return cls.of([[one if i == j else none for j in range(size)] for i in range(size)], size)

    @classmethod
    def of(cls, table: list[list[arb]], columns: int) -> Self:
        """Construct a matrix of balls from its rows."""
        return cls(arb_mat(table) if table and columns else arb_mat(len(table), columns))

    @property
    def rows(self) -> list[list[arb]]:
        """The rows of the matrix, as lists of python-flint's balls."""
        return self._balls.tolist()

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and number of columns of the matrix."""
        return self._balls.nrows(), self._balls.ncols()

    @property
    def T(self) -> Self:
        """The transpose."""
        return type(self)(self._balls.transpose())

    @property
    def middle(self) -> Array:
        """The midpoints of the entries, each rounded to a double."""
        if self._middle is None:
            self._middle = np.array([*map(float, self._balls.mid().entries())]).reshape(self.shape)
        return self._middle

    @property
    def radius(self) -> Array:
        """Bounds on the distance of each exact entry from the matrix ``middle``."""
        if self._radius is None:
            balls, moved = self._balls.entries(), self.middle.ravel() != 0
            if not moved.all():  # a number may be too small for a double
                moved = np.array([not one.is_zero() for one in balls], dtype=np.bool_)
            found = np.array([float(one.rad()) for one in balls]) + _UNDERFLOW * moved
            self._radius = (found.reshape(self.shape) + 2 * UNIT * np.abs(self.middle)) * (1 + 8 * UNIT)
        return self._radius

    @property
    def most(self) -> Array:
        """Bounds on the absolute value of each exact entry; 0 for an entry that is exactly zero."""
        return (np.abs(self.middle) + self.radius) * (1 + 4 * UNIT)

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
        """Multiply the matrix by an exact number or a ball."""
        return type(self)(self._balls * arb(factor))

    def over(self, count: int) -> Self:
        """Divide the matrix by an integer."""
        return type(self)(self._balls / arb(count))

    @classmethod
    def unit(cls) -> float:
        """Return how small, relatively, terms must be to be neglected; the radius is then increased by their size."""
        return 2.0 ** -int(ctx.prec)

    def widened(self, by: Array) -> Self:
        """Increase the radius of each entry by a nonnegative number."""
        more = [arb(0.0, radius) for radius in by.ravel().tolist()]
        return type(self)(self._balls + arb_mat(len(by), by.shape[1], more)) if by.any() else self

    def inner(self, other: Self) -> Self:
        """Enclose the trace of X'Y for this matrix X and another matrix Y; the result is a (1, 1) matrix."""
        return type(self)(arb_mat([[(self._balls.transpose() * other._balls).trace()]]))

    def part(self, rows: Rows, columns: Rows) -> Self:
        """Return the submatrix of the given rows and columns."""
        n, m = self.shape
        down, across = _places(n, rows), _places(m, columns)
        if len(down) == n and len(across) == m:
            return self
        table = self.rows
        return self.of([[table[i][j] for j in across] for i in down], len(across))

    def solve(self, right: Self) -> Self:
        """Enclose X⁻¹Y for this matrix X and another matrix Y."""
        if not all(self.shape) or not all(right.shape):
            return type(self)(arb_mat(*right.shape))
        try:
            return type(self)(self._balls.solve(right._balls))
        except ZeroDivisionError as error:
            raise UnprovedError("the matrix may be singular") from error

    def centre(self) -> Self:
        """Return the matrix of the midpoints, with radius 0, at the present precision."""
        return type(self)(self._balls.mid(), self._middle)

    def symmetric(self) -> Self:
        """Return (X + X')/2 for this matrix X, whose exact value must be symmetric."""
        return (self + self.T).times(0.5)

    def definite(self) -> bool:
        """Return whether this symmetric matrix is proved to be positive definite."""
        return (self._balls.nrows() > _SMALL and _definite(self.middle, self.radius)) or self._has_positive_pivots()

    def _has_positive_pivots(self) -> bool:
        """Eliminate row by row: a symmetric matrix is definite if and only if all pivots are positive."""
        rows = self.rows
        for k, row in enumerate(rows):
            pivot = row[k]
            if not (pivot > 0 and pivot.is_finite()):
                return False
            for i in range(k + 1, len(rows)):
                if not row[i].is_zero():
                    factor, other = row[i] / pivot, rows[i]
                    for j in range(i, len(rows)):
                        other[j] -= factor * row[j]
        return True


class Doubles:
    """A matrix of doubles with a proven bound on the error of each."""

    __slots__ = ("middle", "radius")

    def __init__(self, middle: Array, radius: Array) -> None:
        """Take over middles and radii; a middle or radius that is not finite ends the proof."""
        if not isfinite(float(np.vdot(radius, radius)) + float(np.vdot(middle, middle))):
            raise UnprovedError("a number exceeds the range of double precision")
        self.middle, self.radius = middle, radius

    @classmethod
    def exact(cls, values: Array) -> Self:
        """Convert a matrix of doubles, whose values count as exact."""
        return cls(values, np.zeros(values.shape))

    @classmethod
    def rational(cls, values: fmpq_mat) -> Self:
        """Enclose a matrix of rational numbers."""
        nearest = [int(one.p) / int(one.q) for one in values.entries()]
        middle = np.array(nearest, dtype=np.float64).reshape(values.nrows(), values.ncols())
        return cls(middle, 2 * UNIT * np.abs(middle))

    @classmethod
    def root(cls, value: float, size: int) -> Self:
        """Enclose the identity matrix times the square root of a number."""
        middle = np.sqrt(value) * np.eye(size)
        return cls(middle, 2 * UNIT * middle)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and number of columns of the matrix."""
        n, m = self.middle.shape
        return n, m

    @property
    def T(self) -> Self:
        """The transpose."""
        return type(self)(self.middle.T, self.radius.T)

    @property
    def most(self) -> Array:
        """Bounds on the absolute value of each exact entry; 0 for an entry that is exactly zero."""
        return (np.abs(self.middle) + self.radius) * (1 + 4 * UNIT)

    def __add__(self, other: Self) -> Self:
        """Return the sum."""
        return self._rounded(self.middle + other.middle, self.radius + other.radius)

    def __sub__(self, other: Self) -> Self:
        """Return the difference."""
        return self._rounded(self.middle - other.middle, self.radius + other.radius)

    def __matmul__(self, other: Self) -> Self:
        """Return the product."""
        k, spread, others = self.middle.shape[1], bool(self.radius.any()), bool(other.radius.any())
        if not ((spread or self.middle.any()) and (others or other.middle.any())):
            return type(self).exact(np.zeros((len(self.middle), other.middle.shape[1])))
        bits = int((53 - np.log2(k)) / 2)
        left, right = np.abs(self.middle), np.abs(other.middle)
        high, low, coarse = _split(self.middle, left, bits)
        top, bottom, fine = _split(other.middle.T, right.T, bits)
        middle = high @ top.T + (high @ bottom.T + low @ other.middle)
        # the first product is exact; only the rest is rounded, and the last sum
        one, two = np.array([left.sum(axis=1), coarse]), np.array([fine, right.sum(axis=0)])
        radius = ((k + 4) * UNIT * one.T) @ two + UNIT * np.abs(middle)
        if others:
            radius += left @ other.radius
        if spread:
            radius += self.radius @ (right + other.radius)
        radius *= 1 + (2 * k + 12) * UNIT
        radius += _UNDERFLOW
        return type(self)(middle, radius)

    def times(self, factor: float) -> Self:
        """Multiply the matrix by an exact number."""
        return self._rounded(self.middle * factor, self.radius * abs(factor))

    def over(self, count: int) -> Self:
        """Divide the matrix by an integer."""
        return self._rounded(self.middle / count, self.radius / count)

    @classmethod
    def unit(cls) -> float:
        """Return how small, relatively, terms must be to be neglected; the radius is then increased by their size."""
        return 2.0**-60

    def widened(self, by: Array) -> Self:
        """Increase the error bound of each entry by a nonnegative number."""
        return type(self)(self.middle, (self.radius + by) * (1 + 4 * UNIT))

    def inner(self, other: Self) -> Self:
        """Enclose the trace of X'Y for this matrix X and another matrix Y; the result is a (1, 1) matrix."""
        one, two = (type(self)(part.middle.reshape(1, -1), part.radius.reshape(1, -1)) for part in (self, other))
        return one @ two.T

    def _rounded(self, middle: Array, radius: Array) -> Self:
        """Return an entrywise result whose middle was rounded once."""
        return type(self)(middle, (radius + UNIT * np.abs(middle)) * (1 + 8 * UNIT))

    def part(self, rows: Rows, columns: Rows) -> Self:
        """Return the submatrix of the given rows and columns."""
        return type(self)(self.middle[rows][:, columns], self.radius[rows][:, columns])

    def solve(self, right: Self) -> Self:
        """Enclose the solution X of S X = R with an approximate inverse Z of S: X = X̃ + (ZS)⁻¹Z(R − S X̃)."""
        # With |I − ZS| ≤ G, whose row sums are at most q < 1, the correction of each column is at most
        # |Z(R − S X̃)| plus q/(1 − q) times its largest entry.
        try:
            inverse = type(self).exact(np.asarray(np.linalg.inv(self.middle), dtype=np.float64))
        except np.linalg.LinAlgError as error:
            raise UnprovedError("the matrix may be singular") from error
        off = float((type(self).exact(np.eye(len(self.middle))) - inverse @ self).most.sum(axis=1).max(initial=0.0))
        if not off < 0.5:
            raise UnprovedError("the matrix may be singular")
        found = inverse.middle @ right.middle
        missed = (inverse @ (right - self @ type(self).exact(found))).most
        radius = (missed + 2 * off * missed.max(axis=0, initial=0.0)) * (1 + 16 * len(found) * UNIT)
        return type(self)(found, radius)

    def centre(self) -> Self:
        """Return the matrix of the midpoints, with radius 0."""
        return type(self).exact(self.middle)

    def symmetric(self) -> Self:
        """Return (X + X')/2 for this matrix X, whose exact value must be symmetric."""
        return self._rounded(symmetrised(self.middle), symmetrised(self.radius))

    def definite(self) -> bool:
        """Return whether this symmetric matrix is proved to be positive definite."""
        return _definite(self.middle, self.radius)


E = TypeVar("E", Balls, Doubles)


def block(rows: Sequence[Sequence[E]]) -> E:
    """Combine enclosures of blocks into the enclosure of one matrix."""
    kind = type(rows[0][0])
    if kind is Balls:
        found: list[list[arb]] = []
        for row in cast("Sequence[Sequence[Balls]]", rows):
            found += [reduce(list[arb].__add__, lines) for lines in zip(*(part.rows for part in row), strict=True)]
        return cast("E", Balls.of(found, sum(part.shape[1] for part in rows[0])))
    middle, radius = (
        np.concatenate([np.concatenate([getattr(part, name) for part in row], axis=1) for row in rows])
        for name in ("middle", "radius")
    )
    return cast("E", Doubles(middle, radius))


def solve(left: E, right: E) -> E:
    """Enclose X⁻¹Y for two matrices X and Y that are enclosed themselves."""
    if isinstance(left, Balls):
        return left.solve(right)
    return left.solve(right)  # the same method of the other arithmetic, which type checkers take for another one


def inner(one: E, other: E) -> E:
    """Enclose the trace of X'Y for two enclosed matrices X and Y; the result is a (1, 1) matrix."""
    if isinstance(one, Balls):
        return one.inner(other)
    return one.inner(other)  # the same method of the other arithmetic


def _split(matrix: Array, size: Array, bits: int) -> tuple[Array, Array, Array]:
    """Return the leading bits of the entries of each row, the rest, and twice a bound on the rest of each row."""
    # The leading parts of a row are multiples of one power of two, and at most 2^bits of it. So sums of products of
    # such parts are whole numbers below 2^53, which are exact. ``size`` are the moduli of the entries.
    unit = np.exp2(np.ceil(np.log2(np.maximum(size.max(axis=1, initial=0.0), 1e-280))) - bits)
    shift = (1.5 * 2.0**52 * unit)[:, None]
    high = matrix + shift
    high -= shift
    return high, matrix - high, unit


def _definite(middle: Array, radius: Array) -> bool:
    """Return whether a symmetric enclosure is proved to be positive definite, by a Cholesky factorisation."""
    # In units in which the diagonal is about 1, the factors of a completed factorisation reproduce the matrix up to
    # (n + 1) units of roundoff times its trace. So a matrix from whose diagonal twice this and the radii have been
    # subtracted is only factorised if the exact matrix is definite.
    n, diagonal = len(middle), middle.diagonal()
    if not (diagonal > 0).all():
        return n == 0
    with np.errstate(all="ignore"):
        units = np.exp2(-np.rint(np.log2(diagonal) / 2))
        units = units * units[:, None]
        scaled, spread = middle * units, (radius * units).sum(axis=1)  # spread: a diagonal matrix above any error
        diagonal = scaled.diagonal()
        left = diagonal - (1.01 * spread + 4 * (n + 2) * UNIT * float(diagonal.sum()))
        if not (left > 0).all():
            return False
        scaled.flat[:: n + 1] = left
    try:
        factor = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        return False
    return isfinite(float(np.vdot(factor, factor)))


def _places(count: int, some: Rows) -> list[int]:
    return list(range(count)[some]) if isinstance(some, slice) else np.flatnonzero(some).tolist()
