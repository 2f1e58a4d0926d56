"""A computed number with its standard error, and the method by which it was computed.

A bound is rounded in the direction in which it still holds: up (1) for a guarantee, and down (−1) for a lower bound.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

from taciturn._display import Displayed
from taciturn._text import LARGE, magnitude, measured_text, negligible, number_text

Method: TypeAlias = Literal["exact", "quadrature", "bound", "simulation"]
EXACT_SHARE = 1e-14  # relative errors up to here are those of arithmetic; the number is printed with six digits
Part: TypeAlias = Literal["value", "standard_error", "method", "error"]


@dataclass(frozen=True, repr=False)
class Estimate(Displayed):
    """A computed number. It is printed as value ± standard error, rounded to two digits of the error.

    An error of at most 1e-9 of the value is not printed; JSON documents contain it.

    Args:
        value: the number.
        standard_error: standard error of a simulation; 0 for other methods.
        method: the method by which the number was computed.
        error: error bound of a quadrature; 0 for other methods.
    """

    value: float
    standard_error: float
    method: Method
    error: float = 0.0

    def summary(self) -> Mapping[str, object]:
        """Return the values to display: the number with its standard error, and the method of computation."""
        return {"value": self, "method": self.method}

    def short(self) -> str:
        """Write the number and its standard error as text."""
        return str(self)

    def scaled(self, factor: float, offset: float = 0.0) -> Estimate:
        """Return offset + factor·estimate; the errors are multiplied by the factor."""
        size = abs(factor)
        return Estimate(offset + factor * self.value, size * self.standard_error, self.method, size * self.error)

    def inverse(self, factor: float = 1.0) -> Estimate:
        """Return factor/estimate, with errors to first order."""
        slope = abs(factor) / self.value**2
        return Estimate(factor / self.value, slope * self.standard_error, self.method, slope * self.error)

    def document(self, *parts: Part) -> dict[str, Any]:
        """Return the named attributes as a dictionary for JSON; by default value, standard error and method."""
        return {part: getattr(self, part) for part in parts or ("value", "standard_error", "method")}

    def rounded(self, digits: int = 4) -> str:
        """Write the number with the given number of digits, or with fewer if its standard error is larger."""
        if self.standard_error > 0 and self.value:
            digits = max(1, min(digits, 1 + magnitude(self.value) - magnitude(self.standard_error)))
        return number_text(self.value, digits)

    def __str__(self) -> str:
        """Return the value with the number of digits that its standard error, or its claimed error, supports."""
        spread = self.standard_error or self.error
        if negligible(spread, self.value):
            return number_text(self.value, 6 if spread <= EXACT_SHARE * abs(self.value) else 9)
        return measured_text(self.value, spread)


def outward(value: float, digits: int, up: int) -> float:
    """Round an upper bound up (``up`` = 1), or a lower bound down (``up`` = −1), to a number of digits."""
    nearest = float(f"{value:.{digits}g}")
    if up * (nearest - value) < 0:
        nearest += up * 10.0 ** (math.floor(math.log10(abs(value))) + 1 - digits)
    return nearest


def rounded(value: float, digits: int, up: int) -> str:
    """Round an upper bound up (``up`` = 1), or a lower bound down (``up`` = −1), and write it as text."""
    nearest = outward(value, digits, up)
    if 1e4 <= abs(nearest) < LARGE:  # as a whole number, which is on the same side
        return str((math.ceil if up > 0 else math.floor)(nearest))
    return number_text(nearest, digits)


def proved(bound: float | None) -> float | None:
    """Round an upper bound up to six digits. Return None if the bound is None."""
    return None if bound is None else outward(bound, 6, 1)


def bound_text(bound: Estimate, up: int) -> str:
    """Write a bound as text, rounded up (``up`` = 1) or down (−1) to six digits, or fewer if it has an error."""
    if bound.standard_error == 0:
        return rounded(bound.value, 6, up)
    digits = 2 + magnitude(bound.value) - magnitude(bound.standard_error)
    return str(replace(bound, value=outward(bound.value, digits, up) if digits > 0 else bound.value))
