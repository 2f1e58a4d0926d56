"""Descriptor plants E x⁺ = A x + B u + w, or E dx/dt = A x + B u + w, with a regular matrix E.

They are the plants x⁺ = E⁻¹A x + E⁻¹B u + E⁻¹w, with the same state x. A double is a rational number, so whether E is
regular is decided without a tolerance, and the matrices are the doubles nearest to the exact ones, also if E is nearly
singular. With a singular E, some of the equations are algebraic, and the state may jump when an input does.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import numpy as np
from flint import fmpq, fmpq_mat, fmpz_mat

from taciturn._arrays import Array, ArrayLike, array, is_definite, semidefinite, square
from taciturn._modes import root
from taciturn._rational import is_semidefinite, nearest, rational
from taciturn.errors import ProblemError


class Explicit(NamedTuple):
    """The matrices of a plant without E; ``W`` is None if it was."""

    A: Array
    B: Array
    W: Array | None


def explicit(E: ArrayLike, A: ArrayLike, B: ArrayLike, W: ArrayLike | None) -> Explicit:
    """Return E⁻¹A, E⁻¹B and E⁻¹W(E⁻¹)', each entry the double nearest to the exact value.

    Args:
        E: matrix of the next state, or of the derivative, (n, n), regular.
        A: state matrix, (n, n).
        B: input matrix, (n, m).
        W: covariance, or intensity, of the noise of the equation, (n, n); or None.

    Raises:
        ProblemError: a matrix has the wrong shape or is not finite, W is indefinite, E is singular, or a result exceeds
            the range of numbers.
    """
    A = square("A", A, "states × states")
    B = array("B", B, (len(A), None), "(states, inputs)")
    inverse = _Inverse.of(E, len(A))
    moved = Explicit(inverse.times("A", A), inverse.times("B", B), None)
    return moved if W is None else moved._replace(W=inverse.covariance("W", W))


def covariance_without(E: ArrayLike, name: str, W: ArrayLike) -> Array:
    """Return E⁻¹W(E⁻¹)' for the covariance W of something in the equation of E, as ``explicit`` does."""
    return _Inverse.of(E, len(np.asarray(E))).covariance(name, W)


def effect_without(E: ArrayLike, name: str, effect: ArrayLike) -> Array:
    """Return E⁻¹ times the effect, (n, any), of something on the equation of E, as ``explicit`` does."""
    n = len(np.asarray(E))
    return _Inverse.of(E, n).times(name, array(name, effect, (n, None), "(states, any)"))


class _Inverse(NamedTuple):
    """E⁻¹ as a matrix of whole numbers times a rational number, whose products need no common divisors."""

    whole: fmpz_mat
    factor: fmpq

    @classmethod
    def of(cls, E: ArrayLike, n: int) -> _Inverse:
        matrix, below = rational(array("E", E, (n, n), "(states, states)")).numer_denom()
        try:
            one = fmpz_mat(n, n, [int(i == j) for i in range(n) for j in range(n)])
            found = cast("fmpq_mat", cast("Any", matrix).solve(one))  # its stub leaves the type open
        except ZeroDivisionError:
            raise ProblemError(
                f"E is singular: its rank is {matrix.rank()} for {n} states, so some equations are algebraic, and the "
                "state could jump with an input; expected a regular E: eliminate the states that the algebraic "
                "equations determine"
            ) from None
        whole, divisor = found.numer_denom()
        return cls(whole, fmpq(below, divisor))

    def times(self, name: str, right: Array) -> Array:
        whole, below = rational(right).numer_denom()
        return _checked(f"E⁻¹{name}", self.whole * whole, self.factor / below)

    def covariance(self, name: str, W: ArrayLike) -> Array:
        stated = semidefinite(name, W, self.whole.nrows(), "(states, states)")
        exact = rational(stated)
        if not (is_definite(stated) or is_semidefinite(stated)):  # but for the rounding of its entries
            part = rational(root(stated))
            exact = part * part.transpose()
        whole, below = exact.numer_denom()
        moved = self.whole * whole * self.whole.transpose()
        return _checked(f"E⁻¹·{name}·E'⁻¹", moved, self.factor * self.factor / below)


def _checked(name: str, whole: fmpz_mat, factor: fmpq) -> Array:
    return array(name, nearest(whole, factor), (None, None))
