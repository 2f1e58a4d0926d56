"""The one door to cvxpy, with types: linear matrix inequalities, solved by Clarabel. Both are an extra."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import numpy as np

from taciturn._arrays import Array
from taciturn.errors import ProblemError


def expect_solver() -> None:
    """Refuse to go on where what solves the inequalities is not installed.

    Raises:
        ProblemError: cvxpy or clarabel is missing.
    """
    _solver()


class Minimum:
    """The x that minimises objective'x where every block mat((A + share·S) x + b) ⪰ 0, for one share after another.

    cvxpy takes ten times as long to write such a problem down as Clarabel to solve it: it does so once for all shares.

    Args:
        objective: (unknowns,).
        blocks: (A, S, b) of each inequality, A and S (n², unknowns), b (n, n) symmetric.
        nonnegative: the unknowns that must not be negative.

    Raises:
        ProblemError: cvxpy or clarabel is missing.
    """

    def __init__(
        self, objective: Array, blocks: Sequence[tuple[Array, Array, Array]], nonnegative: Sequence[int]
    ) -> None:
        """Write the problem down."""
        cp = self._cp = _solver()
        self._x, self._share = cp.Variable(len(objective)), cp.Parameter(nonneg=True)
        listed: list[Any] = [self._x[list(nonnegative)] >= 0] if len(nonnegative) else []
        for A, S, b in blocks:
            value = A @ self._x + b.ravel() + (self._share * (S @ self._x) if S.any() else 0)
            n = len(b)
            listed.append(value >= 0 if n == 1 else cp.reshape(value, (n, n), order="C") >> 0)
        self._problem = cp.Problem(cp.Minimize(objective @ self._x), listed)

    def at(self, share: float) -> Array | None:
        """Return the x of a share, or None where the solver finds none.

        It satisfies the inequalities only to the precision of the solver: the callers verify it.
        """
        self._share.value = share
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the callers verify what they get
            try:
                self._problem.solve(solver=self._cp.CLARABEL, max_threads=1)
            except (self._cp.error.SolverError, ValueError, ArithmeticError):
                return None
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
            f"{error.name or 'cvxpy'} is not installed; expected it for certificates: pip install 'taciturn[certify]'"
        ) from None
