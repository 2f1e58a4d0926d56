"""Coordinates in which the matrices of a regulator problem have entries of similar size.

They are units that are powers of two, or principal axes of the cost.

All decisions of the solvers use these coordinates, so that results do not depend on the units of a problem.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from taciturn import _arrays
from taciturn._arrays import NO_VARIANCE, Array, ArrayLike, Bits, symmetrised
from taciturn._modes import ROUNDOFF, reach

CRUMB = 1e-13  # cost relative to the products in its sum, below which it counts as their rounding
VANISHING = 1e-40  # cost relative to its natural size, below which an iteration has driven it to zero
FLAT = 1e-12  # relative eigenvalue of a cost in its own units, below which axes cannot be distinguished


class Quadratic(NamedTuple):
    """A linear-quadratic regulator problem: dynamics (A, B) and weights [[Q, N], [N', R]]."""

    A: Array
    B: Array
    Q: Array
    R: Array
    N: Array

    @classmethod
    def checked(cls, A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike) -> Quadratic:
        """Return the regulator problem with the given matrices, after a check of their shapes and symmetry.

        Raises:
            ProblemError: data of the wrong shape or not finite, or Q or R is not symmetric.
        """
        A = _arrays.square("A", A, "states × states")
        B = _arrays.array("B", B, (len(A), None), "states × inputs")
        n, m = B.shape
        return cls(
            A,
            B,
            _arrays.symmetric("Q", Q, n, "states × states"),
            _arrays.symmetric("R", R, m, "inputs × inputs"),
            _arrays.array("N", N, (n, m), "states × inputs"),
        )

    def among(self, states: Bits) -> Quadratic:
        """Return the regulator problem restricted to some of the states."""
        A, B, Q, R, N = self
        return Quadratic(A[np.ix_(states, states)], B[states], Q[np.ix_(states, states)], R, N[states])

    def under(self, L: Array) -> tuple[Array, Array]:
        """Return the closed-loop matrix A + BL for a gain L, and the weight of the state in its stage cost."""
        stage = self.Q + self.N @ L + L.T @ self.N.T + L.T @ self.R @ L
        return self.A + self.B @ L, symmetrised(stage)

    def terms(self, L: Array) -> Array:
        """Return, for each state, the sum of the absolute values of the terms in its stage cost, (n,)."""
        size = np.abs(L)
        pushed = 2 * np.abs(self.N.T) + np.abs(self.R) @ size
        return np.asarray(np.abs(self.Q.diagonal()) + (size * pushed).sum(axis=0), dtype=np.float64)

    def moved(self, K: Array, L: Array) -> Array:
        """Return, for each state, a bound on the cost-to-go one step later, from absolute values of A and BL, (n,)."""
        size = np.abs(self.A) + np.abs(self.B) @ np.abs(L)
        return np.asarray((np.sqrt(np.maximum(K.diagonal(), 0.0)) @ size) ** 2, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Axes:
    """Change of coordinates of a regulator problem: x = T z for the state and u = units·v for the input.

    Args:
        T: transformation of the state, (n, n).
        inverse: T^{-1}, (n, n).
        units: units of the inputs, powers of two, (m,).
    """

    T: Array
    inverse: Array
    units: Array

    def problem(self, given: Quadratic) -> Quadratic:
        """Convert a regulator problem to these coordinates; this is exact if T contains only powers of two."""
        A, B, Q, R, N = given
        return Quadratic(
            self.inverse @ A @ self.T,
            self.inverse @ B * self.units,
            symmetrised(self.T.T @ Q @ self.T),
            R * self.units * self.units[:, None],
            self.T.T @ N * self.units,
        )

    def then(self, inner: Axes) -> Axes:
        """Return the composition of this change of coordinates with the subsequent change ``inner``."""
        return Axes(self.T @ inner.T, inner.inverse @ self.inverse, self.units * inner.units)

    def sizes(self, given: Quadratic) -> tuple[Array, Array]:
        """Return the sums of the absolute terms in each entry of A and Q in these coordinates, to bound rounding."""
        T, inverse = np.abs(self.T), np.abs(self.inverse)
        return inverse @ np.abs(given.A) @ T, T.T @ np.abs(given.Q) @ T

    def gain(self, L: Array) -> Array:
        """Convert a gain from the original coordinates to these coordinates."""
        return L @ self.T / self.units[:, None]

    def gain_from(self, L: Array) -> Array:
        """Convert a gain from these coordinates to the original coordinates."""
        return self.units[:, None] * (L @ self.inverse)

    def form_from(self, K: Array) -> Array:
        """Convert the matrix of a quadratic form of the state from these coordinates to the original ones."""
        return symmetrised(self.inverse.T @ K @ self.inverse)

    def price_from(self, H: Array) -> Array:
        """Convert the matrix of a quadratic form of the input from these units to the original units."""
        return H / self.units / self.units[:, None]


def units_of_reach(given: Quadratic) -> Axes:
    """Return units of states and inputs in which inputs of unit size move each state by about 1."""
    state, inputs = reach(given.A, given.B)
    return Axes(np.diag(state), np.diag(1 / state), inputs)


def units_of_weight(given: Quadratic) -> Axes:
    """Return units of the states in which the cost weight of each state, or of states that it affects, is about 1."""
    natural = _spread(given.A, np.maximum(given.Q.diagonal(), 0.0))
    units = _power_of_two(np.sqrt(natural))
    pushed = given.R.diagonal() + natural @ given.B**2
    return Axes(np.diag(units), np.diag(1 / units), _power_of_two(np.sqrt(np.maximum(pushed, 0.0))))


def rounding_floor(given: Quadratic, K: Array, L: Array) -> Array:
    """Return, for each state, a cost-to-go that counts as zero because of rounding and slow convergence, (n,).

    A state with a weight in Q has at least this cost. The natural size of the cost of another state follows from the
    weight of the inputs that affect it, or from the states that it affects.

    Args:
        given: the problem.
        K: the cost-to-go.
        L: the gain, which determines the rounding of the stage cost and of the cost of the next state.
    """
    weight = np.maximum(given.Q.diagonal(), 0.0)
    rounding = np.maximum(CRUMB * given.terms(L), (4 * len(K) * ROUNDOFF) ** 2 * given.moved(K, L))
    if (weight > 0).all():
        return rounding
    moved = np.where(given.B != 0, np.abs(given.B), np.inf)
    natural = _spread(given.A, np.maximum(weight, np.max(given.R.diagonal() / moved / moved, axis=1, initial=0.0)))
    return np.maximum(np.where(weight > 0, 0.0, VANISHING * natural), rounding)


def units_of(F: Array, K: Array, H: Array, least: Array) -> Axes:
    """Return units in which the cost-to-go K of a closed loop and its input weight H have diagonal entries near 1.

    A state without cost gets the unit of the states that affect it.

    Args:
        F: closed loop of a step, or in continuous time divided by its pace, (n, n).
        K: cost-to-go, semidefinite up to rounding, (n, n).
        H: weight of the inputs, semidefinite up to rounding, (m, m).
        least: for each state the cost that counts as zero, (n,).
    """
    diagonal = K.diagonal()
    spread = np.sqrt(np.where(diagonal > least, diagonal, 0.0))
    spread = np.maximum(spread, np.sqrt(CRUMB) * (np.abs(F).T @ spread))
    units = _power_of_two(spread)
    if not (spread > 0).all():
        reached = np.max(np.abs(F) * np.where(spread > 0, units, 0.0), axis=1, initial=0.0)
        units = np.where(spread > 0, units, 1 / _power_of_two(reached))
    return Axes(np.diag(units), np.diag(1 / units), _power_of_two(np.sqrt(np.maximum(H.diagonal(), 0.0))))


def principal_axes(of: Axes, K: Array) -> Axes:
    """Return the principal axes of a cost-to-go K, each scaled to unit cost; K is given in the coordinates ``of``."""
    values, vectors = np.linalg.eigh(K)
    largest = float(values[-1]) if values[-1] > NO_VARIANCE else 1.0
    units = _power_of_two(np.sqrt(np.maximum(values, FLAT * largest)))
    return Axes(of.T @ vectors * units, (vectors / units).T @ of.inverse, of.units)


def _spread(A: Array, weight: Array) -> Array:
    """Return the weight of each state; a state without a weight gets that of the states that it affects."""
    for _ in range(len(weight)):
        if (weight > 0).all():
            break
        weight = np.where(weight > 0, weight, np.max(A.T**2 * weight, axis=1, initial=0.0))
    return weight


def _power_of_two(sizes: Array) -> Array:
    """Return 1/size, rounded to powers of two; 1 for a size of 0."""
    return np.exp2(-np.round(np.log2(np.where(sizes > 0, sizes, 1.0))))
