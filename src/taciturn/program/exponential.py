"""Exponentials and logarithms as operations of a program, bit-identical in every back end, without a library.

Largest errors in units in the last place: e^x 1.5, log x 1, e^x − 1 2.25, tanh x 2.75. The fast build, which fuses
some products with sums, has the same bounds.
"""

from __future__ import annotations

from math import factorial, inf, log
from typing import NamedTuple

from taciturn.program.bits import LAYOUTS, absolute_value, nearest, power_of_two, sign_bit, signed, word_of_bits
from taciturn.program.ir import Builder


class _Format(NamedTuple):
    """Constants of a precision for e^x = 2^k e^r, with integer k and |r| ≤ ½ log 2, and for log x = k log 2 + log m."""

    terms: int  # of the series of e^r
    least: float  # exponent at which ``falling`` saturates
    ends: tuple[float, float]  # exponents between which e^x neither overflows nor becomes subnormal
    flat: float  # least 2x for which tanh x rounds to 1
    log_two: tuple[float, float]  # log 2 in two parts; the first has so few bits that its product with k is exact
    root_half: int  # bits of √½
    atanh: int  # terms of the series of a logarithm
    tiny: float  # the least normal number


_FORMATS = {
    "float64": _Format(
        14, -700.0, (-708.0, 709.0), 44.0, (0.6931471803691238, 1.9082149292705877e-10),
        0x3FE6A09E667F3BCD, 11, 2.0**-1022,
    ),
    "float32": _Format(
        8, -80.0, (-87.0, 88.0), 20.0, (0.693359375, -2.12194440e-4), 0x3F3504F3, 5, 2.0**-126,
    ),
}  # fmt: skip


def falling(b: Builder, x: int) -> int:
    """Return e^{−x}, limited to at most 1 (for x < 0) and at least e^{−700}, or e^{−80} in single precision.

    Source: muller2016
    """
    # the exponent −max(x, 0), limited to at least ``least`` so that 2^k is a normal number
    zero, least = b.constant(0.0), b.constant(_FORMATS[b.precision].least)
    exponent = b.emit("sub", zero, b.emit("select", b.emit("greater", x, zero), x, zero))
    exponent = b.emit("select", b.emit("greater", exponent, least), exponent, least)
    r, whole = _reduced(b, exponent)
    return b.emit("mul", b.polynomial(_series(b, 0), r), power_of_two(b, whole))


def exponential_of(b: Builder, x: int) -> int:
    """Return e^x, saturated at e^{−708} and e^{709}, or e^{−87} and e^{88} in single precision.

    Source: muller2016
    """
    low, high = (b.constant(end) for end in _FORMATS[b.precision].ends)
    # comparisons with NaN are false, so that these selections return NaN for NaN
    x = b.emit("select", b.emit("greater", low, x), low, x)
    r, whole = _reduced(b, b.emit("select", b.emit("greater", x, high), high, x))
    return b.emit("mul", b.polynomial(_series(b, 0), r), power_of_two(b, whole))


def exponential_less_one(b: Builder, x: int) -> int:
    """Return e^x − 1, also accurate for small x, with the same saturation as ``exponential_of``.

    Source: muller2016
    """
    low, high = (b.constant(end) for end in _FORMATS[b.precision].ends)
    x = b.emit("select", b.emit("greater", low, x), low, x)
    return _less_one(b, b.emit("select", b.emit("greater", x, high), high, x))


def hyperbolic_tangent(b: Builder, x: int) -> int:
    """Return tanh x = E/(E + 2), where E = e^{2x} − 1.

    Source: muller2016
    """
    # computed for |x|, where E ≥ 0 and nothing cancels; the sign of x is set at the end. 2|x| is limited to ``flat``,
    # from which on the quotient rounds to 1.
    twice, flat = b.scale(2.0, absolute_value(b, x)), b.constant(_FORMATS[b.precision].flat)
    grown = _less_one(b, b.emit("select", b.emit("greater", twice, flat), flat, twice))
    return signed(b, b.emit("div", grown, b.emit("add", grown, b.constant(2.0))), sign_bit(b, x))


