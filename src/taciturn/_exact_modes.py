"""Modes that no input moves, and which of them decay, stay or grow: exact answers for matrices of doubles.

A double is a rational number. The modes that the input through B does not move are the roots of a polynomial with
rational coefficients: the characteristic polynomial of A on the states modulo those that B, AB, A²B, … span. By
duality, the modes of A' that C' does not move are those that the outputs Cx do not show.

A root λ lies on the stability limit if and only if it is its own mirror image there: ρ²/λ* for a circle of radius ρ,
and −λ* for the imaginary axis. The mirror images are the roots of the reflected polynomial. So roots on the limit are
common roots of both, which a greatest common divisor finds exactly; all other roots are separated from the limit by
balls of growing precision.

Sampling changes none of these answers. An input moves all modes of a sampled plant unless (λ − μ)h = 2πik for two modes
λ ≠ μ of the plant, or λh = 2πik ≠ 0 for one mode. For rational matrices and a rational period h, the left sides are
algebraic numbers, and π is not. So the modes of the plant before it was sampled decide. With a discount α they are
compared with −ln α/(2h), which no algebraic number is.

Source: trentelman2001, kalman1963
"""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np
from flint import acb, arb, fmpq, fmpq_mat, fmpq_poly

from taciturn._arrays import Array
from taciturn._modes import Modes, mode_text
from taciturn._precision import precision
from taciturn._rational import basis, beside, kernel, lines, pivots, rational, reaches_all

BITS = 128  # first precision of the roots; it doubles until the limit separates them
FEWEST, MOST = 6, 17  # digits of a mode in a message
SAME = 2.0**-51  # relative distance between two doubles that may be roundings of the same number


class Lost(NamedTuple):
    """Modes of which it is known whether they decay, the fastest ones first, with their multiplicities.

    Args:
        growing: those outside the stability limit.
        staying: those on the limit.
        decaying: those inside.
    """

    growing: Modes
    staying: Modes
    decaying: Modes

    @property
    def lasting(self) -> Modes:
        """The modes that do not decay, the fastest first."""
        return np.concatenate([self.growing, self.staying])


NONE = Lost(*(np.zeros(0, dtype=np.complex128) for _ in range(3)))


class Limit(NamedTuple):
    """The edge of the modes that count as decaying.

    Args:
        continuous: whether time is continuous: the edge is the imaginary axis, and otherwise the unit circle.
        discount: α, by which the cost of a later step counts less: the edge is the circle of radius 1/√α, or in
            continuous time the line Re λ = −ln α/(2h).
        period: h, the period of the steps in continuous time.
    """

    continuous: bool
    discount: float = 1.0
    period: float = 1.0

    def __str__(self) -> str:
        """Return the edge as text."""
        return self.text(FEWEST)

    def text(self, digits: int) -> str:
        """Return the edge as text, with a number of digits."""
        if self.continuous:
            return "the imaginary axis" if self.at == 0 else f"the line Re s = {self.at:.{digits}g}"
        return "the unit circle" if self.at == 1 else f"the circle of radius 1/√discount = {self.at:.{digits}g}"

    def region(self, digits: int) -> str:
        """Return the region of the modes that decay as text, with a number of digits."""
        return "the open left half-plane" if self.continuous and self.discount == 1 else self.text(digits)

    @property
    def at(self) -> float:
        """Real part or modulus of the edge."""
        if self.continuous:
            return -float(np.log(self.discount)) / (2 * self.period)
        return 1 / float(np.sqrt(self.discount))

    def named(self, mode: complex) -> str:
        """Return a mode as text, with as many digits as tell it from the edge."""
        return mode_text(mode, self.digits(mode))

    def digits(self, mode: complex) -> int:
        """Return the least number of digits, six or more, in which a mode and the edge lie as they do."""
        at, own = self.at, mode.real if self.continuous else abs(mode)
        if abs(own - at) <= SAME * at:
            return FEWEST  # the double may be that of a mode on the edge
        for digits in range(FEWEST, MOST):
            rounded = complex(*(float(f"{part:.{digits}g}") for part in (mode.real, mode.imag)))
            shown, edge = rounded.real if self.continuous else abs(rounded), float(f"{at:.{digits}g}")
            if shown != edge and (shown > edge) == (own > at):
                return digits
        return MOST

    @property
    def reaching(self) -> bool:
        """Whether an eigenvalue can lie on the edge: a line that is not the axis has transcendental real parts."""
        return not self.continuous or self.discount == 1

    def side(self, root: acb) -> int:
        """Return 1 for a root that is proved to lie outside, −1 for one inside, and 0 for another one."""
        if self.continuous:
            distance = root.real + arb(self.discount).log() / (2 * arb(self.period))
        else:
            distance = (root.real**2 + root.imag**2) * arb(self.discount) - 1
        return 1 if distance > 0 else -1 if distance < 0 else 0

    def reflected(self, polynomial: fmpq_poly) -> fmpq_poly:
        """Return the polynomial whose roots are the mirror images of the nonzero roots of another one."""
        coefficients = polynomial.coeffs()
        if self.continuous:
            return fmpq_poly([one if k % 2 == 0 else -one for k, one in enumerate(coefficients)])
        discount = fmpq(*self.discount.as_integer_ratio())
        return fmpq_poly(list(reversed([one / discount**k for k, one in enumerate(coefficients)])))

    def image(self, root: acb) -> acb:
        """Return the mirror image of a nonzero root."""
        conjugate = acb(root.real, -root.imag)
        return -conjugate if self.continuous else acb(1) / (conjugate * arb(self.discount))


