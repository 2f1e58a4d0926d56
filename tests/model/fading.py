"""A law of losses of one's own: the levels of a fading radio channel, of which the library has no file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array
from taciturn.model.losses import Chain, LossLaw


@dataclass(frozen=True, repr=False)
class Fading(LossLaw):
    """Equidistant levels of a channel, which moves to a neighbouring level with a given probability."""

    levels: int
    speed: float

    @property
    def turns(self) -> Array:
        """Transition probabilities between the levels; the last ones reflect."""
        half = self.speed / 2 * (np.eye(self.levels, k=1) + np.eye(self.levels, k=-1))
        return half + np.diag(1 - half.sum(axis=1))

    @property
    def losses(self) -> Array:
        """From 0 at the best level to 0.9 at the worst."""
        return np.linspace(0.0, 0.9, self.levels)


LAW = Fading
FADING = Fading(4, 0.5)
JAMMER = Chain((1.0, 0.0, 0.2), ((0, 1, 0), (0, 0, 1), (1, 0, 0)))
