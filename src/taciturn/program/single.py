"""Random numbers in single precision. They use the same random bits as those in double precision (``draws``).

A word gives the same number in both precisions, to seven digits. Therefore paths of one seed in single and in double
precision stay close to each other, and a comparison of both shows the effect of rounding directly.
"""

from __future__ import annotations

from taciturn.program.ir import Builder

# −2 log(1+f) = −2f + f² Σ c_i f^i on [√½ − 1, √2 − 1], absolute error 2.4e-7. The term −2f is exact, so that the
# relative error stays small near u = 1, where −2 log u tends to 0.
_MINUS_TWO_LOG = (
    1.0000018248456755, -0.6666822720817487, 0.49964902413320217, -0.39858114267141076, 0.34264774594783404,
    -0.3196819196666793, 0.20377172947929573,
)  # fmt: skip
# cos(πt/2) = Σ c_i t^(2i) and sin(πt/2) = t Σ c_i t^(2i) on [−½, ½], absolute errors 2.8e-8 and 2.4e-9
_COS = (0.999999972328494, -1.2336970074214806, 0.2535985713024576, -0.020408158392793058)
_SIN = (1.5707963219532364, -0.6459634776647952, 0.07968021764761773, -0.004602149212493523)
_LOG_TWO = 0.6931471805599453

_EXPONENT_ONE = 0x3F800000  # bits of 1.0
_MANTISSA = 0x007FFFFF
_ROOT_HALF = 0x3F3504F3  # bits of √½
_SIGN = 1 << 31
_HALF = (1 << 32) - 1


def uniform(b: Builder, word: int) -> int:
    """Compute a uniform random number in (0, 1), an odd multiple of 2^-24, from the upper 23 bits of a word."""
    # the bits k as the mantissa of a float give 1 + k/2^23; minus 1 − 2^-24 this is (k + ½)/2^23, without rounding:
    # the result is the middle of its interval and never 0 or 1
    field = b.emit("shift_right", b.emit("upper", word), 9)
    number = b.emit("number", b.emit("word_or", field, b.emit("half", _EXPONENT_ONE)))
    return b.emit("sub", number, b.constant(1.0 - 2.0**-24))


def two_normals(b: Builder, word: int) -> tuple[int, int]:
    """Compute two independent standard normal numbers, √(−2 log u)·(cos φ, sin φ), by the Box–Muller method."""
    # upper 32 bits k: the radius, with u = (k + ½)/2^32; u lies in (0, 1], as rounding to a float may give 1
    upper, lower = b.emit("upper", word), b.emit("lower", word)
    u = b.emit("add", b.emit("mul", b.emit("count", upper), b.constant(2.0**-32)), b.constant(2.0**-33))
    radius = b.emit("sqrt", minus_two_log(b, u))
    # lower 30 bits: the angle (π/2) t from the nearest axis, t in [−½, ½], where short polynomials suffice
    turn = b.emit("count", b.emit("word_and", lower, b.emit("half", (1 << 30) - 1)))
    t = b.emit("sub", b.emit("mul", turn, b.constant(2.0**-30)), b.constant(0.5))
    squared = b.emit("mul", t, t)
    cosine, sine = b.polynomial(_COS, squared), b.emit("mul", b.polynomial(_SIN, squared), t)
    # bit 31: direction of the axis, as the sign of the radius; bit 30: which axis, as an exchange of cos and sin
    sign = b.emit("word_and", lower, b.emit("half", _SIGN))
    signed = b.emit("number", b.emit("word_xor", b.emit("bits", radius), sign))
    along, across = b.emit("mul", signed, cosine), b.emit("mul", signed, sine)
    swap = b.emit("any_bit", b.emit("word_and", lower, b.emit("half", 1 << 30)))
    return b.emit("select", swap, across, along), b.emit("select", swap, along, across)


def minus_two_log(b: Builder, u: int) -> int:
    """Compute −2 log u for a number u in (0, 1]: the squared radius in the Box–Muller method."""
    # u = 2^e (1 + f) with 1 + f in [√½, √2): adding bits(1) − bits(√½) moves the boundary between exponents from 1
    # down to √½. So e = 0 for u near 1, and f = u − 1 is exact there.
    offset = b.emit("word_add", b.emit("bits", u), b.emit("half", (_EXPONENT_ONE - _ROOT_HALF) & _HALF))
    e = b.emit("sub", b.emit("count", b.emit("shift_right", offset, 23)), b.constant(127.0))
    mantissa = b.emit("word_add", b.emit("word_and", offset, b.emit("half", _MANTISSA)), b.emit("half", _ROOT_HALF))
    f = b.emit("sub", b.emit("number", mantissa), b.constant(1.0))
    # −2 log u = −2 log(1 + f) − 2 e log 2
    curved = b.emit("mul", b.polynomial(_MINUS_TWO_LOG, f), b.emit("mul", f, f))
    straight = b.emit("add", b.emit("mul", b.constant(-2.0), f), b.emit("mul", b.constant(-2.0 * _LOG_TWO), e))
    return b.emit("add", curved, straight)
