"""Linear matrix inequalities as data: the solver finds a solution, and a bound on rounding proves that it is one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, symmetrised
from taciturn._cvxpy import Minimum

UNIT = 2.0**-53  # relative rounding error of one operation
Square = tuple[float, int, Array]
"""weight, k, T: the term weight · T'P_kT."""


@dataclass(frozen=True, eq=False)
class Inequality:
    """constant + Σ weight·T'P_kT + Σ s_j S_j ⪰ 0.

    Args:
        constant: (n, n), symmetric.
        squares: (weight, k, T) of each term of an unknown matrix.
        scalars: (j, S) of each term of an unknown scalar, S (n, n) symmetric.
    """

    constant: Array
    squares: Sequence[Square] = ()
    scalars: Sequence[tuple[int, Array]] = ()


@dataclass(frozen=True, eq=False)
class Solution:
    """Values of the unknowns: symmetric matrices, and scalars that are not negative."""

    matrices: tuple[Array, ...]
    scalars: Array


@dataclass(frozen=True, eq=False)
class Inequalities:
    """Inequalities in symmetric matrices of given sizes and in so many scalars s ≥ 0.

    Args:
        sizes: of the unknown matrices P_k.
        scalars: number of the unknown scalars.
        listed: the inequalities.
    """

    sizes: tuple[int, ...]
    scalars: int
    listed: tuple[Inequality, ...]

    def minimise(self, weights: Mapping[int, float], margin: float) -> Solution | None:
        """Return a solution with the least Σ weight·scalar, every inequality held by a margin, or None.

        Args:
            weights: of the scalars, those not named 0.
            margin: the least eigenvalue that is asked of every inequality.
        """
        blocks = [(A, 0 * A, b - margin * np.eye(len(b))) for A, b in map(self.block, self.listed)]
        objective, signed = np.zeros(blocks[0][0].shape[1]), self.signed
        for j, weight in weights.items():
            objective[signed[j]] = weight
        found = Minimum(objective, blocks, signed).at(0.0)
        return None if found is None else self.solution(found)

    def shortfall(self, solution: Solution) -> float:
        """Return 0 where the solution provably satisfies every inequality, else by how much one may be missed."""
        if len(solution.scalars) and not solution.scalars.min() >= 0:
            return float("inf")
        with np.errstate(all="ignore"):  # what overflows is no proof
            return max((_shortfall(one, solution) for one in self.listed), default=0.0)

    def raised(self, solution: Solution, index: int) -> Solution:
        """Return the solution with one scalar raised as far as the (1, 1) inequalities in which it stands alone ask."""
        scalars = np.array(solution.scalars)
        for one in self.listed:
            weight = sum(float(S[0, 0]) for j, S in one.scalars if j == index)
            if len(one.constant) == 1 and weight > 0:
                value, size, operations = _evaluated(one, Solution(solution.matrices, scalars))
                least = float(value[0, 0]) - 8 * _gamma(operations) * float(size[0, 0])
                scalars[index] += max(0.0, -least) / weight * (1 + 4 * UNIT)
        return Solution(solution.matrices, scalars)

    def value(self, position: int, solution: Solution) -> Array:
        """Return the left side of an inequality, as computed."""
        return _evaluated(self.listed[position], solution)[0]

    @property
    def signed(self) -> range:
        """Where the scalars stand among all unknowns."""
        first = sum(size * (size + 1) // 2 for size in self.sizes)
        return range(first, first + self.scalars)

    def solution(self, values: Array) -> Solution:
        """Return the unknowns as matrices and scalars."""
        matrices: list[Array] = []
        at = 0
        for size in self.sizes:
            rows, columns = np.triu_indices(size)
            P = np.zeros((size, size))
            P[rows, columns] = P[columns, rows] = values[at : at + len(rows)]
            matrices.append(P)
            at += len(rows)
        return Solution(tuple(matrices), np.maximum(values[at:], 0.0))

    def block(self, one: Inequality) -> tuple[Array, Array]:
        """Return the matrix of the unknowns, (n², unknowns), and the constant."""
        n = len(one.constant)
        starts = np.cumsum([0, *(size * (size + 1) // 2 for size in self.sizes)])
        A = np.zeros((n, n, int(starts[-1]) + self.scalars))
        for weight, k, T in one.squares:
            rows, columns = np.triu_indices(self.sizes[k])
            half = weight * T[rows].T[:, None] * T[columns].T[None]
            both = half + half.swapaxes(0, 1)
            A[:, :, starts[k] : starts[k + 1]] += np.where(rows == columns, half, both)
        for j, S in one.scalars:
            A[:, :, starts[-1] + j] += S
        return A.reshape(n * n, -1), one.constant


class Widest:
    """The solution with the largest margin of all inequalities between two lists of them, the same but for numbers.

    Args:
        first: the inequalities at 0.
        last: those at 1; in between they are linear.
    """

    def __init__(self, first: Inequalities, last: Inequalities) -> None:
        """Write the problem down; the margin is the last unknown, at most 1."""
        blocks: list[tuple[Array, Array, Array]] = []
        for (A, b), (B, _) in zip(map(first.block, first.listed), map(last.block, last.listed), strict=True):
            less = -np.eye(len(b)).reshape(-1, 1)
            blocks.append((np.hstack([A, less]), np.hstack([B - A, 0 * less]), b))
        objective = np.zeros(blocks[0][0].shape[1])
        objective[-1] = -1.0
        blocks.append((objective[None], 0 * objective[None], np.ones((1, 1))))
        self._first, self._minimum = first, Minimum(objective, blocks, first.signed)

    def at(self, share: float) -> Solution | None:
        """Return the solution so far from the first to the last, or None where there is none with a margin."""
        found = self._minimum.at(share)
        return None if found is None or found[-1] <= 0 else self._first.solution(found[:-1])


def _shortfall(one: Inequality, solution: Solution) -> float:
    """Return 0 where the inequality provably holds, else by how much its least eigenvalue may be below 0.

    Every entry is computed with at most so many operations that its error is at most γ times the sum of the moduli of
    what is added up, γ = ku/(1 − ku), which bounds the norm of the error; a Cholesky factorisation that succeeds after
    as much, and γ_{n+1}/(1 − γ_{n+1}) of the trace, is taken from the diagonal proves the rest [rump2006].
    """
    value, size, terms = _evaluated(one, solution)
    if not np.isfinite(size).all():
        return float("inf")
    n = len(value)
    rounding = 2 * _gamma(terms) * float(size.sum(axis=1).max(initial=0.0))  # of ``size`` itself too
    factoring = 2 * _gamma(n + 2) * (float(np.abs(np.diag(value)).sum()) + n * rounding)
    allowance = rounding + factoring + np.finfo(np.float64).tiny
    try:
        np.linalg.cholesky(value - allowance * np.eye(n))
    except np.linalg.LinAlgError:
        least = float(np.linalg.eigvalsh(value)[0])
        return max(allowance - least, np.finfo(np.float64).tiny)
    return 0.0


def _evaluated(one: Inequality, solution: Solution) -> tuple[Array, Array, int]:
    """Return the left side, the sum of the moduli of what it is made of, and the operations that an entry takes."""
    value, size, terms = np.array(one.constant), np.abs(one.constant), 1
    for weight, k, T in one.squares:
        P = solution.matrices[k]
        value += weight * (T.T @ P @ T)
        size += abs(weight) * (np.abs(T).T @ np.abs(P) @ np.abs(T))
        terms += 2 * len(P) + 2
    for j, S in one.scalars:
        value += solution.scalars[j] * S
        size += solution.scalars[j] * np.abs(S)
        terms += 2
    return symmetrised(value), size, terms


def _gamma(operations: int) -> float:
    return operations * UNIT / (1 - operations * UNIT)
