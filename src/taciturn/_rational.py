"""Exact ranks, null spaces and uncontrollable modes of matrices, in rational arithmetic.

A double is a rational number. So whether an input moves a mode, and whether this mode decays, are questions that have
answers, without a tolerance.

The modes that the input through B does not move are the roots of a polynomial with rational coefficients: the
characteristic polynomial of A on the states modulo those that B, AB, A²B, … span. By duality, the modes of A' that C'
does not move are those that the outputs Cx do not show. Full rank is usual and is recognised modulo a prime, in
integer arithmetic of machine words: a rank modulo a prime is at most the rank. Only otherwise rational numbers are
needed.

A root λ lies on the stability limit if and only if it is its own mirror image there: ρ²/λ* for a circle of radius ρ,
and −λ* for the imaginary axis. The mirror images are the roots of the reflected polynomial. So roots on the limit are
common roots of both, which a greatest common divisor finds exactly; all other roots are separated from the limit by
balls of growing precision.

Sampling changes none of these answers. An input moves all modes of a sampled plant unless (λ − μ)h = 2πik for two modes
λ ≠ μ of the plant, or λh = 2πik ≠ 0 for one mode. For rational matrices and a rational period h, the left sides are
algebraic numbers, and π is not. So the modes of the plant before it was sampled decide. With a discount α they are
compared with −ln α/(2h), which no algebraic number is.

The cosines and sines of an oscillator that a user samples are rounded, so its exact modes do not lie on the limit. On
request, modes that rounding the entries may have moved off the limit count as modes on it: some matrix within the
rounding has this mode on the limit, by the least singular value. The entry of a single state is what it is.

Source: trentelman2001, kalman1963
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from threading import RLock
from typing import NamedTuple, cast

import numpy as np
from flint import acb, arb, ctx, fmpq, fmpq_mat, fmpq_poly, fmpz_mat, nmod, nmod_mat

from taciturn._arrays import NO_VARIANCE, Array, Bits
from taciturn._modes import ROUNDOFF, Modes, balancing, closure, in_cycles, mode_text

_PRIME = (1 << 61) - 1  # a rank modulo this prime is at most the rank of the rational numbers
_LOCK = RLock()
_BITS = 128  # first precision of the roots; it doubles until the limit separates them
_SAME = 2.0**-51  # relative distance between two doubles that may be roundings of the same number
_ROUNDINGS = 8  # of each entry of a matrix, by which a mode may have left the limit
FEWEST, _MOST = 6, 17  # digits of a mode in a message
_NEAR = 1e-3  # distance from the limit beyond which rounding has moved no mode


def reaches_all(A: Array, B: Array) -> bool:
    """Check whether (A, B) is controllable: whether the columns of B, AB, A²B, … span the whole state space."""
    # True is exact: a rank modulo a prime is at most the rank. False is exact but for the chance, about n²/2^61, that
    # the prime divides all minors.
    return _reached(A, B) == len(A)


def _reached(A: Array, B: Array) -> int:
    """Return the rank of B, AB, A²B, … modulo a prime; it is at most the rank over the rational numbers."""
    # It is known once it is full, or equal for twice as many powers of A.
    (n, m), before, most = B.shape, 0, len(B)
    moves, block, columns = _modular(A), _modular(B), list[nmod]()
    while n and m:
        columns += block.transpose().entries()
        count = len(columns) // n
        if count >= most or count == n * m:
            rank = nmod_mat(count, n, columns, _PRIME).rank()
            if rank in (n, before) or count == n * m:
                return rank
            before, most = rank, 2 * most
        block = moves * block
    return 0


def _reachable(A: Array, B: Array) -> fmpq_mat:
    """Return a basis of the states that the input through B reaches, the span of B, AB, A²B, …, in reduced form."""
    F, (n, m) = rational(A), B.shape
    chosen, block, columns = _independent(A, B), rational(B.T), fmpq_mat(0, n)
    for k in range(n):  # the columns that are independent modulo a prime, as rows; those of A^k come from those before
        own = [place - k * m for place in chosen if k * m <= place < (k + 1) * m]
        if not own:
            break
        columns = above(columns, lines(block, own))
        block = block * F.transpose()
    return _within(F, basis(columns.transpose()))  # already invariant, unless the prime divides minors


def _within(F: fmpq_mat, some: fmpq_mat) -> fmpq_mat:
    """Return a basis of the least subspace with given states that F does not leave; both in reduced form."""
    while True:
        moved = F * some
        if moved == some * lines(moved, np.flatnonzero(pivots(some)).tolist()):
            return some
        some = basis(beside(some, moved))


def _independent(A: Array, B: Array) -> list[int]:
    """Return places of columns of B, AB, A²B, … that are independent of those before, modulo a prime; so they are."""
    n, m = B.shape
    moves, block = _modular(A), _modular(B)
    table = list[list[int]]()
    for _ in range(n if m else 0):
        table += [[int(block[i, j]) for i in range(n)] for j in range(m)]
        block = moves * block
    if not table:
        return []
    reduced, rank = nmod_mat(n, len(table), [row[i] for i in range(n) for row in table], _PRIME).rref()
    places = list[int]()
    for i in range(rank):
        start = places[-1] + 1 if places else 0
        places.append(next(j for j in range(start, len(table)) if int(reduced[i, j])))
    return places


def _modular(values: Array) -> nmod_mat:
    parts, exponents = np.frexp(np.abs(values))
    turns = ((exponents - 53) % 61).astype(np.uint64)  # 2^61 is 1: a power of two turns the 61 digits
    digits = (parts * 2.0**53).astype(np.uint64)
    turned = (digits << turns) & np.uint64(_PRIME) | digits >> (np.uint64(61) - turns)
    entries = np.where(values < 0, np.uint64(_PRIME) - turned, turned)
    return nmod_mat(len(values), values.shape[1], entries.ravel().tolist(), _PRIME)


def rational(values: Array) -> fmpq_mat:
    """Convert a matrix of doubles to a matrix of rational numbers without rounding."""
    entries = [fmpq(*value.as_integer_ratio()) for value in values.ravel().tolist()]
    return fmpq_mat(len(values), values.shape[1], entries)


def nearest(whole: fmpz_mat, factor: fmpq) -> Array:
    """Multiply integers by ``factor``, and round to the nearest doubles; a product beyond them is infinite."""
    over, under = int(factor.p), int(factor.q)
    return np.array([_quotient(int(one) * over, under) for one in whole.entries()]).reshape(
        whole.nrows(), whole.ncols()
    )


def _quotient(over: int, under: int) -> float:
    try:
        return over / under  # Python rounds the quotient of two integers once
    except OverflowError:
        return np.inf if over > 0 else -np.inf


def above(*parts: fmpq_mat) -> fmpq_mat:
    """Stack matrices vertically into one matrix."""
    rows = sum(part.nrows() for part in parts)
    return fmpq_mat(rows, parts[0].ncols(), [entry for part in parts for entry in part.entries()])


def beside(*parts: fmpq_mat) -> fmpq_mat:
    """Join matrices side by side."""
    return above(*(part.transpose() for part in parts)).transpose()


def lines(matrix: fmpq_mat, rows: Sequence[int]) -> fmpq_mat:
    """Return the submatrix of the given rows of a matrix."""
    return fmpq_mat(len(rows), matrix.ncols(), [matrix[i, j] for i in rows for j in range(matrix.ncols())])


def leading(matrix: fmpq_mat) -> tuple[fmpq_mat, list[int]]:
    """Compute the reduced row echelon form without its zero rows, and the columns of the pivots."""
    if not matrix.nrows() or not matrix.ncols():
        return fmpq_mat(0, matrix.ncols()), []
    reduced, rank = matrix.rref()
    lead = [next(j for j in range(reduced.ncols()) if reduced[i, j] != 0) for i in range(rank)]
    return lines(reduced, range(rank)), lead


def basis(matrix: fmpq_mat) -> fmpq_mat:
    """Compute a basis of the column space of a matrix, in reduced form: its rows ``pivots`` are the identity matrix."""
    return leading(matrix.transpose())[0].transpose()


def pivots(basis: fmpq_mat) -> Bits:
    """Mark the rows of a basis in reduced form that form the identity matrix."""
    found = np.zeros(basis.nrows(), dtype=np.bool_)
    found[leading(basis.transpose())[1]] = True
    return found


def kernel(matrix: fmpq_mat) -> fmpq_mat:
    """Compute a basis of the null space of a matrix: its columns span all vectors that the matrix maps to zero."""
    reduced, lead = leading(matrix)
    free = [j for j in range(matrix.ncols()) if j not in lead]
    found = fmpq_mat(matrix.ncols(), len(free))
    for k, j in enumerate(free):
        found[j, k] = 1
        for i, row in enumerate(lead):
            found[row, k] = -reduced[i, j]
    return found


def right_inverse(matrix: fmpq_mat) -> fmpq_mat:
    """Compute a right inverse Y of a matrix of full row rank, such that matrix·Y is the identity."""
    one = rational(np.eye(matrix.nrows()))
    reduced, lead = leading(beside(matrix, one))
    found = fmpq_mat(matrix.ncols(), matrix.nrows())
    for i, row in enumerate(lead):
        for j in range(matrix.nrows()):
            found[row, j] = reduced[i, matrix.ncols() + j]
    return found


def is_semidefinite(values: Array) -> bool:
    """Check in exact arithmetic whether a symmetric matrix of doubles is positive semidefinite."""
    rest = rational(values)
    n = len(values)
    for k in range(n):
        pivot, row = rest[k, k], [rest[k, j] for j in range(k, n)]
        if pivot < 0 or (pivot == 0 and any(entry != 0 for entry in row)):
            return False
        if pivot == 0:
            continue
        for i in range(k + 1, n):
            factor = row[i - k] / pivot
            if factor == 0:
                continue
            for j in range(i, n):
                rest[i, j] -= factor * row[j - k]
                rest[j, i] = rest[i, j]
    return True


@contextmanager
def precision(bits: int) -> Generator[None]:
    """While the block runs, python-flint computes with a precision of ``bits`` bits. Other threads wait."""
    with _LOCK:
        before, ctx.prec = ctx.prec, bits
        try:
            yield
        finally:
            ctx.prec = before


class Lost(NamedTuple):
    """Modes that an input does not affect: unstable, marginally stable and stable ones, each group from fast to
    slow.
    """

    growing: Modes  # those outside the stability limit
    staying: Modes  # those on the limit
    decaying: Modes  # those inside

    @property
    def lasting(self) -> Modes:
        """The unstable and marginally stable modes, sorted from the fastest to the slowest."""
        return np.concatenate([self.growing, self.staying])


NONE = Lost(*(np.zeros(0, dtype=np.complex128) for _ in range(3)))


class Limit(NamedTuple):
    """The stability limit in the complex plane: unit circle or imaginary axis; with a discount, a larger circle or a
    line.
    """

    continuous: bool  # whether time is continuous: the edge is the imaginary axis, and otherwise the unit circle
    # α, by which the cost of a later step counts less: the edge is the circle of radius 1/√α, or in continuous time
    # the line Re λ = −ln α/(2h)
    discount: float = 1.0
    period: float = 1.0  # h, the period of the steps in continuous time

    def __str__(self) -> str:
        """Return the edge as text."""
        return self.text(FEWEST)

    def text(self, digits: int) -> str:
        """Write the stability limit as text such as "the unit circle", with the given number of digits."""
        if self.continuous:
            return "the imaginary axis" if self.at == 0 else f"the line Re s = {self.at:.{digits}g}"
        return "the unit circle" if self.at == 1 else f"the circle of radius 1/√discount = {self.at:.{digits}g}"

    def region(self, digits: int) -> str:
        """Write the region in which modes are stable as text, with the given number of digits."""
        return "the open left half-plane" if self.continuous and self.discount == 1 else self.text(digits)

    @property
    def at(self) -> float:
        """Radius of the circle that is the stability limit. In continuous time, the real part of the line."""
        if self.continuous:
            return -float(np.log(self.discount)) / (2 * self.period)
        return 1 / float(np.sqrt(self.discount))

    def named(self, mode: complex) -> str:
        """Write a mode as text, with enough digits to show on which side of the stability limit it lies."""
        return mode_text(mode, self.digits(mode))

    def digits(self, mode: complex) -> int:
        """Return how many digits, at least six, are needed to show on which side of the stability limit a mode lies."""
        at, own = self.at, mode.real if self.continuous else abs(mode)
        if abs(own - at) <= _SAME * at:
            return FEWEST  # the double may be that of a mode on the edge
        for digits in range(FEWEST, _MOST):
            rounded = complex(*(float(f"{part:.{digits}g}") for part in (mode.real, mode.imag)))
            shown, edge = rounded.real if self.continuous else abs(rounded), float(f"{at:.{digits}g}")
            if shown != edge and (shown > edge) == (own > at):
                return digits
        return _MOST

    @property
    def reaching(self) -> bool:
        """Whether a mode can lie exactly on the stability limit. It cannot if the limit is another line than Re
        s = 0.
        """
        return not self.continuous or self.discount == 1

    def side(self, root: acb) -> int:
        """Return on which side of the stability limit a root provably lies: 1 outside, −1 inside, 0 if not proved."""
        if self.continuous:
            distance = root.real + arb(self.discount).log() / (2 * arb(self.period))
        else:
            distance = (root.real**2 + root.imag**2) * arb(self.discount) - 1
        return 1 if distance > 0 else -1 if distance < 0 else 0

    def reflected(self, polynomial: fmpq_poly) -> fmpq_poly:
        """Return the polynomial whose roots are the mirror images, at the stability limit, of the polynomial's nonzero
        roots.
        """
        coefficients = polynomial.coeffs()
        if self.continuous:
            return fmpq_poly([one if k % 2 == 0 else -one for k, one in enumerate(coefficients)])
        discount = fmpq(*self.discount.as_integer_ratio())
        return fmpq_poly(list(reversed([one / discount**k for k, one in enumerate(coefficients)])))

    def image(self, root: acb) -> acb:
        """Compute the mirror image of a nonzero root at the stability limit."""
        conjugate = acb(root.real, -root.imag)
        return -conjugate if self.continuous else acb(1) / (conjugate * arb(self.discount))


def unmoved(A: Array, B: Array, limit: Limit, rounded: bool = False) -> Lost:
    """Compute the uncontrollable modes of (A, B)."""
    if not len(A) or reaches_all(A, B):
        return NONE
    leads = np.asarray(A != 0, dtype=np.bool_)
    inside = closure((B != 0).any(axis=1), leads)  # the states that inputs affect
    found, among = [NONE], np.ix_(inside, inside)
    if not reaches_all(A[among], B[inside]):
        moved = A[among], B[inside]
        found.append(_of_block(_beyond(rational(moved[0]), _reachable(*moved)), limit, rounded))
    for cycle in in_cycles(leads):
        if not inside[cycle].any():
            found.append(_of_block(rational(A[np.ix_(cycle, cycle)]), limit, rounded and int(cycle.sum()) > 1))
    return Lost(*(_sorted(np.concatenate(modes)) for modes in zip(*found, strict=True)))


def free_modes(A: Array, limit: Limit) -> Lost:
    """Compute all modes of A. If rounding may hide on which side of the limit a mode lies, it is marginally stable."""
    return unmoved(A, np.zeros((len(A), 0)), limit, rounded=True)


def unmoved_and_seen(A: Array, B: Array, rows: Array, limit: Limit, rounded: bool = False) -> Lost:
    """Compute the modes of A that are uncontrollable through B, but observable in the outputs ``rows``·x."""
    # They are the modes of A on the states modulo those that the input reaches and those that never show.
    F, hidden = rational(A), kernel(_reachable(A.T, rows.T).transpose())
    return _of_block(_beyond(F, _within(F, basis(beside(rational(B), hidden)))), limit, rounded)


def _beyond(F: fmpq_mat, reached: fmpq_mat) -> fmpq_mat:
    """Return the dynamics of the states modulo a subspace that F does not leave, given by a basis in reduced form."""
    # a state modulo the reached ones has as coordinates its entries outside the pivots, without their combination
    inside = pivots(reached)
    rest, kept = np.flatnonzero(~inside).tolist(), np.flatnonzero(inside).tolist()
    late = lines(F.transpose(), rest).transpose()
    return lines(late, rest) - (lines(reached, rest) * lines(late, kept) if kept else fmpq_mat(len(rest), len(rest)))


def _of_block(block: fmpq_mat, limit: Limit, rounded: bool) -> Lost:
    found = modes_of(block, limit)
    if not (rounded and (found.growing.size or found.decaying.size)):
        return found
    A = np.array([int(one.p) / int(one.q) for one in block.entries()]).reshape(block.nrows(), block.ncols())
    scale = balancing(A)
    A = A / scale[:, None] * scale
    out, into = (_may_stay(A, modes, limit) for modes in (found.growing, found.decaying))
    staying = [found.staying, found.growing[out], found.decaying[into]]
    return Lost(found.growing[~out], np.concatenate(staying), found.decaying[~into])


def _may_stay(A: Array, modes: Modes, limit: Limit) -> Bits:
    """Return for each mode whether a matrix within the rounding of A has it on the axis or the unit circle."""
    nearest = 1j * modes.imag if limit.continuous else modes / np.maximum(np.abs(modes), NO_VARIANCE)
    rounding = _ROUNDINGS * ROUNDOFF * float(np.linalg.norm(A))
    near = np.abs(modes - nearest) <= _NEAR * max(float(np.abs(A).max()), 1.0)  # no other mode needs the test
    shifted = nearest[near][:, None, None] * np.eye(len(A)) - A
    near[near] = np.linalg.svd(shifted, compute_uv=False)[:, -1] <= rounding
    return near


def modes_of(A: fmpq_mat, limit: Limit) -> Lost:
    """Compute all modes of a matrix of rational numbers, and on which side of the stability limit they lie."""
    found = roots_of(A.charpoly(), limit)
    sides = ([complex(one.root) for one in found if one.side == side for _ in range(one.many)] for side in (1, 0, -1))
    return Lost(*(_sorted(np.array(modes, dtype=np.complex128)) for modes in sides))


class _Root(NamedTuple):
    """A root of a polynomial, its multiplicity, and its side of a limit: 1 outside, 0 on it, −1 inside."""

    root: acb
    many: int
    side: int


def roots_of(polynomial: fmpq_poly, limit: Limit, bits: int = _BITS) -> list[_Root]:
    """Compute the distinct roots of a polynomial, with at least ``bits`` bits of precision."""
    on = None if limit.reaching else 0
    while True:
        with precision(bits):
            found = [_Root(root, many, limit.side(root)) for root, many in _roots(polynomial)]
            sides = [one.side for one in found]
            if 0 in sides and on is None:
                on = _self_reflected(polynomial.gcd(limit.reflected(polynomial)), limit)
            if sides.count(0) == (on or 0):
                return found
        bits *= 2


def _roots(polynomial: fmpq_poly) -> list[tuple[acb, int]]:
    """Return the different roots with their multiplicities, which the types of python-flint leave out."""
    return cast("list[tuple[acb, int]]", polynomial.complex_roots())  # pyright: ignore[reportUnknownMemberType]


def _self_reflected(common: fmpq_poly, limit: Limit) -> int | None:
    """Return the number of different roots that are their own mirror images; None if the precision is too low."""
    roots, count = [root for root, _ in _roots(common)] if common.degree() else [], 0
    for k, root in enumerate(roots):
        near = [j for j, other in enumerate(roots) if limit.image(root).overlaps(other)]
        if len(near) != 1:
            return None
        count += near[0] == k
    return count


def _sorted(modes: Modes) -> Modes:
    return modes[np.lexsort((-modes.imag, -np.abs(modes)))]
