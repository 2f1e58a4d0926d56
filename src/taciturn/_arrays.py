"""Checks of arguments: shape, finiteness, symmetry and definiteness of arrays. The checked arrays are read-only.

All classes of the model check their arguments here, so that messages are alike: a name, its value, the expected one.

A number is a vector or matrix with one entry. Every other array has the number of dimensions that is expected:
a list of numbers is no matrix, since it could be a row, a column or a diagonal. The message shows the given numbers in
the expected form, ``[[0.005], [0.1]]`` for a B of two states, and names the row that differs from the first one.

An array must be finite together with the squares of its entries, because costs and covariances contain squares.

Symmetry and definiteness must not depend on the units of the variables. So a symmetric matrix M is scaled to the
diagonal 1, S = D^{-½} M D^{-½} with the diagonal D of M, and M counts as semidefinite if no eigenvalue of S is below
−1e-10, which rounding can make of an exact zero. A Cholesky factorisation of S + 1e-10·I answers this for most matrices
and is cheaper than eigenvalues. Entries m_ij and m_ji may differ by 1e-9 of the largest of |m_ij|, |m_ji| and
√(m_ii m_jj), or by the rounding error of the largest entry.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Collection, Mapping, Sequence
from numbers import Integral, Real
from typing import Any, TypeAlias, TypeVar, cast

import numpy as np
import numpy.typing as npt

from taciturn.errors import ProblemError

Array: TypeAlias = npt.NDArray[np.float64]
ArrayLike: TypeAlias = npt.ArrayLike
Bits: TypeAlias = npt.NDArray[np.bool_]
Shape: TypeAlias = tuple[int | None, ...]
Word = TypeVar("Word", bound=str)

NO_VARIANCE = 1e-290  # a variance or weight below this counts as zero, since its inverse could overflow
FORM = "[[0.9, 0.1], [0.0, 0.8]]"  # a matrix as a list of rows, in messages
LONGEST_FORM = 16  # entries of a matrix that a message shows in the expected form
_DEFINITENESS_TOLERANCE = 1e-10  # eigenvalue, at unit diagonal, that rounding can make of an exact zero
_ROUNDING = 8 * float(np.finfo(np.float64).eps)  # relative error per row that products can make of an exact zero


def array(name: str, value: ArrayLike, shape: Shape, meaning: str = "") -> Array:
    """Convert ``value`` to a read-only array of floats with finite entries. Check that it has the shape ``shape``.

    None in ``shape`` accepts any size. A number is accepted as an array with one entry.

    Raises:
        ProblemError: the value is not numeric, not finite, or of another shape.
    """
    result = _numbers(name, value, shape, meaning)
    if result.shape != shape and not _fits(result.shape, shape):
        turned = zip(result.T.shape, shape, strict=False)
        transposed = result.ndim == len(shape) == 2 and all(want in (None, got) for got, want in turned)
        hint = ". Did you pass its transpose?" if transposed else ""
        given = f"has shape {np.shape(value)}" if np.ndim(value) else f"is {result.item():g}"
        form = _form(result, np.ndim(value), shape, meaning)
        raise ProblemError(f"{name} {given}; expected the shape {_shape_text(shape, meaning)}{form}{hint}")
    if not math.isfinite(np.vdot(result, result)):
        infinite = ~np.isfinite(result)
        wrong = infinite if infinite.any() else np.abs(result) == np.abs(result).max()
        where = tuple(int(i) for i in np.argwhere(wrong)[0])
        expected = "finite numbers" if infinite.any() else "numbers with finite squares: use larger units"
        raise ProblemError(
            f"{name} contains the number {result[where]} at index {where}; expected an array of {expected}"
        )
    result.setflags(write=False)
    return result


def square(name: str, value: ArrayLike, meaning: str = "") -> Array:
    """Convert ``value`` to a read-only array. Check that it is a square matrix with finite entries."""
    result = array(name, value, (None, None), meaning)
    rows, columns = result.shape
    return result if rows == columns else array(name, value, (rows, rows), meaning)


def symmetric(name: str, value: ArrayLike, size: int, meaning: str = "") -> Array:
    """Convert ``value`` to a read-only array. Check that it is a symmetric matrix."""
    result = array(name, value, (size, size), meaning)
    if np.array_equal(result, result.T):
        return result
    difference, spread = np.abs(result - result.T), np.sqrt(np.abs(np.diag(result)))
    # Tolerance in the units of each row and column, but at least the rounding error of the largest entry.
    allowed = np.maximum(np.maximum(np.abs(result), np.abs(result.T)), spread * spread[:, None])
    allowed = np.maximum(1e-9 * allowed, _ROUNDING * size * np.abs(result).max(initial=0.0))
    if (difference > allowed).any():
        i, j = (int(k) for k in np.unravel_index(np.argmax(difference - allowed), result.shape))
        raise ProblemError(
            f"{name} is not symmetric: entry ({i}, {j}) is {result[i, j]:g} and ({j}, {i}) is {result[j, i]:g}; "
            f"expected a symmetric matrix; if only the symmetric part is meant, use ({name} + {name}')/2"
        )
    return frozen((result + result.T) / 2)


def semidefinite(name: str, value: ArrayLike, size: int, meaning: str = "") -> Array:
    """Convert ``value`` to a read-only array. Check that it is a symmetric positive semidefinite matrix."""
    result = symmetric(name, value, size, meaning)
    scaled = _in_units(result)
    if exceeds(scaled, -_DEFINITENESS_TOLERANCE):
        return result
    smallest = float(np.linalg.eigvalsh(scaled)[0])
    if smallest < -_DEFINITENESS_TOLERANCE and not _is_rounding(result):
        raise ProblemError(
            f"{name} has the eigenvalue {_named(result, smallest)}; expected a positive semidefinite matrix "
            "(all eigenvalues ≥ 0)"
        )
    return result


def definite(name: str, value: ArrayLike, size: int, meaning: str = "") -> Array:
    """Convert ``value`` to a read-only array. Check that it is a symmetric positive definite matrix."""
    result = symmetric(name, value, size, meaning)
    scaled = _in_units(result)
    if exceeds(scaled, _DEFINITENESS_TOLERANCE):
        return result
    smallest = float(np.linalg.eigvalsh(scaled)[0])
    if smallest <= _DEFINITENESS_TOLERANCE:
        raise ProblemError(
            f"{name} has the eigenvalue {_named(result, smallest)}; expected a positive definite matrix "
            "(all eigenvalues > 0)"
        )
    return result


def is_definite(matrix: Array) -> bool:
    """Check whether a symmetric matrix is positive definite. The units of its variables do not affect the result."""
    return bool((matrix.diagonal() > NO_VARIANCE).all()) and exceeds(_in_units(matrix), _DEFINITENESS_TOLERANCE)


def exceeds(matrix: Array, bound: float) -> bool:
    """Check whether all eigenvalues of a symmetric matrix exceed a bound, by a Cholesky factorisation."""
    rest = matrix.copy()
    rest.flat[:: len(rest) + 1] -= bound
    try:
        np.linalg.cholesky(rest)
    except np.linalg.LinAlgError:
        return False
    return True


def number(name: str, value: object, low: float = -np.inf, high: float = np.inf, *, closed: bool = False) -> float:
    """Convert ``value`` to a float, and check that it is finite and lies between ``low`` and ``high``.

    The endpoints are excluded unless ``closed`` is true.

    Raises:
        ProblemError: the value is not a number, not finite, or outside the interval.
    """
    try:
        found = np.nan if isinstance(value, bool) or not isinstance(value, Real) else float(value)
    except OverflowError:  # an integer with more than 308 digits
        found = np.inf
    if not np.isfinite(found):
        raise ProblemError(f"{name} is {quoted(value)}; expected a finite number")
    inside = low <= found <= high if closed else low < found < high
    if not inside:
        less = "≤" if closed else "<"
        bounds = (f"{low:g} {less} " if low > -np.inf else "") + name + (f" {less} {high:g}" if high < np.inf else "")
        raise ProblemError(f"{name} is {found:g}; expected {bounds}")
    return found


def count(name: str, value: object, least: int = 1) -> int:
    """Convert ``value`` to an integer, and check that it is not smaller than ``least``.

    Raises:
        ProblemError: the value is not an integer, or is too small.
    """
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        raise ProblemError(f"{name} is {quoted(value)}; expected a whole number of at least {least}")
    return int(value)


def choice(name: str, value: Word, allowed: Collection[Word]) -> Word:
    """Check that ``value`` is one of the allowed words, and return it.

    Raises:
        ProblemError: the value is another word.
    """
    if value not in allowed:
        raise ProblemError(
            f"{name} is {quoted(value)}; expected one of the words {', '.join(repr(word) for word in allowed)}"
        )
    return value


def set_fields(made: object, values: Mapping[str, object]) -> None:
    """Set the fields of an instance of a frozen dataclass to values that have been checked."""
    for name, value in values.items():
        object.__setattr__(made, name, value)


def flag(name: str, value: object) -> bool:
    """Check that ``value`` is True or False, and return it."""
    if not isinstance(value, bool):
        raise ProblemError(f"{name} is {quoted(value)}; expected true or false")
    return value


def instance(name: str, value: object, *kinds: type) -> None:
    """Check that a value is an instance of one of the given types.

    Raises:
        ProblemError: the value is not an instance of any of the types.
    """
    if not isinstance(value, kinds):
        nouns = " or ".join(f"{'an' if kind.__name__[0] in 'AEIOaeio' else 'a'} {kind.__name__}" for kind in kinds)
        raise ProblemError(f"{name} is {quoted(value)}; expected {nouns}")


def frozen(value: Array) -> Array:
    """Copy an array to a new read-only array of floats."""
    result = np.array(value, dtype=np.float64)
    result.setflags(write=False)
    return result


def symmetrised(matrix: Array) -> Array:
    """Compute (X + X')/2 for a matrix X, or for each matrix in a stack, so that rounding errors leave it symmetric."""
    return (matrix + matrix.swapaxes(-1, -2)) / 2


def block_diagonal(*blocks: Array) -> Array:
    """Combine matrices into one block-diagonal matrix."""
    result = np.zeros((sum(len(block) for block in blocks), sum(block.shape[1] for block in blocks)))
    row, column = 0, 0
    for block in blocks:
        rows, columns = block.shape
        result[row : row + rows, column : column + columns] = block
        row, column = row + rows, column + columns
    return result


def quoted(value: object) -> str:
    """Write a value as text for an error message, shortened to 60 characters."""
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # an integer with more than 4300 digits
        return "a number that is too long to be shown"
    return text if len(text) <= 60 else f"{text[:57]}…"


def _fits(got: tuple[int, ...], shape: Shape) -> bool:
    return len(got) == len(shape) and all(want in (None, size) for size, want in zip(got, shape, strict=True))


def expect_unmasked(name: str, value: object) -> None:
    """Raise ``ProblemError`` if an array has masked entries, because NumPy would compute with the masked numbers."""
    if _masked(value):
        raise ProblemError(
            f"{name} has masked entries; expected a number in every entry: fill the masked entries, or leave them out"
        )


def _masked(value: object) -> bool:
    if "numpy.ma" not in sys.modules:  # then no array can be masked; NumPy imports this module at its first use
        return False
    if isinstance(value, np.ma.MaskedArray):
        return bool(np.ma.is_masked(cast("Any", value)))
    if not isinstance(value, list | tuple):
        return False
    return any(_masked(one) for one in cast("Sequence[object]", value) if not isinstance(one, float | int))


def _numbers(name: str, value: ArrayLike, shape: Shape, meaning: str) -> Array:
    expect_unmasked(name, value)
    try:
        given = np.asarray(value)
        if given.dtype.kind not in "biufO":  # NumPy would parse text and drop imaginary parts
            raise TypeError(f"it contains {given.dtype.type.__name__.strip('_')} values")
        numbers = np.array(given, dtype=np.float64)
        return numbers if numbers.ndim else numbers.reshape((1,) * len(shape))
    except (TypeError, ValueError, OverflowError) as error:
        expected = _shape_text(shape, meaning)
        if "inhomogeneous" in str(error):
            raise ProblemError(
                f"{name} has rows of different lengths: {_uneven(value)}; expected rows of equal length, such as {FORM}"
            ) from None
        raise ProblemError(
            f"{name} is not an array of numbers ({error}); expected an array of the shape {expected}"
        ) from None


def _uneven(value: object) -> str:
    """Return the clause about the first row of nested lists whose length differs from that of the first row."""
    rows = cast("Sequence[Any]", value)
    sizes = [len(cast("Any", row)) if isinstance(row, Sequence | np.ndarray) else None for row in rows]
    row = next((i for i, size in enumerate(sizes) if size != sizes[0]), None)
    if row is None:
        return "lists within its rows differ in length"
    first, here = (
        f"row {i + 1} is {quoted(rows[i])}"
        if size is None
        else f"row {i + 1} has {size} entr{'y' if size == 1 else 'ies'}"
        for i, size in ((0, sizes[0]), (row, sizes[row]))
    )
    return f"{here}, and {first}"


def _form(given: Array, dimensions: int, shape: Shape, meaning: str) -> str:
    """Return the given numbers in the expected form, as the end of a message, or any matrix if it is unclear."""
    if dimensions == len(shape) or len(shape) not in (1, 2) or not given.size:
        return ""
    numbers, found = given.ravel(), None
    rows, columns = (shape[0], shape[-1])
    if len(shape) == 2 and rows == columns and (rows or len({*re.findall(r"[a-z]+(?: [a-z]+)*", meaning)}) == 1):
        side = math.isqrt(numbers.size)
        size = rows or (side if side * side == numbers.size else numbers.size)
        if numbers.size in (1, size):
            found = np.diag(np.broadcast_to(numbers, size))
        elif numbers.size == size * size:
            found = numbers.reshape(size, size)
    elif dimensions == 0 and None not in shape:
        found = np.full(cast("tuple[int, ...]", shape), numbers[0])
    elif dimensions:
        forms = [numbers] if len(shape) == 1 else [numbers[:, None], numbers[None]]
        fitting = [one for one in forms if _fits(one.shape, shape)]
        found = fitting[0] if len(fitting) == 1 else None
    if found is None or found.size > LONGEST_FORM:
        return f", such as {FORM}" if len(shape) == 2 else ""
    return f", such as {_list_text(found)}"


def _list_text(value: Array) -> str:
    parts = (f"{entry:g}" for entry in value) if value.ndim == 1 else map(_list_text, value)
    return f"[{', '.join(parts)}]"


def _in_units(matrix: Array) -> Array:
    """Return a symmetric matrix in units in which its diagonal entries are 1, 0 or −1."""
    scale = 1 / np.sqrt(np.maximum(np.abs(matrix.diagonal()), NO_VARIANCE))
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = matrix * scale * scale[:, None]
    # An entry beyond 1 proves an eigenvalue below 0; its size is irrelevant.
    return np.minimum(np.maximum(scaled, -1e6), 1e6)


def _is_rounding(matrix: Array) -> bool:
    """Return whether the negative eigenvalues of a matrix are explained by the rounding of its products."""
    others = np.abs(matrix).max(axis=1, initial=0.0)
    if (matrix.diagonal() < -_ROUNDING * len(matrix) * others).any():
        return False
    values = np.linalg.eigvalsh(matrix)
    return bool(values[0] >= -_ROUNDING * len(matrix) * np.abs(values).max())


def _named(matrix: Array, smallest: float) -> str:
    """Return an eigenvalue as text; if it holds only in scaled units, the text names them."""
    found = float(np.linalg.eigvalsh(matrix)[0])
    if found <= 0 or smallest > 0:
        return f"{found:g}"
    return f"{smallest:g} in units that make its diagonal 1"


def _shape_text(shape: Sequence[int | None], meaning: str) -> str:
    sizes = ", ".join("any" if size is None else str(size) for size in shape)
    return f"({sizes}{',' if len(shape) == 1 else ''})" + (f" = {meaning}" if meaning else "")


def pushed(F: Array, X: Array, power: int) -> Array:
    """Compute a moment of the vector F z from the moment ``X`` of z; the last ``power`` indices of X are those of z."""
    for axis in range(X.ndim - power, X.ndim):
        X = np.moveaxis(np.tensordot(X, F, (axis, 1)), -1, axis)
    return X
