"""Gains of LQG that are optimal for a link that drops packets and acknowledges those that arrive.

A dropout acts as silence: the receiver uses its own value h, the last input or 0. With the estimate x̂ of the state,
(x̂, h)'P(x̂, h) is the value and p the loss probability:

    Y = S + [A B; M]'P[A B; M],    L = −Y_hh⁻¹Y_hx,    P = p Y + (1 − p)[I 0; L 0]'Y[I 0; L 0].

The acknowledgements separate estimation from control, as without losses.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from taciturn._arrays import Array, symmetrised
from taciturn.design.base import Attempts, Base, advantage, repeated_value
from taciturn.errors import UnstableError
from taciturn.lqg.discrete import Discrete

STEPS, CONVERGED, LARGEST = 1000, 1e-13, 1e100
HALVINGS = 10  # of the interval that contains the critical loss
IMPROVEMENTS = 50
SETTLED = 1e-12  # change of a gain relative to the gain


def gains_for_losses(problem: Discrete, loss: float, zero: bool, key: str = "loss") -> Array:
    """Return the gain L that minimises the cost of an attempt in every step, (m, n).

    Args:
        problem: the discrete-time problem.
        loss: mean loss probability.
        zero: whether the actuator applies 0 in silence; otherwise it keeps the last input.
        key: the key that states the losses, for messages.

    Raises:
        UnstableError: the mean square grows for every gain; the message states up to which loss it does not.

    Source: schenato2009, imer2006
    """
    plant = problem.plant
    n, m = plant.B.shape
    stage = np.block([[problem.Q, problem.N], [problem.N.T, problem.R]])
    held = np.hstack([np.zeros((m, n)), np.zeros((m, m)) if zero else np.eye(m)])
    base = Base(plant.A, plant.B, stage, np.zeros((m, n)), plant.W, held)
    L = _iterated(base, loss, problem.cost.discount)
    if L is None:
        low, high = 0.0, loss
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            low, high = (middle, high) if _iterated(base, middle, problem.cost.discount) is not None else (low, middle)
        raise UnstableError(
            f"{key} is {loss:.4g} on average, and the mean square of the loop grows for every gain; expected a loss "
            f"below {low:.3g}"
        )
    attempts = Attempts(losses=np.full(1, loss), discount=problem.cost.discount)
    for _ in range(IMPROVEMENTS):
        found = advantage(replace(base, K=L), "expected a smaller loss", attempts)
        change: Array = np.asarray(np.linalg.pinv(found.H[0, 0], hermitian=True), dtype=np.float64) @ found.slope[0, 0]
        L = np.asarray(L - change, dtype=np.float64)
        if np.abs(change).max(initial=0.0) <= SETTLED * np.abs(L).max(initial=0.0):
            break
    return L


def _iterated(base: Base, loss: float, discount: float) -> Array | None:
    """Return the gain after some steps of the value, or None if its own value is infinite."""
    n, silent = len(base.Phi), base.silent
    P, L = np.zeros_like(base.stage), base.K
    for _ in range(STEPS):
        Y = symmetrised(base.stage + discount * silent.T @ P @ silent)
        L = np.asarray(-np.linalg.pinv(Y[n:, n:], hermitian=True) @ Y[n:, :n], dtype=np.float64)
        closed = np.vstack([np.eye(n), L])
        after = loss * Y
        after[:n, :n] += (1 - loss) * symmetrised(closed.T @ Y @ closed)
        size, change = np.abs(after).max(), np.abs(after - P).max()
        P = after
        if not size <= LARGEST:
            return None
        if change <= CONVERGED * size:
            break
    attempts = Attempts(losses=np.full(1, loss), discount=discount)
    return None if repeated_value(replace(base, K=L), attempts) is None else L
