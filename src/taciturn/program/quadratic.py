"""Interpretation of programs whose values are polynomials, of degree at most two, in some coordinates.

A linear value ℓ'q is stored as the row ℓ, and a quadratic form q'Hq as the symmetric matrix H, for a vector q of
coordinates that ends with the number 1. So sums and products of such values are sums and products of matrices, and a
step without branches is known as a map of q, with its cost as a quadratic form.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from taciturn._arrays import Array
from taciturn.errors import ProblemError
from taciturn.program.ir import Program
from taciturn.program.ops import Name, needed


def read_polynomials(
    program: Program, coordinates: int, inputs: Mapping[Name, Array], sizes: bool = False
) -> dict[int, Array]:
    """Express the states, sums and outputs of a program as polynomials in the coordinates, by index of the operation.

    With ``sizes``, a coefficient is the sum of the absolute values of its terms. It exceeds the absolute value of the
    coefficient itself where terms cancel, and bounds its rounding error in units of the last digit.
    """
    size = np.abs if sizes else np.asarray
    unit, values = np.eye(coordinates + 1), dict[int, Array]()
    for index in sorted(needed(program.ops, [*program.following, *program.sums.values(), *program.outputs.values()])):
        name, (first, *rest) = program.ops[index]
        if name == "const":
            values[index] = size(program.constants[first] * unit[-1])
        elif name == "state":
            values[index] = unit[first]
        elif name == "input":
            values[index] = size(inputs[program.inputs[first]])
        elif name == "product":
            values[index] = size(np.array(program.matrices[first])) @ np.array([values[i] for i in rest])
        elif name == "entry":
            values[index] = values[first][rest[0]]
        elif name == "mul":
            values[index] = _product(values[first], values[rest[0]])
        elif name == "div" and not values[rest[0]][..., :-1].any():
            values[index] = values[first] / values[rest[0]][-1]
        elif name in ("add", "sub"):
            left, right = values[first], values[rest[0]]
            if left.ndim != right.ndim:
                left, right = as_form(left), as_form(right)
            values[index] = left + right if sizes or name == "add" else left - right
        else:
            raise ProblemError(f"a policy step contains the operation {name!r}; expected only sums and products")
    return values


def as_form(value: Array) -> Array:
    """Write a linear or quadratic function of the coordinates as the matrix of a quadratic form."""
    return value if value.ndim == 2 else _symmetric(value, np.eye(len(value))[-1])


def _product(left: Array, right: Array) -> Array:
    for known, other in ((left, right), (right, left)):
        if known.ndim == 1 and not known[:-1].any():
            return known[-1] * other
    if left.ndim + right.ndim > 2:
        raise ProblemError("a policy step contains a polynomial of degree above two; expected quadratic forms")
    return _symmetric(left, right)


def _symmetric(left: Array, right: Array) -> Array:
    return (np.outer(left, right) + np.outer(right, left)) / 2
