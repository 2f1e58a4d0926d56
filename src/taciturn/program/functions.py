"""Elementary functions as operations of a program, bit-identical in every back end and without a mathematical library.

``NUMBERS``, ``COMPARISONS`` and ``LOGIC`` list them by the names of NumPy's functions. Arguments are constants or
indices of operations. Constant expressions are evaluated in advance; additions of zero and multiplications by one are
removed. Numbers of IEEE 754 are taken apart and put together by their bits (``_FloatFormat``).

**Exponentials and logarithms.** e^x = 2^k e^r with integer k and |r| ≤ ½ log 2, where r = x − k log 2 is computed in
two parts (Cody and Waite); log x = k log 2 + log(1 + f) for x = 2^k (1 + f), 1 + f in [√½, √2).

**Circular functions.** An angle is reduced to |x| − k·π/2 in the same way: π/2 is a sum of parts. The first parts have
so few bits that their products with k < 2^25 (2^16 in single precision) and the differences are exact. The last parts
are rounded, and the rounding error is stored in a second number.

| function | largest error in units in the last place |
|---|---|
| e^x, log x, e^x − 1, tanh x | 1.5, 1, 2.25, 2.75 |
| sine and cosine, tangent, inverses, for abs(x) ≤ 5e7 (1e5 in single precision) | 1, 2.75, 2 |
| ``floor``, ``ceil``, rounding to integers | exact |
| ``remainder`` | the rounding of y·floor(x/y) |

Within 1e-9 (1e-5) of a multiple of π/2 the error is absolute, at most 1e-25 (1e-12). For a larger angle the reduction
would be inaccurate, so that the result is NaN. ``minimum`` and ``maximum`` of NaN are NaN, as in NumPy. The fast build,
which fuses some products with sums, has the same bounds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from math import factorial, inf, log, pi
from typing import Any, NamedTuple

import numpy as np

from taciturn.errors import ProblemError
from taciturn.program.ir import Builder, Coefficient, Truth, equals
from taciturn.program.ops import Precision

_HALF_TURN = (3.141592653589793, 1.2246467991473532e-16)  # π as a double and the remainder
_QUARTER_TURN = (1.5707963267948966, 6.123233995736766e-17)
_KNOTS = (  # least ratio a/d for the knot c, c, and arctan c as a double and the remainder
    (0.1640625, 0.25, (0.24497866312686414, 1.0698755618734451e-17)),
    (0.375, 0.5, (0.4636476090008061, 2.2698777452961687e-17)),
    (0.71875, 1.0, (0.7853981633974483, 3.061616997868383e-17)),
)


class _FloatFormat(NamedTuple):
    """Binary format of single-precision or double-precision numbers (IEEE 754)."""

    word: str  # the operation for constant bits, ``word`` or ``half``
    mantissa: int  # number of stored bits of the mantissa
    bias: int  # bias of the exponent

    @property
    def shift(self) -> float:
        """Constant whose addition rounds a number to an integer, because the sum has no bits for fractions."""
        # The last bits of the sum are those of the integer.
        return 1.5 * 2.0**self.mantissa

    @property
    def fraction(self) -> int:
        """Mask of the mantissa."""
        return (1 << self.mantissa) - 1

    @property
    def magnitude(self) -> int:
        """Bit mask of all bits of a number except the sign bit."""
        return (1 << self.sign) - 1

    @property
    def sign(self) -> int:
        """Position of the sign bit."""
        return self.mantissa + self.bias.bit_length() + 1

    @property
    def one(self) -> int:
        """Bit pattern of the number 1.0."""
        return self.bias << self.mantissa

    @property
    def modulus(self) -> int:
        """Modulus 2^n of the integer arithmetic, in which words have as many bits n as a floating-point number."""
        return 2 << self.sign


LAYOUTS: Mapping[Precision, _FloatFormat] = {
    "float64": _FloatFormat("word", 52, 1023),
    "float32": _FloatFormat("half", 23, 127),
}


def _word_of_bits(b: Builder, bits: int) -> int:
    """Return the operation that gives a constant word of bits; a negative integer becomes its two's complement."""
    layout = LAYOUTS[b.precision]
    return b.emit(layout.word, bits % layout.modulus)


