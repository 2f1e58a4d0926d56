"""Text to matrices and back, in MATLAB's notation or as a Python list.

A square matrix may be one number or a diagonal, and noise may be given by its amplitudes, the standard deviations.
"""

from __future__ import annotations

import ast
import math
import re

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Array, ArrayLike, array, expect_unmasked, quoted

FORMS = "[1 2; 3 4] or [[1, 2], [3, 4]]"
LONGEST = 100  # characters of a matrix that is printed on one line


def parse_matrix(name: str, text: str) -> Array:
    """Return the matrix that is written in a text."""
    given = text.strip()
    try:
        rows: object = ast.literal_eval(given) if re.match(r"\[\s*\[", given) else _matlab_rows(given)
        return array(name, np.array(rows, dtype=np.float64), (None, None), "(rows, columns)")
    except ProblemError:
        raise
    except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError, OverflowError):
        raise ProblemError(f"{name} is {quoted(given)}; expected a number, or a matrix as {FORMS}") from None


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


def parse_noise(name: str, text: str, B: Array) -> Array:
    """Return the covariance of noise that is written as a matrix, or by amplitudes in units: standard deviations."""
    place, sign, amplitudes = text.replace("+-", "±").partition("±")
    if not sign:
        return parse_matrix(name, text)
    if not amplitudes.strip():
        raise ProblemError(f"{name} has no deviation after ±; expected numbers, such as ± 0.1 0.2")
    deviations = parse_matrix(f"the vector of deviations of {name}", amplitudes)
    at_inputs = place.strip().lower() in ("input", "inputs")
    if (place.strip() and not at_inputs) or (at_inputs and name != "W"):
        raise ProblemError(f"{name} is {quoted(text)}; expected a matrix, ± 0.1 0.2, or for W also inputs ± 0.3")
    if (deviations < 0).any() or 1 not in deviations.shape:
        raise ProblemError(f"the deviations of {name} are {quoted(amplitudes)}; expected numbers of at least 0")
    each = deviations.ravel()
    if not at_inputs:
        return each[None] ** 2
    if each.size not in (1, B.shape[1]):
        expected = "one" if B.shape[1] == 1 else f"one, or {B.shape[1]}"
        raise ProblemError(f"{name} has {each.size} deviations at inputs; expected {expected}")
    return (B * each) @ (B * each).T


def square_matrix(name: str, value: ArrayLike, size: int) -> Array:
    """Return a weight or covariance: a number times the identity, a vector as a diagonal, or a matrix unchanged."""
    expect_unmasked(name, value)
    found = array(name, np.atleast_2d(np.asarray(value)), (None, None), "(rows, columns)")
    if found.size == 1:
        return found[0, 0] * np.eye(size)
    if found.size == size and 1 in found.shape:
        return np.diag(found.ravel())
    if found.shape != (size, size):
        rows, columns = found.shape
        raise ProblemError(
            f"{name} is {rows}×{columns}; expected one number, {size} for a diagonal, or a matrix {size}×{size}"
        )
    return found


def matrix_text(value: ArrayLike) -> str:
    """Return a matrix in TOML notation, on one line or, if this line is too long, row by row."""
    rows = [f"[{', '.join(exact_number_text(entry) for entry in row)}]" for row in np.atleast_2d(np.asarray(value))]
    line = f"[{', '.join(rows)}]"
    return line if len(line) <= LONGEST else "[\n" + "".join(f"  {row},\n" for row in rows) + "]"


def exact_number_text(value: float) -> str:
    """Return a number in TOML notation with full precision; an integer is written without a decimal point."""
    exact = float(value)
    return str(int(exact)) if math.isfinite(exact) and exact == int(exact) and abs(exact) < 1e15 else repr(exact)