def unmoved(A: Array, B: Array, limit: Limit) -> Lost:
    """Return the modes of A that the input through B does not move.

    Args:
        A: (n, n) dynamics.
        B: (n, m) input matrix.
        limit: the edge of the modes that count as decaying.
    """
    if not len(A) or reaches_all(A, B):
        return NONE
    return _beyond(rational(A), basis(rational(B)), limit)


def unmoved_and_seen(A: Array, B: Array, rows: Array, limit: Limit) -> Lost:
    """Return the modes of A that the input through B does not move and on which combinations of states depend.

    They are the modes of A on the states modulo those that the input reaches and those that never show.

    Args:
        A: (n, n) dynamics.
        B: (n, m) input matrix.
        rows: the combinations, (any, n).
        limit: the edge of the modes that count as decaying.
    """
    F = rational(A)
    hidden = kernel(_larger(F.transpose(), basis(rational(rows.T))).transpose())
    return _beyond(F, basis(beside(rational(B), hidden)), limit)


def _larger(F: fmpq_mat, reached: fmpq_mat) -> fmpq_mat:
    """Return a basis of the least subspace that contains another one, and that F does not leave."""
    while True:
        larger = basis(beside(reached, F * reached))
        if larger.ncols() == reached.ncols():
            return reached
        reached = larger


def _beyond(F: fmpq_mat, some: fmpq_mat, limit: Limit) -> Lost:
    """Return the modes of F on the states modulo those to which it moves some states."""
    reached = _larger(F, some)
    # a state modulo the reached ones has as coordinates its entries outside the pivots, without their combination
    inside = pivots(reached)
    rest, kept = np.flatnonzero(~inside).tolist(), np.flatnonzero(inside).tolist()
    if not rest:
        return NONE
    late = lines(F.transpose(), rest).transpose()
    quotient = lines(late, rest)
    if kept:
        quotient = quotient - lines(reached, rest) * lines(late, kept)
    return modes_of(quotient, limit)


def modes_of(A: fmpq_mat, limit: Limit) -> Lost:
    """Return all modes of a matrix of rational numbers."""
    return _split(A.charpoly(), limit)


def _split(polynomial: fmpq_poly, limit: Limit) -> Lost:
    """Return the roots of a polynomial outside, on and inside a limit, with their multiplicities."""
    on, bits = None if limit.reaching else 0, BITS
    while True:
        with precision(bits):
            found = _roots(polynomial)
            sides = [limit.side(root) for root, _ in found]
            if 0 in sides and on is None:
                on = _self_reflected(polynomial.gcd(limit.reflected(polynomial)), limit)
            if sides.count(0) == (on or 0):
                return Lost(*(_values(found, sides, side) for side in (1, 0, -1)))
        bits *= 2


def _roots(polynomial: fmpq_poly) -> list[tuple[acb, int]]:
    """Return the different roots with their multiplicities, which the types of python-flint leave out."""
    return cast("list[tuple[acb, int]]", polynomial.complex_roots())  # pyright: ignore[reportUnknownMemberType]


def _self_reflected(common: fmpq_poly, limit: Limit) -> int | None:
    """Return how many different roots are their own mirror images; None if this precision does not tell.

    Args:
        common: a polynomial that has the mirror images of its roots as roots.
        limit: the mirror.
    """
    roots, count = [root for root, _ in _roots(common)] if common.degree() else [], 0
    for k, root in enumerate(roots):
        near = [j for j, other in enumerate(roots) if limit.image(root).overlaps(other)]
        if len(near) != 1:
            return None
        count += near[0] == k
    return count


def _values(found: list[tuple[acb, int]], sides: list[int], side: int) -> Modes:
    chosen = [complex(root) for (root, many), own in zip(found, sides, strict=True) if own == side for _ in range(many)]
    return np.array(sorted(chosen, key=lambda mode: (-abs(mode), -mode.imag)), dtype=np.complex128)
