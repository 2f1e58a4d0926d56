"""How the packets that a node did not send affect a loop with any linear controller: the cost so far and to go.

A link that is silent adds an error d to a linear loop: the value that the receiver uses, minus the value that a packet
would carry. The loop with every sample is z⁺ = F z, and its cost output ζ is the root of the stage cost, so the errors
of one node add the response

    q⁺ = F q + G d,   ζ_q = C q + D d,   q = 0 at the start,

to the states and the cost output of the loop that sends every sample on the same path. With the cost to come V(q) =
q'Pq, P = F'PF + C'C, an error adds to the cost of its own response, now and later,

    a = |C q + D d|² + V(F q + G d) − V(q) = d'S d + 2 d'Y q,   S = D'D + G'PG,   Y = D'C + G'PF.

So Σ|ζ_q|² = Σa − V(q) at every time, whatever the noise is. By the triangle inequality for the norm (Σ|ζ|²)^½, the cost
J of a path and the cost J_b of sending every sample on it obey |√J − √J_b| ≤ Σ_l √(Σa_l/T), with the sum over the nodes
that decide. No law of the noise enters, and no node knows the others.

The weight of the final state of a run, x_T'Q_T x_T, is part of its cost. Then P = F'PF + C'C + E with E ⪰ 0 such that
P ⪰ Q_T, and Σa ≥ Σ|ζ_q|² + q_T'Q_T q_T.

``Response`` has the coordinates of what the errors reach and the cost sees. A mode on the unit circle that the cost
does not see, such as an integral that nothing reads, is no part of q: the sum for P would not end, and rounding would
grow. The coordinates are those of the modes, in which a node multiplies once for each state, or of the real Schur form
if the modes are nearly parallel.

**Another plant.** If the plant is not that of the design, an error has another effect T_true on the cost output than T,
by which the node computes. With ρ the largest ratio of |T_true d| and |T d| over all errors d and frequencies, the sum
for the true plant is at most ρ² times the computed one (``effect_ratio``).

Source: minkowski1896
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import sqrt
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from taciturn import _scipy
from taciturn._arrays import Array, symmetrised
from taciturn._display import Displayed
from taciturn._modes import closure, mode_text, reach, root
from taciturn.base.value import seen_part
from taciturn.errors import UnstableError
from taciturn.lqg.cache import remembered
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.equation import stationary
from taciturn.model.controller import Controller

Complex: TypeAlias = npt.NDArray[np.complex128]
FINEST, NEAR, MANY = 1e-6, 8.0, 65  # least width of a mode, widths around a mode, and points there
SLOWER = 1e-3  # share of the least width below which a frequency is as good as 0
TINY = 1e-14  # share of an effect below which it is a rounding error
PARALLEL = 1e3  # condition of the modes from which on they are no coordinates: digits that they cost
ROUNDED = 1e-12  # size of a rounding error of the dynamics in these coordinates


@dataclass(frozen=True, eq=False, repr=False)
class Response(Displayed):
    """Response q⁺ = F q + G d, ζ = C q + D d of a loop to errors d that one node causes; q'Pq is the cost-to-go."""

    F: Array  # (k, k)
    G: Array  # (k, e)
    C: Array  # (c, k)
    D: Array  # (c, e)
    P: Array  # (k, k)

    @property
    def states(self) -> int:
        """Number of states q of the response."""
        return len(self.F)

    @cached_property
    def S(self) -> Array:
        """Weight S, (e, e): an error d increases the cost by d'S d + 2 d'Y q."""
        return symmetrised(self.D.T @ self.D + self.G.T @ self.P @ self.G)

    @cached_property
    def Y(self) -> Array:
        """Weight Y, (e, k): an error d increases the cost by d'S d + 2 d'Y q."""
        return self.D.T @ self.C + self.G.T @ self.P @ self.F

    def squares_at(self, angles: Array) -> Complex:
        """Return T*T at the given angles on the unit circle; T is the transfer matrix from the errors to the cost
        output.
        """
        points = np.exp(1j * angles)[:, None, None]
        G = np.broadcast_to(self.G.astype(np.complex128), (len(angles), *self.G.shape))
        effect = self.C @ np.linalg.solve(points * np.eye(self.states) - self.F, G) + self.D
        return np.asarray(effect.conj().swapaxes(1, 2) @ effect, dtype=np.complex128)

    def added(self, errors: Sequence[int]) -> Array:
        """Return the matrix of the added cost as a form in (d, q), if only the listed entries of the error d are
        nonzero.
        """
        at = [*errors]
        S, Y = self.S[np.ix_(at, at)], self.Y[at]
        return np.block([[S, Y], [Y.T, np.zeros((self.states, self.states))]])


