"""Access rules that decide which loops are allowed to send on a shared channel, one class for each rule."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array, Bits
from taciturn._display import Displayed

Places: TypeAlias = npt.NDArray[np.int64]
ARRIVALS = float(np.exp(-1))  # new packets per slot at the largest throughput of random access
COLLISION = 1 / (np.e - 2)  # mean number of additional packets in a collision


@dataclass(frozen=True, eq=False, repr=False)
class Grant(Displayed):
    """Result of an access rule in one step: which loops sent, and how many packets were on the channel.

    Args:
        sent: whether each loop sent successfully, (channels, loops).
        busy: number of packets on the channel, including collisions, (channels,).
    """

    sent: Bits
    busy: Array


class Access(Protocol):
    """An access rule of a shared channel; because it can have internal state, use one object for each simulation."""

    def grant(self, tick: int, at: Places, urgency: Array) -> Grant:
        """Return which loops send.

        Args:
            tick: number of the step.
            at: the loops that check their error in this step, (loops,).
            urgency: urgency of each of these loops on each independent channel, (channels, loops); above 0, a loop
                requests a send.
        """
        ...


class MostUrgent:
    """Access rule in which the loops with the highest urgency use all slots, even if they do not request a send.

    Args:
        capacity: sends per step.
    """

    def __init__(self, capacity: int) -> None:
        """Store the capacity."""
        self.capacity = capacity

    def grant(self, tick: int, at: Places, urgency: Array) -> Grant:
        """Grant the slots of this step to the loops with the highest urgency."""
        sent = _lowest(-urgency, self.capacity)
        return Grant(sent, sent.sum(axis=1).astype(np.float64))


class RoundRobin:
    """Access rule in which the loops take turns to send in a fixed order.

    Args:
        capacity: sends per step.
        loops: number of loops.
    """

    def __init__(self, capacity: int, loops: int) -> None:
        """Start with the first loop."""
        self.capacity, self.loops = capacity, loops
        self.turns = np.arange(loops, dtype=np.float64)

    def grant(self, tick: int, at: Places, urgency: Array) -> Grant:
        """Grant the slots of this step to the next loops in the fixed order."""
        sent = _lowest(self.turns[None, at], self.capacity)
        self.turns[at[sent[0]]] += self.loops
        return _alike(sent, len(urgency))


class TimeDivision:
    """Access rule in which every loop sends periodically at its own rate.

    If too many sends are due, loops whose next send is earlier have priority.

    Args:
        capacity: sends per step.
        rates: sends per step of each loop, (loops,); a loop with rate 0 never sends.
        phases: time of the first send of each loop, as a share of its interval, (loops,).
    """

    def __init__(self, capacity: int, rates: Array, phases: Array) -> None:
        """Plan the first sends."""
        self.capacity = capacity
        with np.errstate(divide="ignore"):
            self.interval = 1 / rates
        self.due = phases * np.where(rates > 0, self.interval, 0.0) + np.where(rates > 0, 0.0, np.inf)

    def grant(self, tick: int, at: Places, urgency: Array) -> Grant:
        """Grant the slots of this step to the loops whose periodic sends are due."""
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
    """Access rule in which loops with an urgency above 0 send in random slots; packets in the same slot collide.

    All loops observe which slots were empty, used or collided. They use it to estimate the backlog n of a channel, and
    send with the probability min(1, slots/n) (pseudo-Bayesian control of slotted ALOHA).

    Args:
        slots: slots per step.
        seed: seed of the random draws.

    Source: rivest1987
    """

    def __init__(self, slots: int, seed: int) -> None:
        """Start with an empty channel."""
        self.slots, self.draws, self.backlog = slots, np.random.default_rng(seed), np.zeros(1)

    def grant(self, tick: int, at: Places, urgency: Array) -> Grant:
        """Draw a random slot for each sending loop, and return the loops whose packets do not collide."""
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
    """Return a mask of the lowest values in each row, at most ``most`` of them."""
    if values.shape[1] <= most:
        return np.ones(values.shape, dtype=np.bool_)
    chosen = np.zeros(values.shape, dtype=np.bool_)
    np.put_along_axis(chosen, np.argpartition(values, most - 1, axis=1)[:, :most], True, axis=1)
    return chosen


def _alike(sent: Bits, channels: int) -> Grant:
    """Return the same grant on all channels."""
    return Grant(np.broadcast_to(sent, (channels, sent.shape[1])), np.full(channels, float(sent.sum())))
