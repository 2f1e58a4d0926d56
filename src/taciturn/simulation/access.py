"""Who may send on a channel that many loops share: one rule per class, asked once per tick."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array, Bits

Places: TypeAlias = npt.NDArray[np.int64]
ARRIVALS = float(np.exp(-1))  # new packets per slot that a busy channel of random access carries
COLLISION = 1 / (np.e - 2)  # packets more than one that a collision tells of, on average


@dataclass(frozen=True, eq=False)
class Grant:
    """What became of the wishes of a tick.

    Args:
        sent: what got through, (channels, loops).
        busy: what was on the channel, collisions included, (channels,).
    """

    sent: Bits
    busy: Array


class Access(Protocol):
    """A rule. It may remember: an object serves one simulation."""

    def grant(self, tick: int, at: Places, urgency: Array) -> Grant:
        """Return who sends.

        Args:
            tick: number of the tick.
            at: the loops that look at their error in this tick, (loops,).
            urgency: of each on each of some independent channels, (channels, loops); above 0 it wants to send.
        """
        ...


class MostUrgent:
    """Those with the highest urgency send, as many as there are slots, whether they want to or not: a slot is free.

    Args:
        capacity: sends per tick.
    """

    def __init__(self, capacity: int) -> None:
        """Remember nothing else."""
        self.capacity = capacity

    def grant(self, tick: int, at: Places, urgency: Array) -> Grant:
        """Let those send."""
        sent = _lowest(-urgency, self.capacity)
        return Grant(sent, sent.sum(axis=1).astype(np.float64))


class RoundRobin:
    """Those send that have sent least often, in a fixed order: each in its turn.

    Args:
        capacity: sends per tick.
        loops: how many there are.
    """

    def __init__(self, capacity: int, loops: int) -> None:
        """Begin with the first."""
        self.capacity, self.loops = capacity, loops
        self.turns = np.arange(loops, dtype=np.float64)

    def grant(self, tick: int, at: Places, urgency: Array) -> Grant:
        """Let the next send."""
        sent = _lowest(self.turns[None, at], self.capacity)
        self.turns[at[sent[0]]] += self.loops
        return _alike(sent, len(urgency))


class TimeDivision:
    """Every loop sends at its own rate: whoever is due, the first to be due again before the others.

    Args:
        capacity: sends per tick.
        rates: sends per tick of each loop, (loops,); 0: never.
        phases: share of its interval after which each is first due, (loops,).
    """

    def __init__(self, capacity: int, rates: Array, phases: Array) -> None:
        """Plan the first sends."""
        self.capacity = capacity
        with np.errstate(divide="ignore"):
            self.interval = 1 / rates
        self.due = phases * np.where(rates > 0, self.interval, 0.0) + np.where(rates > 0, 0.0, np.inf)

    def grant(self, tick: int, at: Places, urgency: Array) -> Grant:
        """Let those send that are due."""
        due = self.due[at]
        ready = np.flatnonzero(due <= tick)
        if len(ready) > self.capacity:
            again = due[ready] + self.interval[at[ready]]
            ready = ready[np.argsort(again, kind="stable")[: self.capacity]]
        self.due[at[ready]] += self.interval[at[ready]]
        sent = np.zeros((1, len(at)), dtype=np.bool_)
        sent[0, ready] = True
        return _alike(sent, len(urgency))


class RandomAccess:
    """Those with an urgency above 0 send in a slot drawn at random; where two meet, neither gets through.

    All hear which slots were empty, used, or collided. From it they estimate the backlog n of a channel, and send with
    the probability min(1, slots/n) (pseudo-Bayesian control of slotted ALOHA).

    Args:
        slots: per tick.
        seed: of the draws.

    Source: rivest1987
    """

    def __init__(self, slots: int, seed: int) -> None:
        """Begin with an empty channel."""
        self.slots, self.draws, self.backlog = slots, np.random.default_rng(seed), np.zeros(1)

    def grant(self, tick: int, at: Places, urgency: Array) -> Grant:
        """Draw who sends in which slot."""
        channels = len(urgency)
        backlog = np.broadcast_to(self.backlog, channels)
        tries = (urgency > 0) & (
            self.draws.random(urgency.shape) * np.maximum(backlog, self.slots)[:, None] < self.slots
        )
        channel, loop = np.nonzero(tries)
        slot = channel * self.slots + self.draws.integers(self.slots, size=len(channel))
        used = np.bincount(slot, minlength=channels * self.slots)
        alone = used[slot] == 1
        sent = np.zeros(urgency.shape, dtype=np.bool_)
        sent[channel[alone], loop[alone]] = True
        collided = (used.reshape(channels, self.slots) > 1).sum(axis=1)
        told = collided * COLLISION - (self.slots - collided)
        self.backlog = self.slots * ARRIVALS + np.maximum(backlog + told, 0.0)
        return Grant(sent, tries.sum(axis=1).astype(np.float64))


def _lowest(values: Array, most: int) -> Bits:
    """Return which are the lowest of each row, at most so many."""
    if values.shape[1] <= most:
        return np.ones(values.shape, dtype=np.bool_)
    chosen = np.zeros(values.shape, dtype=np.bool_)
    np.put_along_axis(chosen, np.argpartition(values, most - 1, axis=1)[:, :most], True, axis=1)
    return chosen


def _alike(sent: Bits, channels: int) -> Grant:
    """Return the same grant on all channels."""
    return Grant(np.broadcast_to(sent, (channels, sent.shape[1])), np.full(channels, float(sent.sum())))