def _absolute_value(b: Builder, x: int) -> int:
    """Return |x|."""
    return b.emit("number", b.emit("word_and", b.emit("bits", x), _word_of_bits(b, LAYOUTS[b.precision].magnitude)))


def _sign_bit(b: Builder, x: int) -> int:
    """Return the bits of a number with all but the sign bit cleared."""
    return b.emit("word_and", b.emit("bits", x), _word_of_bits(b, 1 << LAYOUTS[b.precision].sign))


def signed(b: Builder, x: int, sign: int) -> int:
    """Return the number x, with the opposite sign if the bit ``sign`` is set."""
    return b.emit("number", b.emit("word_xor", b.emit("bits", x), sign))


def nearest(b: Builder, x: int, factor: float = 1.0) -> tuple[int, int]:
    """Round factor·x to the nearest integer k. Return k as a number, and a word whose last bits are those of k."""
    # |factor·x| must be below 2^51, or 2^22 in single precision. The fast build may round factor·x and the sum once
    # instead of twice. The result then differs only for ties, where callers accept both neighbours.
    shift = b.constant(LAYOUTS[b.precision].shift)
    shifted = b.emit("add", b.scale(factor, x), shift)
    return b.emit("sub", shifted, shift), b.emit("bits", shifted)


def _power_of_two(b: Builder, whole: int) -> int:
    """Return the floating-point number 2^k for an integer k that is given by the last bits of a word."""
    # k + bias, shifted to the field of the exponent; higher bits of the word are shifted out
    layout = LAYOUTS[b.precision]
    biased = b.emit("word_add", whole, _word_of_bits(b, layout.bias))
    return b.emit("number", b.emit("shift_left", biased, layout.mantissa))


class _Exponential(NamedTuple):
    """Constants of a precision for e^x = 2^k e^r, with integer k and |r| ≤ ½ log 2, and for log x = k log 2 + log m."""

    terms: int  # of the series of e^r
    least: float  # exponent at which ``falling`` saturates
    ends: tuple[float, float]  # exponents between which e^x neither overflows nor becomes subnormal
    flat: float  # least 2x for which tanh x rounds to 1
    log_two: tuple[float, float]  # log 2 in two parts; the first has so few bits that its product with k is exact
    root_half: int  # bits of √½
    atanh: int  # terms of the series of a logarithm
    tiny: float  # the least normal number


_EXPONENTIALS = {
    "float64": _Exponential(
        14, -700.0, (-708.0, 709.0), 44.0, (0.6931471803691238, 1.9082149292705877e-10),
        0x3FE6A09E667F3BCD, 11, 2.0**-1022,
    ),
    "float32": _Exponential(
        8, -80.0, (-87.0, 88.0), 20.0, (0.693359375, -2.12194440e-4), 0x3F3504F3, 5, 2.0**-126,
    ),
}  # fmt: skip


def falling(b: Builder, x: int) -> int:
    """Compute e^{−x}, but at most 1 and at least e^{−700} (e^{−80} in single precision)."""
    # the exponent −max(x, 0), limited to at least ``least`` so that 2^k is a normal number
    zero, least = b.constant(0.0), b.constant(_EXPONENTIALS[b.precision].least)
    exponent = b.emit("sub", zero, b.emit("select", b.emit("greater", x, zero), x, zero))
    return _exponential(b, b.emit("select", b.emit("greater", exponent, least), exponent, least))


def exponential_of(b: Builder, x: int) -> int:
    """Compute e^x, but between e^{−708} and e^{709} (between e^{−87} and e^{88} in single precision)."""
    return _exponential(b, _saturated(b, x))


def exponential_less_one(b: Builder, x: int) -> int:
    """Compute e^x − 1 accurately even for small x, with x limited to the same range as in ``exponential_of``."""
    return _less_one(b, _saturated(b, x))


def hyperbolic_tangent(b: Builder, x: int) -> int:
    """Compute tanh x = E/(E + 2), where E = e^{2x} − 1."""
    # computed for |x|, where E ≥ 0 and nothing cancels; the sign of x is set at the end. 2|x| is limited to ``flat``,
    # from which on the quotient rounds to 1.
    twice, flat = b.scale(2.0, _absolute_value(b, x)), b.constant(_EXPONENTIALS[b.precision].flat)
    grown = _less_one(b, b.emit("select", b.emit("greater", twice, flat), flat, twice))
    return signed(b, b.emit("div", grown, b.emit("add", grown, b.constant(2.0))), _sign_bit(b, x))


