"""Drawn numbers as operations of the program: the same bits under every printer, with no mathematical library.

One 64-bit word of xoshiro256++ [blackman2021] gives two normals by Box–Muller [box1958]: 32 bits for the radius, 30 for
the angle within an eighth of the circle on either side of an axis, one for the sign and one for the axis. The radius
ends at sqrt(66 ln 2) = 6.76. Logarithm, cosine and sine are polynomials (Chebyshev interpolation; absolute errors
5.5e-10, 4.8e-11 and 3.4e-12, which is below the resolution of the radius).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array
from taciturn.program.ir import Builder, Op, Program, State, rebuild

# −2 log(1+f) = −2f + f² Σ c_i f^i on [√½ − 1, √2 − 1]
_MINUS_TWO_LOG = (
    1.0000000000417548, -0.6666664521177576, 0.4999998251885122, -0.4000290478830937, 0.3333716350817364,
    -0.2846602815641855, 0.24805498871390594, -0.23577812617932722, 0.2331315736302799, -0.13883944587780678,
)  # fmt: skip
# cos(πt/2) = Σ c_i t^(2i) and sin(πt/2) = t Σ c_i t^(2i) on [−½, ½]
_COS = (0.999999999952545, -1.2337005406402766, 0.25366920379732133, -0.020860070410128363, 0.0009036298857944601)
_SIN = (1.570796326788107, -0.6459640961476686, 0.07969258274306916, -0.004681266368307904, 0.00015820652678813778)
_LOG_TWO = 0.6931471805599453

_EXPONENT_ONE = 0x3FF0000000000000  # bits of 1.0
_EXPONENT_MANTISSA = 0x4330000000000000  # bits of 2^52: or-ing an integer below 2^52 gives 2^52 + integer
_MANTISSA = 0x000FFFFFFFFFFFFF
_ROOT_HALF = 0x3FE6A09E667F3BCD  # bits of √½
_SIGN = 1 << 63
_WORD = (1 << 64) - 1

GENERATOR = "generator"  # name of the four words of xoshiro256++
NORMAL, UNIFORM = "normal", "uniform"  # names of the inputs that are draws: "normal 0", "normal 1", …


def with_draws(program: Program) -> Program:
    """Return the program with its inputs ``normal i`` and ``uniform i`` drawn inside, from a generator in its state."""
    drawn = [name for name in program.inputs if name.split()[0] in (NORMAL, UNIFORM)]
    if not drawn:
        return program
    supplied: dict[str, int] = {}
    words: list[int] = []

    def substitute(builder: Builder, op: Op) -> int | None:
        name = program.inputs[op.arguments[0]] if op.name == "input" else None
        if name not in drawn:
            return None
        if not supplied:
            words.extend(draw(builder, drawn, supplied))
        return supplied[name]

    result = rebuild(program, substitute, range(len(program.states)))
    return Program(
        result.ops,
        result.states,
        (*result.following, *words),
        result.inputs,
        result.constants,
        result.tables,
        result.sums,
        result.outputs,
    )


def seed_generators(seed: int, paths: int, first: int = 0) -> Array:
    """Return the start of each path's generator, (4, paths), as the bits of doubles.

    Path i of a seed is the same whatever other paths are run (SplitMix64 of seed and path [steele2014]).
    """
    key = np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]
    index = np.arange(first, first + paths, dtype=np.uint64)
    counter = _mix(index * np.uint64(0xD1342543DE82EF95) + key)
    words = np.empty((4, paths), dtype=np.uint64)
    for row in words:
        counter = counter + np.uint64(0x9E3779B97F4A7C15)
        row[:] = _mix(counter)
    return words.view(np.float64)


def _mix(z: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def draw(builder: Builder, names: Sequence[str], supplied: dict[str, int]) -> list[int]:
    """Define every draw of a tick under its name; return the generator's next words."""
    words = [builder.state(State(GENERATOR, i, start=(GENERATOR, i), word=True)) for i in range(4)]
    normals = [name for name in names if name.split()[0] == NORMAL]
    for i in range(0, len(normals), 2):
        drawn, words = _next_word(builder, words)
        for name, value in zip(normals[i : i + 2], _two_normals(builder, drawn), strict=False):
            supplied[name] = value
    for name in names:
        if name.split()[0] == UNIFORM:
            drawn, words = _next_word(builder, words)
            supplied[name] = _uniform(builder, drawn)
    return words


