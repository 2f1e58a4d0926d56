"""Least fixed points of the backward steps of a value, by doubling the horizon.

A mode that the value does not depend on may be marginally stable, such as an integrator that nothing reads. A solver
for Lyapunov equations refuses such modes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from taciturn._arrays import Array, pushed, symmetrised
from taciturn._growth import growth, normal_moments
from taciturn._progress import check_time
from taciturn.errors import ProblemError

Fate: TypeAlias = tuple[float, Array, Array]
"""Probability, dynamics and stage weight of an outcome of a step."""
Cycle: TypeAlias = Sequence[Sequence[Sequence[Fate]]]
"""The fates of each step and channel state."""

DOUBLINGS = 64
CONVERGED = 1e-14  # relative change of the value within a doubling of the horizon
LARGEST = 1e100  # a larger value has diverged
SEEN = 1e-9  # share of a mode in the value below which the cost does not depend on it
MOST_UNKNOWNS = 2500  # entries of all P_m
MEMORY = 16  # halvings of 1e-14 in the square: steps of a doubled horizon per time constant of the state


def least_value(F: Array, M: Array) -> tuple[Array, float]:
    """Return the least solution of P = M + F'PF, and the modulus of the slowest mode that it depends on, or infinity.

    The horizon is doubled until the value does not change. ``_modes.summed`` also waits until the powers of F are zero,
    which those of a marginal mode never are.
    """
    P, step = M, F
    size = float(np.abs(P).max(initial=0.0))
    for _ in range(DOUBLINGS):
        check_time()
        added = symmetrised(step.T @ P @ step)
        P, step, size = P + added, step @ step, float(np.abs(P + added).max(initial=0.0))
        if size > LARGEST or np.abs(added).max(initial=0.0) <= CONVERGED * size:
            break
    if size > LARGEST:
        return P, np.inf
    modes, vectors = np.linalg.eig(F)
    seen = np.abs(np.einsum("ji,jk,ki->i", vectors.conj(), P, vectors)) > SEEN * size
    return P, float(np.abs(modes)[seen].max(initial=0.0))


def expect_few_states(size: int, channels: int) -> None:
    """Raise an error if the value over a lossy link has too many unknowns.

    Raises:
        ProblemError: it has.
    """
    if channels * size * (size + 1) // 2 > MOST_UNKNOWNS:
        raise ProblemError(
            f"plant, controller and link have {size} states together, too many for the value over a lossy link; "
            "expected fewer states, or a link without losses"
        )


def lossy(cycle: Cycle, turns: Array) -> tuple[Array, float] | None:
    """Return the least P_m ≥ 0 at the start of a cycle, and its time constant in steps; None if the value is infinite.

    All P_m are unknowns of one linear map, and the horizon is doubled as without losses.
    """
    size, s = len(cycle[0][0][0][1]), len(turns)
    rows, columns = np.triu_indices(size)
    d = len(rows)
    spread = np.zeros((size * size, d))  # from the upper triangle to the whole matrix
    spread[rows * size + columns, np.arange(d)] = 1.0
    spread[columns * size + rows, np.arange(d)] = 1.0
    upper = rows * size + columns
    step, value = np.eye(s * d), np.zeros(s * d)
    for states in reversed(cycle):
        before, stage = np.zeros((s * d, s * d)), np.zeros(s * d)
        for m, fates in enumerate(states):
            here = slice(m * d, (m + 1) * d)
            mean = np.zeros((d, d))
            for p, F, M in fates:
                mean += p * (np.kron(F.T, F.T) @ spread)[upper]
                stage[here] += p * M[rows, columns]
            for other in range(s):
                before[here, other * d : (other + 1) * d] = turns[m, other] * mean
        step, value = before @ step, before @ value + stage
    for doubling in range(DOUBLINGS):
        check_time()
        added = step @ value
        value = value + added
        largest = float(np.abs(value).max(initial=0.0))
        if not largest <= LARGEST:
            return None
        if np.abs(added).max(initial=0.0) <= CONVERGED * largest:
            P = (spread @ value.reshape(s, d).T).T.reshape(s, size, size)
            return P, len(cycle) * 2.0**doubling / MEMORY
        step = step @ step
        if not np.isfinite(step).all():
            return None
    return None


def fourth(P: Array, cycle: Cycle, turns: Array) -> float:
    """Return the growth per step of the fourth moments of the states on which the value P depends."""
    size, vectors = np.linalg.eigh(P)
    seen = vectors[:, size > SEEN * size.max(initial=0.0)]
    shape = (len(turns), *[seen.shape[1]] * 4)
    reduced = [[[(p, seen.T @ F @ seen) for p, F, _ in fates] for fates in states] for states in cycle]

    def moved(moments: Array) -> Array:
        for states in reduced:
            after = np.zeros(shape)
            for m, fates in enumerate(states):
                for p, F in fates:
                    after[m] += p * pushed(F, moments[m], 4)
            moments = np.tensordot(turns.T, after, 1)
        return moments

    return growth(moved, np.stack([normal_moments(seen.shape[1], 4)] * len(turns))) ** (1 / len(cycle))