def logarithm(b: Builder, x: int) -> int:
    """Compute log x. The result is −∞ for x = 0, and NaN for negative x."""
    # with the f of the header, log(1 + f) = 2 artanh s, s = f/(2 + f)
    f, layout, zero = _EXPONENTIALS[b.precision], LAYOUTS[b.precision], b.constant(0.0)
    # a subnormal x has fewer bits: it is multiplied by 2^lift, and lift is subtracted from k below
    lift = float(layout.mantissa + 2)
    small = b.emit("greater", b.constant(f.tiny), x)
    lifted = b.emit("select", small, b.scale(2.0**lift, x), x)
    # adding bits(1) − bits(√½) moves the boundary between exponents from 1 down to √½: k = 0 for 1 + f in [√½, √2)
    offset = b.emit("word_add", b.emit("bits", lifted), _word_of_bits(b, layout.one - f.root_half))
    # the exponent field E = k + bias becomes a number without a conversion: inserted into the last bits of 2^mantissa,
    # it gives 2^mantissa + E exactly
    counter = (layout.bias + layout.mantissa) << layout.mantissa
    raised = b.emit(
        "number", b.emit("word_or", b.emit("shift_right", offset, layout.mantissa), _word_of_bits(b, counter))
    )
    k = b.emit("sub", raised, b.constant(2.0**layout.mantissa + layout.bias))
    k = b.emit("select", small, b.emit("sub", k, b.constant(lift)), k)
    # ``part`` is f, exact; s = f/(2 + f), |s| ≤ 0.172
    fraction = b.emit("word_and", offset, _word_of_bits(b, layout.fraction))
    part = b.emit("sub", b.emit("number", b.emit("word_add", fraction, _word_of_bits(b, f.root_half))), b.constant(1.0))
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


def _saturated(b: Builder, x: int) -> int:
    """Return an exponent limited so that its exponential is a normal number."""
    low, high = (b.constant(end) for end in _EXPONENTIALS[b.precision].ends)
    # comparisons with NaN are false, so that these selections return NaN for NaN
    x = b.emit("select", b.emit("greater", low, x), low, x)
    return b.emit("select", b.emit("greater", x, high), high, x)


def _exponential(b: Builder, x: int) -> int:
    """Return e^x = 2^k e^r for an exponent whose exponential is a normal number."""
    r, whole = _reduced_exponent(b, x)
    return b.emit("mul", b.polynomial(_series(b, 0), r), _power_of_two(b, whole))


def _reduced_exponent(b: Builder, exponent: int) -> tuple[int, int]:
    """Return r with x = k log 2 + r, and a word whose last bits are those of the integer k."""
    # Cody and Waite: k·(first part of log 2) and its difference from x are exact; only the second part is rounded
    k, whole = nearest(b, exponent, 1 / log(2))
    r = exponent
    for part in _EXPONENTIALS[b.precision].log_two:
        r = b.emit("sub", r, b.emit("mul", k, b.constant(part)))
    return r, whole


def _series(b: Builder, first: int) -> list[float]:
    """Return the Taylor coefficients 1/first!, 1/(first + 1)!, … of e^r."""
    return [1.0 / factorial(i) for i in range(first, _EXPONENTIALS[b.precision].terms)]


def _less_one(b: Builder, x: int) -> int:
    """Return e^x − 1 = 2^k (e^r − 1) + (2^k − 1), with e^r − 1 = r + r² (1/2! + r/3! + …), accurate for small r."""
    r, whole = _reduced_exponent(b, x)
    less = b.emit("add", r, b.emit("mul", b.emit("mul", r, r), b.polynomial(_series(b, 2), r)))
    power = _power_of_two(b, whole)
    return b.emit("add", b.emit("mul", power, less), b.emit("sub", power, b.constant(1.0)))


