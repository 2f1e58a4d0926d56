"""Random processes of packet dropouts: a Markov chain whose state sets the loss probability of a link."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn.errors import ProblemError

SUMS = 1e-9  # largest deviation of a sum of probabilities from 1


class LossLaw(Displayed, ABC):
    """Base class of the bursty losses of a link.

    The link has states, and it moves from one to the next once per step, whatever is sent. Its first state has the
    stationary distribution. In each state, it drops a packet with a probability of its own.

    A law of one's own is a frozen dataclass with its parameters as fields. It defines ``turns`` and ``losses``;
    simulations, nodes, relays and exact analyses read nothing else.
    """

    @property
    @abstractmethod
    def turns(self) -> Array:
        """Transition probabilities from each state (row) to each state (column), (s, s)."""

    @property
    @abstractmethod
    def losses(self) -> Array:
        """Loss probability in each state, (s,)."""

    @cached_property
    def start(self) -> Array:
        """Stationary distribution of the state, (s,)."""
        return stationary(self.turns)

    @property
    def loss(self) -> float:
        """Stationary loss probability."""
        return float((self.start * self.losses).sum())

    @property
    def constant(self) -> bool:
        """True if the link never leaves its first state."""
        return bool(self.start.max() == 1.0)

    def check(self) -> None:
        """Check the transition probabilities and the losses.

        Raises:
            ProblemError: these are no probabilities, or several stationary distributions exist.
        """
        turns, losses = np.asarray(self.turns), np.asarray(self.losses)
        name, states = type(self).__name__, losses.shape[0] if losses.ndim == 1 else 0
        if states == 0 or turns.shape != (states, states):
            raise ProblemError(
                f"{name} has transition probabilities of shape {turns.shape} and losses of shape {losses.shape}; "
                "expected (s, s) and (s,) for s states"
            )
        if not (np.all(losses >= 0) and np.all(losses <= 1)):
            raise ProblemError(f"{name} has the losses {losses.tolist()}; expected probabilities, in [0, 1]")
        if not np.all(turns >= 0) or np.abs(turns.sum(axis=1) - 1).max() > SUMS:
            raise ProblemError(
                f"{name} has the transition probabilities {turns.tolist()}; expected rows of probabilities with the "
                "sum 1"
            )
        if not self.constant and np.linalg.matrix_rank(turns - np.eye(states)) < states - 1:
            raise ProblemError(
                f"{name} has several groups of states that the link never leaves; expected one, so that its "
                "stationary distribution is unique"
            )

    def pick(self, chances: Array) -> Array:
        """Return the first state of the link for each uniform random number, (paths,)."""
        return _pick(self.start, chances)

    def move(self, chance: float) -> tuple[int, ...]:
        """Return the next state from each state, for one uniform random number."""
        return tuple(int(_pick(row, chance)) for row in self.turns)

    def branches(self) -> list[tuple[list[float], list[float]]]:
        """Return the moves to another state as a list of choices, which a program compares with one random number.

        Each choice holds a limit and a next state for each present state. The first choice whose limit exceeds the
        random number determines the next state; if none does, the state remains.
        """
        leaving = [[(s, p) for s, p in enumerate(row) if s != at and p > 0] for at, row in enumerate(self.turns)]
        found: list[tuple[list[float], list[float]]] = []
        for place in range(max(map(len, leaving))):
            limits = [sum(p for _, p in one[: place + 1]) for one in leaving]
            nexts = [one[place][0] if place < len(one) else at for at, one in enumerate(leaving)]
            found.append(([float(limit) for limit in limits], [float(state) for state in nexts]))
        return found


def stationary(turns: Array) -> Array:
    """Return the stationary distribution of a Markov chain, (s,)."""
    s = len(turns)
    equations = np.vstack([turns.T - np.eye(s), np.ones((1, s))])
    return np.asarray(np.linalg.lstsq(equations, np.append(np.zeros(s), 1.0), rcond=None)[0], dtype=np.float64)


def _pick(chances_of_states: Array, chances: Array | float) -> Array:
    """Return the state whose interval contains a number in [0, 1); the intervals begin with that of the last state."""
    last = len(chances_of_states) - 1
    ends = np.cumsum(chances_of_states[::-1])
    return last - np.minimum(np.searchsorted(ends, chances, side="right"), last)
