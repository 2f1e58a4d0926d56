"""Linear matrix inequalities: a solver finds a solution, which is verified with bounds on rounding errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, symmetrised
from taciturn._cvxpy import Minimum
from taciturn._display import Displayed

UNIT = 2.0**-53  # relative rounding error of one operation
Square = tuple[float, int, Array]
"""The triple (weight, k, T) of a term weight · T'P_kT."""


@dataclass(frozen=True, eq=False, repr=False)
class Inequality(Displayed):
    """Linear matrix inequality constant + Σ weight·T'P_kT + Σ s_j S_j ⪰ 0 in matrices P_k and scalars s_j.

    Args:
        constant: symmetric matrix, (n, n).
        squares: the triple (weight, k, T) of each term with an unknown matrix.
        scalars: the pair (j, S) of each term with an unknown scalar; S is symmetric, (n, n).
    """

    constant: Array
    squares: Sequence[Square] = ()
    scalars: Sequence[tuple[int, Array]] = ()


@dataclass(frozen=True, eq=False, repr=False)
class Unknowns(Displayed):
    """Values of the unknowns of matrix inequalities: symmetric matrices and non-negative scalars."""

    matrices: tuple[Array, ...]
    scalars: Array


@dataclass(frozen=True, eq=False, repr=False)
class Inequalities(Displayed):
    """Set of linear matrix inequalities in symmetric matrices of given sizes and in scalars s ≥ 0.

    Args:
        sizes: sizes of the unknown matrices P_k.
        scalars: number of the unknown scalars.
        listed: the inequalities.
    """

    sizes: tuple[int, ...]
    scalars: int
    listed: tuple[Inequality, ...]

    def minimise(self, weights: Mapping[int, float], margin: float) -> Unknowns | None:
        """Return the solution with the least Σ weight·scalar that satisfies every inequality with a margin, or None.

        Args:
            weights: weights of the scalars by index; the others have weight 0.
            margin: least eigenvalue that the left side of every inequality must have.
        """
        blocks = [(A, 0 * A, b - margin * np.eye(len(b))) for A, b in map(self.block, self.listed)]
        objective, signed = np.zeros(blocks[0][0].shape[1]), self.signed
        for j, weight in weights.items():
            objective[signed[j]] = weight
        found = Minimum(objective, blocks, signed).at(0.0)
        return None if found is None else self.solution(found)

    def shortfall(self, solution: Unknowns) -> float:
        """Return 0 if a solution provably satisfies every inequality; otherwise the largest possible violation."""
        if len(solution.scalars) and not solution.scalars.min() >= 0:
            return float("inf")
        with np.errstate(all="ignore"):  # an overflow makes the proof fail
            return max((_shortfall(one, solution) for one in self.listed), default=0.0)

    def raised(self, solution: Unknowns, index: int) -> Unknowns:
        """Return a solution with one scalar increased until the scalar inequalities that contain it hold."""
        scalars = np.array(solution.scalars)
        for one in self.listed:
            weight = sum(float(S[0, 0]) for j, S in one.scalars if j == index)
            if len(one.constant) == 1 and weight > 0:
                value, size, operations = _evaluated(one, Unknowns(solution.matrices, scalars))
                least = float(value[0, 0]) - 8 * _gamma(operations) * float(size[0, 0])
                scalars[index] += max(0.0, -least) / weight * (1 + 4 * UNIT)
        return Unknowns(solution.matrices, scalars)

    def value(self, position: int, solution: Unknowns) -> Array:
        """Return the left-hand side of an inequality, computed for a given solution."""
        return _evaluated(self.listed[position], solution)[0]

    @property
    def signed(self) -> range:
        """Indices of the scalars in the vector of all unknowns."""
        first = sum(size * (size + 1) // 2 for size in self.sizes)
        return range(first, first + self.scalars)

    def solution(self, values: Array) -> Unknowns:
        """Return a solution (matrices and scalars) from the vector of all unknowns."""
        matrices: list[Array] = []
        at = 0
        for size in self.sizes:
            rows, columns = np.triu_indices(size)
            P = np.zeros((size, size))
            P[rows, columns] = P[columns, rows] = values[at : at + len(rows)]
            matrices.append(P)
            at += len(rows)
        return Unknowns(tuple(matrices), np.maximum(values[at:], 0.0))

    def block(self, one: Inequality) -> tuple[Array, Array]:
        """Return the coefficient matrix of the unknowns in an inequality, (n², unknowns), and its constant."""
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
    """Search for the solution with the largest common margin of inequalities that depend linearly on a parameter.

    They are interpolated between two lists of the same structure.

    Args:
        first: the inequalities at share 0.
        last: the inequalities at share 1; at other shares they are interpolated linearly.
    """

    def __init__(self, first: Inequalities, last: Inequalities) -> None:
        """Set up the problem; the margin is the last unknown, at most 1."""
        blocks: list[tuple[Array, Array, Array]] = []
        for (A, b), (B, _) in zip(map(first.block, first.listed), map(last.block, last.listed), strict=True):
            less = -np.eye(len(b)).reshape(-1, 1)
            blocks.append((np.hstack([A, less]), np.hstack([B - A, 0 * less]), b))
        objective = np.zeros(blocks[0][0].shape[1])
        objective[-1] = -1.0
        blocks.append((objective[None], 0 * objective[None], np.ones((1, 1))))
        self._first, self._minimum = first, Minimum(objective, blocks, first.signed)

    def at(self, share: float) -> Unknowns | None:
        """Return the solution at a parameter from 0 (first list) to 1 (last list), or None if no margin is positive."""
        found = self._minimum.at(share)
        return None if found is None or found[-1] <= 0 else self._first.solution(found[:-1])


def _shortfall(one: Inequality, solution: Unknowns) -> float:
    """Return 0 if the inequality provably holds; otherwise how far its least eigenvalue may be below 0.

    Every entry is computed with at most k operations, so its error is at most γ = ku/(1 − ku) times the sum of the
    absolute values of its terms. This bounds the norm of the error. The bound, and γ_{n+1}/(1 − γ_{n+1}) times the
    trace, are subtracted from the diagonal. If a Cholesky factorisation then succeeds, the inequality is proved
    [rump2006].
    """
    value, size, terms = _evaluated(one, solution)
    if not np.isfinite(size).all():
        return float("inf")
    n = len(value)
    rounding = 2 * _gamma(terms) * float(size.sum(axis=1).max(initial=0.0))  # 2: includes the rounding of ``size``
    factoring = 2 * _gamma(n + 2) * (float(np.abs(np.diag(value)).sum()) + n * rounding)
    allowance = rounding + factoring + np.finfo(np.float64).tiny
    try:
        np.linalg.cholesky(value - allowance * np.eye(n))
    except np.linalg.LinAlgError:
        least = float(np.linalg.eigvalsh(value)[0])
        return max(allowance - least, np.finfo(np.float64).tiny)
    return 0.0


def _evaluated(one: Inequality, solution: Unknowns) -> tuple[Array, Array, int]:
    """Return the left side, the sum of the absolute values of its terms, and the number of operations per entry."""
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
