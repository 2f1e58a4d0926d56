"""Regulator equations: states and inputs at which external signals, which no input affects, cause no cost.

Let d⁺ = Sd be such signals, and x⁺ = Ax + Bu + Ed the other states. Suppose that

    AX + BU + E = XS,   Z [X; U] + F = 0.

Then x = Xd and u = Ud remain so for every d, and Z [x; u] + F d stays zero. These equations are linear in X and U, and
``Resting`` sets them up for all who need their solution:

* ``regulator_equations``: Z contains the outputs z of a plant with disturbances and set-points. If solutions are free,
  that of least cost is taken;
* ``followed``: Z contains the derivatives of a stage cost with respect to x and u, so that Xd and Ud cost nothing. The
  signals need no label: they are found among the states of a plant by what moves them and by how they decay;
* the point at which a given controller rests (``base.given_controller``): S = 1.

If x = Xd and u = Ud cost nothing, the deviations x − Xd and u − Ud have the dynamics and the cost of the problem
without d. The regulator of this problem is u = L(x − Xd) + Ud, and its cost-to-go (x − Xd)'K(x − Xd), also if d never
decays.

A disturbance that decays may be among the states x if an input cannot cancel its effect, such as its movement between
samples. It may move d, d⁺ = Sd + Dx, if it stays at rest where x = Xd; then D X = 0, and the deviations have the
dynamics A − XD.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numpy as np

from taciturn._arrays import Array, Bits
from taciturn._display import Displayed
from taciturn._modes import balancing, closure, paths, reach
from taciturn._rational import Limit, free_modes
from taciturn.errors import ProblemError
from taciturn.lqg.quadratic import Quadratic
from taciturn.lqg.sampling import Exact

FORGETS = 24  # 2^24 steps after which noise without a remaining effect is forgotten
ROUNDS = 1e-12  # entry of X or U, relative to the largest, that counts as zero
CANCELS = 1e-9  # relative residual of the equations for X and U
CRUMB = 1e-13  # entry of X or U, relative to the largest for the same state of d, that is a rounding error
FREE = 1e-10  # relative singular value below which a direction is free
EXACTLY = 1e-13  # relative cost left that is rounding


class Resting(NamedTuple):
    """The linear equations A X + B U + E = X S and Z [X; U] + F = 0, for all entries of X and U as one vector."""

    matrix: Array
    right: Array
    sizes: tuple[int, int, int]  # numbers of states, inputs and signals

    @classmethod
    def of(cls, A: Array, B: Array, S: Array, E: Array, *wanted: tuple[Array, Array]) -> Resting:
        """Set up the equations. Each pair (Z, F) in ``wanted`` adds an equation Z [X; U] + F = 0."""
        n, m = B.shape
        same: Array = np.eye(len(S))
        rows = [np.hstack([np.kron(same, A) - np.kron(S.T, np.eye(n)), np.kron(same, B)])]
        rows += [np.hstack([np.kron(same, Z[:, :n]), np.kron(same, Z[:, n:])]) for Z, _ in wanted]
        matrix = np.asarray(np.vstack(rows), dtype=np.float64)
        right = -np.concatenate([E.T.ravel(), *(F.T.ravel() for _, F in wanted)])
        if not (np.isfinite(matrix).all() and np.isfinite(right).all()):
            raise ProblemError(
                "the effects of disturbances or set-points on each other differ by a factor beyond the range of "
                "double precision; expected effects of similar size, for example with a faster or a constant "
                "disturbance"
            )
        return cls(matrix, right, (n, m, len(S)))

    def smallest(self) -> Array:
        """Return the least-squares solution of the equations that has the smallest norm."""
        return np.asarray(np.linalg.lstsq(self.matrix, self.right, rcond=None)[0], dtype=np.float64)

    def missed(self, vector: Array) -> float:
        """Return the largest residual of the equations at a vector."""
        return float(np.abs(self.matrix @ vector - self.right).max(initial=0.0))

    def split(self, vector: Array) -> tuple[Array, Array]:
        """Split the vector of unknowns into the matrices X and U."""
        n, m, q = self.sizes
        return vector[: n * q].reshape(q, n).T, vector[n * q :].reshape(q, m).T


def regulator_equations(
    A: Array, B: Array, S: Array, E: Array, outputs: Array, F: Array, weight: Array, D: Array | None = None
) -> tuple[Array, Array]:
    """Solve A X + B U + E = X S and C_z X + D_z U + F = 0. If there are several solutions, return the cheapest one."""
    n, m = B.shape
    # A state that neither inputs nor signals move is no part of x = X d, also if it is constant as d is: a constant
    # state at the inputs would otherwise hold the set-point at no cost.
    moved = closure(np.asarray(B.any(axis=1) | E.any(axis=1)), A != 0)
    if moved.any() and not moved.all():
        kept = np.flatnonzero([*moved, *[True] * m])
        seen = outputs[:, moved]
        X, U = regulator_equations(
            A[np.ix_(moved, moved)], B[moved], S, E[moved], seen, F, weight[np.ix_(kept, kept)], D
        )
        found = np.zeros((n, len(S)))
        found[moved] = X
        return found, U
    state, unit = reach(A, B)  # so that the result does not depend on the units
    units = np.concatenate([state, unit])
    A, B, E = A / state[:, None] * state, B / state[:, None] * unit, E / state[:, None]
    direct = np.zeros((len(outputs), m)) if D is None else D
    both: Array = np.hstack([outputs * state, direct * unit])
    sizes = np.maximum(np.abs(both).max(axis=1, initial=0.0), 1e-300)
    wanted = [(Z[None] / size, row[None] / size) for Z, row, size in zip(both, F, sizes, strict=True)]

    def reaching(count: int) -> tuple[Resting, Array]:
        rest, i = Resting.of(A, B, S, E, *wanted[:count]), count - 1
        found = rest.smallest()
        if rest.missed(found) > CANCELS * max(1.0, float(np.abs(found).max(initial=0.0))):
            more = "" if D is None else f" + {direct[i].tolist()} u"
            what = "the state" if i < 0 else f"output {i} of the reference, {outputs[i].tolist()} x{more},"
            more = "" if i < m else f" ({i + 1} outputs, {m} inputs)"
            raise ProblemError(
                f"no input keeps {what} free of the disturbances and at its set-point{more}; expected at most as many "
                "reference.outputs as inputs, each affected by an input, and disturbances that the inputs can cancel"
            )
        return rest, found

    for count in range(len(wanted)):  # one after the other, so that a message names the first that is not possible
        reaching(count)
    rest, found = reaching(len(wanted))
    same: Array = np.eye(len(S))
    scaled = weight * np.outer(units, units)
    weights = np.block(
        [
            [np.kron(same, scaled[:n, :n]), np.kron(same, scaled[:n, n:])],
            [np.kron(same, scaled[n:, :n]), np.kron(same, scaled[n:, n:])],
        ]
    )
    _, values, turned = np.linalg.svd(rest.matrix)
    free = np.asarray(turned[int((values > FREE * values.max(initial=1e-300)).sum()) :].T, dtype=np.float64)
    if free.shape[1]:
        found = found - free @ np.linalg.lstsq(free.T @ weights @ free, free.T @ weights @ found, rcond=None)[0]
    X, U = rest.split(found)
    solved = np.asarray(np.vstack([X, U]), dtype=np.float64)
    least = CRUMB * _sizes(solved, S)
    X, U = (np.where(np.abs(part) > least, part, 0.0) for part in (X, U))  # the cost has no weight on crumbs of d
    return X * state[:, None], U * unit[:, None]


def _sizes(found: Array, S: Array) -> Array:
    """Return the largest effect of the states of each disturbance, in the units of each of its states, (q,)."""
    unit = balancing(S)
    together = paths(np.asarray((S != 0) | (S.T != 0), dtype=np.bool_))
    largest = np.abs(found * unit).max(axis=0, initial=0.0)
    return np.where(together, largest, 0.0).max(axis=1, initial=0.0) / unit


@dataclass(frozen=True, eq=False, repr=False)
class Followed(Displayed):
    """A problem in the deviations of its states and inputs from those that cost nothing."""

    states: Bits  # mask of the states d, (n,)
    T: Array  # matrix of the deviations (x − Xd, d) in the order of the states, (n, n)
    U: Array  # inputs that cost nothing, zero for the states x, (m, n)
    problem: Quadratic  # the problem in the deviations, in which the states d have no cost
    exact: Exact | None = None  # the problem in the deviations to any precision; None if its doubles are exact

    @property
    def inputs(self) -> Array:
        """Matrix, (m, n), that maps the states to the inputs that cost nothing, without rounding errors."""
        return np.where(np.abs(self.U) > CANCELS * np.abs(self.U).max(), self.U, 0.0)

    def outputs(self, C: Array) -> Array:
        """Return the outputs Cx at the states x = Xd that cost nothing, as a matrix that multiplies all states."""
        moved = C[:, ~self.states], self.T[~self.states]
        found, size = C - moved[0] @ moved[1], (np.abs(C) + np.abs(moved[0]) @ np.abs(moved[1])).max(axis=1)
        return np.where(self.states & (np.abs(found) > CANCELS * size[:, None]), found, 0.0)

    def wanders(self, rows: Array, noise: Array) -> bool:
        """Return whether noise accumulates without bound in one of the given combinations of the signals d."""
        d = self.states
        late, seen = self.problem.A[np.ix_(d, d)], rows[:, d]
        moved = np.diag(np.sqrt(np.diag(noise)[d]))
        effects = [float(np.abs(seen @ moved).max(initial=0.0))]
        for _ in range(FORGETS):
            effects.append(float(np.abs(seen @ late @ moved).max(initial=0.0)))
            late = late @ late
        return effects[-1] > CANCELS * max(effects)

    def transients(self, L: Array, K: Array, H: Array, table: Array) -> tuple[float, float]:
        """Return the cost per step of set-points that change at known times, and their effect on the cost of not
        sending.
        """
        # A change moves the deviation ξ = x − Xd by m = −XΔ, before the transient of the change before it has ended. So
        # the cost-to-go of the regulator is ξ'Kξ + 2h'ξ + constant with h_k = (A + BL)'(K m_k + h_{k+1}), and an error
        # e of the input adds e'He + 2e'g with g_k = B'(K m_k + h_{k+1}).
        x = ~self.states
        A, B, Q, R, N = self.problem
        gain, weight = L[:, x], K[np.ix_(x, x)]
        closed = A[np.ix_(x, x)] + B[x] @ gain
        stage = Q[np.ix_(x, x)] + gain.T @ R @ gain + N[x] @ gain + (N[x] @ gain).T
        moves = table @ self.T[x][:, -table.shape[1] :].T  # of the deviation, by each change
        none, unit = np.zeros(len(closed)), np.eye(len(closed))
        before, later, power = none, none, unit
        for first, last in zip(moves, moves[::-1], strict=True):
            before, later, power = closed @ before + first, closed.T @ (weight @ last + later), closed @ power
        deviation, ahead = np.linalg.solve(unit - power, before), np.linalg.solve(unit - power.T, later)
        cost, pulls = 0.0, np.empty((len(moves), B.shape[1]))
        for k, (first, last) in enumerate(zip(moves, moves[::-1], strict=True)):
            cost += float(deviation @ stage @ deviation) - float(first @ weight @ first)
            deviation = closed @ deviation + first
            ahead = weight @ last + ahead
            pulls[k], ahead = B[x].T @ ahead, closed.T @ ahead
        square = float(np.einsum("ki,ij,kj", pulls, np.linalg.pinv(H, hermitian=True), pulls))
        return cost / len(table), sqrt(max(square, 0.0) / len(table))


def followed(given: Quadratic) -> Followed | None:
    """Find the states and inputs that cost nothing; return the problem in deviations, or None if none are found."""
    free = ~closure((given.B != 0).any(axis=1), np.asarray(given.A != 0, dtype=np.bool_))
    if not free.any():
        return None
    others = [states for states in _lasting(given.A, free) if not np.array_equal(states, free)]
    # states that decay slowly cost little between samples; if the others suffice, no cost is left out
    tried = [(free, EXACTLY), *((states, CANCELS) for states in others)] if others else []
    tried.append((free, CANCELS))
    return next((found for states, left in tried if (found := _cancelled(given, states, left)) is not None), None)


def _cancelled(given: Quadratic, states: Bits, most: float) -> Followed | None:
    """Return the deviations if an input can cancel the effect of some states, but for a relative cost of ``most``."""
    if not states.any() or states.all():
        return None
    size, unit = reach(given.A, given.B)  # so that the result does not depend on the units
    A, B = given.A / size[:, None] * size, given.B / size[:, None] * unit
    M = np.block([[given.Q, given.N], [given.N.T, given.R]]) * np.outer(*[np.concatenate([size, unit])] * 2)
    largest = float(np.abs(M).max()) or 1.0
    x: list[int] = np.flatnonzero(~states).tolist()
    d: list[int] = np.flatnonzero(states).tolist()
    n, m = len(x), B.shape[1]
    order = [*x, *range(len(A), len(A) + m)]
    cost, push, none = (M[np.ix_(*place)] / largest for place in ((order, order), (order, d), (d, d)))
    # the derivatives of the cost with respect to x and u are zero
    equations = Resting.of(A[np.ix_(x, x)], B[x], A[np.ix_(d, d)], A[np.ix_(x, d)], (cost, push))
    found = equations.smallest()
    found[np.abs(found) < ROUNDS * np.abs(found).max(initial=0.0)] = 0.0
    if not found.any():  # they have no effect
        return None
    rest = np.vstack(equations.split(found))
    left = none + rest.T @ push + push.T @ rest + rest.T @ cost @ rest
    most_needed = max(1.0, float(np.abs(found).max()))
    residual = max(equations.missed(found), float(np.abs(A[np.ix_(d, x)] @ rest[:n]).max(initial=0.0)))
    if residual > CANCELS * most_needed or np.abs(left).max() > most * most_needed:
        return None
    T, U = np.eye(len(A)), np.zeros((m, len(A)))
    T[np.ix_(x, d)], U[:, d] = -rest[:n] * size[x, None] / size[d], rest[n:] * unit[:, None] / size[d]
    keep, both = np.outer(~states, ~states), np.outer(states, states)
    A, B, Q, R, N = given
    A = np.where(keep | both, A, 0.0)
    A[np.ix_(x, x)] += T[np.ix_(x, d)] @ given.A[np.ix_(d, x)]
    problem = Quadratic(A, B, np.where(keep, Q, 0.0), R, np.where(states[:, None], 0.0, N))
    return Followed(states, T, U, problem)


def _lasting(A: Array, free: Bits) -> tuple[Bits, Bits]:
    """Return the states that no input affects and that do not decay, with those that affect each other, and alone."""
    leads = paths(np.asarray(A != 0, dtype=np.bool_).T)
    found, left = np.zeros_like(free), free.copy()
    while left.any():
        state = int(np.argmax(left))
        cycle = leads[state] & leads[:, state]
        left = left & ~cycle
        if free_modes(A[np.ix_(cycle, cycle)], Limit(False)).lasting.size:
            found = found | cycle
    between = leads[:, found].any(axis=1) | leads[found].any(axis=0)
    return np.asarray(found | (free & between), dtype=np.bool_) if found.any() else found, found
