"""Elementary NumPy functions as operations of a program; arguments are constants or indices of operations.

Constant expressions are evaluated in advance; additions of zero and multiplications by one are removed. ``floor``,
``ceil`` and ``round_off`` are exact. The error of ``remainder`` is the rounding error of y·floor(x/y). ``minimum`` and
``maximum`` of NaN are NaN, as in NumPy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from math import pi
from typing import Any

from taciturn.errors import ProblemError
from taciturn.program import circular
from taciturn.program.bits import LAYOUTS, sign_bit, signed
from taciturn.program.bits import absolute_value as _magnitude
from taciturn.program.exponential import exponential_less_one, exponential_of, hyperbolic_tangent, logarithm
from taciturn.program.ir import Builder, Coefficient, Truth


def add(b: Builder, x: Coefficient, y: Coefficient) -> Coefficient:
    """Return x + y."""
    if _is(x, 0.0) or _is(y, 0.0):
        return y if _is(x, 0.0) else x
    return b.emit("add", b.value(x), b.value(y))


def subtract(b: Builder, x: Coefficient, y: Coefficient) -> Coefficient:
    """Return x − y."""
    if _is(x, 0.0) or _is(y, 0.0):
        return x if _is(y, 0.0) else negate(b, y)
    return b.emit("sub", b.value(x), b.value(y))


def multiply(b: Builder, x: Coefficient, y: Coefficient) -> Coefficient:
    """Return x·y."""
    if _is(x, 0.0) or _is(y, 0.0):
        return 0.0
    return b.scale(y, x) if isinstance(x, int) and isinstance(y, float) else b.scale(x, b.value(y))


def divide(b: Builder, x: Coefficient, y: Coefficient) -> Coefficient:
    """Return x/y; a division by a power of two is an exact multiplication."""
    if _is(x, 0.0) or _is(y, 1.0):
        return x
    if isinstance(y, float) and y.hex().lstrip("-").startswith("0x1.0000000000000p") and 2**-1000 < abs(y) < 2**1000:
        return multiply(b, 1 / y, x)
    return b.emit("div", b.value(x), b.value(y))


def negate(b: Builder, x: Coefficient) -> Coefficient:
    """Return −x."""
    return multiply(b, -1.0, x)


def power(b: Builder, x: Coefficient, exponent: Coefficient) -> Coefficient:
    """Return the power x^p by repeated squaring, for an integer or half-integer p.

    Raises:
        ProblemError: the exponent is not a constant, or not an integer or half-integer.
    """
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
    """Return the smaller of two numbers x and y."""
    return _extreme(b, x, y, less=True)


def maximum(b: Builder, x: Coefficient, y: Coefficient) -> Coefficient:
    """Return the larger of two numbers x and y."""
    return _extreme(b, x, y, less=False)


def clip(b: Builder, x: Coefficient, low: Coefficient, high: Coefficient) -> Coefficient:
    """Return the number x limited to the range from low to high."""
    return minimum(b, maximum(b, x, low), high)


def round_off(b: Builder, x: Coefficient) -> Coefficient:
    """Return the integer nearest to x; ties are rounded to even."""
    # all numbers from 2^mantissa on are integers, so that adding this number rounds a sum to an integer
    value, most = b.value(x), b.constant(2.0 ** LAYOUTS[b.precision].mantissa)
    size = _magnitude(b, value)
    whole = b.emit("sub", b.emit("add", size, most), most)
    return b.emit("select", b.emit("greater", most, size), signed(b, whole, sign_bit(b, value)), value)


def floor(b: Builder, x: Coefficient) -> Coefficient:
    """Return the largest integer not above x."""
    value, whole = b.value(x), b.value(round_off(b, x))
    return b.emit("select", b.emit("greater", whole, value), b.emit("sub", whole, b.constant(1.0)), whole)


def ceil(b: Builder, x: Coefficient) -> Coefficient:
    """Return the smallest integer not below x."""
    value, whole = b.value(x), b.value(round_off(b, x))
    return b.emit("select", b.emit("greater", value, whole), b.emit("add", whole, b.constant(1.0)), whole)


def remainder(b: Builder, x: Coefficient, y: Coefficient) -> Coefficient:
    """Return x − y·floor(x/y)."""
    return subtract(b, x, multiply(b, y, floor_divide(b, x, y)))


def floor_divide(b: Builder, x: Coefficient, y: Coefficient) -> Coefficient:
    """Return floor(x/y)."""
    return floor(b, divide(b, x, y))


def hypotenuse(b: Builder, x: Coefficient, y: Coefficient) -> Coefficient:
    """Return the hypotenuse sqrt(x² + y²); the squares must not overflow."""
    return b.emit("sqrt", b.value(add(b, square(b, x), square(b, y))))


def square(b: Builder, x: Coefficient) -> Coefficient:
    """Return x²."""
    return x * x if isinstance(x, float) else b.emit("mul", x, x)


def arcsine(b: Builder, x: Coefficient) -> Coefficient:
    """Return arcsin x, computed as the angle of the point (√(1 − x²), x); NaN for |x| > 1."""
    return circular.direction(b, b.value(x), _other_side(b, x))


def arccosine(b: Builder, x: Coefficient) -> Coefficient:
    """Return arccos x, computed as the angle of the point (x, √(1 − x²)); NaN for |x| > 1."""
    return circular.direction(b, _other_side(b, x), b.value(x))


def hyperbolic_sine(b: Builder, x: Coefficient) -> Coefficient:
    """Return sinh x = ±½(E + E/(E + 1)), where E = e^{|x|} − 1, accurate for small x."""
    value = b.value(x)
    grown = exponential_less_one(b, _magnitude(b, value))
    both = b.emit("add", grown, b.emit("div", grown, b.emit("add", grown, b.constant(1.0))))
    return signed(b, b.scale(0.5, both), sign_bit(b, value))


def hyperbolic_cosine(b: Builder, x: Coefficient) -> Coefficient:
    """Return cosh x = ½(e^{|x|} + e^{−|x|})."""
    grown = exponential_of(b, _magnitude(b, b.value(x)))
    return b.scale(0.5, b.emit("add", grown, b.emit("div", b.constant(1.0), grown)))


def greater(b: Builder, x: Coefficient, y: Coefficient) -> Truth:
    """Return whether x > y."""
    return b.emit("greater", b.value(x), b.value(y))


def less_equal(b: Builder, x: Coefficient, y: Coefficient) -> Truth:
    """Return whether x ≤ y."""
    return b.emit("less_equal", b.value(x), b.value(y))


def equal(b: Builder, x: Coefficient, y: Coefficient) -> Truth:
    """Return whether x = y."""
    return both(b, less_equal(b, x, y), less_equal(b, y, x))


def both(b: Builder, one: Truth, other: Truth) -> Truth:
    """Return whether both truth values are true."""
    if isinstance(one, bool) or isinstance(other, bool):
        known, rest = (one, other) if isinstance(one, bool) else (other, one)
        return rest if known else False
    return b.emit("and", one, other)


def opposite(b: Builder, one: Truth) -> Truth:
    """Return the logical negation of a truth value."""
    return not one if isinstance(one, bool) else b.emit("not", one)


def either(b: Builder, one: Truth, other: Truth) -> Truth:
    """Return whether at least one of two truth values is true."""
    return opposite(b, both(b, opposite(b, one), opposite(b, other)))


def choose(b: Builder, truth: Truth, yes: Coefficient, no: Coefficient) -> Coefficient:
    """Return the number ``yes`` if the truth value is true, and ``no`` otherwise."""
    if isinstance(truth, bool):
        return yes if truth else no
    if isinstance(yes, float) and isinstance(no, float) and yes == no:
        return yes
    return b.choose(truth, b.value(yes), b.value(no))


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


def _is(coefficient: Coefficient, number: float) -> bool:
    return isinstance(coefficient, float) and coefficient == number


def _of(rule: Callable[..., int]) -> Callable[..., Coefficient]:
    """Return a rule for operations that also accepts constants."""

    def of(b: Builder, *values: Coefficient) -> Coefficient:
        return rule(b, *(b.value(value) for value in values))

    return of


def _times(factor: float) -> Callable[..., Coefficient]:
    return partial(_swapped, multiply, factor)


def _swapped(rule: Callable[..., Any], one: Any, b: Builder, other: Any) -> Any:
    return rule(b, other, one)


def _less(b: Builder, x: Coefficient, y: Coefficient) -> Truth:
    return greater(b, y, x)


def _greater_equal(b: Builder, x: Coefficient, y: Coefficient) -> Truth:
    return less_equal(b, y, x)


def _not_equal(b: Builder, x: Coefficient, y: Coefficient) -> Truth:
    return opposite(b, equal(b, x, y))


def _itself(b: Builder, x: Coefficient) -> Coefficient:
    return x


NUMBERS: Mapping[str, Callable[..., Coefficient]] = {  # by the names of NumPy's functions
    "add": add, "subtract": subtract, "multiply": multiply, "divide": divide, "power": power, "float_power": power,
    "negative": negate, "positive": _itself, "conjugate": _itself,
    "absolute": _of(_magnitude), "fabs": _of(_magnitude), "sign": sign, "square": square,
    "sqrt": partial(_swapped, power, 0.5), "reciprocal": partial(_swapped, power, -1.0),
    "exp": _of(exponential_of), "expm1": _of(exponential_less_one), "log": _of(logarithm),
    "sinh": hyperbolic_sine, "cosh": hyperbolic_cosine, "tanh": _of(hyperbolic_tangent),
    "sin": _of(circular.sine), "cos": _of(circular.cosine), "tan": _of(circular.tangent),
    "arcsin": arcsine, "arccos": arccosine, "arctan": _of(circular.arctangent), "arctan2": _of(circular.direction),
    "hypot": hypotenuse, "minimum": minimum, "maximum": maximum, "clip": clip,
    "floor": floor, "ceil": ceil, "rint": round_off, "remainder": remainder, "floor_divide": floor_divide,
    "deg2rad": _times(pi / 180), "radians": _times(pi / 180), "rad2deg": _times(180 / pi), "degrees": _times(180 / pi),
}  # fmt: skip
COMPARISONS: Mapping[str, Callable[..., Truth]] = {
    "greater": greater, "less_equal": less_equal, "equal": equal, "less": _less, "greater_equal": _greater_equal,
    "not_equal": _not_equal,
}  # fmt: skip
LOGIC: Mapping[str, Callable[..., Truth]] = {
    "logical_and": both, "bitwise_and": both, "logical_or": either, "bitwise_or": either,
    "logical_not": opposite, "invert": opposite,
}  # fmt: skip
