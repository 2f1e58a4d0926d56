"""Conversion of matrices from and to text, in MATLAB's notation or as Python lists.

A covariance and a weight have two forms. Numbers without brackets are sizes in the units of the signals: standard
deviations of noise, or acceptable deviations of outputs and inputs, of which the weight is 1/size². Brackets hold the
matrix itself, or its diagonal.
"""

from __future__ import annotations

import ast
import math
import re

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Array, ArrayLike, array, expect_unmasked, number_of, quoted

FORMS = "[1 2; 3 4] or [[1, 2], [3, 4]]"
DIGITS = 12  # of a square, which rounding does not reach
LONGEST = 100  # characters of a matrix that is printed on one line


def parse_matrix(name: str, text: str) -> Array:
    """Convert a text in MATLAB's or Python's notation to a matrix."""
    given = text.strip()
    try:
        rows: object = ast.literal_eval(given) if re.match(r"\[\s*\[", given) else _matlab_rows(given)
        return array(name, np.array(rows, dtype=np.float64), (None, None), "(rows, columns)")
    except ProblemError:
        raise
    except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError, OverflowError):
        raise ProblemError(f"{name} is {quoted(given)}; expected a number, or a matrix in the form {FORMS}") from None


def _matlab_rows(text: str) -> list[list[float]]:
    """Return the rows of a matrix in MATLAB notation; a line break ends a row unless it follows three dots."""
    inside = text.rstrip(";").strip()
    if inside.startswith("[") != inside.endswith("]") or "_" in inside or set(inside[1:-1]) & {"[", "]"}:
        raise ValueError
    lines = re.sub(r"\.\.\.\s*\n", " ", inside.removeprefix("[").removesuffix("]"))
    rows = [
        [float(part) for part in re.split(r"[\s,]+", row.strip(" \t,"))]
        for row in re.split(r"[;\n]+", lines)
        if row.strip()
    ]
    if len({len(row) for row in rows}) != 1:
        raise ValueError
    return rows


def parse_numbers(name: str, text: str, size: int, each: str) -> Array:
    """Convert numbers in a text without brackets to an array, shape (size,); a single number fills all entries."""
    found = parse_matrix(name, text.replace("\n", " ").replace(";", " ")).ravel()
    if found.size not in (1, size):
        expected = "one number" if size == 1 else f"one number, or {size}, one for each {each}"
        raise ProblemError(f"{name} has {number_of(found.size, 'number')}; expected {expected}")
    return np.broadcast_to(found, size)


def parse_noise(name: str, text: str, size: int, each: str) -> Array:
    """Convert standard deviations, or a covariance in brackets (a matrix or its diagonal), to a covariance matrix."""
    typed = text.replace("+-", " ").replace("±", " ").strip()
    if typed.startswith("["):
        return parse_matrix(name, typed)
    deviations = parse_numbers(f"the standard deviation of {name}", typed, size, each)
    if (deviations < 0).any():
        raise ProblemError(f"the standard deviation of {name} is {deviations.min():g}; expected at least 0")
    return np.diag([float(f"{one**2:.{DIGITS}g}") for one in deviations])


def parse_input_noise(text: str, B: Array) -> Array | None:
    """Return the noise covariance for a text such as ``inputs 0.3`` (noise at the inputs); None for other texts."""
    place, _, rest = text.strip().partition(" ")
    if place.lower() not in ("input", "inputs"):
        return None
    return B @ parse_noise("W", rest, B.shape[1], "input") @ B.T


def parse_weight(name: str, text: str, seen: Array, each: str) -> Array:
    """Convert acceptable signal sizes, or a weight in brackets, to the weighting matrix of the signals ``seen`` @ z."""
    if text.startswith("["):
        return parse_matrix(name, text)
    sizes = parse_numbers(f"the size for {name}", text, len(seen), each)
    if (sizes <= 0).any():
        raise ProblemError(f"the acceptable size of {name} is {sizes.min():g}; expected more than 0")
    return seen.T @ np.diag([float(f"{one**-2:.{DIGITS}g}") for one in sizes]) @ seen


def parse_indices(name: str, text: str, size: int) -> list[int]:
    """Convert the numbers of signals, counted from 1, to indices, counted from 0."""
    words = re.split(r"[\s,]+", text.strip(" ,"))
    for word in words:
        if not word.isdecimal() or not 1 <= int(word) <= size:
            raise ProblemError(f"{name} is {quoted(text)}; expected numbers from 1 to {size}, such as 1")
    found = [int(word) - 1 for word in words]
    if len(set(found)) < len(found):
        raise ProblemError(f"{name} is {quoted(text)}; expected a list that contains each number only once")
    return found


def square_matrix(name: str, value: ArrayLike, size: int) -> Array:
    """Return a weight or covariance as a full matrix, given as a number, as the diagonal, or in full."""
    expect_unmasked(name, value)
    found = array(name, np.atleast_2d(np.asarray(value)), (None, None), "(rows, columns)")
    if found.size == 1:
        return found[0, 0] * np.eye(size)
    if found.size == size and 1 in found.shape:
        return np.diag(found.ravel())
    if found.shape != (size, size):
        rows, columns = found.shape
        raise ProblemError(
            f"{name} is a matrix of size {rows}×{columns}; expected one number, {size} numbers for a diagonal matrix, "
            f"or a {size}×{size} matrix"
        )
    return found


def rows_text(value: ArrayLike) -> str:
    """Format a matrix or vector for TOML: on one line if it fits, otherwise with one row per line."""
    given = np.asarray(value)
    rows = [list_text(row) for row in np.atleast_2d(given)]
    line = rows[0] if given.ndim == 1 else f"[{', '.join(rows)}]"
    return line if len(line) <= LONGEST or given.ndim == 1 else "[\n" + "".join(f"  {row},\n" for row in rows) + "]"


def list_text(row: ArrayLike) -> str:
    """Format a vector for TOML."""
    return f"[{', '.join(exact_number_text(entry) for entry in np.asarray(row))}]"


def exact_number_text(value: float) -> str:
    """Format a number for TOML with all its digits; a whole number has no decimal point."""
    exact = float(value)
    return str(int(exact)) if math.isfinite(exact) and exact == int(exact) and abs(exact) < 1e15 else repr(exact)
