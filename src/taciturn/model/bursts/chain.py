"""Losses with any number of states of the link."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, number
from taciturn.errors import ProblemError
from taciturn.model.losses import LossLaw


@dataclass(frozen=True, repr=False)
class Chain(LossLaw):
    """Losses of a link with any states, such as the levels of a fading channel or the phases of a periodic jammer.

    Args:
        drops: loss probability in each state, in [0, 1].
        moves: probabilities per step of a transition from each state (row) to each state (column).

    Raises:
        ProblemError: if a number is not a probability, the sum of a row is not 1, or the stationary distribution is
            not unique.

    Example:
        >>> jammer = Chain(drops=(1.0, 0.0, 0.0), moves=((0, 1, 0), (0, 0, 1), (1, 0, 0)))  # every third step
        >>> round(jammer.loss, 12)
        0.333333333333
    """

    drops: Sequence[float]
    moves: Sequence[Sequence[float]]

    def __post_init__(self) -> None:
        """Check the arguments."""
        object.__setattr__(self, "drops", tuple(number("drops", one, 0.0, 1.0, closed=True) for one in self.drops))
        if any(len(row) != len(self.moves) for row in self.moves):
            lengths = ", ".join(str(len(row)) for row in self.moves)
            raise ProblemError(f"moves has rows of {lengths} numbers; expected {len(self.moves)} in each")
        moves = tuple(tuple(number("moves", one, 0.0, 1.0, closed=True) for one in row) for row in self.moves)
        object.__setattr__(self, "moves", moves)
        self.check()

    @property
    def turns(self) -> Array:
        """Transition probabilities between the states, (s, s)."""
        return np.array(self.moves)

    @property
    def losses(self) -> Array:
        """Loss probability in each state, (s,)."""
        return np.array(self.drops)


LAW = Chain
