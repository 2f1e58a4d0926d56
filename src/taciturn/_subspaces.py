"""Orthonormal bases of subspaces that linear maps do not leave."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from taciturn._arrays import Array

SAME = 1e-10  # relative length below which a new direction is treated as a rounding error


def invariant(columns: Array, maps: Sequence[Array]) -> Array:
    """Return an orthonormal basis of the least subspace that contains given columns and is invariant under all maps."""
    basis = np.zeros((len(columns), 0))
    new = _added(columns, basis)
    scales = [float(np.linalg.norm(map_, 2)) or 1.0 for map_ in maps]
    while new.shape[1]:
        basis = np.column_stack([basis, new])
        moved = [map_ @ new / scale for map_, scale in zip(maps, scales, strict=True)]
        new = _added(np.column_stack(moved), basis)
    return basis


def unit_columns(columns: Array) -> Array:
    """Return the columns that are not zero, scaled to length 1."""
    lengths = np.linalg.norm(columns, axis=0)
    return columns[:, lengths > 0] / lengths[lengths > 0]


def _added(columns: Array, basis: Array) -> Array:
    """Return orthonormal columns for the part of the given columns that is orthogonal to the basis."""
    rest = columns
    for _ in range(2):  # the second pass removes rounding errors of the first
        rest = rest - basis @ (basis.T @ rest)
    left, values, _ = np.linalg.svd(rest, full_matrices=False)
    return left[:, values > SAME]