def logarithm(b: Builder, x: int) -> int:
    """Return log x, which is −∞ for 0 and NaN for negative x.

    For x = 2^k (1 + f) with 1 + f in [√½, √2), log x = k log 2 + log(1 + f), and log(1 + f) = 2 artanh s with
    s = f/(2 + f).

    Source: muller2016
    """
    f, layout, zero = _FORMATS[b.precision], LAYOUTS[b.precision], b.constant(0.0)
    # a subnormal x has fewer bits: it is multiplied by 2^lift, and lift is subtracted from k below
    lift = float(layout.mantissa + 2)
    small = b.emit("greater", b.constant(f.tiny), x)
    lifted = b.emit("select", small, b.scale(2.0**lift, x), x)
    # adding bits(1) − bits(√½) moves the boundary between exponents from 1 down to √½: k = 0 for 1 + f in [√½, √2)
    offset = b.emit("word_add", b.emit("bits", lifted), word_of_bits(b, layout.one - f.root_half))
    # the exponent field E = k + bias becomes a number without a conversion: inserted into the last bits of 2^mantissa,
    # it gives 2^mantissa + E exactly
    counter = (layout.bias + layout.mantissa) << layout.mantissa
    raised = b.emit(
        "number", b.emit("word_or", b.emit("shift_right", offset, layout.mantissa), word_of_bits(b, counter))
    )
    k = b.emit("sub", raised, b.constant(2.0**layout.mantissa + layout.bias))
    k = b.emit("select", small, b.emit("sub", k, b.constant(lift)), k)
    # ``part`` is f, exact; s = f/(2 + f), |s| ≤ 0.172
    fraction = b.emit("word_and", offset, word_of_bits(b, layout.fraction))
    part = b.emit("sub", b.emit("number", b.emit("word_add", fraction, word_of_bits(b, f.root_half))), b.constant(1.0))
    s = b.emit("div", part, b.emit("add", b.constant(2.0), part))
    # log(1 + f) = f − f²/2 + s (f²/2 + R), R = s² (2/3 + 2s²/5 + …): f is exact and by far the largest term for small
    # f, so that the rounding errors of the other terms are negligible
    square = b.emit("mul", s, s)
    half = b.emit("mul", b.scale(0.5, part), part)
    rest = b.emit("mul", square, b.polynomial([2.0 / (2 * i + 3) for i in range(f.atanh)], square))
    # k log 2 = high + low, where high is exact; small terms are added first, as this has the smaller rounding error
    high, low = (b.scale(value, k) for value in f.log_two)
    inner = b.emit("add", b.emit("mul", s, b.emit("add", half, rest)), low)
    found = b.emit("sub", high, b.emit("sub", b.emit("sub", half, inner), part))
    # log ∞ = ∞. For x ≤ 0, √x − ∞ is −∞ at 0 and NaN below; NaN takes this branch too.
    endless = b.constant(inf)
    found = b.emit("select", b.emit("less_equal", endless, x), x, found)
    pole = b.emit("sub", b.emit("sqrt", x), endless)
    return b.emit("select", b.emit("greater", x, zero), found, pole)


def _reduced(b: Builder, exponent: int) -> tuple[int, int]:
    """Return r with x = k log 2 + r, and a word whose last bits are those of the integer k."""
    # Cody and Waite: k·(first part of log 2) and its difference from x are exact; only the second part is rounded
    k, whole = nearest(b, exponent, 1 / log(2))
    r = exponent
    for part in _FORMATS[b.precision].log_two:
        r = b.emit("sub", r, b.emit("mul", k, b.constant(part)))
    return r, whole


def _series(b: Builder, first: int) -> list[float]:
    """Return the Taylor coefficients 1/first!, 1/(first + 1)!, … of e^r."""
    return [1.0 / factorial(i) for i in range(first, _FORMATS[b.precision].terms)]


def _less_one(b: Builder, x: int) -> int:
    """Return e^x − 1 = 2^k (e^r − 1) + (2^k − 1), with e^r − 1 = r + r² (1/2! + r/3! + …), accurate for small r."""
    r, whole = _reduced(b, x)
    less = b.emit("add", r, b.emit("mul", b.emit("mul", r, r), b.polynomial(_series(b, 2), r)))
    power = power_of_two(b, whole)
    return b.emit("add", b.emit("mul", power, less), b.emit("sub", power, b.constant(1.0)))