@dataclass(frozen=True, eq=False, repr=False)
class EverySample(Displayed):
    """The loop of plant and controller that sends every sample, as a linear system with errors of signals as inputs.

    ``measurement`` and ``applied`` are the columns of G and D for errors of each measurement and of each input.
    """

    F: Array  # dynamics of the plant's and the controller's state, (k, k)
    G: Array  # effect of the errors of measurements and inputs, (k, p + m)
    C: Array  # root of the stage cost, (c, k)
    D: Array  # (c, p + m)
    final: Array  # root of the weight of the final state, (f, k)

    @staticmethod
    def of(problem: Discrete, controller: Controller, weights: Array | None = None) -> EverySample:
        """Return the loop of a problem and a controller. ``weights`` of (x, u) replace the weights of the problem."""
        plant, c = problem.plant, controller
        (n, m), p, k = plant.B.shape, plant.outputs, len(c.A)
        F = np.block(
            [[plant.A + plant.B @ c.D @ plant.C, plant.B @ c.C], [(c.B + c.E @ c.D) @ plant.C, c.A + c.E @ c.C]]
        )
        G = np.block([[plant.B @ c.D, plant.B], [c.B + c.E @ c.D, c.E]])
        used = np.block([[np.eye(n), np.zeros((n, k))], [c.D @ plant.C, c.C]])
        moved = np.block([[np.zeros((n, p + m))], [np.hstack([c.D, np.eye(m)])]])
        stage = np.block([[problem.Q, problem.N], [problem.N.T, problem.R]]) if weights is None else weights
        rooted, terminal = root(stage).T, problem.terminal
        final = np.zeros((0, n)) if terminal is None else root(terminal).T
        return EverySample(F, G, rooted @ used, rooted @ moved, final @ np.eye(n, n + k))

    def response(self, errors: Sequence[int]) -> Response:
        """Return the response to errors of the listed measurements and inputs, without states that have no effect.

        Raises:
            UnstableError: the cost sees a mode of the loop that does not decay.
        """
        return _response(self.F, self.G[:, [*errors]], np.vstack([self.C, self.final]), self.D[:, [*errors]])


@remembered  # the points of a trade-off differ in what silence may cost, and not in its response
def _response(F: Array, G: Array, weighed: Array, D: Array) -> Response:
    """Return the response; the first rows of ``weighed`` are the cost output, the other rows the final output."""
    leads = F != 0
    reached = closure(np.asarray(G.any(axis=1)), leads)
    kept = reached & closure(np.asarray(weighed.any(axis=0)), leads.T)
    F, G, weighed = F[np.ix_(kept, kept)], G[kept], weighed[:, kept]
    unit, _ = reach(F, G)  # so that sizes can be compared, whatever the units are
    F, G, weighed = F / unit[:, None] * unit, G / unit[:, None], weighed * unit
    seen = seen_part(F, weighed)
    F, G, weighed = seen.T @ F @ seen, seen.T @ G, weighed @ seen
    modes = np.linalg.eigvals(F)
    if len(modes) and np.abs(modes).max() >= 1:
        raise UnstableError(
            f"the loop that sends every sample has the eigenvalue {mode_text(modes[np.argmax(np.abs(modes))])}, which "
            "affects the cost, so a step without a packet would increase the cost of all later steps; expected "
            "eigenvalues inside the unit circle: change the controller"
        )
    C, final = weighed[: len(D)], weighed[len(D) :]
    stage, last = symmetrised(C.T @ C), final.T @ final
    P = stationary(F.T, stage)
    values, vectors = np.linalg.eigh(symmetrised(last - P))
    missing = (vectors * np.maximum(values, 0.0)) @ vectors.T
    P = stationary(F.T, stage + symmetrised(missing)) if missing.any() else P
    basis, inverse = _modes_of(F, G)
    F, P = inverse @ F @ basis, symmetrised(basis.T @ P @ basis)
    return Response(_rounded(F), _rounded(inverse @ G), C @ basis, D, P)