class _Circular(NamedTuple):
    """Constants of a precision."""

    limit: float  # largest |x| with a result
    exact: tuple[float, ...]  # first parts of π/2, whose products with k and differences are exact
    rounded: tuple[float, ...]  # last parts, whose differences are rounded
    sine: int  # terms of each series for |r| ≤ π/4, without the first ones
    cosine: int
    arctangent: int
    largest: float  # bound of the two arguments of ``direction``


_CIRCULAR = {
    "float64": _Circular(
        5e7, (1.570796325802803, 9.92093629470503e-10), (-4.9789962505147994e-17,), 8, 7, 9, 2.0**1020
    ),
    "float32": _Circular(
        1e5, (1.5703125, 0.00048828125, -4.410743713378906e-06), (-4.377216100692749e-08, 6.07710062827671e-11),
        4, 4, 4, 2.0**124,
    ),
}  # fmt: skip


def sine(b: Builder, x: int) -> int:
    """Return sin x."""
    # |x| = k·π/2 + r: sin |x| = ±sin r or ±cos r, depending on the last two bits of k
    r, rest, quarter = _reduced_angle(b, x)
    sign = b.emit("word_xor", _moved(b, quarter), _sign_bit(b, x))
    return signed(b, b.emit("select", _odd(b, quarter), _cosine(b, r, rest), _sine(b, r, rest)), sign)


def cosine(b: Builder, x: int) -> int:
    """Return cos x."""
    # cos |x| = sin(|x| + π/2), so that k + 1 determines the sign
    r, rest, quarter = _reduced_angle(b, x)
    sign = _moved(b, b.emit("word_add", quarter, _word_of_bits(b, 1)))
    return signed(b, b.emit("select", _odd(b, quarter), _sine(b, r, rest), _cosine(b, r, rest)), sign)


def tangent(b: Builder, x: int) -> int:
    """Return tan x."""
    # tan(k·π/2 + r) = tan r for even k and −1/tan r for odd k
    r, rest, quarter = _reduced_angle(b, x)
    odd, (over, under) = _odd(b, quarter), (_sine(b, r, rest), _cosine(b, r, rest))
    ratio = b.emit("div", b.emit("select", odd, under, over), b.emit("select", odd, over, under))
    turned = b.emit("shift_left", quarter, LAYOUTS[b.precision].sign)
    return signed(b, ratio, b.emit("word_xor", turned, _sign_bit(b, x)))


def arctangent(b: Builder, x: int) -> int:
    """Compute arctan x, an angle in [−π/2, π/2]."""
    return signed(b, _angle(b, _absolute_value(b, x), b.constant(1.0)), _sign_bit(b, x))


def direction(b: Builder, y: int, x: int) -> int:
    """Compute the angle of the point (x, y) in [−π, π]. For the origin, it is 0 or π by the sign bit of x.

    Larger coordinates are replaced by 2^1020 (2^124 in single precision), so that two infinities give π/4.
    """
    angle = _angle(b, _absolute_value(b, y), _absolute_value(b, x))
    # π − angle in the left half-plane; then the sign of y
    left = b.emit("any_bit", _sign_bit(b, x))
    turn, rest = _pair(b, _HALF_TURN)
    behind = b.emit("sub", turn, b.emit("sub", angle, rest))
    return signed(b, b.emit("select", left, behind, angle), _sign_bit(b, y))


def _reduced_angle(b: Builder, x: int) -> tuple[int, int, int]:
    """Return r, rest, and a word that ends in the bits of the integer k, where |x| = k·π/2 + r + rest, |r| ≤ π/4."""
    # an angle beyond the limit is replaced by ∞, and ∞ − ∞ makes the result NaN
    f, size = _CIRCULAR[b.precision], _absolute_value(b, x)
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
    return b.emit("any_bit", b.emit("word_and", quarter, _word_of_bits(b, 1)))


def _moved(b: Builder, quarter: int) -> int:
    """Return the second-last bit of k as a sign bit: half a turn changes the sign."""
    second = b.emit("word_and", quarter, _word_of_bits(b, 2))
    return b.emit("shift_left", second, LAYOUTS[b.precision].sign - 1)


def _alternating(first: int, terms: int) -> list[float]:
    """Return the coefficients −1/first!, 1/(first + 2)!, … of a series."""
    return [-((-1.0) ** i) / factorial(first + 2 * i) for i in range(terms)]


