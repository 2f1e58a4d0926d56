"""Linear-quadratic problems in double precision: matrices, input weights, many steps at once, and structure.

One step back changes a cost-to-go K to Q + A'KA − (A'KB + N)H⁻¹(B'KA + N') with the weight H = R + B'KB of an input.
Many steps are a ``Span``: relative to a terminal weight X ≻ 0, they map a change Δ of it to K + F'Δ(I + GΔ)⁻¹F. Spans
compose, so that 2^k steps take k compositions (structured doubling).

Some states and inputs are left out before an equation is solved:

* States whose cost-to-go is exactly zero, for example registers that no noise reaches, and modes that nothing drives
  and that do not affect the cost. The cost of such a state has no natural size to which an error could be relative, and
  iterations only halve it towards zero. Which state affects which follows from the exact zeros of the matrices.
* Inputs that cost nothing, now or later. They move states within a subspace in which other such inputs keep them (the
  largest controllability subspace on which the cost is zero). For a filter, such an input is a combination of outputs
  that is known in advance. The weight H of such an input is zero, so no gain follows from the Riccati equation. The
  subspace is computed in rational numbers: a double is one, and so a rank of doubles has an exact answer.

Source: trentelman2001
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from flint import fmpq_mat

from taciturn import _arrays
from taciturn._arrays import NO_VARIANCE, Array, ArrayLike, Bits, is_definite, symmetrised
from taciturn._display import Displayed
from taciturn._modes import SCATTER, Modes, closure, eigenvalues, in_cycles, root
from taciturn._rational import (
    NONE,
    Limit,
    Lost,
    above,
    basis,
    beside,
    free_modes,
    is_semidefinite,
    kernel,
    lines,
    modes_of,
    pivots,
    rational,
    right_inverse,
)

_TURNS = 40  # 2^40 steps
_SETTLED = 1e-6  # last relative change; the remaining error is its square, which Newton's method squares again
_MARGIN = 1e-10  # least distance to the unit circle of a mode of rounded matrices that counts as decaying


class Quadratic(NamedTuple):
    """A linear-quadratic regulator problem with dynamics (A, B) and weights [[Q, N], [N', R]]."""

    A: Array
    B: Array
    Q: Array
    R: Array
    N: Array

    @classmethod
    def checked(cls, A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike) -> Quadratic:
        """Make a regulator problem of the given matrices, after checking their shapes and their symmetry."""
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
        """Return the regulator problem restricted to a subset of the states."""
        A, B, Q, R, N = self
        return Quadratic(A[np.ix_(states, states)], B[states], Q[np.ix_(states, states)], R, N[states])

    def beside(self, place: int, S: Array, P: Array) -> Quadratic:
        """Extend the problem by states z⁺ = S z + P u, which cost nothing and do not affect the other states."""
        kept, more = placed(len(self.A), place, len(S))
        A, B, Q, R, N = self
        return Quadratic(kept @ A @ kept.T + more @ S @ more.T, kept @ B + more @ P, kept @ Q @ kept.T, R, kept @ N)

    def back(self, K: Array) -> tuple[Array, Array]:
        """Return the cost-to-go one step before K with the optimal input, and by how much this input reduces it."""
        off = self.B.T @ K @ self.A + self.N.T
        saved = off.T @ price(self.B, K, self.R)[1] @ off
        return symmetrised(self.Q + self.A.T @ K @ self.A - saved), symmetrised(saved)

    def under(self, L: Array) -> tuple[Array, Array]:
        """Return A + BL and the weight of the state in the stage cost, if the input is u = L x."""
        stage = self.Q + self.N @ L + L.T @ self.N.T + L.T @ self.R @ L
        return self.A + self.B @ L, symmetrised(stage)


def placed(states: int, place: int, more: int) -> tuple[Array, Array]:
    """Return the matrices that write all states from the old ones and from ``more`` new ones, from ``place`` on."""
    old, new = np.split(np.eye(states + more), [states], axis=1)
    order = np.insert(np.arange(states), [place] * more, range(states, states + more))
    return old[order], new[order]


def price(B: Array, K: Array, R: Array) -> tuple[Array, Array]:
    """Return the input weight H = R + B'KB and its inverse; for a singular H, its pseudo-inverse."""
    # A diagonal entry counts as zero if it is smaller than the rounding of the products in its sum. The other entries
    # are scaled to a unit diagonal, so that the result does not depend on the units of the variables.
    H = symmetrised(R + B.T @ K @ B)
    diagonal = H.diagonal()
    products = (np.abs(B.T) @ np.sqrt(np.maximum(K.diagonal(), 0))) ** 2 + np.abs(R.diagonal())
    kept = diagonal > np.maximum(1e-14 * products, NO_VARIANCE)
    scale = 1 / np.sqrt(diagonal) if kept.all() else np.where(kept, 1 / np.sqrt(np.where(kept, diagonal, 1.0)), 0.0)
    values, vectors = np.linalg.eigh(H * scale * scale[:, None])
    # If R is definite, every direction counts; otherwise a small eigenvalue may be the error of a computed K.
    vectors = scale[:, None] * vectors
    inside = values > 1e-10 * len(diagonal)
    if not inside.all():
        if is_definite(R):
            inside = values > 1e-15 * len(diagonal)
        values, vectors = values[inside], vectors[:, inside]
    return H, (vectors / values) @ vectors.T


class Span(NamedTuple):
    """Several steps with optimal inputs, as a map: the cost-to-go after them, X + Δ, determines the one before them."""

    # The cost-to-go before the steps is X + K + F'Δ(I + GΔ)^{-1}F. With X ≻ 0, the input weight R + B'XB is definite
    # even if R is not. A stack of problems has stacks of matrices.

    F: Array  # the states after the steps, for Δ = 0
    G: Array  # how a later Δ changes these states
    K: Array  # the cost-to-go before the steps, less X, for Δ = 0

    @classmethod
    def of(cls, given: Quadratic, last: Array, inverse: Array) -> Span:
        """Return the map of one step: F = A + BL, G = BH^{-1}B', K = Ric(X) − X, with L = −H^{-1}(B'XA + N')."""
        A, B, Q, _, N = given
        off = B.T @ last @ A + N.T
        K = Q - last + A.T @ last @ A - off.T @ inverse @ off
        return cls(A - B @ inverse @ off, symmetrised(B @ inverse @ B.T), symmetrised(K))

    def then(self, later: Span) -> Span:
        """Combine these steps with the steps that follow them."""
        return self._through(later, *self._onto(later.K))

    def before(self, change: Array) -> Array:
        """Return the change Δ of the cost-to-go before the steps that a change after the steps causes."""
        return self._onto(change)[0]

    def _onto(self, change: Array) -> tuple[Array, Array]:
        """Return the Δ before the steps, and (I + GΔ)^{-1}[F, G]."""
        n = self.F.shape[-1]
        solved = _divided(np.eye(n) + self.G @ change, np.concatenate([self.F, self.G], axis=-1))
        return symmetrised(self.K + self.F.mT @ change @ solved[..., :n]), solved

    def _through(self, later: Span, K: Array, solved: Array) -> Span:
        n = self.F.shape[-1]
        return Span(later.F @ solved[..., :n], later.G + later.F @ solved[..., n:] @ later.F.mT, K)

    def for_ever(self, last: Array, crumb: Array | float = 0.0) -> Array:
        """Return the limit of the cost-to-go if the steps are repeated infinitely often; infinite or NaN without a
        limit.
        """
        # Each iteration doubles the number of steps, and leaves the square of the error before.
        span, worth = self, np.diag(last)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for _ in range(_TURNS):
                K, solved = span._onto(span.K)
                found, more = (np.diagonal(part, axis1=-2, axis2=-1) for part in (K, K - span.K))
                if not (np.abs(more) > _SETTLED * np.abs(worth + found) + crumb).any():
                    return symmetrised(last + K)  # also if entries are not finite
                span = span._through(span, K, solved)
        return symmetrised(last + span.K)


def _divided(matrix: Array, right: Array) -> Array:
    """Return M^{-1}R for one matrix or a stack; NaN for singular matrices, without effect on other matrices."""
    try:
        return np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)
    except np.linalg.LinAlgError:
        if matrix.ndim == 2:
            return np.full_like(right, np.nan)
        return np.stack([_divided(one, part) for one, part in zip(matrix, right, strict=True)])


def in_powers_of_two(sizes: Array) -> Array:
    """Round 1/√size to powers of two. In these units, a form with the diagonal ``size`` has entries near 1."""
    return np.exp2(-np.round(np.log2(np.where(sizes > 0, sizes, 1.0)) / 2))


class Worth(NamedTuple):
    """Partition of the states into those with and those without a cost-to-go, and the modes of the latter."""

    states: Bits  # the states with a cost-to-go, for which the equation must be solved, (n,)
    decaying: Modes  # decaying modes of the other states
    still: Modes  # marginally stable modes of the other states; no input affects them, so that they remain in the loop
    resting: Bits  # the states with these marginally stable modes, (n,)


Before: TypeAlias = tuple[Quadratic, Limit]  # a problem before sampling and discount, and the edge of its modes


def worth_of(given: Quadratic, continuous: bool = False, rounded: bool = True, before: Before | None = None) -> Worth:
    """Find the states with a nonzero cost-to-go, and the modes of all other states."""
    # A state x has no cost-to-go, Kx = 0, if it needs no input: neither the state nor any state that it affects has a
    # weight, and all their modes decay, or are marginally stable and not affected by an input. Modes are computed for
    # sets of states that affect each other in cycles, so that a chain of registers has the mode 0 for any length.
    nothing = np.zeros(0, dtype=np.complex128)
    moved = np.asarray(given.A != 0, dtype=np.bool_)  # entry (i, j): state j affects state i
    needed = closure((given.Q != 0).any(axis=0) | (given.N != 0).any(axis=1), moved.T)
    resting = np.zeros(len(needed), dtype=np.bool_)
    if needed.all():
        return Worth(needed, nothing, nothing, resting)
    reached = closure((given.B != 0).any(axis=1), moved)
    cycles: list[tuple[Bits, Lost]] = []
    decaying, still = [nothing], [nothing]
    for cycle in in_cycles(moved):
        if needed[cycle].any():
            continue
        A = given.A[np.ix_(cycle, cycle)]
        modes = _modes_of(A, continuous, rounded) if before is None else _sampled(*before, cycle)
        cycles.append((cycle, modes))
        if modes.growing.size or (modes.staying.size and reached[cycle].any()):
            needed = closure(needed | cycle, moved.T)
    for cycle, modes in cycles:
        if not needed[cycle].any():
            decaying.append(modes.decaying)
            still.append(modes.staying)
            if modes.staying.size:
                resting = resting | cycle
    return Worth(needed, np.concatenate(decaying), np.concatenate(still), resting)


def _modes_of(A: Array, continuous: bool, rounded: bool) -> Lost:
    """Return the modes of states that affect each other, on each side of the stability limit."""
    if not rounded:
        return free_modes(A, Limit(continuous))
    modes = eigenvalues(A)
    outside = modes.real if continuous else np.abs(modes) - 1
    margin, scatter = (0.0, 0.0) if len(A) == 1 else (0.0 if continuous else _MARGIN, SCATTER)
    growing, decaying = outside > scatter, outside < -margin
    return Lost(modes[growing], modes[~growing & ~decaying], modes[decaying])


def _sampled(given: Quadratic, limit: Limit, cycle: Bits) -> Lost:
    """Return the modes of some states from step to step, on the sides of the limit that they have before sampling."""
    found, root = free_modes(given.A[np.ix_(cycle, cycle)], limit), np.sqrt(limit.discount)
    return Lost(*(root * np.exp(modes * limit.period) for modes in found))


@dataclass(frozen=True, eq=False, repr=False)
class Free(Displayed):
    """Inputs that never cause a cost, and the subspace of states that they can reach."""

    # A state x = inside·a + e has coordinates a, its entries at ``places``, and a rest e that is zero there. The inputs
    # u = keeping·a + moving·w cost nothing, and move a to (A x + B u) at ``places``.

    inside: fmpq_mat  # a basis of the subspace, the identity at ``places``, (n, r)
    places: Bits  # mask of the states that are coordinates of the subspace, (n,)
    keeping: fmpq_mat  # inputs that keep the columns of ``inside`` in the subspace without cost, (m, r)
    moving: fmpq_mat  # inputs that move the state within the subspace without cost, (m, f)
    others: Bits  # mask of inputs that complete ``moving`` to all inputs, (m,)


def unpaid(given: Quadratic, limit: Limit) -> Lost:
    """Return the modes with which inputs can keep the state moving without cost; none if some inputs cost nothing."""
    # They are the eigenvalues of the problem on the largest subspace in which inputs keep the state without cost, the
    # invariant zeros of (A, B, [C, D]) with the weight [C, D]'[C, D] of states and inputs. The closed loop of an
    # optimal gain has them, mirrored into the region of decay. So none of them may lie on its edge.
    definite, weight = is_definite(given.R), np.block([[given.Q, given.N], [given.N.T, given.R]])
    if limit.continuous and not definite:
        return NONE  # free inputs move the state at once, but not an input that is held
    rows = rational(weight if is_semidefinite(weight) else root(weight).T)
    if not definite and free_inputs(given, rows) is not None:
        return NONE
    safe, A, B, state, push = _kept_for_nothing(given, rows)
    r = safe.ncols()
    if not r:
        return NONE
    after = fmpq_mat(rows.nrows(), r)
    found = kernel(above(beside(state * safe, push, after), beside(A * safe, B, safe * -1)))
    now, later = lines(found, range(r)), lines(found, range(found.nrows() - r, found.nrows()))
    return modes_of(later * now.inv(), limit)


def _kept_for_nothing(given: Quadratic, rows: fmpq_mat) -> tuple[fmpq_mat, fmpq_mat, fmpq_mat, fmpq_mat, fmpq_mat]:
    """Return a basis of the states that inputs keep at no cost for ever; A and B; rows of the states and the inputs."""
    n, A, B, turned = len(given.A), rational(given.A), rational(given.B), rows.transpose()
    state, push = (lines(turned, some).transpose() for some in (range(n), range(n, turned.nrows())))
    safe, nothing = rational(np.eye(n)), fmpq_mat(rows.nrows(), n)
    while True:
        found = kernel(above(beside(state, push, nothing), beside(A, B, safe * -1)))
        smaller = basis(lines(found, range(n)))
        nothing = fmpq_mat(rows.nrows(), smaller.ncols())
        if smaller.ncols() == safe.ncols():
            return safe, A, B, state, push
        safe = smaller


def free_inputs(given: Quadratic, rows: fmpq_mat) -> Free | None:
    """Find the inputs that cost nothing, now and later; return None if there are no such inputs."""
    (n, m), z = given.B.shape, rows.nrows()
    safe, A, B, state, push = _kept_for_nothing(given, rows)
    inside, keeping, nothing = fmpq_mat(n, 0), fmpq_mat(m, 0), fmpq_mat(z, safe.ncols())
    while True:  # states that they reach from zero meanwhile
        r = inside.ncols()
        found = kernel(above(beside(state * inside, push, nothing), beside(A * inside, B, safe * -1)))
        larger = basis(safe * lines(found, range(r + m, found.nrows())))
        if larger.ncols() == r:
            break
        inside = larger
    r = inside.ncols()
    nothing = fmpq_mat(z, r)
    moving = basis(lines(kernel(above(beside(push, nothing), beside(B, inside * -1))), range(m)))
    if not moving.ncols():
        return None
    found = kernel(above(beside(state * inside, push, nothing), beside(A * inside, B, inside * -1)))
    keeping = lines(found, range(r, r + m)) * right_inverse(lines(found, range(r)))
    return Free(inside, pivots(inside), keeping, moving, ~pivots(moving))