def _next_word(b: Builder, words: Sequence[int]) -> tuple[int, list[int]]:
    """xoshiro256++."""
    s0, s1, s2, s3 = words
    result = b.emit("word_add", b.emit("rotate_left", b.emit("word_add", s0, s3), 23), s0)
    shifted = b.emit("shift_left", s1, 17)
    s2, s3 = b.emit("word_xor", s2, s0), b.emit("word_xor", s3, s1)
    s1, s0 = b.emit("word_xor", s1, s2), b.emit("word_xor", s0, s3)
    return result, [s0, s1, b.emit("word_xor", s2, shifted), b.emit("rotate_left", s3, 45)]


def _uniform(b: Builder, word: int) -> int:
    """A double strictly between 0 and 1, a multiple of 2^-53."""
    mantissa = b.emit("word_or", b.emit("shift_right", word, 12), b.emit("word", _EXPONENT_ONE))
    return b.emit("sub", b.emit("double", mantissa), b.constant(1.0 - 2.0**-53))


def _two_normals(b: Builder, word: int) -> tuple[int, int]:
    radius = b.emit("sqrt", minus_two_log(b, _upper_half_as_fraction(b, word)))
    # an angle in [−½, ½) eighths of a turn from an axis: bits 0–29
    field = b.emit("word_and", b.emit("shift_left", word, 22), b.emit("word", _MANTISSA))
    t = b.emit("sub", b.emit("double", b.emit("word_or", field, b.emit("word", _EXPONENT_ONE))), b.constant(1.5))
    square = b.emit("mul", t, t)
    cosine = _polynomial(b, _COS, square)
    sine = b.emit("mul", _polynomial(b, _SIN, square), t)
    # which direction of the axis: bit 31; which axis: bit 30
    sign = b.emit("word_and", b.emit("shift_left", word, 32), b.emit("word", _SIGN))
    signed = b.emit("double", b.emit("word_xor", b.emit("bits", radius), sign))
    along, across = b.emit("mul", signed, cosine), b.emit("mul", signed, sine)
    swap = b.emit("any_bit", b.emit("word_and", word, b.emit("word", 1 << 30)))
    return b.emit("select", swap, across, along), b.emit("select", swap, along, across)


def _upper_half_as_fraction(b: Builder, word: int) -> int:
    """(upper 32 bits + ½) / 2^32, in (0, 1)."""
    integer = b.emit("double", b.emit("word_or", b.emit("shift_right", word, 32), b.emit("word", _EXPONENT_MANTISSA)))
    scaled = b.emit("mul", integer, b.constant(2.0**-32))  # exact, and the next as well: they may fuse
    return b.emit("sub", scaled, b.constant((2.0**52 - 0.5) * 2.0**-32))


def minus_two_log(b: Builder, u: int) -> int:
    """Return −2 log u of a u in (0, 1), by u = 2^e (1 + f) with 1 + f in [√½, √2)."""
    offset = b.emit("word_add", b.emit("bits", u), b.emit("word", (_EXPONENT_ONE - _ROOT_HALF) & _WORD))
    exponent = b.emit("word_or", b.emit("shift_right", offset, 52), b.emit("word", _EXPONENT_MANTISSA))
    e = b.emit("sub", b.emit("double", exponent), b.constant(2.0**52 + 1023))
    mantissa = b.emit("word_add", b.emit("word_and", offset, b.emit("word", _MANTISSA)), b.emit("word", _ROOT_HALF))
    f = b.emit("sub", b.emit("double", mantissa), b.constant(1.0))
    curved = b.emit("mul", _polynomial(b, _MINUS_TWO_LOG, f), b.emit("mul", f, f))
    straight = b.emit("add", b.emit("mul", b.constant(-2.0), f), b.emit("mul", b.constant(-2.0 * _LOG_TWO), e))
    return b.emit("add", curved, straight)


def _polynomial(b: Builder, coefficients: Sequence[float], x: int) -> int:
    """Even and odd powers apart: half the chain of Horner's rule."""
    square = b.emit("mul", x, x)

    def horner(part: Sequence[float]) -> int:
        total = b.constant(part[-1])
        for coefficient in part[-2::-1]:
            total = b.emit("add", b.emit("mul", total, square), b.constant(coefficient))
        return total

    return b.emit("add", b.emit("mul", horner(coefficients[1::2]), x), horner(coefficients[0::2]))