def effect_ratio(computed: Response, true: Response) -> float:
    """Return the largest ratio ρ, over all frequencies, of the cost outputs of two responses to the same error.

    It is searched on a grid of frequencies that is dense at the modes of both loops, and refined at its peak.
    """
    modes = np.concatenate([np.linalg.eigvals(one.F) for one in (computed, true) if one.states] or [np.ones(1)])
    angles = np.abs(np.angle(modes))
    widths = np.maximum(1 - np.abs(modes), FINEST)
    near = (angles[:, None] + widths[:, None] * np.linspace(-NEAR, NEAR, MANY)).ravel()
    # at lower frequencies the ratio is at its limit, and effects that an integral compensates are differences
    low = SLOWER * float(widths.min())
    tried = np.concatenate([np.geomspace(low, np.pi, 8 * MANY), near])
    grid: Array = np.sort(tried[(tried >= low) & (tried <= np.pi)])
    largest = 0.0
    for _ in range(3):
        values = _ratios(computed, true, grid)
        i, largest = int(np.argmax(values)), max(largest, float(values.max()))
        grid = np.linspace(float(grid[max(i - 1, 0)]), float(grid[min(i + 1, len(grid) - 1)]), MANY)
    return sqrt(largest)


def _ratios(computed: Response, true: Response, angles: Array) -> Array:
    """Return the largest ratio of the squares of the effects at each frequency."""
    return _scipy.largest_ratios(true.squares_at(angles), computed.squares_at(angles), TINY)


def _modes_of(F: Array, G: Array) -> tuple[Array, Array]:
    """Return a basis of the modes of F, or of its real Schur form, and the inverse of the basis."""
    if not len(F):
        return F, F
    modes, vectors = np.linalg.eig(F)
    if np.linalg.cond(vectors) > PARALLEL:
        _, basis, _ = _scipy.real_schur(F)
        return basis, basis.T
    # of a pair of modes, both the real and the imaginary part; an error then drives the first of the two alone
    driven = np.linalg.solve(vectors, G.astype(np.complex128))[:, :1]
    driven = np.where(np.abs(driven) > PARALLEL**-1 * np.abs(driven).max(initial=0.0), driven, 1.0)
    turned, columns = vectors * driven.T, list[Array]()
    for mode, column in zip(modes, turned.T, strict=True):
        if mode.imag > 0:
            columns += [2 * column.real, -2 * column.imag]
        elif mode.imag == 0:
            columns.append(column.real)
    basis = np.array(columns, dtype=np.float64).T
    return basis, np.asarray(np.linalg.inv(basis), dtype=np.float64)


def _rounded(matrix: Array) -> Array:
    """Return a matrix with entries of 0 and 1 where they differ from these by rounding errors, which saves products."""
    near = ROUNDED * max(1.0, float(np.abs(matrix).max(initial=0.0)))
    matrix = np.where(np.abs(matrix) < near, 0.0, matrix)
    return np.asarray(np.where(np.abs(matrix - 1) < near, 1.0, matrix), dtype=np.float64)
