"""Sine, cosine, tangent and their inverses as operations of a program, bit-identical in every back end.

An angle is reduced to |x| − k·π/2 by the method of Cody and Waite: π/2 is a sum of parts. The first parts have so few
bits that their products with k < 2^25 (2^16 in single precision) and the differences are exact. The last parts are
rounded, and the rounding error is stored in a second number.

Largest errors in units in the last place, for |x| ≤ 5e7 (1e5 in single precision): sine and cosine 1, tangent 2.75,
inverses 2. Within 1e-9 (1e-5) of a multiple of π/2 the error is absolute, at most 1e-25 (1e-12). For a larger |x| the
reduction would be inaccurate, so that the result is NaN.
"""

from __future__ import annotations

from math import factorial, inf, pi
from typing import NamedTuple

import numpy as np

from taciturn.program.bits import LAYOUTS, absolute_value, nearest, sign_bit, signed, word_of_bits
from taciturn.program.ir import Builder

_HALF_TURN = (3.141592653589793, 1.2246467991473532e-16)  # π as a double and the remainder
_QUARTER_TURN = (1.5707963267948966, 6.123233995736766e-17)


class _Format(NamedTuple):
    """Constants of a precision."""

    limit: float  # largest |x| with a result
    exact: tuple[float, ...]  # first parts of π/2, whose products with k and differences are exact
    rounded: tuple[float, ...]  # last parts, whose differences are rounded
    sine: int  # terms of each series for |r| ≤ π/4, without the first ones
    cosine: int
    arctangent: int
    largest: float  # bound of the two arguments of ``direction``


_FORMATS = {
    "float64": _Format(
        5e7, (1.570796325802803, 9.92093629470503e-10), (-4.9789962505147994e-17,), 8, 7, 9, 2.0**1020
    ),
    "float32": _Format(
        1e5, (1.5703125, 0.00048828125, -4.410743713378906e-06), (-4.377216100692749e-08, 6.07710062827671e-11),
        4, 4, 4, 2.0**124,
    ),
}  # fmt: skip
_KNOTS = (  # least ratio a/d for the knot c, c, and arctan c as a double and the remainder
    (0.1640625, 0.25, (0.24497866312686414, 1.0698755618734451e-17)),
    (0.375, 0.5, (0.4636476090008061, 2.2698777452961687e-17)),
    (0.71875, 1.0, (0.7853981633974483, 3.061616997868383e-17)),
)


def sine(b: Builder, x: int) -> int:
    """Return sin x.

    Source: muller2016
    """
    # |x| = k·π/2 + r: sin |x| = ±sin r or ±cos r, depending on the last two bits of k
    r, rest, quarter = _reduced(b, x)
    sign = b.emit("word_xor", _moved(b, quarter), sign_bit(b, x))
    return signed(b, b.emit("select", _odd(b, quarter), _cosine(b, r, rest), _sine(b, r, rest)), sign)


def cosine(b: Builder, x: int) -> int:
    """Return cos x.

    Source: muller2016
    """
    # cos |x| = sin(|x| + π/2), so that k + 1 determines the sign
    r, rest, quarter = _reduced(b, x)
    sign = _moved(b, b.emit("word_add", quarter, word_of_bits(b, 1)))
    return signed(b, b.emit("select", _odd(b, quarter), _sine(b, r, rest), _cosine(b, r, rest)), sign)


def tangent(b: Builder, x: int) -> int:
    """Return tan x.

    Source: muller2016
    """
    # tan(k·π/2 + r) = tan r for even k and −1/tan r for odd k
    r, rest, quarter = _reduced(b, x)
    odd, (over, under) = _odd(b, quarter), (_sine(b, r, rest), _cosine(b, r, rest))
    ratio = b.emit("div", b.emit("select", odd, under, over), b.emit("select", odd, over, under))
    turned = b.emit("shift_left", quarter, LAYOUTS[b.precision].sign)
    return signed(b, ratio, b.emit("word_xor", turned, sign_bit(b, x)))


def arctangent(b: Builder, x: int) -> int:
    """Return arctan x, in [−π/2, π/2].

    Source: muller2016
    """
    return signed(b, _angle(b, absolute_value(b, x), b.constant(1.0)), sign_bit(b, x))


def direction(b: Builder, y: int, x: int) -> int:
    """Return the angle of the point (x, y), in [−π, π]; the angle of the origin is 0 or π, depending on the sign of x.

    Larger coordinates are replaced by 2^1020 (2^124 in single precision), so that two infinities give π/4.

    Source: muller2016
    """
    angle = _angle(b, absolute_value(b, y), absolute_value(b, x))
    # π − angle in the left half-plane; then the sign of y
    left = b.emit("any_bit", sign_bit(b, x))
    behind = _less(b, _HALF_TURN, angle)
    return signed(b, b.emit("select", left, behind, angle), sign_bit(b, y))


def _reduced(b: Builder, x: int) -> tuple[int, int, int]:
    """Return r, rest, and a word that ends in the bits of the integer k, where |x| = k·π/2 + r + rest, |r| ≤ π/4."""
    # an angle beyond the limit is replaced by ∞, and ∞ − ∞ makes the result NaN
    f, size = _FORMATS[b.precision], absolute_value(b, x)
    size = b.emit("select", b.emit("greater", size, b.constant(f.limit)), b.constant(inf), size)
    k, quarter = nearest(b, size, 2 / pi)
    # the exact parts have so few bits that nothing is rounded
    r, rest = size, None
    for part in f.exact:
        r = b.emit("sub", r, b.scale(part, k))
    # the rounded parts: r' = fl(r − t) with t = part·k − rest; (r − r') − t is its rounding error, the new rest
    for part in f.rounded:
        taken, before = b.scale(part, k), r
        taken = taken if rest is None else b.emit("sub", taken, rest)
        r = b.emit("sub", before, taken)
        rest = b.emit("sub", b.emit("sub", before, r), taken)
    assert rest is not None
    return r, rest, quarter


