"""Exponentials made of the program's own operations: printed alike everywhere, without a library."""

from __future__ import annotations

from math import factorial
from typing import NamedTuple

from taciturn.program.ir import Builder


class _Format(NamedTuple):
    """How a precision takes e^{−x} apart: 2^k e^r, k whole and |r| at most half of log 2.

    A sum with ``shift`` has no bits left below one, so that its last bits are those of the whole number k.
    """

    terms: int  # of the series of e^r
    least: float  # exponent below which nothing is left
    shift: float  # 1.5 · 2^(bits of the mantissa)
    log_two: tuple[float, float]  # the first part has so few bits that its product with k is exact
    word: str
    bias: int
    mantissa: int


_FORMATS = {
    "float64": _Format(14, -700.0, 1.5 * 2.0**52, (0.6931471803691238, 1.9082149292705877e-10), "word", 1023, 52),
    "float32": _Format(8, -80.0, 1.5 * 2.0**23, (0.693359375, -2.12194440e-4), "half", 127, 23),
}


def falling(b: Builder, x: int) -> int:
    """Return e^{−x} to the last digit or two: 1 of an x < 0, and e^{−700}, or e^{−80} in single precision, at least.

    Source: muller2016
    """
    f = _FORMATS[b.precision]
    zero, least = b.constant(0.0), b.constant(f.least)
    exponent = b.emit("sub", zero, b.emit("select", b.emit("greater", x, zero), x, zero))
    exponent = b.emit("select", b.emit("greater", exponent, least), exponent, least)
    shifted = b.emit("add", b.emit("mul", exponent, b.constant(1.4426950408889634)), b.constant(f.shift))
    k = b.emit("sub", shifted, b.constant(f.shift))
    r = exponent
    for part in f.log_two:
        r = b.emit("sub", r, b.emit("mul", k, b.constant(part)))
    series = b.polynomial([1.0 / factorial(i) for i in range(f.terms)], r)
    biased = b.emit("word_add", b.emit("bits", shifted), b.emit(f.word, f.bias))
    return b.emit("mul", series, b.emit("number", b.emit("shift_left", biased, f.mantissa)))
