"""Normals for means over noises: few points that fill space evenly, shifted at random so that the means are fair."""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt

from taciturn import _scipy
from taciturn._arrays import Array, frozen


class Lattice:
    """Sobol points, as many and of as many dimensions as are asked for.

    Args:
        points: a power of 2.
        dimensions: at least 0.
    """

    def __init__(self, points: int, dimensions: int) -> None:
        """Place the points."""
        self.dimensions = dimensions
        self.places = _places(points, max(dimensions, 1))

    def normals(
        self, draws: np.random.Generator, copies: int, wanted: slice | npt.NDArray[np.bool_] = slice(None)
    ) -> Array:
        """Return standard normals, (copies, points, dimensions): every row is a draw, those of a copy spread evenly.

        Each copy is shifted by a uniform draw of its own [cranley1976]; of those that are drawn, the wanted ones are
        returned.
        """
        levels = (self.places + draws.random((copies, 1, self.places.shape[1]))[wanted]) % 1.0
        found = _scipy.normal_quantile(np.clip(levels, 1e-300, 1 - 1e-16))
        return found[..., : self.dimensions]


@cache
def _places(points: int, dimensions: int) -> Array:
    """Return Sobol's points, always the same: they are a few kilobytes, and take longer than what they are for."""
    return frozen(_scipy.sobol(dimensions, points, np.random.default_rng(points)))
