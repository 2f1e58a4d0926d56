"""The bits of a number as operations of the program: signs, magnitudes, whole numbers and powers of two."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from taciturn.program.ir import Builder
from taciturn.program.ops import Precision


class Layout(NamedTuple):
    """How the numbers of a precision are laid out.

    Args:
        word: the operation that gives bits known now.
        mantissa: bits behind the leading one.
        bias: of the exponent.
    """

    word: str
    mantissa: int
    bias: int

    @property
    def shift(self) -> float:
        """A sum with it has no bits left below one, so that its last bits are those of a whole number."""
        return 1.5 * 2.0**self.mantissa

    @property
    def fraction(self) -> int:
        """The bits of the mantissa."""
        return (1 << self.mantissa) - 1

    @property
    def magnitude(self) -> int:
        """All bits but the sign."""
        return (1 << self.sign) - 1

    @property
    def sign(self) -> int:
        """Place of the sign."""
        return self.mantissa + self.bias.bit_length() + 1

    @property
    def one(self) -> int:
        """The bits of 1."""
        return self.bias << self.mantissa

    @property
    def modulus(self) -> int:
        """Words are whole numbers modulo this one."""
        return 2 << self.sign


LAYOUTS: Mapping[Precision, Layout] = {
    "float64": Layout("word", 52, 1023),
    "float32": Layout("half", 23, 127),
}


def literal(b: Builder, bits: int) -> int:
    """Return bits known now; those of a negative number are its complement."""
    layout = LAYOUTS[b.precision]
    return b.emit(layout.word, bits % layout.modulus)


def absolute(b: Builder, x: int) -> int:
    """Return |x|."""
    return b.emit("number", b.emit("word_and", b.emit("bits", x), literal(b, LAYOUTS[b.precision].magnitude)))


def sign_bit(b: Builder, x: int) -> int:
    """Return the bits of a number with all but the sign taken away."""
    return b.emit("word_and", b.emit("bits", x), literal(b, 1 << LAYOUTS[b.precision].sign))


def signed(b: Builder, x: int, sign: int) -> int:
    """Return a number with its sign turned where the bit of a sign is set."""
    return b.emit("number", b.emit("word_xor", b.emit("bits", x), sign))


def nearest(b: Builder, x: int, factor: float = 1.0) -> tuple[int, int]:
    """Return the whole number nearest to factor·x, of a size below 2^51 (2^22), as a number, and bits that end in its.

    Whether the product is rounded before the sum does not matter: a tie goes one way or the other.
    """
    shift = b.constant(LAYOUTS[b.precision].shift)
    shifted = b.emit("add", b.scale(factor, x), shift)
    return b.emit("sub", shifted, shift), b.emit("bits", shifted)


def power_of_two(b: Builder, whole: int) -> int:
    """Return 2^k, given bits that end in those of the whole number k."""
    layout = LAYOUTS[b.precision]
    biased = b.emit("word_add", whole, literal(b, layout.bias))
    return b.emit("number", b.emit("shift_left", biased, layout.mantissa))
