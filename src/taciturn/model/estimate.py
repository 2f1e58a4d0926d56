"""A reported number: its value, its standard error, and the method by which it was computed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from taciturn._display import Displayed

Method: TypeAlias = Literal["exact", "quadrature", "bound", "simulation"]
EXACT, FINE = 1e-14, 1e-10  # relative errors below which the error is not printed
Part: TypeAlias = Literal["value", "standard_error", "method", "error"]


@dataclass(frozen=True, repr=False)
class Estimate(Displayed):
    """A computed number that prints as value ± standard error, rounded to two digits of the error.

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
        if spread <= EXACT * abs(self.value):  # only rounding errors
            return f"{self.value:z.6g}"
        if spread <= FINE * abs(self.value):  # the error is below the printed digits; JSON contains it
            return f"{self.value:z.9g}"
        digits = max(0, 1 - _exponent(spread))
        if digits > 12 or abs(self.value) >= 1e15:
            return f"{self.value:z.{12 if digits > 12 else 6}g} ± {spread:.2g}"
        return f"{self.value:z.{digits}f} ± {spread:.{digits}f}"


def _exponent(value: float) -> int:
    return int(f"{value:e}".split("e")[1])
