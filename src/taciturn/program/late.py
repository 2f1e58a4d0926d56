"""Packets that arrive at random times, in the program of a loop: a ring of packets for each link.

A period has q pieces, which begin at the parts of a period at which packets may arrive. The delay d + r of a packet is
stored as the whole number c = d q + i, where the i-th piece begins at r, so that one subtraction per step follows it:

    age 0:    c of the delay that is drawn when the packet is sent, or NEVER if it is lost or nothing is sent
    c < q:    the packet arrives in this step, at the beginning of piece c
    c ≥ q:    it is in flight; its age grows by 1, and c becomes c − q

The newest packet wins: a packet that arrives after a newer one, and all packets older than one that has arrived, are
dropped (c becomes NEVER). If the receiver uses the packet of each age (``Received.of_age``), none is dropped. A packet
of age j keeps what its signals were when it was sent.

The receiver acts when a packet arrives: an actuator that holds its input changes it at the beginning of a piece
(``TimeStep.pieces``), and a node that works once per step hears a packet at its next step. A sender that receives
time-stamped acknowledgements knows at the end of a step what arrived in which piece (``Acted``), or of a link with late
acknowledgements, what arrived in the step before.

A node that runs apart from the others has no ring: its inputs are the packets that have arrived, for each piece the
newest one (``Heard``), so that its program selects the same values. Its inbox drops the older ones (``nodes.inbox``).
The flag of such a packet is 1 plus its age in steps, so that a receiver may use each age in its own way. A node that
uses all packets hears them once per step, and its inputs are the packets by their ages in place of pieces.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, TypeAlias

import numpy as np

from taciturn._arrays import Array
from taciturn.model.delay import DelayLaw
from taciturn.model.network import Network
from taciturn.model.policy import Policy
from taciturn.model.steps import Received, Send
from taciturn.program.functions import floor
from taciturn.program.ir import Builder, Truth
from taciturn.program.ops import Entry, Name

Values: TypeAlias = list[int]  # operations that compute the entries of a signal
Sum: TypeAlias = Callable[[Mapping[str, Values]], Values]  # a sum of the signals in a packet
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

    def delayed(self, link: str, drawn: int) -> int:
        """Return the delay of the packet of this step, which is the drawn one unless another is given."""
        ...


class Ring:
    """The packets on a link that were sent in this step or earlier, and are not yet heard."""

    def __init__(
        self,
        tick: _Step,
        link: str,
        law: DelayLaw,
        cuts: tuple[float, ...],
        clocked: bool,
        told_late: bool,
        every: bool = False,
    ) -> None:
        """Begin a step. The law counts in periods; a ``clocked`` receiver hears a packet only once per step.

        It uses ``every`` packet, or only those that no newer one has overtaken.
        """
        self.tick, self.link, self.law, self.pieces, self._every = tick, link, law, len(cuts), every
        self.codes = codes_of(law, cuts, clocked)
        self.oldest = int(max(self.codes) // self.pieces)
        self.arrivals = {age: tick.recall(self._arrival(age))[0] for age in self.ages}  # by age; 0 when it is sent
        self.payload: dict[str, list[list[int]]] = {}
        self._told_late = told_late  # whether an acknowledgement tells of the step before
        self._told: dict[int, int] = {}  # arrivals of the step before, by age

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
        self.arrivals[0] = b.choose(sent, tick.delayed(self.link, self._drawn()), never)
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
        for place in reversed(range(last)):  # the first limit above the random number decides, so it is applied last
            limits = [float(row[place]) for row in sums]
            limit = limits[0] if len(limits) == 1 else b.lookup(limits, tick.link_states[self.link])
            found = b.choose(b.greater(limit, uniform), b.constant(self.codes[place]), found)
        return found

    def acted(self, age: int, piece: int) -> Truth:
        """Return whether the packet of an age arrives in this step, before a piece of it ends."""
        if age > self.oldest:  # as in a loop with shorter delays than those of the design
            return False
        return self.tick.builder.less_equal(self.arrivals[age], float(piece))

    def told(self, age: int, piece: int) -> Truth:
        """Return whether an acknowledgement that comes in this step tells that the packet of an age has arrived."""
        if not self._told_late or age > self.oldest:
            return self.acted(age, piece)
        if age not in self._told:
            self._told[age] = self.tick.recall(told_of(self.link, age))[0]
        return self.tick.builder.less_equal(self._told[age], float(piece))

    def assigned(self, sums: Sequence[Sum], silent: Values) -> list[Values]:
        """Return in each piece a sum of the signals in the newest packet that has arrived, or what it is otherwise.

        There is one sum, or one for each age of the packet.
        """
        by_age = list[Values]()
        for age in (0, *self.ages):
            packet = {name: values[age] for name, values in self.payload.items()}
            by_age.append(sums[age if len(sums) > 1 else 0](packet))
        return [self.newest(by_age, silent, piece) for piece in range(self.pieces)]

    def of_age(self, age: int, sum_of: Sum, silent: Values) -> Values:
        """Return a sum of the signals in the packet of an age if it arrives in this step, or what it is otherwise."""
        if age > self.oldest:
            return silent
        values = sum_of({name: values[age] for name, values in self.payload.items()})
        here = self.acted(age, self.pieces - 1)
        return [self.tick.builder.choose(here, *one) for one in zip(values, silent, strict=True)]

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
        """Let the packets grow older, and drop those that have arrived, or that a newer one has overtaken."""
        if 0 not in self.arrivals:  # the program ends before the packet is sent
            return
        tick, b, newer = self.tick, self.tick.builder, False
        never, step = b.constant(NEVER), b.constant(-float(self.pieces))
        for age in self._told:
            tick.signals[told_of(self.link, age)] = [self.arrivals[age]]
        for age in range(self.oldest):
            here = self.acted(age, self.pieces - 1)
            newer = here if self._every else b.either(newer, here)
            code = self.arrivals[age]
            gone = b.either(newer, b.greater(code, NEVER / 2))  # also where steps were subtracted from NEVER
            tick.signals[self._arrival(age + 1)] = [b.choose(gone, never, b.emit("add", code, step))]
            for name, values in self.payload.items():
                tick.signals[stored(self.link, name, age + 1)] = values[age]


class Heard:
    """The packets that a node hears in a step, as inputs of its program: for each piece the newest one, or none.

    If the node uses all packets, there is one for each age.
    """

    def __init__(self, tick: _Step, link: str, pieces: int, sizes: Mapping[str, int]) -> None:
        """Begin a step; ``sizes`` are the numbers of entries of the signals in a packet."""
        self.tick, self.link, self.pieces, self._sizes = tick, link, pieces, sizes

    def assigned(self, sums: Sequence[Sum], silent: Values) -> list[Values]:
        """Return in each piece a sum of the signals in the newest packet that has arrived, or what it is otherwise.

        There is one sum, or one for each age of the packet. A packet that is older than all of them is not used.
        """
        b, found = self.tick.builder, list[Values]()
        for piece in range(self.pieces):
            flag = b.input(flag_of(self.link, piece))
            here, values = b.greater(flag, 0.0), silent
            packet = self._packet(piece)
            if len(sums) == 1:
                values = sums[0](packet)
            for age, sum_of in reversed([*enumerate(sums, start=1)] if len(sums) > 1 else []):
                young = b.less_equal(flag, float(age))
                values = [b.choose(young, *one) for one in zip(sum_of(packet), values, strict=True)]
            found.append([b.choose(here, *one) for one in zip(values, silent, strict=True)])
        return found

    def of_age(self, age: int, sum_of: Sum, silent: Values) -> Values:
        """Return a sum of the signals in the packet of an age if it arrives in this step, or what it is otherwise."""
        b = self.tick.builder
        here = b.greater(b.input(flag_of(self.link, age)), 0.0)
        return [b.choose(here, *one) for one in zip(sum_of(self._packet(age)), silent, strict=True)]

    def _packet(self, place: int) -> dict[str, Values]:
        """Return the inputs with the signals in the packet of a piece, or of an age if all packets are used."""
        b = self.tick.builder
        return {
            name: [b.input(Entry(name, i, self.link, place)) for i in range(size)] for name, size in self._sizes.items()
        }


def flag_of(link: str, piece: int) -> Name:
    """Return the name of the program input for a packet that has arrived in a step, before a piece ends.

    It is 0 without a packet, and otherwise 1 plus its age in steps. Where all packets are used, each age has one.
    """
    return Entry("arrived", 0, link, piece) if piece else Received(link)


def codes_of(law: DelayLaw, cuts: tuple[float, ...], clocked: bool) -> list[float]:
    """Return the delays of a law as whole numbers of pieces; a clocked receiver hears packets when a step begins."""
    starts, found = np.array(cuts), list[float]()
    for wait in law.waits:
        whole = float(np.ceil(wait)) if clocked else float(np.floor(wait))
        piece = 0 if clocked else int(np.abs(starts - (wait - whole)).argmin())
        found.append(whole * len(cuts) + piece)
    return found


def is_clocked(network: Network, link: str) -> bool:
    """Return whether the receiver of a link hears packets only when its step begins, as a controller does."""
    return network.nodes[link].measures is not False


def pieces_of_links(network: Network, period: float) -> dict[str, int]:
    """Return for each link with random delays in how many pieces of a period its receiver may hear a packet."""
    count = len(network.cuts(period) or (0.0,))
    return {link: 1 if is_clocked(network, link) else count for link in network.late}


def memories(policy: Policy, network: Network) -> tuple[dict[str, int], dict[str, Array | str]]:
    """Return sizes and initial values of the memories of all packets that may be on their way, and of traces."""
    sizes, initial = dict[str, int](), dict[str, Array | str]()
    for step in (step for step in policy.steps if isinstance(step, Send)):
        law = network.random_delay(step.link, policy.tick)
        if law is None:
            continue
        if law.sequence:
            sizes[place_of(step.link)], initial[place_of(step.link)] = 1, place_of(step.link)
        oldest = network.longest(step.link, policy.tick)
        told = range(oldest + 1) if network.links[step.link].acknowledgement_delay else ()
        sizes |= dict.fromkeys((told_of(step.link, age) for age in told), 1)
        initial |= {told_of(step.link, age): np.array([NEVER]) for age in told}
        for age in range(1, oldest + 1):
            sizes[arrival_of(step.link, age)], initial[arrival_of(step.link, age)] = 1, np.array([NEVER])
            sizes |= {stored(step.link, name, age): policy.sizes[name] for name in step.payload}
    return sizes, initial


def arrival_of(link: str, age: int) -> str:
    """Return the name of the memory for the arrival of a packet that was sent ``age`` steps ago."""
    return f"arrival of the {link} packet of age {age}"


def told_of(link: str, age: int) -> str:
    """Return the name of the memory for the arrival of a packet of an age in the last step, for its acknowledgement."""
    return f"told arrival of the {link} packet of age {age}"


def stored(link: str, signal: str, age: int) -> str:
    """Return the name of the memory for a signal in a packet that was sent ``age`` steps ago."""
    return f"{signal} in the {link} packet of age {age}"


def place_of(link: str) -> str:
    """Return the name of the memory for the place in the trace of a link."""
    return f"place in the trace of {link}"
