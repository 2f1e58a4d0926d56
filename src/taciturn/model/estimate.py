"""A reported number: value, standard error, and how it was had."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

Method: TypeAlias = Literal["exact", "quadrature", "bound", "simulation"]
Part: TypeAlias = Literal["value", "standard_error", "method", "error"]


@dataclass(frozen=True)
class Estimate:
    """A number that was computed.

    Args:
        value: the number.
        standard_error: its standard error; 0 where it was not simulated.
        method: how it was had.
        error: what a quadrature claims that it is off by at most; 0 of any other method.
    """

    value: float
    standard_error: float
    method: Method
    error: float = 0.0

    def scaled(self, factor: float, offset: float = 0.0) -> Estimate:
        """Return offset + factor·estimate."""
        size = abs(factor)
        return Estimate(offset + factor * self.value, size * self.standard_error, self.method, size * self.error)

    def inverse(self, factor: float = 1.0) -> Estimate:
        """Return factor/estimate, its errors to first order."""
        slope = abs(factor) / self.value**2
        return Estimate(factor / self.value, slope * self.standard_error, self.method, slope * self.error)

    def document(self, *parts: Part) -> dict[str, Any]:
        """Return what JSON holds of it; where no parts are named, all but the error, which a quadrature alone has."""
        return {part: getattr(self, part) for part in parts or ("value", "standard_error", "method")}

    def __str__(self) -> str:
        """Return the value with as many digits as its standard error, or its claimed error, supports."""
        spread = self.standard_error or self.error
        if spread <= 1e-14 * abs(self.value):  # nothing but rounding
            return f"{self.value:.6g}"
        digits = max(0, 1 - _exponent(spread))
        if digits > 12 or abs(self.value) >= 1e15:
            return f"{self.value:.{12 if digits > 12 else 6}g} ± {spread:.2g}"
        return f"{self.value:.{digits}f} ± {spread:.{digits}f}"


def _exponent(value: float) -> int:
    return int(f"{value:e}".split("e")[1])
