"""Packets that arrive at random times, in the program of a loop: a ring of packets for each link.

A period has q pieces, which begin at the parts of a period at which packets may arrive. The delay d + r of a packet is
stored as the whole number c = d q + i, where the i-th piece begins at r, so that one subtraction per step follows it:

    age 0:    c of the delay that is drawn when the packet is sent, or NEVER if it is lost or nothing is sent
    c < q:    the packet arrives in this step, at the beginning of piece c
    c ≥ q:    it is in flight; its age grows by 1, and c becomes c − q

The newest packet wins: a packet that arrives after a newer one, and all packets older than one that has arrived, are
dropped (c becomes NEVER). A packet of age j keeps what its signals were when it was sent.

The receiver acts when a packet arrives: an actuator that holds its input changes it at the beginning of a piece
(``TimeStep.pieces``), and a node that works once per step hears a packet at its next step. A sender that receives
time-stamped acknowledgements knows at the end of a step what arrived in which piece (``Acted``).
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from taciturn._arrays import Array
from taciturn.model.delay import DelayLaw
from taciturn.model.network import Network
from taciturn.model.policy import Policy
from taciturn.model.steps import Send
from taciturn.program.functions import floor
from taciturn.program.ir import Builder, Truth

NEVER = 1e6  # of a packet that does not arrive


class _Step(Protocol):
    """A step of a loop that is being translated (``translation.TimeStep``)."""

    builder: Builder
    signals: dict[str, list[int]]
    link_states: dict[str, int]

    def recall(self, name: str) -> list[int]:
        """Return the value of a signal, of this step or of the previous one."""
        ...

    def uniform(self) -> int:
        """Draw a random number."""
        ...


class Ring:
    """The packets on a link that were sent in this step or earlier, and are not yet heard."""

    def __init__(self, tick: _Step, link: str, law: DelayLaw, cuts: tuple[float, ...], clocked: bool) -> None:
        """Begin a step. The law counts in periods; a ``clocked`` receiver hears a packet only once per step."""
        self.tick, self.link, self.law, self.pieces = tick, link, law, len(cuts)
        starts = np.array(cuts)
        self.codes: list[float] = []
        for wait in law.waits:
            whole = float(np.ceil(wait)) if clocked else float(np.floor(wait))
            piece = 0 if clocked else int(np.abs(starts - (wait - whole)).argmin())
            self.codes.append(whole * self.pieces + piece)
        self.oldest = int(max(self.codes) // self.pieces)
        self.arrivals: list[int | None] = [None, *(tick.recall(self._arrival(age))[0] for age in self.ages)]
        self.payload: dict[str, list[list[int]]] = {}

    @property
    def ages(self) -> range:
        """Ages of the packets that may still be in flight at the beginning of a step."""
        return range(1, self.oldest + 1)

    def _arrival(self, age: int) -> str:
        return arrival_of(self.link, age)

    def send(self, sent: Truth, payload: tuple[str, ...]) -> None:
        """Take up the packet of this step, if it is sent; draw its delay."""
        tick, b = self.tick, self.tick.builder
        never = b.constant(NEVER)
        self.arrivals[0] = b.choose(sent, self._drawn(), never)
        for name in payload:
            now = tick.recall(name)
            older = [tick.recall(stored(self.link, name, age)) for age in self.ages]
            self.payload[name] = [now, *older]

    def _drawn(self) -> int:
        """Return the number of a delay that is drawn by the law of the link."""
        tick, b, law = self.tick, self.tick.builder, self.law
        if law.sequence:
            (here,) = tick.recall(place_of(self.link))
            moved = b.emit("add", here, b.constant(1.0))
            ended = b.greater(moved, len(law.sequence) - 0.5)
            turned, start = b.greater(1.0 / law.block, tick.uniform()), tick.uniform()
            begun = b.value(floor(b, b.scale(float(len(law.sequence)), start)))
            after = b.choose(ended, b.constant(0.0), moved)
            tick.signals[place_of(self.link)] = [b.choose(turned, begun, after)]
            found = [*self.codes, NEVER]
            return b.value(b.lookup([found[i] for i in law.sequence], here))
        uniform, found = tick.uniform(), b.constant(NEVER)
        sums = np.cumsum(np.array(law.odds), axis=1)
        if law.loses or len(law.odds) > 1:
            last = len(self.codes)
        else:  # the last delay is drawn if no earlier one is
            last, found = len(self.codes) - 1, b.constant(self.codes[-1])
        for place in reversed(range(last)):
            limits = [float(row[place]) for row in sums]
            limit = limits[0] if len(limits) == 1 else b.lookup(limits, tick.link_states[self.link])
            found = b.choose(b.greater(limit, uniform), b.constant(self.codes[place]), found)
        return found

    def acted(self, age: int, piece: int) -> Truth:
        """Return whether the packet of an age arrives in this step, before a piece of it ends."""
        code = self.arrivals[age]
        assert code is not None, "a packet arrives after it is sent"
        return self.tick.builder.less_equal(code, float(piece))

    def arrived(self) -> Truth:
        """Return whether a packet arrives in this step."""
        b, found = self.tick.builder, False
        for age in (0, *self.ages):
            found = b.either(found, self.acted(age, self.pieces - 1))
        return found

    def newest(self, values: list[list[int]], otherwise: list[int], piece: int) -> list[int]:
        """Return the value, of those by age, of the newest packet that has arrived before a piece ends."""
        found = otherwise
        for age in reversed((0, *self.ages)):
            here = self.acted(age, piece)
            found = [self.tick.builder.choose(here, *one) for one in zip(values[age], found, strict=True)]
        return found

    def end(self) -> None:
        """Let the packets grow older, and drop those that are older than one that has arrived."""
        tick, b, newer = self.tick, self.tick.builder, False
        never, step = b.constant(NEVER), b.constant(-float(self.pieces))
        for age in range(self.oldest):
            code = self.arrivals[age]
            assert code is not None, "every packet is sent within its step"
            newer = b.either(newer, self.acted(age, self.pieces - 1))
            gone = b.either(newer, b.greater(code, NEVER / 2))
            tick.signals[self._arrival(age + 1)] = [b.choose(gone, never, b.emit("add", code, step))]
            for name, values in self.payload.items():
                tick.signals[stored(self.link, name, age + 1)] = values[age]


def memories(policy: Policy, network: Network) -> tuple[dict[str, int], dict[str, Array | str]]:
    """Return sizes and initial values of the memories of all packets that may be on their way, and of traces."""
    sizes, initial = dict[str, int](), dict[str, Array | str]()
    for step in (step for step in policy.steps if isinstance(step, Send)):
        law = network.random_delay(step.link, policy.tick)
        if law is None:
            continue
        if law.sequence:
            sizes[place_of(step.link)], initial[place_of(step.link)] = 1, place_of(step.link)
        for age in range(1, int(np.ceil(max(law.waits))) + 1):
            sizes[arrival_of(step.link, age)], initial[arrival_of(step.link, age)] = 1, np.array([NEVER])
            sizes |= {stored(step.link, name, age): policy.sizes[name] for name in step.payload}
    return sizes, initial


def arrival_of(link: str, age: int) -> str:
    """Return the name of the memory for the arrival of a packet that was sent ``age`` steps ago."""
    return f"arrival of the {link} packet of age {age}"


def stored(link: str, signal: str, age: int) -> str:
    """Return the name of the memory for a signal in a packet that was sent ``age`` steps ago."""
    return f"{signal} in the {link} packet of age {age}"


def place_of(link: str) -> str:
    """Return the name of the memory for the place in the trace of a link."""
    return f"place in the trace of {link}"
