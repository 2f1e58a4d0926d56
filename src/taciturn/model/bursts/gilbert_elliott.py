"""Losses with a good and a bad state of the link."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from taciturn._arrays import Array, number
from taciturn.model.losses import LossLaw


@dataclass(frozen=True, repr=False)
class Burst(LossLaw):
    """Gilbert–Elliott losses of a link with a good and a bad state; the initial state has the stationary distribution.

    Args:
        to_bad: probability per step of a transition from good to bad, in [0, 1].
        to_good: probability per step of a transition from bad to good, in [0, 1].
        loss_good: loss probability in the good state, in [0, 1].
        loss_bad: loss probability in the bad state, in [0, 1].

    Raises:
        ProblemError: if a probability is outside [0, 1].

    Source: gilbert1960, elliott1963
    """

    to_bad: float
    to_good: float
    loss_good: float
    loss_bad: float

    def __post_init__(self) -> None:
        """Check the ranges of the arguments."""
        for name in ("to_bad", "to_good", "loss_good", "loss_bad"):
            object.__setattr__(self, name, number(name, getattr(self, name), 0.0, 1.0, closed=True))

    @property
    def turns(self) -> Array:
        """Transition probabilities between good and bad, (2, 2)."""
        return np.array([[1 - self.to_bad, self.to_bad], [self.to_good, 1 - self.to_good]])

    @property
    def losses(self) -> Array:
        """Loss probability in the good and in the bad state, (2,)."""
        return np.array([self.loss_good, self.loss_bad])

    @cached_property
    def start(self) -> Array:
        """Stationary distribution of the state, (2,)."""
        return np.array([1 - self.share_bad, self.share_bad])

    @property
    def share_bad(self) -> float:
        """Stationary probability of the bad state; 0 for a link that remains in its initial good state."""
        turns = self.to_bad + self.to_good
        return 0.0 if turns == 0 else self.to_bad / turns


LAW = Burst
