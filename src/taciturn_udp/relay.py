"""Emulated link, which drops, delays, duplicates, reorders and corrupts packets as a random seed determines.

The impairments of a packet depend only on the seed and its place (sequence number, step and loop), not on its arrival
time. Therefore a run can be repeated, and its packet drops can be predicted (``Fate.lost``). ``losses`` are those of a
network, ``EmulatedLink`` applies them to datagrams without sockets, and ``relay`` does so between two sockets.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Displayed, count, instance, number
from taciturn.model.coverage import INTERVALS, LATE, NETWORKS, Coverage
from taciturn.model.losses import LossLaw
from taciturn.model.network import Network
from taciturn.model.wire import HEADER_SIZE, KINDS, read_place
from taciturn_udp.endpoint import Address
from taciturn_udp.late import Lateness, stamped
from taciturn_udp.service import IDLE, QUIET, Port

_WORD = (1 << 64) - 1
_LOSS, _TURN, _FIRST, _DOUBLE, _SWAP, _HARM, _BIT, _WAIT, _LATE, _PIECE = range(1, 11)
DELAYED = Coverage(NETWORKS | INTERVALS | LATE, "running links do not emulate")
EMULATED = Coverage(NETWORKS | INTERVALS, "only relays emulate", "a network of relays, or a link with a buffer")
MARK, ANSWER = KINDS.index("mark"), KINDS.index("answer")


@dataclass(frozen=True, repr=False)
class Fate(Displayed):
    """The impairments that a link causes: packets are dropped, delayed, duplicated, reordered or corrupted.

    Args:
        seed: seed of the random draws.
        loss: probability that a packet is dropped, in [0, 1].
        burst: law of bursty losses, used instead of ``loss``.
        delay: delay of every packet and every mark, in seconds.
        jitter: largest additional random delay, in seconds.
        hold: delay of every packet in steps, counted by the marks on the link; for runs in virtual time.
        duplicate: probability that a packet is delivered twice.
        reorder: probability that a packet is delivered after its successor.
        corrupt: probability that one to three bits of a packet are inverted.
        outage: (first, end): every packet of a step in first ≤ step < end is dropped.
        late: law of random delays, of packets; marks take the least of them.

    Raises:
        ProblemError: a probability is outside [0, 1], a time is negative, loss and burst are both given, or an outage
            ends before it begins.

    Example:
        >>> [k for k in range(20) if Fate(seed=1, loss=0.2).lost(k, tick=k)]
        [0, 1, 5, 12, 16, 19]
    """

    seed: int = 0
    loss: float = 0.0
    burst: LossLaw | None = None
    delay: float = 0.0
    jitter: float = 0.0
    hold: int = 0
    duplicate: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0
    outage: tuple[int, int] | None = None
    late: Lateness | None = None
    _last: tuple[int, int] = field(default=(-1, 0), init=False, repr=False, compare=False)  # step, its state

    def __post_init__(self) -> None:
        """Check the ranges."""
        count("seed", self.seed, 0)
        count("hold", self.hold, 0)
        for name in ("loss", "duplicate", "reorder", "corrupt"):
            number(name, getattr(self, name), 0.0, 1.0, closed=True)
        for name in ("delay", "jitter"):
            number(name, getattr(self, name), 0.0, 3600.0, closed=True)
        if self.burst is not None:
            instance("burst", self.burst, LossLaw)
            if self.loss > 0:
                raise ProblemError("loss and burst are both given; expected only one of them")
        if self.outage is not None and not 0 <= self.outage[0] < self.outage[1]:
            raise ProblemError(f"the outage is {self.outage}; expected (first, end) with 0 <= first < end")

    @property
    def timed(self) -> Lateness | None:
        """The law of random delays if they are in seconds, for runs in real time; otherwise None."""
        return None if self.late is None or self.late.pieces else self.late

    def uniform(self, purpose: int, index: int) -> float:
        """Return a pseudo-random number in [0, 1), as a function of seed, purpose and index only."""
        return uniform(self.seed, purpose, index)

    def lost(self, sequence: int, tick: int, loop: int = 0) -> bool:
        """Return whether the link drops a packet; bursts and outages affect the packets of all loops."""
        if self.outage is not None and self.outage[0] <= tick < self.outage[1]:
            return True
        chance = self.loss if self.burst is None else float(self.burst.losses[self._state_at(self.burst, tick)])
        return self.uniform(_LOSS, of_loop(sequence, loop)) < chance

    def late_by(self, sequence: int, tick: int, loop: int = 0) -> float | None:
        """Return the random delay of a packet as its law counts it, or None if it never arrives."""
        law = self.late
        if law is None or law.sequence:
            return 0.0 if law is None else law.replayed(tick, lambda index: self.uniform(_PIECE, index))
        state = 0 if self.burst is None else self._state_at(self.burst, tick)
        return law.drawn(self.uniform(_LATE, of_loop(sequence, loop)), state)

    def _state_at(self, burst: LossLaw, tick: int) -> int:
        """Return the state of the link in a step, from the last earlier step at which all histories coincide."""
        known, state = self._last
        reached = tuple(range(len(burst.losses)))  # the state in this step, for each state in an earlier step
        for back in range(tick, 0, -1):
            if back == known:
                break
            # one draw moves each state; if all lead to the same one, earlier steps are irrelevant
            reached = tuple(reached[after] for after in burst.move(self.uniform(_TURN, back)))
            if len(set(reached)) == 1:
                state = 0
                break
        else:
            state = int(burst.pick(np.array([self.uniform(_FIRST, 0)]))[0])
        object.__setattr__(self, "_last", (tick, reached[state]))
        return reached[state]


def losses(
    network: Network,
    seed: int,
    outages: Mapping[str, tuple[int, int] | None] | None = None,
    period: float | None = None,
    tick: float | None = None,
) -> dict[str, Fate]:
    """Return the impairments of each link of a network, including an outage, in which a link drops every packet.

    Random delays need the sampling period, whose real duration is ``tick``, or None in virtual time.
    """
    (EMULATED if period is None else DELAYED).check(network)
    links = tuple(reversed(tuple(network.links)))
    return {
        link: Fate(
            seed=len(links) * seed + i,
            loss=0.0 if network.burst(link) else network.loss(link),
            burst=network.burst(link),
            outage=(outages or {}).get(link),
            late=None if period is None else Lateness.of(network, link, period, tick),
        )
        for i, link in enumerate(links)
    }


class EmulatedLink:
    """Emulated link that takes and returns datagrams, without sockets or a clock; the caller provides the time."""

    def __init__(self, fate: Fate) -> None:
        """Start without packets on the link."""
        self.fate = fate
        self.counters: Counter[str] = Counter()
        self._waiting: list[tuple[float, int, bool, bytes]] = []  # due time, order, whether it is a mark, datagram
        self._held: list[tuple[int, bytes]] = []  # step of the mark that releases it, datagram
        self._swapped: bytes | None = None
        self._order = 0

    @property
    def due(self) -> float | None:
        """Time at which the next datagram leaves the link; None if the link holds no datagram."""
        return min(self._waiting)[0] if self._waiting else None

    @property
    def pending(self) -> int:
        """Number of packets on the link; messages that only report the end of a step (marks) are not counted."""
        waiting = sum(not mark for _, _, mark, _ in self._waiting)
        return waiting + len(self._held) + (self._swapped is not None)

    def take(self, datagram: bytes, now: float) -> list[bytes]:
        """Accept a datagram, and return the datagrams that leave the link at once.

        A mark reports that all packets of its step were sent before it. Marks and answers to challenges are never
        dropped. They are delayed by ``delay``, or longer if a packet sent before them is. They overtake only packets
        that ``hold``, ``reorder`` or, in real time, ``late`` delays. A malformed packet is dropped.
        """
        if len(datagram) < HEADER_SIZE:
            self.counters["foreign"] += 1
            return []
        sequence, kind, loop, tick = read_place(datagram)
        if kind in (MARK, ANSWER):
            self.counters["marks" if kind == MARK else "answers"] += 1
            free = [old for let, old in self._held if let <= tick]
            self._held = [(let, old) for let, old in self._held if let > tick]
            timed = self.fate.timed
            delay = self.fate.delay + (0.0 if timed is None else timed.delays[0])
            if delay == 0.0 and (timed is not None or not self._waiting):
                return [*self._out(free), datagram]
            last = max((due for due, *_ in self._waiting), default=now)
            self._wait([datagram], max(now + delay, now if timed is not None else last), mark=True)
            return self._out(free)
        self.counters["received"] += 1
        fate = self.fate
        late = None if fate.lost(sequence, tick, loop) else fate.late_by(sequence, tick, loop)
        if late is None:
            self.counters["lost"] += 1
            return []
        sequence = of_loop(sequence, loop)
        if fate.uniform(_HARM, sequence) < fate.corrupt:
            self.counters["corrupted"] += 1
            datagram = flip_bits(datagram, fate.seed, sequence)
        copies = [datagram]
        if fate.uniform(_DOUBLE, sequence) < fate.duplicate:
            self.counters["duplicated"] += 1
            copies.append(datagram)
        if fate.uniform(_SWAP, sequence) < fate.reorder and self._swapped is None:
            self.counters["reordered"] += 1
            self._swapped, *copies = copies
        elif self._swapped is not None:
            copies.append(self._swapped)
            self._swapped = None
        if fate.timed is not None:
            self._wait(copies, now + fate.delay + fate.jitter * fate.uniform(_WAIT, sequence) + late)
            return []
        if fate.late is not None:
            tick, copies = tick + int(late) // fate.late.pieces, [stamped(copy, late) for copy in copies]
        return self._send(copies, sequence, tick, now)

    def release(self, now: float) -> list[bytes]:
        """Return the datagrams that leave the link now, because their delay is over."""
        due = sorted(entry for entry in self._waiting if entry[0] <= now)
        self._waiting = [entry for entry in self._waiting if entry[0] > now]
        self._out([datagram for _, _, mark, datagram in due if not mark])
        return [datagram for *_, datagram in due]

    def _send(self, copies: list[bytes], sequence: int, tick: int, now: float) -> list[bytes]:
        fate = self.fate
        if fate.hold or fate.late is not None:
            self._held += [(tick + fate.hold, datagram) for datagram in copies]
            return []
        if fate.delay == 0.0 and fate.jitter == 0.0:
            return self._out(copies)
        self._wait(copies, now + fate.delay + fate.jitter * fate.uniform(_WAIT, sequence))
        return []

    def _wait(self, datagrams: list[bytes], due: float, mark: bool = False) -> None:
        for datagram in datagrams:
            self._waiting.append((due, self._order, mark, datagram))
            self._order += 1

    def _out(self, datagrams: list[bytes]) -> list[bytes]:
        self.counters["delivered"] += len(datagrams)
        return datagrams


def relay(link: EmulatedLink, endpoint: Port, peer: Address, stopped: Callable[[], bool]) -> dict[str, Any]:
    """Forward datagrams to an address over an emulated link until stopped, and return the report.

    Datagrams from the peer, such as challenges, go back without impairments to the last other sender.
    """
    client: Address | None = None

    def carry(until: float) -> bool:
        nonlocal client
        found = endpoint.receive(until if link.due is None else min(until, link.due))
        now, out = time.monotonic(), list[bytes]()
        for datagram, sender in zip(found, endpoint.senders, strict=True):
            if sender != peer:
                client = sender
                out += link.take(datagram, now)
            elif client is not None:
                endpoint.send(datagram, client)
                link.counters["sent back"] += 1
        for datagram in out + link.release(now):
            endpoint.send(datagram, peer)
        return bool(found)

    while not stopped():
        carry(time.monotonic() + IDLE)
    while carry(time.monotonic() + QUIET):
        pass
    return {
        "role": "relay",
        "counters": dict(link.counters),
        "pending": link.pending,
        "datagrams": endpoint.counted,
    }


def uniform(seed: int, purpose: int, index: int) -> float:
    """Return a pseudo-random number in [0, 1), as a function of the arguments only (SplitMix64 [steele2014])."""
    return _mix(_mix(seed * 0xD1342543DE82EF95 + purpose) + index * 0x9E3779B97F4A7C15) / 2.0**64


def flip_bits(datagram: bytes, seed: int, index: int) -> bytes:
    """Invert one to three bits of a datagram."""
    harmed = bytearray(datagram)
    for i in range(1 + int(3 * uniform(seed, _BIT, 4 * index))):
        place = int(8 * len(harmed) * uniform(seed, _BIT, 4 * index + 1 + i))
        harmed[place // 8] ^= 1 << place % 8
    return bytes(harmed)


def of_loop(sequence: int, loop: int) -> int:
    """Return a number that distinguishes a packet from all packets of this loop and of other loops."""
    return sequence | loop << 32


def _mix(z: int) -> int:
    z &= _WORD
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & _WORD
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & _WORD
    return z ^ (z >> 31)
