"""Cost of silence in a loop with a given controller, relative to the base, the loop that always sends.

In each step of the loop, a packet carries the choice c = K z, where z contains everything that the loop uses. With the
choice, the loop moves by z⁺ = Φ z + Γ c + noise at the stage cost [z; c]'S[z; c]. The base makes the choice in every
step, and has the value z'P z. A step with the choice c = K z + e instead costs

    e'He + 2 e'(slope) z,    H = S_cc + Γ'PΓ,    slope = S_cz + S_cc K + Γ'P(Φ + ΓK)

more than the base, now and later. For every policy that decides when to be silent, the cost exceeds that of the base by
the mean of this over the silent steps. LQG minimises its own value, so its slope is zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, block_diagonal, symmetrised
from taciturn._display import Displayed
from taciturn._modes import mode_text
from taciturn.errors import UnstableError

DOUBLINGS = 64
CONVERGED = 1e-14  # relative change of the value within a doubling of the horizon
LARGEST = 1e100  # a larger value has diverged
SEEN = 1e-9  # share of a mode in the value below which the cost does not depend on it


@dataclass(frozen=True, eq=False, repr=False)
class Base(Displayed):
    """A loop that sends in every step, as a linear system.

    Args:
        Phi: dynamics without the choice, (n, n).
        Gamma: effect of the choice, (n, c).
        stage: weight of the stage cost, (n + c, n + c).
        K: the choice of the base, (c, n).
        noise: covariance of the noise, (n, n).
    """

    Phi: Array
    Gamma: Array
    stage: Array
    K: Array
    noise: Array


@dataclass(frozen=True, eq=False, repr=False)
class Advantage(Displayed):
    """The value of a base, and the weights of the additional cost of another choice.

    Args:
        P: the value z'P z of the base beyond its average cost, (n, n).
        H: quadratic weight of the deviation of the choice, (c, c).
        slope: linear weight of this deviation, (c, n).
        cost: average cost of the base per step.
        settling: time constant in steps of the slowest mode that the cost depends on.
    """

    P: Array
    H: Array
    slope: Array
    cost: float
    settling: float


def advantage(base: Base, remedy: str) -> Advantage:
    """Return the value of a base, and the weights of the additional cost of another choice.

    Raises:
        UnstableError: the cost of the base is infinite; the message ends with ``remedy``.
    """
    n = len(base.Phi)
    F, closed = base.Phi + base.Gamma @ base.K, np.vstack([np.eye(n), base.K])
    P, slowest = least_value(F, symmetrised(closed.T @ base.stage @ closed))
    if slowest >= 1:
        modes = np.linalg.eigvals(F)
        worst = complex(modes[np.argmax(np.abs(modes))])
        raise UnstableError(
            f"the loop that sends every sample is not stable: it has the eigenvalue {mode_text(worst)}; expected "
            f"eigenvalues inside the unit circle: {remedy}"
        )
    gain = base.stage[n:] @ closed + base.Gamma.T @ P @ F
    H = symmetrised(base.stage[n:, n:] + base.Gamma.T @ P @ base.Gamma)
    return Advantage(P, H, gain, float(np.sum(P * base.noise)), 1 / (1 - slowest))


def least_value(F: Array, M: Array) -> tuple[Array, float]:
    """Return the least solution of P = M + F'PF, and the modulus of the slowest mode that it depends on, or infinity.

    A mode that the value does not depend on may be marginally stable. The horizon is doubled until the value does not
    change. ``_modes.summed`` also waits until the powers of F are zero, which those of such a mode never are.
    """
    P, step = M, F
    size = float(np.abs(P).max(initial=0.0))
    for _ in range(DOUBLINGS):
        added = symmetrised(step.T @ P @ step)
        P, step, size = P + added, step @ step, float(np.abs(P + added).max(initial=0.0))
        if size > LARGEST or np.abs(added).max(initial=0.0) <= CONVERGED * size:
            break
    if size > LARGEST:
        return P, np.inf
    modes, vectors = np.linalg.eig(F)
    seen = np.abs(np.einsum("ji,jk,ki->i", vectors.conj(), P, vectors)) > SEEN * size
    return P, float(np.abs(modes)[seen].max(initial=0.0))


def cycle_value(parts: Sequence[tuple[Array, Array]]) -> tuple[Array, float]:
    """Return the least value at the start of a cycle of steps with dynamics and stage weight, and its slowest mode."""
    F, M = np.eye(len(parts[0][0])), np.zeros_like(parts[0][1])
    for step, stage in parts:
        M = M + F.T @ stage @ F
        F = step @ F
    return least_value(F, symmetrised(M)) if np.isfinite(F).all() else (M, np.inf)


def held_steps(base: Base) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return dynamics and stage weight of (z, h) with a packet that arrives, and in silence that keeps h."""
    n, c = base.Gamma.shape
    closed = np.vstack([np.eye(n), base.K])
    arrives = np.block([[base.Phi + base.Gamma @ base.K, np.zeros((n, c))], [base.K, np.zeros((c, c))]])
    silent = np.block([[base.Phi, base.Gamma], [np.zeros((c, n)), np.eye(c)]])
    return (arrives, block_diagonal(closed.T @ base.stage @ closed, np.zeros((c, c)))), (silent, base.stage)