def _sine(b: Builder, r: int, rest: int) -> int:
    """Return sin(r + rest) ≈ r + (r³ (−1/3! + r²/5! − …) + rest) for |r| ≤ π/4."""
    square = b.emit("mul", r, r)
    series = b.polynomial(_alternating(3, _CIRCULAR[b.precision].sine), square)
    return b.emit("add", r, b.emit("add", b.emit("mul", b.emit("mul", square, r), series), rest))


def _cosine(b: Builder, r: int, rest: int) -> int:
    """Return cos(r + rest) ≈ 1 − r²/2 + r⁴ (1/4! − …) − r·rest for |r| ≤ π/4."""
    # m = fl(1 − r²/2); its rounding error (1 − m) − r²/2 is exact and is added to the small terms
    one, square = b.constant(1.0), b.emit("mul", r, r)
    half = b.scale(0.5, square)
    most = b.emit("sub", one, half)
    series = b.polynomial(_alternating(4, _CIRCULAR[b.precision].cosine), square)
    bent = b.emit("add", b.emit("mul", b.emit("mul", square, square), series), b.emit("mul", r, rest))
    return b.emit("add", most, b.emit("sub", b.emit("sub", b.emit("sub", one, most), half), bent))


def _angle(b: Builder, y: int, x: int) -> int:
    """Return the angle of a point with x, y ≥ 0."""
    # Let a ≤ d be the two coordinates and α = arctan(a/d). A knot c reduces the argument of the series:
    #
    #     tan(α − arctan c) = (a − cd)/(d + ca).
    #
    # c is a power of two, so that cd is exact; the difference a − cd is exact where it is small.
    f = _CIRCULAR[b.precision]
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


def _pair(b: Builder, value: tuple[float, float]) -> tuple[int, int]:
    """Return two constants: a number rounded to the precision of the program, and the remainder."""
    high = value[0] if b.precision == "float64" else float(np.float32(value[0]))
    return b.constant(high), b.constant(value[0] - high + value[1])


def _clipped(b: Builder, x: int, most: float) -> int:
    return b.emit("select", b.emit("greater", x, b.constant(most)), b.constant(most), x)


def add(b: Builder, x: Coefficient, y: Coefficient) -> Coefficient:
    """Return x + y."""
    if equals(x, 0.0) or equals(y, 0.0):
        return y if equals(x, 0.0) else x
    return b.emit("add", b.value(x), b.value(y))


def subtract(b: Builder, x: Coefficient, y: Coefficient) -> Coefficient:
    """Return x − y."""
    if equals(x, 0.0) or equals(y, 0.0):
        return x if equals(y, 0.0) else _negate(b, y)
    return b.emit("sub", b.value(x), b.value(y))


def multiply(b: Builder, x: Coefficient, y: Coefficient) -> Coefficient:
    """Return x·y."""
    if equals(x, 0.0) or equals(y, 0.0):
        return 0.0
    return b.scale(y, x) if isinstance(x, int) and isinstance(y, float) else b.scale(x, b.value(y))


def divide(b: Builder, x: Coefficient, y: Coefficient) -> Coefficient:
    """Compute x/y. If y is a constant power of two, x is multiplied by 1/y, which is exact."""
    if equals(x, 0.0) or equals(y, 1.0):
        return x
    if isinstance(y, float) and y.hex().lstrip("-").startswith("0x1.0000000000000p") and 2**-1000 < abs(y) < 2**1000:
        return multiply(b, 1 / y, x)
    return b.emit("div", b.value(x), b.value(y))


def _negate(b: Builder, x: Coefficient) -> Coefficient:
    """Return −x."""
    return multiply(b, -1.0, x)


def power(b: Builder, x: Coefficient, exponent: Coefficient) -> Coefficient:
    """Compute x^p by repeated squaring, for an integer or half-integer exponent p."""
    if isinstance(exponent, int) or not (2 * exponent).is_integer():
        got = "a traced number" if isinstance(exponent, int) else f"{exponent:g}"
        raise ProblemError(
            f"the exponent of a traced number is {got}; expected a constant integer or half-integer, "
            "or np.exp and np.log"
        )
    if exponent < 0:
        return b.emit("div", b.constant(1.0), b.value(power(b, x, -exponent)))
    whole, value = int(exponent), b.value(x)
    result: Coefficient = b.emit("sqrt", value) if exponent > whole else 1.0
    while whole:
        result = multiply(b, value, result) if whole & 1 else result
        whole >>= 1
        value = b.emit("mul", value, value) if whole else value
    return result


