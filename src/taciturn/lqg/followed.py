"""States that no input moves, such as a disturbance or a set-point, and whose effect on the cost an input can cancel.

Let d⁺ = Sd be such states, and x⁺ = Ax + Bu + Ed the others. If x = Xd and u = Ud cost nothing for every d, and

    AX + BU + E = XS,

then the deviations x − Xd and u − Ud have the dynamics and the cost of the problem without d. The regulator of this
problem is u = L(x − Xd) + Ud, and its cost-to-go (x − Xd)'K(x − Xd), also if d never decays.

A disturbance that decays may be among the states x if an input cannot cancel its effect, such as its movement between
samples. It may move d, d⁺ = Sd + Dx, if it stays at rest where x = Xd; then D X = 0, and the deviations have the
dynamics A − XD.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np

from taciturn._arrays import Array, Bits
from taciturn._display import Displayed
from taciturn._modes import closure, paths, reach
from taciturn._rational import Limit, free_modes
from taciturn.errors import ProblemError
from taciturn.lqg.quadratic import Quadratic
from taciturn.lqg.sampling import Exact

FORGETS = 24  # 2^24 steps after which noise without a remaining effect is forgotten
ROUNDS = 1e-12  # entry of X or U, relative to the largest, that counts as zero
CANCELS = 1e-9  # relative residual of the equations for X and U
EXACTLY = 1e-13  # relative cost left that is rounding


@dataclass(frozen=True, eq=False, repr=False)
class Followed(Displayed):
    """Deviations of states and inputs from those that cost nothing.

    Args:
        states: mask of the states d, (n,).
        T: matrix of the deviations (x − Xd, d) in the order of the states, (n, n).
        U: inputs that cost nothing, zero for the states x, (m, n).
        problem: the problem in the deviations, in which the states d have no cost.
        exact: the problem in the deviations to any precision; None if its doubles are exact.
    """

    states: Bits
    T: Array
    U: Array
    problem: Quadratic
    exact: Exact | None = None

    @property
    def inputs(self) -> Array:
        """The inputs that cost nothing, without rounding errors of entries that are zero, (m, n)."""
        return np.where(np.abs(self.U) > CANCELS * np.abs(self.U).max(), self.U, 0.0)

    def outputs(self, C: Array) -> Array:
        """Return combinations Cx at the states x = Xd that cost nothing, as a matrix of all states."""
        moved = C[:, ~self.states], self.T[~self.states]
        found, size = C - moved[0] @ moved[1], (np.abs(C) + np.abs(moved[0]) @ np.abs(moved[1])).max(axis=1)
        return np.where(self.states & (np.abs(found) > CANCELS * size[:, None]), found, 0.0)

    def wanders(self, rows: Array, noise: Array) -> bool:
        """Return whether a combination of the states d does not forget the noise that moves them.

        Args:
            rows: the combinations, (any, n).
            noise: covariance of the noise of all states, (n, n).
        """
        d = self.states
        late, seen = self.problem.A[np.ix_(d, d)], rows[:, d]
        moved = np.diag(np.sqrt(np.diag(noise)[d]))
        effects = [float(np.abs(seen @ moved).max(initial=0.0))]
        for _ in range(FORGETS):
            effects.append(float(np.abs(seen @ late @ moved).max(initial=0.0)))
            late = late @ late
        return effects[-1] > CANCELS * max(effects)

    def transients(self, L: Array, K: Array, H: Array, table: Array) -> tuple[float, float]:
        """Return the effects of set-points that change at known times, which are no noise of mean zero.

        A change moves the deviation ξ = x − Xd by m = −XΔ, before the transient of the change before it has ended. So
        the cost-to-go of the regulator is ξ'Kξ + 2h'ξ + constant with h_k = (A + BL)'(K m_k + h_{k+1}), and an error e
        of the input adds e'He + 2e'g with g_k = B'(K m_k + h_{k+1}).

        Args:
            L: gain of the regulator.
            K: cost-to-go of the regulator.
            H: weight of the error of the input.
            table: change of the set-points, the last states, from each step to the next, repeated, (steps, z).

        Returns:
            The cost per step beyond that of unrelated changes, which cost tr(X'KX ΔΔ') each, and the root mean square
            of g in the norm of the inverse of H.
        """
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
    """Return the deviations from what costs nothing, or None if no state needs them or an input cannot cancel it."""
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
    n, q, m = len(x), len(d), B.shape[1]
    order = [*x, *range(len(A), len(A) + m)]
    cost, push, none = (M[np.ix_(*place)] / largest for place in ((order, order), (order, d), (d, d)))
    S, E, same = A[np.ix_(d, d)], A[np.ix_(x, d)], np.eye(q)
    # A X + B U − X S = −E, and the derivatives of the cost with respect to x and u are zero
    moves = np.hstack([np.kron(same, A[np.ix_(x, x)]) - np.kron(S.T, np.eye(n)), np.kron(same, B[x])])
    costs = np.hstack([np.kron(same, cost[:, :n]), np.kron(same, cost[:, n:])])
    matrix, right = np.vstack([moves, costs]), -np.concatenate([E.T.ravel(), push.T.ravel()])
    if not (np.isfinite(matrix).all() and np.isfinite(right).all()):
        raise ProblemError(
            "the effects of disturbances or set-points on each other differ by a factor beyond the range of numbers; "
            "expected effects nearer to 1, such as a faster or a constant disturbance"
        )
    found = np.linalg.lstsq(matrix, right, rcond=None)[0]
    found[np.abs(found) < ROUNDS * np.abs(found).max(initial=0.0)] = 0.0
    if not found.any():  # they have no effect
        return None
    rest = np.vstack([found[: n * q].reshape(q, n).T, found[n * q :].reshape(q, m).T])
    left = none + rest.T @ push + push.T @ rest + rest.T @ cost @ rest
    most_needed = max(1.0, float(np.abs(found).max()))
    beside = A[np.ix_(d, x)] @ rest[:n]
    residual = max(float(np.abs(part).max(initial=0.0)) for part in (matrix @ found - right, beside))
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
    """Return the states that no input moves and that do not decay, with those that affect each other, and alone."""
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
