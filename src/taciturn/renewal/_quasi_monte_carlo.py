"""Randomly shifted quasi-Monte Carlo points with a normal distribution, for unbiased averages over noise."""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt

from taciturn import _scipy
from taciturn._arrays import Array, frozen


class Lattice:
    """A fixed set of Sobol points; each use shifts all points by a new random vector.

    Args:
        points: number of points, a power of 2.
        dimensions: dimension of the points, at least 0.
    """

    def __init__(self, points: int, dimensions: int) -> None:
        """Compute the points."""
        self.dimensions = dimensions
        self.places = _places(points, max(dimensions, 1))

    def normals(
        self, draws: np.random.Generator, copies: int, wanted: slice | npt.NDArray[np.bool_] = slice(None)
    ) -> Array:
        """Return standard normal samples, (copies, points, dimensions); each copy is a newly shifted Sobol set.

        Each copy is shifted by an independent uniform draw [cranley1976]. All shifts are drawn, and the wanted copies
        are returned.
        """
        levels = (self.places + draws.random((copies, 1, self.places.shape[1]))[wanted]) % 1.0
        found = _scipy.normal_quantile(np.clip(levels, 1e-300, 1 - 1e-16))
        return found[..., : self.dimensions]


@cache
def _places(points: int, dimensions: int) -> Array:
    """Return Sobol points with a fixed seed, cached, as computing them takes longer than using them."""
    return frozen(_scipy.sobol(dimensions, points, np.random.default_rng(points)))
