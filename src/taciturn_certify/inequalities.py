"""Linear matrix inequalities: a numerical solver finds a solution, and interval arithmetic proves that it is one.

cvxpy and Clarabel, optional dependencies, find a solution (``Minimum``). The left side of each inequality is enclosed
for the solution as it is stored: in double precision with bounds on every rounding, and in balls where these bounds are
too wide. An inequality counts only if its enclosure is proved to be definite.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Array, Displayed, check_time, precision, seconds_left
from taciturn.lqg.enclosures import PRECISIONS, UNIT, Balls, Doubles, E, UnprovedError


def expect_solver() -> None:
    """Raise an error if no solver for semidefinite programs is installed."""
    _solver()


class Minimum:
    """Semidefinite program: minimise objective'x so that every mat((A + share·S) x + b) ⪰ 0, for a parameter ``share``.

    cvxpy takes ten times as long to build such a problem as Clarabel takes to solve it, so it is built only once.
    """

    def __init__(
        self, objective: Array, blocks: Sequence[tuple[Array, Array, Array]], nonnegative: Sequence[int]
    ) -> None:
        """Build the problem."""
        cp = self._cp = _solver()
        self._x, self._share = cp.Variable(len(objective)), cp.Parameter(nonneg=True)
        listed: list[Any] = [self._x[list(nonnegative)] >= 0] if len(nonnegative) else []
        for A, S, b in blocks:
            value = A @ self._x + b.ravel() + (self._share * (S @ self._x) if S.any() else 0)
            n = len(b)
            listed.append(value >= 0 if n == 1 else cp.reshape(value, (n, n), order="C") >> 0)
        self._problem = cp.Problem(cp.Minimize(objective @ self._x), listed)

    def at(self, share: float) -> Array | None:
        """Solve the program for one value of ``share``; return None if the solver finds no solution.

        The solution satisfies the inequalities only to the precision of the solver, so the caller must verify it.
        """
        self._share.value = share
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the caller verifies the solution
            try:
                self._problem.solve(solver=self._cp.CLARABEL, max_threads=1, time_limit=seconds_left())
            except (self._cp.error.SolverError, ValueError, ArithmeticError):
                return None
            finally:
                check_time()
        if self._x.value is None or self._problem.status not in ("optimal", "optimal_inaccurate"):
            return None
        found = np.asarray(self._x.value, dtype=np.float64)
        return found if np.isfinite(found).all() else None


def _solver() -> Any:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import_module("clarabel")
            return import_module("cvxpy")
    except ImportError as error:
        raise ProblemError(
            f"the package {error.name or 'cvxpy'} is not installed, but certificates require it: pip install "
            "'taciturn[certify]'"
        ) from None


Square = tuple[float, int, Array]
"""The triple (weight, k, T) of a term weight · T'P_kT."""


@dataclass(frozen=True, eq=False, repr=False)
class Inequality(Displayed):
    """Linear matrix inequality: constant + Σ weight·T'P_kT + Σ s_j S_j ⪰ 0 with matrices P_k and scalars s_j."""

    constant: Array  # symmetric matrix, (n, n)
    squares: Sequence[Square] = ()  # the triple (weight, k, T) of each term with an unknown matrix
    scalars: Sequence[tuple[int, Array]] = ()  # the pair (j, S) of each term with an unknown scalar


@dataclass(frozen=True, eq=False, repr=False)
class Unknowns(Displayed):
    """Values of the unknowns of matrix inequalities: symmetric matrices and non-negative scalars."""

    matrices: tuple[Array, ...]
    scalars: Array


