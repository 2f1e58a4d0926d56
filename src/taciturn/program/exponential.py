"""Exponentials and logarithms made of the program's own operations: printed alike everywhere, without a library.

Errors in the last place: an exponential one unit and a half, a logarithm one, e^x − 1 two and a quarter, tanh two and
three quarters; the fast build, which rounds some products together with a sum, is no worse.
"""

from __future__ import annotations

from math import factorial, inf, log
from typing import NamedTuple

from taciturn.program.bits import LAYOUTS, absolute, literal, nearest, power_of_two, sign_bit, signed
from taciturn.program.ir import Builder


class _Format(NamedTuple):
    """How a precision takes e^x apart: 2^k e^r, k whole and |r| at most half of log 2; and log x: k log 2 + log m."""

    terms: int  # of the series of e^r
    least: float  # exponent below which ``falling`` ends
    ends: tuple[float, float]  # exponents between which e^x is a number without loss
    flat: float  # 2x beyond which tanh x is 1
    log_two: tuple[float, float]  # the first part has so few bits that its product with k is exact
    root_half: int  # bits of √½
    atanh: int  # terms of the series of a logarithm
    tiny: float  # the least number with all its bits


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
    """Return e^{−x} to the last digit or two: 1 of an x < 0, and e^{−700}, or e^{−80} in single precision, at least.

    Source: muller2016
    """
    zero, least = b.constant(0.0), b.constant(_FORMATS[b.precision].least)
    exponent = b.emit("sub", zero, b.emit("select", b.emit("greater", x, zero), x, zero))
    exponent = b.emit("select", b.emit("greater", exponent, least), exponent, least)
    r, whole = _reduced(b, exponent)
    return b.emit("mul", b.polynomial(_series(b, 0), r), power_of_two(b, whole))


def exponential(b: Builder, x: int) -> int:
    """Return e^x, which saturates at e^{−708} and e^{709}, or e^{−87} and e^{88}.

    Source: muller2016
    """
    low, high = (b.constant(end) for end in _FORMATS[b.precision].ends)
    x = b.emit("select", b.emit("greater", low, x), low, x)  # what is no number stays none
    r, whole = _reduced(b, b.emit("select", b.emit("greater", x, high), high, x))
    return b.emit("mul", b.polynomial(_series(b, 0), r), power_of_two(b, whole))


def exponential_less_one(b: Builder, x: int) -> int:
    """Return e^x − 1, with all its digits where x is small, too; it saturates as e^x does.

    Source: muller2016
    """
    low, high = (b.constant(end) for end in _FORMATS[b.precision].ends)
    x = b.emit("select", b.emit("greater", low, x), low, x)
    return _less_one(b, b.emit("select", b.emit("greater", x, high), high, x))


def hyperbolic_tangent(b: Builder, x: int) -> int:
    """Return tanh x = E/(E + 2) of E = e^{2x} − 1.

    Source: muller2016
    """
    twice, flat = b.scale(2.0, absolute(b, x)), b.constant(_FORMATS[b.precision].flat)
    grown = _less_one(b, b.emit("select", b.emit("greater", twice, flat), flat, twice))
    return signed(b, b.emit("div", grown, b.emit("add", grown, b.constant(2.0))), sign_bit(b, x))


def logarithm(b: Builder, x: int) -> int:
    """Return log x: −∞ of 0, and no number of what is less.

    By x = 2^k (1 + f) with 1 + f in [√½, √2), and log(1 + f) = 2 artanh s, s = f/(2 + f).

    Source: muller2016
    """
    f, layout, zero = _FORMATS[b.precision], LAYOUTS[b.precision], b.constant(0.0)
    lift = float(layout.mantissa + 2)  # numbers with fewer bits than all are made larger first
    small = b.emit("greater", b.constant(f.tiny), x)
    lifted = b.emit("select", small, b.scale(2.0**lift, x), x)
    offset = b.emit("word_add", b.emit("bits", lifted), literal(b, layout.one - f.root_half))
    counter = (layout.bias + layout.mantissa) << layout.mantissa  # the bits of a number whose last one counts by one
    raised = b.emit("number", b.emit("word_or", b.emit("shift_right", offset, layout.mantissa), literal(b, counter)))
    k = b.emit("sub", raised, b.constant(2.0**layout.mantissa + layout.bias))
    k = b.emit("select", small, b.emit("sub", k, b.constant(lift)), k)
    fraction = b.emit("word_and", offset, literal(b, layout.fraction))
    part = b.emit("sub", b.emit("number", b.emit("word_add", fraction, literal(b, f.root_half))), b.constant(1.0))
    s = b.emit("div", part, b.emit("add", b.constant(2.0), part))
    square = b.emit("mul", s, s)
    half = b.emit("mul", b.scale(0.5, part), part)
    rest = b.emit("mul", square, b.polynomial([2.0 / (2 * i + 3) for i in range(f.atanh)], square))
    high, low = (b.scale(value, k) for value in f.log_two)
    inner = b.emit("add", b.emit("mul", s, b.emit("add", half, rest)), low)
    found = b.emit("sub", high, b.emit("sub", b.emit("sub", half, inner), part))
    endless = b.constant(inf)
    found = b.emit("select", b.emit("less_equal", endless, x), x, found)
    pole = b.emit("sub", b.emit("sqrt", x), endless)
    return b.emit("select", b.emit("greater", x, zero), found, pole)


def _reduced(b: Builder, exponent: int) -> tuple[int, int]:
    """Return r, and bits that end in those of k."""
    k, whole = nearest(b, exponent, 1 / log(2))
    r = exponent
    for part in _FORMATS[b.precision].log_two:
        r = b.emit("sub", r, b.emit("mul", k, b.constant(part)))
    return r, whole


def _series(b: Builder, first: int) -> list[float]:
    return [1.0 / factorial(i) for i in range(first, _FORMATS[b.precision].terms)]


def _less_one(b: Builder, x: int) -> int:
    r, whole = _reduced(b, x)
    less = b.emit("add", r, b.emit("mul", b.emit("mul", r, r), b.polynomial(_series(b, 2), r)))
    power = power_of_two(b, whole)
    return b.emit("add", b.emit("mul", power, less), b.emit("sub", power, b.constant(1.0)))