def _odd(b: Builder, quarter: int) -> int:
    """Return whether k is odd."""
    return b.emit("any_bit", b.emit("word_and", quarter, word_of_bits(b, 1)))


def _moved(b: Builder, quarter: int) -> int:
    """Return the second-last bit of k as a sign bit: half a turn changes the sign."""
    second = b.emit("word_and", quarter, word_of_bits(b, 2))
    return b.emit("shift_left", second, LAYOUTS[b.precision].sign - 1)


def _alternating(first: int, terms: int) -> list[float]:
    """Return the coefficients −1/first!, 1/(first + 2)!, … of a series."""
    return [-((-1.0) ** i) / factorial(first + 2 * i) for i in range(terms)]


def _sine(b: Builder, r: int, rest: int) -> int:
    """Return sin(r + rest) ≈ r + (r³ (−1/3! + r²/5! − …) + rest) for |r| ≤ π/4."""
    square = b.emit("mul", r, r)
    series = b.polynomial(_alternating(3, _FORMATS[b.precision].sine), square)
    return b.emit("add", r, b.emit("add", b.emit("mul", b.emit("mul", square, r), series), rest))


def _cosine(b: Builder, r: int, rest: int) -> int:
    """Return cos(r + rest) ≈ 1 − r²/2 + r⁴ (1/4! − …) − r·rest for |r| ≤ π/4."""
    # m = fl(1 − r²/2); its rounding error (1 − m) − r²/2 is exact and is added to the small terms
    one, square = b.constant(1.0), b.emit("mul", r, r)
    half = b.scale(0.5, square)
    most = b.emit("sub", one, half)
    series = b.polynomial(_alternating(4, _FORMATS[b.precision].cosine), square)
    bent = b.emit("add", b.emit("mul", b.emit("mul", square, square), series), b.emit("mul", r, rest))
    return b.emit("add", most, b.emit("sub", b.emit("sub", b.emit("sub", one, most), half), bent))


def _angle(b: Builder, y: int, x: int) -> int:
    """Return the angle of a point with x, y ≥ 0.

    Let a ≤ d be the two coordinates and α = arctan(a/d). A knot c reduces the argument of the series:

        tan(α − arctan c) = (a − cd)/(d + ca).

    c is a power of two, so that cd is exact; the difference a − cd is exact where it is small.
    """
    f = _FORMATS[b.precision]
    steep = b.emit("greater", y, x)
    a, d = (_clipped(b, b.emit("select", steep, *sides), f.largest) for sides in ((x, y), (y, x)))
    # at the origin, 0/1 replaces 0/0
    nothing = b.emit("less_equal", d, b.constant(0.0))
    d = b.emit("select", nothing, b.constant(1.0), d)
    zero = knot = b.constant(0.0)
    # base + rest = arctan c, or π/2 − arctan c if y > x (``steep``), with twice the digits of one number
    base, rest = (b.emit("select", steep, part, zero) for part in _pair(b, _QUARTER_TURN))
    for start, value, known in _KNOTS:
        beyond = b.emit("greater", a, b.scale(start, d))
        knot = b.emit("select", beyond, b.constant(value), knot)
        turned = zip(_pair(b, _difference(_QUARTER_TURN, known)), _pair(b, known), (base, rest), strict=True)
        base, rest = (
            b.emit("select", beyond, b.emit("select", steep, back, forth), old) for back, forth, old in turned
        )
    # v = tan(α − arctan c), |v| ≤ 0.17; arctan v = v − v³ (1/3 − v²/5 + …)
    v = b.emit("div", b.emit("sub", a, b.emit("mul", knot, d)), b.emit("add", d, b.emit("mul", knot, a)))
    square = b.emit("mul", v, v)
    series = b.polynomial([-((-1.0) ** i) / (2 * i + 3) for i in range(f.arctangent)], square)
    moved = b.emit("add", v, b.emit("mul", b.emit("mul", square, v), series))
    # angle = α, or π/2 − α if steep; the small terms are added first, as this has the smaller rounding error
    moved = b.emit("select", steep, b.emit("sub", zero, moved), moved)
    return b.emit("add", base, b.emit("add", moved, rest))


def _difference(one: tuple[float, float], other: tuple[float, float]) -> tuple[float, float]:
    """Return the difference of a larger and a smaller number, each given as a double and a remainder."""
    high = one[0] - other[0]
    return high, (one[0] - high) - other[0] + (one[1] - other[1])


def _less(b: Builder, turn: tuple[float, float], angle: int) -> int:
    """Return turn − angle."""
    high, low = _pair(b, turn)
    return b.emit("sub", high, b.emit("sub", angle, low))


def _pair(b: Builder, value: tuple[float, float]) -> tuple[int, int]:
    """Return two constants: a number rounded to the precision of the program, and the remainder."""
    high = value[0] if b.precision == "float64" else float(np.float32(value[0]))
    return b.constant(high), b.constant(value[0] - high + value[1])


def _clipped(b: Builder, x: int, most: float) -> int:
    return b.emit("select", b.emit("greater", x, b.constant(most)), b.constant(most), x)
