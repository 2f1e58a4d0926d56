"""Faults of links, processes, clocks and keys, described as data, and drawn at random from a seed.

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

from taciturn.extend import Displayed, number_of, percent
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
        """Step at which the fault's direct effect ends."""
        return self.first + self.steps

    def text(self) -> str:
        """Return a line of text that describes the fault."""
        return f"steps {self.first} to {self.first + self.steps - 1}: {self.what()}"

    @abstractmethod
    def what(self) -> str:
        """Return the event, in words."""


@dataclass(frozen=True, repr=False)
class LinkFault(Fault):
    """A fault of a link in one of its two directions."""

    path: Path  # sender and receiver
    share: float = 1.0  # probability that a datagram is affected
    seed: int = 0  # seed of the random draws

    @abstractmethod
    def act(self, flights: Flights, number: int) -> Flights:
        """Return the delays and contents with which one sent datagram arrives; ``number`` is its place on the path."""

    def what(self) -> str:
        """Return the event, in words."""
        affected = "every datagram" if self.share >= 1 else f"{percent(self.share, 0)} of the datagrams"
        return f"{affected} from {self.path[0]} to {self.path[1]} {self.effect()}"

    @abstractmethod
    def effect(self) -> str:
        """Return the predicate of the sentence that describes the fault."""

    def _hits(self, purpose: int, number: int) -> bool:
        return uniform(self.seed, purpose, number) < self.share


class Loss(LinkFault):
    """Fault of a link that drops a share of the datagrams; a share of 1 drops all of them."""

    def act(self, flights: Flights, number: int) -> Flights:
        """Drop the datagram."""
        return [] if self._hits(_LOSS, number) else flights

    def effect(self) -> str:
        """Return the predicate of the sentence that describes the fault."""
        return "is dropped" if self.share >= 1 else "are dropped"


@dataclass(frozen=True, repr=False)
class Delay(LinkFault):
    """Fault of a link that delays datagrams; unequal delays change their order."""

    least: float = 0.0  # smallest delay in steps
    most: float = 1.0  # largest delay in steps

    @property
    def end(self) -> float:
        """Step at which the fault's direct effect ends."""
        return self.first + self.steps + self.most

    def act(self, flights: Flights, number: int) -> Flights:
        """Delay every copy of the datagram by the same time."""
        if not self._hits(_DELAY, number):
            return flights
        by = self.least + (self.most - self.least) * uniform(self.seed, _TIME, number)
        return [(delay + by, datagram) for delay, datagram in flights]

    def effect(self) -> str:
        """Return the predicate of the sentence that describes the fault."""
        verb = "arrives" if self.share >= 1 else "arrive"
        late = f"{self.least:g} to {self.most:g}" if self.most > self.least else f"{self.most:g}"
        return f"{verb} {number_of(late, 'step')} late"


@dataclass(frozen=True, repr=False)
class Duplicate(LinkFault):
    """Datagrams arrive twice."""

    most: float = 1.0  # largest delay of the copy in steps

    @property
    def end(self) -> float:
        """Step at which the fault's direct effect ends."""
        return self.first + self.steps + self.most

    def act(self, flights: Flights, number: int) -> Flights:
        """Add a copy."""
        if not self._hits(_COPY, number):
            return flights
        by = self.most * uniform(self.seed, _TIME, number)
        return flights + [(delay + by, datagram) for delay, datagram in flights]

    def effect(self) -> str:
        """Return the predicate of the sentence that describes the fault."""
        return f"{'arrives' if self.share >= 1 else 'arrive'} twice, within {number_of(f'{self.most:g}', 'step')}"


class Corruption(LinkFault):
    """Fault of a link that inverts one to three bits of a datagram."""

    def act(self, flights: Flights, number: int) -> Flights:
        """Invert bits of the datagram."""
        if not self._hits(_HARM, number):
            return flights
        return [(delay, flip_bits(datagram, self.seed, number)) for delay, datagram in flights]

    def effect(self) -> str:
        """Return the predicate of the sentence that describes the fault."""
        return f"{'loses' if self.share >= 1 else 'lose'} one to three bits"


