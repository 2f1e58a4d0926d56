"""Cost of silence over a link that drops packets and acknowledges them, for independent losses and bursts.

In each step, the base attempts to send. In channel state m, the link drops the packet with probability p_m. A dropout
acts as silence: the receiver keeps its last value h. With w = (z, h) and the value w'P_m w in channel state m,

    P_m = p_m X_s(Q_m) + (1 − p_m) X_a(Q_m),    X_f(Q) = M_f + F_f'Q F_f,    Q_m = Σ_m' T_mm' P_m',

where a is the step with a packet that arrives, s that of silence, and T contains the transition probabilities of the
channel. Silence costs (1 − p_m) w'[X_s(Q_m) − X_a(Q_m)]w more than an attempt. Here m is the channel state of the
present step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array, block_diagonal, symmetrised
from taciturn._display import Displayed
from taciturn.design.base import CONVERGED, DOUBLINGS, LARGEST, SEEN, Base, held_steps
from taciturn.errors import ProblemError, UnstableError

MOST_UNKNOWNS = 2500  # entries of all P_m
WIDTH = 1e-6  # accuracy of the critical loss
MEMORY = 16  # halvings of 1e-14 in the square: steps of a doubled horizon per time constant of the state


@dataclass(frozen=True, eq=False, repr=False)
class LossyAdvantage(Displayed):
    """The value of a base over a lossy link, and the cost of silence in each channel state.

    Args:
        silence: weights of (z, h) in the cost of silence, one for each channel state, (s, n + c, n + c).
        cost: average cost of the base per step.
        settling: time constant of the loop in steps.
        start: stationary distribution of the channel state, (s,).
        fourth: growth per step of the fourth moments of the base, as far as the cost depends on them; at 1 or more, the
            variance of the cost is infinite.
    """

    silence: Array
    cost: float
    settling: float
    start: Array
    fourth: float


def lossy_advantage(base: Base, turns: Array, losses: Array, remedy: str) -> LossyAdvantage:
    """Return the value of a base over a lossy link.

    Args:
        base: the base with every packet.
        turns: transition probabilities of the channel state, (s, s).
        losses: loss probability in each channel state, (s,).
        remedy: end of the message about an unstable loop.

    Raises:
        UnstableError: the mean square of the loop that attempts in every step grows; the message states the critical
            losses.
        ProblemError: the loop has too many states.
    """
    n, c = base.Gamma.shape
    size, states = n + c, len(losses)
    if states * size * (size + 1) // 2 > MOST_UNKNOWNS:
        raise ProblemError(
            f"plant, controller and link have {size} states together, too many for the value over a lossy link; "
            "expected fewer states, or a link without losses"
        )
    found = _value(base, turns, losses)
    if found is None:
        scale = critical_scale(base, turns, losses)
        stated = " and ".join(f"{p:.4g}" for p in losses)
        limit = f"below {scale * losses[0]:.4g}" if states == 1 else f"below {scale:.4g} times as much"
        reason = f"a loss {limit}" if scale else f"a stable loop: {remedy}"
        raise UnstableError(
            f"with loss probability {stated}, the mean square of the loop that attempts to send every sample grows; "
            f"expected {reason}"
        )
    P, settling = found
    (arrives, M_arrives), (silent, M_silent) = held_steps(base)
    Q = np.einsum("ij,jkl->ikl", turns, P)
    gap = [
        (1 - p) * symmetrised(M_silent + silent.T @ q @ silent - M_arrives - arrives.T @ q @ arrives)
        for p, q in zip(losses, Q, strict=True)
    ]
    start = stationary(turns)
    noise = block_diagonal(base.noise, np.zeros((c, c)))
    cost = float(sum(share * np.sum(q * noise) for share, q in zip(start, Q, strict=True)))
    return LossyAdvantage(np.array(gap), cost, settling, start, _fourth(P, (arrives, silent), turns, losses))


def critical_scale(base: Base, turns: Array, losses: Array) -> float:
    """Return the largest factor of the losses with which the mean square of the base does not grow; 0 for none."""
    low, high = 0.0, 1 / float(losses.max())
    if _value(base, turns, 0.0 * losses) is None:
        return 0.0
    if _value(base, turns, high * losses) is not None:
        return high
    while high - low > WIDTH * high:
        middle = (low + high) / 2
        low, high = (middle, high) if _value(base, turns, middle * losses) is not None else (low, middle)
    return low


def stationary(turns: Array) -> Array:
    """Return the stationary distribution of a Markov chain, (s,)."""
    s = len(turns)
    equations = np.vstack([turns.T - np.eye(s), np.ones((1, s))])
    return np.asarray(np.linalg.lstsq(equations, np.append(np.zeros(s), 1.0), rcond=None)[0], dtype=np.float64)


@dataclass(frozen=True, eq=False, repr=False)
class ChannelBelief(Displayed):
    """The update of the distribution of the channel state by the fate of an attempt, and by a step of the channel."""

    turns: Array
    losses: Array

    def __call__(self, belief: Any, attempted: Any, arrived: Any) -> Any:
        """Return the distribution at the next step; ``attempted`` and ``arrived`` are 0 or 1."""
        a, r, p = attempted[0], arrived[0], self.losses
        likelihood = 1.0 - a + a * (r * (1.0 - p) + (1.0 - r) * p)
        weights = belief * likelihood
        total = sum(weights[i] for i in range(len(p)))
        known = weights / np.where(total > 0.0, total, 1.0)
        return self.turns.T @ known


def _fourth(P: Array, maps: tuple[Array, Array], turns: Array, losses: Array) -> float:
    """Return the growth of the fourth moments of the states on which the value depends."""
    size, vectors = np.linalg.eigh(P.sum(axis=0))
    seen = vectors[:, size > SEEN * size.max(initial=0.0)]
    arrives, silent = (seen.T @ F @ seen for F in maps)
    shape = (len(losses), *[seen.shape[1]] * 4)

    def moved(entries: Array) -> Array:
        moments: Array = entries.reshape(shape)
        each = [(1 - p) * _pushed(arrives, moments[m]) + p * _pushed(silent, moments[m]) for m, p in enumerate(losses)]
        return np.tensordot(turns.T, np.stack(each), 1).ravel()

    return _scipy.spectral_radius(moved, int(np.prod(shape)))


def _pushed(F: Array, X: Array) -> Array:
    for axis in range(4):
        X = np.moveaxis(np.tensordot(X, F, (axis, 1)), -1, axis)
    return X


def _value(base: Base, turns: Array, losses: Array) -> tuple[Array, float] | None:
    """Return the least P_m ≥ 0, and the time constant of the loop in steps; None if the mean square grows.

    All P_m are unknowns of one linear map, and the horizon is doubled as for a base without losses.
    """
    (arrives, M_arrives), (silent, M_silent) = held_steps(base)
    size, s = len(arrives), len(losses)
    rows, columns = np.triu_indices(size)
    d = len(rows)
    spread = np.zeros((size * size, d))  # from the upper triangle to the whole matrix
    spread[rows * size + columns, np.arange(d)] = 1.0
    spread[columns * size + rows, np.arange(d)] = 1.0
    upper = rows * size + columns
    maps = [(np.kron(F.T, F.T) @ spread)[upper] for F in (arrives, silent)]
    stages = [M[rows, columns] for M in (M_arrives, M_silent)]
    step, value = np.zeros((s * d, s * d)), np.zeros(s * d)
    for m, p in enumerate(losses):
        here = slice(m * d, (m + 1) * d)
        value[here] = (1 - p) * stages[0] + p * stages[1]
        mean = (1 - p) * maps[0] + p * maps[1]
        for other in range(s):
            step[here, other * d : (other + 1) * d] = turns[m, other] * mean
    for doubling in range(DOUBLINGS):
        added = step @ value
        value = value + added
        largest = float(np.abs(value).max(initial=0.0))
        if not largest <= LARGEST:
            return None
        if np.abs(added).max(initial=0.0) <= CONVERGED * largest:
            P = (spread @ value.reshape(s, d).T).T.reshape(s, size, size)
            return P, 2.0**doubling / MEMORY
        step = step @ step
        if not np.isfinite(step).all():
            return None
    return None
