"""Faults of links, processes, clocks and keys as plain data, and their random choice for a seed.

Times are steps of the plant. A fault of a link changes datagrams that are sent while it lasts. Its random draws depend
on its own seed and the number of the datagram alone, so a fault acts alike if other faults are left out of a list.
Nodes with keys also meet attacks: recordings, forged packets, and changes of keys.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from taciturn.extend import Displayed, percent
from taciturn_udp.relay import flip_bits, uniform

_LOSS, _DELAY, _TIME, _COPY, _HARM = range(21, 26)
CUT = 40  # steps for which a process is cut at least when it starts again, continues, or its clock jumps
DRIFT = 4e-4  # largest relative error of a clock's speed, so that two clocks differ by less than 0.1 %
Path: TypeAlias = tuple[str, str]  # names of the processes that send and receive
Flights: TypeAlias = list[tuple[float, bytes]]  # delay in steps and content of every copy of a datagram


@dataclass(frozen=True, repr=False)
class Fault(Displayed, ABC):
    """A fault.

    Args:
        first: step in which it begins.
        steps: number of steps that it lasts.
    """

    first: int
    steps: int

    @property
    def end(self) -> float:
        """Step from which on it has no direct effect."""
        return self.first + self.steps

    def text(self) -> str:
        """Return the fault as a line of text."""
        return f"steps {self.first} to {self.first + self.steps - 1}: {self.what()}"

    @abstractmethod
    def what(self) -> str:
        """Return what happens, in words."""


@dataclass(frozen=True, repr=False)
class LinkFault(Fault):
    """A fault of a link in one direction."""

    path: Path  # sender and receiver
    share: float = 1.0  # probability that a datagram is affected
    seed: int = 0  # seed of the random draws

    @abstractmethod
    def act(self, flights: Flights, number: int) -> Flights:
        """Return what becomes of a datagram with this number on its path."""

    def what(self) -> str:
        """Return what happens, in words."""
        affected = "every datagram" if self.share >= 1 else f"{percent(self.share, 0)} of the datagrams"
        return f"{affected} from {self.path[0]} to {self.path[1]} {self.effect()}"

    @abstractmethod
    def effect(self) -> str:
        """Return the verb of the sentence."""

    def _hits(self, purpose: int, number: int) -> bool:
        return uniform(self.seed, purpose, number) < self.share


class Loss(LinkFault):
    """Datagrams are dropped; with share 1 the link is cut, as in a partition."""

    def act(self, flights: Flights, number: int) -> Flights:
        """Drop the datagram."""
        return [] if self._hits(_LOSS, number) else flights

    def effect(self) -> str:
        """Return the verb of the sentence."""
        return "is dropped" if self.share >= 1 else "are dropped"


@dataclass(frozen=True, repr=False)
class Delay(LinkFault):
    """Datagrams arrive late. Some of them, or a random delay, also changes their order."""

    least: float = 0.0  # smallest delay in steps
    most: float = 1.0  # largest delay in steps

    @property
    def end(self) -> float:
        """Step from which on it has no direct effect."""
        return self.first + self.steps + self.most

    def act(self, flights: Flights, number: int) -> Flights:
        """Delay all copies of the datagram alike."""
        if not self._hits(_DELAY, number):
            return flights
        by = self.least + (self.most - self.least) * uniform(self.seed, _TIME, number)
        return [(delay + by, datagram) for delay, datagram in flights]

    def effect(self) -> str:
        """Return the verb of the sentence."""
        verb = "arrives" if self.share >= 1 else "arrive"
        late = f"{self.least:g} to {self.most:g}" if self.most > self.least else f"{self.most:g}"
        return f"{verb} {late} steps late"


@dataclass(frozen=True, repr=False)
class Duplicate(LinkFault):
    """Datagrams arrive twice."""

    most: float = 1.0  # largest delay of the copy in steps

    @property
    def end(self) -> float:
        """Step from which on it has no direct effect."""
        return self.first + self.steps + self.most

    def act(self, flights: Flights, number: int) -> Flights:
        """Add a copy."""
        if not self._hits(_COPY, number):
            return flights
        by = self.most * uniform(self.seed, _TIME, number)
        return flights + [(delay + by, datagram) for delay, datagram in flights]

    def effect(self) -> str:
        """Return the verb of the sentence."""
        return f"{'arrives' if self.share >= 1 else 'arrive'} twice, within {self.most:g} steps"


class Corruption(LinkFault):
    """One to three bits of datagrams are inverted."""

    def act(self, flights: Flights, number: int) -> Flights:
        """Invert bits of the datagram."""
        if not self._hits(_HARM, number):
            return flights
        return [(delay, flip_bits(datagram, self.seed, number)) for delay, datagram in flights]

    def effect(self) -> str:
        """Return the verb of the sentence."""
        return f"{'loses' if self.share >= 1 else 'lose'} one to three bits"


@dataclass(frozen=True, repr=False)
class Replay(Fault):
    """Datagrams of the same session are sent again: in each step, those that were sent some steps earlier."""

    path: Path  # sender and receiver
    age: int  # number of steps since they were sent

    def what(self) -> str:
        """Return what happens, in words."""
        return f"datagrams from {self.path[0]} to {self.path[1]} are sent again after {self.age} steps"


@dataclass(frozen=True, repr=False)
class ProcessFault(Fault):
    """A fault of a process, or of the machine on which it runs."""

    role: str  # name of the process


@dataclass(frozen=True, repr=False)
class Crash(ProcessFault):
    """A process is killed, and started again after some steps."""

    kept: bool  # whether it starts from its saved state

    def what(self) -> str:
        """Return what happens, in words."""
        return f"the {self.role} does not run, and starts again {'with' if self.kept else 'without'} its state"


class Pause(ProcessFault):
    """A process is suspended."""

    def what(self) -> str:
        """Return what happens, in words."""
        return f"the {self.role} is suspended"


@dataclass(frozen=True, repr=False)
class Jump(ProcessFault):
    """The clock of a machine jumps.

    Args:
        by: steps by which the clock jumps, forward or (negative) back.
    """

    by: float

    def text(self) -> str:
        """Return the fault as a line of text."""
        return f"step {self.first}: {self.what()}"

    def what(self) -> str:
        """Return what happens, in words."""
        return f"the clock of the {self.role} jumps {'forward' if self.by > 0 else 'back'} by {abs(self.by):g} steps"


@dataclass(frozen=True, repr=False)
class Skew(ProcessFault):
    """A fault from which on the clock of a machine is fast or slow; the fault lasts to the end of the world."""

    by: float  # relative error of its speed

    def text(self) -> str:
        """Return the fault as a line of text."""
        return f"from step {self.first}: {self.what()}"

    def what(self) -> str:
        """Return what happens, in words."""
        return f"the clock of the {self.role} is {percent(abs(self.by), 2)} {'fast' if self.by > 0 else 'slow'}"


def draw_faults(seed: int, paths: Sequence[Path], roles: Sequence[str], within: int) -> tuple[Fault, ...]:
    """Return one to five random faults, of which some are moved to where they harm most.

    Half of the replays begin when a process starts again, if one does. Half of the losses cut a process when it starts
    again, continues, or its clock jumps.
    """
    draws = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(2,)))
    found = [_draw(draws, paths, roles, within) for _ in range(draws.integers(1, 6))]
    woken = [fault for fault in found if isinstance(fault, Crash | Pause | Jump)]
    return tuple(_move(fault, paths, woken) if draws.integers(2) else fault for fault in found)


def _move(fault: Fault, paths: Sequence[Path], woken: Sequence[ProcessFault]) -> Fault:
    """Return a fault of a link that begins when a process is surprised."""
    crash = next((one for one in woken if isinstance(one, Crash)), None)
    if isinstance(fault, Replay) and crash is not None:
        return replace(fault, first=crash.first + crash.steps - 1, steps=fault.steps + 1)
    if isinstance(fault, Loss) and woken:
        path = next(path for path in paths if path[1] == woken[0].role)
        first = woken[0].first + woken[0].steps - 1
        return replace(fault, first=first, steps=fault.steps + CUT, path=path, share=1.0)
    return fault


def _draw(draws: np.random.Generator, paths: Sequence[Path], roles: Sequence[str], within: int) -> Fault:
    first, own = int(draws.integers(0, within)), int(draws.integers(2**31))
    path, role = paths[int(draws.integers(len(paths)))], roles[int(draws.integers(len(roles)))]
    short, long = 1 + int(draws.geometric(0.12)), 1 + int(draws.geometric(0.05))
    share = float(draws.choice([1.0, 1.0, 0.5, 0.2]))
    most = float(draws.choice([0.5, 2.0, 6.0, 20.0]))
    choice = int(draws.integers(10))
    if choice == 0:
        return Delay(first, short, path, share, own, most * float(draws.choice([0.0, 1.0])), most)
    if choice == 1:  # another order
        return Delay(first, long, path, 0.5, own, 0.0, most)
    if choice == 2:
        return Duplicate(first, long, path, share, own, most)
    if choice == 3:
        return Corruption(first, long, path, share, own)
    if choice == 4:
        return Loss(first, long, path, share, own)
    if choice == 5:
        return Replay(first + 2, short, path, int(draws.integers(1, first + 2)))
    if choice == 6:
        return Crash(first, int(draws.choice([long, 4 * long])), role, bool(draws.integers(2)))
    if choice == 7:
        return Pause(first, int(draws.choice([short, long, 4 * long])), role)
    if choice == 8:
        by = float(draws.choice([-1, 1]) * draws.choice([0.5, 4.0, 40.0]) * draws.uniform(0.2, 2.5))
        return Jump(first, 1, role, round(by, 2))
    return Skew(first, 1, role, float(draws.uniform(-DRIFT, DRIFT)))


READ = 14  # steps within which every process has read changed keys
FAR = 1_000_000  # steps by which a recording of a long session is ahead


@dataclass(frozen=True, repr=False)
class Recording(Fault):
    """An attacker sends a recording: everything that was sent on a path before, in the order of the recording."""

    path: Path  # sender and receiver
    # difference of the epoch of the recorded session from the present one, or 0 for the present session
    epochs: int = 0
    ahead: int = 0  # steps by which the steps of the recording are ahead of those of the present session

    def what(self) -> str:
        """Return what happens, in words."""
        session = "this session" if not self.epochs else f"a session with an epoch {self.epochs:+d}"
        return f"a recording of {session}, {self.ahead} steps ahead, is sent from {self.path[0]} to {self.path[1]}"


@dataclass(frozen=True, repr=False)
class Forgery(Fault):
    """An attacker sends packets with other numbers than those of the last step, and with a tag of a wrong key."""

    path: Path  # sender and receiver
    former: bool  # whether the key is a former key of this link, if there is one, or the key of another link

    def what(self) -> str:
        """Return what happens, in words."""
        key = "a former key or that of another link" if self.former else "an unknown key"
        return f"packets from {self.path[0]} to {self.path[1]} are forged with {key}"


@dataclass(frozen=True, repr=False)
class KeyChange(Fault):
    """The key of a link is changed in three writings of the key files: the new key is added, used, and left alone."""

    link: str  # the link

    @property
    def end(self) -> float:
        """Step from which on it has no direct effect."""
        return self.first + self.steps + READ

    def what(self) -> str:
        """Return what happens, in words."""
        return f"the key of the {self.link} link is changed"


def draw_attacks(
    seed: int, paths: Sequence[Path], links: Sequence[str], within: int, faults: Sequence[Fault]
) -> tuple[Fault, ...]:
    """Return one to three random faults of nodes with keys; some recordings begin when a process starts again."""
    draws = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(6,)))
    crash = next((fault for fault in faults if isinstance(fault, Crash)), None)
    found: list[Fault] = []
    for _ in range(draws.integers(1, 4)):
        first, steps = int(draws.integers(10, within)), 1 + int(draws.geometric(0.1))
        path = paths[int(draws.integers(len(paths)))]
        choice = int(draws.integers(4))
        if choice == 0 and not any(isinstance(fault, KeyChange) for fault in found):
            found.append(KeyChange(first, 3 * int(draws.choice([2, READ, 20])), str(draws.choice(links))))
        elif choice == 1:
            found.append(Forgery(first, steps, path, bool(draws.integers(2))))
        else:
            if crash is not None and draws.integers(2):  # the attacker is faster than the true sender
                path = next(path for path in paths if crash.role in path)
                first = crash.first + crash.steps - 1
            epochs = int(draws.choice([0, 500, -500]))
            ahead = int(draws.choice([0, 5, FAR])) if epochs else 0
            found.append(Recording(first, steps, path, epochs, ahead))
    return tuple(found)