def sign(b: Builder, x: Coefficient) -> Coefficient:
    """Return the sign of x: 1, −1 or 0."""
    value, zero = b.value(x), b.constant(0.0)
    below = b.emit("select", b.emit("greater", zero, value), b.constant(-1.0), value)
    return b.emit("select", b.emit("greater", value, zero), b.constant(1.0), below)


def minimum(b: Builder, x: Coefficient, y: Coefficient) -> Coefficient:
    """Return the smaller of the two numbers x and y."""
    return _extreme(b, x, y, less=True)


def maximum(b: Builder, x: Coefficient, y: Coefficient) -> Coefficient:
    """Return the larger of the two numbers x and y."""
    return _extreme(b, x, y, less=False)


def clip(b: Builder, x: Coefficient, low: Coefficient, high: Coefficient) -> Coefficient:
    """Limit the number x to the range from ``low`` to ``high``."""
    return minimum(b, maximum(b, x, low), high)


def _round_off(b: Builder, x: Coefficient) -> Coefficient:
    """Return the integer nearest to x; ties are rounded to even."""
    # all numbers from 2^mantissa on are integers, so that adding this number rounds a sum to an integer
    value, most = b.value(x), b.constant(2.0 ** LAYOUTS[b.precision].mantissa)
    size = _absolute_value(b, value)
    whole = b.emit("sub", b.emit("add", size, most), most)
    return b.emit("select", b.emit("greater", most, size), signed(b, whole, _sign_bit(b, value)), value)


def floor(b: Builder, x: Coefficient) -> Coefficient:
    """Round x down to an integer."""
    value, whole = b.value(x), b.value(_round_off(b, x))
    return b.emit("select", b.emit("greater", whole, value), b.emit("sub", whole, b.constant(1.0)), whole)


def ceil(b: Builder, x: Coefficient) -> Coefficient:
    """Round x up to an integer."""
    value, whole = b.value(x), b.value(_round_off(b, x))
    return b.emit("select", b.emit("greater", value, whole), b.emit("add", whole, b.constant(1.0)), whole)


def remainder(b: Builder, x: Coefficient, y: Coefficient) -> Coefficient:
    """Return x − y·floor(x/y)."""
    return subtract(b, x, multiply(b, y, floor_divide(b, x, y)))


def floor_divide(b: Builder, x: Coefficient, y: Coefficient) -> Coefficient:
    """Return floor(x/y)."""
    return floor(b, divide(b, x, y))


def _hypotenuse(b: Builder, x: Coefficient, y: Coefficient) -> Coefficient:
    """Return the hypotenuse sqrt(x² + y²); the squares must not overflow."""
    return b.emit("sqrt", b.value(add(b, square(b, x), square(b, y))))


def square(b: Builder, x: Coefficient) -> Coefficient:
    """Return x²."""
    return x * x if isinstance(x, float) else b.emit("mul", x, x)


def _arcsine(b: Builder, x: Coefficient) -> Coefficient:
    """Return arcsin x, computed as the angle of the point (√(1 − x²), x); NaN for |x| > 1."""
    return direction(b, b.value(x), _other_side(b, x))


def _arccosine(b: Builder, x: Coefficient) -> Coefficient:
    """Return arccos x, computed as the angle of the point (x, √(1 − x²)); NaN for |x| > 1."""
    return direction(b, _other_side(b, x), b.value(x))


def _hyperbolic_sine(b: Builder, x: Coefficient) -> Coefficient:
    """Return sinh x = ±½(E + E/(E + 1)), where E = e^{|x|} − 1, accurate for small x."""
    value = b.value(x)
    grown = exponential_less_one(b, _absolute_value(b, value))
    both = b.emit("add", grown, b.emit("div", grown, b.emit("add", grown, b.constant(1.0))))
    return signed(b, b.scale(0.5, both), _sign_bit(b, value))


