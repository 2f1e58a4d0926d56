"""Operations on the bits of floating-point numbers: signs, magnitudes, rounding to integers and powers of two."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from taciturn.program.ir import Builder
from taciturn.program.ops import Precision


class FloatFormat(NamedTuple):
    """Binary format of single-precision or double-precision numbers (IEEE 754).

    Args:
        word: the operation for constant bits, ``word`` or ``half``.
        mantissa: number of stored bits of the mantissa.
        bias: bias of the exponent.
    """

    word: str
    mantissa: int
    bias: int

    @property
    def shift(self) -> float:
        """Constant whose addition rounds a number to an integer, because the sum has no fraction bits.

        The last bits of the sum are those of the integer.
        """
        return 1.5 * 2.0**self.mantissa

    @property
    def fraction(self) -> int:
        """Mask of the mantissa."""
        return (1 << self.mantissa) - 1

    @property
    def magnitude(self) -> int:
        """Bit mask that selects all bits of a number except the sign."""
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
        """Modulus of integer arithmetic on words with the size of a number."""
        return 2 << self.sign


LAYOUTS: Mapping[Precision, FloatFormat] = {
    "float64": FloatFormat("word", 52, 1023),
    "float32": FloatFormat("half", 23, 127),
}


def word_of_bits(b: Builder, bits: int) -> int:
    """Return the operation that gives a constant word of bits; a negative integer becomes its two's complement."""
    layout = LAYOUTS[b.precision]
    return b.emit(layout.word, bits % layout.modulus)


def absolute_value(b: Builder, x: int) -> int:
    """Return |x|."""
    return b.emit("number", b.emit("word_and", b.emit("bits", x), word_of_bits(b, LAYOUTS[b.precision].magnitude)))


def sign_bit(b: Builder, x: int) -> int:
    """Return the bits of a number with all but the sign bit cleared."""
    return b.emit("word_and", b.emit("bits", x), word_of_bits(b, 1 << LAYOUTS[b.precision].sign))


def signed(b: Builder, x: int, sign: int) -> int:
    """Return the number x with its sign changed if the sign bit ``sign`` is set."""
    return b.emit("number", b.emit("word_xor", b.emit("bits", x), sign))


def nearest(b: Builder, x: int, factor: float = 1.0) -> tuple[int, int]:
    """Return the integer k nearest to factor·x as a floating-point number, and a word whose last bits are those of k.

    |factor·x| must be below 2^51, or 2^22 in single precision.
    """
    # The fast build may round factor·x and the sum once instead of twice. The result then differs only for ties, where
    # callers accept both neighbours.
    shift = b.constant(LAYOUTS[b.precision].shift)
    shifted = b.emit("add", b.scale(factor, x), shift)
    return b.emit("sub", shifted, shift), b.emit("bits", shifted)


def power_of_two(b: Builder, whole: int) -> int:
    """Return the floating-point number 2^k for an integer k that is given by the last bits of a word."""
    # k + bias, shifted to the field of the exponent; higher bits of the word are shifted out
    layout = LAYOUTS[b.precision]
    biased = b.emit("word_add", whole, word_of_bits(b, layout.bias))
    return b.emit("number", b.emit("shift_left", biased, layout.mantissa))
