"""Bursty packet losses: the loss probability of a link depends on a Markov chain, the state of the channel.

A law is a class derived from ``LossLaw``: the transition probabilities between the states of the link, and the loss
probability in each. ``Burst`` has a good and a bad state (Gilbert and Elliott), ``Chain`` any number of states. A
problem file names the law with the key ``law``; ``OWN`` maps these names to classes. A package registers a law by an
entry point of the group ``taciturn.bursts``. Everything else reads only the probabilities, so a new law needs no other
entry.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache, cached_property
from itertools import product
from typing import Any, NamedTuple, cast

import numpy as np

from taciturn._arrays import Array, number
from taciturn._display import Displayed
from taciturn._plugins import find_plugins, load_entry
from taciturn._text import number_of
from taciturn.errors import ProblemError

SUMS = 1e-9  # largest deviation of a sum of probabilities from 1


class LossLaw(Displayed, ABC):
    """Base class of the models of bursty packet losses.

    The link has states, and it moves from one to the next once per step, whatever is sent. Its first state has the
    stationary distribution. In each state, it drops a packet with a probability of its own.

    A loss model of your own is a frozen dataclass with its parameters as fields. It defines ``turns`` and ``losses``;
    simulations, nodes, relays and exact analyses read nothing else.
    """

    @property
    @abstractmethod
    def turns(self) -> Array:
        """Transition probabilities of the channel state, (s, s): from the state of the row to that of the column."""

    @property
    @abstractmethod
    def losses(self) -> Array:
        """Probability that a packet is dropped, in each channel state, (s,)."""

    @cached_property
    def start(self) -> Array:
        """Stationary distribution of the channel state, (s,)."""
        return stationary(self.turns)

    @property
    def loss(self) -> float:
        """Probability that a packet is dropped if the channel state has its stationary distribution."""
        return float((self.start * self.losses).sum())

    @property
    def constant(self) -> bool:
        """True if the channel always stays in its initial state."""
        return bool(self.start.max() == 1.0)

    def check(self) -> None:
        """Check that the transition and loss probabilities are probabilities, and that their shapes match.

        Raises:
            ProblemError: these are no probabilities, or several stationary distributions exist.
        """
        turns, losses = np.asarray(self.turns), np.asarray(self.losses)
        name, states = type(self).__name__, losses.shape[0] if losses.ndim == 1 else 0
        if states == 0 or turns.shape != (states, states):
            raise ProblemError(
                f"{name} has transition probabilities of shape {turns.shape} and loss probabilities of shape "
                f"{losses.shape}; expected the shapes (s, s) and (s,) for s states"
            )
        if not (np.all(losses >= 0) and np.all(losses <= 1)):
            raise ProblemError(f"{name} has the loss probabilities {losses.tolist()}; expected numbers from 0 to 1")
        if not np.all(turns >= 0) or np.abs(turns.sum(axis=1) - 1).max() > SUMS:
            raise ProblemError(
                f"{name} has the transition probabilities {turns.tolist()}; expected rows of probabilities with the "
                "sum 1"
            )
        if not self.constant and np.linalg.matrix_rank(turns - np.eye(states)) < states - 1:
            raise ProblemError(
                f"{name} has several groups of states that the link never leaves; expected one such group, so that "
                "its stationary distribution is unique"
            )

    def pick(self, chances: Array) -> Array:
        """Draw the initial channel state of each path, (paths,), from a uniform random number per path."""
        return _pick(self.start, chances)

    def move(self, chance: float) -> tuple[int, ...]:
        """Return the next channel state for each present state, given one uniform random number."""
        return tuple(int(_pick(row, chance)) for row in self.turns)

    def branches(self) -> list[tuple[list[float], list[float]]]:
        """Return the transitions between channel states in the form that a program evaluates with one random number.

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
    """Compute the stationary distribution, (s,), of a Markov chain with the transition matrix ``turns``."""
    s = len(turns)
    equations = np.vstack([turns.T - np.eye(s), np.ones((1, s))])
    return np.asarray(np.linalg.lstsq(equations, np.append(np.zeros(s), 1.0), rcond=None)[0], dtype=np.float64)


class Chances(NamedTuple):
    """The cases of a step in which several things fail or not, and a Markov chain by which their chances depend on the
    steps before.
    """

    cases: list[tuple[bool, ...]]  # whether each of them fails
    turns: Array  # transition probabilities between the states, (states, states)
    shares: Array  # share of the steps in each state, (states,)
    odds: Array  # probability of each case in each state, (states, cases)


def together(laws: Sequence[tuple[Array, Array]]) -> Chances:
    """Return the cases of independent laws, each given by transition probabilities and the chance of a failure."""
    turns: Array = np.ones((1, 1))
    shares: Array = np.ones(1)
    chances: list[tuple[float, ...]] = [()]
    for own, drops in laws:
        turns = np.asarray(np.kron(turns, own), dtype=np.float64)
        shares = np.asarray(np.kron(shares, stationary(own)), dtype=np.float64)
        chances = [(*before, drop) for before in chances for drop in drops.tolist()]
    cases = list(product((False, True), repeat=len(laws)))
    odds = [
        [float(np.prod([p if fails else 1 - p for p, fails in zip(state, case, strict=True)])) for case in cases]
        for state in chances
    ]
    return Chances(cases, turns, shares, np.array(odds))


