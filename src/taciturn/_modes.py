"""Which modes of A the columns of B cannot move (Popov–Belevitch–Hautus test)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array

TOLERANCE = 1e-9  # relative to the norm of [A, B]; a mode nearer to uncontrollable than this is lost to rounding anyway


def uncontrollable_modes(A: Array, B: Array) -> npt.NDArray[np.complex128]:
    """Return the eigenvalues λ of A at which [A − λI, B] loses rank.

    Applied to (A', C') it returns the unobservable modes.
    """
    size = A.shape[0]
    values = np.linalg.eigvals(A).astype(np.complex128)
    pencils = np.concatenate(
        [A[None] - values[:, None, None] * np.eye(size), np.broadcast_to(B, (size, *B.shape))], axis=2
    )
    smallest = np.linalg.svd(pencils, compute_uv=False)[:, -1]
    scale = max(float(np.linalg.norm(A, 2)), float(np.linalg.norm(B, 2)) if B.size else 0.0, 1e-300)
    return values[smallest <= TOLERANCE * scale]
