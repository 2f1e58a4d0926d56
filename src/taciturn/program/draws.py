"""Random numbers as operations of a program, bit-identical in every back end, and control variates for simulations.

Each path has a generator of its own, whose four words are states of the program; they are seeded by SplitMix64
[steele2014] from the seed and the number of the path. One 64-bit word of xoshiro256++ [blackman2021] gives two normal
numbers √(−2 log u)·(cos φ, sin φ) by the Box–Muller method [box1958]: 32 bits for the radius, 30 for the angle from the
nearest axis (up to an eighth of the circle on either side), one for the sign, and one for the axis. The largest radius
is sqrt(66 ln 2) = 6.76.

Logarithm, cosine and sine are polynomials (Chebyshev interpolation) with the absolute errors 2.3e-11, 4.8e-11 and
3.4e-12, which are below the resolution of the radius. With u = 2^e m, m in [1, 2), and c ≈ 1/m from a table of eight
entries, m·c = 1 + r with |r| ≤ 1/17 and

    −2 log u = −2e log 2 + 2 log c − 2 log(1 + r).

In single precision the same bits give the same normal numbers, to seven digits (``single``).

Control variates are sums with mean 0 that explain most of the variance of a path's average cost. A normal number n_i
that is drawn in a step is independent of the states s_j at the start of the step. So n_i s_j and n_i n_j − [i = j] have
the conditional mean 0 given the past: they are martingale differences. Those of a quadratic value function are linear
combinations of them [henderson2002].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array
from taciturn.program import single
from taciturn.program.ir import Builder, Program, rebuild
from taciturn.program.ops import Control, Entry, Name, Op, Precision, State, is_entry

# −2 log(1+r) = r Σ c_i r^i on [−1/17, 1/17]
_MINUS_TWO_LOG = (
    -2.0000000003714016, 1.0000000003250018, -0.6666647349251146, 0.4999983095557708, -0.4014874488621837,
    0.3346349590338773,
)  # fmt: skip
# cos(πt/2) = Σ c_i t^(2i) and sin(πt/2) = t Σ c_i t^(2i) on [−½, ½]
_COS = (0.999999999952545, -1.2337005406402766, 0.25366920379732133, -0.020860070410128363, 0.0009036298857944601)
_SIN = (1.570796326788107, -0.6459640961476686, 0.07969258274306916, -0.004681266368307904, 0.00015820652678813778)
_LOG_TWO = 0.6931471805599453

_EXPONENT_ONE = 0x3FF0000000000000  # bits of 1.0
_EXPONENT_MANTISSA = 0x4330000000000000  # bits of 2^52: a bitwise or with an integer k < 2^52 gives 2^52 + k
_MANTISSA = 0x000FFFFFFFFFFFFF
_EXPONENT_FIELD = 0x000FFE0000000000  # the eleven bits of an exponent, shifted right by eleven
_INVERSES = tuple(16 / (17 + 2 * i) for i in range(8))  # 1/m at the middle of each eighth of [1, 2)
# 2 log c_i, plus the offset from the encoding of the exponent in ``minus_two_log``
_LOGARITHMS = tuple(2 * math.log(inverse) + (4096 + 2046) * _LOG_TWO for inverse in _INVERSES)
_SIGN = 1 << 63

GENERATOR = "generator"  # name of the four words of xoshiro256++
NORMAL, UNIFORM = "normal", "uniform"  # an input that is a random number has the name Entry(NORMAL, i)
MOST = 64  # most controls; more would take longer than the rest of a step


def draws_of(program: Program, kind: str) -> list[Name]:
    """List the random inputs of a program that are of the given kind, ``NORMAL`` or ``UNIFORM``."""
    return [name for name in program.inputs if is_entry(name, kind)]


def with_draws(program: Program, uniforms: int = 0) -> Program:
    """Replace the random inputs of a program by a random number generator in the program.

    In each step, the generator draws at least ``uniforms`` uniform numbers.

    Programs with equally many normal numbers per step then draw the same normal numbers.
    """
    normal, uniform = draws_of(program, NORMAL), draws_of(program, UNIFORM)
    drawn = [*normal, *uniform]
    if not drawn:
        return program
    unused = [Entry(UNIFORM, -1 - i) for i in range(uniforms - len(uniform))]
    supplied: dict[Name, int] = {}
    words: list[int] = []

    def substitute(builder: Builder, op: Op) -> int | None:
        name = program.inputs[op.arguments[0]] if op.name == "input" else None
        if name not in drawn:
            return None
        if not supplied:
            words.extend(draw_numbers(builder, [*drawn, *unused], supplied))
        return supplied[name]

    result = rebuild(program, substitute, range(len(program.states)))
    return replace(result, following=(*result.following, *words))


def draw_uniforms(count: int, precision: Precision = "float64") -> Program:
    """Return a program that draws ``count`` uniform random numbers in each step."""
    builder, supplied = Builder(precision), dict[Name, int]()
    following = draw_numbers(builder, [Entry(UNIFORM, i) for i in range(count)], supplied)
    return builder.finish(following, {}, supplied)


def draw_numbers(builder: Builder, names: Sequence[Name], supplied: dict[Name, int]) -> list[int]:
    """Draw the random numbers ``names`` of a step, and add them to ``supplied``. Return the next generator state."""
    words = [builder.state(State(GENERATOR, i, start=(GENERATOR, i), word=True)) for i in range(4)]
    normals = [name for name in names if is_entry(name, NORMAL)]
    for i in range(0, len(normals), 2):
        drawn, words = _next_word(builder, words)
        for name, value in zip(normals[i : i + 2], _two_normals(builder, drawn), strict=False):
            supplied[name] = value
    for name in names:
        if is_entry(name, UNIFORM):
            drawn, words = _next_word(builder, words)
            supplied[name] = _uniform(builder, drawn)
    return words


def _next_word(b: Builder, words: Sequence[int]) -> tuple[int, list[int]]:
    """Return the output word of xoshiro256++ and the next four words of the generator."""
    # result = rotl(s0 + s3, 23) + s0; the linear update of the state follows [blackman2021]
    s0, s1, s2, s3 = words
    result = b.emit("word_add", b.emit("rotate_left", b.emit("word_add", s0, s3), 23), s0)
    shifted = b.emit("shift_left", s1, 17)
    s2, s3 = b.emit("word_xor", s2, s0), b.emit("word_xor", s3, s1)
    s1, s0 = b.emit("word_xor", s1, s2), b.emit("word_xor", s0, s3)
    return result, [s0, s1, b.emit("word_xor", s2, shifted), b.emit("rotate_left", s3, 45)]


def _uniform(b: Builder, word: int) -> int:
    """Return a number strictly between 0 and 1; in double precision an odd multiple of 2^-53."""
    if b.precision == "float32":
        return single.uniform(b, word)
    # the upper 52 bits k as a mantissa give 1 + k/2^52; minus 1 − 2^-53 this is (k + ½)/2^52, without rounding
    mantissa = b.emit("word_or", b.emit("shift_right", word, 12), b.emit("word", _EXPONENT_ONE))
    return b.emit("sub", b.emit("number", mantissa), b.constant(1.0 - 2.0**-53))


def _two_normals(b: Builder, word: int) -> tuple[int, int]:
    """Return two independent standard normal numbers √(−2 log u)·(cos φ, sin φ) by the Box–Muller method."""
    if b.precision == "float32":
        return single.two_normals(b, word)
    # bits 32–63: k, and the radius with u = (k + ½)/2^32 in (0, 1). 2^52 + k as a double, times 2^-32, minus
    # (2^52 − ½) 2^-32: both operations are exact, so that the result does not change if the fast build fuses them.
    integer = b.emit("number", b.emit("word_or", b.emit("shift_right", word, 32), b.emit("word", _EXPONENT_MANTISSA)))
    scaled = b.emit("mul", integer, b.constant(2.0**-32))
    u = b.emit("sub", scaled, b.constant((2.0**52 - 0.5) * 2.0**-32))
    radius = b.emit("sqrt", minus_two_log(b, u))
    # bits 0–29: the angle (π/2) t from the nearest axis, t in [−½, ½). As a mantissa they give 1 + (t + ½).
    field = b.emit("word_and", b.emit("shift_left", word, 22), b.emit("word", _MANTISSA))
    t = b.emit("sub", b.emit("number", b.emit("word_or", field, b.emit("word", _EXPONENT_ONE))), b.constant(1.5))
    square = b.emit("mul", t, t)
    cosine = b.polynomial(_COS, square)
    sine = b.emit("mul", b.polynomial(_SIN, square), t)
    # bit 31: direction of the axis, as the sign of the radius; bit 30: which axis, as an exchange of cos and sin
    sign = b.emit("word_and", b.emit("shift_left", word, 32), b.emit("word", _SIGN))
    signed = b.emit("number", b.emit("word_xor", b.emit("bits", radius), sign))
    along, across = b.emit("mul", signed, cosine), b.emit("mul", signed, sine)
    swap = b.emit("any_bit", b.emit("word_and", word, b.emit("word", 1 << 30)))
    return b.emit("select", swap, across, along), b.emit("select", swap, along, across)


def minus_two_log(b: Builder, u: int) -> int:
    """Compute −2 log u for a number u in (0, 1): the squared radius in the Box–Muller method."""
    if b.precision == "float32":
        return single.minus_two_log(b, u)
    # the first three bits of the mantissa select the eighth of [1, 2), and so c
    bits = b.emit("bits", u)
    eighth = b.emit("shift_right", bits, 49)
    # the biased exponent E = e + 1023 at the top of a mantissa gives the double 1 + E/2048, without a conversion;
    # times −4096 log 2 this is −2e log 2 − (4096 + 2046) log 2, and the table adds the constant back
    field = b.emit("word_and", b.emit("shift_right", bits, 11), b.emit("word", _EXPONENT_FIELD))
    exponent = b.emit("number", b.emit("word_or", field, b.emit("word", _EXPONENT_ONE)))
    mantissa = b.emit("word_or", b.emit("word_and", bits, b.emit("word", _MANTISSA)), b.emit("word", _EXPONENT_ONE))
    # r = m·c − 1, then −2 log(1 + r) = r Σ c_i r^i with an absolute error of 2.3e-11
    r = b.emit("sub", b.emit("mul", b.emit("number", mantissa), b.pick(_INVERSES, eighth)), b.constant(1.0))
    whole = b.emit("add", b.emit("mul", b.constant(-4096 * _LOG_TWO), exponent), b.pick(_LOGARITHMS, eighth))
    return b.emit("add", b.emit("mul", b.polynomial(_MINUS_TWO_LOG, r), r), whole)


def seed_generators(seed: int, paths: int, first: int = 0) -> Array:
    """Compute the initial generator state of each path: four words of 64 bits, stored as doubles."""
    # from the seed and the number of the path alone, so path i does not depend on which other paths are run
    # the increment 2^64/φ of SplitMix64, and an odd multiplier that separates the counters of the paths
    key = np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]
    index = np.arange(first, first + paths, dtype=np.uint64)
    counter = _mix(index * np.uint64(0xD1342543DE82EF95) + key)
    words = np.empty((4, paths), dtype=np.uint64)
    for row in words:
        counter = counter + np.uint64(0x9E3779B97F4A7C15)
        row[:] = _mix(counter)
    return words.view(np.float64)


def _mix(z: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """Return the output function of SplitMix64, a bijection of words."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def with_controls(program: Program) -> Program:
    """Add control variates to a simulation program as further sums; they reduce the variance of simulated averages."""
    # If there were more than MOST of them, the program is returned unchanged.
    ops, sums = list(program.ops), dict(program.sums)
    normals = [
        i for i, op in enumerate(ops) if op.name == "input" and is_entry(program.inputs[op.arguments[0]], NORMAL)
    ]
    states = [i for i, op in enumerate(ops) if op.name == "state" and not program.states[op.arguments[0]].word]
    if len(normals) * (len(states) + (len(normals) + 1) / 2) > MOST:
        return program
    minus_one = len(ops)
    ops.append(Op("const", (len(program.constants),)))
    for k, normal in enumerate(normals):
        for index in states:
            ops.append(Op("mul", (normal, index)))
            state = program.states[ops[index].arguments[0]]
            sums[Control(k, Entry(state.name, state.index))] = len(ops) - 1
        for m, other in enumerate(normals[k:], start=k):
            ops.append(Op("mul", (normal, other)))
            if m == k:
                ops.append(Op("add", (len(ops) - 1, minus_one)))
            sums[Control(k, m)] = len(ops) - 1
    return replace(program, ops=tuple(ops), constants=(*program.constants, -1.0), sums=sums)


def controlled(program: Program, lean: Program) -> Program:
    """Add to the reduced program ``lean`` the control variates of ``program`` that depend on states of ``lean``
    only.
    """
    # Its states are those of ``lean``, entry by entry, so that a run may go on with it.
    remembered = {Entry(state.name, state.index) for state in lean.states}
    controls = [name for name in program.sums if isinstance(name, Control)]
    fit = {name for name in controls if isinstance(name.other, int) or name.other in remembered}
    return program.keep({*lean.sums, *fit})