@dataclass(frozen=True, repr=False)
class Replay(Fault):
    """An attack that sends the datagrams of the same session again, a fixed number of steps later."""

    path: Path  # sender and receiver
    age: int  # number of steps since they were sent

    def what(self) -> str:
        """Return the event, in words."""
        return f"datagrams from {self.path[0]} to {self.path[1]} are sent again after {number_of(self.age, 'step')}"


@dataclass(frozen=True, repr=False)
class ProcessFault(Fault):
    """A fault of a process, or of the machine on which it runs."""

    role: str  # name of the process


@dataclass(frozen=True, repr=False)
class Crash(ProcessFault):
    """Fault that kills a process and starts it again some steps later."""

    kept: bool  # whether it starts from its saved state

    def what(self) -> str:
        """Return the event, in words."""
        return f"the {self.role} does not run, and starts again {'with' if self.kept else 'without'} its state"


class Pause(ProcessFault):
    """A process is suspended."""

    def what(self) -> str:
        """Return the event, in words."""
        return f"the {self.role} is suspended"


@dataclass(frozen=True, repr=False)
class Jump(ProcessFault):
    """Fault in which a machine's clock jumps.

    Args:
        by: steps by which the clock jumps, forward or (negative) back.
    """

    by: float

    def text(self) -> str:
        """Return a line of text that describes the fault."""
        return f"step {self.first}: {self.what()}"

    def what(self) -> str:
        """Return the event, in words."""
        way, steps = "forward" if self.by > 0 else "back", number_of(f"{abs(self.by):g}", "step")
        return f"the clock of the {self.role} jumps {way} by {steps}"


@dataclass(frozen=True, repr=False)
class Skew(ProcessFault):
    """Fault in which a machine's clock runs fast or slow, from one step to the end of the test."""

    by: float  # relative error of its speed

    def text(self) -> str:
        """Return a line of text that describes the fault."""
        return f"from step {self.first}: {self.what()}"

    def what(self) -> str:
        """Return the event, in words."""
        return f"the clock of the {self.role} is {percent(abs(self.by), 2)} {'fast' if self.by > 0 else 'slow'}"


def draw_faults(seed: int, paths: Sequence[Path], roles: Sequence[str], within: int) -> tuple[Fault, ...]:
    """Draw one to five random faults, and move some of them to steps at which they do most harm.

    Half of the replays begin when a process starts again, if one does. Half of the losses disconnect a process when it
    starts again, when it continues, or when its clock jumps.
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
    """A replay attack, which sends all datagrams again that were sent on a path before, in the same order."""

    path: Path  # sender and receiver
    # difference of the epoch of the recorded session from the present one, or 0 for the present session
    epochs: int = 0
    ahead: int = 0  # steps by which the steps of the recording are ahead of those of the present session

    def what(self) -> str:
        """Return the event, in words."""
        session = "this session" if not self.epochs else f"a session with an epoch {self.epochs:+d}"
        ahead = number_of(self.ahead, "step")
        return f"a recording of {session}, {ahead} ahead, is sent from {self.path[0]} to {self.path[1]}"


@dataclass(frozen=True, repr=False)
class Forgery(Fault):
    """An attack with forged packets, which carry other numbers than the last packets, and the tag of a wrong key."""

    path: Path  # sender and receiver
    former: bool  # whether the key is a former key of this link, if there is one, or the key of another link

    def what(self) -> str:
        """Return the event, in words."""
        key = "a former key or that of another link" if self.former else "an unknown key"
        return f"packets from {self.path[0]} to {self.path[1]} are forged with {key}"


@dataclass(frozen=True, repr=False)
class KeyChange(Fault):
    """Change of a link's key by three updates of the key files: add the new key, use it, and remove the old key."""

    link: str  # the link

    @property
    def end(self) -> float:
        """Step at which the fault's direct effect ends."""
        return self.first + self.steps + READ

    def what(self) -> str:
        """Return the event, in words."""
        return f"the key of the {self.link} link is changed"


def draw_attacks(
    seed: int, paths: Sequence[Path], links: Sequence[str], within: int, faults: Sequence[Fault]
) -> tuple[Fault, ...]:
    """Draw one to three random attacks on nodes that have keys; some begin when a process starts again."""
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