def _hyperbolic_cosine(b: Builder, x: Coefficient) -> Coefficient:
    """Return cosh x = ½(e^{|x|} + e^{−|x|})."""
    grown = exponential_of(b, _absolute_value(b, b.value(x)))
    return b.scale(0.5, b.emit("add", grown, b.emit("div", b.constant(1.0), grown)))


def _equal(b: Builder, x: Coefficient, y: Coefficient) -> Truth:
    """Return whether x = y."""
    return b.both(b.less_equal(x, y), b.less_equal(y, x))


def _extreme(b: Builder, x: Coefficient, y: Coefficient, less: bool) -> Coefficient:
    if isinstance(x, float):
        x, y = y, x
    one, other = b.value(x), b.value(y)
    forth, back = (b.emit("less_equal", *pair) for pair in ((one, other), (other, one)))
    ahead, behind = (forth, back) if less else (back, forth)
    # comparisons with NaN are false: with a constant y the result is the traced x, and otherwise x + y = NaN
    if isinstance(y, float):
        return b.emit("select", behind, other, one)
    rest = b.emit("select", behind, other, b.emit("add", one, other))
    return b.emit("select", ahead, one, rest)


def _other_side(b: Builder, x: Coefficient) -> int:
    """Return √(1 − x²) as √((1 − x)(1 + x)), which is accurate near |x| = 1."""
    value, one = b.value(x), b.constant(1.0)
    return b.emit("sqrt", b.emit("mul", b.emit("sub", one, value), b.emit("add", one, value)))


def _of(rule: Callable[..., int]) -> Callable[..., Coefficient]:
    """Return a rule for operations that also accepts constants."""

    def of(b: Builder, *values: Coefficient) -> Coefficient:
        return rule(b, *(b.value(value) for value in values))

    return of


def _times(factor: float) -> Callable[..., Coefficient]:
    return partial(_swapped, multiply, factor)


def _swapped(rule: Callable[..., Any], one: Any, b: Builder, other: Any) -> Any:
    return rule(b, other, one)


def _itself(b: Builder, x: Coefficient) -> Coefficient:
    return x


NUMBERS: Mapping[str, Callable[..., Coefficient]] = {  # by the names of NumPy's functions
    "add": add, "subtract": subtract, "multiply": multiply, "divide": divide, "power": power, "float_power": power,
    "negative": _negate, "positive": _itself, "conjugate": _itself,
    "absolute": _of(_absolute_value), "fabs": _of(_absolute_value), "sign": sign, "square": square,
    "sqrt": partial(_swapped, power, 0.5), "reciprocal": partial(_swapped, power, -1.0),
    "exp": _of(exponential_of), "expm1": _of(exponential_less_one), "log": _of(logarithm),
    "sinh": _hyperbolic_sine, "cosh": _hyperbolic_cosine, "tanh": _of(hyperbolic_tangent),
    "sin": _of(sine), "cos": _of(cosine), "tan": _of(tangent),
    "arcsin": _arcsine, "arccos": _arccosine, "arctan": _of(arctangent), "arctan2": _of(direction),
    "hypot": _hypotenuse, "minimum": minimum, "maximum": maximum, "clip": clip,
    "floor": floor, "ceil": ceil, "rint": _round_off, "remainder": remainder, "floor_divide": floor_divide,
    "deg2rad": _times(pi / 180), "radians": _times(pi / 180), "rad2deg": _times(180 / pi), "degrees": _times(180 / pi),
}  # fmt: skip
COMPARISONS: Mapping[str, Callable[[Builder, Coefficient, Coefficient], Truth]] = {
    "greater": Builder.greater,
    "less": lambda b, x, y: b.greater(y, x),
    "less_equal": Builder.less_equal,
    "greater_equal": lambda b, x, y: b.less_equal(y, x),
    "equal": _equal,
    "not_equal": lambda b, x, y: b.negated(_equal(b, x, y)),
}
LOGIC: Mapping[str, Callable[..., Truth]] = {
    "logical_and": Builder.both, "bitwise_and": Builder.both, "logical_or": Builder.either,
    "bitwise_or": Builder.either, "logical_not": Builder.negated, "invert": Builder.negated,
}  # fmt: skip