@dataclass(frozen=True, eq=False, repr=False)
class Inequalities(Displayed):
    """Linear matrix inequalities in symmetric matrices P_k and scalars s_j ≥ 0."""

    sizes: tuple[int, ...]  # sizes of the unknown matrices P_k
    scalars: int  # number of the unknown scalars
    listed: tuple[Inequality, ...]  # the inequalities

    def minimise(self, weights: Mapping[int, float], margin: float) -> Unknowns | None:
        """Minimise Σ weight·scalar so that each inequality holds with a margin; return None if that is impossible."""
        blocks = [(A, 0 * A, b - margin * np.eye(len(b))) for A, b in map(self.block, self.listed)]
        objective, signed = np.zeros(blocks[0][0].shape[1]), self.signed
        for j, weight in weights.items():
            objective[signed[j]] = weight
        found = Minimum(objective, blocks, signed).at(0.0)
        return None if found is None else self.solution(found)

    def shortfall(self, solution: Unknowns) -> float:
        """Return 0 if a solution provably satisfies every inequality, otherwise a bound on the largest violation."""
        if len(solution.scalars) and not solution.scalars.min() >= 0:
            return float("inf")
        return max((_shortfall(one, solution) for one in self.listed), default=0.0)

    def raised(self, solution: Unknowns, index: int) -> Unknowns:
        """Return a solution in which one scalar is increased until every scalar inequality that contains it holds."""
        scalars = np.array(solution.scalars)
        for one in self.listed:
            weight = sum(float(S[0, 0]) for j, S in one.scalars if j == index)
            if len(one.constant) == 1 and weight > 0:
                value = _enclosed(Doubles, one, Unknowns(solution.matrices, scalars))
                short = float(value.radius[0, 0] - value.middle[0, 0]) / weight
                # the enclosure of the raised sum is wider than that of this one, by the roundings of the added part
                scalars[index] += max(0.0, short) * (1 + 16 * UNIT) + 4 * UNIT * float(scalars[index])
        return Unknowns(solution.matrices, scalars)

    def value(self, position: int, solution: Unknowns) -> Array:
        """Evaluate the matrix on the left-hand side of an inequality ⪰ 0 for a given solution."""
        return _enclosed(Doubles, self.listed[position], solution).middle

    @property
    def signed(self) -> range:
        """Indices of the scalars s_j among all unknowns; the solver keeps these entries non-negative."""
        first = sum(size * (size + 1) // 2 for size in self.sizes)
        return range(first, first + self.scalars)

    def solution(self, values: Array) -> Unknowns:
        """Split a vector of all unknowns into the matrices and the scalars of a solution."""
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
        """Return the coefficients of the unknowns in an inequality, shape (n², unknowns), and its constant term."""
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
    """Search for the solution of matrix inequalities with the largest margin; the inequalities depend on a parameter.

    The inequalities are interpolated between two lists of the same structure.
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
        """Solve the inequalities for a parameter value from 0 to 1; return None if no solution with a margin exists."""
        found = self._minimum.at(share)
        return None if found is None or found[-1] <= 0 else self._first.solution(found[:-1])


def _shortfall(one: Inequality, solution: Unknowns) -> float:
    """Return 0 if the inequality is proved; otherwise how far its least eigenvalue may be below 0."""
    with np.errstate(all="ignore"):
        try:
            value = _enclosed(Doubles, one, solution)
        except UnprovedError:
            return float("inf")
    if value.definite():
        return 0.0
    least, width = float(np.linalg.eigvalsh(value.middle)[0]), float(value.radius.sum(axis=1).max())
    if least > -width:  # rounding could explain the violation
        with precision(PRECISIONS[0]):
            if _enclosed(Balls, one, solution).definite():
                return 0.0
    return max(width - least, float(np.finfo(np.float64).tiny))


def _enclosed(arithmetic: type[E], one: Inequality, solution: Unknowns) -> E:
    """Return an enclosure of the left side of an inequality for a solution."""
    value = arithmetic.exact(one.constant)
    for weight, k, T in one.squares:
        turned = arithmetic.exact(T)
        value = value + (turned.T @ arithmetic.exact(solution.matrices[k]) @ turned).times(weight)
    for j, S in one.scalars:
        value = value + arithmetic.exact(S).times(float(solution.scalars[j]))
    return value.symmetric()
