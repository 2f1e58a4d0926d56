"""A reported number: its value, its standard error, and the method by which it was computed.

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
    """A computed number that prints as value ± standard error, rounded to two digits of the error.

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
        """Return the value with its standard error, and the method."""
        return {"value": self, "method": self.method}

    def short(self) -> str:
        """Return the value with its standard error as text."""
        return str(self)

    def scaled(self, factor: float, offset: float = 0.0) -> Estimate:
        """Return offset + factor·estimate."""
        size = abs(factor)
        return Estimate(offset + factor * self.value, size * self.standard_error, self.method, size * self.error)

    def inverse(self, factor: float = 1.0) -> Estimate:
        """Return factor/estimate, with errors propagated to first order."""
        slope = abs(factor) / self.value**2
        return Estimate(factor / self.value, slope * self.standard_error, self.method, slope * self.error)

    def document(self, *parts: Part) -> dict[str, Any]:
        """Return the named parts as a dictionary for JSON; by default value, standard error and method."""
        return {part: getattr(self, part) for part in parts or ("value", "standard_error", "method")}

    def __str__(self) -> str:
        """Return the value with as many digits as its standard error, or its claimed error, supports."""
        spread = self.standard_error or self.error
        if negligible(spread, self.value):
            return number_text(self.value, 6 if spread <= EXACT_SHARE * abs(self.value) else 9)
        return measured_text(self.value, spread)


def outward(value: float, digits: int, up: int) -> float:
    """Return a bound rounded up (1) or down (−1) to the given number of digits, so that it still holds."""
    nearest = float(f"{value:.{digits}g}")
    if up * (nearest - value) < 0:
        nearest += up * 10.0 ** (math.floor(math.log10(abs(value))) + 1 - digits)
    return nearest


def rounded(value: float, digits: int, up: int) -> str:
    """Return a bound as text, rounded up (1) or down (−1), so that it still holds."""
    nearest = outward(value, digits, up)
    if 1e4 <= abs(nearest) < LARGE:  # as a whole number, which is on the same side
        return str((math.ceil if up > 0 else math.floor)(nearest))
    return number_text(nearest, digits)


def proved(bound: float | None) -> float | None:
    """Return an upper bound, rounded up to six digits, or None without a bound."""
    return None if bound is None else outward(bound, 6, 1)


def bound_text(bound: Estimate, up: int) -> str:
    """Return a bound as text, rounded up (1) or down (−1) to six digits, or to those that its standard error allows."""
    if bound.standard_error == 0:
        return rounded(bound.value, 6, up)
    digits = 2 + magnitude(bound.value) - magnitude(bound.standard_error)
    return str(replace(bound, value=outward(bound.value, digits, up) if digits > 0 else bound.value))