def _pick(chances_of_states: Array, chances: Array | float) -> Array:
    """Return the state whose interval contains a number in [0, 1); the intervals begin with that of the last state."""
    last = len(chances_of_states) - 1
    ends = np.cumsum(chances_of_states[::-1])
    return last - np.minimum(np.searchsorted(ends, chances, side="right"), last)


GROUP = "taciturn.bursts"
USUAL = "gilbert-elliott"


def law_names() -> list[str]:
    """Return the names of all loss models: those of Taciturn, and those of other installed packages."""
    return [*OWN, *(name for name in find_plugins(GROUP) if name not in OWN)]


@cache
def find_law(name: str) -> type[LossLaw]:
    """Return the class of the loss model with the given name; raise an error if there is none."""
    if name not in law_names():
        raise ProblemError(f"law is {name!r}; expected one of the loss laws {', '.join(law_names())}")
    added = find_plugins(GROUP).get(name)
    found = load_entry(added[0], f"the law {name} of losses") if added else OWN[name]
    if not (isinstance(found, type) and issubclass(found, LossLaw)):
        raise ProblemError(f"the loss law {name!r} is {found!r}; expected a class derived from LossLaw")
    return found


def _is_of(law: LossLaw, name: str) -> bool:
    """Return whether a name is that of a law; that of a broken package is not."""
    try:
        return find_law(name) is type(law)
    except ProblemError:
        return False


def law_text(law: LossLaw) -> str:
    """Write a loss model as one word, in the format of the relay's option ``--burst``."""
    name = next((name for name in law_names() if _is_of(law, name)), None)
    if name is None:
        raise ProblemError(
            f"the losses follow the law {type(law).__name__}, which other processes cannot find; expected a "
            f"registered law: register the class by an entry point of the group {GROUP}"
        )
    values = [getattr(law, field.name) for field in fields(cast("Any", law))]
    return f"{name}:{json.dumps(values, separators=(',', ':'))[1:-1]}"


def read_law(name: str, text: str) -> LossLaw:
    """Read a loss model from text such as ``NAME:VALUES``. Text without a name describes the model ``Burst``."""
    stated, colon, values = text.rpartition(":")
    law_name, known = stated if colon else USUAL, law_names()
    try:
        given = cast("list[Any]", json.loads(f"[{values}]") if law_name in known else [])
    except json.JSONDecodeError:
        given = []
    if given and len(given) == len(_keys(law_name)):
        try:
            return find_law(law_name)(*given)
        except ProblemError as error:
            raise ProblemError(f"{name} is {text!r}; {error}") from None
    forms = [f"{one}:{','.join(_keys(one))}" for one in ([stated] if stated in known else known)]
    raise ProblemError(
        f"{name} is {text!r}; expected a text of the form {' or '.join(forms)}, with a number or a list of numbers in "
        "place of each name"
    )


def _keys(law_name: str) -> list[str]:
    return [field.name for field in fields(cast("Any", find_law(law_name)))]


@dataclass(frozen=True, repr=False)
class Burst(LossLaw):
    """Gilbert–Elliott losses: the link has a good and a bad state, and begins in their stationary distribution.

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
        """Transition probabilities between good and bad state, (2, 2)."""
        return np.array([[1 - self.to_bad, self.to_bad], [self.to_good, 1 - self.to_good]])

    @property
    def losses(self) -> Array:
        """Probability that a packet is dropped in the good and in the bad state, (2,)."""
        return np.array([self.loss_good, self.loss_bad])

    @cached_property
    def start(self) -> Array:
        """Stationary distribution of good and bad state, (2,)."""
        return np.array([1 - self.share_bad, self.share_bad])

    @property
    def share_bad(self) -> float:
        """Stationary probability of the bad state. It is 0 if the link always stays in its initial, good state."""
        turns = self.to_bad + self.to_good
        return 0.0 if turns == 0 else self.to_bad / turns


@dataclass(frozen=True, repr=False)
class Chain(LossLaw):
    """Losses of a link with several channel states, such as levels of fading or phases of a periodic jammer."""

    drops: Sequence[float]  # loss probability in each state, in [0, 1]
    moves: Sequence[Sequence[float]]  # probabilities per step of a transition from each state

    def __post_init__(self) -> None:
        """Check the arguments."""
        object.__setattr__(self, "drops", tuple(number("drops", one, 0.0, 1.0, closed=True) for one in self.drops))
        if any(len(row) != len(self.moves) for row in self.moves):
            lengths = ", ".join(str(len(row)) for row in self.moves)
            raise ProblemError(
                f"the rows of 'moves' have {lengths} numbers; expected "
                f"{number_of(len(self.moves), 'number')} in each row"
            )
        moves = tuple(tuple(number("moves", one, 0.0, 1.0, closed=True) for one in row) for row in self.moves)
        object.__setattr__(self, "moves", moves)
        self.check()

    @property
    def turns(self) -> Array:
        """Transition probabilities between the channel states, (s, s)."""
        return np.array(self.moves)

    @property
    def losses(self) -> Array:
        """Probability that a packet is dropped, in each channel state, (s,)."""
        return np.array(self.drops)


OWN: Mapping[str, type[LossLaw]] = {"chain": Chain, "gilbert-elliott": Burst}  # by the name in problem files
