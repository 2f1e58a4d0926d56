"""Typed interface to cvxpy and Clarabel, optional dependencies that solve linear matrix inequalities."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import numpy as np

from taciturn._arrays import Array
from taciturn._progress import check_time, seconds_left
from taciturn.errors import ProblemError


def expect_solver() -> None:
    """Check that the solver for matrix inequalities is installed.

    Raises:
        ProblemError: cvxpy or clarabel is missing.
    """
    _solver()


class Minimum:
    """A semidefinite program with a given share: minimise objective'x so that all blocks mat((A + share·S) x + b) ⪰ 0.

    cvxpy takes ten times as long to build such a problem as Clarabel takes to solve it, so it is built only once.

    Args:
        objective: coefficients of the objective, (unknowns,).
        blocks: (A, S, b) of each inequality, with A and S (n², unknowns) and b (n, n) symmetric.
        nonnegative: indices of the unknowns that must be nonnegative.

    Raises:
        ProblemError: cvxpy or clarabel is missing.
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
        """Return the solution x for a value of the share, or None if the solver finds none.

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
            f"{error.name or 'cvxpy'} is not installed, but certificates require it: pip install 'taciturn[certify]'"
        ) from None
