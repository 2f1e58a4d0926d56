"""A link that loses, delays, doubles, reorders and corrupts what it carries: the same of the same seed.

What befalls a packet depends on the seed and its sequence number alone, not on when it comes: a run can be repeated,
and what will be lost can be told before (``Fate.lost``).
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from taciturn._arrays import count, instance, number
from taciturn.errors import ProblemError
from taciturn.model.network import Burst
from taciturn.model.wire import HEADER_SIZE, KINDS, read_place

_WORD = (1 << 64) - 1
_LOSS, _TURN, _FIRST, _DOUBLE, _SWAP, _HARM, _BIT, _WAIT = range(1, 9)
MARK = KINDS.index("mark")


@dataclass(frozen=True)
class Fate:
    """What a link does to a packet.

    Args:
        seed: of the draws.
        loss: probability that a packet is lost, in [0, 1].
        burst: losses that come in bursts instead: the link turns good or bad from tick to tick.
        delay: seconds that every packet takes, and every mark.
        jitter: up to so many seconds more, drawn.
        hold: ticks that every packet waits, as the marks on the link count them; for runs in virtual time.
        duplicate: probability that a packet comes twice.
        reorder: probability that a packet comes after the one that follows it.
        corrupt: probability that one to three bits of a packet are turned.
        outage: (first, end): every packet of the ticks from the first to before the end is lost.

    Raises:
        ProblemError: a probability outside [0, 1], a negative time, loss and burst together, an outage that ends
            before it begins.

    Example:
        >>> [k for k in range(20) if Fate(seed=1, loss=0.2).lost(k, tick=k)]
        [0, 1, 5, 12, 16, 19]
    """

    seed: int = 0
    loss: float = 0.0
    burst: Burst | None = None
    delay: float = 0.0
    jitter: float = 0.0
    hold: int = 0
    duplicate: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0
    outage: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        """Check the ranges."""
        count("seed", self.seed, 0)
        count("hold", self.hold, 0)
        for name in ("loss", "duplicate", "reorder", "corrupt"):
            number(name, getattr(self, name), 0.0, 1.0, closed=True)
        for name in ("delay", "jitter"):
            number(name, getattr(self, name), 0.0, 3600.0, closed=True)
        if self.burst is not None:
            instance("burst", self.burst, Burst)
            if self.loss > 0:
                raise ProblemError("loss and burst are both given; expected one of them")
        if self.outage is not None and not 0 <= self.outage[0] < self.outage[1]:
            raise ProblemError(f"the outage is {self.outage}; expected its first tick and, later, the tick it ends at")

    def uniform(self, purpose: int, index: int) -> float:
        """Return a number in [0, 1) that depends on seed, purpose and index alone (SplitMix64 [steele2014])."""
        return _mix(_mix(self.seed * 0xD1342543DE82EF95 + purpose) + index * 0x9E3779B97F4A7C15) / 2.0**64

    def lost(self, sequence: int, tick: int, loop: int = 0) -> bool:
        """Tell whether a packet is lost; a burst and an outage are those of all loops that share the link."""
        if self.outage is not None and self.outage[0] <= tick < self.outage[1]:
            return True
        chance = self.loss if self.burst is None else self._loss_at(tick)
        return self.uniform(_LOSS, of_loop(sequence, loop)) < chance

    def _loss_at(self, tick: int) -> float:
        assert self.burst is not None
        return self.burst.loss_bad if self._bad_at(tick) else self.burst.loss_good

    def _bad_at(self, tick: int) -> bool:
        """Whether the link is bad in a tick: the state of the tick at which all histories have last met, moved on."""
        burst = self.burst
        assert burst is not None
        turns: list[float] = []
        # one draw moves both states: a draw that leads both to the same one makes the past irrelevant
        for back in range(tick, 0, -1):
            drawn = self.uniform(_TURN, back)
            turns.append(drawn)
            if (drawn < 1 - burst.to_good) == (drawn < burst.to_bad):
                bad = drawn < burst.to_bad
                turns.pop()
                break
        else:
            bad = self.uniform(_FIRST, 0) < burst.share_bad
        for drawn in reversed(turns):
            bad = drawn < (1 - burst.to_good if bad else burst.to_bad)
        return bad


class EmulatedLink:
    """A link on its way: datagrams in, datagrams out; no socket, and time is what the caller says.

    Args:
        fate: what it does.
    """

    def __init__(self, fate: Fate) -> None:
        """Nothing is on its way."""
        self.fate = fate
        self.counters: Counter[str] = Counter()
        self._waiting: list[tuple[float, int, bool, bytes]] = []  # due, order, whether it is a mark, datagram
        self._held: list[tuple[int, bytes]] = []  # tick of the mark that lets it go, datagram
        self._swapped: bytes | None = None
        self._order = 0

    @property
    def due(self) -> float | None:
        """When the next datagram is due, or None."""
        return min(self._waiting)[0] if self._waiting else None

    @property
    def pending(self) -> int:
        """Datagrams that are still on their way; marks are not counted."""
        waiting = sum(not mark for _, _, mark, _ in self._waiting)
        return waiting + len(self._held) + (self._swapped is not None)

    def take(self, datagram: bytes, now: float) -> list[bytes]:
        """Take a datagram in, and return what comes out at once.

        A mark says that all packets of its tick were sent before it: it is never lost, and takes the delay, or longer
        where what was sent before it does. It overtakes only what ``hold`` and ``reorder`` mean to come too late. What
        is no packet at all is dropped.
        """
        if len(datagram) < HEADER_SIZE:
            self.counters["foreign"] += 1
            return []
        sequence, kind, loop, tick = read_place(datagram)
        if kind == MARK:
            self.counters["marks"] += 1
            free = [old for let, old in self._held if let <= tick]
            self._held = [(let, old) for let, old in self._held if let > tick]
            if not self._waiting and self.fate.delay == 0.0:
                return [*self._out(free), datagram]
            last = max((due for due, *_ in self._waiting), default=now)
            self._wait([datagram], max(now + self.fate.delay, last), mark=True)
            return self._out(free)
        self.counters["received"] += 1
        fate = self.fate
        if fate.lost(sequence, tick, loop):
            self.counters["lost"] += 1
            return []
        sequence = of_loop(sequence, loop)
        if fate.uniform(_HARM, sequence) < fate.corrupt:
            self.counters["corrupted"] += 1
            datagram = self._harmed(datagram, sequence)
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
        return self._send(copies, sequence, tick, now)

    def release(self, now: float) -> list[bytes]:
        """Return the datagrams that are due."""
        due = sorted(entry for entry in self._waiting if entry[0] <= now)
        self._waiting = [entry for entry in self._waiting if entry[0] > now]
        self._out([datagram for _, _, mark, datagram in due if not mark])
        return [datagram for *_, datagram in due]

    def _send(self, copies: list[bytes], sequence: int, tick: int, now: float) -> list[bytes]:
        fate = self.fate
        if fate.hold:
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

    def _harmed(self, datagram: bytes, sequence: int) -> bytes:
        harmed = bytearray(datagram)
        for i in range(1 + int(3 * self.fate.uniform(_BIT, 4 * sequence))):
            place = int(8 * len(harmed) * self.fate.uniform(_BIT, 4 * sequence + 1 + i))
            harmed[place // 8] ^= 1 << place % 8
        return bytes(harmed)


def of_loop(sequence: int, loop: int) -> int:
    """Return a number that tells the packets of all loops apart."""
    return sequence | loop << 32


def _mix(z: int) -> int:
    z &= _WORD
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & _WORD
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & _WORD
    return z ^ (z >> 31)
