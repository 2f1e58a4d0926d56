"""The H∞ norm of a discrete-time linear system, which is its largest gain from input to output in the mean square.

The norm of x⁺ = A x + B d, ζ = C x + D d is the largest singular value of C(e^{iω}I − A)⁻¹B + D over all frequencies ω.
So its value at many frequencies is a lower bound. A number γ is an upper bound if and only if there is a P ⪰ 0 with

    x⁺'P x⁺ + |ζ|² ≤ x'P x + γ²|d|²   for all x and d   (bounded real lemma).

P is computed from a Riccati equation for γ a little above the lower bound, and the inequality is then checked, so that
the answer does not depend on the accuracy of P. States that d does not reach or ζ does not show are left out before.
"""

from __future__ import annotations

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array
from taciturn._modes import invariant, radius, reach, unit_columns
from taciturn.errors import UnstableError

_EDGE = 1e-13  # distance to the unit circle within which a computed mode may lie on it
_FREQUENCIES = 200  # tried between 0 and π
_AROUND = np.concatenate([-np.logspace(-4, 2, 100), np.zeros(1), np.logspace(-4, 2, 100)])  # each mode, in its widths
_EXCESSES = np.logspace(-8, 1, 19)  # relative amounts above the largest gain found that are tried
_SLACK = (1e-10, 1e-8, 1e-6)  # margins of the proof, relative to the weight of the output


def largest_gain(A: Array, B: Array, C: Array, D: Array) -> float:
    """Return an upper bound on the H∞ norm of x⁺ = A x + B d, ζ = C x + D d. It is usually accurate to 1e-6."""
    units, _ = reach(A, B)  # so that the result does not depend on the units of the states
    A, B, C = A / units[:, None] * units, B / units[:, None], C * units
    reached = invariant(unit_columns(B), (A,))
    A, B, C = reached.T @ A @ reached, reached.T @ B, C @ reached
    seen = invariant(unit_columns(C.T), (A.T,))
    A, B, C = seen.T @ A @ seen, seen.T @ B, C @ seen
    direct = float(np.linalg.norm(D, 2))
    if not len(A):
        return direct
    if radius(A) >= 1 - _EDGE:
        raise UnstableError(
            f"the loop has a mode of modulus {radius(A):.6g} that affects the cost; expected a loop that is stable if "
            "it sends every sample"
        )
    least = max(direct, _largest(A, B, C, D))
    for excess in _EXCESSES:
        level = float(1 + excess) * least
        if any(_exceeds(A, B, C, D, level, slack) for slack in _SLACK):
            return level
    raise UnstableError(
        f"the gain of the loop is at least {least:.6g}, but no upper bound on it was found; expected modes that decay "
        "faster"
    )


def _largest(A: Array, B: Array, C: Array, D: Array) -> float:
    """Return the largest gain at many frequencies, most of them near those of slow modes."""
    modes = np.linalg.eigvals(A)
    near = np.angle(modes)[:, None] + np.maximum(1 - np.abs(modes), 1e-12)[:, None] * _AROUND
    angles = np.concatenate([np.linspace(0.0, np.pi, _FREQUENCIES), near.ravel()])
    shifted = np.exp(1j * angles)[:, None, None] * np.eye(len(A)) - A
    responses = C @ np.linalg.solve(shifted, np.broadcast_to(B, (len(angles), *B.shape))) + D
    return float(np.linalg.norm(responses, 2, axis=(1, 2)).max())


def _exceeds(A: Array, B: Array, C: Array, D: Array, level: float, slack: float) -> bool:
    """Return whether the dissipation inequality has a solution P for a gain."""
    output = np.hstack([C, D])
    stage, n = output.T @ output, len(A)
    weight = stage + slack * np.diag([float(np.trace(C.T @ C)) / n] * n + [0.0] * B.shape[1])
    weight[n:, n:] -= level**2 * (1 - slack) * np.eye(B.shape[1])
    P = _scipy.discrete_riccati(A, B, weight[:n, :n], weight[n:, n:], weight[:n, n:])
    if P is None:
        return False
    moved = np.hstack([A, B])
    gap = moved.T @ P @ moved + stage
    gap[:n, :n] -= P
    gap[n:, n:] -= level**2 * np.eye(B.shape[1])
    size = np.sqrt(np.maximum(np.abs(np.diag(gap)), 1e-300))  # the sign of a form does not depend on units
    return bool(np.linalg.eigvalsh(P)[0] >= 0 and np.linalg.eigvalsh(gap / size / size[:, None])[-1] <= 0)
