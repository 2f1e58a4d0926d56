"""Ranks and kernels of matrices in rational numbers, which decide without a tolerance.

A double is a rational number. So whether an input moves a mode of a plant is a question that has an answer.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from flint import fmpq, fmpq_mat, fmpz_mat, nmod, nmod_mat

from taciturn._arrays import Array, Bits

PRIME = (1 << 61) - 1  # a rank modulo this prime is at most the rank of the rational numbers


def reaches_all(A: Array, B: Array) -> bool:
    """Return whether the input through B reaches all states: whether B, AB, A²B, … have full rank.

    True is exact: a rank modulo a prime is at most the rank. False is exact but for the chance, about n²/2^61, that the
    prime divides all minors.
    """
    return _reached(A, B) == len(A)


def _reached(A: Array, B: Array) -> int:
    """Return the rank of B, AB, A²B, … modulo a prime, which is at most that of the rational numbers.

    It is known once it is full, or equal for twice as many powers of A.
    """
    (n, m), before, most = B.shape, 0, len(B)
    moves, block, columns = _modular(A), _modular(B), list[nmod]()
    while n and m:
        columns += block.transpose().entries()
        count = len(columns) // n
        if count >= most or count == n * m:
            rank = nmod_mat(count, n, columns, PRIME).rank()
            if rank in (n, before) or count == n * m:
                return rank
            before, most = rank, 2 * most
        block = moves * block
    return 0


def reachable(A: Array, B: Array) -> fmpq_mat:
    """Return a basis of the states that the input through B reaches, the span of B, AB, A²B, …, in reduced form."""
    F, (n, m) = rational(A), B.shape
    chosen, block, columns = _independent(A, B), rational(B.T), fmpq_mat(0, n)
    for k in range(n):  # the columns that are independent modulo a prime, as rows; those of A^k come from those before
        own = [place - k * m for place in chosen if k * m <= place < (k + 1) * m]
        if not own:
            break
        columns = above(columns, lines(block, own))
        block = block * F.transpose()
    return within(F, basis(columns.transpose()))  # already invariant, unless the prime divides minors


def within(F: fmpq_mat, some: fmpq_mat) -> fmpq_mat:
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
    reduced, rank = nmod_mat(n, len(table), [row[i] for i in range(n) for row in table], PRIME).rref()
    places = list[int]()
    for i in range(rank):
        start = places[-1] + 1 if places else 0
        places.append(next(j for j in range(start, len(table)) if int(reduced[i, j])))
    return places


def _modular(values: Array) -> nmod_mat:
    parts, exponents = np.frexp(np.abs(values))
    turns = ((exponents - 53) % 61).astype(np.uint64)  # 2^61 is 1: a power of two turns the 61 digits
    digits = (parts * 2.0**53).astype(np.uint64)
    turned = (digits << turns) & np.uint64(PRIME) | digits >> (np.uint64(61) - turns)
    entries = np.where(values < 0, np.uint64(PRIME) - turned, turned)
    return nmod_mat(len(values), values.shape[1], entries.ravel().tolist(), PRIME)


def rational(values: Array) -> fmpq_mat:
    """Return a matrix of doubles as rational numbers, each exactly."""
    entries = [fmpq(*value.as_integer_ratio()) for value in values.ravel().tolist()]
    return fmpq_mat(len(values), values.shape[1], entries)


def nearest(whole: fmpz_mat, factor: fmpq) -> Array:
    """Return the doubles nearest to the products of whole numbers with a factor; infinite beyond their range."""
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
    """Return matrices, one above the other."""
    rows = sum(part.nrows() for part in parts)
    return fmpq_mat(rows, parts[0].ncols(), [entry for part in parts for entry in part.entries()])


def beside(*parts: fmpq_mat) -> fmpq_mat:
    """Return matrices side by side."""
    return above(*(part.transpose() for part in parts)).transpose()


def lines(matrix: fmpq_mat, rows: Sequence[int]) -> fmpq_mat:
    """Return some rows of a matrix."""
    return fmpq_mat(len(rows), matrix.ncols(), [matrix[i, j] for i in rows for j in range(matrix.ncols())])


def leading(matrix: fmpq_mat) -> tuple[fmpq_mat, list[int]]:
    """Return the reduced echelon form of a matrix without its zero rows, and the columns of its leading ones."""
    if not matrix.nrows() or not matrix.ncols():
        return fmpq_mat(0, matrix.ncols()), []
    reduced, rank = matrix.rref()
    lead = [next(j for j in range(reduced.ncols()) if reduced[i, j] != 0) for i in range(rank)]
    return lines(reduced, range(rank)), lead


def basis(matrix: fmpq_mat) -> fmpq_mat:
    """Return a basis of the columns of a matrix, which is the identity in the rows ``pivots``."""
    return leading(matrix.transpose())[0].transpose()


def pivots(basis: fmpq_mat) -> Bits:
    """Return a mask of the rows in which a basis in reduced form is the identity."""
    found = np.zeros(basis.nrows(), dtype=np.bool_)
    found[leading(basis.transpose())[1]] = True
    return found


def kernel(matrix: fmpq_mat) -> fmpq_mat:
    """Return a basis of the vectors that a matrix maps to zero, as columns."""
    reduced, lead = leading(matrix)
    free = [j for j in range(matrix.ncols()) if j not in lead]
    found = fmpq_mat(matrix.ncols(), len(free))
    for k, j in enumerate(free):
        found[j, k] = 1
        for i, row in enumerate(lead):
            found[row, k] = -reduced[i, j]
    return found


def right_inverse(matrix: fmpq_mat) -> fmpq_mat:
    """Return a matrix Y with matrix·Y = I, for a matrix of full row rank."""
    one = rational(np.eye(matrix.nrows()))
    reduced, lead = leading(beside(matrix, one))
    found = fmpq_mat(matrix.ncols(), matrix.nrows())
    for i, row in enumerate(lead):
        for j in range(matrix.nrows()):
            found[row, j] = reduced[i, matrix.ncols() + j]
    return found


def is_semidefinite(values: Array) -> bool:
    """Return whether a symmetric matrix of doubles has no negative eigenvalue, by elimination without rounding."""
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
