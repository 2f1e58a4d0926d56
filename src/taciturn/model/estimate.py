"""A reported number: value, standard error, and how it was had."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

Method: TypeAlias = Literal["exact", "quadrature", "bound", "simulation"]


@dataclass(frozen=True)
class Estimate:
    """A number that was computed.

    Args:
        value: the number.
        standard_error: its standard error; 0 where it was not simulated.
        method: how it was had.
    """

    value: float
    standard_error: float
    method: Method

    def scaled(self, factor: float, offset: float = 0.0) -> Estimate:
        """Return offset + factor·estimate."""
        return Estimate(offset + factor * self.value, abs(factor) * self.standard_error, self.method)

    def __str__(self) -> str:
        """Return the value with as many digits as its standard error supports."""
        if self.standard_error == 0:
            return f"{self.value:.6g}"
        digits = max(0, 1 - _exponent(self.standard_error))
        if digits > 12 or abs(self.value) >= 1e15:
            return f"{self.value:.6g} ± {self.standard_error:.2g}"
        return f"{self.value:.{digits}f} ± {self.standard_error:.{digits}f}"


def _exponent(value: float) -> int:
    return int(f"{value:e}".split("e")[1])
